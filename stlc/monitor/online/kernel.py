"""Monitor of streams in C (`stlc.compile.backends.c.streams`), loaded into this process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, final

import numpy as np

from stlc import native
from stlc.compile.backends.c.streams import SIZES, TABLES, Rule, Streams, runtime, streams_of
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.ir import nodes as ir
from stlc.compile.pipeline import CompiledRequirement
from stlc.monitor.instants import beyond, window_of
from stlc.monitor.online.history import Floats
from stlc.monitor.online.tally import Asked, JudgedInstants, RequirementSummary
from stlc.monitor.signals import Gap

_MOST = 1 << 32
"""Greatest size of the state in bytes."""


class _Tables(ctypes.Structure):
    """The structure `tables` of `streams.c`."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in (*TABLES.values(), "predicates")),
        *((name, ctypes.c_int32) for name in SIZES),
    )


_TYPES = {"q": ctypes.c_int64, "p": ctypes.c_void_p, "i": ctypes.c_int32, "d": ctypes.c_double, "-": None}

_FUNCTIONS = {
    "stlc_size": "qp",
    "stlc_place": "-pp",
    "stlc_init": "-piqiid",
    "stlc_block": "qppqip",
    "stlc_look": "-piiiqqp",
    "stlc_news": "qppq",
    "stlc_tally": "-pipp",
    "stlc_gap": "-pip",
}
"""Function of `streams.c` -> types of its result and of its arguments."""


@lru_cache(maxsize=256)
def _library(text: str) -> ctypes.CDLL | None:
    """Library of C text after the types of `streams.c`, which takes milliseconds to find on the disk."""
    return native.load(f"#define REAL double\n#define API\n{runtime()[0]}{text}")


@cache
def _transducers() -> ctypes.CDLL | None:
    """Library of the transducers of all monitors."""
    library = _library(runtime()[1])
    for name, types in _FUNCTIONS.items() if library else ():
        function = getattr(library, name)
        function.restype, *function.argtypes = map(_TYPES.get, types)
    return library


class StreamKernel:
    """Compiled monitor of several requirements, with its state.

    Args:
        library: the transducers.
        program: tables of the monitor.
        predicates: library of its predicates.
        asked: the requirements.
    """

    def __init__(
        self, library: ctypes.CDLL, program: Streams, predicates: ctypes.CDLL, asked: Sequence[Asked]
    ) -> None:
        self.library, self._predicates = library, predicates
        self._arrays = {
            name: np.array([number for row in rows for number in row] or [0], np.int32)
            for name, rows in program.tables.items()
        }
        places = {name: array.ctypes.data for name, array in self._arrays.items()}
        function = ctypes.cast(predicates.predicates, ctypes.c_void_p)
        self._tables = _Tables(**places, predicates=function, **program.sizes)
        self.program = ctypes.addressof(self._tables)
        size = library.stlc_size(self.program)
        if size > _MOST:
            raise MemoryError
        self.state = np.zeros(size // 8 + 1)
        self.at = self.state.ctypes.data
        self._known = ctypes.c_int64.from_address(self.at + 8)  # `s.known`, after a pointer
        library.stlc_place(self.at, self.program)
        self._row = (ctypes.c_double * program.sizes["signals"])()
        self._step = library.stlc_step
        self._arguments = (ctypes.c_void_p(self.at), ctypes.cast(self._row, ctypes.c_void_p))
        for rule, each in enumerate(asked):
            cut = each.ending == "truncate"
            library.stlc_init(self.at, rule, each.begin, each.everywhere, cut, each.tolerance)

    @property
    def samples(self) -> int:
        """Number of samples received."""
        return self._known.value

    @staticmethod
    def of(asked: Sequence[Asked], rules: Sequence[Rule], signals: Sequence[str]) -> StreamKernel | None:
        """Return a kernel; None without a compiler, or if its state takes more than 4 GiB.

        Raises:
            Untranslatable: a requirement has no transducers.
        """
        program = streams_of(rules, signals, cut=any(each.ending == "truncate" for each in asked))
        library = _transducers()
        predicates = None if library is None else _library(program.predicates)
        if library is None or predicates is None:
            return None
        try:
            return StreamKernel(library, program, predicates, asked)
        except MemoryError:
            return None

    def push(self, row: Any) -> int:
        """Take a sample, one number per signal; return how many starts it decides."""
        self._row[:] = row
        return self._step(*self._arguments)  # type: ignore[no-any-return]

    def push_block(self, rows: Floats, *, pause: bool = False) -> tuple[int, int]:
        """Take samples, (count, signals); with `pause`, up to the first that decides a start.

        Returns:
            The number of starts that are decided, and the number of samples taken.
        """
        rows, taken = np.ascontiguousarray(rows, dtype=np.float64), ctypes.c_int64()
        place = ctypes.addressof(taken)
        return self.library.stlc_block(self.at, rows.ctypes.data, len(rows), pause, place), taken.value

    def news(self) -> list[tuple[int, int, int]]:
        """Starts that the latest sample decided: number of the requirement, start, truth (1: no, 2: yes)."""
        count = self.library.stlc_news(self.at, None, 0)
        found = (ctypes.c_int64 * (3 * count))()
        self.library.stlc_news(self.at, found, count)
        return sorted(zip(found[::3], found[1::3], found[2::3], strict=True))

    def gap(self, signal: int) -> Gap:
        """Samples at which a signal is unknown."""
        out = np.zeros(3, dtype=np.int64)
        self.library.stlc_gap(self.at, signal, out.ctypes.data)
        return Gap(*out.tolist())


@final
@dataclass(frozen=True, slots=True)
class Streamed:
    """A requirement in a kernel, with its number there."""

    asked: Asked
    kernel: StreamKernel
    number: int

    @property
    def tally(self) -> RequirementSummary:
        """Summary of the counted starts."""
        counts, bounds, kernel = (ctypes.c_int64 * 5)(), (ctypes.c_double * 6)(), self.kernel
        kernel.library.stlc_tally(kernel.at, self.number, counts, bounds)
        instants, holds, fails, low_at, high_at = counts
        low, high, least, most, *_ = bounds
        found = (instants, holds, fails, low_at, high_at, low, high, (least, most), self.asked.begin)
        return RequirementSummary(*found)

    def judged(self, starts: range, *, ended: bool = False) -> JudgedInstants:
        """Bounds and verdicts at starts that are not counted, over all continuations of the trace.

        `ended`: the trace ends with the last sample.
        """
        asked, cut = self.asked, self.asked.ending == "truncate"
        out = self._look(starts, cut=cut, ended=ended)
        if cut and ended:
            outside = beyond(asked.rule, starts, self.kernel.samples, asked.horizon)
            other = self._look(starts, cut=True, ended=False)[outside]
            out[outside, ::2] = np.minimum(out[outside, ::2], other[:, ::2])
            out[outside, 1::2] = np.maximum(out[outside, 1::2], other[:, 1::2])
        return asked.judged(out)

    def _look(self, starts: range, *, cut: bool, ended: bool) -> Floats:
        """Bounds at consecutive instants that are not counted, (instants, 4)."""
        out, kernel = np.zeros((len(starts), 4)), self.kernel
        if starts:
            copy = kernel.state.copy()
            place, where, after = copy.ctypes.data, out.ctypes.data, 1 + cut + 2 * ended  # OPEN to CLIPPED
            kernel.library.stlc_place(place, kernel.program)
            found = (self.number, after, cut and ended, starts.start, len(starts), where)
            kernel.library.stlc_look(place, *found)
        return out


def streamed_rule(asked: Asked, signals: Sequence[str]) -> Rule | None:
    """Return the requirement of a kernel; None if it has no transducers."""
    values, deciding = (_in_windows(each, asked) for each in (asked.rules[0], asked.rules[-1]))
    if values is None or deciding is None or (asked.everywhere and values.endless):
        return None
    rule = Rule(values, deciding, asked.lag)
    try:
        streams_of([rule], signals, cut=False)
    except Untranslatable:
        return None
    return rule


def _in_windows(rule: CompiledRequirement, asked: Asked) -> ir.Formula | None:
    """Formula that has the value of a requirement at its starts, without windows to a moving end.

    `end` is that of the planning window, some samples after each instant. None is returned where the formula
    would have another value: `end` occurs inside another temporal operator or in `sweep` (motion between
    samples), or a bounded window extends beyond `end`.
    """
    window = window_of(rule, asked.horizon)

    def moved(part: ir.Formula) -> ir.Formula:
        if window is None:
            return part if asked.begin else part.from_first
        if (operator := part.unbounded) and operator.window.lo <= window:
            return operator.with_window(operator.window.lo, window)
        return part

    found = rule.formula.map_terms(moved)
    return None if window is not None and (found.uses_end or found.reach.future > window) else found
