"""Shapes of what compiled functions take, and the sharing of rows among threads."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from stlc import native
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import LANES, Motion, emit
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.kernel import (
    GRAIN,
    Adjoint,
    Kernel,
    ObjectiveSlopes,
    SearchOptions,
    Sizes,
    _share,
)

MOTION = Motion(("x",), ("u",), (), {"x": ir.Op("add", (ir.Signal("x"), ir.Signal("u")))}, 5, 0.1)
SIZES = Sizes(states=1, controls=1, steps=5, rules=1)
RULES = [ir.Temporal("always", ir.Window(0, None), ir.Predicate(ir.Signal("x")))]
compiled = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")


def _kernel() -> Kernel:
    library = native.load(emit(MOTION, RULES))
    assert library is not None
    return Kernel(library, SIZES)


@compiled
@pytest.mark.parametrize("batch", [1, LANES - 1, LANES, LANES + 1, 5 * LANES + 3, 2000])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_row_is_judged_whatever_the_batch_and_the_threads(batch: int, threads: int) -> None:
    rng = np.random.default_rng(batch)
    x0, u = rng.normal(size=(batch, 1)), rng.normal(size=(batch, 5, 1))
    rho, columns = _kernel().judge(x0, u, threads=threads, columns=True)
    assert columns is not None
    expected = np.concatenate([x0, x0 + u[:, :, 0].cumsum(1)], 1)
    np.testing.assert_allclose(columns[0].T, expected)
    np.testing.assert_allclose(rho[:, 0], expected.min(1))


@compiled
def test_arrays_of_other_sizes_are_refused() -> None:
    """Compiled code would read beyond their ends."""
    kernel, library = _kernel(), native.load(emit_adjoint(MOTION, RULES))
    assert library is not None
    adjoint = Adjoint(library, SIZES)
    search = SearchOptions(np.zeros((3, 1)), np.ones(1), np.zeros((2, 4, 1)), 1, 0.0, 0)
    x0, u = np.zeros((4, 1)), np.zeros((4, 5, 1))
    slopes = ObjectiveSlopes(np.ones((4, 1)), np.ones((1, 6, 4)), 1.0)
    assert adjoint.pull(x0, u, slopes).shape == u.shape
    for start, plans in ((x0, u[:1]), (x0[:1], u), (x0[:, :0], u), (x0, u[:, :4]), (x0, u[:, :, :0])):
        for call in (
            lambda: kernel.judge(start, plans),  # noqa: B023 - called at once
            lambda: kernel.local_search(start, plans, search),  # noqa: B023
            lambda: adjoint.pull(start, plans, slopes),  # noqa: B023
            lambda: adjoint.pull_starts(start, plans, slopes),  # noqa: B023
        ):
            with pytest.raises(ValueError, match=r"x0 \(B, 1\) and u \(B, 5, 1\)"):
                call()
    with pytest.raises(ValueError, match="library of plans"):
        kernel.local_search(x0, u, search)
    for wrong in (replace(slopes, by_rho=np.ones((3, 1))), replace(slopes, by_columns=np.ones((1, 5, 4)))):
        with pytest.raises(ValueError, match="by_"):
            adjoint.pull(x0, u, wrong)


@pytest.mark.parametrize("threads", [1, 3])
def test_rows_are_shared_in_parts_and_each_is_done_once(threads: int) -> None:
    done: list[int] = []

    def rows(first: int, last: int) -> int:
        assert first % GRAIN == 0
        done.extend(range(first, last))
        return 0

    _share(rows, 1000, threads)
    assert sorted(done) == list(range(1000))


def test_work_is_stopped_between_two_parts() -> None:
    done: list[int] = []

    def rows(first: int, _last: int) -> int:
        done.append(first)
        return 0

    _share(rows, 10**6, 1, stop=lambda: len(done) == 3)
    assert len(done) == 3


@pytest.mark.parametrize("threads", [1, 2])
def test_an_interruption_ends_the_work(threads: int) -> None:
    def rows(first: int, last: int) -> int:
        time.sleep(0.001 * (last - first))  # else parts grow until one holds them all
        return 0

    timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        _share(rows, 1 << 40, threads, grain=1)
    timer.join()


def test_a_part_without_memory_is_told() -> None:
    with pytest.raises(MemoryError):
        _share(lambda _first, _last: 1, 100, 2)
