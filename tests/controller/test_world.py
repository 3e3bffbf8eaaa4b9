from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.controller.world import ModelWorld, world_type
from stlc.diagnostics import SystemFileError
from stlc.dynamics.system import System

F64 = torch.float64

YAML = """
stlc: 1
name: dot
time: {dt: 0.5 s, horizon: 4 steps}
state:
  p: {unit: m, range: [0, 10]}
  w: {unit: m/s, range: [0, 5]}
control:
  u: {unit: m/s^2, range: [-1, 1]}
flow: {p: w, w: u}
init:
  mixture:
    - {name: start, weight: 1, draw: {p: 0, w: 1}}
test:
  agents: 3
  steps: 10
"""


def system(tmp_path: Path, test: str = "") -> System:
    path = tmp_path / "dot.yaml"
    path.write_text(YAML + test)
    return System.load(path)


def run(world: ModelWorld, steps: int) -> np.ndarray:
    x = world.reset()
    frames = [x]
    for _ in range(steps):
        x = world.advance(x, torch.zeros(len(x), 1, dtype=F64))
        frames.append(x)
    return torch.stack(frames).numpy()


def make(made: System, agents: int = 3, seed: int = 0) -> ModelWorld:
    return world_type(made.decl)(made, agents, torch.Generator().manual_seed(seed))  # type: ignore[return-value]


# ---------------------------------------------------------------------------- events


def test_without_events_the_world_is_the_model(tmp_path: Path) -> None:
    states = run(make(system(tmp_path)), 6)
    assert states[:, 0, 0].tolist() == [0.5 * k for k in range(7)]
    assert (states[..., 1] == 1.0).all()


def test_an_event_by_state_happens_to_whom_it_concerns_and_is_counted(tmp_path: Path) -> None:
    world = make(system(tmp_path, "  events:\n    - {name: lap, when: p >= 2, set: {p: 0}}\n"))
    states = run(world, 8)
    assert states[:, 0, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 0.0, 0.5, 1.0, 1.5, 0.0]
    assert world.progress() == {"lap": 6.0}


def test_events_by_the_clock(tmp_path: Path) -> None:
    events = (
        "  events:\n    - {name: stop, at: 1 s, set: {w: 0}}\n    - {name: go, every: 2 s, set: {w: 2}}\n"
    )
    states = run(make(system(tmp_path, events)), 6)
    assert states[:, 0, 1].tolist() == [1.0, 1.0, 0.0, 0.0, 2.0, 2.0, 2.0]


def test_a_rising_edge_happens_once(tmp_path: Path) -> None:
    world = make(system(tmp_path, "  events:\n    - {name: in, when: rise(p >= 1), set: {w: w + 1}}\n"), 1)
    assert run(world, 5)[:, 0, 1].tolist() == [1.0, 1.0, 2.0, 2.0, 2.0, 2.0]
    assert world.progress() == {"in": 1.0}


def test_draws_are_each_agents_own_and_repeat_with_the_seed(tmp_path: Path) -> None:
    made = system(tmp_path, '  events:\n    - {name: jolt, every: 1 s, set: {w: "uniform(0, 5)"}}\n')
    first, again, other = (run(make(made, 50, seed), 4) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(np.unique(first[2, :, 1])) == 50


def test_reset_begins_anew(tmp_path: Path) -> None:
    world = make(system(tmp_path, "  events:\n    - {name: lap, when: p >= 2, set: {p: 0}}\n"))
    first = run(world, 8)
    assert np.array_equal(run(world, 8), first)
    assert world.progress() == {"lap": 6.0}


def test_a_frame_of_the_model_world(tmp_path: Path) -> None:
    figures = pytest.importorskip("matplotlib.figure")
    world = make(system(tmp_path))
    world.reset()
    scene = {name: np.stack([value]) for name, value in world.snapshot().items()}
    axes = figures.Figure().add_subplot()
    world.draw(axes, scene, 0)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("p", "w")
    assert sum(len(points.get_offsets()) for points in axes.collections) == 3


# ---------------------------------------------------------------------------- loading

WORLD = """
from dataclasses import dataclass

@dataclass(slots=True)
class Still:
    system: object
    agents: int
    generator: object
    def reset(self): return self.system.sample(self.agents, generator=self.generator)
    def advance(self, x, action): return x
    def progress(self): return {}
    def units(self): return {}
    def snapshot(self): return {}
    @staticmethod
    def draw(axes, scene, index): pass

class Halting:
    def reset(self): pass
"""


def named(tmp_path: Path, reference: str, text: str = WORLD) -> System:
    (tmp_path / "worlds.py").write_text(text)
    return system(tmp_path, f'  world: "{reference}"\n')


def test_a_world_beside_the_system_file_is_loaded(tmp_path: Path) -> None:
    made = named(tmp_path, "worlds.py:Still")
    world = make(made, 4)
    assert type(world).__name__ == "Still"
    assert world.reset().shape == (4, 2)


@pytest.mark.parametrize(
    ("reference", "text", "said"),
    [
        ("other.py:Still", WORLD, "there is no file"),
        ("worlds.py:Stil", WORLD, "has no class `Stil`"),
        ("worlds.py:Halting", WORLD, "it lacks advance, progress, units, snapshot, draw"),
        ("worlds.py:Still", "1 / 0", "importing"),
        ("worlds.py:Still", "def (", "importing"),
        ("worlds.py:Still", "Still = 3", "has no class"),
    ],
)
def test_a_world_that_cannot_be_loaded(tmp_path: Path, reference: str, text: str, said: str) -> None:
    made = named(tmp_path, reference, text)
    with pytest.raises(SystemFileError) as caught:
        world_type(made.decl)
    (finding,) = caught.value.diagnostics
    assert finding.code == "S206"
    assert said in finding.message
    assert finding.span is not None
    assert reference in finding.span.text
    if "Stil`" in said:
        assert finding.help == ("did you mean `Still`?",)
