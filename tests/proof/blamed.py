"""Properties of the cause that is reported for one violated case.

The value at the end of the path is the robustness of the requirement. Where it is said that it decides alone,
a change of a signal there that brings its predicate closer to what is wanted raises the robustness. What is
said to be true or false, in a line of the tree, beside an underlined part or in the sentence, is so by the
definition of the text that is printed there, read alone, and so is its robustness. The numbers told are those
of the trace.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from helpers import reference
from proof.cases import Case
from proof.draw import DT, HORIZON, Taste
from proof.streamed import drawn

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.diagnostics import SpecError, TraceError
from stlc.monitor.explain.causes import CauseNode
from stlc.monitor.explain.report import Cause, explain
from stlc.monitor.instants import window_of
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor

TASTES = (
    Taste(),
    Taste(plain=True, constants=False),
    Taste(windows=True, depth=3),
    Taste(absolute=True, constants=False, depth=3),
    Taste(plain=True, constants=False, depth=4),
)
CHANGES = (1e-4, -1e-4, 0.6, -0.6, 1.2, -1.2, 3.0, -3.0)
"""Of a signal at one sample: small ones, and some that are enough for a step of what is made of it."""


def check_cause(seed: int) -> bool:
    """The cause told of a recording. Whether the case is violated."""
    found = drawn(seed, TASTES)
    if found is None:
        return False
    case, monitor = found
    verdict = monitor.check(case.signals)
    cause = explain(verdict, "r")
    if cause is None:
        return False
    rho = float(verdict["r"].high[cause.start - verdict["r"].start, cause.trace])
    if _known_by_folding(case, monitor, cause, rho):
        return False
    wrong = [*_values(case, cause, rho), *_statements(case, monitor, cause)]
    wrong += _change(case, monitor, cause, rho)
    assert not wrong, f"{', '.join(wrong)}\n{cause.because}\n{cause.place.text} {cause.labels}\n{case}"
    return True


def check_told_by_stream(seed: int) -> bool:
    """The cause told of the same samples one by one. Whether the case is violated."""
    found = drawn(seed, TASTES)
    if found is None:
        return False
    case, monitor = found
    cause = explain(monitor.check(case.signals), "r")
    if cause is None:
        return False
    online = monitor.online(How(reasons=True))
    for k in range(case.samples):
        online.push({name: values[k] for name, values in case.signals.items()})
    told = online.cause("r")
    assert told is not None, case
    assert _told(told) == _told(cause), f"{_told(told)}\n{_told(cause)}\n{case}"
    return True


def _told(cause: Cause) -> tuple[object, ...]:
    labels = tuple((label.span.text, label.text) for label in (cause.place, *cause.labels))
    return cause.start, cause.sample, cause.time, cause.because, cause.readings, cause.alone, labels


def _known_by_folding(case: Case, monitor: Monitor, cause: Cause, rho: float) -> bool:
    """True if `true` and `false` tell the compiler what the definition leaves open: nothing is behind it."""
    if not case.folds or np.isfinite(rho):
        return False
    (rule,) = monitor.compiled.requirements
    ends = _Definition(_seen(case, monitor, cause)).at(rule.typed.formula, cause.start)
    return ends is not None and ends[1] > -np.inf


def _values(case: Case, cause: Cause, rho: float) -> Iterator[str]:
    """Check that the leaf and the readings have their reported values."""
    leaf = cause.tree.leaf
    if not np.isclose(-leaf.rho if leaf.holds else leaf.rho, rho, rtol=0, atol=1e-9):
        yield f"value: {leaf.rho} at the leaf, {rho} is the robustness"
    for reading in cause.readings:
        if not reading.frozen and reading.value not in case.columns()[reading.signal]:
            yield f"value: {reading.text}"


def _seen(case: Case, monitor: Monitor, cause: Cause) -> reference.Trace:
    """The trace up to the end of what the cause is about."""
    (rule,) = monitor.compiled.requirements
    grid = monitor.compiled.grid
    window = window_of(rule, grid.horizon)
    stop = None if window is None else cause.start + window + 1
    columns = {name: column[:stop].tolist() for name, column in case.columns().items()}
    return reference.Trace(columns, grid, "open", stop=stop or 0)


class _Definition(reference.Robustness):
    """The definition; what is on the mission clock is at every sample what it is at the first one."""

    def _at(self, node: typed.Formula, t: int, positive: bool) -> reference.Interval | None:
        if t and isinstance(node, (typed.Temporal, typed.Until)) and node.on_clock:
            return self.at(node.from_now(), 0, positive)
        return super()._at(node, t, positive)


@dataclass(frozen=True)
class Statement:
    """A printed text, the truth value that it has at some instants, and its robustness, if told."""

    text: str
    holds: bool
    instants: tuple[int, ...]
    rho: float | None = None
    formula: typed.Formula | None = None


MOMENT = r"t = ([-+.\de]+) s"
LABEL = re.compile(rf"(true|false|always true|never true) (?:at|from) {MOMENT}(?: to {MOMENT})?")
BECAUSE = re.compile(rf"`([^`]*)` is (true|false) where .*?, at {MOMENT}(?:$|;)")


def _printed(cause: Cause) -> Iterator[Statement]:
    """The lines of the tree, the texts beside the underlined parts, and the sentence."""
    for node in _nodes(cause.tree):
        instants = tuple(node.during or (node.sample,))
        rho = None if node.during else node.rho
        yield Statement(node.span.text, node.holds, instants, rho, node.formula)
    for label in (cause.place, *cause.labels):
        found = LABEL.match(label.text)
        assert found is not None, label
        first = _sample(found[2])
        last = first if found[3] is None else _sample(found[3])
        yield Statement(label.span.text, found[1] in ("true", "always true"), tuple(range(first, last + 1)))
    for text, truth, moment in BECAUSE.findall(cause.because):
        yield Statement(text, truth == "true", (_sample(moment),))


def _nodes(tree: CauseNode) -> Iterator[CauseNode]:
    yield tree
    for part in tree.parts:
        yield from _nodes(part)


def _sample(seconds: str) -> int:
    return round(float(seconds) / float(DT))


def _statements(case: Case, monitor: Monitor, cause: Cause) -> Iterator[str]:
    """Check every printed text by the definition of the formula that it is, read alone.

    A text with a name that has no meaning alone, an argument of a `def` or a variable of a quantifier, is
    checked as the formula of its line, if it is one.
    """
    seen = _seen(case, monitor, cause)
    kept = {each.name: each.num for leaf in cause.tree.leaves for each in leaf.frozen}
    known = {name: f"({num.value!r})" for name, num in kept.items() if isinstance(num, ir.Const)}
    source = cause.tree.span.source.text
    alone: dict[str, typed.Formula | None] = {}
    for said in _printed(cause):
        if said.text not in alone:
            text = re.sub(r"kept\d+", lambda found: known.get(found[0], found[0]), said.text)
            alone[said.text] = _read(source[: source.index("require r:")], text)
        formula = alone[said.text] or said.formula
        if formula is None or (formula is said.formula and "kept" in said.text):
            continue
        for k in said.instants:
            ends = _Definition(seen).at(formula, k, not said.holds)
            if case.folds and ends == reference.UNKNOWN:
                continue  # the compiler knows what the definition leaves open
            if ends is None or not (ends[0] >= 0 if said.holds else ends[1] <= 0):
                yield f"printed: `{said.text}` {'true' if said.holds else 'false'} at {k}, not {ends}"
            elif said.rho is not None and not case.folds:
                value = ends[0] if said.holds else ends[1]
                if not np.isclose(value, said.rho, rtol=0, atol=1e-9):
                    yield f"printed: `{said.text}` robustness {said.rho} at {k}, not {value}"


def _read(declarations: str, text: str) -> typed.Formula | None:
    try:
        alone = Monitor(f"{declarations}\nrequire r: {text}\n", dt=DT, horizon=HORIZON * DT)
    except SpecError:
        return None
    return alone.compiled.requirements[0].typed.formula


def _change(case: Case, monitor: Monitor, cause: Cause, rho: float) -> Iterator[str]:
    """Check that a change of the predicate towards the wanted value raises the robustness."""
    leaf = cause.tree.leaf
    if not cause.alone or not np.isfinite(rho):
        return
    own = _margin(leaf, _seen(case, monitor, cause))
    closer = 0
    for name, later in leaf.reads:
        for change in CHANGES:
            signals = _changed(case.signals, name, leaf.sample + later, change)
            if signals is None:
                continue
            moved = Case(case.seed, TASTES[case.seed % len(TASTES)])
            moved.signals = signals
            if _margin(leaf, _seen(moved, monitor, cause)) <= own:
                continue
            closer += 1
            try:
                judged = monitor.check(signals)["r"]
            except TraceError:
                continue
            if judged.high[cause.start - judged.start, 0] > rho:
                return
    if closer:
        yield f"change: {closer} of `{leaf.formula.span.text}` at {leaf.sample} leave {rho}"


def _margin(leaf: CauseNode, trace: reference.Trace) -> float:
    ends = _Definition(trace).at(leaf.substituted, leaf.sample, not leaf.holds)
    assert ends is not None
    return -ends[0] if leaf.holds else ends[1]


def _changed(signals: Mapping[str, Any], name: str, sample: int, change: float) -> dict[str, Any] | None:
    """The signals with one value changed; None where it is none of them."""
    base, _, component = name.partition("[")
    if base not in signals or not 0 <= sample < len(signals[base]):
        return None
    found = {each: np.array(values, dtype=float) for each, values in signals.items()}
    if component:
        found[base][sample, int(component[:-1])] += change
    else:
        found[base][sample] += change
    return found
