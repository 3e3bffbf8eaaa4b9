"""Exported monitors on a Cortex-M4: texts for R2U2, samples of the board, and a run where there is QEMU."""

from __future__ import annotations

import re
import shutil

import pytest

from benchmarks.__main__ import main as measure_by
from benchmarks.monitors import ALWAYS, NESTED, response
from benchmarks.requirements import Until
from benchmarks.tables import cortex
from stlc.diagnostics import StlcError


def test_formulas_are_written_for_r2u2():
    assert cortex.for_r2u2(NESTED) == "(G[0,100] (F[0,10] (x > 5.0)))"
    assert cortex.for_r2u2(response()) == "((x > 7.0) -> (F[0,50] (y > 2.0)))"
    with pytest.raises(StlcError, match="R2U2 has no form"):
        cortex.for_r2u2(Until(ALWAYS.body, ALWAYS.body))


def test_the_samples_are_those_of_the_board():
    text = (cortex.BOARD / "board.c").read_text(encoding="utf-8")
    factor, offset, scale, shift, divisor = map(
        int,
        re.search(r"(\d+)u \+ (\d+)u;.*?\((\d+) \* \(seed >> (\d+)\)\) / (\d+)", text, re.DOTALL).groups(),
    )
    assert f"#define ROWS {cortex.ROWS}\n" in text
    seed = (factor + offset) % (1 << 32)
    data = cortex.samples(["x", "y"])
    assert data["x"][0] == scale * (seed >> shift) / divisor
    assert (
        data["y"][cortex.ROWS]
        == data["y"][0]
        == scale * ((seed * factor + offset) % (1 << 32) >> shift) / divisor
    )
    assert all(0 <= x.min() < 1 and 9 < x.max() < 10 for x in data.values())


def test_a_missing_program_is_named_with_its_package(monkeypatch, capsys):
    monkeypatch.setattr(cortex.shutil, "which", lambda _: None)
    assert measure_by(["cortex"]) == 5
    assert "apt install gcc-arm-none-eabi" in capsys.readouterr().err


@pytest.mark.apart
@pytest.mark.skipif(
    not all(map(shutil.which, ("arm-none-eabi-gcc", "qemu-system-arm"))), reason="apt install qemu-system-arm"
)
@pytest.mark.parametrize("formula", [NESTED, response()], ids=["nested", "response"])
def test_a_monitor_on_the_board_counts_what_a_recording_has(formula, monkeypatch):
    monkeypatch.setattr(cortex, "PASSES", 3)
    row = cortex.row_of("stlc", formula, "-Os", None)
    assert row.equal
    assert 2_000 < row.flash < 40_000
    assert 100 < row.instructions < 10_000
