"""Errors of a world with a location in its file: S207 (wrong behaviour), S302 (non-finite states)."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from types import CodeType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.diagnostics import Diagnostic, StlcError, SystemFileError
from stlc.files import File
from stlc.source import Source, Span


@contextmanager
def blamed(world: object, method: str, what: str) -> Iterator[None]:
    """Context that converts an exception of a world's code into error S207, "the world cannot …".

    Args:
        world: the world, or its class if the constructor is called.
        method: name of the method that is called in the context.
        what: end of the message, such as "give a snapshot".
    """
    try:
        yield
    except StlcError:
        raise
    except (Exception, SystemExit) as error:
        file = getattr(sys.modules.get(_class_of(world).__module__), "__file__", None) or ""
        lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == file]
        place = (_line(file, lines[-1]) if lines and lines[-1] else None) or _defined_at(world, method)
        note = f"{type(error).__name__}: {error}"
        finding = Diagnostic("S207", f"the world cannot {what}: {error}", place, "here", note=(note,))
        raise SystemFileError(finding) from error


def states_of(world: object, method: str, given: object, size: tuple[int, int]) -> Tensor:
    """Check that `given`, returned by `method` of a world, is an array of states of shape `size`.

    Returns:
        The states, (agents, n) float64.

    Raises:
        SystemFileError: S207, `given` is not a tensor or has another shape.
    """
    if not isinstance(given, torch.Tensor):
        name = type(given).__name__
        what = "nothing" if given is None else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
        raise wrong(world, method, f"gives {what}, not a tensor of shape {size}")
    if given.shape != size:
        raise wrong(world, method, f"gives states of shape {tuple(given.shape)}, not {size}")
    with blamed(world, method, "give states"):
        return given.detach().to("cpu", torch.float64)


def require_numbers(world: object, method: str, x: Tensor, names: Sequence[str], when: str) -> None:
    """Check that the states `x`, (agents, n), which `method` of a world returned, are finite.

    `names`: names of the states. `when`: the instant as a text for the message.

    Raises:
        SystemFileError: S302, a state is NaN or infinite.
    """
    bad = ~torch.isfinite(x)
    if not bool(bad.any()):
        return
    agent, column = torch.nonzero(bad)[0].tolist()
    message = f"the world gives {x[agent, column]:g} for `{names[column]}` of agent {agent} {when}"
    raise SystemFileError.of("S302", message, _defined_at(world, method), "by this")


def scene_of(
    world: object, given: Mapping[str, NDArray[Any]], before: Mapping[str, NDArray[Any]] | None
) -> dict[str, Any]:
    """Convert the snapshot `given` to arrays, and compare their names and shapes with the previous snapshot.

    `before`: the previous snapshot; None for the first one.

    Raises:
        SystemFileError: S207, an array does not contain numbers, or names or shapes differ from `before`.
    """
    with blamed(world, "snapshot", "give a snapshot"):
        scene = {str(name): np.asarray(value) for name, value in given.items()}
    for name, value in scene.items():
        if value.dtype == object:
            raise wrong(world, "snapshot", f"gives `{name}`, which is no array of numbers")
    if before is not None:
        then, now = _shapes(before), _shapes(scene)
        for name in then | now:
            if then.get(name) != now.get(name):
                change = f"gives `{name}` of shape {now.get(name)}, and {then.get(name)} before"
                raise wrong(world, "snapshot", change)
    return scene


def wrong(world: object, method: str, what: str) -> SystemFileError:
    """Return error S207 for `method` of a world; `what` completes the message "`method` of the world …"."""
    message = f"`{method}` of the world {what}"
    return SystemFileError.of("S207", message, _defined_at(world, method), "this method")


def _shapes(scene: Mapping[str, NDArray[Any]]) -> dict[str, tuple[int, ...]]:
    return {name: value.shape for name, value in scene.items()}


# ----------------------------------------------------------------------- source locations


def _class_of(world: object) -> type:
    return world if isinstance(world, type) else type(world)


def _defined_at(world: object, method: str) -> Span | None:
    """Location of the line where a world's method is defined; None for a method of stlc itself."""
    code = getattr(getattr(_class_of(world), method, None), "__code__", None)
    if not isinstance(code, CodeType) or Path(__file__).parents[1] in Path(code.co_filename).parents:
        return None
    return _line(code.co_filename, code.co_firstlineno)


def _line(file: str, number: int) -> Span | None:
    """Location of line `number` of a file, without surrounding blanks; None if the line cannot be read."""
    try:
        text = File(file).read().text
    except StlcError:
        return None
    near = os.path.relpath(file)
    source = Source(file if near.startswith("..") else near, text)
    if number > len(source.line_starts):
        return None
    start, line = source.line_starts[number - 1], source.line(number)
    begin = start + len(line) - len(line.lstrip())
    return source.span(begin, start + len(line.rstrip()))
