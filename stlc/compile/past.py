"""Operators of the past become timers, so that a plan knows what was before it.

A timer holds the time up to the sample before: `historically[0, c] p` is `p and held >= c`, `once[0, c] p` is
`p or since_p <= c`. At the start of a mission nothing was before: windows of the past are cut there.

That decides at an instant, and has no slope. Along a plan the samples since its start are looked at as they
were written about, and only what was before the start is left to the timer: after k steps it lacks the
`c - held - k` steps that it lacked of c when the plan began.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal, TypeAlias, final

from stlc.compile import ir, typed
from stlc.compile.bounds import report, to_window
from stlc.compile.interface import Grid
from stlc.compile.lower import lower
from stlc.compile.simplify import simplify
from stlc.compile.timers import Kind, Ledger, Timer, choose, denied, guard, recalled, tolerant
from stlc.compile.walk import Sign, at_hand, flip, is_state_formula, looks_back, normal
from stlc.diagnostics import Diagnostic
from stlc.source import Span

_ZERO, _ONE = ir.Lit(0.0), ir.Lit(1.0)
_Op: TypeAlias = Literal["and", "or"]


@dataclass(frozen=True, slots=True)
class _Test:
    """`left >= right`, where one is a timer and the other a number.

    Attributes:
        left: the greater one.
        right: the other one.
        span: of the operator.
        later: how much a timer has gone on one step later, if nothing else happened.
    """

    left: ir.Num
    right: ir.Num
    span: Span
    later: int = 0

    def decides(self) -> typed.Recalled:
        """As one of several ways: it decides, or has no say."""
        return typed.Recalled(
            self.span, guard(self.left, self.right, self.span), guard(*self._then, self.span)
        )

    def lacks(self) -> typed.Recalled:
        """As one of several conditions: what is missing counts."""
        return typed.Recalled(
            self.span, guard(self.left, self.right, self.span), recalled(*self._then, self.span)
        )

    @property
    def _then(self) -> tuple[ir.Num, ir.Num]:
        """Both sides some samples after the timer was read at the first one."""
        return self._since_first(self.left), self._since_first(self.right)

    def _since_first(self, side: ir.Num) -> ir.Num:
        if not isinstance(side, ir.Col):
            return side
        first = ir.at_first(side)
        return ir.Op("add", (first, ir.Col(ir.ELAPSED))) if self.later else first


@final
@dataclass(frozen=True, slots=True)
class Past:
    """Rewrites operators of the past for one requirement.

    Attributes:
        grid: of time.
        ledger: takes the timers.
        sink: takes the findings, E309 for what no timer can hold.
        name: of the requirement; timers are named after it.
    """

    grid: Grid
    ledger: Ledger
    sink: list[Diagnostic]
    name: str

    def rewrite(self, formula: typed.Formula) -> typed.Formula:
        """A formula in negation normal form without operators of the past."""
        if not looks_back(formula):
            return formula
        match formula:
            case typed.Logic(_, _, items):
                return replace(formula, items=tuple(map(self.rewrite, items)))
            case typed.Temporal(_, "once" | "historically"):
                return self._window(formula)
            case typed.Temporal():
                return replace(formula, body=self.rewrite(formula.body))
            case typed.Until(_, "since"):
                return self._since(formula, positive=True)
            case typed.Not(_, typed.Until(_, "since") as since):
                return self._since(since, positive=False)
            case typed.Until():
                return replace(formula, left=self.rewrite(formula.left), right=self.rewrite(formula.right))
            case typed.Edge():
                return self._edge(formula, positive=True)
            case typed.Not(_, typed.Edge() as edge):
                return self._edge(edge, positive=False)
            case _:
                return self._refused(formula.span, "under `prev` or `next`")

    # ---------------------------------------------------------------- once, historically

    def _window(self, node: typed.Temporal) -> typed.Formula:
        once = node.op == "once"
        body = self._body(node.body)
        window = self._ending_now(node, outward=not once)
        if body is None or window is None:
            return typed.Truth(node.span, True)
        if window.hi == 0:
            return body
        memory = self._seen(node, body, window.hi) if once else self._held(node, body, window.hi)
        inside = replace(node, interval=_back(window, node.span), body=body)
        op: _Op = "or" if once else "and"
        return typed.Recalled(
            node.span,
            now=typed.Logic(node.span, op, (body, memory.now)),
            along=typed.Logic(node.span, op, (inside, memory.along)),
        )

    def _seen(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Recalled:
        """Whether `body` held at one of the `most` samples before."""
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "seen", 0.0, 1.0, f"whether {_short(node.body)} ever held")
            seen = self.ledger.add(draft, lambda own: choose(condition, _ONE, own))
            return _Test(seen, _ONE, node.span).decides()
        about = f"steps since {_short(node.body)} last held, up to {most}"
        draft = self._draft("timer", "since", most + 1.0, most + 1.0, about)
        since = self.ledger.add(draft, lambda own: choose(condition, _ONE, _counted(own, most + 1)))
        return _Test(ir.Lit(float(most)), since, node.span, later=1).decides()

    def _held(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Recalled:
        """Whether `body` held at all of the `most` samples before."""
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "kept", 1.0, 1.0, f"whether {_short(node.body)} always held")
            kept = self.ledger.add(draft, lambda own: choose(condition, own, _ZERO))
            return _Test(kept, _ONE, node.span).lacks()
        about = f"steps for which {_short(node.body)} has held, up to {most}"
        draft = self._draft("timer", "held", float(most), float(most), about)
        held = self.ledger.add(draft, lambda own: choose(condition, _counted(own, most), _ZERO))
        return _Test(held, ir.Lit(float(most)), node.span, later=1).lacks()

    # ------------------------------------------------------------------------------ since

    def _since(self, node: typed.Until, *, positive: bool) -> typed.Formula:
        """`p since[0, c] q`: p now, and q now or so lately that p has held from there on; or its dual."""
        sign: Sign = 1 if positive else -1
        left, right = self._body(normal(node.left, sign)), self._body(normal(node.right, sign))
        window = self._ending_now(node, outward=not positive)
        if left is None or right is None or window is None:
            return typed.Truth(node.span, True)
        ops: tuple[_Op, _Op] = ("and", "or") if positive else ("or", "and")
        if window.hi == 0:
            return typed.Logic(node.span, ops[0], (left, right))
        recent = self._recent(node, self._condition(left), self._condition(right), (window.hi, positive))
        met = typed.Logic(node.span, ops[1], (right, recent.now))
        whole = typed.Temporal(
            node.span, "historically" if positive else "once", _back(ir.Window(0, None), node.span), left
        )
        before = typed.Logic(node.span, ops[0], (whole, recent.along))
        return typed.Recalled(
            node.span,
            now=typed.Logic(node.span, ops[0], (left, met)),
            along=typed.Logic(
                node.span, ops[1], (_since_inside(node, left, right, window, positive=positive), before)
            ),
        )

    def _recent(
        self, node: typed.Until, left: ir.Formula, right: ir.Formula, how: tuple[int | None, bool]
    ) -> typed.Recalled:
        """Whether q held at one of the samples before, and p from there on up to now; or its contrary."""
        most, positive = how
        held, met = (left, right) if positive else (denied(left), denied(right))
        about = f"{_short(node.right)}, and {_short(node.left)} from there on"
        if most is None:
            draft = self._draft("latch", "since", 0.0, 1.0, f"whether there was {about}")
            begun = self.ledger.add(draft, lambda own: choose(held, choose(met, _ONE, own), _ZERO))
            test = _Test(begun, _ONE, node.span) if positive else _Test(_ZERO, begun, node.span)
            return test.decides()
        far = ir.Lit(most + 1.0)
        draft = self._draft("timer", "since", far.value, far.value, f"steps since {about}, up to {most}")
        since = self.ledger.add(
            draft, lambda own: choose(held, choose(met, _ONE, _counted(own, most + 1)), far)
        )
        if positive:
            return _Test(ir.Lit(float(most)), since, node.span, later=1).decides()
        return _Test(since, far, node.span, later=1).decides()

    # ------------------------------------------------------------------------- rise, fall

    def _edge(self, node: typed.Edge, *, positive: bool) -> typed.Formula:
        """`rise`: now and not before; false at the first sample."""
        now: Sign = 1 if (node.op == "rise") is positive else -1
        body, before = self._body(normal(node.body, now)), self._body(normal(node.body, flip(now)))
        if body is None or before is None:
            return typed.Truth(node.span, True)
        condition = self._condition(before)
        about = f"whether {_short(node.body)} {'failed' if now > 0 else 'held'} at the sample before"
        draft = self._draft("latch", "before", 0.0 if positive else 1.0, 1.0, about)
        latch = self.ledger.add(draft, lambda _own: choose(condition, _ONE, _ZERO))
        op: _Op = "and" if positive else "or"
        begun = guard(ir.Col(ir.ELAPSED), _ONE, node.span)
        first = typed.Logic(node.span, "or", (begun, _Test(latch, _ONE, node.span).lacks().along))
        inside = typed.Shift(node.span, -1, before, outside=True)
        return typed.Recalled(
            node.span,
            now=typed.Logic(node.span, op, (body, guard(latch, _ONE, node.span))),
            along=typed.Logic(node.span, op, (body, typed.Logic(node.span, "and", (inside, first)))),
        )

    # -------------------------------------------------------------------------- in common

    def _draft(self, kind: Kind, what: str, initial: float, high: float, about: str) -> Timer:
        return Timer(f"{self.name}_{what}", kind, initial, _ZERO, 0.0, high, about)

    def _condition(self, body: typed.Formula) -> ir.Formula:
        return tolerant(simplify(lower(at_hand(body), self.grid, self.sink)))

    def _body(self, body: typed.Formula) -> typed.Formula | None:
        """A body without operators of the past, if it is about one instant alone by then."""
        rewritten = self.rewrite(body)
        if is_state_formula(rewritten):
            return rewritten
        self._refused(body.span, "over a formula that looks ahead")
        return None

    def _ending_now(self, node: typed.Temporal | typed.Until, *, outward: bool) -> ir.Window | None:
        window = to_window(node.interval, self.grid, self.sink, outward=outward)
        if window.lo == 0:
            return window
        self._refused(node.span, "with a window that does not end now")
        return None

    def _refused(self, span: Span, why: str) -> typed.Formula:
        finding = Diagnostic(
            "E309",
            "this past operator would need the policy to remember more than a timer can hold",
            span,
            f"a past operator {why}",
            help=(
                "windows that end now train: `once[0, 3 s] p` becomes a timer",
                "`stlc check` can judge this one on recorded traces",
            ),
        )
        report(self.sink, finding)
        return typed.Truth(span, True)


def _counted(own: ir.Num, most: int) -> ir.Num:
    """One more, up to `most`."""
    return ir.Op("min", (ir.Op("add", (own, _ONE)), ir.Lit(float(most))))


def _short(formula: typed.Formula) -> str:
    """A formula as it was written, cut where it is long."""
    text = " ".join(formula.span.text.split())
    return f"`{text}`" if len(text) <= 40 else f"`{text[:37]}...`"


def _back(window: ir.Window, span: Span) -> typed.Interval:
    """A window of the past that ends now."""
    hi = None if window.hi is None else typed.Time(steps=Fraction(window.hi), span=span)
    return typed.Interval(typed.Time(), hi, span=span)


def _since_inside(
    node: typed.Until, left: typed.Formula, right: typed.Formula, window: ir.Window, *, positive: bool
) -> typed.Formula:
    """`since` or its dual over the samples since the first one; the operands of the dual are negated."""
    interval = _back(window, node.span)
    if positive:
        return replace(node, interval=interval, left=left, right=right)
    denied_ = tuple(typed.Not(part.span, part) for part in (left, right))
    return typed.Not(node.span, replace(node, interval=interval, left=denied_[0], right=denied_[1]))
