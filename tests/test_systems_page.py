"""The page about system files is true: its blocks are one file that loads, moves, and is deployed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from stlc.controller.world import ModelWorld
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.source import Source

PAGE = Path(__file__).resolve().parent.parent / "docs/systems.md"
BLOCK = re.compile(r"^```yaml(?P<kind>[^\n]*)\n(?P<text>.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(kind: str) -> list[str]:
    found = BLOCK.finditer(PAGE.read_text(encoding="utf-8"))
    return [match["text"] for match in found if match["kind"].strip() == kind]


def system(text: str) -> System:
    return System(parse_system(Source("arm.yaml", text), Path("arm.yaml")))


def moved(of: System) -> torch.Tensor:
    world = ModelWorld(of, 20, torch.Generator().manual_seed(0))
    x = world.reset()
    for _ in range(30):
        x = world.advance(x, torch.ones(20, 2, dtype=torch.float64))
    return x


def test_the_file_on_the_page_works() -> None:
    arm = system("\n".join(blocks("")))
    assert arm.names[:4] == ("q[0]", "q[1]", "goal[0]", "goal[1]")
    assert arm.names[-3:] == ("radius", "load", "warm_happened")
    assert arm.probe() == ()
    assert arm.observed_count == 8
    assert bool(torch.isfinite(moved(arm)).all())


def test_a_grid_instead() -> None:
    whole = "\n".join(text for text in blocks("") if not text.startswith("init:"))
    (other,) = blocks("instead")
    x0 = system(whole + other).sample(84, seed=0, dtype=torch.float64)
    assert len({tuple(row) for row in x0[:, [0, 1, 4]].tolist()}) == 84


def test_a_ball_that_bounces_within_a_step() -> None:
    (text,) = blocks("ball")
    ball = system(text)
    x0 = ball.sample(10, seed=0, dtype=torch.float64)
    x = ball.rollout(x0, torch.zeros(10, ball.horizon, 0, dtype=torch.float64))
    assert x[:, :, 0].min() > -1e-4
    assert x[:, 1:, 1].max() > 3.0


def test_a_feedback_beneath_the_plans() -> None:
    whole = "\n".join(text for text in blocks("") if not text.startswith("policy:"))
    whole = re.sub(r"^policy:.*$", "", whole, flags=re.MULTILINE)
    regulator, given = (system(whole + text) for text in blocks("feedback"))
    assert regulator.decl.feedback is not None
    assert given.decl.feedback is not None
    assert given.decl.feedback.gain[1][1] == 3.0
    assert given.decl.feedback.authority == (2.0, 2.0)
    assert bool(torch.isfinite(moved(regulator)).all())


@pytest.mark.parametrize("name", ["heavy", "longer", "worn", "windy", "blurred", "late"])
def test_every_scenario_can_be_laid_over(name: str) -> None:
    decl = parse_system(Source("arm.yaml", "\n".join(blocks(""))), Path("arm.yaml"))
    laid = System(under(decl, name))
    assert bool(torch.isfinite(moved(laid.truth)).all())


def test_a_plant_with_input_signals_tables_and_held_values() -> None:
    plant = system("".join(blocks("plant")))
    assert [each.name for each in plant.decl.inputs] == ["outside", "open"]
    assert [each.name for each in plant.decl.tables] == ["power", "loss"]
    assert plant.probe() == ()
    x = plant.rollout(plant.sample(50, seed=0), torch.zeros(50, plant.horizon, 0))
    valve, mode = (x[:, :, plant.names.index(name)] for name in ("valve", "mode"))
    assert bool((valve[:, 1:6] == valve[:, :1]).all())
    assert 0.0 <= valve.min() < valve.max() == 1.0
    assert mode.unique().tolist() == [0.0, 1.0]


def test_a_file_from_it(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text("\n".join(blocks("")))
    (tmp_path / "short.yaml").write_text(blocks("separate")[0])
    decl = load_system_decl(tmp_path / "short.yaml")
    assert (decl.name, decl.constants["reach"][0]) == ("short_arm", 0.8)
