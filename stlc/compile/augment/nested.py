"""Absolute operators (`always@[a, b]`) with future operators inside, rewritten with past operators inside.

The interval of an absolute operator counts from the start of the mission. Example: `eventually@[a, b]
always[0, c] p` is true if and only if, at some sample from a + c to b + c, p has held since c samples ago.
The rewritten formula thus refers to the sample at which the inner formula is decided. At this sample, only
memory of the past is needed: one timer per window. If the parts of a formula are decided at different
samples, the truth of the earlier parts is stored until the last part is decided. This takes one state per
sample of delay.

In the example, the window of `always[0, c] p` must begin no later than b. If the formula is still undecided
at b, it is violated as soon as p fails. The rewritten formula has the form `left until@ right`. Its left side
becomes false as soon as p fails, not only at b + c. The method is that of Maler, Nickovic and Pnueli, "Real
time temporal logic: past, present, future" (2005).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias, final

from stlc.compile.augment.mission import typed_inside
from stlc.compile.augment.past import REGISTER, in_steps
from stlc.compile.augment.timers import TimerTable, time_test
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.normal_form import normal
from stlc.diagnostics import Diagnostic
from stlc.source import Span

_LONGEST = 32
"""Maximum length in samples of an `until` below other operators, which is expanded sample by sample."""

_Wide: TypeAlias = Literal["always", "eventually", "once", "historically"]
Formulas: TypeAlias = tuple[typed.Formula, ...]


class TooFarError(Exception):
    """A formula needs unbounded lookahead or too much memory of the past; the message says why."""

    def __init__(self, span: Span, why: str) -> None:
        super().__init__(why)
        self.span = span


def looks_ahead(formula: typed.Formula) -> bool:
    """True if `formula` has a future operator."""
    return any(map(_forwards, formula.walk()))


def _forwards(node: typed.Formula) -> bool:
    """True if the outermost operator of a formula is a future operator."""
    match node:
        case typed.Temporal(_, op):
            return op in ("always", "eventually")
        case typed.Until(_, op):
            return op != "since"
        case typed.Shift(_, steps):
            return steps > 0
        case _:
            return False


def in_past_form(
    formula: typed.Formula, grid: Grid, table: TimerTable, sink: list[Diagnostic]
) -> typed.Formula:
    """Rewrite a formula so that the operands of its absolute operators contain only past operators.

    Args:
        formula: formula in negation normal form. It consists of operators that are evaluated at the start of
            the mission, absolute (`always@[a, b]`) or relative (`always[a, b]`), joined by `and` and `or`.
        grid: time step and horizon.
        table: table of added states. The mission clock (steps since the start of the mission) is added to it
            if the rewritten formula reads the clock.
        sink: list to which findings about interval bounds are appended.

    Raises:
        TooFarError: an operand has unbounded lookahead, or an unsupported operator.
    """
    match formula:
        case typed.Logic(_, _, items):
            return replace(formula, items=tuple(in_past_form(item, grid, table, sink) for item in items))
        case typed.Temporal(_, "always" | "eventually" as op, interval, body) if looks_ahead(body):
            window = grid.window(interval, sink, outward=op == "always")
            body = _on_grid(body, grid, sink)
            writer = _Writer(table, formula.span, soon=op == "eventually")
            if op == "eventually":
                return writer.met(window, (), body)
            return normal(writer.met(window, (), normal(body, -1)), -1)
        case typed.Until(_, "until" | "release" as op, interval, left, right) if looks_ahead(
            left
        ) or looks_ahead(right):
            window = grid.window(interval, sink, outward=op == "release")
            left, right = _on_grid(left, grid, sink), _on_grid(right, grid, sink)
            writer = _Writer(table, formula.span, soon=op == "until")
            if op == "until":
                return writer.until(window, left, right)
            return normal(writer.until(window, normal(left, -1), normal(right, -1)), -1)
        case _:
            return formula


# ------------------------------------------------------------------- windows in samples


def _on_grid(
    formula: typed.Formula, grid: Grid, sink: list[Diagnostic], *, negated: bool = False
) -> typed.Formula:
    """Return a formula with the bounds of its intervals in whole samples.

    A bound between two samples is rounded so that the result implies the formula as written. `negated`:
    whether the formula is the operand of a `not`, which reverses the rounding of `since`.
    """
    match formula:
        case typed.Logic(_, _, items):
            return replace(formula, items=tuple(_on_grid(item, grid, sink) for item in items))
        case typed.Shift(span, 1, body):
            return _next(span, _on_grid(normal(body), grid, sink))
        case typed.Not(_, typed.Shift(span, 1, body)):
            return _next(span, _on_grid(normal(body, -1), grid, sink))
        case typed.Not(_, body):
            return replace(formula, body=_on_grid(body, grid, sink, negated=True))
        case typed.Temporal(_, op, interval, body):
            window = grid.window(interval, sink, outward=op in ("always", "historically"))
            return replace(formula, interval=in_steps(window, formula.span), body=_on_grid(body, grid, sink))
        case typed.Until(_, op, interval, left, right):
            window = grid.window(interval, sink, outward=op == "release" or negated)
            left, right = (_on_grid(part, grid, sink) for part in (left, right))
            return replace(formula, interval=in_steps(window, formula.span), left=left, right=right)
        case _:
            return formula


def _next(span: Span, body: typed.Formula) -> typed.Formula:
    """Return `next(body)` as `always` with the window [1, 1]; in a mission there is always a next sample."""
    return typed.Temporal(span, "always", in_steps(ir.Window(1, 1), span), body)


def _window(node: typed.Temporal | typed.Until) -> ir.Window:
    """Return the window of an operator whose bounds are whole numbers of samples."""
    lo, hi = node.interval.lo, node.interval.hi
    return ir.Window(int(lo.steps), None if hi is None else int(hi.steps))


def _sum(window: ir.Window, lo: int, hi: int | None) -> ir.Window:
    return ir.Window(window.lo + lo, None if window.hi is None or hi is None else window.hi + hi)


def _ahead(formula: typed.Formula) -> int:
    """Return the lookahead of a formula in samples.

    Raises:
        TooFarError: the lookahead is unbounded.
    """
    if isinstance(formula, _OPAQUE):
        return 0
    inner = max(map(_ahead, formula.operands), default=0)
    return inner + _end(formula) if _forwards(formula) else inner  # type: ignore[arg-type]


_OPAQUE = (typed.Shift, typed.Edge, typed.Freeze, typed.Recalled)
"""Formulas that cannot be stated in terms of the past; their operands are not visited."""


def _end(node: typed.Temporal | typed.Until) -> int:
    """Return the end of an operator's window in samples.

    Raises:
        TooFarError: the window extends to the end of the trace.
    """
    hi = _window(node).hi
    if hi is None:
        raise TooFarError(node.span, "a window to the end of the trace")
    return hi


# ------------------------------------------------------------------------ the rewriting


@final
class _Writer:
    """Rewriter that replaces the future operators in one absolute operator by past operators.

    An absolute operator, such as `eventually@[a, b]`, has an interval that counts from the start of the
    mission.

    Args:
        table: table of added states, which provides the mission clock (steps since the start of the mission).
        span: source location of the absolute operator.
        soon: if True, the rewritten formula is an `until@`, whose left side becomes false as soon as a
            violation is certain; if False, a violation is detected only at the deadline.
    """

    def __init__(self, table: TimerTable, span: Span, *, soon: bool) -> None:
        self._table, self._span, self._soon = table, span, soon

    def met(self, window: ir.Window, when: Formulas, what: typed.Formula) -> typed.Formula:
        """Return `eventually@[window] (when and what)`, rewritten with past operators only.

        All formulas in `when` must hold at the sample at which `what` holds; they look only into the past.
        If `what` looks n samples ahead, it is decided n samples later. The result is therefore evaluated n
        samples later: its window is shifted by n, and its operands look back from there.
        """
        if not looks_ahead(what):
            return self._on_clock("eventually", window, self._and(*when, what))
        match what:
            case typed.Logic(_, "or", items):
                return self._or(*(self.met(window, when, item) for item in items))
            case typed.Logic(_, "and", items):
                return self._all(window, when, items)
            case typed.Temporal(_, "eventually", _, body):
                inner = _window(what)
                later = _sum(window, inner.lo, inner.hi)
                known = (self._past("once", inner, self._begun(window, when)),) if when else ()
                return self.met(later, known, body)
            case typed.Temporal(_, "always", _, body):
                _end(what)
                return self._lasting(window, when, _window(what), body)
            case typed.Until(_, "until", _, left, right):
                return self._reached(window, when, _window(what), left, right)
            case typed.Until(_, "release", _, left, right):
                return self.met(window, when, self._freed(what, left, right))
            case _:
                raise TooFarError(what.span, "not something that the past can tell")

    def until(self, window: ir.Window, left: typed.Formula, right: typed.Formula) -> typed.Formula:
        """Return `left until@[window] right`, rewritten with past operators only.

        The window counts from the start of the mission (`@`). Both operands are delayed to the sample at
        which both are decided, and the window is shifted by the same number of samples.
        """
        late = max(_ahead(left), _ahead(right))
        known = self._or(self._until_step(late - 1), self.delayed(left, late))
        return self._on_clock_until(_sum(window, late, late), known, self.delayed(right, late))

    def _all(self, window: ir.Window, when: Formulas, items: Formulas) -> typed.Formula:
        """Return `eventually@[window] (when and items)`, rewritten with past operators only.

        All formulas in `when` and in `items` must hold at the same sample. Those in `when` look only into the
        past.
        """
        later = [item for item in items if looks_ahead(item)]
        known = (*when, *(item for item in items if not looks_ahead(item)))
        if len(later) == 1:
            return self.met(window, known, later[0])
        whole = self._and(*known, *later)
        late = _ahead(whole)
        return self._on_clock("eventually", _sum(window, late, late), self.delayed(whole, late))

    def _lasting(
        self, window: ir.Window, when: Formulas, what: ir.Window, body: typed.Formula
    ) -> typed.Formula:
        """Return `eventually@[window] (when and always[what] body)`, rewritten with past operators only.

        All formulas in `when` must hold; they look only into the past.
        """
        lo, hi = what.lo, what.hi or 0
        late = _ahead(body)
        body = self.delayed(body, late)
        lo, hi = lo + late, hi + late
        there = _sum(window, hi, hi)
        if not when:
            held = self._past("historically", ir.Window(0, hi - lo), body)
            if not self._soon:
                return self._on_clock("eventually", there, held)
            latest = self._until_step(None if window.hi is None else window.hi + lo - 1)
            return self._on_clock_until(there, self._or(latest, body), held)
        begun = self._ago(self._begun(window, when), lo)
        lasting = self._since(ir.Window(hi - lo, None), body, begun)
        if not self._soon:
            return self._on_clock("eventually", there, lasting)
        latest = self._until_step(None if window.hi is None else window.hi + lo)
        pending = self._since(ir.Window(0, None), body, begun)
        return self._on_clock_until(there, self._or(latest, pending), lasting)

    def _reached(
        self, window: ir.Window, when: Formulas, inner: ir.Window, left: typed.Formula, right: typed.Formula
    ) -> typed.Formula:
        """Rewrite `eventually@[window] (when and left until[inner] right)` with past operators only.

        All formulas in `when` must hold; they look only into the past.
        """
        late = max(_ahead(left), _ahead(right))
        left, right = self.delayed(left, late), self.delayed(right, late)
        begun = self._ago(self._begun(window, when), late) if when else None
        window = _sum(window, late, late)
        there = _sum(window, inner.lo, inner.hi)
        if begun is None:
            met = self._and(right, self._past("historically", ir.Window(0, inner.lo), left))
            latest = self._until_step(None if window.hi is None else window.hi - 1)
            return self._on_clock_until(there, self._or(latest, left), met)
        met = self._and(right, self._since(inner, left, begun))
        if not self._soon:
            return self._on_clock("eventually", there, met)
        latest = self._until_step(window.hi)
        pending = self._since(ir.Window(0, inner.hi), left, begun)
        return self._on_clock_until(there, self._or(latest, pending), met)

    def _freed(self, node: typed.Until, left: typed.Formula, right: typed.Formula) -> typed.Formula:
        """Rewrite `left release[l, u] right` as a disjunction of three cases.

        First case: `right` holds throughout the window. Second case: `left` holds at some sample up to l.
        Third case: `right` holds from l on, until `left` holds at a sample of the window.
        """
        window, span = _window(node), node.span
        hi = _end(node)
        always = typed.Temporal(span, "always", node.interval, right)
        before = typed.Temporal(span, "eventually", in_steps(ir.Window(0, window.lo), span), left)
        inside = typed.Until(
            span, "until", in_steps(ir.Window(0, hi - window.lo), span), self._or(left, right), left
        )
        at = in_steps(ir.Window(window.lo, window.lo), span)
        return self._or(always, before, typed.Temporal(span, "eventually", at, inside))

    # ------------------------------------------------------------------ formulas delayed in time

    def delayed(self, formula: typed.Formula, steps: int) -> typed.Formula:
        """Return a past formula that is true if `formula` was true `steps` samples ago.

        `formula` looks at most `steps` samples ahead. So the samples up to now decide whether it was true.
        """
        if not looks_ahead(formula):
            return self._ago(formula, steps)
        match formula:
            case typed.Logic(_, _, items):
                return replace(formula, items=tuple(self.delayed(item, steps) for item in items))
            case typed.Temporal(_, "always" | "eventually" as op, _, body):
                window, late, end = _window(formula), _ahead(body), _end(formula)
                back: _Wide = "historically" if op == "always" else "once"
                seen = self._past(back, ir.Window(0, end - window.lo), self.delayed(body, late))
                return self._ago(seen, steps - end - late)
            case typed.Until(_, "until" | "release", _, left, right):
                return self._written_out(formula, left, right, steps)
            case _:
                raise TooFarError(formula.span, "not something that the past can tell")

    def _written_out(
        self, node: typed.Until, left: typed.Formula, right: typed.Formula, steps: int
    ) -> typed.Formula:
        """Return a past formula that is true if an `until` or `release` was true `steps` samples ago.

        The operator is expanded sample by sample.

        Raises:
            TooFarError: the window of `node` is longer than `_LONGEST` samples.
        """
        window, end, strong = _window(node), _end(node), node.op == "until"
        if end > _LONGEST:
            raise TooFarError(
                node.span, f"an `{node.op}` of more than {_LONGEST} samples below other operators"
            )
        one, two = (self._and, self._or) if strong else (self._or, self._and)
        whole = one(self.delayed(left, steps - end), self.delayed(right, steps - end))
        for turn in range(end - 1, -1, -1):
            ago = steps - turn
            met = two(self.delayed(right, ago), whole) if turn >= window.lo else whole
            whole = one(self.delayed(left, ago), met)
        return whole

    # --------------------------------------------------------------- constructors of nodes

    def _and(self, *items: typed.Formula) -> typed.Formula:
        return items[0] if len(items) == 1 else typed.Logic(self._span, "and", items)

    def _or(self, *items: typed.Formula) -> typed.Formula:
        kept = tuple(item for item in items if not (isinstance(item, typed.Truth) and not item.value))
        return kept[0] if len(kept) == 1 else typed.Logic(self._span, "or", kept)

    def _begun(self, window: ir.Window, when: Formulas) -> typed.Formula:
        """Return a formula that holds if all of `when` hold and the mission clock is within `window`.

        The mission clock counts the steps since the start of the mission.
        """
        if window == ir.Window(0, None):
            return self._and(*when)
        clock = self._table.clock((window.lo if window.hi is None else window.hi) + 1)
        return self._and(*when, typed_inside(window, clock, self._span))

    def _until_step(self, step: int | None) -> typed.Formula:
        """Return a formula that holds up to and including step `step` of the mission.

        If `step` is None, the formula always holds.
        """
        if step is None or step < 0:
            return typed.Truth(self._span, step is None)
        return time_test(ir.Const(float(step)), self._table.clock(step + 1), self._span)

    def _on_clock(self, op: _Wide, window: ir.Window, body: typed.Formula) -> typed.Formula:
        return typed.Temporal(self._span, op, in_steps(window, self._span, "start"), body)

    def _on_clock_until(self, window: ir.Window, left: typed.Formula, right: typed.Formula) -> typed.Formula:
        if isinstance(left, typed.Logic) and any(isinstance(item, typed.Truth) for item in left.items):
            return self._on_clock("eventually", window, right)
        return typed.Until(self._span, "until", in_steps(window, self._span, "start"), left, right)

    def _past(self, op: _Wide, window: ir.Window, body: typed.Formula) -> typed.Formula:
        if window == ir.Window(0, 0):
            return body
        self._require_memory(window.lo)
        return typed.Temporal(self._span, op, in_steps(window, self._span), body)

    def _ago(self, body: typed.Formula, steps: int) -> typed.Formula:
        return self._past("once", ir.Window(steps, steps), body)

    def _since(self, window: ir.Window, left: typed.Formula, right: typed.Formula) -> typed.Formula:
        if window.hi is not None:
            self._require_memory(window.lo)
        return typed.Until(self._span, "since", in_steps(window, self._span), left, right)

    def _require_memory(self, steps: int) -> None:
        if steps > REGISTER:
            why = f"a part is kept for {steps} samples until the rest is known: at most {REGISTER}"
            raise TooFarError(self._span, why)
