"""Exact verdicts on simulated trajectories, and comparison of the trajectories with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import SURPRISE
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import viable as search_safe

if TYPE_CHECKING:
    from stlc.compile.backends.schedule import Boundary
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.controller.deployment.simulator import DeploymentRecording

MOST_TIMED = 200
"""Maximum number of trajectories for which the time of a violation is determined, per requirement."""
Mask = NDArray[np.bool_]
Margins: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Least and greatest robustness over all continuations of what is recorded."""


@dataclass(frozen=True, slots=True)
class Executed:
    """Verdicts on recorded trajectories. A row is one agent of one seed.

    A planning window consists of the T steps of a plan. A requirement that mentions the horizon T is judged
    at every start instant from which a whole planning window is recorded. Any other requirement is judged
    once, from the first sample. If the trajectory ends before the windows of that requirement do, it may be
    undecided: it neither holds nor fails, whatever the continuation.

    Attributes:
        rules: requirement -> whether it certainly holds, (starts, rows). There is a single start for a
            requirement that does not mention T.
        fails: requirement -> whether it certainly does not hold, (starts, rows).
        safety: names of the requirements that are tagged `@safety`.
        consistent: (starts, rows), whether the model predicts every step in the planning window from the
            start instant, up to rounding errors.
        eventless: (starts, rows), whether no exogenous event occurs in the planning window. Then all steps in
            the window follow the true dynamics. They may still differ from the model. None if events were not
            recorded.
        viable: (rows,), whether the trajectory is safe, or a safe plan from its first state is known.
        decided: requirement -> sample from which on it certainly does not hold at its first failing start,
            whatever follows, (rows,); NaN where it does not fail, or where this was not determined.
    """

    rules: Mapping[str, Mask]
    fails: Mapping[str, Mask]
    safety: tuple[str, ...]
    consistent: Mask
    viable: Mask
    eventless: Mask | None = None
    decided: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def agents(self, names: Sequence[str]) -> Mask:
        """Mask of the agents for which all requirements in `names` hold at all start instants, (rows,)."""
        held = [self.rules[name].all(0) for name in names]
        return np.logical_and.reduce(held) if held else np.ones(self.consistent.shape[1], dtype=bool)

    def failing(self, names: Sequence[str]) -> Mask:
        """Mask of the agents for which a requirement in `names` certainly fails at a start, (rows,)."""
        failed = [self.fails[name].any(0) for name in names]
        return np.logical_or.reduce(failed) if failed else np.zeros(self.consistent.shape[1], dtype=bool)

    def starts(self, names: Sequence[str]) -> Mask:
        """Mask of the start instants at which all requirements in `names` hold, (starts, rows).

        A requirement that does not mention the horizon T has a single verdict, which counts for every start
        instant.
        """
        held = np.ones_like(self.consistent)
        for name in names:
            held &= self.rules[name][: len(held)] if len(self.rules[name]) > 1 else self.rules[name]
        return held


def judge_executed(task: Task, recording: DeploymentRecording, *, viable: Mask | None = None) -> Executed:
    """Judge the trajectories of a recording exactly; see `Executed`.

    `viable`: (rows,), whether a safe plan from the first state is known; if None, a search for safe plans
    determines it.
    """
    starts = max(recording.steps + 1 - task.horizon, 0)
    margins = _margins_of_rules(task, recording)
    rules = {name: TOLERANCE.satisfied(low) for name, (low, _) in margins.items()}
    fails = {name: TOLERANCE.violated(high) for name, (_, high) in margins.items()}
    safety = tuple(rule.name for rule in task.compiled.safety)
    found = viable
    if found is None:
        found = search_safe(task, torch.from_numpy(recording.states[:, 0])).numpy()
    eventless = None if recording.eventless is None else _throughout(recording.eventless, task, starts)
    consistent = _throughout(model_consistent(task, recording), task, starts)
    executed = Executed(rules, fails, safety, consistent, found, eventless, _decided(task, recording, fails))
    return replace(executed, viable=found | executed.agents(safety))


def executed_robustness(task: Task, recording: DeploymentRecording) -> dict[str, Margins]:
    """Bounds on the least robustness of each trajectory over the start instants of `Executed`.

    requirement -> two arrays (rows,). They differ where the recording is too short: they are -inf and inf for
    a requirement without a start instant.
    """
    return {
        name: (low.min(0) if len(low) else np.full(low.shape[1], -np.inf), high.min(0, initial=np.inf))
        for name, (low, high) in _margins_of_rules(task, recording).items()
    }


def _margins_of_rules(task: Task, recording: DeploymentRecording) -> dict[str, Margins]:
    """Bounds on the robustness of each requirement at the start instants of `Executed`."""
    columns = _columns(task, recording)
    return {rule.name: _margins(rule, columns, task.window) for rule in task.compiled.recorded}


def _columns(task: Task, recording: DeploymentRecording) -> dict[str, NDArray[np.float64]]:
    """State -> samples, (time, rows)."""
    return dict(zip(task.system.names, recording.states.transpose(2, 1, 0), strict=True))


def _decided(
    task: Task, recording: DeploymentRecording, fails: Mapping[str, Mask]
) -> dict[str, NDArray[np.float64]]:
    """Samples from which on requirements certainly do not hold; see `Executed.decided`.

    `fails`: requirement -> mask, (starts, rows). The first `MOST_TIMED` failing rows of each are determined.
    """
    columns, last, found = _columns(task, recording), recording.steps, {}
    for rule, written in zip(task.rules, task.compiled.recorded, strict=True):
        failing = fails[rule.name]
        rows = np.flatnonzero(failing.any(0))[:MOST_TIMED]
        samples = found[rule.name] = np.full(failing.shape[1], np.nan)
        starts = failing[:, rows].argmax(0) if len(rows) else rows
        for start in np.unique(starts):
            those = rows[starts == start]
            high = min(last, start + max(task.window, rule.reach)) if written.windowed else last
            window = {name: each[start : high + 1, those] for name, each in columns.items()}
            samples[those] = start + _since(written, window, 0, high - start)
    return found


def _since(
    rule: CompiledRequirement, columns: Mapping[str, NDArray[np.float64]], low: int, high: int
) -> NDArray[np.int64]:
    """First sample up to which each trajectory violates a requirement whatever follows, (rows,).

    It lies between `low` and `high`. `columns`: state -> samples, (time, rows).
    """
    samples, rows = next(iter(columns.values())).shape
    if low == high or not rows:
        return np.full(rows, low)
    middle = (low + high) // 2
    prefix = {name: each[: middle + 1] for name, each in columns.items()}
    early = ~TOLERANCE.satisfied(torch.from_numpy(_margin(rule, prefix, 1, "upper", stop=samples)[0])).numpy()
    found = np.zeros(rows, dtype=np.int64)
    for part, bounds in ((early, (low, middle)), (~early, (middle + 1, high))):
        found[part] = _since(rule, {name: each[:, part] for name, each in columns.items()}, *bounds)
    return found


def _margins(rule: CompiledRequirement, columns: Mapping[str, NDArray[Any]], horizon: int) -> Margins:
    """Least and greatest robustness of one requirement over all continuations, (starts, rows) each.

    `columns`: state -> samples, (time, rows). `horizon`: number of steps of a planning window.
    """
    samples, rows = next(iter(columns.values())).shape
    if not rule.windowed:
        if rule.reach >= samples:
            return _margin(rule, columns, 1, "lower"), _margin(rule, columns, 1, "upper")
        margin = _margin(rule, columns, 1)
        return margin, margin
    count = samples - max(horizon, rule.reach)
    if count <= 0:
        margin = np.ones((0, rows))
    elif not rule.uses_end:
        margin = _margin(rule, columns, count)
    else:
        windows = ({name: each[k : k + horizon + 1] for name, each in columns.items()} for k in range(count))
        margin = np.concatenate([_margin(rule, window, 1) for window in windows])
    return margin, margin


def _margin(
    rule: CompiledRequirement,
    columns: Mapping[str, NDArray[Any]],
    count: int,
    end: Boundary = "truncate",
    stop: int | None = None,
) -> NDArray[np.float64]:
    """Robustness at the first `count` samples, (count, rows); -inf where it is no number.

    `end` and `stop` are explained in `stlc.compile.backends.array.graph.evaluate`.
    """
    (margin,) = evaluate([rule.formula], columns, count=count, end=end, stop=stop)
    whole = np.broadcast_to(margin, (count, next(iter(columns.values())).shape[1]))
    return np.where(np.isnan(whole), -np.inf, whole)


def model_consistent(task: Task, recording: DeploymentRecording) -> Mask:
    """Mask of the steps whose recorded next state equals the prediction of the model, (rows, steps).

    Rounding errors are ignored.
    """
    before = torch.from_numpy(recording.states[:, :-1]).flatten(0, 1)
    action = torch.from_numpy(recording.actions).flatten(0, 1)
    predicted = task.system.step(before, action).numpy(force=True).reshape(recording.states[:, 1:].shape)
    return np.asarray((np.abs(predicted - recording.states[:, 1:]) <= SURPRISE).all(-1))


def _throughout(right: Mask, task: Task, starts: int) -> Mask:
    """Mask of the start instants from which `right` is True in all steps of a planning window.

    `right`: mask of steps, (rows, steps). `starts`: number of start instants. Returns (starts, rows).
    """
    so_far = np.concatenate([np.zeros((1, len(right)), dtype=int), np.cumsum(right.T, 0)])
    whole: Mask = so_far[task.horizon : task.horizon + starts] - so_far[:starts] == task.horizon
    return whole
