"""Obligations of a requirement that a recording never put to the test.

A requirement is walked from its root as written, with the instants at which each part has to hold. The right
side of an implication has to hold where its left side does; the operand of `always` throughout its window.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.monitor.judgement import RequirementVerdict
from stlc.monitor.prepared import Part, Prepared
from stlc.monitor.uncertain import outer
from stlc.monitor.values import bounds, by_truth
from stlc.source import Span

Bools = NDArray[np.bool_]
_OUTWARD = ("always", "historically", "release")


@dataclass(frozen=True, slots=True)
class Trigger:
    """Part of a requirement whose obligation depends on what the recording holds.

    Attributes:
        span: the part that triggers it: the left side of an implication, or the whole operator.
        at: instants at which it has to hold, (samples, traces) or (samples, 1).
        hits: instants among them at which there is an obligation beyond the present sample, (samples,
            traces).
        kind: "triggered" for implications and `until`; "at once" for `eventually`, which a present sample
            may satisfy.
    """

    span: Span
    at: Bools
    hits: Bools
    kind: str = "triggered"


def triggers(judged: RequirementVerdict, subject: Prepared) -> Iterator[Trigger]:
    """Yield the obligations of a requirement that depend on what the recording holds."""
    part = judged.part
    at = np.zeros((subject.record.samples, 1), dtype=bool)
    at[judged.start : judged.start + judged.instants] = True
    yield from _Walk(subject, part).visit(judged.rule.typed.formula, at)


@dataclass(frozen=True, slots=True)
class _Walk:
    subject: Prepared
    part: Part

    def visit(self, node: typed.Formula, at: Bools) -> Iterator[Trigger]:
        """Yield the obligations of a formula that has to hold at the instants `at`."""
        if not at.any():
            return
        if (operator := node.temporal) is not None:
            yield from self.visit_temporal(operator, at)
        elif node.word == "->":
            left, right = node.operands
            if (held := self.held(left)) is not None:
                yield Trigger(left.span, at, at & held)
                yield from self.visit(right, at & held)
        elif node.word in ("and", "freeze"):
            for item in node.operands:
                yield from self.visit(item, at)

    def visit_temporal(self, node: typed.Timed, at: Bools) -> Iterator[Trigger]:
        """Yield the obligations of a temporal operator that has to hold at the instants `at`."""
        first, last = node.operands[0], node.operands[-1]
        match node.op:
            case "always" | "historically":
                yield from self.visit(last, self.window(node, at))
            case "eventually" if (held := self.held(last, surely=True)) is not None:
                lo = self.steps(node).lo
                if not node.on_clock and lo < len(held):
                    there = np.zeros_like(held)
                    there[: len(held) - lo] = held[lo:]
                    yield Trigger(node.span, at, at & ~there, "at once")
            case "until" | "unless" | "release":
                ends = self.held(first if node.op == "release" else last, surely=True)
                if not node.on_clock and not self.steps(node).lo and ends is not None:
                    yield Trigger(node.span, at, at & ~ends)
            case _:
                return

    def steps(self, node: typed.Timed) -> ir.Window:
        """Return the interval of an operator in samples."""
        return self.subject.compiled.grid.window(node.interval, [], outward=node.op in _OUTWARD)

    def window(self, node: typed.Timed, at: Bools) -> Bools:
        """Return the instants in the windows of `always` or `historically` that begin at `at`."""
        steps, samples = self.steps(node), len(at)
        if node.on_clock:
            first = np.zeros_like(at[:1])
            first[0] = at.any(axis=0)
            at = np.concatenate([first, np.zeros_like(at[1:])])
        if node.op == "always" and steps.hi is None:
            first = np.where(at.any(axis=0), at.argmax(axis=0) + steps.lo, samples)
            return self.inside(np.arange(samples)[:, None] >= first)
        forward = at if node.op == "always" else at[::-1]
        edges = np.zeros(at.shape, dtype=np.int32)
        if steps.lo < samples:
            edges[steps.lo :] += forward[: samples - steps.lo]
        if steps.hi is not None and steps.hi + 1 < samples:
            edges[steps.hi + 1 :] -= forward[: samples - steps.hi - 1]
        within = np.cumsum(edges, axis=0) > 0
        return self.inside(within if node.op == "always" else within[::-1])

    def inside(self, instants: Bools) -> Bools:
        """Return the instants without those outside of the part that is judged."""
        instants[: self.part.first] = False
        instants[self.part.stop :] = False
        return instants

    def held(self, node: typed.Formula, *, surely: bool = False) -> Bools | None:
        """Instants at which a formula may hold, or surely does, (samples, traces).

        None if it reads a frozen value, or a signal that makes no difference to the requirement.
        """
        if node.frozen:
            return None
        written = node.from_first_sample() if node.absolute else node
        formula = by_truth(simplify(self.subject.compiled.grid.lower(written, [])))
        if not formula.columns <= self.subject.record.env.keys():
            return None
        record = self.subject.record.of_cells(formula, loose=False)
        low, high = outer(*bounds(formula, record, range(record.samples), "truncate"))
        return np.asarray((low if surely else high) > 0)
