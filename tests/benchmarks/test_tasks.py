"""Control tasks in folders: what is measured, by whom it is judged, and what is made of failures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.judged import NoAnswerError, asked, judged, tasks_in
from benchmarks.store import ResultStore
from benchmarks.tables.schema import document_schema
from stlc.diagnostics import UsageError

SYSTEM = """stlc: 1
name: cart
time: {dt: 1 s, horizon: 2 s}
state: {x: {unit: m}}
control: {v: {unit: m/s, range: [-1, 1]}}
flow: {x: v}
init: {mixture: [{draw: {x: "uniform(0, 1)"}}]}
test: {steps: 3, agents: 2}
"""
SPEC = 'spec cart\nsystem "cart.yaml"\nstate signal x [m]\n@safety\nrequire low: always[0, T] x <= 2 m\n'
JUDGE = """import sys, numpy as np
x = np.load(sys.argv[1])["x"]
low = (x <= 2).all(1)
print("low", low.sum(), "of", len(x))
print("left", (x[:, 2] > -9).sum(), "of", len(x))
print("all", low.sum(), "of", len(x))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "tasks" / "cart"
    place.mkdir(parents=True)
    for name, text in (("cart.yaml", SYSTEM), ("cart.stl", SPEC), ("judge.py", JUDGE)):
        (place / name).write_text(text)
    (place / "words.stl").write_text("const a = 1\n")
    return place.parent


def saved(path: Path, x: list[list[float]]) -> Path:
    np.savez(path, t=np.arange(len(x[0]), dtype=float), x=np.array(x))
    return path


def test_each_specification_with_a_system_is_a_task(folder: Path) -> None:
    assert [each.name for each in tasks_in(folder)] == ["cart"]
    (folder / "cart" / "other.stl").write_text(SPEC)
    assert [each.name for each in tasks_in(folder)] == ["cart/cart", "cart/other"]
    assert set(tasks_in(folder)[0].hashes) == {"cart.stl", "cart.yaml", "judge.py"}


def test_a_folder_without_tasks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no task"):
        tasks_in(tmp_path)


def test_the_task_s_own_judge_counts(folder: Path, tmp_path: Path) -> None:
    (task,) = tasks_in(folder)
    found = judged(task, saved(tmp_path / "a.npz", [[0, 1, 2], [0, 1, 3]]))
    assert (found.obeyed, found.count, found.rules) == (1, 2, {"low": 1, "left": 2})
    assert found.lacking == "low 1"


def test_a_judge_that_fails_says_why_and_where_the_trace_ends(folder: Path, tmp_path: Path) -> None:
    (task,) = tasks_in(folder)
    with pytest.raises(NoAnswerError, match=r"judge.py: IndexError: .*; the trace ends at 1 s"):
        judged(task, saved(tmp_path / "a.npz", [[0, 1], [0, 1]]))


def test_without_a_judge_the_monitor_counts(folder: Path, tmp_path: Path) -> None:
    (folder / "cart" / "judge.py").unlink()
    (task,) = tasks_in(folder)
    found = judged(task, saved(tmp_path / "a.npz", [[0, 1, 2], [0, 1, 3], [0, 0, 0]]))
    assert (found.obeyed, found.count, found.rules) == (2, 3, {"low": 2})


def test_a_command_without_a_result_gives_its_diagnostics(tmp_path: Path) -> None:
    with pytest.raises(NoAnswerError, match="U102 there is no trace"):
        asked("check", str(tmp_path / "no.stl"), "no.npz", limit=60)
    with pytest.raises(NoAnswerError, match=r"no end within 0\.01 s"):
        asked("check", limit=0.01)


def answer(*arguments: str, **_: float) -> dict[str, object]:
    """Answers of stlc: plans that end early, drives, and a training that fails for seed 1."""
    place = Path(arguments[arguments.index("--runs" if arguments[0] == "train" else "simulate") + 1])
    if arguments[0] == "train" and arguments[arguments.index("--seed") + 1] == "1":
        raise NoAnswerError("R404 no plan")
    if arguments[0] == "train":
        driven = [{"guard": "none", "drives": 9, "satisfied": 3}]
        return {"run": str(place), "closed_loop": {"guards": driven}, "verdict": {"level": "trained"}}
    worlds = arguments[arguments.index("--seeds") + 1]
    x = [[0, 0, 0, 0]] * 4 if worlds == "0..1" else [[0, 0, 0, 0]] * 3 + [[3, 3, 3, 3]]
    saved(Path(arguments[arguments.index("--record") + 1]), x)
    times = {"median": 0.001, "p99": 0.002, "samples": 3}
    guard = arguments[arguments.index("--guard") + 1]
    return {"guards": {guard: {"latency": times, "drives": {"obeyed": 4, "count": 4}}}}


def test_failures_are_rows_and_results_are_kept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("benchmarks.tables.tasks.asked", answer)
    monkeypatch.setattr("benchmarks.tables.tasks.AGENTS", 2)
    places = ["--folder", str(folder), "--out", str(tmp_path / "out"), "--runs", str(tmp_path / "runs")]
    command = ["tasks", *places, "--parts", "controller,policy", "--seeds", "0,1", "--drives", "4", "--json"]
    assert measure(command) == 0
    printed = json.loads(capsys.readouterr().out)
    assert misfits(printed, document_schema()) == []
    rows = {row["what"]: row for row in printed["result"]["rows"]}
    assert rows["controller"]["counts"] == "4, 3 of 4"
    assert rows["controller"]["causes"] == ["low 3"]
    assert rows["policy, none"]["said"] == ["none 3 of 9; trained"]
    assert rows["policy, full"]["counts"] == "4 of 4"
    assert (rows["policy"]["counts"], rows["policy"]["causes"]) == ("-", ["R404 no plan"])
    before = ResultStore("tasks", tmp_path / "out").all()
    monkeypatch.setattr("benchmarks.tables.tasks.asked", None)
    assert measure(command) == 0
    assert ResultStore("tasks", tmp_path / "out").all() == before
    (folder / "cart" / "cart.yaml").write_text(SYSTEM + "doc: changed\n")
    monkeypatch.setattr("benchmarks.tables.tasks.asked", answer)
    assert measure([*command[:-1], "--seeds", "0", "--only", "cart"]) == 0
    assert ResultStore("tasks", tmp_path / "out").all()["cart-policy-seed0"] != before["cart-policy-seed0"]


@pytest.mark.slow
def test_plans_of_the_command_are_judged(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["tasks", "--folder", str(folder), "--out", str(tmp_path), "--parts", "plans", "--seeds", "0"]
    assert measure([*command, "--starts", "3", "--seconds", "0.01", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["result"]["rows"]
    assert (row["obeyed"], row["count"], row["said"]) == ([3], 3, ["3 of 3 satisfied, to 2 s"])
