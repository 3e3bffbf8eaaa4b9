"""Drives of a campaign: verdicts agree with those of deployments, and units with what worlds say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.small_systems import moved_by_steps

from stlc.assurance.campaign import BATCH, FIRST, SEED, Campaign, campaign
from stlc.assurance.certificate import Claim, Judged, Sample
from stlc.assurance.drives import PolicyDrives, sample_of
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.rules import Rules
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import BestOfKPolicy
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.world import ModelWorld, independent_agents
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.jsontext import plain
from stlc.registry import METHODS
from stlc.source import Source

ROOT = Path(__file__).parents[2]
SMALL = {"test.steps": "30", "test.agents": "4", "test.world": "null"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """An untrained car."""
    spec = Spec.parse(File(ROOT / "specs" / "traffic.stl").read())
    task = Task.of(spec, System.load(ROOT / "examples" / "car.yaml", SMALL))
    config = TrainConfig()
    folder = open_folder(task, config, Launch(root=tmp_path_factory.mktemp("runs")))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        resolved = resolve_config(task, config)
        network = METHODS.get(resolved.method).network(task, resolved)
    return Run(folder, task, BestOfKPolicy(task, network))


def test_drives_are_judged_as_deployments_are(run: Run) -> None:
    setting = Setting((0, 1, 2), 4, 30, 1)
    recorder = Recorder(4, pictured=False)
    simulate(Guard(run.task, run.policy, "none"), ModelWorld, setting, recorder)  # type: ignore[arg-type]
    recording = recorder.recording()
    assert recording is not None
    found = sample_of(run.task, recording)
    executed = judge_executed(run.task, recording, viable=np.ones(12, dtype=bool))
    for each in found.requirements:
        held = executed.rules[each.name].all(0)
        assert (each.satisfied == held).all()
        assert (each.violated == ~held).all()
        assert ((each.robustness >= -TOLERANCE) == held).all()
    assert not found.overall.satisfied.all()
    assert found.units.tolist() == list(range(12))
    by_rules = sample_of(run.task, recording, Rules.of(run))
    assert {each.name for each in by_rules.requirements} != {each.name for each in found.requirements}


@pytest.mark.parametrize(
    ("formula", "values", "satisfied", "violated", "least"),
    [
        ("always[0 s, 6 s] x < 5", [0, 1, 2, 3], False, False, -np.inf),
        ("always[0 s, 6 s] x < 2", [0, 1, 2, 3], False, True, -np.inf),
        ("always@[10 s, 20 s] x < 5", [0, 1, 2, 3], False, False, -np.inf),
        ("eventually@[0 s, 20 s] x > 5", [0, 1, 2, 3], False, False, -2),
        ("eventually@[0 s, 20 s] x > 2", [0, 1, 2, 3], True, False, 1),
        ("always[0 s, T] x < 5", [0, 1, 2, 3], False, False, -np.inf),
        ("always[0 s, 3 s] x < 5", [0, 1, 2, 3], True, False, 2),
        ("always[0 s, 3 s] x < 5", [0, 1, 2, np.nan], False, True, -np.inf),
    ],
)
def test_a_drive_that_ends_before_a_window_may_be_undecided(
    tmp_path: Path, formula: str, values: list[float], satisfied: bool, violated: bool, least: float
) -> None:
    (tmp_path / "cart.yaml").write_text(moved_by_steps("cart", "uniform(0, 1)", horizon=6))
    spec = Spec.parse(Source("cart.stl", f"signal x\nrequire r: {formula}"))
    task = Task.of(spec, System.load(tmp_path / "cart.yaml"))
    states = np.zeros((2, 4, len(task.system.names)))
    states[:, :, task.system.names.index("x")] = values
    each, none = np.zeros((2, 3)), np.zeros((2, 3), dtype=np.int64)
    recording = DeploymentRecording(
        1, states, each[..., None], none, none, each, each, none > 0, ({},) * 2, {}, {}
    )
    (found,) = sample_of(task, recording).requirements
    assert found.satisfied.tolist() == [satisfied] * 2
    assert found.violated.tolist() == [violated] * 2
    assert found.robustness.tolist() == [least] * 2


def test_drives_that_violate_an_assumption_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "cart.yaml").write_text(moved_by_steps("cart", "uniform(0, 1)", horizon=3))
    spec = Spec.parse(
        Source("cart.stl", "signal x\nassume calm: always[0 s, 3 s] x < 4\nrequire r: always[0 s, 3 s] x < 2")
    )
    task = Task.of(spec, System.load(tmp_path / "cart.yaml"))
    states = np.zeros((4, 4, len(task.system.names)))
    states[:, :, task.system.names.index("x")] = [[0, 1, 1, 1], [0, 1, 5, 1], [0, 3, 3, 3], [0, 1, 1, 9]]
    each, none = np.zeros((4, 3)), np.zeros((4, 3), dtype=np.int64)
    recording = DeploymentRecording(
        2, states, each[..., None], none, none, each, each, none > 0, ({},) * 4, {}, {}
    )
    judge = Rules(spec, "cart.stl")
    for rules in (None, judge):
        found = sample_of(task, recording, rules)
        assert (found.drives, found.left_out, found.count) == (2, 2, 2)
        assert found.units.tolist() == [0, 1]
        assert found.overall.satisfied.tolist() == [True, False]
        assert found.requirements[0].violated.tolist() == [False, True]
        assert len(found.predicted) == 2
    bounds = found.assess(Claim(0.9))
    assert bounds.left_out == 2
    assert "2 drives that violate an assumption of the specification are left out" in bounds.assumptions


def test_a_campaign_is_repeatable_and_counts_its_seeds(run: Run) -> None:
    drives = PolicyDrives(run, Rules.of(run), "none", Setting((), 4, 2, 1))
    order = Campaign(drives, Claim(0.999), most=FIRST + 20)
    first, again = list(campaign(order)), next(campaign(order))
    assert plain(first[0].assessment) == plain(again.assessment)
    last = first[-1]
    assert last.done
    assert last.seeds == tuple(range(SEED, SEED + last.assessment.overall.units // 4))
    assert all(not each.done for each in first[:-1])
    assert last.assessment.claim.calibration == FIRST


class Late:
    """A subject whose first batch is out of scope; it satisfies every other observation."""

    doing, per_seed, packages, assumptions = "observing", 1, (), ()

    def observed(self, seeds: Sequence[int]) -> Iterator[Sample]:
        if seeds[0] > SEED:
            good = np.arange(len(seeds)) % 2 == 0
            judged = Judged("r", "", good, ~good, np.where(good, 1.0, -1.0))
            yield Sample(judged, (judged,), np.arange(len(seeds)), "simulation")

    def record(self, seeds: Sequence[int]) -> dict[str, Any]:  # noqa: ARG002
        return {}

    def close(self) -> None:
        pass


def test_units_of_the_first_batch_in_scope_calibrate_whatever_follows() -> None:
    found = list(campaign(Campaign(Late(), Claim(0.5), most=FIRST + 4 * BATCH)))
    assert [each.assessment.calibration for each in found] == [BATCH] * 4


class Derived(ModelWorld):
    """A world that might couple its agents."""


class Declared(ModelWorld):
    independent = True


class Odd(ModelWorld):
    independent = "perhaps"


def test_only_a_world_itself_says_that_its_agents_are_independent() -> None:
    found = [independent_agents(each) for each in (ModelWorld, Derived, Declared, Odd)]  # type: ignore[arg-type]
    assert found == [True, False, True, False]
