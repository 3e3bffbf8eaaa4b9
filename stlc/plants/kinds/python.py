"""Plants in Python: a class, a function that makes a step, or the right-hand side of a differential equation.

- A class has the methods `reset(initial, params)` and `step(inputs)`. The arguments are dictionaries; both
  return the outputs, as a dictionary or in the order of the plant file.
- A step is `step(state, inputs, dt)`. It returns the next state.
- A right-hand side is `f(t, x, u)`. It returns the derivative of the state.

States, inputs and parameters of functions are NumPy vectors in the order of the plant file; the states are
those of the section `initial`. A function with a fourth argument gets the parameters.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, final

import numpy as np

from stlc.dynamics.declaration.schema.record import TEXT, integer, key, number, word
from stlc.extras import needed
from stlc.foreign import module_at
from stlc.plants.kind import FaultError, Floats, Layout, PlantKind, UnfitError, vector
from stlc.similar import did_you_mean

TARGET = re.compile(r"(?P<module>[\w./-]+\.py|\w+(?:\.\w+)*):(?P<attribute>[^\W\d]\w*)")
FORMS = ("class", "step", "flow")


@dataclass(frozen=True, slots=True)
class PythonKeys:
    """The keys of `python` in a plant file."""

    target: str | None = key(
        TEXT, "`file.py:name` beside the plant file, or `package.module:name`", required=True
    )
    form: str | None = key(
        word(FORMS), "what it is; unless given, a class, or a function by its first argument"
    )
    integrator: str = key(
        word(("rk4", "scipy")), "of a `flow`: fixed steps, or `scipy.integrate` (LSODA)", "rk4"
    )
    substeps: int = key(
        integer(high=100_000), "of a `flow` with `rk4`: integration steps in one time step", 1
    )
    tolerance: float = key(number(), "of a `flow` with `scipy`: relative tolerance", 1e-8)


def open_python(layout: Layout) -> PythonObject | StateFunction:
    """Import the target and return the plant. Raises UnfitError if it cannot be loaded."""
    target = _target(str(layout.options["target"]), layout)
    form = layout.options.get("form") or _form(target)
    if form == "class":
        return PythonObject(target, layout)
    return StateFunction(target, layout, flow=form == "flow")


def _target(text: str, layout: Layout) -> Callable[..., Any]:
    match = TARGET.fullmatch(text)
    if match is None:
        raise UnfitError(f"`{text}` is not of the form `file.py:name` or `package.module:name`")
    sys.path.insert(0, layout.folder)
    try:
        where = match["module"]
        if where.endswith(".py"):
            module = module_at(layout.path(where), f"stlc_plant_{Path(where).stem}")
        else:
            module = importlib.import_module(where)
    except Exception as error:
        raise UnfitError(f"importing `{match['module']}` fails: {type(error).__name__}: {error}") from error
    found = getattr(module, match["attribute"], None)
    if not callable(found):
        near = did_you_mean(
            match["attribute"], [name for name, value in vars(module).items() if callable(value)]
        )
        raise UnfitError(
            "; ".join((f"`{match['module']}` has no function or class `{match['attribute']}`", *near))
        )
    return found  # type: ignore[no-any-return]


def _form(target: Callable[..., Any]) -> str:
    if isinstance(target, type):
        return "class"
    first = next(iter(_parameters(target)), "")
    if first in ("t", "time"):
        return "flow"
    if first in ("state", "x"):
        return "step"
    raise UnfitError(
        f"what kind of function is it? Its first argument is `{first}`; give `form`: step or flow"
    )


def _parameters(target: Callable[..., Any]) -> list[str]:
    try:
        return list(inspect.signature(target).parameters)
    except (TypeError, ValueError):
        return []


@final
class PythonObject:
    """A plant that is a class; every simulation makes a new object."""

    def __init__(self, make: Callable[..., Any], layout: Layout) -> None:
        missing = [name for name in ("reset", "step") if not callable(getattr(make, name, None))]
        if isinstance(make, type) and missing:
            raise UnfitError(f"the class lacks the method `{missing[0]}`")
        self.units: dict[str, str] = {}
        self.ended = False
        self._make, self._layout = make, layout
        self._options = {"dt": layout.dt} if "dt" in _parameters(make) else {}
        if layout.halves and not self._options:
            raise UnfitError("the constructor has no argument `dt`, so its time step is fixed", "time.halves")
        self._object: Any = None

    def start(self, initial: Floats, param: Floats, _inputs: Floats, _seed: int) -> Floats:
        """Make an object and reset it."""
        layout = self._layout
        self._object = self._make(**self._options)
        given = (
            {port.source: float(value) for port, value in zip(ports, values, strict=True)}
            for ports, values in ((layout.initial, initial), (layout.param, param))
        )
        return vector(self._object.reset(*given), layout.outputs, "the outputs of `reset`")

    def step(self, inputs: Floats) -> Floats:
        """Call the method `step`."""
        ports = self._layout.inputs
        given = {port.source: float(value) for port, value in zip(ports, inputs, strict=True)}
        return vector(self._object.step(given), self._layout.outputs, "the outputs of `step`")


@final
class StateFunction:
    """A plant that is a function of its state; the outputs are states."""

    def __init__(self, function: Callable[..., Any], layout: Layout, *, flow: bool) -> None:
        self.units: dict[str, str] = {}
        self.ended = False
        self._function, self._layout, self._flow = function, layout, flow
        self._with_params = len(_parameters(function)) > 3
        states = [port.source for port in layout.initial]
        for port in layout.outputs:
            if port.source not in states:
                advice = did_you_mean(port.source, states, f"states: {', '.join(states)}")
                message = f"the output `{port.name}` is not a state of the section `initial`"
                raise UnfitError("; ".join((message, *advice)), f"output.{port.name}")
        self._read = np.array([states.index(port.source) for port in layout.outputs], dtype=np.intp)
        adaptive = flow and layout.options.get("integrator") == "scipy"
        self._advance = self._adaptive() if adaptive else self._rk4 if flow else self._step
        self._x: Floats = np.zeros(0)
        self._param: tuple[Floats, ...] = ()
        self._steps = 0

    def start(self, initial: Floats, param: Floats, _inputs: Floats, _seed: int) -> Floats:
        """Take the start values as the state."""
        self._x, self._steps = np.array(initial), 0
        self._param = (param,) if self._with_params else ()
        return self._x[self._read]

    def step(self, inputs: Floats) -> Floats:
        """Advance the state by one time step."""
        self._x = self._advance(self._steps * self._layout.dt, self._x, inputs)
        self._steps += 1
        return self._x[self._read]

    def _step(self, _t: float, x: Floats, u: Floats) -> Floats:
        return self._numbers(self._function(x, u, self._layout.dt, *self._param), "the next state")

    def _slope(self, t: float, x: Floats, u: Floats) -> Floats:
        return self._numbers(self._function(t, x, u, *self._param), "the derivative")

    def _numbers(self, given: Any, what: str) -> Floats:
        try:
            found = np.asarray(given, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError) as error:
            raise FaultError("wrong shape", f"{what} is not a vector: {str(error)[:200]}") from error
        if found.size != len(self._layout.initial):
            shape = f"{what} has {found.size:,} components, the state has {len(self._layout.initial)}"
            raise FaultError("wrong shape", shape)
        return found

    def _rk4(self, t: float, x: Floats, u: Floats) -> Floats:
        """One time step in equal substeps of the classical Runge-Kutta method of order 4 (Kutta 1901)."""
        count = int(self._layout.options.get("substeps", 1))
        h = self._layout.dt / count
        for index in range(count):
            at = t + index * h
            k1 = self._slope(at, x, u)
            k2 = self._slope(at + h / 2, x + h / 2 * k1, u)
            k3 = self._slope(at + h / 2, x + h / 2 * k2, u)
            k4 = self._slope(at + h, x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    def _adaptive(self) -> Callable[[float, Floats, Floats], Floats]:
        """One time step by LSODA (Petzold 1983) of SciPy."""
        solve_ivp = needed("scipy.integrate").solve_ivp
        tolerance = float(self._layout.options.get("tolerance", 1e-8))

        def advance(t: float, x: Floats, u: Floats) -> Floats:
            found = solve_ivp(
                self._slope,
                (t, t + self._layout.dt),
                x,
                "LSODA",
                args=(u,),
                rtol=tolerance,
                atol=tolerance * 1e-3,
            )
            if not found.success:
                raise FaultError("error", f"the integrator fails: {found.message}")
            return np.asarray(found.y[:, -1])

        return advance


# ------------------------------------------------------------------------------------ files


def _files(options: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """Return the file of the target, and the modules in the folder of the plant file that it imports.

    Imports are read from the text: nothing is imported. A target in another place is its file alone.
    """
    match = TARGET.fullmatch(str(options["target"]))
    if match is None:
        return {}
    named = match["module"]
    first = folder / named if named.endswith(".py") else _located(named, folder)
    found: dict[str, Path] = {} if first is None else {_shown(first, folder, named): first}
    waiting = list(found.values()) if first is not None and first.is_relative_to(folder) else []
    while waiting:
        for name in _imports(waiting.pop(), folder):
            base = folder.joinpath(*name.split("."))
            files = (base.with_suffix(".py"), base / "__init__.py")
            path = next((each for each in files if each.is_file()), None)
            if path is not None and path not in found.values():
                found[_shown(path, folder, name)] = path
                waiting.append(path)
    return found


def _shown(path: Path, folder: Path, otherwise: str) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else otherwise


def _located(module: str, folder: Path) -> Path | None:
    """Return the file of a module that is not imported: in a folder, or where Python would find it."""
    places: Sequence[str] | None = [str(folder), *sys.path]
    found = None
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        found = PathFinder.find_spec(".".join(parts[:count]), places)
        if found is None:
            return None
        places = found.submodule_search_locations
    return None if found is None or not found.has_location or found.origin is None else Path(found.origin)


def _imports(path: Path, folder: Path) -> Iterator[str]:
    """Yield the names of modules that a Python file below `folder` may import; of `a.b` also `a`."""
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError):
        return
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = path.relative_to(folder).parent.parts
            above = package[: max(len(package) - node.level + 1, 0)] if node.level else ()
            base = (*above, *filter(None, [node.module]))
            names = [".".join(base), *(".".join((*base, each.name)) for each in node.names)]
        for name in names:
            parts = name.split(".") if name else []
            yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))


KIND = PlantKind(PythonKeys, "target", open_python, files=_files, packages=("scipy",))
