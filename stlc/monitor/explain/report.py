"""Report of a violation in terms of the specification: sub-formula, instant, signal and value."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

from stlc.compile.augment.lift import from_first_sample
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import margin_unit, operands
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Label
from stlc.grammar import ast
from stlc.monitor.explain.causes import CauseFinder, CauseNode
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.judgement import Judgement, Part, Prepared, Verdict
from stlc.monitor.values import Record
from stlc.signature import Column
from stlc.source import Span

_MOST_LABELS = 6


@dataclass(frozen=True, slots=True)
class SignalValue:
    """Value of a signal at an instant at which the deciding predicate reads it.

    Attributes:
        signal: name of the signal.
        value: value in the unit of the signal.
        unit: declared unit; "" if there is none.
        text: name and value in words: `x = 0.27 m`, `sign = stop`.
    """

    signal: str
    value: float
    unit: str
    text: str


@dataclass(frozen=True, slots=True)
class Cause:
    """Cause of a violation of one requirement by one trace in one window.

    Attributes:
        judgement: verdict and robustness of the requirement.
        trace: index of the trace.
        start: sample at which the requirement was evaluated.
        sample: sample at which the deciding predicate was evaluated.
        time: time of `sample` in seconds.
        predicate: text of the deciding predicate.
        span: source location of the deciding predicate.
        readings: values of the signals that the predicate reads at `sample`.
        place: the part of the requirement to underline first, and the text beside it.
        labels: the other parts to underline, and their texts.
        because: the cause in words, on one line.
        tree: tree of the sub-formulas that explain the violation, down to predicates.
        alone: whether the robustness rises if only the value of `predicate` at `sample` rises.
        subject: the trace from the first judged sample on, from which the tree counts samples.
        first: index of this sample in the trace.
    """

    judgement: Judgement
    trace: int
    start: int
    sample: int
    time: float
    predicate: str
    span: Span
    readings: tuple[SignalValue, ...]
    place: Label
    labels: tuple[Label, ...]
    because: str
    tree: CauseNode
    alone: bool
    subject: Prepared = field(compare=False, repr=False)
    first: int = 0

    @property
    def started(self) -> str:
        """Instant at which the requirement was evaluated, as text."""
        return self.subject.moment(self.start - self.first)

    @property
    def moment(self) -> str:
        """Instant at which the deciding predicate was evaluated, as text."""
        return self.subject.moment(self.sample - self.first)

    @property
    def unit(self) -> str:
        """Unit of the deciding predicate's values."""
        return margin_unit(self.tree.leaf.formula)


MOST = 500
"""Greatest number of violated requirements explained at once; each takes half a millisecond."""


def explain(verdict: Verdict, name: str) -> Cause | None:
    """Return the cause of the worst violation of a requirement; None if it is not violated.

    Raises UsageError (U101) if there is no such requirement.
    """
    judgement = verdict[name]
    if judgement.overall != "violated":
        return None
    definitions = _definitions(verdict.subject.compiled.spec)
    return _cause(judgement, verdict.subject, judgement.worst, definitions)


def explain_at(verdict: Verdict, name: str, trace: int, start: int) -> Cause | None:
    """Return the cause of a violation by one trace in the window that begins at sample `start`.

    None if no single sample in each step shows it. Raises UsageError (U101) for an unknown requirement.
    """
    definitions = _definitions(verdict.subject.compiled.spec)
    return _cause(verdict[name], verdict.subject, (trace, start), definitions)


def explain_all(verdict: Verdict) -> dict[str, Cause]:
    """Return the causes of the first `MOST` violated requirements, by name of the requirement."""
    definitions = _definitions(verdict.subject.compiled.spec)
    violated = [judgement for judgement in verdict if judgement.overall == "violated"]
    found = {x.name: _cause(x, verdict.subject, x.worst, definitions) for x in violated[:MOST]}
    return {name: cause for name, cause in found.items() if cause is not None}


def _cause(
    judgement: Judgement, subject: Prepared, at: tuple[int, int], definitions: dict[str, ast.Expr]
) -> Cause | None:
    rule, (trace, start) = judgement.rule, at
    part = judgement.part or Part(0, subject.record.samples)
    subject = _evidence(rule, subject, part, trace)
    record, start = subject.record, start - part.first
    if subject.signals.times is not None:  # of several samples in a step, one was chosen
        (high,) = rule_bounds(rule, record, range(start, start + 1), subject.horizon, "open")[1]
        if not float(high.max()) < 0.0:
            return None
    window = window_of(rule, subject.horizon)
    stop = None if window is None else start + window + 1
    if stop is not None and stop <= record.samples:
        record, stop = record.cut(stop), None
    formula = from_first_sample(rule.typed.formula) if rule.absolute else rule.typed.formula
    tree, alone = CauseFinder(record, subject.compiled.grid, stop=stop).why(formula, start)
    words = _Words(subject, record, rule.typed.written, definitions)
    leaf = tree.leaf
    place, *labels = words.labels(tree)
    return Cause(
        judgement=judgement,
        trace=trace,
        start=start + part.first,
        sample=leaf.sample + part.first,
        time=subject.time(leaf.sample),
        predicate=_flat(leaf.span.text),
        span=leaf.span,
        readings=words.readings(leaf),
        place=place,
        labels=tuple(labels[: _MOST_LABELS - 1]),
        because=words.because(tree),
        tree=tree,
        alone=alone,
        subject=subject,
        first=part.first,
    )


def _evidence(rule: CompiledRequirement, subject: Prepared, part: Part, trace: int) -> Prepared:
    """Samples on which a requirement is judged; of several in a step, the one most against it."""
    given, signals = subject.record, subject.signals
    times = None
    if given.cells is None:
        env = {name: column[:, trace : trace + 1] for name, column in given.env.items()}
        record = Record(env, given.ops, holes=given.holes, computed=given.computed)
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

    def readings(self, cause: CauseNode) -> tuple[SignalValue, ...]:
        """Signal values that the predicates of a cause tree read, without duplicates."""
        seen: dict[tuple[str, int], SignalValue] = {}
        read = self.subject.compiled.signature
        for leaf in cause.leaves:
            for name, later in _in_order(leaf):
                sample = leaf.sample + later
                if name not in read or not 0 <= sample < self.record.samples:
                    continue
                value = float(self.record.env[name][sample, 0])
                when = f" at {self.subject.moment(sample)}" if later else ""
                text = f"{name} = {shown(value, read[name])}{when}"
                seen.setdefault((name, sample), SignalValue(name, value, read[name].unit.text, text))
        return tuple(seen.values())

    def labels(self, tree: CauseNode) -> list[Label]:
        """Source locations to underline, each with its text; that of the deciding predicate is the first."""
        found: dict[Span, str] = {}
        for node in _labelled(tree):
            found.setdefault(self.site(_body(node).span), self.label(node))
        deciding = tree
        while deciding.until is None and deciding.parts:
            deciding = deciding.parts[deciding.main]
        first = self.site(_body(deciding).span)
        spans = sorted(found, key=lambda span: (span != first, span.start))
        return [Label(span, found[span]) for span in spans]

    def label(self, node: CauseNode) -> str:
        """Truth value and instant of `node`; of the left side of an implication, also its signals."""
        moment = self.subject.moment(node.sample)
        if node.until is not None:
            window = f"from {moment} to {self.subject.moment(node.until)}"
            return f"{'always' if node.holds else 'never'} true {window}"
        values = ", ".join(reading.text for reading in self.readings(node)) if node.premise else ""
        return f"{'true' if node.holds else 'false'} at {moment}" + (f" ({values})" if values else "")

    def because(self, tree: CauseNode) -> str:
        """The cause in words, as one line; with both sides of an implication whose left side decides."""
        text = self.reason(tree)
        while tree.parts:
            if tree.parts[0].premise and tree.main == 0:
                return f"{text}; {self.reason(tree.parts[1])}"
            tree = tree.parts[tree.main]
        return text

    def reason(self, tree: CauseNode) -> str:
        """Sentence on the deciding predicate, or on its definition: `near means x < 2, and x = 0.27 m …`."""
        leaf = tree.leaf
        moment, truth = self.subject.moment(leaf.sample), "true" if leaf.holds else "false"
        values = " and ".join(reading.text for reading in self.readings(leaf))
        text = f"`{_flat(leaf.span.text)}`"
        if not values:
            return f"{text} is {truth} whatever the signals are"
        nearest = f"comes closest at {moment}, where {values}" if _closest(tree) else ""
        if chain := self.chain(self.written, leaf.span):
            name = chain[-1].name
            body = _flat(self.definitions[name].span.text)
            return f"{name} means {body}, and {nearest or f'{values} at {moment}'} (line {leaf.span.line})"
        return f"{text} {nearest}" if nearest else f"{text} is {truth} where {values}, at {moment}"

    def site(self, span: Span) -> Span:
        """Return `span`, or the name in the requirement that refers to it if it lies in a definition."""
        chain = self.chain(self.written, span)
        return chain[0].span if chain else span

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


def _in_order(leaf: CauseNode) -> list[tuple[str, int]]:
    """Reads of a predicate, in the order in which its text names the signals; those of definitions last."""
    words = re.findall(r"\w+(?:\[\d+\])?", leaf.span.text)
    places = {word: place for place, word in reversed(list(enumerate(words)))}
    return sorted(
        leaf.reads, key=lambda read: (places.get(read[0], len(words)), read[0], abs(read[1]), read[1])
    )


def _labelled(tree: CauseNode) -> Iterator[CauseNode]:
    """Yield the nodes to underline, none inside another.

    These are left sides of implications, predicates, and temporal operators whose body has the wrong truth
    value in the whole window.
    """
    if tree.premise or tree.until is not None or not tree.parts:
        yield tree
        return
    for part in tree.parts:
        yield from _labelled(part)


def _closest(tree: CauseNode) -> bool:
    """True if the deciding predicate fails at every instant of its window."""
    if not tree.parts:
        return False
    part = tree.parts[tree.main]
    return _closest(part) or (tree.until is not None and not part.parts)


def _body(node: CauseNode) -> typed.Formula:
    """The part to underline: of an operator whose body is wrong in the whole window, this body."""
    if node.until is not None and isinstance(node.formula, (typed.Temporal, typed.Until)):
        return operands(node.formula)[-1]
    return node.formula


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


def _definitions(spec: ast.Spec) -> dict[str, ast.Expr]:
    return {item.name: item.value for item in spec.items if isinstance(item, (ast.Def, ast.Region))}


def _flat(text: str) -> str:
    return " ".join(text.split())
