"""Conjunctions that nothing satisfies: W505 where the parts leave no room, and nowhere else."""

from __future__ import annotations

import pytest

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source

HEAD = "signal x [m]\nsignal y [m]\nsignal v [km/h]\nsignal n : int\n"


def found(formula: str) -> list[str]:
    text = f"{HEAD}require r: {formula}\n"
    compiled = Monitor(text, dt=0.1, horizon=1.0).compiled
    return [finding.code for finding in compiled.warnings if finding.code == "W505"]


@pytest.mark.parametrize(
    "formula",
    [
        "x > 1 m and x < 0.5 m",
        "always[0 s, 1 s] (x > 1 m and (y > 0 m and x < 0.5 m))",
        "0.5 m > x > 1 m",
        "x - y > 1 m and 2 * y - 2 * x > 1 m",
        "n >= 4 and n < 3",
        "v > 100 km/h and v < 20 m/s",
        "x > 0 m or (x in [1 m, 2 m] and x > 3 m)",
    ],
)
def test_no_room(formula: str) -> None:
    assert found(formula) == ["W505"]


@pytest.mark.parametrize(
    "formula",
    [
        "x > 0.5 m and x < 1 m",
        "x >= 1 m and x <= 1 m",
        "x > 1 m or x < 0.5 m",
        "eventually[0 s, 1 s] x > 1 m and eventually[0 s, 1 s] x < 0.5 m",
        "x > 1 m and y < 0.5 m",
        "not (x > 1 m) and x < 0.5 m",
        "x * x > 1 m^2 and x < 0.5 m",
        "n >= 3 and n <= 3",
    ],
)
def test_room(formula: str) -> None:
    assert found(formula) == []


def test_training_says_it_too() -> None:
    spec = Spec.parse(Source("s.stl", f"{HEAD}require r: x > 1 m and x < 0.5 m\n"))
    assert "W505" in [finding.code for finding in compile_spec(spec, grid=Grid(None, None)).warnings]
