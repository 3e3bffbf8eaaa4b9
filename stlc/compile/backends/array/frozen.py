"""Evaluation of `freeze`: a formula that refers to signal values at the instant at which it is evaluated.

For example, `freeze a = x in eventually[0 s, 1 s] x > a` compares later values of `x` with the present value.
The value of `a` differs from instant to instant. So each instant gets its own copy of the signals. The copies
are stacked along the batch axis: signals `(time, batch)` become `(time, instants * batch)`. If the body (the
formula after `in`) reads only samples near the instant, only these samples are copied.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias, final

import numpy as np

from stlc.compile.backends.array.arith import ArrayProgram, inputs
from stlc.compile.backends.schedule import IndexRange, TraceDomain, reads, spanning, within
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach
from stlc.compile.namespace import Array, Ops

Env: TypeAlias = Mapping[str, Array]
Judge: TypeAlias = Callable[[ir.Formula, Env, IndexRange, TraceDomain], Array]
"""Values `(count, batch)` of a formula on columns `(time, batch)` at the instants of a run."""

_MOST = 1 << 22
"""Elements of one column that are copied at a time."""


@final
@dataclass(frozen=True, slots=True)
class Freezer:
    """Evaluator of `freeze` formulas on one trace.

    Attributes:
        domain: length of the trace, and treatment of instants beyond its last sample.
        env: signals of the trace, and values bound by enclosing `freeze` formulas.
        ops: array library of `env`.
        judge: function that evaluates a formula on given signals at given instants.
    """

    domain: TraceDomain
    env: Env
    ops: Ops
    judge: Judge

    def values(self, node: ir.Freeze, run: IndexRange) -> Array:
        """Robustness of a `freeze` formula at the instants `run`, `(count, batch)`."""
        reaches = [reads(num, self.domain) for _, num in node.bindings]
        reach = Reach(max(r.past for r in reaches), max(r.future for r in reaches))
        bound = within(reach, run, self.domain)
        if bound.count <= 0:
            parts = list(self._unbound(node, run))
        else:
            parts = [
                *self._unbound(node, IndexRange(run.start, bound.start - 1)),
                *self._bound(node, bound),
                *self._unbound(node, IndexRange(bound.last + 1, run.last)),
            ]
        return self.ops.cat(parts) if len(parts) > 1 else parts[0]

    def _unbound(self, node: ir.Freeze, run: IndexRange) -> Iterator[Array]:
        """Yield, in chunks, the robustness at the instants `run`, at which some bound value is undefined.

        A value that `freeze` binds is undefined if it needs samples outside the trace. A predicate that reads
        this value is unknown if the trace is open (continues beyond its last sample). Otherwise the predicate
        is false, and its negation is true.
        """
        if run.count <= 0:
            return
        known = {name: within(reads(num, self.domain), run, self.domain) for name, num in node.bindings}
        starts = {edge for its in known.values() for edge in (its.start, its.last + 1) if its.count > 0}
        edges = sorted({run.start, *starts, run.last + 1})
        for part in (IndexRange(start, stop - 1) for start, stop in pairwise(edges)):
            there = {name for name, its in known.items() if its.start <= part.start <= its.last}
            missing = frozenset(known) - there
            kept = tuple((name, num) for name, num in node.bindings if name in there)
            body = without(node.body, missing, self.domain)
            if kept:
                yield from self._bound(replace(node, bindings=kept, body=body), part)
            else:
                yield self.judge(body, self.env, part, self.domain)

    def _bound(self, node: ir.Freeze, run: IndexRange) -> Iterator[Array]:
        back, ahead = _neighbourhood(node.body)
        if run.count == 1 or math.isinf(back + ahead):
            yield from self._whole(node, run, back, ahead)
            return
        first = min(max(run.start, int(back)), run.last + 1)
        last = max(min(run.last, self.domain.samples - 1 - int(ahead)), first - 1)
        if first > run.start:
            yield from self._whole(node, IndexRange(run.start, first - 1), back, ahead)
        yield from self._near(node, IndexRange(first, last), int(back), int(ahead))
        if last < run.last:
            yield from self._whole(node, IndexRange(last + 1, run.last), back, ahead)

    def _near(self, node: ir.Freeze, run: IndexRange, back: int, ahead: int) -> Iterator[Array]:
        """Yield, in chunks, the robustness at the instants `run`, from copies of their neighbourhoods.

        The neighbourhood of an instant extends from `back` samples before the instant to `ahead` samples
        after the instant. Every neighbourhood must lie within the trace.
        """
        length = back + ahead + 1
        domain = replace(self.domain, samples=length, stop=None)
        for chunk in _chunks(run, max(_MOST // (length * self._batch), 1)):
            chosen = np.arange(chunk.start, chunk.last + 1)
            rows = np.arange(-back, ahead + 1)[:, None] + chosen
            env = {n: x[rows].reshape(length, -1) for n, x in self._columns_read(node).items()}
            env |= self._bound_values(node, chunk, length)
            yield self.judge(node.body, env, spanning(back, 1), domain).reshape(chunk.count, -1)

    def _whole(self, node: ir.Freeze, run: IndexRange, back: float, ahead: float) -> Iterator[Array]:
        """Yield, in chunks, the robustness at the instants `run`, whose neighbourhoods may leave the trace.

        The neighbourhood of an instant extends from `back` samples before the instant to `ahead` samples
        after the instant. A chunk is a group of consecutive instants. Each of them gets its own copy of all
        samples that the chunk needs.
        """
        ops, batch = self.ops, self._batch
        most, width = _MOST // batch, back + ahead
        if math.isinf(width):  # each instant has a copy of the whole trace
            size = most // self.domain.samples
        else:  # `size` instants have copies of size + width samples each: at most `most` in total
            size = int((math.sqrt(width * width + 4.0 * most) - width) / 2.0)
        for chunk in _chunks(run, max(size, 1)):
            start = max(chunk.start - back, 0)
            stop = min(chunk.last + ahead + 1, self.domain.samples)
            begin, length = int(start), int(stop) - int(start)
            blank = ops.full((1, chunk.count, 1), 0.0, self._like)
            env = {
                name: (x[begin : begin + length][:, None] + blank).reshape(length, -1)
                for name, x in self._columns_read(node).items()
            }
            env |= self._bound_values(node, chunk, length)
            ends = self.domain.stop
            domain = replace(self.domain, samples=length, stop=None if ends is None else ends - begin)
            there = self.judge(node.body, env, spanning(chunk.start - begin, chunk.count), domain)
            each = np.arange(chunk.count)
            yield there.reshape(chunk.count, chunk.count, batch)[each, each]

    def _bound_values(self, node: ir.Freeze, run: IndexRange, length: int) -> dict[str, Array]:
        """Values that `freeze` binds at each instant in `run`: name -> array `(length, run.count * batch)`.

        All `length` rows of an array are equal.
        """
        program = ArrayProgram(dict(node.bindings))
        found = program(inputs(program, self.env, run, self.ops), self.ops)
        blank = self.ops.full((length, run.count * self._batch), 0.0, self._like)
        rows = self.ops.full((run.count, self._batch), 0.0, self._like)
        return {name: blank + (value + rows).reshape(1, -1) for name, value in found.items()}

    def _columns_read(self, node: ir.Freeze) -> dict[str, Array]:
        """Arrays that the body of `node` reads: name -> signal, or value bound by an outer `freeze`.

        The body is the formula after `in`. If it reads no such array, the result is one arbitrary signal, so
        that the shape is known.
        """
        own = {name for name, _ in node.bindings}
        names = set(node.body.columns).union(*(each.frozen for each in node.body.numbers())) - own
        return {name: self.env[name] for name in names & self.env.keys() or list(self.env)[:1]}

    @property
    def _like(self) -> Array:
        return next(iter(self.env.values()))

    @property
    def _batch(self) -> int:
        return int(self._like.shape[1])


def _neighbourhood(body: ir.Formula) -> tuple[float, float]:
    """Numbers of samples that the formula `body` may read before and after its instant.

    A number is inf if all samples on that side of the instant may be read.
    """
    past, future = body.reach
    on_clock = any(isinstance(node, ir.AtStart) for node in body.walk())
    if on_clock or any(each.depends_on_ends for each in body.numbers()):
        return math.inf, math.inf
    back = any(isinstance(node, ir.Windowed) and node.back and node.window.hi is None for node in body.walk())
    return math.inf if back else past, math.inf if body.uses_end else future


def _chunks(run: IndexRange, size: int) -> Iterator[IndexRange]:
    for start in range(run.start, run.start + run.count, size):
        yield IndexRange(start, min(start + size - 1, run.last))


def without(body: ir.Formula, names: frozenset[str], domain: TraceDomain) -> ir.Formula:
    """Return `body` with a constant in place of each predicate that reads a value in `names`.

    The values in `names` are undefined. On an open trace (one that continues beyond its last sample) the
    constant is true if an upper bound is computed, and false if a lower bound is computed. On any other trace
    the constant is false for a predicate, and true for a negated predicate.
    """
    match body:
        case ir.Predicate(num, sign):
            if not num.frozen & names:
                return body
            return ir.Truth(domain.end == "upper" if domain.open else sign < 0, body.span)
        case ir.Freeze(bindings, inner):
            lost = {name for name, num in bindings if num.frozen & names}
            inner = without(inner, names - {name for name, _ in bindings} | lost, domain)
            kept = tuple((name, num) for name, num in bindings if name not in lost)
            return replace(body, bindings=kept, body=inner) if kept else inner
        case _:
            return body.map_children(formulas=lambda part: without(part, names, domain))
