"""Building, caching, threads, and going on without a compiler."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc import native
from stlc.compile import ir
from stlc.compile.emit_c import LANES, Motion, emit

MOTION = Motion(("x",), ("u",), (), {"x": ir.Op("add", (ir.Col("x"), ir.Col("u")))}, 5, 0.1)
pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")
RULES = [ir.Over("always", ir.Window(0, None), ir.Atom(ir.Col("x")))]


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "stlc"


def _kernel() -> native.Kernel:
    path = native.build(emit(MOTION, RULES))
    assert path is not None
    return native.Kernel(path, states=1, rules=1, steps=5)


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


def test_a_kernel_is_built_once(cache: Path) -> None:
    text = emit(MOTION, RULES)
    first = native.build(text)
    assert first is not None
    before = first.stat().st_mtime_ns
    assert native.build(text) == first
    assert first.stat().st_mtime_ns == before
    assert [path.name for path in cache.iterdir()] == [first.name]


def test_no_compiler_no_kernel(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "compiler", lambda: None)
    assert native.build(emit(MOTION, RULES)) is None
    assert not cache.exists()


def test_a_compiler_that_fails_leaves_nothing(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "compiler", lambda: "/bin/false")
    assert native.build(emit(MOTION, RULES)) is None
    assert list(cache.iterdir()) == []
