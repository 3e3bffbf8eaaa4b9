"""Timed formulas: they have the same robustness, and the figures meet the targets."""

from __future__ import annotations

import json
import sys

import pytest
import torch
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.formulas import CASES, Case, Timing, width_of
from benchmarks.tables.robustness import timings
from benchmarks.tables.schema import document_schema
from benchmarks.timing import interleaved, one_thread, ratio
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.torch.ops import TORCH


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize(("samples", "batch"), [(20, 1), (200, 3), (100, 300)])
def test_plain_torch_computes_the_same(case: Case, samples: int, batch: int) -> None:
    torch.manual_seed(0)
    x, y = (torch.randn(samples, batch, dtype=torch.float64, requires_grad=True) for _ in range(2))
    width = width_of(samples)
    ours = robustness_signal(case.formula(width), {"x": x, "y": y}, ops=TORCH, end="truncate")
    plain = case.plain(x, y, width)
    torch.testing.assert_close(ours, plain, atol=0.0, rtol=0.0)
    weights = torch.randn_like(ours)
    mine = torch.autograd.grad(ours, (x, y), weights, allow_unused=True)
    theirs = torch.autograd.grad(plain, (x, y), weights, allow_unused=True)
    for one, other in zip(mine, theirs, strict=True):
        assert (one is None) is (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, atol=1e-12, rtol=1e-12)


def test_a_slower_function_takes_longer() -> None:
    with one_thread():
        assert torch.get_num_threads() == 1
        small, large = interleaved([lambda: sum(range(100)), lambda: sum(range(100_000))], 0.05)
    assert ratio(large, small) > 10
    assert min(small) > 0


@pytest.mark.apart
def test_timings_and_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["robustness", "--samples", "20", "--traces", "1", "--seconds", "0"]
    assert measure([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    rows = document["result"]["rows"]
    assert [row["formula"] for row in rows[::2]] == [case.name for case in CASES]
    assert all(row["passes"] > 0 and row["plain"] is not None for row in rows)
    assert measure(command) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) == 1 + 2 * len(CASES)
    assert "with gradient" in out


LIMITS = {"G[0,end] p": 25.0, "G[0,w] p": 45.0, "p U[0,w] q": 600.0}


@pytest.mark.bench
def test_large_traces_take_few_passes_over_memory(capsys: pytest.CaptureFixture[str]) -> None:
    found = [timing for timing in timings([1000], [1000], seconds=2.0).rows if timing.gradient]
    show(found, capsys)
    for timing in found:
        assert timing.passes <= LIMITS.get(timing.formula, 600.0)


@pytest.mark.bench
def test_small_traces_are_hardly_slower_than_plain_torch(capsys: pytest.CaptureFixture[str]) -> None:
    found = [timing for timing in timings([20], [1], seconds=2.0).rows if timing.gradient]
    show(found, capsys)
    for timing in found:
        assert timing.plain is not None
        assert timing.plain >= 1 / 1.5


def show(found: list[Timing], capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        for timing in found:
            plain = "" if timing.plain is None else f", plain torch {timing.plain:.2f}x"
            figures = f"{timing.seconds * 1e3:.3f} ms, {timing.passes:.1f} passes"
            sys.stdout.write(f"\n{timing.formula}: {figures}{plain}")
