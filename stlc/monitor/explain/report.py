"""Report of a violation in terms of the specification: sub-formula, instant, signal and value."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

from stlc.compile.augment.lift import from_first_sample
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import margin_unit, operands
from stlc.diagnostics import Label
from stlc.grammar import ast
from stlc.monitor.explain.causes import CauseFinder, CauseNode
from stlc.monitor.instants import window_of
from stlc.monitor.judgement import Judgement, Prepared, Verdict
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
        alone: whether the robustness of the requirement rises if only the value of `predicate` at `sample`
            rises.
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

    @property
    def unit(self) -> str:
        """Unit of the deciding predicate's values."""
        return margin_unit(self.tree.leaf.formula)


MOST = 500
"""Greatest number of violated requirements explained at once; each takes half a millisecond."""


def explain(verdict: Verdict, name: str) -> Cause | None:
    """Return the cause of the worst violation of a requirement; None if it is not violated.

    Raises:
        UsageError: U101, there is no such requirement.
    """
    judgement = verdict[name]
    if judgement.overall != "violated":
        return None
    return _cause(judgement, verdict.subject, _definitions(verdict.subject.compiled.spec))


def explain_at(verdict: Verdict, name: str, trace: int, start: int) -> Cause:
    """Return the cause of a violation by one trace in the window that begins at sample `start`.

    Raises:
        UsageError: U101, there is no such requirement.
    """
    definitions = _definitions(verdict.subject.compiled.spec)
    return _cause(verdict[name], verdict.subject, definitions, (trace, start))


def explain_all(verdict: Verdict) -> dict[str, Cause]:
    """Return the causes of the first `MOST` violated requirements, by name of the requirement."""
    definitions = _definitions(verdict.subject.compiled.spec)
    violated = [judgement for judgement in verdict if judgement.overall == "violated"]
    return {judgement.name: _cause(judgement, verdict.subject, definitions) for judgement in violated[:MOST]}


def _cause(
    judgement: Judgement,
    subject: Prepared,
    definitions: dict[str, ast.Expr],
    at: tuple[int, int] | None = None,
) -> Cause:
    rule, (trace, start) = judgement.rule, judgement.worst if at is None else at
    one_trace = {name: column[:, trace : trace + 1] for name, column in subject.record.env.items()}
    given = subject.record
    record = Record(one_trace, given.ops, holes=given.holes, computed=given.computed)
    window = window_of(rule, subject.horizon)
    stop = None if window is None else start + window + 1
    record = record if stop is None else record.cut(stop)
    going_on = stop if stop is not None and stop > record.samples else None
    formula = from_first_sample(rule.typed.formula) if rule.absolute else rule.typed.formula
    tree, alone = CauseFinder(record, subject.compiled.grid, stop=going_on).why(formula, start)
    words = _Words(subject, record, rule.typed.written, definitions)
    leaf = tree.leaf
    place, *labels = words.labels(tree)
    return Cause(
        judgement=judgement,
        trace=trace,
        start=start,
        sample=leaf.sample,
        time=subject.time(leaf.sample),
        predicate=_flat(leaf.span.text),
        span=leaf.span,
        readings=words.readings(leaf),
        place=place,
        labels=tuple(labels[: _MOST_LABELS - 1]),
        because=words.because(tree),
        tree=tree,
        alone=alone,
    )


# -------------------------------------------------------------------------- words


@dataclass(frozen=True, slots=True)
class _Words:
    """Writer of the texts that explain the violation of one requirement.

    Attributes:
        subject: the evaluated signals and requirements.
        record: the trace, up to the end of the evaluated window.
        written: expression of the requirement, as it is written in the specification.
        definitions: name of a definition in the specification -> its expression.
    """

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
        """Source locations to underline, each with its text.

        The location of the deciding predicate comes first.
        """
        found: dict[Span, str] = {}
        for node in _labelled(tree):
            found.setdefault(self.site(node.span), self.label(node))
        first = self.site(_deciding(tree).span)
        spans = sorted(found, key=lambda span: (span != first, span.start))
        return [Label(span, found[span]) for span in spans]

    def label(self, node: CauseNode) -> str:
        """Text beside the underlined source of `node`: its truth value, and the instant.

        If `node` is the left side of an implication, the values of its signals are added.
        """
        moment = self.subject.moment(node.sample)
        if node.until is not None:
            window = f"from {moment} to {self.subject.moment(node.until)}"
            return f"{'always' if node.holds else 'never'} true {window}"
        values = ", ".join(reading.text for reading in self.readings(node)) if node.premise else ""
        return f"{'true' if node.holds else 'false'} at {moment}" + (f" ({values})" if values else "")

    def because(self, tree: CauseNode) -> str:
        """The cause in words, as one line of text.

        If the deciding predicate is on the left side of an implication, the text continues with the right
        side.
        """
        text = self.reason(tree)
        while tree.parts:
            if tree.parts[0].premise and tree.main == 0:
                return f"{text}; {self.reason(tree.parts[1])}"
            tree = tree.parts[tree.main]
        return text

    def reason(self, tree: CauseNode) -> str:
        """Return a sentence on the deciding predicate.

        If the predicate is in the text of a definition, the sentence explains the name of this definition:
        `before_junction means x < x_inter / 2, and x = 0.27 m …`.
        """
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
        """Return the part of the requirement to underline for the source location `span`.

        If `span` lies in the requirement itself, it is returned. Otherwise it lies in the text of a
        definition. The requirement then contains a name that refers to this definition, directly or through
        other definitions. The location of the name is returned.
        """
        chain = self.chain(self.written, span)
        return chain[0].span if chain else span

    def chain(self, expr: ast.Expr, span: Span) -> tuple[ast.Name, ...] | None:
        """Return the names that lead from the expression `expr` to the source location `span`.

        Example: `expr` contains the name of the definition `a`, the text of `a` contains `b`, and the text of
        `b` contains `span`. The result is (`a`, `b`). It is empty if `span` lies in `expr` itself, and None
        if no name leads to `span`.
        """
        if _within(span, expr.span):
            return ()
        for name in names_in(expr):
            body = self.definitions.get(name.name)
            rest = None if body is None else self.chain(body, span)
            if rest is not None:
                return (name, *rest)
        return None


def _in_order(leaf: CauseNode) -> list[tuple[str, int]]:
    """Pairs (signal, offset in samples) that a predicate reads, in the order in which its text names them.

    If the text contains the name of a definition, the signals in this definition come last.
    """
    words = re.findall(r"\w+(?:\[\d+\])?", leaf.span.text)
    places = {word: place for place, word in reversed(list(enumerate(words)))}
    return sorted(
        leaf.reads, key=lambda read: (places.get(read[0], len(words)), read[0], abs(read[1]), read[1])
    )


def _labelled(tree: CauseNode) -> Iterator[CauseNode]:
    """Yield the nodes of a tree of causes whose source is underlined.

    Three kinds of nodes are underlined: left sides of implications, predicates, and the body of a temporal
    operator if the body has the wrong truth value in the whole window. Nothing inside an underlined part is
    underlined again.
    """
    if tree.premise or tree.until is not None or not tree.parts:
        yield _body(tree)
        return
    for part in tree.parts:
        yield from _labelled(part)


def _deciding(tree: CauseNode) -> CauseNode:
    """Node whose source is underlined first: it contains the predicate that decides the violation.

    It is the body of a temporal operator if this body has the wrong truth value in the whole window.
    Otherwise it is the predicate itself.
    """
    return _body(tree) if tree.until is not None or not tree.parts else _deciding(tree.parts[tree.main])


def _closest(tree: CauseNode) -> bool:
    """True if the predicate that decides the verdict fails at every instant of its window.

    The explanation then shows the instant at which it comes closest to being true.
    """
    if not tree.parts:
        return False
    part = tree.parts[tree.main]
    return _closest(part) or (tree.until is not None and not part.parts)


def _body(node: CauseNode) -> CauseNode:
    """Return a copy of `node` whose formula is the body of its temporal operator.

    This is done only if the body has the wrong truth value in the whole window. Any other node is returned
    unchanged.
    """
    if node.until is not None and isinstance(node.formula, (typed.Temporal, typed.Until)):
        return replace(node, formula=operands(node.formula)[-1])
    return node


def shown(value: float, column: Column) -> str:
    """Return a signal's value as text: the label of an enum member, else the number with its unit."""
    for label, number in column.labels:
        if number == value:
            return label
    return f"{value:.6g} {column.unit.text}".rstrip()


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


def _within(inner: Span, outer: Span) -> bool:
    return inner.source is outer.source and outer.start <= inner.start and inner.end <= outer.end


def _flat(text: str) -> str:
    return " ".join(text.split())
