"""Exported controllers decide as their run does; others are not written."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.documents import misfits
from helpers.exported import CART, MISSION, STRICT, build, exported, run_of, untrained

from stlc import native
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.diagnostics import RunError, UsageError
from stlc.export.c_header import header, main_of, public, weights
from stlc.export.programs import without_deprecations
from stlc.export.verify import Answer, agreement, answers, by_c
from stlc.export.write import export, target_of
from stlc.runtime import backup
from stlc.runtime.decision import Shot, prefix_shooting
from stlc.runtime.facts import read_facts
from stlc.runtime.graphs import Graphs
from stlc.runtime.prefixes import SAMPLINGS

ROOT = Path(__file__).parents[2]
compiled = pytest.mark.skipif(native.compiler() is None, reason="needs a C compiler")


def build_in_cpp(folder: Path) -> Path:
    using = shutil.which("c++")
    assert using is not None
    target = folder / "controller++"
    options = ("-std=c++11", "-O1", "-ffp-contract=off", *STRICT, "-x", "c++")
    subprocess.run([using, *options, "-o", str(target), str(folder / "main.c"), "-lm"], check=True)
    return target


@compiled
@pytest.mark.parametrize(
    ("spec", "system", "varied"),
    [
        ("traffic", "car", True),
        pytest.param("traffic", "car", False, marks=pytest.mark.apart),
        pytest.param("ship_safe", "ship_safe", True, marks=pytest.mark.apart),
    ],
)
def test_the_c_controller_decides_as_the_guard(spec: str, system: str, varied: bool, tmp_path: Path) -> None:
    run = run_of(spec, system, tmp_path, varied=varied)
    done = export(run, "c", tmp_path / "out")
    assert done.files == ("Makefile", "main.c", "stlc_controller.h", "stlc_weights.h")
    assert done.agreement is not None
    assert (done.agreement.states, done.agreement.guarded) == (64, 16)
    assert done.agreement.rho <= 1e-9
    x = run.task.sample(6, seed=5, dtype=torch.float64)
    wanted = Guard(run.task, run.policy, "paper").decide(x)
    assert bool((wanted.source > 0).any()), "no state asks for the backup policy"
    got = torch.tensor(answers([str(build(done.folder))], x.tolist()), dtype=torch.float64)
    rules = len(run.task.rules)
    assert got[:, 0].tolist() == wanted.source.tolist()
    assert got[:, 1].tolist() == wanted.t0.tolist()
    torch.testing.assert_close(got[:, 2], wanted.rho, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(got[:, 4 + rules :].view_as(wanted.plan), wanted.plan, rtol=0.0, atol=1e-4)


@compiled
def test_the_c_controller_costs_plans_as_the_task(tmp_path: Path) -> None:
    (tmp_path / "cart.yaml").write_text(CART)
    (tmp_path / "cart.stl").write_text(MISSION)
    run = untrained(tmp_path / "cart.stl", tmp_path / "cart.yaml", tmp_path / "runs")
    texts = {"stlc_controller.h": header(run.task, run.network), "stlc_weights.h": weights(run.network)}
    example = main_of(run.task).replace("verdict.rho, verdict.safe", "verdict.rho, verdict.cost")
    for name, text in {**public(texts, "STLC_CONTROLLER_H"), "main.c": example}.items():
        (tmp_path / name).write_text(text)
    x = run.task.sample(20, seed=1, dtype=torch.float64)
    found = by_c(tmp_path, run.task, tmp_path / "built")("policy")(x)
    wanted = run.task.cost(run.task.judge(x, found.plan))
    assert len(set(wanted.tolist())) > 10
    torch.testing.assert_close(found.safe, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.apart
@compiled
@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(
    ("spec", "system"),
    [("traffic", "car"), pytest.param("manipulation", "panda", marks=pytest.mark.slow)],
)
def test_the_header_may_be_included_from_cpp(spec: str, system: str, tmp_path: Path) -> None:
    run, whole = exported(spec, system, "c")
    folder = Path(shutil.copytree(whole, tmp_path / "out"))
    states = run.task.sample(4, seed=5, dtype=torch.float64).tolist()
    mine, theirs = (
        torch.tensor(answers([str(built), "policy"], states), dtype=torch.float64)
        for built in (build(folder), build_in_cpp(folder))
    )
    torch.testing.assert_close(theirs, mine, rtol=0.0, atol=1e-5)


def mission_of(folder: Path) -> Run:
    """A cart that makes promises on its mission clock, looks back, and has a parameter."""
    (folder / "cart.yaml").write_text(CART)
    held = "require calm: always[0, T] (v > 1 m/s -> once[0 s, 0.4 s] x < 0.4 m)\n"
    (folder / "cart.stl").write_text(MISSION + held)
    return untrained(folder / "cart.stl", folder / "cart.yaml", folder / "runs")


@pytest.mark.apart
@compiled
def test_the_c_controller_advances_what_a_mission_adds(tmp_path: Path) -> None:
    run = mission_of(tmp_path)
    system, far = run.task.system, 0.25
    folder = export(run, "c", tmp_path / "out").folder
    kinds = {timer.kind for timer in system.timers}
    assert kinds >= {"clock", "status", "timer"}
    drive = torch.randn(40, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64) / 2
    whole = torch.tensor([[*drive[0], far, *(timer.initial for timer in system.timers)]], dtype=torch.float64)
    lines = []
    for sample in drive:
        whole[:, :2] = sample
        lines.append(whole[0].tolist())
        whole = torch.cat((whole[:, :2], system.added_later(whole)), 1)
    for how in (build, build_in_cpp) if shutil.which("c++") else (build,):
        built = how(folder)
        wanted = answers([str(built)], lines)
        assert answers([str(built), "mission", str(far)], drive.tolist()) == wanted
    assert (
        len({line[len(system.decl.signature.names) + 1] for line in map(tuple, lines)}) > 10
    )  # the clock runs
    text = (folder / "stlc_controller.h").read_text()
    assert "clock: counts the samples of the mission" in text
    assert "status, 0 open, 1 true, -1 false: " in text
    assert "STLC_MEASURED = 2," in text


@compiled
@pytest.mark.parametrize(
    "sampling", [SAMPLINGS[0], *(pytest.param(each, marks=pytest.mark.apart) for each in SAMPLINGS[1:])]
)
def test_the_c_controller_tries_the_same_sample(sampling: str, tmp_path: Path) -> None:
    run = run_of("traffic", "car", tmp_path)
    system = run.task.system
    backup = replace(system.decl.backup, samples=40, sampling=sampling)
    system.decl = replace(system.decl, backup=backup)
    done = export(run, "c", tmp_path / "out")
    x = run.task.sample(40, seed=5, dtype=torch.float64)
    wanted = Guard(run.task, run.policy, "paper").decide(x)
    assert bool(((wanted.source > 0) & (wanted.t0 == 3)).any()), "no state asks for a sample"
    got = torch.tensor(answers([str(build(done.folder))], x.tolist()), dtype=torch.float64)
    rules = len(run.task.rules)
    assert got[:, 1].tolist() == wanted.t0.tolist()
    torch.testing.assert_close(got[:, 4 + rules :].view_as(wanted.plan), wanted.plan, rtol=0.0, atol=1e-4)


@pytest.mark.slow
def test_the_torch_program_needs_nothing_of_stlc(tmp_path: Path) -> None:
    run = run_of("traffic", "car", tmp_path)
    done = export(run, "torch", tmp_path / "out")
    assert done.files == ("backup.pt2", "controller.json", "decide.pt2")
    with without_deprecations():
        module = torch.export.load(done.folder / "decide.pt2").module()
        backup = torch.export.load(done.folder / "backup.pt2").module()
    for count in (1, 70):
        x = run.task.sample(count, seed=9, dtype=torch.float64)
        plan, judged = run.plan_judged(x)
        mine, rho, _, each = module(x)
        torch.testing.assert_close(mine, plan, rtol=0.0, atol=1e-5)
        torch.testing.assert_close(rho, judged.rho, rtol=0.0, atol=1e-5)
        torch.testing.assert_close(each, judged.requirements, rtol=0.0, atol=1e-5)
        wanted = StagedSearch(run.task, run.policy, PAPER).search(x, plan)
        mine, *_, source, t0 = backup(x, plan)
        torch.testing.assert_close(mine, wanted.plans, rtol=0.0, atol=1e-5)
        assert (source.tolist(), t0.tolist()) == (wanted.source.tolist(), wanted.prefix_length.tolist())


@compiled
@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "system"),
    [
        ("reach_n_avoid", "maze"),
        ("ship_track", "ship_track"),
        ("navigation", "rover"),
        ("manipulation", "panda"),
        ("patrol", "unicycle"),
    ],
)
def test_every_benchmark_has_a_c_controller(spec: str, system: str, tmp_path: Path) -> None:
    done = export(run_of(spec, system, tmp_path), "c", tmp_path / "out")
    assert done.agreement is not None
    assert done.agreement.ties <= 1


def test_what_disagrees_is_not_handed_out(tmp_path: Path) -> None:
    run = run_of("traffic", "car", tmp_path)

    def proud(x: torch.Tensor) -> Answer:
        plan, judged = run.plan_judged(x)
        return Answer(plan, judged.rho + 1e-3, judged.safe, judged.requirements)

    with pytest.raises(RunError, match="does not do what the run does"):
        agreement(run.policy, proud, states=8)


@pytest.mark.apart
def test_a_backup_policy_with_another_rule_is_not_handed_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_of("traffic", "car", tmp_path)

    def dearest(*of: Any) -> Iterator[Shot[Any]]:
        for shot in prefix_shooting(*of):
            yield replace(shot, plans=replace(shot.plans, cost=-shot.plans.cost))

    monkeypatch.setattr(backup, "prefix_shooting", dearest)
    with pytest.raises(RunError, match="does not do what the run does"):
        export(run, "onnx", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@compiled
def test_the_c_controller_says_that_a_number_is_not_finite(tmp_path: Path) -> None:
    run, whole = exported("traffic", "car", "c")
    folder = Path(shutil.copytree(whole, tmp_path / "out"))
    text = (folder / "main.c").read_text()
    for call in ("stlc_policy(&controller", "stlc_decide(&controller"):
        text = text.replace(call, f'printf("%d ", {call}', 1).replace(
            "plan, &verdict);", "plan, &verdict));", 1
        )
    (folder / "main.c").write_text(text)
    state = run.task.sample(1, seed=5, dtype=torch.float64)[0].tolist()
    program = str(build(folder))
    for value in (math.nan, math.inf, -math.inf, 1e308):
        state[0] = value
        for mode in (["policy"], []):
            (row,) = answers([program, *mode], [state])
            assert row[0] == -1 or (value == 1e308 and not mode and row[0] in (0, 1))
            assert np.isfinite(row[5 + len(run.task.rules) :]).all()


def test_a_robustness_that_both_call_not_a_number_agrees(tmp_path: Path) -> None:
    (tmp_path / "cart.yaml").write_text(CART)
    rooted = "@safety\nrequire slow: always[0, T] sqrt(1 - abs(v) / (1.5 m/s)) >= 0\n"
    signals = "state signal x [m]\nstate signal v [m/s]\n"
    (tmp_path / "cart.stl").write_text(signals + rooted + "require near: always[0, T] abs(x) < 1.5 m\n")
    run = untrained(tmp_path / "cart.stl", tmp_path / "cart.yaml", tmp_path / "runs")
    done = export(run, "onnx", tmp_path / "out")
    graphs, system = Graphs(read_facts(done.folder)), run.task.system
    x = run.task.sample(4, seed=1, dtype=torch.float64).numpy()
    hard = np.full((4, run.task.horizon, 1), float(system.control_high))
    assert np.isnan(graphs.falls(x, hard)).any()
    assert done.agreement is not None
    assert done.agreement.rho <= 1e-9


def test_an_unknown_target_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="rust"):
        target_of("rust")


@compiled
def test_the_page_compiles(tmp_path: Path) -> None:
    run, whole = exported("traffic", "car", "c")
    out = Path(shutil.copytree(whole, tmp_path / "out"))
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    (out / "main.c").write_text(text.split("```c\n")[1].split("```")[0], encoding="utf-8")
    measured = " ".join(["0"] * len(run.task.system.decl.signature.names))
    program = [str(build(out))]
    done = subprocess.run(
        program, check=True, capture_output=True, text=True, input=f"{measured}\n{measured}\n"
    )
    assert len(done.stdout.split()) == 2 * 3


@pytest.mark.parametrize(("arguments", "code"), [(["--to", "rust"], 2), (["--to", "c"], 3)])
def test_bad_input_gives_a_diagnostic(
    arguments: list[str],
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    task = run_of("traffic", "car", tmp_path / "other").task
    made = open_folder(task, TrainConfig(steps=1), Launch(root=tmp_path / "runs", name="test"))
    assert main(["export", str(made.path), *arguments]) == code
    assert "error[" in capsys.readouterr().err
    assert not (made.path / "export").exists()


@pytest.mark.apart
@pytest.mark.parametrize("target", ["c", "onnx"])
def test_the_command_writes_beside_the_run(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of("traffic", "car", tmp_path / "runs")
    monkeypatch.setattr(Run, "open", lambda *_, **__: run)
    assert main(["export", "--to", target, "--json", "-o", str(tmp_path / target)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("export/1")) == []
    assert sorted(path.name for path in (tmp_path / target).iterdir()) == document["result"]["files"]
    assert (document["result"]["latency"] is not None) == (target == "onnx")
    assert main(["export", "--to", target, "-o", str(tmp_path / "again")]) == 0
    assert ("decides in" in capsys.readouterr().err) == (target == "onnx")


def test_the_command_keeps_the_program_of_a_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, whole = exported("traffic", "car", "c")
    monkeypatch.setattr(Run, "open", lambda *_, **__: run)
    folder = Path(shutil.copytree(whole, tmp_path / "c"))
    (folder / "main.c").write_text("int main(void) { return 0; }\n")
    (folder / "stlc_weights.h").write_text("old")
    assert main(["export", "--to", "c", "--json", "-o", str(folder)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("export/1")) == []
    assert document["result"]["latency"] is None
    assert document["result"]["kept"] == ["main.c"]
    assert document["result"]["files"] == ["Makefile", "stlc_controller.h", "stlc_weights.h"]
    assert (folder / "main.c").read_text() == "int main(void) { return 0; }\n"
    assert (folder / "stlc_weights.h").read_text() != "old"
