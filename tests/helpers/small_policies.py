"""Policies of small networks with random weights, without a training."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parents[2]


@cache
def task_of(spec: str, system: str) -> Task:
    files = ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"
    return Task.of(Spec.parse(File(files[0]).read()), System.load(files[1]))


def half_seen_task(folder: Path) -> Task:
    """A task whose policy sees `y` and not `x`; both are uniform from -1 to 1, and `x < 1.2` is required."""
    path = folder / "half_seen.yaml"
    path.write_text(
        """
stlc: 1
name: half_seen
time: {dt: 1 s, horizon: 1 steps, discrete: true}
state:
  y: {range: [-1, 1]}
  x: {range: [-9, 9]}
control:
  u: {range: [-9, 9], squash: clip}
flow:
  x: x - u
init:
  mixture:
    - draw: {y: "uniform(-1, 1)", x: "uniform(-1, 1)"}
policy:
  observe: [y]
"""
    )
    text = "signal x, y\nrequire r: always[0 s, 1 s] x < 1.2"
    return Task.of(Spec.parse(Source("half_seen.stl", text)), System.load(path))


@cache
def policy() -> BestOfKPolicy:
    """A policy of `traffic`, whose first proposal brakes hard and whose second does little."""
    task = task_of("traffic", "car")
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(5)
        network = PlanNetwork(task, hidden=(24, 16), plans=2, varied=True).eval()
        network.normalise(task.sample(500, seed=1))
        last = network.body[-1]
        last.weight *= 0.3
        last.bias.view(2, -1)[0] -= 0.8
    return BestOfKPolicy(task, network)
