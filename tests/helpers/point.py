"""A point on a line, for tests that need a system and little else."""

from __future__ import annotations

from pathlib import Path

from stlc.controller.problem.task import Task
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """
stlc: 1
name: point
time: {dt: 1 s, horizon: 8 steps, integrator: euler}
state: {x: {unit: m, range: [0, 10]}}
control: {v: {unit: m/s, range: [-1, 1]}}
flow: {x: v}
init: {mixture: [{draw: {x: "uniform(4, 5)"}}]}
"""


def task(folder: Path, rules: str) -> Task:
    """Task of a point that moves at up to 1 m/s between 0 and 10 m."""
    (folder / "point.yaml").write_text(SYSTEM)
    spec = f"spec s\nstate signal x [m]\n{rules}\n"
    return Task.of(Spec.parse(Source("s.stl", spec)), System.load(folder / "point.yaml"))
