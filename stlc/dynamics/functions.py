"""External functions, loaded on demand, which work on arrays of NumPy or torch."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, final

import numpy as np

from stlc.compile.frontend.interface import InterfaceFunction
from stlc.compile.namespace import Array
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.functions import FunctionDecl
from stlc.foreign import module_at, require_driving


def load_functions(decl: SystemDecl) -> Mapping[str, InterfaceFunction]:
    """Load the functions of a system: name -> function. Their modules are imported, which runs their code.

    Raises:
        SystemFileError: S208, a module or a function cannot be loaded.
        RunError: R111, a run names them, and the command does not drive.
    """
    return {
        function.name: function if function.body is not None else PythonFunction(function, _loaded(function))
        for function in decl.functions
    }


def _loaded(decl: FunctionDecl) -> Callable[..., Array]:
    require_driving(decl.span)
    where = decl.module
    try:
        if isinstance(where, str):
            module = importlib.import_module(where)
        else:
            module = module_at(where, f"stlc_functions_{where.stem}", decl.span)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise _refused(decl, f"`{decl.module}` cannot be imported", reason) from error
    found = getattr(module, decl.attribute, None)
    if not callable(found):
        functions = [name for name, value in vars(module).items() if callable(value)]
        missing = _refused(decl, f"`{decl.module}` has no function `{decl.attribute}`")
        raise missing.near(decl.attribute, functions)
    return found  # type: ignore[no-any-return]


def _refused(decl: FunctionDecl, message: str, note: str = "") -> SystemFileError:
    notes = (note,) if note else ()
    return SystemFileError.of("S208", message, decl.span, "named here", note=notes)


@final
@dataclass(frozen=True, slots=True)
class PythonFunction:
    """Loaded Python function of a system.

    A vector argument is an array (…, size), and a number is an array (…). The same is true for the result.
    """

    decl: FunctionDecl
    call: Callable[..., Array]

    def bound(self, arguments: tuple[int | None, ...], result: int | None) -> Bound:
        """Return the function with the sizes of arguments and result that a specification declares.

        A size is the number of components of a vector, or None for a number.
        """
        return Bound(self.decl, self.call, arguments, result)


@final
@dataclass(frozen=True, slots=True)
class Bound:
    """External function with the sizes of arguments and result that a specification declares."""

    decl: FunctionDecl
    call: Callable[..., Array]
    arguments: tuple[int | None, ...]
    result: int | None

    def __call__(self, *components: Array) -> Sequence[Array]:
        """Call the function; `components` are the components of all arguments, in order.

        Returns the components of the result. Raises SystemFileError (S208) if the call fails or the result
        has another shape.
        """
        given = not all(isinstance(part, (float, np.ndarray, np.generic)) for part in components)
        wanted = given if self.decl.library is None else self.decl.library == "torch"
        torch: Any = importlib.import_module("torch") if given or wanted else None
        parts: Sequence[Array] = (torch.broadcast_tensors if given else np.broadcast_arrays)(*components)
        shape = tuple(parts[0].shape) if parts else ()
        if wanted and not given:
            parts = [torch.as_tensor(np.asarray(part)) for part in parts]
        elif given and not wanted:
            parts = [part.detach().cpu().numpy() for part in parts]
        stack, rest = torch.stack if wanted else np.stack, iter(parts)
        values = [
            next(rest) if size is None else stack(list(islice(rest, size)), -1) for size in self.arguments
        ]
        found = self._checked(values, shape)
        if wanted and not given:
            found = found.detach().numpy()
        elif given:
            found = torch.as_tensor(found).to(components[0])
        return [found] if self.result is None else [found[..., i] for i in range(self.result)]

    def _checked(self, values: Sequence[Array], batch: tuple[int, ...]) -> Array:
        """Call the function on `values`; return the result as one array of the declared shape.

        `batch` is the shape of a number. Raises SystemFileError (S208) if the call fails or the shape is
        wrong.
        """
        try:
            found = self.call(*values)
            shape = tuple(found.shape)
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise _refused(self.decl, f"the function `{self.decl.name}` fails", reason) from error
        wanted = batch if self.result is None else (*batch, self.result)
        if shape == wanted:
            return found
        shapes = ", ".join(str(tuple(value.shape)) for value in values)
        message = f"the function `{self.decl.name}` gives an array {shape}, declared is {wanted}"
        raise _refused(self.decl, message, f"for arguments {shapes}")
