"""Calls that look at other samples: by how many, and by how much time."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import Diagnostic, SpecError
from stlc.grammar.spec import Spec
from stlc.lint.lint import lint
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.trace import Trace

TENTH = Grid(Fraction(1, 10), 20)
X = np.arange(30.0)


def source(text: str) -> Source:
    return Source("specs/spec.stl", f"signal x [m]\nconst d = 0.3 s\nrequire r: {text}\n")


def recorded(dt: float) -> Trace:
    return Trace(Signature((Column("x"),)), dt, {"x": X[None]})


def compiled(text: str, grid: Grid = TENTH) -> object:
    return compile_spec(Spec.parse(source(text)), grid=grid, purpose="check").requirements[0].formula


def finding(text: str, grid: Grid) -> Diagnostic:
    with pytest.raises(SpecError) as caught:
        compiled(text, grid)
    (found,) = caught.value.diagnostics
    return found


@given(st.integers(-50, 50), st.sampled_from([1, 2, 10, 25, 100]))
@settings(max_examples=12)
def test_a_time_is_its_number_of_steps(steps: int, hertz: int) -> None:
    time = f"{float(Fraction(steps, hertz))!r} s"
    by_time = compiled(f"shift(x, {time}) > 1 m", Grid(Fraction(1, hertz)))
    assert by_time == compiled(f"shift(x, {steps}) > 1 m")


@pytest.mark.parametrize(
    ("time", "steps"),
    [
        ("0.1 s", 1),
        ("100 ms", 1),
        ("d", 3),
        ("-d", -3),
        ("d + 1 step", 4),
        ("2 * dt", 2),
        ("T", 20),
        ("0 s", 0),
    ],
)
def test_times_of_every_kind(time: str, steps: int) -> None:
    for what in ("shift(x, {}) > 1 m", "shift(x > 1 m, {})", "norm(shift([x, x], {})) > 1 m"):
        assert compiled(what.format(time)) == compiled(what.format(steps))


def test_between_two_samples_there_is_none() -> None:
    found = finding("shift(x, 0.25 s) > 1 m", TENTH)
    assert (found.code, found.message) == ("E205", "0.25 s is not a whole number of 0.1 s steps")
    assert found.span is not None
    assert found.span.text == "0.25 s"
    assert found.help == ("use 0.2 s or 0.3 s, or a dt that fits",)


def test_without_a_step_a_time_is_no_number_of_samples() -> None:
    assert finding("shift(x, 0.1 s) > 1 m", Grid()).code == "E311"
    assert finding("shift(x, T) > 1 m", Grid(Fraction(1))).code == "E311"


@pytest.mark.parametrize("time", ["0.5", "1 m", "x", "end", "1e9 s", "true"])
def test_what_is_no_number_of_samples(time: str) -> None:
    assert finding(f"shift(x, {time}) > 1 m", TENTH).code == "E205"


def test_lint_without_a_system_leaves_times_to_the_compiler() -> None:
    assert [found.code for found in lint(source("always shift(x, 0.25 s) > d * 1 m/s"))] == []


def test_the_step_may_be_that_of_the_trace() -> None:
    monitor = Monitor(source("shift(x, 0.1 s) - x > 0.5 m").text)
    assert monitor.check(recorded(0.1), at=0)["r"].robustness == 0.5
    assert monitor.check(recorded(0.05), at=0)["r"].robustness == 1.5
    with pytest.raises(SpecError) as caught:
        monitor.check(recorded(0.2), at=0)
    assert caught.value.diagnostics[0].code == "E205"


def test_a_mistake_is_not_hidden_behind_a_step_that_nobody_knows_yet() -> None:
    with pytest.raises(SpecError) as caught:
        Monitor("signal x [m]\nrequire a: shift(x, 0.1 s) > 1 m\nrequire b: x > 1 s\n")
    assert [found.code for found in caught.value.diagnostics] == ["E203"]


def test_a_macro_of_another_file_knows_the_step(tmp_path: Path) -> None:
    (tmp_path / "lib.stl").write_text("def soon(a) = shift(a, 0.1 s)\n")
    path = tmp_path / "a.stl"
    path.write_text('import "lib.stl" as lib\nsignal x [m]\nrequire r: lib.soon(x) > 0 m\n')
    assert Monitor(path, dt=0.1).check({"x": X}, at=0)["r"].robustness == 1.0
