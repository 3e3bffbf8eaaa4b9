"""Training by several processes: one policy, states of one's own, one writer, and an end that is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.several import together
from torch import nn

from stlc.controller.parallel.ddp import ALONE, Ranks, expected, joined
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.final_evaluation import TrainingOutcome
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.learner import Trainer
from stlc.controller.training.loop import Watch, resume, train
from stlc.diagnostics import MissingError, StlcError, UsageError
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
CONFIG = TrainConfig(held_out=20, steps=12, seed=3, batch=8, threads=1)
TINY = {"pool": 32, "every": 4, "most": 8, "hidden": (8,)}

pytestmark = [pytest.mark.apart, pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")]


def _tensors(run: RunDir) -> dict[str, torch.Tensor]:
    return load_checkpoint(run, **run.hashes).tensors


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, car_task: Task) -> Task:
    """Traffic, and an engine that is through in a moment."""
    from stlc.controller.training import loop as module

    decided = module.resolve_config
    monkeypatch.setattr(module, "resolve_config", lambda task, config: replace(decided(task, config), **TINY))
    monkeypatch.setattr("stlc.controller.training.learner.MARGIN_STATES", 8)
    assert car_task.gradient is not None  # what takes long is done before the ranks are forked
    return car_task


def test_alone_there_is_nobody_to_ask() -> None:
    weight = nn.Parameter(torch.ones(2))
    weight.grad = torch.tensor([1.0, 2.0])
    assert ALONE.learn([weight], torch.tensor(3.0)) == 3.0
    assert weight.grad.tolist() == [1.0, 2.0]
    assert (ALONE.mean([1.0, 2.0]), ALONE.agree(4.0), ALONE.any(False), ALONE.agree_text("x")) == (
        [1.0, 2.0],
        4.0,
        False,
        "x",
    )
    assert (ALONE.gather({}), ALONE.seed(7), ALONE.device("cuda"), expected()) == ([], 7, "cuda", ALONE)


def test_what_ranks_tell_each_other() -> None:
    def talk(ranks: Ranks) -> object:
        mine = float(ranks.rank + 1)
        layer = nn.Linear(2, 1)
        nn.init.constant_(layer.weight, mine)
        layer.weight.grad, layer.bias.grad = torch.full((1, 2), mine), torch.tensor([10.0 * mine])
        mean = ranks.learn(layer.parameters(), torch.tensor(mine))
        slopes = [layer.weight.grad.tolist(), layer.bias.grad.tolist()]
        ranks.agree_on(layer)
        given = ranks.gather({"a": torch.full((ranks.rank + 1,), mine)})
        return (
            *(float(mean), slopes, layer.weight.tolist(), ranks.mean([mine, 0.0]), ranks.agree(mine)),
            *(ranks.any(ranks.rank == 1), ranks.any(False), ranks.agree_text(f"für {ranks.rank}")),
            *([part["a"].tolist() for part in given], ranks.device("cuda"), ranks.device("cpu")),
        )

    common = (1.5, [[[1.5, 1.5]], [15.0]], [[1.0, 1.0]], [1.5, 0.0], 1.0, True, False, "für 0")
    assert together(talk) == [(*common, [[2.0, 2.0]], "cuda:0", "cpu"), (*common, [], "cuda:1", "cpu")]


def test_two_train_one_policy_from_states_of_their_own(tiny: Task, tmp_path: Path) -> None:
    folder = open_folder(tiny, CONFIG, Launch(root=tmp_path))

    def work(ranks: Ranks) -> object:
        seen: list[dict[str, object]] = []
        place = folder if ranks.first else RunDir(tmp_path / "nowhere")
        outcome = train(tiny, CONFIG, place, Watch(row=seen.append), ranks=ranks)
        state = torch.cat([part.flatten() for part in outcome.run.network.state_dict().values()])
        return state.tolist(), outcome.score is not None, [row["accuracy"] for row in seen]

    (weights, judged, rows), (same, other, rows_too) = together(work)
    assert weights == same
    assert (judged, other) == (True, False)
    assert rows == rows_too
    assert len(rows) == 2
    assert not (tmp_path / "nowhere").exists()
    saved = _tensors(folder)
    assert not torch.equal(saved["supply.block"], saved["rank1.supply.block"])
    assert not torch.equal(saved["generator"], saved["rank1.generator"])
    record = folder.record()
    assert (record["status"], record["engine"]["ranks"]) == ("finished", 2)


def test_a_run_of_two_that_was_stopped_equals_one_that_was_not(tiny: Task, tmp_path: Path) -> None:
    whole, stopped = (open_folder(tiny, CONFIG, Launch(root=tmp_path / name)) for name in "ab")

    def work(ranks: Ranks) -> object:
        train(tiny, CONFIG, whole, ranks=ranks)
        asked: list[int] = []
        stop = Watch(stop=lambda: bool(asked.append(1)) or (ranks.rank == 1 and len(asked) == 7))
        first = train(tiny, CONFIG, stopped, stop, ranks=ranks)
        again = resume(stopped, ranks=ranks)
        return first.interrupted, again.interrupted, again.ranks

    assert together(work) == [(True, False, 2)] * 2
    left, right = _tensors(whole), _tensors(stopped)
    assert left.keys() == right.keys()
    assert all(torch.equal(value, right[name]) for name, value in left.items())
    with pytest.raises(UsageError) as caught:
        resume(stopped, steps=20)
    (finding,) = caught.value.diagnostics
    assert (finding.code, finding.help) == (
        "R104",
        ("torchrun --nproc-per-node 2 -m stlc train --resume RUN",),
    )


def test_a_rank_that_dies_is_told_and_costs_no_checkpoint(
    tiny: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stlc.controller.training.loop.SAVE_EVERY", 5)
    folder = open_folder(tiny, CONFIG, Launch(root=tmp_path))
    advance = Trainer.advance

    def dying(self: Trainer) -> float:
        if self.ranks.rank == 1 and self.step == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return advance(self)

    monkeypatch.setattr(Trainer, "advance", dying)
    error, dead = together(lambda ranks: train(tiny, CONFIG, folder, ranks=ranks))
    assert dead is None
    assert isinstance(error, MissingError)
    assert error.diagnostics[0].code == "R403"
    assert "rank 0 of 2" in error.diagnostics[0].message
    assert "rank1.generator" in _tensors(folder)
    monkeypatch.setattr(Trainer, "advance", advance)
    finished, _ = together(lambda ranks: resume(folder, ranks=ranks).score is not None)
    assert finished


def test_a_gradient_of_one_rank_that_is_no_number_ends_both(
    tiny: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = open_folder(tiny, CONFIG, Launch(root=tmp_path))
    loss = Trainer._loss

    def broken(self: Trainer) -> torch.Tensor:
        value = loss(self)
        return value * torch.nan if self.ranks.rank == 1 and self.step == 3 else value

    monkeypatch.setattr(Trainer, "_loss", broken)
    for error in together(lambda ranks: train(tiny, CONFIG, folder, ranks=ranks)):
        assert isinstance(error, StlcError)
        assert error.diagnostics[0].code == "R401"


def test_two_processes_agree_on_the_steps_of_a_budget(tiny: Task, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=None, budget=0.5)
    folder = open_folder(tiny, config, Launch(root=tmp_path))

    def work(ranks: Ranks) -> TrainingOutcome | int:
        outcome = train(tiny, config, folder, ranks=ranks)
        return int(outcome.run.dir.record()["steps"])

    first, second = together(work)
    assert first == second >= 1


def test_whoever_does_not_come_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("MASTER_ADDR", raising=False)
    with pytest.raises(MissingError) as caught, joined("cpu"):
        pass
    assert caught.value.diagnostics[0].code == "R403"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "interrupted")]
)
def test_torchrun_on_the_command_line(number: int, status: str, tmp_path: Path) -> None:
    spec = str(ROOT / "specs" / "traffic.stl")
    start = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "stlc", "train"]
    quick = ["--batch", "8", "--held-out", "50", "--no-pictures", "--runs", str(tmp_path)]
    process = subprocess.Popen(
        [*start, spec, "--steps", "3000", *quick], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stderr is not None
    said = next(line for line in process.stderr if "engine" in line)
    os.killpg(process.pid, number)
    said += process.communicate(timeout=120)[1]
    assert "go on with: torchrun --nproc-per-node 2 -m stlc train --resume" in said
    (run,) = RunDir.every(tmp_path)
    assert run.status == status
    words = ["--resume", str(run.path), "--steps", str(int(_facts(run)) + 5), "--no-pictures"]
    done = subprocess.run([*start, *words], capture_output=True, text=True, check=True)
    assert done.stdout.count("plan accuracy") == 1
    assert run.status == "finished"


def _facts(run: RunDir) -> object:
    return load_checkpoint(run, **run.hashes).facts["step"]


def test_a_rank_without_a_gpu_of_its_own_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("RANK", "7"), ("WORLD_SIZE", "99"), ("LOCAL_RANK", "77")):
        monkeypatch.setenv(name, value)
    with pytest.raises(MissingError, match="no device `cuda:77`"), joined("cuda"):
        pass
