"""Verdicts on recorded closed-loop runs: margins and violations.

The runs are evaluated by the specification that is stored in their trace.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir.traverse import margin_unit
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.monitor.explain.report import violations
from stlc.monitor.verdict import Monitor, Verdict
from stlc.source import Source
from stlc.trace import Trace
from stlc.view.signals import Strip

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ENOUGH = 0.4
"""Margins are shown only where the world agrees with the model if at least this share of them remains."""
CONSISTENT_ONLY = "least margin from each instant on, of the agents for which the world did as the model says"
MOST = 240
"""Maximum number of events per requirement."""
FLASH = (True, True, True, False)
"""Blink pattern of a mark, in frames."""
FLASHES = 4


def monitor_of(
    trace: Trace, text: str = "", *, system: Source | None = None, drives: bool = False
) -> Monitor:
    """Return a monitor of the specification that is stored in a trace.

    A trace may store two specifications: the one for which the controls were planned, and a separate one that
    evaluates closed-loop runs (drives).

    Args:
        trace: the recorded trace.
        text: specification to use if the trace stores none.
        system: text of the system file, which supplies external functions.
        drives: whether to use the separate specification, if there is one.

    Raises:
        SpecError: the specification is invalid.
    """
    carried = trace.meta.carried if drives else trace.meta.planned
    spec = replace(parse(Source("spec.stl", carried.text or text)), library=carried.library)
    outside = any(isinstance(item, ast.Extern) for item in spec.items)
    return Monitor(spec, system=system if outside else None, overrides=carried.overrides)


def margins_of(monitor: Monitor, verdict: Verdict, trace: Trace) -> dict[str, Floats]:
    """Robustness of each requirement at each sample, (traces, samples); NaN where undefined.

    At each sample, the requirement is evaluated from this sample on. A requirement that is evaluated only
    once has the same value at every sample.
    """
    found = monitor.requirement_robustness(trace)
    rows = {judgement.name: np.atleast_2d(found[judgement.name]) for judgement in verdict}
    for name in judged_at_start(verdict):
        rows[name] = np.repeat(verdict[name].least[:, None], rows[name].shape[1], 1)
    return rows


def units_of(verdict: Verdict) -> dict[str, str]:
    """Mapping from requirements to the units of their robustness; it omits requirements without a unit."""
    return {j.name: unit for j in verdict if (unit := margin_unit(j.rule.typed.formula))}


def judged_at_start(verdict: Verdict) -> list[str]:
    """Names of the requirements that are evaluated once, at the start of a trace."""
    planned = verdict.subject.horizon is not None
    return [j.name for j in verdict if j.rule.absolute or not (j.rule.windowed and planned)]


def trace_names(trace: Trace) -> list[str]:
    """Names of the traces: their numbers and, if recorded, seed and agent."""
    seeds, agents = trace.extras.get("seed"), trace.extras.get("agent")
    if seeds is None or agents is None or not len(seeds) == len(agents) == trace.traces:
        return [f"trace {index}" for index in range(trace.traces)]
    return [
        f"trace {index} (seed {seed}, agent {agent})"
        for index, (seed, agent) in enumerate(zip(seeds.tolist(), agents.tolist(), strict=True))
    ]


# ------------------------------------------------------------------------------ agents of a scene


@dataclass(frozen=True, slots=True)
class SceneVerdicts:
    """Evaluated traces of the agents in a scene; the scene shows the first seed.

    Attributes:
        trace: recorded traces of these agents.
        monitor: monitor of the specification for which the controls were planned.
        verdict: verdict of that monitor.
        executed: verdict by the separate specification for closed-loop runs. It is `verdict` if the trace
            stores no such specification.
        consistent: whether the world (simulated environment) behaves as the model predicts, for the length of
            a plan after each sample: (agents, samples). None if not recorded.
    """

    trace: Trace
    monitor: Monitor
    verdict: Verdict
    executed: Verdict
    consistent: Mask | None

    @property
    def marked(self) -> set[str]:
        """Names of the requirements whose violations are marked in the picture.

        If the trace has a separate specification for closed-loop runs, all of its requirements are marked.
        Otherwise the requirements with the tag `@safety` are marked, or all if none has this tag.
        """
        safety = {each.name for each in self.executed if "safety" in each.rule.tags}
        ruled = bool(self.trace.meta.judge_text)
        return safety if safety and not ruled else {each.name for each in self.executed}


def judge_agents(trace: Trace, agents: int, *, system: Source | None) -> SceneVerdicts:
    """Evaluate the traces of the first `agents` agents by the specification stored in the trace.

    Raises:
        StlcError: the trace cannot be evaluated.
    """
    data = {name: values[:agents] for name, values in trace.data.items()}
    monitor, first = monitor_of(trace, system=system), replace(trace, data=data, extras={})
    verdict = executed = monitor.check(first)
    if trace.meta.judge_text:
        executed = monitor_of(trace, system=system, drives=True).check(first)
    return SceneVerdicts(first, monitor, verdict, executed, model_consistent(trace, agents))


def strip_of(judged: SceneVerdicts, decisions: NDArray[np.int64] | None) -> Strip:
    """Strip charts of the agents' margins, and of the sources of decisions.

    Margins are shown only at samples from which the world (simulated environment) behaves as the model
    predicts. If too few margins would be shown, all are shown.

    Args:
        judged: verdicts on the agents.
        decisions: source of each decision, (frames, agents); None if not recorded.
    """
    rows, units = margins_of(judged.monitor, judged.verdict, judged.trace), units_of(judged.verdict)
    times, every = judged.trace.times, {name: least(rho) for name, rho in rows.items()}
    if judged.consistent is not None:
        margins = {name: least(rho, judged.consistent) for name, rho in rows.items()}
        known, all_known = (np.isfinite([*each.values()]).sum() for each in (margins, every))
        if known >= ENOUGH * all_known:
            return Strip(times, margins, decisions, CONSISTENT_ONLY, units)
    return Strip(times, every, decisions, units=units)


def model_consistent(trace: Trace, agents: int) -> Mask | None:
    """Return for each agent and sample whether the world behaves as the model predicts: (agents, samples).

    The world is the simulated environment. A sample is True if the prediction is right for the length of a
    plan after this sample. None is returned if the trace does not record where the world deviates from the
    model.
    """
    steps, horizon = trace.extras.get("foreseen"), trace.meta.horizon
    if steps is None or horizon is None or steps.shape != (trace.traces, trace.samples - 1):
        return None
    wrong = np.cumsum(np.pad(steps[:agents] == 0, ((0, 0), (1, horizon))), axis=1)
    return np.asarray(wrong[:, horizon : horizon + trace.samples] == wrong[:, : trace.samples])


def least(rho: Floats, counts: Mask | bool = True) -> Floats:
    """Least robustness over the agents at each sample: (agents, samples) -> (samples,).

    Only values where `counts` is True are used. The result is NaN where no robustness is known.
    """
    known = np.where(counts & ~np.isnan(rho), rho, np.inf).min(0)
    return np.where(np.isfinite(known), known, np.nan)


# ------------------------------------------------------------------------------------- violations


@dataclass(frozen=True, slots=True)
class Event:
    """A violation by one agent, which lasts from `sample` to `until` without interruption.

    Example: `always[0, 5 s] p` is violated at `start`: `p` is false from `sample` to `until`.

    Attributes:
        requirement: name of the requirement.
        agent: number of the agent's trace.
        sample: first sample at which the body of the outermost `always` is violated; without an `always`, the
            requirement itself.
        until: last sample up to which it stays violated.
        start: sample at which the requirement was evaluated, from which its time windows are counted.
        because: cause of the violation at `sample`, in one line.
        cause: sample of the cause, at which the deciding predicate is evaluated. It lies before `sample` if
            the requirement looks back, and after it if it looks ahead.
    """

    requirement: str
    agent: int
    sample: int
    until: int
    start: int
    because: str
    cause: int


def events_of(verdict: Verdict, agents: int, *, most: int = MOST) -> list[Event]:
    """Violations by the first `agents` traces, in order of time; at most `most` of each requirement."""
    found: list[Event] = []
    for judgement in verdict:
        name, left = judgement.name, most
        for agent in range(min(agents, verdict.traces)):
            if judgement.scope is None or judgement.scope[agent]:
                own = violations(verdict, name, agent, left)
                left -= len(own)
                for each in own:
                    cause = each.cause
                    told = cause.start, cause.because, cause.sample
                    found.append(Event(name, agent, each.first, each.last, *told))
    return sorted(found, key=lambda event: (event.sample, event.agent))


def marks(events: Iterable[Event], frames: int, agents: int, names: Collection[str] | None = None) -> Mask:
    """Return which agents are to be marked in which frame: booleans, (frames, agents).

    An agent is marked during a violation. After it, the mark blinks for a while.

    Args:
        events: violations.
        frames: number of instants.
        agents: number of agents.
        names: requirements whose violations are marked; None: all.
    """
    shown = np.zeros((frames, agents), dtype=bool)
    pattern = np.array(FLASH * FLASHES)
    for event in events:
        if event.agent < agents and (names is None or event.requirement in names):
            shown[event.sample : event.until + 1, event.agent] = True
            after = shown[event.until : event.until + len(pattern), event.agent]
            after |= pattern[: len(after)]
    return shown
