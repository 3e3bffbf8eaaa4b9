"""Report of a violation in terms of the specification: sub-formula, instant, signal and value."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.holes import KNOWN
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.grammar import ast
from stlc.jsontext import Num
from stlc.monitor.explain.causes import CauseFinder, CauseNode, Violations
from stlc.monitor.instants import beyond, rule_bounds, window_of
from stlc.monitor.judgement import RequirementVerdict, Verdict
from stlc.monitor.prepared import Part, Prepared, Timeline
from stlc.monitor.values import Record, decisive
from stlc.signature import Column
from stlc.source import Label, Span

_MOST_LABELS = 6


@dataclass(frozen=True, slots=True)
class SignalValue:
    """Value of a signal at an instant at which a predicate reads it, or value that a `freeze` has stored.

    Attributes:
        signal: name of the signal, or of the frozen value.
        value: value in the unit of the signal.
        unit: its unit; "" if there is none.
        text: name and value in words: `x = 0.27 m`, `sign = stop`, `x0 = 2 m (frozen at t = 4 s)`.
        frozen: whether it is a frozen value.
    """

    JSON: ClassVar = "signal value text unit"

    signal: str
    value: Num
    unit: str
    text: str
    frozen: bool = False


@dataclass(frozen=True, slots=True)
class Cause:
    """Cause of a violation of one requirement by one trace in one window.

    Attributes:
        rule: the requirement.
        trace: index of the trace.
        start: sample at which the requirement was evaluated.
        sample: sample at which the deciding predicate was evaluated.
        time: time of `sample` in seconds.
        violated: sample at which the body of the outermost `always` is violated; without one, `start`.
        predicate: text of the deciding predicate.
        span: source location of the deciding predicate.
        readings: values of the signals and of frozen values that the predicate reads at `sample`.
        place: the part of the requirement to underline first, and the text beside it.
        labels: the other parts to underline, and their texts.
        because: the cause in words, on one line.
        tree: tree of the sub-formulas that explain the violation, down to predicates.
        alone: whether the robustness rises if only the value of `predicate` at `sample` rises, and a change
            of its signals there can make it rise.
        timeline: times of the samples from the first judged one on, from which the tree counts.
        first: index of this sample in the trace.
        unit: unit of the deciding predicate's values.
        subject: the trace from the first judged sample on.
    """

    JSON: ClassVar = (
        "predicate trace start sample time because signal value readings span requirement=place_span"
    )

    rule: CompiledRequirement
    trace: int
    start: int
    sample: int
    time: Num
    violated: int
    predicate: str
    span: Span
    readings: tuple[SignalValue, ...]
    place: Label
    labels: tuple[Label, ...]
    because: str
    tree: CauseNode
    alone: bool
    timeline: Timeline = field(compare=False)
    first: int
    unit: str
    subject: Prepared = field(compare=False)

    def __repr__(self) -> str:
        return f"Cause({self.name}: {self.because})"

    def told(self) -> Cause:
        """Return the cause without the tree and the signals, which are large."""
        gone: Any = None
        return replace(self, tree=gone, subject=gone)

    @property
    def name(self) -> str:
        """Name of the requirement."""
        return self.rule.name

    @property
    def signal(self) -> str | None:
        """The first signal that the predicate reads; None if it reads none."""
        return self.readings[0].signal if self.readings else None

    @property
    def value(self) -> Num | None:
        """Value of that signal."""
        return self.readings[0].value if self.readings else None

    @property
    def place_span(self) -> Span:
        """Place in the requirement that is underlined first."""
        return self.place.span

    @property
    def started(self) -> str:
        """Instant at which the requirement was evaluated, as text."""
        return self._grid.moment(self.start - self.first)

    @property
    def started_at(self) -> float:
        """The same in seconds."""
        return self._grid.time(self.start - self.first)

    @property
    def _grid(self) -> Timeline:
        return replace(self.timeline, times=None)

    @property
    def shown(self) -> int:
        """Sample by which the violation shows: `violated`, or `sample` where that comes later."""
        return max(self.violated, self.sample)

    @property
    def shown_time(self) -> float:
        """Time of `shown` in seconds."""
        return self.timeline.time(self.shown - self.first)

    @property
    def moment(self) -> str:
        """Instant by which the violation shows, as text."""
        return self.timeline.moment(self.shown - self.first)


@dataclass(frozen=True, slots=True)
class Violation:
    """Consecutive samples at which the body of the outermost `always` of a requirement is violated.

    A requirement without an `always` is violated at the sample at which it is evaluated.

    Attributes:
        first: the first of the samples.
        last: the last of them.
        cause: cause of the violation at the first one.
    """

    first: int
    last: int
    cause: Cause


def explain(verdict: Verdict, name: str) -> Cause | None:
    """Return the cause of the worst violation of a requirement; None if it is not violated.

    Raises UsageError (U101) if there is no such requirement.
    """
    judgement = verdict[name]
    if judgement.overall != "violated":
        return None
    return cause_of(judgement)


def violations(verdict: Verdict, name: str, trace: int, most: int) -> list[Violation]:
    """Return the first `most` violations of a requirement by one trace, in order of time.

    Left out are those that no single sample in each step shows. Raises UsageError (U101) for an unknown
    requirement.
    """
    judgement, definitions = verdict[name], verdict.subject.compiled.spec.definitions
    judged = _JudgedTrace.of(judgement, verdict.subject, trace)
    found: dict[int, tuple[int, CauseFinder, typed.Formula, bool]] = {}
    finders: dict[bool, CauseFinder] = {}
    begin = judgement.start - judged.first
    cut = judged.cut(range(begin, begin + len(judgement.fails))).tolist()
    for start in (begin + np.flatnonzero(judgement.fails[:, trace])).tolist():
        if not judged.shows(start):
            continue
        own_end = cut[start - begin]
        if own_end not in finders or judged.window is not None:
            finders[own_end] = judged.finder(start, cut=own_end)
        finder = finders[own_end]
        own = list(finder.violations(judged.formula, np.array([start])))
        for each in own or [Violations(judged.formula, True, np.array([start]))]:
            for sample in each.instants.tolist():
                found.setdefault(sample, (start, finder, each.formula, each.wanted))
    instants = np.array(sorted(found), dtype=np.int64)
    result = []
    for run in np.split(instants, np.flatnonzero(np.diff(instants) > 1) + 1)[:most] if found else ():
        sample = int(run[0])
        start, finder, formula, wanted = found[sample]
        tree, alone = finder.why(formula, sample, wanted=wanted)
        cause = judged.cause(finder.record, start, tree, alone, definitions)
        result.append(Violation(judged.first + sample, judged.first + int(run[-1]), cause))
    return result


def cause_of(judgement: RequirementVerdict) -> Cause | None:
    """Return the cause of the worst violation of a violated requirement; None if no sample shows it."""
    subject, (trace, start) = judgement.subject, judgement.worst
    assert subject is not None
    definitions = subject.compiled.spec.definitions
    judged = _JudgedTrace.of(judgement, subject, trace)
    start -= judged.first
    if not judged.shows(start):
        return None
    finder = judged.finder(start, cut=bool(judged.cut(range(start, start + 1))[0]))
    tree, alone = finder.why(judged.formula, start)
    return judged.cause(finder.record, start, tree, alone, definitions)


@dataclass(frozen=True, slots=True)
class _JudgedTrace:
    """The samples of one trace on which a requirement is judged; instants are counted from the first one."""

    judgement: RequirementVerdict
    subject: Prepared
    trace: int
    first: int

    @staticmethod
    def of(judgement: RequirementVerdict, subject: Prepared, trace: int) -> _JudgedTrace:
        part = judgement.part
        return _JudgedTrace(judgement, _evidence(judgement.rule, subject, part, trace), trace, part.first)

    @property
    def formula(self) -> typed.Formula:
        rule = self.judgement.rule
        return rule.typed.formula.from_first_sample() if rule.absolute else rule.typed.formula

    @property
    def window(self) -> int | None:
        return window_of(self.judgement.rule, self.subject.horizon)

    def shows(self, start: int) -> bool:
        """True if the samples show the violation at `start`; of several in a step, one was chosen."""
        tolerance, subject, starts = self.judgement.tolerance, self.subject, range(start, start + 1)
        if subject.signals.times is None and tolerance:
            return True
        rule = decisive(self.judgement.rule, tolerance, subject.compiled.signature)
        high = rule_bounds(rule, subject.record, starts, subject.horizon, self.judgement.ends)[1]
        return TOLERANCE.violated(float(high.max()), tolerance)

    def cut(self, starts: range) -> NDArray[np.bool_]:
        """Starts whose violation is explained with windows that the end cuts, (count,).

        Windows of the others begin beyond the end, and nothing that follows could undo their violation.
        """
        if self.judgement.ends == "open":
            return np.zeros(len(starts), dtype=np.bool_)
        rule, record, horizon = self.judgement.rule, self.subject.record, self.subject.horizon
        high = np.asarray(rule_bounds(rule, record, starts, horizon, "open")[1].max(axis=1))
        return ~(beyond(rule, starts, record.samples, horizon) & (high < 0.0))

    def finder(self, start: int, *, cut: bool) -> CauseFinder:
        record = self.subject.record
        stop = None if self.window is None else start + self.window + 1
        if stop is not None and stop <= record.samples:
            record, stop = record.cut(stop), None
        grid, exact = self.subject.compiled.grid, not self.judgement.tolerance
        if cut:
            return CauseFinder(record, grid, "truncate", exact=exact)
        return CauseFinder(record, grid, stop=stop, exact=exact)

    def cause(
        self, record: Record, start: int, tree: CauseNode, alone: bool, definitions: dict[str, ast.Expr]
    ) -> Cause:
        words = _Words(self.subject, record, self.judgement.rule.typed.written, definitions)
        leaf = tree.leaf
        place, *labels = words.labels(tree)
        return Cause(
            rule=self.judgement.rule,
            trace=self.trace,
            start=start + self.first,
            sample=leaf.sample + self.first,
            time=self.subject.time(leaf.sample),
            violated=tree.violated + self.first,
            predicate=_flat(leaf.span.text),
            span=leaf.span,
            readings=readings_of(leaf, self.subject, record.samples),
            place=place,
            labels=tuple(labels[: _MOST_LABELS - 1]),
            because=words.because(tree),
            tree=tree,
            alone=alone,
            timeline=self.subject.timeline,
            first=self.first,
            unit=leaf.formula.margin_unit,
            subject=self.subject,
        )


def _evidence(rule: CompiledRequirement, subject: Prepared, part: Part, trace: int) -> Prepared:
    """Samples on which a requirement is judged; of several in a step, the one most against it."""
    given, signals = subject.record, subject.signals
    times = None
    if given.cells is None:
        env = {name: column[:, trace : trace + 1] for name, column in given.env.items()}
        sure = Record(env, given.ops)
        record = replace(sure, holes=given.holes, computed=given.computed, infinite=given.infinite)
    else:
        env, times = given.cells.of_trace(trace).witness(rule.formula)
        record = Record.of(env, given.ops)
    if part.stop - part.first < record.samples:
        record = record.part(part.first, part.stop)
        times = None if times is None else times[part.first : part.stop]
    t0 = signals.t0 + part.first * (signals.dt or 0.0)
    return replace(subject, record=record, signals=replace(signals, t0=t0, times=times))


@dataclass(frozen=True, slots=True)
class _Words:
    """Writer of the texts that explain the violation of the requirement `written` on the trace `record`."""

    subject: Prepared
    record: Record
    written: ast.Expr
    definitions: dict[str, ast.Expr]

    def labels(self, tree: CauseNode) -> list[Label]:
        """Source locations to underline, each with its text; that of the deciding predicate is the first."""
        found: dict[Span, str] = {}
        for span, node in self.stated(tree):
            found.setdefault(span, self.label(node))
        first, *rest = found
        return [span.label(found[span]) for span in (first, *sorted(rest, key=lambda span: span.start))]

    def stated(
        self, node: CauseNode, use: Span | None = None, whole: CauseNode | None = None
    ) -> Iterator[tuple[Span, CauseNode]]:
        """Yield source locations and the nodes whose truth values are stated there, the deciding one first.

        These are left sides of implications, conditions, predicates, and operands that have the wrong truth
        value in a whole window. In a definition, the location is the name in the requirement, and the truth
        value that of the whole definition. `use` and `whole` are this name and value above `node`.
        """
        chain = self.chain(self.written, node.span)
        site = chain[0].span if chain else node.span
        whole = (whole if site == use else None) or node
        if node.premise or node.during is not None or not node.parts:
            yield site, whole
            return
        for part in (node.parts[node.main], *node.parts[: node.main], *node.parts[node.main + 1 :]):
            yield from self.stated(part, site, whole)

    def label(self, node: CauseNode) -> str:
        """Truth value and instant of `node`, and its frozen values; of a premise, also its signals."""
        text = f"{'true' if node.holds else 'false'} at {self.subject.moment(node.sample)}"
        if node.during is not None:
            first, last = map(self.subject.moment, (node.during[0], node.during[-1]))
            text = f"{'always' if node.holds else 'never'} true from {first} to {last}"
        told = [each.text for each in self.readings(node) if node.premise or (each.frozen and not node.parts)]
        return text + (f" ({', '.join(told)})" if told else "")

    def readings(self, node: CauseNode) -> tuple[SignalValue, ...]:
        """Values that the predicates of a cause tree read, without duplicates."""
        samples = self.record.samples
        found = (each for leaf in node.leaves for each in readings_of(leaf, self.subject, samples))
        return tuple({each.text: each for each in found}.values())

    def because(self, tree: CauseNode) -> str:
        """The cause in words, as one line; with both sides of an implication whose left side decides.

        The instant of the violation is named if it comes after that of the deciding predicate.
        """
        text = self.reason(tree.leaf)
        if tree.violated > tree.leaf.sample:
            text = f"violated at {self.subject.moment(tree.violated)}: {text}"
        while tree.parts:
            if tree.parts[0].premise and tree.main == 0:
                return f"{text}; {self.reason(tree.parts[1].leaf)}"
            tree = tree.parts[tree.main]
        return text

    def reason(self, leaf: CauseNode) -> str:
        """Sentence on a predicate, or on its definition: `near means x < 2, and x = 0.27 m …`."""
        moment, truth = self.subject.moment(leaf.sample), "true" if leaf.holds else "false"
        values = " and ".join(reading.text for reading in self.readings(leaf))
        text = f"`{_flat(leaf.span.text)}`"
        if not values:
            return f"{text} is {truth} whatever the signals are"
        other = " to false" if leaf.holds else ""
        nearest = f"comes closest{other} at {moment}, where {values}" if leaf.during is not None else ""
        if chain := self.chain(self.written, leaf.span):
            name = chain[-1].name
            body = _flat(self.definitions[name].span.text)
            return f"{name} means {body}, and {nearest or f'{values} at {moment}'} (line {leaf.span.line})"
        return f"{text} {nearest}" if nearest else f"{text} is {truth} where {values}, at {moment}"

    def chain(self, expr: ast.Expr, span: Span) -> tuple[ast.Name, ...] | None:
        """Return the names that lead from the expression `expr` to the source location `span`.

        They are those of definitions, each in the text of the one before: none if `span` lies in `expr`
        itself, and None if nothing leads to `span`.
        """
        outer = expr.span
        if span.source is outer.source and outer.start <= span.start and span.end <= outer.end:
            return ()
        for name in names_in(expr):
            body = self.definitions.get(name.name)
            rest = None if body is None else self.chain(body, span)
            if rest is not None:
                return (name, *rest)
        return None


def readings_of(leaf: CauseNode, subject: Prepared, samples: int) -> tuple[SignalValue, ...]:
    """Values that a predicate reads in the first `samples` samples, in the order of its text.

    Those that its definitions read come last.
    """
    words = re.findall(r"\w+(?:\[\d+\])?", leaf.span.text)
    places = {word: place for place, word in reversed(list(enumerate(words)))}
    reads = sorted(
        leaf.reads, key=lambda read: (places.get(read[0], len(words)), read[0], abs(read[1]), read[1])
    )
    found = []
    signature, env = subject.compiled.signature, subject.record.env
    for name, later in reads:
        sample = leaf.sample + later
        if name not in signature or not 0 <= sample < samples:
            continue
        known = env.get(KNOWN + name)
        if known is not None and known[sample, 0] < 0.0:
            continue
        value = float(env[name][sample, 0])
        when = f" at {subject.moment(sample)}" if later else ""
        text = f"{name} = {shown(value, signature[name])}{when}"
        found.append(SignalValue(name, value, signature[name].unit.text, text))
    for kept in leaf.frozen:
        if isinstance(kept.num, ir.Const):
            value = kept.unit.of_si(kept.num.value)
            text = f"{kept.name} = {shown(value, Column(kept.name, kept.unit))}"
            text += f" (frozen at {subject.moment(kept.sample)})"
            found.append(SignalValue(kept.name, value, kept.unit.text, text, frozen=True))
    return tuple(found)


def shown(value: float, column: Column) -> str:
    """Return a signal's value as text: the label of an enum member, else the number with its unit."""
    number = f"{value:.6g} {column.unit.text}".rstrip()
    return next((label for label, worth in column.labels if worth == value), number)


def names_in(expr: object) -> Iterator[ast.Name]:
    """Yield all names in an expression, from left to right."""
    if isinstance(expr, ast.Name):
        yield expr
    elif isinstance(expr, tuple):
        for item in expr:
            yield from names_in(item)
    elif isinstance(expr, ast.Node):
        for part in fields(expr):
            yield from names_in(getattr(expr, part.name))


def _flat(text: str) -> str:
    return " ".join(text.split())
