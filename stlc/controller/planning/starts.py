"""Initial states of plans: drawn at random, written as `x=1, v=2 m/s`, or the first samples of a trace."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.diagnostics import Diagnostic, UsageError, usage
from stlc.registry import closest
from stlc.trace import load_trace
from stlc.units import parse_unit

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

RANDOM = "random"


def starts_of(task: Task, text: str, count: int | None, seed: int) -> Tensor:
    """Initial states, (B, n) float64.

    Args:
        task: specification and system.
        text: `random`; assignments such as `x=1, v=2 m/s`, other columns as in a random start; or the path of
            a trace, of whose traces each first sample is a start.
        count: number of starts; of a trace, at most this many.
        seed: of random columns.

    Raises:
        UsageError: U101, the text is neither; U102, there is no such file.
        TraceError: the file cannot be read, or lacks a column.
    """
    if text == RANDOM:
        return task.sample(count or 1, seed=seed, dtype=torch.float64)
    if "=" in text:
        states = task.sample(count or 1, seed=seed, dtype=torch.float64)
        for part in text.split(","):
            name, value = _assignment(task, part)
            states[:, task.system.names.index(name)] = value
        return states
    return _recorded(task, text, count, seed)


def _assignment(task: Task, part: str) -> tuple[str, float]:
    """Column and value in SI units of `v = 2 m/s`."""
    name, _, value = (each.strip() for each in part.partition("="))
    if name not in task.system.names:
        near = closest(name, task.system.names)
        known = f"states: {', '.join(task.system.names)}"
        advice = known if near is None else f"did you mean `{near}`?  {known}"
        raise usage(f"`{task.system.decl.name}` has no state `{name}`", advice)
    number, _, unit = value.partition(" ")
    column = task.system.signature.columns[task.system.names.index(name)]
    try:
        given = parse_unit(unit.strip()) if unit.strip() else None
        labels = dict(column.labels)
        if number in labels:
            return name, float(labels[number])
        found = float(number)
    except ValueError:
        raise usage(f"`{part.strip()}` is not of the form NAME=NUMBER", "x=1.5, v=2 m/s") from None
    return name, found if given is None else found * float(given.scale) + float(given.offset)


def _recorded(task: Task, text: str, count: int | None, seed: int) -> Tensor:
    """First samples of the traces in a file; timers start as at random starts."""
    if not Path(text).exists():
        help_ = ("random", "x=1, v=2 m/s", "a trace, such as trace.npz")
        raise UsageError(Diagnostic("U102", f"there is no file `{text}` with initial states", help=help_))
    trace = load_trace(text)
    rows = min(trace.traces, count or trace.traces)
    states = task.sample(rows, seed=seed, dtype=torch.float64)
    missing = [name for name in task.plain.names if name not in trace.data]
    if missing:
        raise usage(f"`{text}` has no signal {', '.join(f'`{name}`' for name in missing)}")
    for index, name in enumerate(task.system.names):
        if name in trace.data:
            states[:, index] = torch.tensor(trace.data[name][:rows, 0])
    return states
