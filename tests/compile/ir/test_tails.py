"""Windows far beyond the end of a trace: few instants are computed, and the bounds are those of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from stlc.compile.backends import schedule
from stlc.compile.backends.array.graph import evaluate, planned
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.steps import MAX_BEYOND
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.semantics import SEMANTICS, LogSumExp, semantics_of
from stlc.diagnostics import StlcError

Env = dict[str, np.ndarray]
X, Y = ir.Predicate(ir.Signal("x")), ir.Predicate(ir.Signal("y"))
COLUMN = {"x": np.array([[1.0], [-2.0], [3.0]])}


def bounds(node: ir.Formula, env: Env, end: str, stop: int | None, far: int) -> np.ndarray:
    """At every sample, where instants are looked at one by one up to `far` samples beyond the last one."""
    planned.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "_FAR", far)
        (found,) = evaluate([node], env, ops=NUMPY, count=len(env["x"]), end=end, stop=stop)
    planned.cache_clear()
    return found


def operators(*windows: tuple[int, int | None]) -> Iterator[Callable[[ir.Formula, ir.Formula], ir.Formula]]:
    """Every operator with every window, of one part or of two."""
    for window in (ir.Window(*ends) for ends in windows):
        for op in ("always", "eventually"):
            yield lambda one, _, op=op, window=window: ir.Temporal(op, window, one)
        for op in ("historically", "once"):
            yield lambda one, _, op=op, window=window: ir.PastTemporal(op, window, one)
        for op in ("until", "release"):
            yield lambda one, two, op=op, window=window: ir.Until(op, window, one, two)
        for op in ("since", "trigger"):
            yield lambda one, two, op=op, window=window: ir.Since(op, window, one, two)


def pairs() -> Iterator[ir.Formula]:
    """Changes beyond the trace, below an operator that looks far beyond it."""
    inner = [make(X, Y) for make in operators((0, 3), (2, 4), (0, None), (2, None))]
    inner += [ir.Shift(steps, X) for steps in (-4, 4)]
    inner += [
        ir.BoolOp("or", (X, ir.PastTemporal("once", ir.Window(0, 2), Y))),
        ir.AtStart(ir.BoolOp("and", (X, Y))),
    ]
    for outer in operators((3, 20)):
        yield from (outer(part, Y) for part in inner)
        yield from (outer(Y, part) for part in inner)


@pytest.mark.parametrize("end", ["lower", "upper"])
@pytest.mark.parametrize("stop", [None, 9])
def test_one_unknown_instant_stands_for_all(end: str, stop: int | None) -> None:
    env = dict(zip("xy", np.random.default_rng(1).normal(size=(2, 3, 12)), strict=True))
    for node in pairs():
        few, all_ = (bounds(node, env, end, stop, far) for far in (0, 10**6))
        np.testing.assert_array_equal(few, all_, err_msg=str(node))


def nested(window: ir.Window, *ops: str) -> ir.Formula:
    """Operators around `x >= 0`, the first one outermost."""
    node: ir.Formula = X
    for op in reversed(ops):
        kind = ir.Temporal if op in ("always", "eventually") else ir.PastTemporal
        node = kind(op, window, node)
    return node


def test_a_window_of_days_takes_no_time() -> None:
    node = nested(ir.Window(0, 8_640_000), *["always", "eventually"] * 20)
    assert planned((node,), 3, range(1), "lower").beyond < 100
    low, high = (evaluate([node], COLUMN, ops=NUMPY, end=end)[0] for end in ("lower", "upper"))
    assert (low.item(), high.item()) == (-np.inf, np.inf)


def test_a_mean_counts_every_instant() -> None:
    node = nested(ir.Window(0, 5000), "always")
    assert planned((node,), 3, range(1), "lower", None, LogSumExp(1.0)).beyond == 4998
    for name in SEMANTICS.names:
        (found,) = evaluate([node], COLUMN, ops=NUMPY, semantics=semantics_of(name), end="upper")
        padded = {"x": np.concatenate([COLUMN["x"], np.full((4998, 1), np.inf)])}
        (wanted,) = evaluate([node], padded, ops=NUMPY, semantics=semantics_of(name))
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_what_is_decided_is_decided_before_a_far_deadline() -> None:
    node = ir.Temporal("always", ir.Window(0, 10**12), X)
    (high,) = evaluate([node], COLUMN, ops=NUMPY, end="upper")
    assert high.item() == -2.0


def test_what_looks_too_far_is_refused() -> None:
    node = nested(ir.Window(0, 10**9), "always", "once", "always")
    assert planned((node,), 3, range(1), "lower").beyond > MAX_BEYOND
    with pytest.raises(StlcError) as caught:
        evaluate([node], COLUMN, ops=NUMPY, end="lower")
    (finding,) = caught.value.diagnostics
    assert finding.code == "E306"
    assert "samples beyond the last one" in finding.message
