"""Starts of a deployment are drawn again where no plan is known from them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import solvable, viable
from stlc.controller.world import ModelWorld, world_type
from stlc.diagnostics import RunError, SystemFileError
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

EXAMPLES = Path(__file__).parents[2] / "examples"
CART = """
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 10 steps}
state:
  x: {unit: m, range: [-2, 4]}
  v: {unit: m/s, range: [-2, 2]}
control:
  a: {unit: m/s^2, range: [-1, 1]}
flow: {x: v, v: a}
init:
  mixture: [{weight: 1, draw: {x: "uniform(0, 4)", v: 0}}]
"""
SPEC = "@safety require near: always x < 3 m\nrequire home: eventually x < 1 m\nstate signal x [m]\n"


def cart(tmp_path: Path, test: str, drawn: str = "uniform(0, 4)") -> Task:
    """By default drawn evenly from 0 to 4 m: safe below 3, home within reach below about 1.4."""
    (tmp_path / "cart.yaml").write_text(CART.replace("uniform(0, 4)", drawn) + f"test: {{{test}}}\n")
    return Task.of(Spec.parse(Source("cart.stl", SPEC)), System.load(tmp_path / "cart.yaml"))


def begun(task: Task, *seeds: int, agents: int = 30) -> tuple[torch.Tensor, int]:
    """The first states, and how many were drawn again."""
    worlds = Worlds(task, world_type(task.system.decl), Setting(seeds, agents, 10))
    return worlds.reset(), worlds.redrawn


def test_every_start_is_taken_unless_the_system_says_otherwise(tmp_path: Path) -> None:
    x, redrawn = begun(cart(tmp_path, "agents: 30"), 0)
    assert redrawn == 0
    assert float(x[:, 0].max()) > 3.0


@pytest.mark.parametrize(("starts", "highest"), [("savable", 3.0), ("feasible", 1.45)])
def test_starts_without_a_plan_are_drawn_again(tmp_path: Path, starts: str, highest: float) -> None:
    task = cart(tmp_path, f"starts: {starts}")
    x, redrawn = begun(task, 0, 1)
    assert bool((viable if starts == "savable" else solvable)(task, x).all())
    assert 0.75 * highest < float(x[:, 0].max()) < highest
    assert redrawn > 5
    drawn, _ = begun(cart(tmp_path, "starts: any"), 0, 1)
    kept = (drawn == x).all(1)
    assert torch.equal(kept, drawn[:, 0] < float(drawn[kept, 0].max()) + 1e-9), "the others keep theirs"
    assert len(torch.unique(x[:, 0])) == 60


def test_a_seed_begins_alike_whichever_others_there_are(tmp_path: Path) -> None:
    task = cart(tmp_path, "starts: feasible")
    assert torch.equal(begun(task, 3, 4)[0][30:], begun(task, 4)[0])


def test_a_world_without_hope_ends_the_deployment(tmp_path: Path) -> None:
    task = cart(tmp_path, "starts: feasible", drawn="uniform(2, 2.5)")
    with pytest.raises(RunError) as caught:
        begun(task, 0, agents=3)
    finding = caught.value.diagnostics[0]
    assert finding.code == "R405"
    assert "for 3 agents of seed 0" in finding.message
    assert any("savable" in text for text in finding.help)


WORLD = """
import torch

class Still:
    def __init__(self, system, agents, generator):
        self.agents = agents
    def reset(self):
        return torch.tensor([[2.0, 0.0]] * self.agents, dtype=torch.float64)
    def advance(self, x, action):
        return x
    def progress(self):
        return {}
    def units(self):
        return {}
    def snapshot(self):
        return {}
    @staticmethod
    def draw(axes, scene, index):
        pass

class Broken(Still):
    def redraw(self, rows):
        return self.reset() * float("nan")
"""


@pytest.mark.parametrize(("name", "code"), [("Still", "S211"), ("Broken", "S302")])
def test_a_world_that_cannot_draw_again_is_told(tmp_path: Path, name: str, code: str) -> None:
    (tmp_path / "still.py").write_text(WORLD)
    task = cart(tmp_path, f'world: "still.py:{name}", starts: feasible')
    with pytest.raises(SystemFileError) as caught:
        begun(task, 0, agents=2)
    assert caught.value.diagnostics[0].code == code


def test_events_happen_at_the_starts_that_are_drawn_again(tmp_path: Path) -> None:
    (tmp_path / "cart.yaml").write_text(CART + "test: {events: [{name: pushed, at: 0, set: {v: 1 m/s}}]}\n")
    system = System.load(tmp_path / "cart.yaml")
    world = ModelWorld(system, 4, torch.Generator().manual_seed(0))
    first, rows = world.reset(), torch.tensor([1, 3])
    again = world.redraw(rows)
    assert (again[:, 1] == 1.0).all()
    assert (again[rows] != first[rows]).any(1).all()
    assert torch.equal(again[[0, 2]], first[[0, 2]])


@pytest.mark.parametrize("name", ["ship_safe", "ship_track"])
def test_ships_are_drawn_again_on_the_same_river(name: str) -> None:
    system = System.load(EXAMPLES / f"{name}.yaml")
    world: Any = world_type(system.decl)(system, 6, torch.Generator().manual_seed(2))
    first, rows = world.reset(), torch.tensor([0, 4])
    chain = world.chain.x.clone()
    again = world.redraw(rows)
    others = [1, 2, 3, 5]
    assert torch.equal(again[others], first[others])
    assert (again[rows] != first[rows]).any(1).all()
    assert torch.equal(world.chain.x, chain)
    assert torch.equal(again[:, world.at["x1"]], first[:, world.at["x1"]])
    assert bool(system.initial.holds(again).all())
    assert isinstance(world.progress(), Mapping)
