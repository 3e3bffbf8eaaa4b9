from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc.controller.problem.task import Task
from stlc.dynamics.quantiles import InitialPoints

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["traffic", "ship_track", "navigation"])
def test_uniform_points_give_the_declared_distribution(name):
    system = Task.load(ROOT / "specs" / f"{name}.stl").system
    points = InitialPoints(system)
    generator = torch.Generator().manual_seed(1)
    states = points.states(torch.rand((20_000, points.dim), generator=generator, dtype=torch.float64))
    states = states[points.admissible(states)]
    drawn = system.sample(20_000, seed=2, dtype=torch.float64)
    for found, expected in zip(states.T, drawn.T, strict=True):
        scale = expected.std() + 1e-9
        assert abs(found.mean() - expected.mean()) < 0.06 * scale
        assert abs(found.std() - expected.std()) < 0.06 * scale


def test_the_same_point_gives_the_same_state():
    points = InitialPoints(Task.load(ROOT / "specs/traffic.stl").system)
    at = torch.rand((50, points.dim), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = points.states(at)
    alone = torch.cat([points.states(each[None]) for each in at])
    assert torch.equal(together, alone)


def test_coordinates_of_columns(tmp_path):
    (tmp_path / "s.yaml").write_text(
        "stlc: 1\nname: s\ntime: {dt: 0.1 s, horizon: 3 steps}\n"
        "state: {x: {range: [0, 1]}, y: {range: [0, 2]}}\ncontrol: {u: {range: [-1, 1]}}\nflow: {x: u}\n"
        "init: {mixture: [{draw: {x: 'uniform(0, 1)', y: 'x + uniform(0, 1)'}}]}\n"
    )
    (tmp_path / "s.stl").write_text('system "s.yaml"\nsignal x\nrequire r: always x < 2\n')
    points = InitialPoints(Task.load(tmp_path / "s.stl").system)
    assert points.dim == 2
    assert points.coordinates_of(("x", "y")) == {"x": 0}
    assert points.last_coordinates_of(("x", "y")) == (0, 1)
