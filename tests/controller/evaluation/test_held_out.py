"""The verdict on held-out states: what is known to be possible beside what a policy does."""

from __future__ import annotations

from pathlib import Path

import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.held_out import save_states, score
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.run.config import HELD_OUT_SEED
from stlc.controller.search.feasibility import solvable
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir
from stlc.view.held_out import load_held_out


def test_what_is_known_is_kept_state_by_state(car_task: Task, tmp_path: Path) -> None:
    engine = resolve_config(car_task, TrainConfig())
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = BestOfKPolicy(car_task, PlanNetwork(car_task, hidden=engine.hidden, plans=1))
    reports: list[str] = []
    found = score(car_task, policy, n=60, report=reports.append)
    good = TOLERANCE.satisfied(found.rho)
    assert reports == [
        "evaluation, 0 of 60 held-out starts",
        f"evaluation, search of 0 of {60 - int(good.sum())} failing starts",
    ]
    assert 0 < int(good.sum()) < 60
    assert bool(found.known[good].all())
    assert found.feasible == float(found.known.double().mean()) > found.accuracy
    folder = RunDir(tmp_path)
    save_states(folder.place(RunDir.HELD_OUT), car_task, found)
    held = load_held_out(folder)
    assert held is not None
    failing, known = held.unsolved
    assert failing == 60 - int(good.sum())
    assert known == int(found.known.sum()) - int(good.sum())
    assert held.unsolved_text.startswith(f"{failing} of 60 starts; a satisfying plan is known for {known} ")


def test_what_is_feasible_hardly_depends_on_the_policy() -> None:
    """Ships that nobody has trained: where search begins with their plans alone it knows half as many."""
    root = Path(__file__).parents[3]
    spec = Spec.parse(File(root / "specs" / "ship_track.stl").read())
    task = Task.of(spec, System.load(root / "examples" / "ship_track.yaml"))
    engine = resolve_config(task, TrainConfig())
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = BestOfKPolicy(task, PlanNetwork(task, hidden=engine.hidden, plans=1))
    found = score(task, policy, n=60)
    assert found.accuracy < 0.05
    states = task.sample(60, seed=HELD_OUT_SEED, dtype=torch.float64)
    assert found.feasible >= 0.85 * float(solvable(task, states).double().mean())
    assert int(found.searched.sum()) == 60
