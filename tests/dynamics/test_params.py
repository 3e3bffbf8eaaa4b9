"""The section `param`: constants of a trajectory, drawn for each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from stlc.diagnostics import StlcError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.source import Source

Make = Callable[..., System]

CART = """\
time: {dt: 0.1 s, horizon: 10 steps}
state:
  x: {unit: m}
param:
  r: {unit: m, range: [0.6, 1.2]}
  far: {unit: m, draw: "r + uniform(1, 2)"}
  mass: normal(2 kg, 0.1 kg)
  lane: {enum: {left: 0, right: 1}}
  c: {size: 2, unit: m, draw: "uniform([0, 10], [1, 11])"}
control: {u: {unit: kg*m/s, range: [-1, 1]}}
flow: {x: u / mass}
jump: [{guard: x > r, reset: {x: 0}}]
init:
  mixture:
    - {weight: 1, draw: {x: far}}
    - {weight: 1, draw: {r: 1, x: -r}}
test:
  events: [{every: 1 s, set: {r: "uniform(0.6, 1.2)"}}]
"""


def test_every_trajectory_has_its_own(make: Make) -> None:
    system = make(CART)
    assert system.names == ("x", "r", "far", "mass", "lane", "c[0]", "c[1]")
    x0 = system.sample(2000, seed=0, dtype=torch.float64)
    x, r, far, mass, lane, c0, c1 = x0.unbind(1)
    own = x > 0
    assert 800 < int(own.sum()) < 1200
    assert torch.equal(x[own], far[own])
    assert torch.equal(x[~own], -r[~own])
    assert bool((r[~own] == 1.0).all())
    assert bool(((r[own] >= 0.6) & (r[own] <= 1.2)).all())
    assert abs(float(mass.mean()) - 2.0) < 0.02
    assert set(lane.tolist()) == {0.0, 1.0}
    assert bool(((c0 >= 0) & (c0 <= 1) & (c1 >= 10) & (c1 <= 11)).all())
    low, high = system.signature["mass"].low, system.signature["mass"].high
    assert low is not None
    assert high is not None
    assert low < 1.75
    assert high > 2.25


def test_nothing_moves_it(make: Make) -> None:
    system = make(CART)
    x0 = system.sample(20, seed=0)
    x = system.rollout(x0, torch.ones(20, 10, 1))
    assert torch.equal(x[:, :, 1:], x0[:, None, 1:].expand(-1, 11, -1))
    assert system.observed_count == 7


@pytest.mark.parametrize(("text", "value"), [("0.8 m", 0.8), ("0.8", 0.8), ("uniform(0.9, 0.91)", 0.9)])
def test_set_fixes_it(make: Make, text: str, value: float) -> None:
    x0 = make(CART.replace("draw: {r: 1, x: -r}", "draw: {x: -r}"), r=text).sample(50, seed=0)
    assert float((x0[:, 1] - value).abs().max()) < 0.011


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("r: {unit: m, range: [0.6, 1.2]}", "r: {unit: m}", "S102"),
        ("r: {unit: m, range: [0.6, 1.2]}", "r: {unit: m, range: [1.2, 0.6]}", "S204"),
        ("r: {unit: m, range: [0.6, 1.2]}", "r: {unit: m, draw: far}", "E101"),
        ("r: {unit: m, range: [0.6, 1.2]}", "x: {unit: m, range: [0.6, 1.2]}", "E102"),
        ("r: {unit: m, range: [0.6, 1.2]}", "r: {unit: m, draw: x}", "S202"),
        ("r: {unit: m, range: [0.6, 1.2]}", "r: {unit: m, clamp: true}", "S101"),
        ('draw: "r + uniform(1, 2)"', 'draw: "r + uniform(1 s, 2 s)"', "E203"),
    ],
)
def test_what_is_wrong_is_said(old: str, new: str, code: str) -> None:
    assert CART.count(old) == 1
    with pytest.raises(StlcError) as caught:
        parse_system(Source("a.yaml", "stlc: 1\nname: a\n" + CART.replace(old, new)), Path("a.yaml"))
    assert code in {finding.code for finding in caught.value.diagnostics}
