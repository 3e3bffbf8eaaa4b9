"""Initial states from a grid or a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.diagnostics import StlcError
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.dynamics.system import System
from stlc.source import Source

Make = Callable[..., System]

HEAD = """\
time: {dt: 0.1 s, horizon: 10 steps}
const: {wall: 4 m}
state:
  x: {unit: m}
  v: {unit: m/s}
  sign: {enum: [stop, light]}
  q: {size: 2, unit: rad}
control: {u: {range: [-1, 1]}}
flow: {x: v}
init:
"""
GRID = """\
  grid:
    x: {from: 0, to: wall, count: 5}
    sign: [stop, light]
    v: 1 m/s
  let: {turn: "uniform(0, 1)"}
  draw: {q: "[turn, x * 1 rad/m]"}
"""
FILE = """\
  from: starts.npz
  draw: {v: "uniform(0, 1)", "q[1]": 0}
  where: [x > 1]
"""


def test_a_grid_is_every_combination_equally_often(make: Make) -> None:
    x0 = make(HEAD + GRID).sample(30, seed=0, dtype=torch.float64)
    counts = Counter((row[0], row[2]) for row in x0.tolist())
    assert counts == {(float(x), float(sign)): 3 for x in range(5) for sign in range(2)}
    assert set(x0[:, 1].tolist()) == {1.0}
    assert torch.equal(x0[:, 4], x0[:, 0])
    assert len(set(x0[:, 3].tolist())) == 30


def test_conditions_hold_on_a_grid_too(make: Make) -> None:
    x0 = make(HEAD + GRID + "  where: [x > 1.5]\n").sample(200, seed=0)
    assert set(x0[:, 0].tolist()) == {2.0, 3.0, 4.0}


def test_a_grid_too_large_to_write_out(make: Make) -> None:
    wide = "{from: 0, to: 1, count: 100000}"
    text = f"  grid: {{x: {wide}, v: {wide}, 'q[0]': {wide}, 'q[1]': {wide}, sign: stop}}\n"
    x0 = make(HEAD + text).sample(100, seed=0, dtype=torch.float64)
    assert len(set(x0[:, 0].tolist())) > 90
    assert bool(((x0[:, 4] >= 0) & (x0[:, 4] <= 1)).all())


def write(folder: Path, **arrays: np.ndarray) -> System:
    np.savez(folder / "starts.npz", **arrays)  # type: ignore[arg-type]
    (folder / "a.yaml").write_text("stlc: 1\nname: a\n" + HEAD + FILE)
    return System(load_system_decl(folder / "a.yaml"))


def test_states_from_a_file(tmp_path: Path) -> None:
    x = np.arange(6.0).reshape(2, 3)
    system = write(tmp_path, x=x, sign=np.zeros((2, 3)), q=np.stack([x * 10, x], -1))
    x0 = system.sample(40, seed=0, dtype=torch.float64)
    assert set(x0[:, 0].tolist()) == {2.0, 3.0, 4.0, 5.0}
    assert torch.equal(x0[:, 3], x0[:, 0] * 10)
    assert bool((x0[:, 4] == 0).all())
    assert len(set(x0[:, 1].tolist())) == 40


def test_states_from_a_file_are_in_units_and_words(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("stlc: 1\nname: a\n" + HEAD + FILE.replace("starts.npz", "starts.csv"))
    path = tmp_path / "starts.csv"

    def drawn(head: str, rows: str) -> torch.Tensor:
        path.write_text(f"{head}\n{rows}\n")
        return System(load_system_decl(tmp_path / "a.yaml")).sample(20, seed=0, dtype=torch.float64)

    x0 = drawn("t,x [km],sign,q[0] [deg]", "0,0.002,light,180\n1,0.003,stop,180\n7,0.004,light,180")
    assert {tuple(row) for row in x0[:, [0, 2]].tolist()} == {(2.0, 1.0), (3.0, 0.0), (4.0, 1.0)}
    assert x0[:, 3].tolist() == pytest.approx([np.pi] * 20)
    for head, row, message in (
        ("t,x [s],sign,q[0]", "0,2,light,0", r"`x` is in \[s\]"),
        ("t,x,sign,q[0]", "0,2,halt,0", "halt"),
        ("t,x,sign,q[0]", "0,2,7,0", "holds 7 in `sign`, which is one of stop, light"),
    ):
        with pytest.raises(StlcError, match=message) as caught:
            drawn(head, row)
        assert [finding.code for finding in caught.value.diagnostics] == ["S303"]


@pytest.mark.parametrize(
    "arrays",
    [
        {"x": np.ones(4), "q": np.ones((4, 2))},
        {"x": np.ones(4), "sign": np.ones(3), "q": np.ones((4, 2))},
        {"x": np.full(4, np.nan), "sign": np.ones(4), "q": np.ones((4, 2))},
        {"x": np.ones(4), "sign": np.ones(4), "q": np.ones((4, 0))},
        {"x": np.ones(0), "sign": np.ones(0), "q": np.ones((0, 2))},
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    system = write(tmp_path, **arrays)
    with pytest.raises(StlcError) as caught:
        system.sample(4, seed=0)
    assert [finding.code for finding in caught.value.diagnostics] == ["S303"]


def test_a_missing_file_is_named_when_states_are_asked_for(make: Make) -> None:
    system = make(HEAD + FILE)
    with pytest.raises(StlcError, match=r"starts\.npz"):
        system.sample(4, seed=0)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (GRID + "  mixture: [{draw: {x: 0}}]\n", "S102"),
        (GRID.replace("count: 5", "count: 1"), "S103"),
        (GRID.replace("count: 5", "steps: 5"), "S101"),
        (GRID.replace("[stop, light]", "{from: 0, to: 1, count: 2}"), "S103"),
        (GRID.replace("v: 1 m/s", "v: 1 m"), "E203"),
        (GRID.replace("v: 1 m/s", "v: uniform(0, 1)"), "S201"),
        (GRID.replace("v: 1 m/s", "v: x * 1 s^-1"), "S103"),
        (GRID.replace("v: 1 m/s", "q: [0, 1]"), "S203"),
        (GRID.replace("    v: 1 m/s\n", ""), "S102"),
        ("  grid: {}\n", "S103"),
        ("  from: starts.pkl\n", "S103"),
        ("  mixture: [{draw: {x: 0, v: 0, sign: stop, q: 0}}]\n  draw: {x: 1}\n", "S102"),
    ],
)
def test_what_is_wrong_is_said(text: str, code: str) -> None:
    with pytest.raises(StlcError) as caught:
        parse_system(Source("a.yaml", "stlc: 1\nname: a\n" + HEAD + text), Path("a.yaml"))
    assert code in {finding.code for finding in caught.value.diagnostics}
