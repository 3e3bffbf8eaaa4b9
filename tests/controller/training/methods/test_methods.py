"""Methods are files: found by name, read by schema and command line, judged, and opened again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from stlc import Run, System
from stlc.cli.framework.app import main
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import ModelRollout
from stlc.controller.problem.task import Task
from stlc.controller.run.run import load_config, save_config
from stlc.controller.search.planner_policy import PlannerChoice
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder, open_planner
from stlc.diagnostics import RunError, SystemFileError, UsageError
from stlc.registry import METHODS
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[4]
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")

COASTING = '''"""Coasting: the least force at every step, a planner that learns nothing."""

from stlc.controller.training.method import Method
from stlc.controller.policies.policy import ModelRollout


class Coasting(Method):
    def load(self, task, run, config, device):
        low = task.system.control_low
        return ModelRollout(lambda x: low.to(x).expand(len(x), -1), task)


METHOD = Coasting()
'''
CLIMBING = '''"""Climbing: one action a step, the state times a gain that is learnt by random steps."""

from dataclasses import dataclass

import torch
from stlc.controller.training.method import Learner, Method
from stlc.controller.policies.policy import ModelRollout
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.run.run import trained_on


@dataclass(frozen=True, slots=True)
class Options(ResolvedConfig):
    noise: float = 0.5


def feedback(task, gain):
    low, high = task.system.control_low, task.system.control_high
    return ModelRollout(lambda x: (x @ gain.to(x)).clamp(low.to(x), high.to(x)), task)


class Climber(Learner):
    def __init__(self, task, config, **rest):
        super().__init__(task, config, **rest)
        self.gain = torch.zeros(len(task.system.names), len(task.system.control_names))

    @property
    def policy(self):
        return feedback(self.task, self.gain)

    def advance(self):
        x0 = self.task.sample(32, generator=self.generator)
        other = self.gain + self.config.noise * torch.randn(self.gain.shape, generator=self.generator)
        mine, new = (-feedback(self.task, gain).plan_judged(x0)[1].rho.mean() for gain in (self.gain, other))
        self.gain = other if new < mine else self.gain
        self.step, self.loss = self.step + 1, float(min(mine, new))
        return self.loss

    def tensors(self):
        return super().tensors() | {"gain": self.gain}

    def restore(self, tensors, facts):
        super().restore(tensors, facts)
        self.gain = tensors["gain"]


class Climbing(Method):
    options = Options

    def learner(self, task, config, **rest):
        return Climber(task, config, **rest)

    def load(self, task, run, config, device):
        saved = load_checkpoint(run, spec_hash=run.hashes["spec_hash"], system_hash=trained_on(run))
        return feedback(task, saved.tensors["gain"])


METHOD = Climbing()
'''


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods more, in files of their own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STLC_METHODS", str(tmp_path / "methods"))
    (tmp_path / "methods").mkdir()
    for name, text in {"coasting": COASTING, "climbing": CLIMBING}.items():
        (tmp_path / "methods" / f"{name}.py").write_text(text, encoding="utf-8")


def test_the_default_comes_first_and_parts_of_methods_are_none() -> None:
    assert METHODS.names[0] == "guided"
    assert list(METHODS.names[1:]) == sorted(METHODS.names[1:])
    assert {"gradient", "plan"} < set(METHODS.names)
    assert all(METHODS.get(name).resolve is not None for name in METHODS)


def test_an_unknown_method_is_a_finding_with_a_way_out(car_task: Task) -> None:
    with pytest.raises(UsageError) as caught:
        resolve_config(car_task, TrainConfig(method="guide"))
    (finding,) = caught.value.diagnostics
    assert finding.message == "unknown method `guide`"
    assert finding.help == (f"did you mean `guided`?  methods: {', '.join(METHODS.names)}",)
    with pytest.raises(SystemFileError):
        System.load(CAR, {"train.method": "guide"})


@pytest.mark.usefixtures("added")
def test_a_method_is_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert METHODS.names[:4] == ("guided", "climbing", "coasting", "gradient")
    assert System.load(CAR, {"train.method": "coasting"}).decl.train.method == "coasting"
    options = ["--method", "coasting", "--held-out", "40", "--drives", "4", "--set", "test.steps=15"]
    code = main(["train", SPEC, "--system", CAR, *options, "--no-pictures", "--json"])
    document = json.loads(capsys.readouterr().out)
    result = document["result"]
    assert code == 0, document["diagnostics"]
    assert (result["steps"], result["held_out"]) == (0, 40)
    assert 0.0 < result["accuracy"] < 1.0
    assert {guard["guard"] for guard in result["closed_loop"]["guards"]} <= {"none", "paper", "full"}
    run = Run.open(result["run"])
    x = run.task.sample(5, seed=0, dtype=torch.float64)
    plans, judged = run.plan_judged(x)
    assert plans.shape == (5, run.task.horizon, 1)
    torch.testing.assert_close(judged.rho, run.task.judge(x, plans).rho)
    with pytest.raises(RunError, match="no network"):
        _ = run.network
    assert main(["train", "--resume", result["run"], "--no-pictures", "--json"]) == 0
    capsys.readouterr()


@pytest.mark.apart
@pytest.mark.usefixtures("added")
def test_a_method_of_one_action_a_step_is_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    """It has its own option, is trained, resumed bit for bit, deployed under guards, and opened again."""

    def trained(*words: str) -> Run:
        assert main(["train", *words, "--no-pictures", "--json"]) == 0
        return Run.open(json.loads(capsys.readouterr().out)["result"]["run"])

    options = [SPEC, "--system", CAR, "--method", "climbing", "--held-out", "40"]
    options += ["--drives", "4", "--set", "test.steps=15"]
    whole, part = trained(*options, "--steps", "60"), trained(*options, "--steps", "30")
    rows = [json.loads(line) for line in (whole.dir.path / "train.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [50]
    assert json.loads((whole.dir.path / "config.resolved.yaml").read_text())["noise"] == 0.5
    resumed = trained("--resume", str(part.dir.path), "--steps", "60")
    x = whole.task.sample(5, seed=0, dtype=torch.float64)
    assert torch.equal(whole.policy(x), resumed.policy(x))
    assert not torch.equal(whole.policy(x), torch.zeros_like(whole.policy(x)))
    guarded = Guard(whole.task, whole.policy, "full", limits=Limits(margin={"stop": 0.1})).decide(x)
    assert torch.isfinite(guarded.action).all()
    with pytest.raises(RunError, match="no network"):
        _ = whole.network


def test_an_actor_plans_along_the_model(car_task: Task) -> None:
    policy = ModelRollout(lambda x: 0.1 * x[:, :1], car_task)
    x = car_task.sample(4, seed=1, dtype=torch.float64)
    plans = policy.plan(x)
    path = car_task.rollout(x, plans)
    torch.testing.assert_close(plans, 0.1 * path[:, :-1, :1])


def test_names_are_known_without_torch() -> None:
    code = "import sys; from stlc.registry import METHODS; METHODS.names; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "options"), [("serach", {}), ("schedule", {"tries": "many"}), ("policy", {"run": "latest"})]
)
def test_a_refused_planner_leaves_no_run_behind(
    car_task: Task, tmp_path: Path, name: str, options: dict[str, str]
) -> None:
    with pytest.raises(UsageError):
        open_planner(
            car_task, PlannerChoice(name, options, 0.01), seed=0, launch=Launch(root=tmp_path / "runs")
        )
    assert not (tmp_path / "runs").exists()


def test_a_refused_option_leaves_no_run_behind(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(steps=1, options={"reward": "task"})
    with pytest.raises(UsageError):
        open_folder(car_task, config, Launch(root=tmp_path / "runs"))
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("option", [{"plans": 70_000}, {"batch": 10**9}, {"threads": 10**6}])
def test_an_option_that_a_run_could_not_be_opened_with_is_refused(
    option: dict[str, int], car_task: Task
) -> None:
    with pytest.raises(UsageError, match=next(iter(option))):
        resolve_config(car_task, TrainConfig(**option))  # type: ignore[arg-type]


@pytest.mark.parametrize("option", [{"lr": 1e38}, {"seed": 2**63 - 1}])
def test_an_option_that_is_accepted_is_read_again(
    option: dict[str, float], car_task: Task, car_run: RunDir
) -> None:
    config = resolve_config(car_task, TrainConfig(**option))  # type: ignore[arg-type]
    save_config(car_run, config)
    assert load_config(car_run) == config


def test_options_of_a_planner_are_kept_and_damaged_ones_are_a_finding(car_task: Task, tmp_path: Path) -> None:
    choice = PlannerChoice("search", {"tries": "64"}, 0.01)
    folder = open_planner(car_task, choice, seed=0, launch=Launch(root=tmp_path / "runs"))
    assert Run.open(folder.path).policy.plan(car_task.sample(2, seed=0)).shape == (2, 25, 1)
    path = folder.path / "config.resolved.yaml"
    for damaged in ("x", "[1]", "3"):
        values = json.loads(path.read_text()) | {"options": damaged}
        path.write_text(json.dumps(values))
        with pytest.raises(RunError, match="damaged"):
            Run.open(folder.path)
