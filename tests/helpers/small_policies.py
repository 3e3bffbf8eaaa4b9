"""Policies of small networks with random weights, without a training."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.dynamics.model.system import System
from stlc.files import read_source
from stlc.grammar.parse.parser import parse

ROOT = Path(__file__).parents[2]


@cache
def task_of(spec: str, system: str) -> Task:
    files = ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"
    return Task.of(parse(read_source(files[0])), System.load(files[1]))


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
