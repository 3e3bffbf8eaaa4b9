"""The paper's comparison: cells by their keys, resumed after a kill, refused with a reason; claims."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure_by_command
from benchmarks.bars import Bar, Facet, Point, draw
from benchmarks.claims import FAILS, HOLDS, OPEN, Claim, Standing, claims
from benchmarks.comparison import Learned, accuracies, deployments, standings, upsets
from benchmarks.drives import Drive, DriveRow, driven
from benchmarks.options import Comparing
from benchmarks.plannings import PlanCell, PlanRow, feasible_bounds, improves, measure, planned
from benchmarks.roster import Contender, learners, planners, roster
from benchmarks.store import BENCHMARKS, ResultStore, load
from benchmarks.tables.schema import document_schema
from benchmarks.training import Cell, Length, Place, _job, pack
from stlc.controller.parallel.jobs import Job
from stlc.diagnostics import Diagnostic, MissingError, RunError

ROOT = Path(__file__).parents[2]
SEARCH = Contender("plan:search", "search", plans=True)


@pytest.fixture(autouse=True)
def _in_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def tiny(**changes: Any) -> PlanCell:
    return replace(PlanCell("reach_n_avoid", SEARCH, 0.002, 4), **changes)


# ---------------------------------------------------------------------- roster


def test_every_learner_and_planner_is_a_row() -> None:
    names = [*roster()]
    assert {"guided", "gradient", "plan:search", "plan:cem:paper", "plan:gradient:paper"} <= set(names)
    assert "plan" not in names
    assert "plan:policy" not in names
    assert names.index("guided") < names.index("plan:search")
    assert len(names) == len(learners()) + len(planners())


def test_a_new_planner_is_a_row_by_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = type("Registry", (), {"names": ("search", "random")})()
    monkeypatch.setattr("benchmarks.roster.PLANNERS", registry)
    assert [each.name for each in planners()] == ["plan:search", "plan:random"]


def test_options_of_a_learner_are_in_name_key_and_command(tmp_path: Path) -> None:
    plain = Cell("traffic", "guided", 0, Length(60.0))
    assert "options" not in plain.key.values
    cell = Cell("traffic", "guided", 0, Length(60.0), options={"reward": "task", "rate": "2"})
    assert cell.name == "traffic-guided-task-2-60s-seed0"
    assert cell.key.values["options"] == {"reward": "task", "rate": "2"}
    assert Cell.of({"key": cell.key.values}) == cell
    job: Job = _job(cell, Place(ResultStore("paper", tmp_path)), None)
    words = " ".join(job.arguments)
    assert "--option reward=task --option rate=2" in words


# ---------------------------------------------------------------------- planner cells


def test_a_planner_is_measured_once_for_its_inputs(tmp_path: Path) -> None:
    store = ResultStore("plans", tmp_path)
    first, second = planned([tiny()], store), planned([tiny()], store)
    assert (first.new, second.new) == (1, 0)
    assert first.results == second.results
    (row,) = [PlanRow.of(each) for each in first.results]
    assert row.accuracy is not None
    assert 0.0 <= row.accuracy <= 1.0
    assert row.median_ms is not None
    assert row.p99_ms is not None
    assert row.median_ms <= row.p99_ms
    assert not row.outdated
    others = [tiny(seconds=0.003), tiny(starts=5), tiny(benchmark="traffic"), tiny(seconds=math.inf)]
    others.append(tiny(contender=replace(SEARCH, options={"tries": "10"})))
    assert len({tiny().key.digest, *(each.key.digest for each in others)}) == 6


def test_a_killed_cell_costs_itself_only(tmp_path: Path) -> None:
    store, asked = ResultStore("plans", tmp_path), []

    def killed(cell: PlanCell) -> dict[str, Any]:
        asked.append(cell.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return {"refused": "not asked"}

    cells = [tiny(), tiny(seconds=0.003), tiny(seconds=0.004)]
    with pytest.raises(KeyboardInterrupt):
        planned(cells, store, measuring=killed)
    assert [*store.all()] == [cells[0].name]
    assert planned(cells, store, measuring=killed).new == 2
    assert asked == [cells[0].name, cells[1].name, cells[1].name, cells[2].name]


def test_a_refusal_is_stored_with_its_reason(tmp_path: Path) -> None:
    pytest.importorskip("highspy")
    store = ResultStore("plans", tmp_path)
    cell = tiny(benchmark="ship_safe", contender=Contender("plan:milp", "milp", plans=True))
    (result,) = planned([cell], store).results
    row = PlanRow.of(result)
    assert row.accuracy is None
    assert "cannot encode" in row.refused
    lines = accuracies([], [cell.contender], [], [replace(row, seconds=0.01)], ())
    assert lines[1].cells["ship_safe"] == "refused"
    assert "ship_safe" not in lines[1].command


def test_a_missing_package_is_no_result(tmp_path: Path) -> None:
    def missing(_cell: PlanCell) -> dict[str, Any]:
        raise MissingError(Diagnostic("R301", "no package"))

    store = ResultStore("plans", tmp_path)
    assert planned([tiny()], store, measuring=missing).failed == ({"name": tiny().name, "why": "no package"},)
    assert store.all() == {}


def test_a_damaged_run_costs_its_own_cell_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def damaged(cell: PlanCell) -> dict[str, Any]:
        if cell.seconds == 0.003:
            raise RunError(Diagnostic("R101", "the run is damaged"))
        return {"refused": "not asked"}

    cells = [tiny(), tiny(seconds=0.003), tiny(seconds=0.004)]
    found = planned(cells, ResultStore("plans", tmp_path), measuring=damaged)
    assert (found.new, found.failed) == (2, ({"name": cells[1].name, "why": "the run is damaged"},))
    assert f"{cells[1].name}  broke off: the run is damaged" in capsys.readouterr().err


def test_a_long_cell_is_measured_where_time_helps(tmp_path: Path) -> None:
    store, long = ResultStore("plans", tmp_path), tiny(seconds=1.0)
    assert improves(long, store)
    for seconds, accuracy in ((0.01, 0.5), (0.1, 0.75)):
        store.put(tiny(seconds=seconds).key, {"accuracy": accuracy})
    assert improves(long, store)
    store.put(tiny(seconds=0.1).key, {"accuracy": 0.5})
    assert not improves(long, store)
    assert improves(tiny(seconds=0.1), store)


def test_feasible_bounds_are_of_all_plans_together(tmp_path: Path) -> None:
    store = ResultStore("plans", tmp_path)
    flags = [True, False, False, False], [False, True, False, False], [False, False, True, False]
    for cell, solved in zip((tiny(), tiny(seconds=0.003)), flags[:2], strict=True):
        store.put(cell.key, {"solved": pack(solved), "infeasible": pack(flags[2])})
    found = feasible_bounds(store.all().values())["reach_n_avoid"]
    assert (found.known, found.proved, found.contradictions) == (0.5, 0.25, 0)
    wrong = {"solved": pack(flags[0]), "infeasible": pack(flags[0])}
    store.put(tiny(seconds=0.004).key, wrong)
    assert feasible_bounds(store.all().values())["reach_n_avoid"].contradictions == 1


@pytest.mark.apart
def test_the_settings_of_the_paper_end_by_evaluations() -> None:
    cell = PlanCell("reach_n_avoid", roster()["plan:gradient:paper"], math.inf, 2)
    result = measure(cell)
    assert cell.evaluations == 51
    assert result["evaluations"] <= 51
    assert cell.key.values["seconds"] is None


# ---------------------------------------------------------------------- claims


def made_up(**accuracy: float) -> list[Standing]:
    """`BENCHMARK__METHOD` -> accuracy, where `_p_` stands for `plan:`."""
    found = []
    for name, value in accuracy.items():
        benchmark, method = name.split("__")
        found.append(Standing(benchmark, method.replace("p_", "plan:"), value, 100.0, 1.0))
    return found


def verdict(found: list[Claim], start: str) -> Claim:
    return next(each for each in found if each.claim.startswith(start))


def test_without_cells_nothing_is_decided() -> None:
    assert {each.verdict for each in claims([])} == {OPEN}


def test_a_lead_holds_against_what_is_measured_and_one_baseline_refutes_it() -> None:
    cells = made_up(navigation__guided=0.99, navigation__mbpo=0.5)
    found = verdict(claims(cells), "navigation")
    assert found.verdict == HOLDS
    assert "7 of 8 baselines not measured" in found.here
    found = verdict(claims([*cells, *made_up(navigation__p_milp=0.9)]), "navigation")
    assert found.verdict == FAILS
    assert found.why == "plan:milp leaves 10.0 % to gain here"


def test_behind_on_a_simple_benchmark() -> None:
    close = claims(made_up(traffic__guided=0.95, traffic__pets=0.97))
    assert verdict(close, "traffic: at most").verdict == HOLDS
    far = verdict(claims(made_up(traffic__guided=0.90, traffic__pets=0.97)), "traffic: at most")
    assert (far.verdict, far.why) == (FAILS, "7.0 % below pets")


def test_times_are_compared_by_benchmark() -> None:
    ours = Standing("traffic", "guided", 0.97, 1.0, 20.0)
    cells = [ours, Standing("traffic", "plan:milp", 0.83, 30.0), Standing("traffic", "plan:mpc", 0.9, 2.0)]
    cells.append(Standing("traffic", "plan:cem:paper", 0.5, 50.0))
    found = claims(cells)
    assert verdict(found, "10 to 100 times faster than MILP").verdict == HOLDS
    assert verdict(found, "10 to 100 times faster than MPC").verdict == FAILS
    assert verdict(found, "traffic: STL_M").verdict == HOLDS
    slow = verdict(found, "the policy with its backup")
    assert (slow.verdict, slow.here) == (FAILS, "traffic 2.5 times")


def row(method: str, seconds: float | None, accuracy: float, label: str = "") -> PlanRow:
    interval = accuracy, accuracy
    return PlanRow("traffic", method, label, seconds, 10, accuracy, interval, 0.0, 1.0, 2.0, 3.0, 4.0)


def test_where_search_beats_the_policy_its_least_budget_is_told() -> None:
    rows = [row("plan:search", 0.1, 0.99), row("plan:search", 0.01, 0.98), row("plan:search", 0.001, 0.9)]
    policy = row("guided", None, 0.97, "guided-60s-seed0")
    (found,) = upsets([*rows, policy])
    assert (
        found.text
        == "traffic: plan:search at 10 ms a plan 0.980 (2 ms a decision), guided-60s-seed0 0.970 (2 ms)"
    )
    assert upsets([rows[2], policy]) == []
    (close,) = upsets([rows[0], replace(policy, interval=(0.9, 0.995))])
    assert close.text.endswith("; the intervals overlap")
    assert upsets([replace(rows[0], outdated=True), policy]) == []


def test_a_standing_is_that_of_the_largest_budget() -> None:
    trained = Learned("traffic", "guided", "60 s", 0.9, (0.8, 1.0), 60.0)
    longer = replace(trained, accuracy=0.95, seconds=300.0)
    old = replace(trained, accuracy=1.0, seconds=900.0, outdated=True)
    rows = [
        row("plan:search", 0.1, 0.99),
        row("plan:search", 0.01, 0.98),
        row("guided", None, 0.97, "guided"),
    ]
    found = {each.method: each for each in standings([longer, old, trained], rows, [])}
    assert (found["guided"].accuracy, found["guided"].decision_ms) == (0.95, 2.0)
    assert found["plan:search"].accuracy == 0.99


def test_an_empty_cell_names_the_command_that_fills_it() -> None:
    lines = accuracies(learners()[:1], [SEARCH], [], [row("plan:search", 0.01, 0.98)], (60.0,))
    assert lines[0].command == "python -m benchmarks paper --methods guided --budget 60s"
    assert lines[1].cells["traffic"] == ""
    ten = next(line for line in lines if line.budget == "10 ms")
    assert ten.cells["traffic"] == "0.980 [0.980, 0.980]"
    assert "--only reach_n_avoid,ship_safe," in ten.command
    assert ten.command.endswith("--plan-time 10ms --parts plans")


def test_a_long_cell_of_a_planner_that_refuses_or_gains_nothing_says_so() -> None:
    def long_cell(*found: float | None) -> tuple[str, str]:
        rows = [
            replace(row("plan:search", seconds, 0.5), accuracy=each, interval=each and (0.0, 1.0))
            for seconds, each in zip((0.01, 0.1), found, strict=True)
        ]
        lines = accuracies([], [SEARCH], [], rows, [])
        line = next(each for each in lines if each.budget == "1 s")
        return line.cells["traffic"], line.command

    text, command = long_cell(None, None)
    assert text == "refused"
    assert "traffic" not in command
    assert long_cell(0.5, 0.5)[0] == "no gain"
    assert long_cell(0.5, 0.6)[0] == ""
    assert "--only" not in long_cell(0.5, 0.6)[1]


def test_a_cell_of_fewer_seeds_names_them_and_the_command_for_the_rest() -> None:
    budget = "60 s of processor time"
    whole = [Learned(name, "guided", budget, 0.9, (0.8, 1.0), 60.0) for name in BENCHMARKS]
    (line,) = accuracies(learners()[:1], [], whole, [], (60.0,))
    assert (line.cells["traffic"], line.command) == ("0.900 [0.800, 1.000]", "")
    partly = [replace(whole[0], seeds=(0, 2)), *whole[1:]]
    (line,) = accuracies(learners()[:1], [], partly, [], (60.0,))
    assert line.cells["traffic"] == "0.900 [0.800, 1.000] (seeds 0, 2)"
    assert line.command == "python -m benchmarks paper --methods guided --only traffic --budget 60s"


def test_a_training_of_an_hour_needs_one_seed() -> None:
    (sac,) = (each for each in learners() if each.hour)
    whole = [
        Learned(name, sac.name, "3600 s of processor time", 0.9, (0.8, 1.0), 3600.0, seeds=(0,))
        for name in BENCHMARKS
    ]
    (line,) = accuracies([sac], [], whole, [], ())
    assert (line.cells["traffic"], line.command) == ("0.900 [0.800, 1.000]", "")


# ---------------------------------------------------------------------- figures, closed loop, the command


@pytest.mark.apart
def test_both_figures_are_drawn(tmp_path: Path) -> None:
    bars = Bar("guided", 0.9, (0.85, 0.95), plans=False), Bar("plan:search", 0.95, (0.9, 1.0), plans=True)
    points = Point("guided", 0.1, 0.9), Point("plan:search", 1.0, 0.9), Point("plan:search", 10.0, 0.95)
    facets = [Facet("traffic", bars, points, 0.97), Facet("empty", (), ())]
    refusing = Facet("refusing", bars[:1], points[:1])
    assert [each.get_text() for each in draw([facets[0], refusing], tmp_path)[0].figure.axes[1].texts] == [
        "no result"
    ]
    pictures = draw(facets, tmp_path)
    assert [each.alt for each in pictures] == ["Plan accuracy of all methods; the best: traffic 0.950."] * 2
    assert all(
        (tmp_path / name).read_text().startswith("<svg")
        for name in ("img/comparison.svg", "img/plan_times.svg")
    )
    assert pictures[1].figure.axes[0].get_xscale() == "log"
    assert draw([facets[1]], tmp_path) == ()


@pytest.mark.apart
def test_long_names_are_not_cut_off(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    bars = tuple(Bar(name, 0.5, (0.4, 0.6), plans=True) for name in ("search", "plan:gradient:paper"))
    (picture, _) = draw([Facet(name, bars, ()) for name in "abcdef"], tmp_path)
    starts = re.findall(r"translate\(([-\d.]+) [-\d.]+\) scale", picture.svg())
    assert starts
    assert min(map(float, starts)) > 0.0


def test_a_drive_is_stored_with_guard_and_size(tmp_path: Path) -> None:
    store = ResultStore("drives", tmp_path)
    cells = [Drive(tiny(), guard, (0,), agents=2, steps=3) for guard in ("none", "paper")]
    found, again = driven(cells, store), driven(cells, store)
    assert (found.new, again.new) == (2, 0)
    assert found.results == again.results
    assert {*store.all()} == {f"{tiny().name}-none", f"{tiny().name}-paper"}
    for result in found.results:
        assert 0.0 <= result["metrics"]["plan_accuracy"]["mean"] <= 1.0
        assert result["decision"]["median"] <= result["decision"]["p99"]


def test_slow_decisions_are_timed_less_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.drives.TIMING", 0.0)
    cells = [Drive(tiny(), "none", (0,), agents=2, steps=6)]
    (result,) = driven(cells, ResultStore("drives", tmp_path)).results
    assert result["decision"]["samples"] == 5  # of 12


def test_a_drive_depends_on_its_world_and_its_backup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Drive(tiny(), "paper", (0,), agents=2, steps=3)
    (result,) = driven([cell], ResultStore("drives", tmp_path)).results
    assert not DriveRow.of(result).outdated
    other = {**result, "key": {**result["key"], "deployed_sha256": ""}}
    assert DriveRow.of(other).outdated
    before, decl = cell.key, load("reach_n_avoid").system.decl
    for changed in (
        replace(decl, backup=replace(decl.backup, bins=7)),
        replace(decl, test=replace(decl.test, replan=2)),
        replace(decl, test=replace(decl.test, starts="savable")),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(load("reach_n_avoid").system, "decl", changed)
            assert cell.key.digest != before.digest


def test_the_closed_loop_shows_the_best_policy_of_a_method_and_what_is_missing() -> None:
    def driven_by(label: str, accuracy: float, fewer: str = "") -> DriveRow:
        first = "traffic", "sac:task", label, None, "none", "3 x 20 x 150"
        return DriveRow(*first, accuracy, None, 1.0, None, 1.0, 2.0, fewer=fewer)

    rows = (
        driven_by("sac-task-300s-seed1", 0.75, "3 worlds of 5 agents"),
        driven_by("sac-task-60s-seed0", 0.5),
    )
    trained = {("traffic", "sac-task-300s-seed1"): 0.7, ("traffic", "sac-task-60s-seed0"): 0.6}
    known = roster()
    lines = deployments(rows, trained, [known["sac:task"], known["plan:cem"]])
    assert [(line.method, line.budget) for line in lines] == [
        *(("sac:task", "no guard"), ("sac:task", "with backup")),
        *(("plan:cem", "10 ms, no guard"), ("plan:cem", "10 ms, with backup")),
    ]
    assert lines[0].cells == {"traffic": "0.750 / 1.000 (300s-seed1; 3 worlds of 5 agents)"}
    assert lines[0].command.startswith("python -m benchmarks paper --methods sac:task --only reach_n_avoid,")
    assert lines[2].command == "python -m benchmarks paper --methods plan:cem --parts drives"


def test_a_drive_of_fewer_agents_says_so(tmp_path: Path) -> None:
    cells = [Drive(tiny(), "none", (0,), agents=agents, steps=steps) for agents, steps in ((2, 3), (None, 3))]
    few, short = (DriveRow.of(result) for result in driven(cells, ResultStore("drives", tmp_path)).results)
    assert few.fewer == "1 world of 2 agents, 3 steps"
    assert short.fewer == "3 steps"


def answer(capsys: pytest.CaptureFixture[str], words: list[str]) -> dict[str, Any]:
    assert measure_by_command(words) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    result: dict[str, Any] = document["result"]
    return result


@pytest.mark.apart
def test_the_command_from_planner_cells_to_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["paper", "--only", "reach_n_avoid", "--methods", "plan:search", "--json"]
    words += ["--parts", "plans,drives", "--plan-time", "2ms", "--starts", "4"]
    words += ["--decision", "2ms", "--drives", "0", "--agents", "2", "--drive-steps", "3"]
    words += ["--out", str(tmp_path / "bench"), "--runs", str(tmp_path / "runs")]
    words += ["--page", str(tmp_path / "results.md")]
    first, second, shown = (answer(capsys, [*words, *more]) for more in ((), (), ("--show",)))
    assert (first["planned"], first["driven"]) == (1, 2)
    assert (second["planned"], second["driven"]) == (0, 0)
    assert first["plans"] == second["plans"] == shown["plans"]
    assert len(shown["drives"]) == 2
    page = (tmp_path / "results.md").read_text()
    assert page.count("<!-- paper -->") == 1
    assert "### The paper's claims" in page
    assert "python -m benchmarks paper --methods guided --budget 60s" in page


def test_parts_and_times_that_do_not_exist(tmp_path: Path) -> None:
    assert Comparing(plan_time=["5ms", "5ms"]).seconds == (0.005,)
    for words in (["--parts", "planes"], ["--methods", "plan:serch"], ["--decision", "soon"]):
        assert measure_by_command(["paper", *words, "--only", "traffic", "--out", str(tmp_path)]) == 2
