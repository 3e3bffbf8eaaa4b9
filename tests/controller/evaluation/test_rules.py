"""The rules of drives: where a run finds them, who obeyed, and what travels with a trace."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.controller.deployment.simulator import DeploymentRecording
from stlc.controller.evaluation.causes import Lost
from stlc.controller.evaluation.executed import Executed
from stlc.controller.evaluation.rules import JudgedRuns, Rules, judge_runs, judge_runs_by_plans
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.search.local_search import SearchResult
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.diagnostics import RunError, SpecError, SystemFileError
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.jsontext import plain
from stlc.rundir import RunDir

SYSTEM = """stlc: 1
name: cart
spec: cart.stl
time: {dt: 1 s, horizon: 3 steps}
state: {x: {unit: m, range: [-10, 10]}}
control: {u: {unit: m/s, range: [-1, 1]}}
flow: {x: u}
init: {mixture: [{weight: 1, draw: {x: 0}}]}
test: {judge: ../rules/cart.stl, steps: 4, agents: 2}
scenario: {far: {judge: far.stl}, same: {doc: nothing else}}
"""
PLAN = "spec cart\nsignal x [m]\nconst wall = 4 m\n@safety require near: always[0, T] x < wall\n"
RULES = (
    'spec cart_rules\nimport "parts/limit.stl" as limit\nsignal x [m]\nconst wall = 3 m\n'
    "## Never at the wall.\n@safety\nrequire stay: always x < wall\n"
    "@safety\nrequire home: always[1 s, end] prev(x) > limit.low\n"
)
LIMIT = "const low = -2 m\n"
FAR = "spec far\nsignal x [m]\nrequire far: always x < 9 m\n"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A system with rules in a folder beside, which import a file, and a scenario with rules of its own."""
    files = {
        "car/cart.yaml": SYSTEM,
        "car/cart.stl": PLAN,
        "car/far.stl": FAR,
        "rules/cart.stl": RULES,
        "rules/parts/limit.stl": LIMIT,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def task_of(home: Path, overrides: Mapping[str, str] | None = None) -> Task:
    spec = Spec.parse(File(home / "car/cart.stl").read())
    return Task.of(spec, System.load(home / "car/cart.yaml", overrides or {}))


def opened(folder: RunDir, overrides: Mapping[str, str] | None = None, scenario: str | None = None) -> Run:
    return Run(folder, Run.task_in(folder, overrides, scenario), None)  # type: ignore[arg-type]


def run_of(home: Path, overrides: Mapping[str, str] | None = None) -> RunDir:
    launch = Launch(root=home / "runs", name="test", overrides=overrides or {})
    return open_folder(task_of(home, overrides), TrainConfig(steps=1), launch)


def found(run: Run) -> Rules:
    rules = Rules.of(run)
    assert rules is not None
    return rules


def driven(xs: list[list[float]], *, good: bool = True) -> DeploymentRecording:
    """Drives along these x, by plans that were good or not."""
    states = np.array(xs, dtype=float)[..., None]
    rows, steps = states.shape[0], states.shape[1] - 1
    whole = np.zeros((rows, steps))
    none = whole.astype(np.int64)
    actions = np.zeros((rows, steps, 1))
    rho, safe = whole - (not good), np.full(whole.shape, good)
    return DeploymentRecording(rows, states, actions, none, none, rho, rho, safe, ({},), {}, {})


# ------------------------------------------------------------------------ where they are


def test_a_run_judges_by_the_rules_that_it_was_made_with(home: Path) -> None:
    folder = run_of(home)
    for name in ("rules/cart.stl", "rules/parts/limit.stl", "car/far.stl"):
        (home / name).unlink()
    rules = found(opened(folder))
    assert (rules.name, rules.spec.source.text) == ("cart_rules", RULES)
    assert rules.spec.library == {"parts/limit.stl": LIMIT}
    assert rules.docs == {"stay": "Never at the wall.", "home": ""}
    assert rules.path.endswith("rules/cart.stl")
    drives = judge_runs(rules, opened(folder).task, driven([[0, 1, 2], [0, 1, 3.5], [-3, 0, 0]]), viable(3))
    assert {name: list(each == "satisfied") for name, each in drives.rules.items()} == {
        "stay": [True, False, True],
        "home": [True, True, False],
    }


def test_the_same_name_in_the_folder_of_the_run_is_another_file(home: Path) -> None:
    """Copies of rules lie in a folder of their own: none replaces the specification, or a system file."""
    (home / "rules/cart.stl").rename(home / "rules/spec.stl")
    (home / "car/cart.yaml").write_text(SYSTEM.replace("rules/cart.stl", "rules/spec.stl"))
    folder = run_of(home)
    assert (folder.path / "spec.stl").read_text() == PLAN
    assert found(opened(folder)).name == "cart_rules"


def test_a_scenario_may_bring_rules_of_its_own(home: Path) -> None:
    folder = run_of(home)
    assert found(opened(folder, scenario="far")).name == "far"
    assert found(opened(folder, scenario="same")).name == "cart_rules"
    assert found(opened(folder, scenario="noise")).name == "cart_rules"


def test_constants_that_were_changed_are_changed_in_the_rules_too(home: Path) -> None:
    folder = run_of(home, {"wall": "1 m", "x": "0.5 m", "train.seed": "3"})
    assert found(opened(folder)).overrides == {"wall": "1 m"}
    assert found(opened(folder, {"wall": "2 m"})).overrides == {"wall": "2 m"}


def test_rules_may_be_left_out_or_given_anew(home: Path) -> None:
    folder = run_of(home)
    assert Rules.of(opened(folder, {"test.judge": "null"})) is None
    assert found(opened(folder, {"test.judge": str(home / "car/far.stl")})).name == "far"


def test_rules_that_are_missing_or_do_not_fit_stop_a_training(home: Path) -> None:
    (home / "rules/cart.stl").write_text(RULES.replace("signal x [m]", "signal x [s]"))
    with pytest.raises(SpecError):
        run_of(home)
    (home / "rules/cart.stl").unlink()
    with pytest.raises(SystemFileError) as caught:
        run_of(home)
    (finding,) = caught.value.diagnostics
    assert finding.code == "S210"
    assert finding.span is not None
    assert finding.span.text == "../rules/cart.stl"
    assert "--set test.judge=null" in finding.help[-1]


@pytest.mark.parametrize(
    "broken", ['{"../rules/cart.stl": {"file": "../../x.stl"}}', '{"../rules/cart.stl": 3}', "[", "[]"]
)
def test_a_copy_that_is_damaged_is_said(home: Path, broken: str) -> None:
    folder = run_of(home)
    (folder.path / "judge/index.json").write_text(broken)
    with pytest.raises(RunError) as caught:
        Rules.of(opened(folder))
    assert caught.value.diagnostics[0].code == ("R110" if "x.stl" in broken else "R101")


# ------------------------------------------------------------------------- who obeyed


def viable(rows: int, *lost: int) -> np.ndarray:
    able = np.ones(rows, dtype=bool)
    able[list(lost)] = False
    return able


MISSED = {
    "why": "missed",
    "time": 1.0,
}  # where it was at the wall already, and a search is told that it could


def test_drives_are_counted(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task, rules = opened(run_of(home)).task, found(opened(run_of(home)))
    searched(monkeypatch, -1)
    recording = replace(driven([[0, 1, 2], [0, 3.5, 1], [-3, -2.5, 0], [0, 0, 0]], good=False), agents=2)
    drives = judge_runs(rules, task, recording, viable(4, 2, 3))
    document = plain(JudgedRuns.of(drives, (7, 8), 2))
    assert json.loads(json.dumps(document)) == {
        "count": 4,
        "obeyed": 2,
        "safe": 2,
        "undecided": 0,
        "lost": 1,  # the last one obeyed although no search has found a plan for it
        "told": 0,
        "rules": {
            "stay": {"obeyed": 3, "broken": 1, "undecided": 0},
            "home": {"obeyed": 3, "broken": 1, "undecided": 0},
        },
        "broken": [
            {"seed": 7, "agent": 1, "lost": False, "rules": {"stay": 1.0}, "cause": MISSED},
            {
                "seed": 8,
                "agent": 0,
                "lost": True,
                "rules": {"home": 1.0},
                "cause": {"why": "start", "time": 0.0},
            },
        ],
    }


GO = "spec go\nsignal x [m]\n@safety\nrequire near: always x < 3\nrequire go: always[1 s, end] x > 0\n"


def searched(monkeypatch: pytest.MonkeyPatch, known: float) -> list[tuple[int, list[float]]]:
    """Record of further searches, as (requirements, starts): a plan is known where x exceeds `known`."""
    asked = []

    def solve(task: Task, x0: torch.Tensor, **_limits: object) -> SearchResult:
        asked.append((len(task.rules), x0[:, 0].tolist()))
        return SearchResult(x0, x0, x0[:, 0] - known - 0.1)

    monkeypatch.setattr("stlc.controller.evaluation.causes.solve", solve)
    return asked


def test_who_only_comes_late_is_lost_where_no_plan_keeps_all(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (home / "car/cart.stl").write_text(PLAN + "require go: always x > -99\n")
    rules, asked = Rules(Spec.parse(text_of(home, GO)), "go.stl"), searched(monkeypatch, -1)
    recording = driven([[0, 1, 2], [-2, -1, 0.5], [-0.5, -0.5, 1], [-3, -1, 3.5]], good=False)
    drives = judge_runs(rules, opened(run_of(home)).task, recording, viable(4, 0, 1))
    assert asked == [  # not who obeyed; of who hit something, a safe plan until then
        (2, [-2.0, -1.0]),
        (2, [-0.5, -0.5]),
        (1, [-3.0, -1.0, 3.5]),
    ]
    assert drives.viable.tolist() == [True, False, True, True]
    assert [each.lost for each in drives.broken] == [
        Lost("start", 0.0),
        Lost("missed", 1.0),
        Lost("missed", 2.0),
    ]


@pytest.mark.parametrize("calm", [True, False, None])
def test_a_drive_can_be_lost_later(home: Path, monkeypatch: pytest.MonkeyPatch, calm: bool | None) -> None:
    """The plan of the first instant was good; from the second on none is known; the fourth breaks a rule.

    Where events are not recorded, a step that the model does not predict counts as one.
    """
    rules, asked = Rules(Spec.parse(text_of(home, GO)), "go.stl"), searched(monkeypatch, 9)
    recording = driven([[1, 2, 2.5, 3.5, 1]], good=False)
    recording.safe[0, 0] = True
    recording = replace(recording, eventless=None if calm is None else np.array([[calm, True, True, True]]))
    (broken,) = judge_runs(rules, opened(run_of(home)).task, recording, viable(1)).broken
    assert asked == [(1, [2.0, 2.5, 3.5])]
    assert broken.lost == Lost("later" if calm else "told", 1.0, inconsistent=not calm)
    assert broken.excused == (not calm)


def test_a_plan_that_was_good_until_a_rule_was_broken_is_no_excuse(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rules, asked = Rules(Spec.parse(text_of(home, GO)), "go.stl"), searched(monkeypatch, 9)
    drives = judge_runs(rules, opened(run_of(home)).task, driven([[1, 2, 3.5, 1]]), viable(1, 0))
    assert (asked, drives.broken[0].lost, drives.viable.tolist()) == ([], None, [True])


def test_a_drive_that_ends_too_early_is_neither(home: Path) -> None:
    text = "spec soon\nsignal x [m]\nrequire soon: eventually[0 s, 5 s] x > 1\n"
    rules = Rules(Spec.parse(text_of(home, text)), "soon.stl")
    task = opened(run_of(home)).task
    document = plain(
        JudgedRuns.of(judge_runs(rules, task, driven([[0, 2, 0], [0, 0, 0]]), viable(2)), (0,), 2)
    )
    assert (document["obeyed"], document["undecided"], document["broken"]) == (1, 1, [])


def text_of(home: Path, text: str):  # type: ignore[no-untyped-def]
    (home / "other.stl").write_text(text)
    return File(home / "other.stl").read()


def test_without_rules_every_start_counts() -> None:
    def executed(held: np.ndarray, fails: np.ndarray, able: np.ndarray) -> Executed:
        decided = {"a": np.array([3.0, np.nan])}
        return Executed({"a": held}, {"a": fails}, (), np.ones((1, 2), dtype=bool), able, decided=decided)

    held = np.array([[True, True], [True, False], [False, False]])
    drives = judge_runs_by_plans(executed(held, ~held, viable(2, 1)), 0.5)
    assert [each.rules for each in drives.broken] == [{"a": 1.5}, {"a": None}]
    assert drives.viable.tolist() == [True, False]
    for none in (held[:0], np.zeros((1, 2), dtype=bool)):  # no start, and no verdict
        drives = judge_runs_by_plans(executed(none, none, viable(2)), 0.5)
        assert JudgedRuns.of(drives, (0,), 2).undecided == 2
