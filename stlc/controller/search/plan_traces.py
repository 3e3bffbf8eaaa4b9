"""Reading of initial states from texts and trace files, and conversion of plans to traces.

A trace of plans holds predicted states and actions, with the specification that they were planned for.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from stlc.diagnostics import usage
from stlc.trace import Reading, Trace, TraceMeta
from stlc.trace.recording import conversion
from stlc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanResult

RANDOM = "random"


def starts_of(task: Task, text: str, count: int | None, seed: int) -> Tensor:
    """Initial states for planning, (B, n) float64.

    Args:
        task: specification and system.
        text: `random`; or assignments such as `x=1, v=2 m/s`, where all other states are random; or the path
            of a trace file. In the last case the first sample of each trace is an initial state, in the units
            of the system; an enum or bool may be a word.
        count: number of initial states; for a trace file, the maximum number.
        seed: seed of random states.

    Raises:
        UsageError: U101, an assignment is invalid; or the traces lack a state or its first value, or this is
            no value of the enum or bool; U102, there is no such file.
        TraceError: the trace file is invalid, or a unit in it measures another quantity (E605).
    """
    if text == RANDOM:
        return task.sample(count or 1, seed=seed, dtype=torch.float64)
    if "=" in text:
        states = task.sample(count or 1, seed=seed, dtype=torch.float64)
        given = dict(_assignment(task, part) for part in text.split(","))
        for name, value in given.items():
            states[:, task.system.names.index(name)] = value
        return task.plain.initial.completed(states, given)
    return _recorded(task, text, count, seed)


def following(task: Task, text: str) -> tuple[str, ...]:
    """Names of the columns of `starts_of` that follow from the others there, such as held values."""
    if text != RANDOM and "=" not in text:
        return ()
    given = {part.partition("=")[0].strip() for part in text.split(",")}
    return tuple(each.name for each in task.plain.decl.init.computed if each.name not in given)


def _assignment(task: Task, part: str) -> tuple[str, float]:
    """Name of a state and its value as it is stored, from a text such as `v = 36 km/h`.

    Raises:
        UsageError: U101, the system has no such state; or the value is not a finite number with or without a
            unit of its dimension, not a label of the state, or a value that the state never has.
    """
    name, _, value = (each.strip() for each in part.partition("="))
    if name not in task.system.names:
        missing, names = usage(f"`{task.system.decl.name}` has no state `{name}`"), task.system.names
        raise missing.near(name, names, listed=f"states: {', '.join(names)}")
    column = task.system.signature[name]
    words = column.words
    word = value.lower() if column.kind == "bool" else value
    if word in words:
        return name, float(words[word])
    try:
        found = column.unit.value_of(value)
    except ValueError as error:
        listed = f"or {', '.join(words)}" if words else f"`{name}` is in [{column.unit}]"
        raise usage(
            f"`{part.strip()}`: {error}", f"write NAME=NUMBER, such as x=1.5, v=2 m/s; {listed}"
        ) from None
    if words and found not in words.values():
        raise usage(f"`{part.strip()}`: `{name}` is one of {', '.join(words)}")
    low, high = column.low, column.high
    if column.fact and not words and low is not None and high is not None and not low <= found <= high:
        raise usage(f"`{part.strip()}`: `{name}` is always within [{low:g}, {high:g}]")
    return name, found


def _recorded(task: Task, text: str, count: int | None, seed: int) -> Tensor:
    """First samples of at most `count` traces of the file `text` as initial states, (B, n) float64.

    A state that the specification adds (timer or parameter) is random if the traces do not contain it.

    Raises:
        UsageError: U101, the traces lack a state or its first value, or this is no value of the enum or bool;
            U102, there is no such file.
        TraceError: the trace file is invalid, or a unit in it measures another quantity (E605).
    """
    if not text.strip() or not Path(text).exists():
        help_ = ("random", "x=1, v=2 m/s", "a trace, such as trace.npz")
        raise usage(f"there is no file `{text}` with initial states", *help_, code="U102")
    columns = task.system.signature.columns
    trace = Trace.load(text, Reading(words={column.name: column.words for column in columns}))
    rows = min(trace.traces, count or trace.traces)
    states = task.sample(rows, seed=seed, dtype=torch.float64)
    missing = [name for name in task.plain.names if name not in trace.data]
    if missing:
        raise usage(f"`{text}` has no signal {', '.join(f'`{name}`' for name in missing)}")
    for index, column in enumerate(columns):
        if column.name in trace.data:
            first = trace.data[column.name][:rows, 0]
            change = conversion(trace.name, column, trace.signature[column.name].unit)
            states[:, index] = torch.tensor(first if change is None else change(first))
    absent = (~torch.isfinite(states)).nonzero()
    if len(absent):
        row, index = absent[0].tolist()
        raise usage(f"trace {row} of `{text}` has no first value of `{task.system.names[index]}`")
    for index, column in enumerate(columns):
        if words := column.words:
            odd = (~torch.isin(states[:, index], torch.tensor(list(words.values())).double())).nonzero()
            if len(odd):
                found = f"trace {int(odd[0])} of `{text}` begins with {float(states[odd[0], index]):g}"
                raise usage(f"{found}: `{column.name}` is one of {', '.join(words)}")
    return states


@torch.no_grad()
def trace_of(task: Task, result: PlanResult, seed: int | None = None) -> Trace:
    """Convert plans to the content of a trace file, with one trace per initial state.

    A trace contains the predicted states, and these arrays:

    - `action.NAME`, (traces, steps): the actuator commands of the control NAME.
    - `plan_rho`, (traces,): the robustness of each plan.
    - `infeasible`, (traces,): 1 if the planner proved that no plan satisfies the specification, else 0.
    """
    extras = {"plan_rho": result.rho.numpy(), "infeasible": result.infeasible.numpy().astype(np.int8)}
    states = task.rollout(result.states, result.plans)
    return trace_along(task, states, result.plans, extras, meta_of(task, seed))


def trace_along(
    task: Task, states: Tensor, plans: Tensor, extras: Mapping[str, NDArray[Any]], meta: TraceMeta
) -> Trace:
    """Content of a trace file with states and actuator commands.

    Args:
        task: specification and system.
        states: (traces, steps + 1, n).
        plans: controls as they were planned, (traces, steps, m).
        extras: further arrays.
        meta: origin of the trace.
    """
    system, controls = task.system, plans.flatten(0, 1)
    commanded = system.commanded(states[:, :-1].flatten(0, 1), controls).reshape(plans.shape)
    actions = zip(system.control_names, np.moveaxis(commanded.numpy(), -1, 0), strict=True)
    return Trace(
        signature=system.signature,
        dt=system.dt,
        data=dict(zip(system.names, np.moveaxis(states.numpy(), -1, 0), strict=True)),
        extras={**{f"action.{name}": action for name, action in actions}, **extras},
        meta=meta,
    )


def meta_of(task: Task, seed: int | None) -> TraceMeta:
    """Origin of a trace of a task: texts and hashes of its files, and versions."""
    spec, decl = task.compiled.spec, task.system.decl
    library = spec.imported_texts()
    names = spec.settable
    own = names - {*task.system.names}
    return TraceMeta(
        spec_name=task.compiled.name,
        spec_path=spec.source.name,
        spec_text=spec.source.text,
        spec_library=library,
        spec_set={name: text for name, text in decl.overrides.items() if name in own},
        spec_hash=spec.sha256,
        system_name=decl.name,
        system_path=str(decl.path),
        system_text=decl.source.text,
        system_hash=decl.hash,
        seed=seed,
        horizon=task.window,
        dt=task.system.dt,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        stlc_version=__version__,
    )
