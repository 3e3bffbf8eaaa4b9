"""Exact extrema over sliding windows, in a number of passes that does not depend on the width.

Rows are cut into blocks as long as the window is wide (van Herk; Gil and Werman). Every window is the end of
one block and the beginning of the next, and both are running extrema. `until` is put together likewise.
Arrays are `(time, batch)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias, final

from stlc.compile.backends.array.extremum import Pick, Sliding, dual, neutral
from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.backends.array.scans import chooser, running, running_until
from stlc.compile.backends.array.scratch import Scratch, scratch

Operands: TypeAlias = tuple[Array, Array]
"""Left and right operand of `until`."""


@final
@dataclass(frozen=True, slots=True)
class Asked:
    """Which extrema of which windows, on which array library; "max" asks for `until`, "min" for `release`."""

    pick: Pick
    window: Sliding
    ops: Ops

    @property
    def other(self) -> Pick:
        """The dual extremum."""
        return dual(self.pick)


def extrema(x: Array, asked: Asked) -> Array:
    """`(time, batch)` -> `(count, batch)`."""
    window, batch, ops = asked.window, x.shape[1], asked.ops
    if window.to_end:
        return to_end(x, asked)[: window.count]
    out = ops.empty((window.count, batch), x)
    with scratch(2 * window.numbers(batch, 2), x, ops) as memory:
        for part in window.chunks(batch, 2):
            memory.clear()
            tails, heads = tails_and_heads(x[:, part], asked, memory)
            chooser(asked.pick, ops)(starts(tails, window), stops(heads, window), out=out[:, part])
    return out


def until(left: Array, right: Array, asked: Asked) -> Array:
    """Two of `(time, batch)` -> `(count, batch)`."""
    window, batch, ops = asked.window, left.shape[1], asked.ops
    out = ops.empty((window.count, batch), left)
    with scratch(5 * window.numbers(batch, 3), left, ops) as memory:
        for part in window.chunks(batch, 3):
            memory.clear()
            operands = left[:, part], right[:, part]
            held, met = held_and_met(operands, asked, memory)
            if window.to_end:
                out[:, part] = starts(met, window)
                continue
            _, _, reach = heads_then_and_reach(operands, asked, memory)
            later = starts(held, window)
            chooser(asked.other, ops)(later, stops(reach, window), out=later)
            chooser(asked.pick, ops)(starts(met, window), later, out=out[:, part])
    return out


def flat(blocks: Array) -> Array:
    """The view `(time, batch)` of blocks."""
    return blocks.reshape(-1, blocks.shape[2])


def starts(blocks: Array, window: Sliding) -> Array:
    """A view of the first row of every window."""
    return flat(blocks)[: window.count]


def stops(blocks: Array, window: Sliding) -> Array:
    """A view of the last row of every window."""
    return flat(blocks)[window.width - 1 : window.width - 1 + window.count]


def to_end(x: Array, asked: Asked) -> Array:
    """From every row to the last one: `(time, batch)`."""
    out = asked.ops.empty(tuple(x.shape), x)
    out[:] = x
    running(out[None], asked.pick, asked.ops, behind=True)
    return out


def tails_and_heads(x: Array, asked: Asked, memory: Scratch) -> tuple[Array, Array]:
    """From every row to the end of its block, and from the beginning of its block to every row."""
    tails = _loaded(x, asked.window, neutral(asked.pick), memory)
    heads = _loaded(x, asked.window, neutral(asked.pick), memory)
    running(tails, asked.pick, asked.ops, behind=True)
    running(heads, asked.pick, asked.ops, behind=False)
    return tails, heads


def held_and_met(operands: Operands, asked: Asked, memory: Scratch) -> tuple[Array, Array]:
    """From every row to the end of its block: `left` throughout, and `until`."""
    held = _loaded(operands[0], asked.window, neutral(asked.other), memory)
    met = _loaded(operands[1], asked.window, neutral(asked.pick), memory)
    running_until(held, met, asked.pick, asked.ops)
    return held, met


def heads_then_and_reach(operands: Operands, asked: Asked, memory: Scratch) -> tuple[Array, Array, Array]:
    """From the beginning of a block: `left` up to a row, `right` there too, and that at any row so far."""
    heads = _loaded(operands[0], asked.window, neutral(asked.other), memory)
    running(heads, asked.other, asked.ops, behind=False)
    then = _loaded(operands[1], asked.window, neutral(asked.pick), memory)
    chooser(asked.other, asked.ops)(then, heads, out=then)
    reach = memory.take(*then.shape)
    reach[:] = then
    running(reach, asked.pick, asked.ops, behind=False)
    return heads, then, reach


def _loaded(x: Array, window: Sliding, fill: float, memory: Scratch) -> Array:
    """A copy of what the windows see, `(blocks, time, batch)`, with `fill` for absent rows."""
    blocks, length = window.shape
    out = memory.take(blocks * length, x.shape[1])
    rows = min(len(x), len(out))
    out[:rows] = x[:rows]
    out[rows:] = fill
    return out.reshape(blocks, length, x.shape[1])
