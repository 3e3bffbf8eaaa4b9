"""Training: reproducible, resumable bit for bit, interruptible, and better than where it began."""

from __future__ import annotations

import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from stlc.controller.evaluation.held_out import score, wilson
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.run.run import Run
from stlc.controller.search.local_search import SearchResult
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.learner import Trainer
from stlc.controller.training.loop import Watch, resume, train
from stlc.diagnostics import MissingError, RunError
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
STEPS = 110


def _folder(task: Task, root: Path, config: TrainConfig) -> RunDir:
    return open_folder(task, config, Launch(root=root))


def _saved(run: RunDir) -> dict[str, torch.Tensor]:
    hashes = run.hashes
    return load_checkpoint(run, **hashes).tensors


def test_a_fixed_training_set(car_task: Task) -> None:
    engine = replace(resolve_config(car_task, TrainConfig(method="gradient", batch=16)), samples=40)
    trainer, again = (Trainer(car_task, engine, steps=9, device=torch.device("cpu")) for _ in range(2))
    for _ in range(5):
        trainer.advance()
    again.restore({name: value.clone() for name, value in trainer.tensors().items()}, trainer.facts())
    for _ in range(2):
        assert trainer.advance() == again.advance()
    assert all(torch.equal(value, again.tensors()[name]) for name, value in trainer.tensors().items())
    trainer.training.take(8)  # 7 x 16 + 8 states: the set has been handed out three times
    states, counts = trainer.training.take(120).unique(dim=0, return_counts=True)
    assert (len(states), set(counts.tolist())) == (40, {3})
    assert len(trainer.supply.take(60).unique(dim=0)) == 60


def test_the_system_file_may_ask_for_a_training_set() -> None:
    system = System.load(ROOT / "examples" / "car.yaml", {"train.samples": "500"})
    task = Task.of(Spec.parse(File(ROOT / "specs" / "traffic.stl").read()), system)
    assert resolve_config(task, TrainConfig(method="gradient")).samples == 500
    assert resolve_config(task, TrainConfig(method="guided")).samples == 0


@pytest.mark.apart
@pytest.mark.parametrize("method", ["guided", pytest.param("gradient", marks=pytest.mark.slow)])
def test_a_killed_and_resumed_run_equals_an_uninterrupted_one(
    car_task: Task, tmp_path: Path, method: str
) -> None:
    config = TrainConfig(held_out=50, drives=0, method=method, steps=STEPS, seed=3, batch=64)  # type: ignore[arg-type]
    whole = train(car_task, config, _folder(car_task, tmp_path / "a", config))
    count = []
    first = _folder(car_task, tmp_path / "b", config)
    stopped = train(car_task, config, first, Watch(stop=lambda: bool(count.append(1)) or len(count) == 71))
    assert stopped.interrupted
    assert first.status == "interrupted"
    again = resume(first)
    assert not again.interrupted
    left, right = _saved(whole.run.dir), _saved(first)
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert torch.equal(value, right[name]), name
    assert [row["step"] for row in first.rows()] == [row["step"] for row in whole.run.dir.rows()]


@pytest.mark.apart
def test_a_run_that_ends_at_a_look_repeats_it(car_task: Task, tmp_path: Path) -> None:
    """The checkpoint of step 50 is older than the row of the look there, written or not."""
    config = TrainConfig(held_out=50, drives=0, method="gradient", steps=52, seed=3, batch=16)
    whole = train(car_task, config, _folder(car_task, tmp_path / "a", config)).run.dir.rows()
    count = []
    first = _folder(car_task, tmp_path / "b", config)
    train(car_task, config, first, Watch(stop=lambda: bool(count.append(1)) or len(count) == 50))
    assert first.rows() == []
    second = RunDir(shutil.copytree(first.path, tmp_path / "c" / first.name))
    second.append_row(whole[0])
    for run in (first, second):
        resume(run)
        wanted, rows = (
            [{**row, "seconds": 0, "s_per_step": 0} for row in each] for each in (whole, run.rows())
        )
        assert rows == wanted
        assert [row["step"] for row in rows] == [50]


def test_a_resumed_run_has_the_threads_it_was_started_with(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=4, batch=16, threads=1)
    folder = _folder(car_task, tmp_path, config)
    train(car_task, config, folder, Watch(stop=lambda: True))
    told: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", told.append)
    resume(folder)
    assert told == [1]


def test_the_system_file_chooses_the_method_unless_told() -> None:
    spec = Spec.parse(File(ROOT / "specs/traffic.stl").read())
    system = System.load(ROOT / "examples/car.yaml", {"train.method": "gradient"})
    task = Task.of(spec, system)
    assert resolve_config(task, TrainConfig()).method == "gradient"
    assert resolve_config(task, TrainConfig(method="guided")).method == "guided"


def test_a_slow_run_is_saved_by_the_clock(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stlc.controller.training.loop.SAVE_SECONDS", 0.0)
    config = TrainConfig(held_out=50, drives=0, steps=3, batch=16)
    folder = _folder(car_task, tmp_path, config)
    seen: list[bool] = []
    pointer = folder.path / "ckpt" / "last.json"
    train(car_task, config, folder, Watch(stop=lambda: bool(seen.append(pointer.exists()))))
    assert len(seen) >= 3
    assert all(seen)


def test_seeds_matter_and_repeat(car_task: Task, tmp_path: Path) -> None:
    def weights(seed: int, root: str) -> torch.Tensor:
        config = TrainConfig(held_out=50, drives=0, steps=20, seed=seed, batch=32)
        return _saved(train(car_task, config, _folder(car_task, tmp_path / root, config)).run.dir)[
            "network.body.0.weight"
        ]

    first = weights(1, "a")
    assert torch.equal(first, weights(1, "b"))
    assert not torch.equal(first, weights(2, "c"))


def test_a_short_run_learns_and_opens_again(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=300, steps=150, drives=0, seed=0)
    outcome = train(car_task, config, _folder(car_task, tmp_path, config))
    assert outcome.score is not None
    assert outcome.score.accuracy > 0.6
    assert outcome.score.feasible >= outcome.score.accuracy
    low, high = outcome.score.interval
    assert low < outcome.score.accuracy < high
    opened = Run.open(outcome.run.dir.path)
    x0 = car_task.sample(50, seed=11, dtype=torch.float64)
    assert torch.equal(opened.policy(x0), outcome.run.policy(x0))
    assert opened.policy(x0).shape == (50, car_task.horizon, 1)
    record = outcome.run.dir.record()
    assert record["status"] == "finished"
    assert record["result"]["accuracy"] == outcome.score.accuracy
    assert set(record["result"]["requirements"]) == {rule.name for rule in car_task.rules}


def test_resuming_a_finished_run_says_so(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=5, batch=32)
    folder = _folder(car_task, tmp_path, config)
    train(car_task, config, folder)
    with pytest.raises(RunError) as caught:
        resume(folder)
    assert caught.value.diagnostics[0].code == "R103"
    record = folder.path / "run.json"
    told = record.read_text()
    for damaged in ("{}", '{"status": "finished", "seed": 0}'):
        record.write_text(damaged)
        with pytest.raises(RunError, match=r"run\.json` is damaged"):
            resume(folder)
        assert record.read_text() == damaged
    record.write_text(told)
    assert resume(folder, steps=8).run.dir.record()["steps"] == 8


def test_a_run_that_is_being_trained_is_not_resumed(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=3, seed=3, batch=16)
    folder, refused = _folder(car_task, tmp_path, config), []

    def another() -> bool:
        for _ in range(2):
            with pytest.raises(RunError) as caught:
                resume(folder)
            refused.append(caught.value.diagnostics[0].code)
        return len(refused) == 4

    assert train(car_task, config, folder, Watch(stop=another)).interrupted
    assert resume(folder).steps == 3
    assert refused == ["R109"] * 4


def test_a_changed_spec_is_refused(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=5, batch=32)
    folder = _folder(car_task, tmp_path, config)
    train(car_task, config, folder)
    path = folder.path / "spec.stl"
    path.write_text(path.read_text().replace("tau >= 1 s", "tau >= 2 s"))
    for call in (lambda: Run.open(folder.path), lambda: resume(folder)):
        with pytest.raises(RunError) as caught:
            call()
        assert caught.value.diagnostics[0].code == "R102"


def test_the_deployment_may_be_edited_but_not_what_is_learnt(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=5, batch=32)
    folder = _folder(car_task, tmp_path, config)
    train(car_task, config, folder)
    path = folder.path / "system.yaml"
    text = path.read_text()
    path.write_text(text.replace("steps: 150", "steps: 15") + "# a note\n")
    assert Run.open(folder.path).task.system.decl.test.steps == 15
    path.write_text(text.replace("gamma: 0.5", "gamma: 0.4"))
    assert path.read_text() != text
    with pytest.raises(RunError) as caught:
        Run.open(folder.path)
    assert caught.value.diagnostics[0].code == "R102"


@pytest.mark.slow
def test_a_budget_becomes_steps(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=200, budget=3.0, batch=32)
    folder = _folder(car_task, tmp_path, config)
    train(car_task, config, folder)
    assert folder.record()["steps"] >= 2


def test_a_device_that_is_not_there(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=200, steps=5, device="cuda:77")
    with pytest.raises(MissingError) as caught:
        train(car_task, config, _folder(car_task, tmp_path, config))
    assert caught.value.diagnostics[0].code == "R302"


def test_held_out_states_are_always_the_same(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=5, batch=32)
    policy = train(car_task, config, _folder(car_task, tmp_path, config)).run.policy
    first, second = score(car_task, policy, n=200), score(car_task, policy, n=200)
    assert torch.equal(first.states, second.states)
    assert first.accuracy == second.accuracy
    assert first.states.dtype == torch.float64


def test_wilson_interval_of_known_cases() -> None:
    low, high = wilson(0.5, 100)
    assert abs(low - 0.4038) < 1e-3
    assert abs(high - 0.5962) < 1e-3
    assert all(wilson(1.0, n)[1] == 1.0 for n in (1, 10, 320))
    assert wilson(0.0, 10)[0] == 0.0


def test_a_run_that_was_interrupted_before_its_first_checkpoint_begins_again(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=4, seed=3, batch=16)
    whole = train(car_task, config, _folder(car_task, tmp_path / "a", config))
    folder = _folder(car_task, tmp_path / "b", config)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "advance", lambda _self: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(car_task, config, folder)
    assert resume(folder).steps == 4
    left, right = _saved(whole.run.dir), _saved(folder)
    assert all(torch.equal(value, right[name]) for name, value in left.items())


def test_a_checkpoint_keeps_a_search_that_goes_on(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = resolve_config(car_task, TrainConfig(batch=16, seed=1))
    trainer, again = (Trainer(car_task, engine, steps=9, device=torch.device("cpu")) for _ in range(2))
    trainer.advance()
    trainer.validate()
    assert trainer.repairing is not None
    search = trainer.repairing
    with monkeypatch.context() as patch:
        patch.setattr(search, "result", lambda stop: stop() and None)  # whatever the clock says, it goes on
        again.restore({name: value.clone() for name, value in trainer.tensors().items()}, trainer.facts())
    assert again.repairing is not None
    assert again.repairing.seed == search.seed
    one, other = search.result(), again.repairing.result()
    assert one is not None
    assert other is not None
    assert torch.equal(one.plans, other.plans)


def test_without_a_compiler_torch_judges_in_parts(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stlc.native.compiler", lambda: None)
    task = Task(car_task.compiled, System(car_task.system.decl))
    x0 = task.sample(100, seed=7, dtype=torch.float64)
    plans = torch.zeros(100, task.horizon, 1, dtype=torch.float64)
    whole = task.judge(x0, plans)
    monkeypatch.setattr("stlc.controller.problem.task.MOST_VALUES", 7 * task._values_of_a_row)
    parts = task.judge(x0, plans)
    assert torch.equal(whole.rho, parts.rho)
    assert all(torch.equal(column, parts.columns[name]) for name, column in whole.columns.items())


def test_the_verdict_ends_when_its_time_is_over(car_task: Task) -> None:
    engine = resolve_config(car_task, TrainConfig(batch=16, seed=1))
    trainer = Trainer(car_task, engine, steps=9, device=torch.device("cpu"))
    found = score(trainer.task, trainer.policy, n=1200, stop=lambda: True)
    assert len(found.states) == 500
    assert found.accuracy <= found.feasible


def test_a_search_round_takes_the_nearest_misses_first_and_some_others(car_task: Task) -> None:
    engine = replace(resolve_config(car_task, TrainConfig(batch=16, seed=1)), most=8)
    trainer = Trainer(car_task, engine, steps=9, device=torch.device("cpu"))
    rho = torch.tensor([0.2, -5.0, -0.3, -4.0, 0.1, -0.1, *(-1.0 - 0.1 * k for k in range(14))])
    chosen = trainer._to_repair(rho, rho < 0).tolist()
    assert chosen == [5, 2, 6, 7, 8, 9, 1, 3]  # three quarters by robustness, then in the order of the draw
    few = torch.tensor([0.2, -5.0, -0.3, 0.4])
    assert trainer._to_repair(few, few < 0).tolist() == [2, 1]
    assert trainer._to_repair(few, few < -9).tolist() == []


def test_known_feasible_counts_the_failing_states_that_no_search_looked_at(car_task: Task) -> None:
    engine = replace(resolve_config(car_task, TrainConfig(batch=16, seed=1)), most=8)
    trainer = Trainer(car_task, engine, steps=9, device=torch.device("cpu"))
    x0 = trainer.supply.take(8)
    plans = torch.zeros(8, car_task.horizon, 1)
    rho = torch.tensor([0.1, 0.1, 0.1, -1.0, -1.0, -1.0, 0.1, -1.0])  # 3 of the 6 nearest, 1 of the 2 others
    found = SearchResult(x0, plans, rho)
    trainer.accuracy, trainer.failing = 0.5, 106
    trainer.repairing = SimpleNamespace(result=lambda: found)
    failing, repaired, feasible = trainer._take_repaired()
    assert (failing, repaired, len(trainer.buffer)) == (8, 4, 4)
    assert feasible == pytest.approx(0.5 + 0.5 * (3 + 0.5 * 100) / 106)
