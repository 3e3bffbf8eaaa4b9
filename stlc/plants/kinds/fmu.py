"""Functional mock-up units (FMUs) as plants: FMI 2.0 and 3.0, co-simulation and model exchange, by fmpy.

Start values, parameters, inputs and outputs are variables of the FMU, by their names. Inputs are constant
during a time step. In model exchange, CVode (SUNDIALS) integrates, and state events, time events and step
events are handled as FMI prescribes (FMI 2.0.5, section 3.2; FMI 3.0.2, section 3.3).
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from stlc.dynamics.declaration.schema.record import TEXT, key, number, word
from stlc.extras import needed
from stlc.plants.kind import FaultError, Floats, Layout, PlantKind, Port, UnfitError
from stlc.similar import did_you_mean

INTERFACES = {"co-simulation": "coSimulation", "model exchange": "modelExchange"}
_NEAR = 1e-9
"""Times closer than this share of a time step are the same."""
_CLOSEST = 50
"""The integrator makes at least this many steps in a simulation, so that it does not step over events."""


@dataclass(frozen=True, slots=True)
class FmuKeys:
    """The keys of `fmu` in a plant file."""

    file: str | None = key(TEXT, "the FMU, relative to the plant file", required=True)
    interface: str | None = key(word(INTERFACES), "unless given, `co-simulation` if the FMU offers it")
    tolerance: float = key(number(), "relative tolerance of the integration", 1e-6)


def open_fmu(layout: Layout) -> Fmu:
    """Unpack the FMU and load its library. Raises UnfitError if it cannot be used."""
    needed("fmpy.simulation")
    needed("fmpy.sundials")  # before the clock of the first simulation runs
    fmpy = needed("fmpy")
    path = layout.path(str(layout.options["file"]))
    if not path.is_file():
        raise UnfitError(f"there is no file `{path}`")
    try:
        description = fmpy.read_model_description(str(path))
        folder = fmpy.extract(str(path), unzipdir=layout.scratch)
    except (OSError, zipfile.BadZipFile, KeyError) as error:
        raise UnfitError(f"`{path.name}` is not an FMU: {error}") from error
    except Exception as error:
        raise UnfitError(f"`{path.name}` cannot be read: {str(error)[:500]}") from error
    if not description.fmiVersion.startswith(("2.", "3.")):
        raise UnfitError(f"`{path.name}` follows FMI {description.fmiVersion}; FMI 2 and 3 are read")
    offered = [name for name, attribute in INTERFACES.items() if getattr(description, attribute) is not None]
    interface = layout.options.get("interface") or (offered[0] if offered else "")
    if interface not in offered:
        wanted = f"no interface `{interface}`" if interface else "neither interface"
        raise UnfitError(f"`{path.name}` has {wanted}; it has {', '.join(offered) or 'another one'}")
    variables = _Variables(description, layout)
    return Fmu(description, str(folder), layout, variables, exchange=interface == "model exchange")


class _Variables:
    def __init__(self, description: Any, layout: Layout) -> None:
        self.major = 2 if description.fmiVersion.startswith("2.") else 3
        self._known = {each.name: each for each in description.modelVariables}
        self.initial = [self._settable(port, "initial") for port in layout.initial]
        self.param = [self._settable(port, "param") for port in layout.param]
        self.inputs = [self._input(port) for port in layout.inputs]
        self.outputs = [self._named(port, "output") for port in layout.outputs]
        used = (*self.initial, *self.param, *self.inputs, *self.outputs)
        known = {each.name: _text(each) for each in description.unitDefinitions}
        self.units = {}
        for each in used:
            declared = None if each.declaredType is None else each.declaredType.unit
            name = str(each.unit or declared or "")
            if name:
                self.units[each.name] = known.get(name, name)

    def _named(self, port: Port, section: str) -> Any:
        found, place = self._known.get(port.source), f"{section}.{port.name}"
        if found is None:
            advice = did_you_mean(port.source, self._known)
            raise UnfitError("; ".join((f"the FMU has no variable `{port.source}`", *advice)), place)
        if found.dimensions or self.kind(found) in ("String", "Binary", "Clock"):
            raise UnfitError(f"the variable `{port.source}` is not a single number", place)
        return found

    def _settable(self, port: Port, section: str) -> Any:
        found = self._named(port, section)
        free = found.initial in ("exact", "approx") or found.causality in ("parameter", "input")
        if not free or found.variability == "constant" or found.causality == "independent":
            message = f"the variable `{port.source}` has no start value that can be set"
            raise UnfitError(f"{message} ({found.causality}, {found.variability})", f"{section}.{port.name}")
        return found

    def _input(self, port: Port) -> Any:
        found = self._named(port, "input")
        if found.causality != "input" and not (
            found.causality == "parameter" and found.variability == "tunable"
        ):
            inputs = [name for name, each in self._known.items() if each.causality == "input"]
            listed = f"its inputs: {', '.join(inputs)}" if inputs else "it has none"
            raise UnfitError(f"the variable `{port.source}` is no input; {listed}", f"input.{port.name}")
        return found

    def kind(self, variable: Any) -> str:
        """Name of the type in the functions that read and write the variable."""
        if variable.type == "Enumeration":
            return "Integer" if self.major == 2 else "Int64"
        return str(variable.type)


def _text(unit: Any) -> str:
    """Text of a unit: the product of powers of base units that the FMU gives, else its name.

    FMUs may name a unit as they like, such as `m/s2`.
    """
    base = unit.baseUnit
    if base is None or float(base.factor or 1) != 1.0 or float(base.offset or 0) != 0.0:
        return str(unit.name)
    powers = {name: int(getattr(base, name) or 0) for name in ("kg", "m", "s", "A", "K", "mol", "cd")}
    parts = [f"{name}^{power}" for name, power in powers.items() if power]
    return "*".join(parts) if parts and float(base.rad or 0) == 0.0 else str(unit.name)


@final
class Fmu:
    """A plant that is an FMU; every simulation makes a new instance."""

    def __init__(
        self, description: Any, folder: str, layout: Layout, variables: _Variables, *, exchange: bool
    ) -> None:
        self.units = variables.units
        self.ended = False
        self._description, self._folder, self._layout = description, folder, layout
        self._variables, self._exchange = variables, exchange
        self._tolerance = float(layout.options.get("tolerance", 1e-6))
        groups: dict[str, tuple[list[int], list[int]]] = {}  # type -> places and value references
        for place, variable in enumerate(variables.outputs):
            places, references = groups.setdefault(variables.kind(variable), ([], []))
            places.append(place)
            references.append(variable.valueReference)
        self._groups = groups
        self._instance: Any = None
        self._solver: _Integrator | None = None
        self._steps = 0

    def start(self, initial: Floats, param: Floats, inputs: Floats, _seed: int) -> list[float]:
        """Instantiate the FMU, set its start values, and initialise it."""
        from fmpy.simulation import instantiate_fmu

        self._solver = None
        if self._instance is not None:
            if not self.ended:
                self._instance.terminate()
            self._instance.freeInstance()
            self._instance = None
        self._steps, self.ended = 0, False
        kind = "ModelExchange" if self._exchange else "CoSimulation"
        self._instance = instance = instantiate_fmu(self._folder, self._description, kind)
        two, stop = self._variables.major == 2, self._layout.duration
        if two:
            instance.setupExperiment(tolerance=self._tolerance, startTime=0.0, stopTime=stop)
        self._set(self._variables.param, param)
        self._set(self._variables.initial, initial)
        if two:
            instance.enterInitializationMode()
        else:
            instance.enterInitializationMode(tolerance=self._tolerance, startTime=0.0, stopTime=stop)
        self._set(self._variables.inputs, inputs)
        instance.exitInitializationMode()
        if self._exchange:
            self._solver = _Integrator(instance, self._description, self._layout, inputs)
        return self._outputs()

    def step(self, inputs: Floats) -> list[float]:
        """Advance by one time step."""
        t, dt = self._steps * self._layout.dt, self._layout.dt
        self._steps += 1
        if self._solver is not None:
            if self._solver.differ(inputs):
                self._set(self._variables.inputs, inputs)
                self._solver.restart()
            self.ended = self._solver.advance(self._steps * dt, dt)
        else:
            self._set(self._variables.inputs, inputs)
            self.ended = self._co_simulate(t, dt)
        return self._outputs()

    def _co_simulate(self, t: float, dt: float) -> bool:
        """Make a step of a co-simulation; return whether the FMU ends the simulation."""
        if self._variables.major == 3:
            _, terminate, early, last = self._instance.doStep(t, dt)
            if early and not terminate and last < t + dt * (1 - _NEAR):
                raise FaultError("error", f"the FMU returned early from a step, at {last:g} s")
            return bool(terminate)
        from fmpy.fmi1 import FMICallException
        from fmpy.fmi2 import fmi2Discard, fmi2Terminated

        try:
            self._instance.doStep(t, dt)
        except FMICallException as error:
            if error.status == fmi2Discard and self._instance.getBooleanStatus(fmi2Terminated):
                return True
            raise
        return False

    def _set(self, variables: Sequence[Any], values: Floats) -> None:
        for variable, value in zip(variables, values, strict=True):
            kind = self._variables.kind(variable)
            number: float | int | bool = float(value)
            if not kind.startswith(("Real", "Float")):
                number = bool(value >= 0.5) if kind == "Boolean" else round(float(value))
            getattr(self._instance, f"set{kind}")([variable.valueReference], [number])

    def _outputs(self) -> list[float]:
        found = [0.0] * len(self._variables.outputs)
        for kind, (places, references) in self._groups.items():
            values = getattr(self._instance, f"get{kind}")(references)
            for place, value in zip(places, values, strict=True):
                found[place] = float(value)
        return found


class _NoInput:
    """Inputs for the integrator of fmpy: they are constant during a step, and set before it."""

    def apply(self, time: float) -> None:
        """Do nothing."""


class _Integrator:
    """Integration of an FMU for model exchange, from time 0."""

    def __init__(self, instance: Any, description: Any, layout: Layout, inputs: Floats) -> None:
        from fmpy.sundials import CVodeSolver

        self._instance, self._two = instance, description.fmiVersion.startswith("2.")
        self._completes = description.modelExchange.needsCompletedIntegratorStep
        self._time, self._next_event, self._inputs = 0.0, math.inf, inputs.copy()
        if self._events():
            raise FaultError("error", "the FMU ends the simulation at its initial event")
        self._solver = CVodeSolver(
            nx=description.numberOfContinuousStates,
            nz=description.numberOfEventIndicators,
            get_x=instance.getContinuousStates,
            set_x=instance.setContinuousStates,
            get_dx=instance.getDerivatives if self._two else instance.getContinuousStateDerivatives,
            get_z=instance.getEventIndicators,
            get_nominals=instance.getNominalsOfContinuousStates,
            set_time=instance.setTime,
            input=_NoInput(),
            startTime=0.0,
            maxStep=layout.duration / _CLOSEST,
            relativeTolerance=float(layout.options.get("tolerance", 1e-6)),
            maxNumSteps=100_000,
        )

    def differ(self, inputs: Floats) -> bool:
        """Begin an event if `inputs` differ from those of the previous step; return whether they do."""
        if (self._inputs == inputs).all():
            return False
        self._inputs = inputs.copy()
        self._instance.enterEventMode()
        return True

    def restart(self) -> None:
        """End the event, and continue with the inputs that were set."""
        self._events()
        self._solver.reset(self._time)

    def advance(self, until: float, dt: float) -> bool:
        """Integrate up to the time `until`; return whether the FMU ends the simulation."""
        while self._time < until - _NEAR * dt:
            goal = min(until, self._next_event)
            state_event, _, self._time = self._solver.step(self._time, goal)
            self._instance.setTime(self._time)
            step_event = ends = False
            if self._completes:
                step_event, ends = self._instance.completedIntegratorStep()
            if ends:
                return True
            if state_event or step_event or self._time >= self._next_event - _NEAR * dt:
                self._instance.enterEventMode()
                if self._events():
                    return True
                self._solver.reset(self._time)
        return False

    def _events(self) -> bool:
        """Iterate the event mode, then continue in continuous time; return whether the FMU ends."""
        update = self._instance.newDiscreteStates if self._two else self._instance.updateDiscreteStates
        again, ends = True, False
        while again and not ends:
            again, ends, _, _, defined, time = update()
            self._next_event = float(time) if defined else math.inf
        if not ends:
            self._instance.enterContinuousTimeMode()
        return bool(ends)


def _files(options: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    name = str(options["file"])
    return {name: folder / name}


KIND = PlantKind(FmuKeys, "file", open_fmu, files=_files, packages=("fmpy",))
