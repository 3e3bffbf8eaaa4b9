"""Past operators rewritten with timers: states that the compiler adds to store what happened before a plan.

A timer counts the samples before the current one: `historically[0, c] p` is `p and held >= c`, where `held`
is the number of samples for which p has held; `once[0, c] p` is `p or since_p <= c`, where `since_p` is the
number of samples since p last held. Windows of the past are cut at the start of the mission.

At a single instant, timers tell whether a past operator is true, but they have no gradient. Along a plan, the
operator is therefore evaluated on the samples of the plan. The timer is used only for the samples before the
plan: its value at the first sample of the plan is read. For example, suppose that p holds at all samples of
the plan. At step k, `held` has then grown to `held + k`. `historically[0, c] p` is false while `held + k` is
less than c.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal, TypeAlias, final

from stlc.compile.augment.timers import (
    MISSING,
    Timer,
    TimerKind,
    TimerTable,
    at_least,
    choose,
    cited,
    time_test,
    timer_test,
    tolerant,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.normal_form import condition, normal
from stlc.diagnostics import Diagnostic, tell
from stlc.source import Span

REGISTER = 64
"""Maximum number of samples for which the truth of a formula is stored, with one state per sample."""

_ZERO, _ONE = ir.Const(0.0), ir.Const(1.0)
_SO_FAR = ir.Window(0, None)
_Op: TypeAlias = Literal["and", "or"]


@dataclass(frozen=True, slots=True)
class _Test:
    """Test `left >= right` between an added state and a constant, used in place of a past operator.

    Attributes:
        left: the added state or the constant.
        right: the constant or the added state.
        span: source location of the past operator.
        later: growth of the added state per step of a plan. It is 1 if the state counts steps, and 0 if the
            state stores a truth value.
    """

    left: ir.Num
    right: ir.Num
    span: Span
    later: int = 0

    def decides(self) -> typed.Recalled:
        """Return the formula `left >= right` for use in an `or`, in place of a past operator.

        Its robustness is +inf where it is true and -inf where it is false.
        """
        return typed.Recalled(
            self.span, time_test(self.left, self.right, self.span), time_test(*self._then, self.span)
        )

    def lacks(self) -> typed.Recalled:
        """Return the formula `left >= right` for use in an `and`, in place of a past operator.

        Along a plan, its robustness is +inf where it is true. Where it is false, its robustness is finite and
        negative: it is proportional to the number of steps by which `left` is less than `right`.
        """
        return typed.Recalled(
            self.span, time_test(self.left, self.right, self.span), timer_test(*self._then, self.span)
        )

    @property
    def _then(self) -> tuple[ir.Num, ir.Num]:
        """Both sides of the test at any sample of a plan, computed from the timer at the first sample."""
        return self._extrapolated(self.left), self._extrapolated(self.right)

    def _extrapolated(self, side: ir.Num) -> ir.Num:
        if not isinstance(side, ir.Signal):
            return side
        first = side.at_first
        return first + ir.Signal(ir.ELAPSED) if self.later else first


@final
@dataclass(frozen=True, slots=True)
class Past:
    """Rewriter of a requirement's past operators with timers (added states).

    Attributes:
        grid: time step and horizon.
        table: table to which the timers are added.
        sink: list to which findings are appended: E309 for an operator that no timer represents.
        name: name of the requirement, which begins the names of its timers.
    """

    grid: Grid
    table: TimerTable
    sink: list[Diagnostic]
    name: str

    def rewrite(self, formula: typed.Formula) -> typed.Formula:
        """Return `formula`, which is in negation normal form, with its past operators replaced by timers."""
        if not formula.looks_back:
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
        if body is None:
            return typed.Truth(node.span, True)
        window = self.grid.window(node.interval, self.sink, outward=not once)
        if window.lo:
            recent = ir.Window(0, None if window.hi is None else window.hi - window.lo)
            inner = self._window(replace(node, interval=in_steps(recent, node.span)))
            return self._delayed(node, inner, window.lo, before=not once)
        if window.hi == 0:
            return body
        memory = self._seen(node, body, window.hi) if once else self._held(node, body, window.hi)
        inside = replace(node, interval=in_steps(window, node.span), body=body)
        op: _Op = "or" if once else "and"
        return typed.Recalled(
            node.span,
            now=typed.Logic(node.span, op, (body, memory.now)),
            along=typed.Logic(node.span, op, (inside, memory.along)),
        )

    def _seen(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Recalled:
        """Add a timer, and return the test that `body` held at one or more of the previous `most` samples.

        If `most` is None, all earlier samples count. `body` is the operand of `node`, with its own past
        operators rewritten.
        """
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "seen", 0.0, 1.0, f"whether {cited(node.body)} ever held")
            seen = self.table.add(draft, lambda own: choose(condition, _ONE, own))
            return _Test(seen, _ONE, node.span).decides()
        about = f"steps since {cited(node.body)} last held, up to {most}"
        draft = self._draft("timer", "since", most + 1.0, most + 1.0, about)
        since = self.table.add(draft, lambda own: choose(condition, _ONE, _counted(own, most + 1)))
        return _Test(ir.Const(float(most)), since, node.span, later=1).decides()

    def _held(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Recalled:
        """Add a timer, and return the test that `body` held at each of the previous `most` samples.

        If `most` is None, all earlier samples count. `body` is the operand of `node`, with its own past
        operators rewritten.
        """
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "kept", 1.0, 1.0, f"whether {cited(node.body)} always held")
            latch = self.table.add(draft, lambda own: choose(condition, own, _ZERO))
            return _Test(latch, _ONE, node.span).lacks()
        about = f"steps for which {cited(node.body)} has held, up to {most}"
        draft = self._draft("timer", "held", float(most), float(most), about)
        held = self.table.add(draft, lambda own: choose(condition, _counted(own, most), _ZERO))
        return _Test(held, ir.Const(float(most)), node.span, later=1).lacks()

    # ------------------------------------------------------------------------------ since

    def _since(self, node: typed.Until, *, positive: bool) -> typed.Formula:
        """Rewrite `p since[0, c] q`, or its negation if not `positive`, with a timer.

        The operator is true if q is true now, or if q was true at a sample at most c samples ago and p has
        been true at every sample since then. Windows that end before now are rewritten by `_since_before` and
        `_lasting`.
        """
        left = self._body(normal(node.left, 1 if positive else -1))
        right = self._body(normal(node.right, 1 if positive else -1))
        if left is None or right is None:
            return typed.Truth(node.span, True)
        window = self.grid.window(node.interval, self.sink, outward=not positive)
        if window.lo and window.hi is None:
            return self._lasting(node, left, right, window.lo, positive=positive)
        if window.lo and window.hi is not None:
            return self._since_before(node, window, positive=positive)
        ops: tuple[_Op, _Op] = ("and", "or") if positive else ("or", "and")
        if window.hi == 0:
            return typed.Logic(node.span, ops[0], (left, right))
        recent = self._recent(
            node, self._condition(left), self._condition(right), window.hi, positive=positive
        )
        met = typed.Logic(node.span, ops[1], (right, recent.now))
        throughout = self._throughout(left, node.span, positive=positive)
        before = typed.Logic(node.span, ops[0], (throughout, recent.along))
        inside = _since_inside(node, left, right, window, positive=positive)
        return typed.Recalled(
            node.span,
            now=typed.Logic(node.span, ops[0], (left, met)),
            along=typed.Logic(node.span, ops[1], (inside, before)),
        )

    def _recent(
        self, node: typed.Until, left: ir.Formula, right: ir.Formula, most: int | None, *, positive: bool
    ) -> typed.Recalled:
        """Add a timer; return the test that q was true earlier and p has been true since then.

        p and q are the operands of `node`, `p since q`. q must have held at a sample at most `most` samples
        ago; if `most` is None, at any earlier sample. p must have held at all samples from there to the
        previous sample; the present sample does not count. If `positive` is False, the test is negated,
        and `left` and `right` are the negations of p and q.
        """
        held, met = (left, right) if positive else (left.negated, right.negated)
        about = f"{cited(node.right)}, and {cited(node.left)} from there on"
        if most is None:
            draft = self._draft("latch", "since", 0.0, 1.0, f"whether there was {about}")
            latch = self.table.add(draft, lambda own: choose(held, choose(met, _ONE, own), _ZERO))
            test = _Test(latch, _ONE, node.span) if positive else _Test(_ZERO, latch, node.span)
            return test.decides()
        far = ir.Const(most + 1.0)
        draft = self._draft("timer", "since", far.value, far.value, f"steps since {about}, up to {most}")
        since = self.table.add(
            draft, lambda own: choose(held, choose(met, _ONE, _counted(own, most + 1)), far)
        )
        sides: tuple[ir.Num, ir.Num] = (ir.Const(float(most)), since) if positive else (since, far)
        return _Test(sides[0], sides[1], node.span, later=1).decides()

    # ------------------------------------------------------------------------- rise, fall

    def _edge(self, node: typed.Edge, *, positive: bool) -> typed.Formula:
        """Rewrite `rise` or `fall`, or its negation if not `positive`, with the truth of the previous sample.

        `rise(p)` holds where p is true and was false at the previous sample; at the first sample it is false.
        """
        rises = (node.op == "rise") is positive
        body = self._body(normal(node.body, 1 if rises else -1))
        before = self._body(normal(node.body, -1 if rises else 1))
        if body is None or before is None:
            return typed.Truth(node.span, True)
        op: _Op = "and" if positive else "or"
        return typed.Logic(node.span, op, (body, self._delayed(node, before, 1, before=not positive)))

    # --------------------------------------------------------------- windows that end earlier

    def _delayed(
        self,
        node: typed.Temporal | typed.Until | typed.Edge,
        body: typed.Formula,
        steps: int,
        *,
        before: bool,
    ) -> typed.Formula:
        """Return a formula that is true if `body` was true `steps` samples ago.

        One state is added per sample of delay. Before the start of the mission, the truth is `before`. `node`
        is the operator that needs the delay, for messages. If more than `REGISTER` states are needed, E309 is
        appended to `sink`.
        """
        if steps > REGISTER:
            return self._refused(node.span, f"that asks what was more than {REGISTER} samples ago")
        condition = self._condition(body)
        initial = float(before)
        known = cited(node.body if not isinstance(node, typed.Until) else node)
        about = f"whether {known} held at the sample before"
        draft = self._draft("latch", "before", initial, 1.0, about)
        latch = self.table.add(draft, lambda _own: choose(condition, _ONE, _ZERO))
        for ago in range(2, steps + 1):
            about = f"whether {known} held {ago} samples before"
            draft = self._draft("latch", "before", initial, 1.0, about)
            latch = self.table.add(draft, lambda _own, last=latch: last)  # type: ignore[misc]
        late = time_test(ir.Signal(ir.ELAPSED), ir.Const(float(steps)), node.span)
        first = typed.Logic(node.span, "or", (late, timer_test(latch, _ONE, node.span)))
        inside = typed.Shift(node.span, -steps, body, outside=True)
        return typed.Recalled(
            node.span,
            now=time_test(latch, _ONE, node.span),
            along=typed.Logic(node.span, "and", (inside, first)),
        )

    def _since_before(self, node: typed.Until, window: ir.Window, *, positive: bool) -> typed.Formula:
        """Rewrite `p since[a, b] q`, with a > 0, in terms of windows that end now.

        `node` is the operator, `window` its interval in samples. If `positive` is False, the negation of
        `node` is rewritten. The operator is true if `historically[0, a] p` is true now, and
        `p since[0, b - a] q` was true `a` samples ago.
        """
        lo, hi = window.lo, window.hi or 0
        recent = replace(node, interval=in_steps(ir.Window(0, hi - lo), node.span))
        ago = self._delayed(node, self._since(recent, positive=positive), lo, before=not positive)
        left = normal(node.left, 1 if positive else -1)
        held = self._throughout(left, node.span, ir.Window(0, lo), positive=positive)
        return typed.Logic(node.span, "and" if positive else "or", (self._window(held), ago))

    def _lasting(
        self, node: typed.Until, left: typed.Formula, right: typed.Formula, least: int, *, positive: bool
    ) -> typed.Formula:
        """Rewrite `p since[a, end] q`, with a > 0, by means of a timer.

        `node` is the operator, and `least` is a in samples. If `positive` is False, the negation of `node` is
        rewritten, and `left` and `right` are the negations of p and q. The timer starts at a sample at which
        p and q hold. It counts steps while p holds, and is reset when p fails.
        """
        p, q = self._condition(left), self._condition(right)
        held, met = (p, q) if positive else (p.negated, q.negated)
        from_there = f"{cited(node.right)} with {cited(node.left)} from there on"
        about = f"steps since the first {from_there}, up to {least}"
        draft = self._draft("timer", "lasting", 0.0, float(least), about)

        def update(own: ir.Signal) -> ir.Num:
            running = at_least(own, _ONE).select(_counted(own, least), choose(met, _ONE, _ZERO))
            return choose(held, running, _ZERO)

        age = self.table.add(draft, update)
        span, bound, few = node.span, ir.Const(float(least)), ir.Const(least - 1.0)
        first, elapsed = age.at_first, ir.Signal(ir.ELAPSED)
        after = first + elapsed
        throughout = self._throughout(left, span, positive=positive)
        inside = _since_inside(node, left, right, ir.Window(least, None), positive=positive)
        if not positive:
            tests = time_test(_ZERO, first, span), time_test(few, after, span)
            none = typed.Logic(span, "or", (throughout, *tests))
            now = typed.Logic(span, "or", (left, time_test(few, age, span)))
            return typed.Recalled(span, now=now, along=typed.Logic(span, "and", (inside, none)))
        tests = time_test(first, _ONE, span), time_test(after, bound, span)
        memory = typed.Logic(span, "and", (throughout, *tests))
        missing = (elapsed - bound).apply("min", -1.0)
        lacks = typed.Predicate(span, missing * MISSING, strict=False)
        now = typed.Logic(span, "and", (left, time_test(age, bound, span)))
        return typed.Recalled(span, now=now, along=typed.Logic(span, "or", (inside, memory, lacks)))

    # -------------------------------------------------------------------------- in common

    def _draft(self, kind: TimerKind, what: str, initial: float, high: float, about: str) -> Timer:
        return Timer(f"{self.name}_{what}", kind, initial, _ZERO, 0.0, high, about)

    def _throughout(
        self, body: typed.Formula, span: Span, window: ir.Window = _SO_FAR, *, positive: bool
    ) -> typed.Temporal:
        """Return `historically[window] body`, or `once[window] body` if not `positive`."""
        return typed.Temporal(span, "historically" if positive else "once", in_steps(window, span), body)

    def _condition(self, body: typed.Formula) -> ir.Formula:
        return tolerant(condition(body.timer_form(), flat=True))

    def _body(self, body: typed.Formula) -> typed.Formula | None:
        """Return `body`, the operand of a past operator, with the past operators inside it rewritten.

        The result is None, with E309 in `sink`, if `body` looks into the future.
        """
        rewritten = self.rewrite(body)
        if rewritten.is_state(augmented=True):
            return rewritten
        self._refused(body.span, "over a formula that looks ahead")
        return None

    def _refused(self, span: Span, why: str) -> typed.Formula:
        finding = Diagnostic(
            "E309",
            "this past operator would need the policy to remember more than a timer can hold",
            span,
            f"a past operator {why}",
            help=(
                f"windows that end now, or up to {REGISTER} samples ago, train: `once[0, 3 s] p` is a timer",
                "`stlc check` can judge this one on recorded traces",
            ),
        )
        tell(self.sink, finding)
        return typed.Truth(span, True)


def _counted(own: ir.Num, most: int) -> ir.Num:
    """Return the number `own + 1`, but at most `most`."""
    return (own + _ONE).apply("min", float(most))


def in_steps(window: ir.Window, span: Span, clock: Literal["now", "start"] = "now") -> typed.Interval:
    """Return a window as an interval in steps, from now or from the start of the mission (`clock`)."""
    hi = None if window.hi is None else typed.Time(steps=Fraction(window.hi), span=span)
    return typed.Interval(typed.Time(steps=Fraction(window.lo), span=span), hi, clock=clock, span=span)


def _since_inside(
    node: typed.Until, left: typed.Formula, right: typed.Formula, window: ir.Window, *, positive: bool
) -> typed.Formula:
    """Return `left since[window] right`, evaluated on the samples of the plan alone.

    If `positive` is False, return the negation of `(not left) since[window] (not right)` instead. `node` is
    the operator in the source.
    """
    interval = in_steps(window, node.span)
    if positive:
        return replace(node, interval=interval, left=left, right=right)
    left, right = (typed.Not(part.span, part) for part in (left, right))
    return typed.Not(node.span, replace(node, interval=interval, left=left, right=right))
