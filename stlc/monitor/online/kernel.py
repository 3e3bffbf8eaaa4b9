"""Monitor of streams in C (`stlc.compile.backends.c.streams`), loaded into this process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from stlc import native
from stlc.compile.backends.c.streams import TABLES, Rule, Streams, runtime, streams_of
from stlc.compile.semantics.tolerance import Status
from stlc.monitor.online.history import Floats
from stlc.monitor.online.tally import JudgedInstants, RequirementSummary
from stlc.monitor.signals import Gap

After = Literal["open", "growing", "ended", "clipped"]
"""Continuation after the samples: others, where the end may cut windows to it, or all windows; or nothing."""

_STEPS: dict[After, int] = {"open": 1, "growing": 2, "ended": 3, "clipped": 4}

_HEAD = "#define REAL double\n#define API\n"

_MOST = 1 << 32
"""Greatest size of the state in bytes."""


class Starts(NamedTuple):
    """Instants at which a requirement is judged: from `begin` on, or only there."""

    begin: int
    everywhere: bool


@dataclass(frozen=True, slots=True)
class Watching:
    """Settings of a monitor of streams.

    Attributes:
        starts: instants of each requirement.
        tolerance: a requirement is satisfied if its robustness is at least minus this value.
        cut: whether the end of the trace cuts all windows.
    """

    starts: Sequence[Starts]
    tolerance: float
    cut: bool


class _Tables(ctypes.Structure):
    """The structure `tables` of `streams.c`."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in (*TABLES.values(), "predicates")),
        *(
            (name, ctypes.c_int32)
            for name in ("signals", "rows", "judged", "spans", "times", "ints", "truths")
        ),
    )


@cache
def _transducers() -> ctypes.CDLL | None:
    """Library of the transducers of all monitors."""
    library = native.load(_HEAD + "".join(runtime()))
    if library is not None:
        pointer, integer, flag = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int32
        library.stlc_size.restype = library.stlc_block.restype = library.stlc_news.restype = integer
        library.stlc_size.argtypes = [pointer]
        library.stlc_place.argtypes = [pointer, pointer]
        library.stlc_init.argtypes = [pointer, flag, integer, flag, flag, ctypes.c_double]
        library.stlc_block.argtypes = [pointer, pointer, integer, flag, pointer]
        library.stlc_look.argtypes = [pointer, flag, flag, flag, integer, integer, pointer]
        library.stlc_news.argtypes = library.stlc_tally.argtypes = [pointer, flag, pointer, pointer]
        library.stlc_gap.argtypes = [pointer, flag, pointer]
    return library


class StreamKernel:
    """Compiled monitor of several requirements, with its state.

    Args:
        library: the transducers.
        program: tables of the monitor.
        predicates: library of its predicates.
        watching: settings.
    """

    def __init__(
        self, library: ctypes.CDLL, program: Streams, predicates: ctypes.CDLL, watching: Watching
    ) -> None:
        self._library, self._watching, self._predicates = library, watching, predicates
        self._arrays = {name: np.array(_flat(rows) or [0], np.int32) for name, rows in program.tables.items()}
        places = {name: array.ctypes.data for name, array in self._arrays.items()}
        function = ctypes.cast(predicates.predicates, ctypes.c_void_p)
        self._tables = _Tables(**places, predicates=function, **program.sizes)
        self._program = ctypes.addressof(self._tables)
        size = library.stlc_size(self._program)
        if size > _MOST:
            raise MemoryError
        self._state = np.zeros(size // 8 + 1)
        self._at = self._state.ctypes.data
        library.stlc_place(self._at, self._program)
        self._row = (ctypes.c_double * program.sizes["signals"])()
        self._step = library.stlc_step
        self._arguments = (ctypes.c_void_p(self._at), ctypes.cast(self._row, ctypes.c_void_p))
        for rule, start in enumerate(watching.starts):
            library.stlc_init(self._at, rule, *start, watching.cut, watching.tolerance)

    @property
    def samples(self) -> int:
        """Number of samples received."""
        return int(self._state[1:2].view(np.int64)[0])  # `s.known`, after a pointer

    @staticmethod
    def of(rules: Sequence[Rule], signals: Sequence[str], watching: Watching) -> StreamKernel | None:
        """Return a kernel; None without a compiler, or if its state takes more than 4 GiB.

        Raises:
            Untranslatable: a requirement has no transducers.
        """
        program = streams_of(rules, signals, cut=watching.cut)
        library = _transducers()
        predicates = None if library is None else native.load(f"{_HEAD}{runtime()[0]}{program.predicates}")
        if library is None or predicates is None:
            return None
        try:
            return StreamKernel(library, program, predicates, watching)
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
        decided = self._library.stlc_block(self._at, rows.ctypes.data, len(rows), pause, place)
        return decided, taken.value

    def news(self, rule: int) -> dict[int, Status]:
        """Starts of a requirement that the latest sample decided, in order, and their verdicts."""
        count = self._library.stlc_news(self._at, rule, None, None)
        starts, truths = np.zeros((2, count), dtype=np.int64)
        self._library.stlc_news(self._at, rule, starts.ctypes.data, truths.ctypes.data)
        found = sorted(zip(starts.tolist(), truths.tolist(), strict=True))
        return {start: "satisfied" if truth == 2 else "violated" for start, truth in found}

    def tally(self, rule: int) -> RequirementSummary:
        """Summary of the instants of a requirement that are counted."""
        (instants, holds, fails, low_at, high_at), (low, high, *_) = self._tally(rule)
        first = self._watching.starts[rule].begin
        return RequirementSummary(instants, holds, fails, low, high, low_at, high_at, first)

    def last(self, rule: int) -> JudgedInstants:
        """Bounds and verdict at the instant of a requirement that was counted last."""
        return JudgedInstants.of(np.array([self._tally(rule)[1][2:]]), self._watching.tolerance)

    def _tally(self, rule: int) -> tuple[list[int], list[float]]:
        counts, bounds = np.zeros(5, dtype=np.int64), np.zeros(6)
        self._library.stlc_tally(self._at, rule, counts.ctypes.data, bounds.ctypes.data)
        return counts.tolist(), bounds.tolist()

    def gap(self, signal: int) -> Gap:
        """Samples at which a signal is unknown."""
        out = np.zeros(3, dtype=np.int64)
        self._library.stlc_gap(self._at, signal, out.ctypes.data)
        return Gap(*out.tolist())

    def look(self, rule: int, starts: range, after: After) -> JudgedInstants:
        """Bounds and verdicts at consecutive instants that are not counted, over all that may follow."""
        out = np.zeros((len(starts), 4))
        if starts:
            copy = self._state.copy()
            place, where = copy.ctypes.data, out.ctypes.data
            self._library.stlc_place(place, self._program)
            clip = after == "clipped"
            self._library.stlc_look(place, rule, _STEPS[after], clip, starts.start, len(starts), where)
        return JudgedInstants.of(out, self._watching.tolerance)


def _flat(row: Any) -> list[int]:
    return [number for each in row for number in (_flat(each) if isinstance(each, tuple) else (each,))]
