"""Runs to export: the benchmarks with small networks that have learnt nothing, and a mission of a cart."""

from __future__ import annotations

import atexit
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import torch

from stlc import native
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.export.verify import BUILT
from stlc.export.write import Exported, export
from stlc.files import File
from stlc.grammar.spec import Spec

ROOT = Path(__file__).parents[2]
STRICT = ("-Wall", "-Wextra", "-Wshadow", "-pedantic", "-Werror")
"""Warnings of the C compiler that count as errors."""

CART = """stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 6 steps}
state:
  x: {unit: m, range: [-2, 2]}
  v: {unit: m/s, range: [-2, 2]}
control:
  u: {unit: m/s^2, range: [-8, 8]}
flow: {x: v, v: u}
objective:
  gamma: 0.2
  terms: [{name: calm, weight: 0.3, expr: abs(x - x_start)}, {name: work, weight: 0.1, expr: abs(u)}]
backup: {bins: 3, T0: [1, 2]}
init:
  mixture:
    - draw: {x: "uniform(-0.5, 0.5)", v: 0}
"""
MISSION = """spec cart
state signal x [m]
state signal v [m/s]
param far [m] in [0.1, 0.4]
@liveness
require there: eventually@[0 s, 1 s] x > far
require back: eventually@[1.2 s, 2 s] x < -far
@safety
require slow: always[0, T] abs(v) <= 1.5 m/s
"""


def run_of(spec: str, system: str, folder: Path, *, varied: bool = True) -> Run:
    """A run with a small network that has learnt nothing; if `varied`, it tries changed copies of plans."""
    files = ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"
    return untrained(*files, folder, varied=varied)


def untrained(spec: Path, system: Path, folder: Path, *, varied: bool = True) -> Run:
    """The same of any two files."""
    task = Task.of(Spec.parse(File(spec).read()), System.load(system))
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = PlanNetwork(task, hidden=(16, 16), plans=3, varied=varied).eval()
    network.normalise(task.sample(200, seed=1))
    opened = open_folder(task, TrainConfig(steps=1), Launch(root=folder, name="test"))
    return Run(opened, task, BestOfKPolicy(task, network))


@cache
def written(spec: str, system: str, target: str = "onnx") -> tuple[Run, Exported]:
    """The run of a benchmark, and what its export came to; nobody changes them, nor the files."""
    folder = _kept()
    run = run_of(spec, system, folder / "runs")
    return run, export(run, target, folder / "out")  # type: ignore[arg-type]


def exported(spec: str, system: str, target: str = "onnx") -> tuple[Run, Path]:
    """The run of a benchmark, and the folder that it was exported to."""
    run, done = written(spec, system, target)
    return run, done.folder


@cache
def mission() -> tuple[Run, Path]:
    """The same of a cart that makes promises on its mission clock, with a parameter."""
    folder = _kept()
    (folder / "cart.yaml").write_text(CART)
    (folder / "cart.stl").write_text(MISSION)
    run = untrained(folder / "cart.stl", folder / "cart.yaml", folder / "runs")
    return run, export(run, "onnx", folder / "out").folder


def build(folder: Path) -> Path:
    """The example program of an exported C controller, compiled without a warning."""
    using = native.compiler()
    assert using is not None
    target = folder / "controller"
    subprocess.run([using, *BUILT, *STRICT, "-o", str(target), str(folder / "main.c"), "-lm"], check=True)
    return target


def _kept() -> Path:
    """A folder that stays until the process ends."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
