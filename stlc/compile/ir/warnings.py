"""Warnings about requirements: contradictions, tautologies, vacuity, and jumps of the modulo operator."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import normal
from stlc.compile.ir.ranges import KnownRanges, bounds
from stlc.diagnostics import Diagnostic
from stlc.signature import Signature
from stlc.source import Span

_TOLERANCE = 1e-6


def contradictions(formula: typed.Formula, signature: Signature) -> Iterator[Diagnostic]:
    """Yield W505 for conjunctions that no values of their signals satisfy, W312 for formulas that all do.

    W312 concerns disjunctions and implications. Of nested formulas, the innermost is reported. `signature`
    tells which signals have whole values.
    """
    whole = {column.name for column in signature.columns if column.kind != "real"}
    reported: set[Span] = set()
    for node in reversed(list(formula.walk())):
        if isinstance(node, typed.Logic) and node.op == "if":
            node = typed.Logic(node.items[1].span, "and", node.items[:2])
        if not isinstance(node, typed.Logic) or node.op not in _DECIDED_BY or node.span in reported:
            continue
        found = None if any(part.span in reported for part in node.walk()) else _decided(node, whole)
        if found is not None:
            reported.add(node.span)
            yield found


@dataclass(slots=True)
class _Room:
    """Range that the predicates of a conjunction leave for one linear combination of signals.

    `low` is the greatest lower bound and `high` the least upper bound; `low_at` and `high_at` set them.
    If `whole`, all signals have whole values; the compiler puts bounds halfway between these.
    """

    whole: bool
    low: float = -math.inf
    high: float = math.inf
    low_at: _Demand | None = None
    high_at: _Demand | None = None

    def bound(self, factor: float, bound: float, demand: _Demand) -> None:
        """Add a bound that a predicate sets: from below if `factor` is positive, else from above."""
        if factor > 0 and (bound > self.low or (bound == self.low and demand.strict)):
            self.low, self.low_at = bound, demand
        if factor < 0 and (bound < self.high or (bound == self.high and demand.strict)):
            self.high, self.high_at = bound, demand

    @property
    def empty(self) -> bool:
        """True if no value is left, with a margin for rounding."""
        if self.low_at is None or self.high_at is None:
            return False
        if self.low == self.high:
            return self.whole or self.low_at.strict or self.high_at.strict
        return self.low > self.high + _TOLERANCE * max(1.0, abs(self.low), abs(self.high))


@dataclass(frozen=True, slots=True)
class _Linear:
    """Linear form of a number: a coefficient for each of its terms, and a constant."""

    parts: dict[ir.Num, float] = field(default_factory=dict)
    constant: float = 0.0

    def plus(self, other: _Linear, factor: float = 1.0) -> _Linear:
        parts = dict(self.parts)
        for part, its in other.parts.items():
            parts[part] = parts.get(part, 0.0) + factor * its
        return _Linear({p: f for p, f in parts.items() if f}, self.constant + factor * other.constant)


_DECIDED_BY: Mapping[str, typed.Sign] = {"and": 1, "or": -1, "->": -1}
"""Connective -> 1 if a contradiction in it makes it false, -1 if one in its negation makes it true."""


@dataclass(frozen=True, slots=True)
class _Demand:
    """Demand of the predicate at `span`: that `linear` is positive (`strict`), or at least 0."""

    linear: _Linear
    strict: bool
    span: Span


def _decided(node: typed.Logic, whole: Set[str]) -> Diagnostic | None:
    sign = _DECIDED_BY[node.op]
    rooms: dict[frozenset[tuple[ir.Num, float]], _Room] = {}
    for demand in _conjuncts(normal(node, sign)):
        linear = demand.linear
        if not linear.parts or not math.isfinite(linear.constant):
            continue
        scale = next(iter(sorted(linear.parts.items(), key=lambda item: repr(item[0]))))[1]
        key = frozenset((part, factor / scale) for part, factor in linear.parts.items())
        counted = all(isinstance(part, ir.Signal) and part.name in whole for part in linear.parts)
        room = rooms.setdefault(key, _Room(counted))
        room.bound(scale, -linear.constant / scale, demand)
    for room in rooms.values():
        if room.low_at is None or room.high_at is None or not room.empty:
            continue
        places = sorted({room.low_at.span, room.high_at.span}, key=lambda span: span.start)
        if sign > 0:
            code, message, advice = "W505", "this can never be true: its parts leave no room", "`or`"
            texts = ("bounds it from one side", "and this from the other")
        else:
            code, message, advice = "W312", "this is always true: its parts leave no value out", "`and`"
            texts = ("holds wherever the other part does not", "and this likewise")
        return Diagnostic(
            code,
            message,
            node.span,
            labels=tuple(map(Span.label, places, texts)) if len(places) > 1 else (),
            help=(f"{advice}, or the other comparison?",),
        )
    return None


def _conjuncts(formula: typed.Formula) -> Iterator[_Demand]:
    """Yield what the predicates of a conjunction in negation normal form require at one instant.

    A predicate on `c - abs(x)` requires two linear forms.
    """
    match formula:
        case typed.Predicate(span, num, strict):
            yield from (_Demand(part, strict, span) for part in _at_least(_linear(num)))
        case typed.Not(_, typed.Predicate(span, num, strict)):
            opposite = _Linear().plus(_linear(num), -1.0)
            yield from (_Demand(part, not strict, span) for part in _at_least(opposite))
        case typed.Logic(_, "and", items):
            for item in items:
                yield from _conjuncts(item)
        case _:
            return


def _at_least(linear: _Linear) -> Iterator[_Linear]:
    """Yield linear forms that are at least 0 if and only if `linear` is: two if a term is -abs(…)."""
    for part, factor in linear.parts.items():
        if isinstance(part, ir.Op) and part.name == "abs" and factor < 0:
            rest, inner = linear.plus(_Linear({part: 1.0}), -factor), _linear(part.args[0])
            yield rest.plus(inner, factor)
            yield rest.plus(inner, -factor)
            return
    yield linear


def _linear(num: ir.Num) -> _Linear:
    match num:
        case ir.Const(value):
            return _Linear(constant=value)
        case ir.Op("add", (left, right)):
            return _linear(left).plus(_linear(right))
        case ir.Op("sub", (left, right)):
            return _linear(left).plus(_linear(right), -1.0)
        case ir.Op("neg", (inner,)):
            return _Linear().plus(_linear(inner), -1.0)
        case ir.Op("mul", (ir.Const(factor), inner)) | ir.Op("mul", (inner, ir.Const(factor))):
            return _Linear().plus(_linear(inner), factor)
        case ir.Op("div", (inner, ir.Const(divisor))) if divisor:
            return _Linear().plus(_linear(inner), 1.0 / divisor)
        case _:
            return _Linear({num: 1.0})


def jumps(formula: typed.Formula, ranges: KnownRanges) -> Iterator[Diagnostic]:
    """Yield the warning W403 for each predicate with a modulo that may jump within the ranges of its signals.

    A modulo such as `x % 360` jumps from 360 back to 0 where x is a multiple of 360.

    Args:
        formula: formula whose names and units are resolved.
        ranges: ranges of the signals by name, each in the unit in which the signal is stored.
    """
    for node in formula.walk():
        if isinstance(node, typed.Predicate) and any(
            _jumps(num, ranges) for num in node.num.subexpressions()
        ):
            yield Diagnostic(
                "W403",
                "a modulo in a predicate that is trained for",
                node.span,
                "jumps at every multiple, and no gradient tells so",
                help=(
                    "give the system a phase as a state that a jump sets back: `timer`, `reset_when`",
                    "or declare a range within one period: `signal tau [s] in [0, 8]`",
                ),
            )


def _jumps(num: ir.Num, ranges: KnownRanges) -> bool:
    """True if `num` is a modulo whose left side may cross a multiple of its right side."""
    if not isinstance(num, ir.Op) or num.name != "mod":
        return False
    value, period = (bounds(arg, ranges) for arg in num.args)
    if value is None or period is None or period[0] != period[1] or not all(map(math.isfinite, value)):
        return True
    return math.ceil(value[1] / period[0]) - math.floor(value[0] / period[0]) > 1


_DECIDED = 1e-6


def vacuous(formula: typed.Formula, signature: Signature, facts: KnownRanges) -> Iterator[Diagnostic]:
    """Yield the warning W503 for each implication in a formula whose left side is never true.

    If there is no such implication, W503 is yielded if the formula as a whole is never false. `facts`
    contains the ranges that signals never leave; other declared ranges are not used, since a signal may leave
    them. `signature` gives the units for the messages.
    """
    found = False
    for left in _antecedents(formula):
        if truth(left, facts) is False:
            found = True
            why = _because(left, signature, facts)
            note = ("the requirement is satisfied by every trajectory",)
            yield Diagnostic(
                "W503", f"the left side can never be true{why}", left.span, "always false", note=note
            )
    if not found and truth(formula, facts) is True:
        why = _because(formula, signature, facts)
        yield Diagnostic("W503", f"this can never be false{why}", formula.span, "always true")


def truth(formula: typed.Formula, facts: KnownRanges) -> bool | None:
    """Return the truth of a formula if the ranges in `facts` determine it, else None.

    The result holds at all instants of all traces whose signals stay in these ranges.
    """
    return _truth(normal(formula), facts)


def _truth(formula: typed.Formula, facts: KnownRanges) -> bool | None:
    if isinstance(formula, typed.Truth):
        return formula.value
    match formula:
        case typed.Predicate(_, num):
            reach = bounds(num, facts)
            if reach is None or isinstance(num, ir.Const):
                return None
            return True if reach[0] > _DECIDED else (False if reach[1] < -_DECIDED else None)
        case typed.Not(_, body):
            inner = _truth(body, facts)
            return None if inner is None else not inner
        case typed.Logic(_, op, items):
            values, decisive = [_truth(item, facts) for item in items], op == "or"
            return decisive if decisive in values else None if None in values else not decisive
        case typed.Temporal(_, "always" | "eventually", _, body) | typed.Freeze(_, _, body):
            return _truth(body, facts)
        case _:
            return None


def _antecedents(formula: typed.Formula) -> Iterator[typed.Formula]:
    """Yield the left sides of the implications that a formula requires to hold.

    The implications are looked for in the formula itself, the items of `and`, the operands of `always` and
    `freeze`, and the right sides of implications. An implication below a negation, `or` or `eventually` is
    left out.
    """
    match formula:
        case typed.Logic(_, "->", (left, right)):
            yield left
            yield from _antecedents(right)
        case typed.Logic(_, "and", items):
            for item in items:
                yield from _antecedents(item)
        case typed.Temporal(_, "always", _, body) | typed.Freeze(_, _, body):
            yield from _antecedents(body)
        case _:
            return


def _because(formula: typed.Formula, signature: Signature, facts: KnownRanges) -> str:
    """Return a text on the ranges of the signals in a formula, such as ": `x` is in [0, 5]".

    Only ranges in `facts` are named; the text is empty if there are none. `signature` gives the units of the
    signals.
    """
    read = (leaf for num in formula.numbers() for leaf in num.leaves())
    names = dict.fromkeys(leaf.name for leaf in read if isinstance(leaf, (ir.Signal, ir.ShiftedSignal)))
    parts = [in_range(name, signature, facts) for name in names if name in facts and name in signature]
    return f": {', '.join(parts)}" if parts else ""


def in_range(name: str, signature: Signature, ranges: KnownRanges) -> str:
    """Return a text on the range of a signal, such as "`x` is in [0, 5] m"."""
    low, high = ranges[name]
    unit = signature[name].unit
    return f"`{name}` is in [{low:g}, {high:g}]" + (f" {unit}" if unit.text else "")


# ----------------------------------------------------------------------- safety


def safety_never_violated(requirement: typed.Requirement, tag: Span | None) -> Diagnostic | None:
    """Return the warning W502 if no finite prefix of a trace violates a `@safety` requirement, else None.

    The message points to `tag`, the place of the tag `@safety` in the source, unless `tag` is None.
    """
    formula = normal(requirement.formula)
    if "safety" not in requirement.tags or _constrains(formula):
        return None
    culprit = _promise(formula)
    labels = () if tag is None else (tag.label("puts it into phi_safe"),)
    return Diagnostic(
        "W502",
        "this `@safety` requirement can never constrain the backup policy",
        culprit,
        "only says that something good happens at the end",
        labels,
        help=(
            "a safety requirement is violated by a finite prefix; use @liveness, or bound it with `always`",
        ),
    )


def _constrains(formula: typed.Formula) -> bool:
    """True if a trace can violate the formula within a prefix that is shorter than the planning horizon.

    The formula is in negation normal form.
    """
    if isinstance(formula, typed.Truth):
        return False
    match formula:
        case typed.Logic(_, op, items):
            return (all if op == "or" else any)(map(_constrains, items))
        case typed.Temporal(_, op, window, body):
            return _constrains(body) and not (op == "eventually" and _open(window))
        case typed.Freeze(_, _, body):
            return _constrains(body)
        case typed.Until(_, op, window, left, right):
            return _constrains(left if op in ("until", "since") else right) or not _open(window)
        case typed.Not(_, typed.Until(_, _, window, _, right)):
            return _constrains(normal(right, -1)) or not _open(window)
        case _:
            return True


def _open(window: typed.Interval) -> bool:
    """True if a window extends to the planning horizon or to the end of the trace."""
    return window.hi is None or window.hi.horizons > 0


def _promise(formula: typed.Formula) -> Span:
    """Return the source location of the part of a formula that no finite prefix of a trace violates."""
    if isinstance(formula, typed.Freeze):
        return _promise(formula.body)
    if isinstance(formula, typed.Logic):
        return next((_promise(item) for item in formula.items if not _constrains(item)), formula.span)
    return formula.span
