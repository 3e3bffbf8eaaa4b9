"""Operators of the past become timers, so that a plan knows what was before it.

A timer holds the time up to the sample before: `historically[0, c] p` is `p and held >= c`, `once[0, c] p` is
`p or since_p <= c`. At the start of a mission nothing was before: windows of the past are cut there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

from stlc.compile import ir, typed
from stlc.compile.bounds import report, to_window
from stlc.compile.interface import Grid
from stlc.compile.lower import lower
from stlc.compile.simplify import simplify
from stlc.compile.timers import Kind, Ledger, Timer, choose, denied, guard, tolerant
from stlc.compile.walk import Sign, flip, is_state_formula, looks_back, normal
from stlc.diagnostics import Diagnostic
from stlc.source import Span

_ZERO, _ONE = ir.Lit(0.0), ir.Lit(1.0)


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
        test = self._seen(node, body, window.hi) if once else self._held(node, body, window.hi)
        return typed.Logic(node.span, "or" if once else "and", (body, test))

    def _seen(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Formula:
        """Whether `body` held at one of the `most` samples before."""
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "seen", 0.0, 1.0, f"whether {_short(node.body)} ever held")
            seen = self.ledger.add(draft, lambda own: choose(condition, _ONE, own))
            return guard(seen, _ONE, node.span)
        about = f"steps since {_short(node.body)} last held, up to {most}"
        draft = self._draft("timer", "since", most + 1.0, most + 1.0, about)
        since = self.ledger.add(draft, lambda own: choose(condition, _ONE, _counted(own, most + 1)))
        return guard(ir.Lit(float(most)), since, node.span)

    def _held(self, node: typed.Temporal, body: typed.Formula, most: int | None) -> typed.Formula:
        """Whether `body` held at all of the `most` samples before."""
        condition = self._condition(body)
        if most is None:
            draft = self._draft("latch", "kept", 1.0, 1.0, f"whether {_short(node.body)} always held")
            kept = self.ledger.add(draft, lambda own: choose(condition, own, _ZERO))
            return guard(kept, _ONE, node.span)
        about = f"steps for which {_short(node.body)} has held, up to {most}"
        draft = self._draft("timer", "held", float(most), float(most), about)
        held = self.ledger.add(draft, lambda own: choose(condition, _counted(own, most), _ZERO))
        return guard(held, ir.Lit(float(most)), node.span)

    # ------------------------------------------------------------------------------ since

    def _since(self, node: typed.Until, *, positive: bool) -> typed.Formula:
        """`p since[0, c] q`: p now, and q now or so lately that p has held from there on; or its dual."""
        sign: Sign = 1 if positive else -1
        left, right = self._body(normal(node.left, sign)), self._body(normal(node.right, sign))
        window = self._ending_now(node, outward=not positive)
        if left is None or right is None or window is None:
            return typed.Truth(node.span, True)
        both = typed.Logic(node.span, "and" if positive else "or", (left, right))
        if window.hi == 0:
            return both
        recent = self._recent(node, self._condition(left), self._condition(right), (window.hi, positive))
        if positive:
            begun = typed.Logic(node.span, "or", (right, recent))
            return typed.Logic(node.span, "and", (left, begun))
        begun = typed.Logic(node.span, "and", (right, typed.Not(node.span, recent)))
        return typed.Logic(node.span, "or", (left, begun))

    def _recent(
        self, node: typed.Until, left: ir.Formula, right: ir.Formula, how: tuple[int | None, bool]
    ) -> typed.Formula:
        """Whether q held at one of the samples before, and p from there on up to the sample before."""
        most, positive = how
        held, met = (left, right) if positive else (denied(left), denied(right))
        about = f"{_short(node.right)}, and {_short(node.left)} from there on"
        if most is None:
            draft = self._draft("latch", "since", 0.0, 1.0, f"whether there was {about}")
            begun = self.ledger.add(draft, lambda own: choose(held, choose(met, _ONE, own), _ZERO))
            return guard(begun, _ONE, node.span)
        far = ir.Lit(most + 1.0)
        draft = self._draft("timer", "since", far.value, far.value, f"steps since {about}, up to {most}")
        since = self.ledger.add(
            draft, lambda own: choose(held, choose(met, _ONE, _counted(own, most + 1)), far)
        )
        return guard(ir.Lit(float(most)), since, node.span)

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
        test = guard(latch, _ONE, node.span)
        return typed.Logic(node.span, "and" if positive else "or", (body, test))

    # -------------------------------------------------------------------------- in common

    def _draft(self, kind: Kind, what: str, initial: float, high: float, about: str) -> Timer:
        return Timer(f"{self.name}_{what}", kind, initial, _ZERO, 0.0, high, about)

    def _condition(self, body: typed.Formula) -> ir.Formula:
        return tolerant(simplify(lower(body, self.grid, self.sink)))

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
