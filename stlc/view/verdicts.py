"""Verdicts on recorded closed-loop runs: margins and violations.

The runs are evaluated by the specification that is stored in their trace.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.grammar.spec import Spec
from stlc.monitor.explain.report import violations
from stlc.monitor.judgement import RequirementVerdict, Verdict
from stlc.monitor.verdict import Monitor, robustness_signals
from stlc.source import Source
from stlc.trace import Trace
from stlc.view.signals import Deciding, Marks, Strip

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
    spec = replace(Spec.parse(Source("spec.stl", carried.text or text)), library=carried.library)
    outside = bool(spec.functions)
    return Monitor(spec, system=system if outside else None, overrides=carried.overrides)


def margins_of(verdict: Verdict) -> dict[str, Floats]:
    """Robustness of each requirement at each sample, (traces, samples); NaN where undefined.

    A requirement is evaluated from each sample on. One that is judged once, over the whole trace, and demands
    something at all times (`always p`) has at each sample the robustness of what it demands there: its least
    value is that of the requirement. Another one that is judged once has the same value at every sample.
    """
    found = robustness_signals(verdict.subject)
    rows = {judgement.name: np.atleast_2d(found[judgement.name]) for judgement in verdict}
    for judgement in _judged_once(verdict):
        whole = np.repeat(judgement.least[:, None], rows[judgement.name].shape[1], 1)
        rows[judgement.name] = _demanded(judgement, verdict, whole)
    return rows


def _demanded(judgement: RequirementVerdict, verdict: Verdict, whole: Floats) -> Floats:
    """Robustness at each sample of what a requirement demands at all times, (traces, samples).

    The result is `whole` for a trace in which this is not known, or does not decide the requirement.
    """
    demands = judgement.rule.formula.demands
    if not demands:
        return whole
    record, rho = verdict.subject.record, np.full_like(whole, np.nan)
    for first, body in demands:
        signal = robustness_signal(body, record.env, ops=record.ops, semantics=record.semantics, end="strict")
        own = np.array(np.broadcast_to(np.asarray(signal, dtype=float).T, whole.shape))
        own[:, :first] = np.nan
        rho = np.fmin(rho, own)
    decides = np.isclose(np.where(np.isnan(rho), np.inf, rho).min(1), whole[:, 0], rtol=1e-6, atol=TOLERANCE)
    return np.where(decides[:, None], rho, whole)


def units_of(verdict: Verdict) -> dict[str, str]:
    """Mapping from requirements to the units of their robustness; it omits requirements without a unit."""
    return {j.name: unit for j in verdict if (unit := j.rule.typed.formula.margin_unit)}


def marks_of(verdict: Verdict, trace: Trace) -> Marks:
    """Thresholds of the requirements of `verdict` on `trace`, and values that decide its violations."""
    columns = {each.name: each for each in trace.signature.columns}
    thresholds: dict[str, list[float]] = {}
    for judgement in verdict:
        for name, value in filter(None, (atom.threshold for atom in judgement.rule.formula.predicates())):
            if name in columns:
                unit = columns[name].unit
                shown = (value - float(unit.offset)) / unit.scale
                thresholds[name] = list(dict.fromkeys([*thresholds.get(name, ()), shown]))
    deciding = []
    for cause in verdict.causes.values():
        leaf, first = cause.tree.leaf, cause.first
        window = (first + leaf.during[0], first + leaf.during[-1]) if leaf.during else None
        deciding += [
            Deciding(name, cause.trace, cause.sample + offset, window) for name, offset in leaf.reads
        ]
    return Marks(thresholds, deciding)


def _judged_once(verdict: Verdict) -> list[RequirementVerdict]:
    planned = verdict.subject.horizon is not None
    return [j for j in verdict if j.rule.absolute or not (j.rule.windowed and planned)]


def judged_at_start(verdict: Verdict) -> list[str]:
    """Names of the requirements that are evaluated once, and do not demand the same at all times."""
    return [each.name for each in _judged_once(verdict) if not each.rule.formula.demands]


def violating(trace: Trace, verdict: Verdict, *, system: Source | None = None) -> Mask:
    """Traces that violate a requirement by which drives are judged, (traces,).

    These are the requirements of the separate specification for drives, if the trace stores one, else those
    of `verdict`. `system` is the text of the system file, which supplies external functions.
    """
    if trace.meta.judge_text:
        verdict = monitor_of(trace, system=system, drives=True).check(trace)
    return np.asarray(np.logical_or.reduce([judgement.fails.any(0) for judgement in verdict]))


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
        verdict: verdict by the specification for drives; by that of the plans if the trace stores no other.
    """

    trace: Trace
    verdict: Verdict

    @property
    def marked(self) -> set[str]:
        """Names of the requirements whose violations are marked in the picture.

        If the trace has a separate specification for closed-loop runs, all of its requirements are marked.
        Otherwise the requirements with the tag `@safety` are marked, or all if none has this tag.
        """
        safety = {each.name for each in self.verdict if "safety" in each.rule.tags}
        ruled = bool(self.trace.meta.judge_text)
        return safety if safety and not ruled else {each.name for each in self.verdict}


def judge_agents(trace: Trace, agents: int, *, system: Source | None) -> SceneVerdicts:
    """Evaluate the traces of the first `agents` agents by the specification that judges drives.

    Raises:
        StlcError: the trace cannot be evaluated.
    """
    data = {name: values[:agents] for name, values in trace.data.items()}
    first = replace(trace, data=data, extras={})
    return SceneVerdicts(first, monitor_of(trace, system=system, drives=True).check(first))


def strip_of(judged: SceneVerdicts, decisions: NDArray[np.int64] | None) -> Strip:
    """Strip charts of the agents' margins, and of the sources of decisions.

    Args:
        judged: verdicts on the agents.
        decisions: source of each decision, (frames, agents); None if not recorded.
    """
    rows = margins_of(judged.verdict)
    margins = {name: least(rho) for name, rho in rows.items()}
    return Strip(judged.trace.times, margins, decisions, units_of(judged.verdict))


def least(rho: Floats) -> Floats:
    """Least robustness over the agents at each sample: (agents, samples) -> (samples,).

    The result is NaN where no robustness is known.
    """
    known = np.where(np.isnan(rho), np.inf, rho).min(0)
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
