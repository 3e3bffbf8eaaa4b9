"""Tables that fill cell by cell: what is there is kept, what was cut short goes on, what fails is told."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.documents import misfits
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import store
from benchmarks.__main__ import main as measure
from benchmarks.feasible import TRIES, KnownFeasible, _union, known_feasible, prove_on, search_on
from benchmarks.learned import learned
from benchmarks.options import Training
from benchmarks.store import BENCHMARKS, ResultStore, load
from benchmarks.table import text_of
from benchmarks.tables import ablation, paper
from benchmarks.tables.schema import document_schema
from benchmarks.training import (
    Cell,
    Length,
    Place,
    _fill,
    _job,
    _shorter,
    _spent,
    filled,
    grouped,
    is_complete,
    outdated,
    pack,
    remaining,
    unpack,
)
from stlc.cli.framework.app import main
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.parallel.jobs import Job, JobResult
from stlc.controller.run.config import HELD_OUT_SEED
from stlc.controller.run.run import Run
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import Watch, train
from stlc.registry import METHODS
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[2]
QUICK = {"train.batch": "8"}
TINY_SPEC = 'system "tiny.yaml"\nsignal x\nrequire r: always x < 1\n'
TINY_SYSTEM = """\
stlc: 1
name: tiny
time: {dt: 1 s, horizon: 3}
state: {x: {}}
control: {a: {range: [-1, 1]}}
flow: {x: a}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
"""


@pytest.fixture(autouse=True)
def _in_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def quick(**changes: Any) -> Cell:
    cell = Cell("traffic", "gradient", 0, Length(steps=2), held_out=30, axis="k", value="7", overrides=QUICK)
    return replace(cell, **changes)


def trained(cell: Cell, place: Place, watch: Watch | None = None) -> Run:
    """Files that a process leaves behind."""
    task = load(cell.benchmark, tuple(cell.overrides.items()))
    launch = Launch(root=place.runs_of(cell.key), overrides=cell.overrides, command=("train",))
    return train(task, cell.config(), open_folder(task, cell.config(), launch), watch).run


def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_executor: object, sent: list[Any], _begun: object) -> list[Any]:
        assert sent == []
        return []

    monkeypatch.setattr("stlc.controller.parallel.jobs.LocalExecutor.run", refuse)


# ---------------------------------------------------------------------- cells


@given(st.lists(st.booleans(), min_size=1, max_size=70))
def test_flags_survive_being_written(flags: list[bool]) -> None:
    assert unpack(pack(flags), len(flags)) == flags


@given(st.lists(st.lists(st.booleans(), min_size=9, max_size=9), min_size=1, max_size=4))
def test_the_union_holds_where_any_does(sets: list[list[bool]]) -> None:
    assert _union(map(pack, sets), 9) == [any(flags[i] for flags in sets) for i in range(9)]


def ablated(*seeds: int) -> list[Cell]:
    axes = [axis.name for axis in ablation.AXES]
    return ablation.cells_of(axes, [(seed, Length(60.0)) for seed in seeds], 5000)


def test_cells_have_names_of_their_own() -> None:
    trainings = Training(budget=["60s", "5min"], seeds="0..1").seeds_and_lengths(())
    assert [(seed, length.name) for seed, length in trainings] == [
        *((0, "60s"), (1, "60s")),
        *((0, "300s"), (1, "300s")),
    ]
    assert Cell("traffic", "guided", 0, trainings[0][1]).name == "traffic-guided-60s-seed0"
    changed = sum(value != axis.default for axis in ablation.AXES for value in axis.reported)
    assert len(ablated(0)) == len({cell.name for cell in ablated(0)}) == changed + 1 == 26


def test_an_ablation_changes_one_number() -> None:
    base, *others = ablated(0)
    assert base.overrides["policy.hidden"] == "[256, 256, 256]"
    for cell in others:
        different = [key for key, value in cell.overrides.items() if value != base.overrides[key]]
        assert different == [axis.key for axis in ablation.AXES if axis.name == cell.axis]


def test_what_a_result_depends_on() -> None:
    """Specification, system, method and its version, seeds, sizes."""
    cell = quick()
    assert cell.key == quick().key
    assert {"spec_sha256", "system_sha256", "method", "method_version", "seed"} <= set(cell.key.values)
    others = [quick(seed=1), quick(held_out=31), quick(length=Length(steps=3)), quick(method="guided")]
    others += [quick(length=Length(2.0)), quick(length=Length(2.0, clock="processor"))]
    others.append(quick(overrides={"objective.gamma": "0.3"}))
    assert len({cell.key.digest, *(each.key.digest for each in others)}) == 8


def test_the_key_has_what_the_system_file_declares_for_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tiny.stl").write_text(TINY_SPEC)
    monkeypatch.chdir(tmp_path)

    def keys(reward: str, more: str = "") -> list[str]:
        (tmp_path / "tiny.yaml").write_text(TINY_SYSTEM + f"train: {{reward: {reward}{more}}}\n")
        store._load.cache_clear()
        options = [{"reward": "task"}, {"reward": "robustness"}]
        return [Cell("tiny", "sac", 0, Length(1.0), options=each).key.digest for each in options]

    monkeypatch.setattr(store, "spec_path", lambda _name: Path("tiny.stl"))
    (task, robustness), (other, same), slower = keys("x"), keys("-x"), keys("x", ", lr: 0.1")
    assert task != other
    assert robustness == same
    assert not {task, robustness} & {*slower}


# ---------------------------------------------------------------------- filling


def test_a_finished_run_is_collected_and_then_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_process(monkeypatch)
    place = Place(ResultStore("ablation", tmp_path), tmp_path / "runs")
    cell = quick(overrides={**QUICK, "train.samples": "40"})
    run = trained(cell, place)
    first, second = filled([cell], place), filled([cell], place)
    assert (first.trained, first.kept, second.trained, second.kept) == (1, 0, 0, 1)
    (document,) = place.store.all().values()
    assert first.results == second.results == (document,)
    assert Cell.of(document) == cell
    states = load("traffic").sample(30, seed=HELD_OUT_SEED, dtype=torch.float64)
    good = TOLERANCE.satisfied(run.plan_judged(states)[1].rho)
    assert unpack(document["solved"], 30) == good.tolist()
    assert document["accuracy"] == pytest.approx(float(good.double().mean()))
    assert 0.0 <= document["training_accuracy"] <= 1.0
    assert place.valid() == [document]
    assert [row.outdated for row in ablation.table([document], ["k"]).rows] == []  # no value of the paper
    monkeypatch.setattr("benchmarks.training.ENGINE_VERSION", -1)
    assert place.valid() == []
    assert place.all() == [document]
    assert outdated(document) == ("method",)
    assert place.store.find(cell.key) is None
    (group,) = grouped(place.all())
    row = paper.row_of(group, {})
    assert row.outdated == ("method",)
    assert paper.SHOWN["inputs"](row) == "outdated: method"  # type: ignore[operator]


@pytest.mark.apart
def test_a_longer_training_extends_a_shorter_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(METHODS.get("gradient")), "extendable", True, raising=False)
    place = Place(ResultStore("ablation", tmp_path), tmp_path / "runs")
    short = quick(length=Length(0.3, clock="processor"))
    run = trained(short, place)
    assert filled([short], place).trained == 1
    long = replace(short, length=Length(round(_spent(run.dir) + 0.5, 3), clock="processor"))
    assert _shorter(replace(long, length=Length(_spent(run.dir), clock="processor")), place) is None
    sent: list[Job] = []

    def train_here(_executor: object, jobs: list[Job], _begun: object) -> list[JobResult]:
        sent.extend(jobs)
        return [JobResult(job, main(["train", *job.arguments]), None, "", 1) for job in jobs]

    monkeypatch.setattr("stlc.controller.parallel.jobs.LocalExecutor.run", train_here)
    (result,) = filled([long], place).results
    assert sent[0].arguments[0] == "--resume"
    (longer,) = RunDir.every(place.runs_of(long.key))
    assert longer.name == run.dir.name
    assert [row["step"] for row in longer.rows()][: len(run.dir.rows())] == [
        row["step"] for row in run.dir.rows()
    ]
    assert result["steps"] > run.dir.record()["steps"]
    assert result["seconds"] > _spent(run.dir)
    assert place.store.find(short.key) is not None
    no_process(monkeypatch)
    assert filled([long], place).kept == 1
    other = replace(long, seed=1)
    assert _shorter(other, place) is None


def test_a_copied_run_is_not_taken_for_the_longer_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process may end between the copy and the training."""
    monkeypatch.setattr(type(METHODS.get("gradient")), "extendable", True, raising=False)
    place = Place(ResultStore("ablation", tmp_path), tmp_path / "runs")
    short = quick(length=Length(0.3, clock="processor"))
    trained(short, place)
    filled([short], place)
    long = replace(short, length=Length(60.0, clock="processor"))
    assert _shorter(long, place) is not None
    assert _shorter(long, place) is not None  # in place of a copy that has failed
    copy = place.newest_run(long.key)
    assert copy is not None
    assert copy.status == "finished"
    assert is_complete(copy, short)
    assert not is_complete(copy, long)
    assert _job(long, place, copy).arguments[-2] == "--budget"
    monkeypatch.undo()
    assert _shorter(replace(long, length=Length(61.0, clock="processor")), place) is None


@pytest.mark.slow
def test_a_run_that_was_cut_short_goes_on(tmp_path: Path) -> None:
    place = Place(ResultStore("ablation", tmp_path), tmp_path / "runs")
    cell, count = quick(length=Length(steps=6)), []
    cut = trained(cell, place, Watch(stop=lambda: bool(count.append(1)) or len(count) == 4))
    assert cut.dir.status == "interrupted"
    broken = quick(seed=1, overrides={"train.lr": "1e30"}, length=Length(steps=9))
    found = {each.name: (result, why) for each, result, why in _fill([cell, broken], replace(place, jobs=2))}
    assert (found[cell.name][0] or {})["steps"] == 6
    assert [run.path for run in RunDir.every(place.runs_of(cell.key))] == [cut.dir.path]
    assert cut.dir.status == "finished"
    assert found[broken.name][0] is None
    assert found[broken.name][1]
    assert broken.name not in place.store.all()


@pytest.mark.apart
def test_the_command_from_training_to_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["paper", "--only", "traffic", "--methods", "gradient", "--seeds", "5", "--steps", "2"]
    words += ["--parts", "learners"]
    words += ["--held-out", "20", "--out", str(tmp_path / "bench"), "--runs", str(tmp_path / "runs")]
    words += ["--page", str(tmp_path / "docs" / "results.md"), "--json"]

    def answer(*more: str) -> dict[str, Any]:
        assert measure([*words, *more]) == 0
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        assert misfits(document, document_schema()) == []
        result: dict[str, Any] = document["result"]
        return result

    first = answer("--passes", "1")
    no_process(monkeypatch)
    second = answer("--passes", "2")
    assert (first["trained"], first["kept"]) == (1, 0)
    assert (second["trained"], second["kept"]) == (0, 1)
    (before,), (after,) = first["known_feasible"], second["known_feasible"]
    assert (before["passes"], after["passes"]) == (1, 2)
    assert first["rows"][0]["accuracy"] <= before["share"] <= after["share"] <= 1.0
    (cell,) = ResultStore("paper", tmp_path / "bench").all().values()
    assert not [word for word in cell["command"] if word.startswith("/")]
    assert second["rows"][0]["known_feasible"] == after["share"]
    page = (tmp_path / "docs" / "results.md").read_text()
    assert page.count("<!-- paper -->") == 1
    assert f"| traffic | gradient | 2 steps | 5 | {cell['accuracy']:.4f} [" in page
    assert (tmp_path / "docs" / "img" / "results.svg").read_text().startswith("<svg")


def test_what_there_is_to_choose_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["paper", "--only", "trafic"], ["ablation", "--only", "lambda"], ["paper", "--only", ","]):
        assert measure([*words, "--out", str(tmp_path / "out")]) == 2
    assert measure(["paper", "--budget", "60s", "--steps", "3"]) == 2
    assert "did you mean `traffic`?" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------- known feasible shares


@pytest.fixture
def result() -> Callable[..., dict[str, Any]]:
    """The result of a cell that solves nothing unless told."""

    def made(count: int = 24, solved: list[bool] | None = None) -> dict[str, Any]:
        cell = Cell("traffic", "guided", 0, Length(steps=2), held_out=count)
        return {"key": cell.key.values, "solved": pack(solved or [False] * count)}

    return made


def test_a_search_goes_on_where_it_stopped(
    tmp_path: Path, result: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    nothing, store = result(), ResultStore("feasible", tmp_path)
    for passes in (1, 1, 2):
        search_on([nothing], store, passes=passes)
    told = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in told] == ["traffic: search 1", "traffic: search 2"]
    known = known_feasible(store, [nothing])["traffic"]
    assert (known.passes, known.tries) == (2, 2 * TRIES)
    assert told[-1].endswith(f" {known.open} states without a plan")
    assert known.share == 1.0 - known.open / 24
    assert known.share > 0.7
    assert known.by_search == 24 - known.open


def test_what_any_policy_solves_counts(tmp_path: Path, result: Callable[..., dict[str, Any]]) -> None:
    one, other = ([i < 20 for i in range(24)], [i >= 20 for i in range(24)])
    cells, store = [result(solved=one), result(solved=other)], ResultStore("feasible", tmp_path)
    search_on(cells, store, passes=3)
    known = known_feasible(store, cells)["traffic"]
    assert (known.share, known.open, known.by_search) == (1.0, 0, 0)
    elsewhere = ResultStore("feasible", tmp_path / "elsewhere")
    assert known_feasible(elsewhere, cells[:1])["traffic"].share == 20 / 24


@pytest.mark.apart
def test_states_without_a_plan_are_proved_infeasible(
    tmp_path: Path, result: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("highspy")
    searched, proved = ResultStore("feasible", tmp_path / "a"), ResultStore("feasible", tmp_path / "b")
    search_on([result()], searched, passes=2)
    assert known_feasible(searched, [result()])["traffic"].proved is None
    for _ in range(2):
        prove_on([result()], proved)
    assert capsys.readouterr().err.count("no plan exists for") == 2  # 20 states, then 4, then none again
    search, proof = (known_feasible(store, [result()])["traffic"] for store in (searched, proved))
    assert proof.proved == proof.open
    assert proof.share >= search.share
    search_on([result()], proved, passes=1)
    assert known_feasible(proved, [result()])["traffic"].proved == proof.proved
    prove_on([result()], searched)
    assert known_feasible(searched, [result()])["traffic"].proved == proof.proved


def test_other_states_are_searched_anew(tmp_path: Path, result: Callable[..., dict[str, Any]]) -> None:
    store = ResultStore("feasible", tmp_path)
    search_on([result()], store, passes=1)
    search_on([result(12)], store, passes=0)
    assert known_feasible(store, [result(12)])["traffic"].share == 0.0


# ---------------------------------------------------------------------- tables


def cell_result(benchmark: str, method: str, seed: int, accuracy: float, **changes: Any) -> dict[str, Any]:
    cell = Cell(benchmark, method, seed, Length(60.0))  # type: ignore[arg-type]
    facts = {"benchmark": cell.benchmark, "method": cell.method, "seed": seed, "held_out": cell.held_out}
    key = {**facts, "budget": 60.0, "steps": None, "clock": "wall", "axis": "", "value": "", "overrides": {}}
    numbers = {"accuracy": accuracy, "seconds": 60.0 + seed, "steps": 100}
    return {"key": {**key, **changes}, **numbers, "requirements": {"stop": accuracy}}


def paper_rows(documents: list[dict[str, Any]], known: dict[str, float]) -> list[paper.LearnedRow]:
    found = {name: KnownFeasible(name, share, (0.0, 1.0), 0, None, 0, 0, 0) for name, share in known.items()}
    return paper.tables(documents, found)["rows"].rows


def test_rows_are_means_over_seeds_as_shares_of_what_is_feasible() -> None:
    documents = [cell_result("ship_safe", "gradient", seed, 0.8 + 0.01 * seed) for seed in (2, 0, 1)]
    documents += [cell_result("traffic", "guided", 0, 0.96)]
    traffic, ship = paper_rows(documents, {"ship_safe": 0.9})
    assert (traffic.benchmark, traffic.share, traffic.length) == ("traffic", None, "60 s")
    assert ship.seeds == (0, 1, 2)
    assert ship.accuracies == pytest.approx((0.8, 0.81, 0.82))
    assert ship.accuracy == pytest.approx(0.81)
    assert ship.share == pytest.approx(0.9)
    assert ship.worst_share == pytest.approx(0.8 / 0.9)
    assert ship.requirements == {"stop": pytest.approx(0.81)}
    low, high = ship.interval
    assert low < 0.81 < high
    assert high - low == pytest.approx(2 * math.hypot(0.0248, 0.0109), rel=0.01)  # of seeds, of 5,000 states
    assert [row.benchmark for row in paper_rows(documents, {})] == ["traffic", "ship_safe"]
    assert set(BENCHMARKS) >= {"traffic", "ship_safe"}


def test_a_policy_that_is_judged_on_the_first_states_only(tmp_path: Path) -> None:
    flags = {40: [i % 4 > 0 for i in range(40)], 8: [i < 7 for i in range(8)]}
    full, part = (
        {
            **cell_result("traffic", method, 0, sum(own) / len(own), held_out=40),
            **{"held_out": len(own), "solved": pack(own)},
        }
        for method, own in zip(("guided", "pets"), flags.values(), strict=True)
    )
    for each in (full, part):
        each["key"] |= {"spec_sha256": "", "system_sha256": "", "held_out_seed": 1}
    known = known_feasible(ResultStore("feasible", tmp_path), [full, part])
    # of the first eight states, guided solves all but 0 and 4, and pets all but 7
    assert (known["traffic"].share, known["traffic"].partial) == (32 / 40, {8: 1.0})
    rows = {row.method: row for row in paper.tables([full, part], known)["rows"].rows}
    assert (rows["pets"].judged, rows["pets"].known_feasible, rows["pets"].share) == ((8,), 1.0, 7 / 8)
    assert rows["pets"].interval == pytest.approx(wilson(7 / 8, 8))
    assert rows["guided"].interval == pytest.approx(wilson(0.75, 40))
    shown = {name: text_of(row, paper.SHOWN["accuracy"]) for name, row in rows.items()}
    assert shown["pets"].endswith("] (of 8 states)")
    assert shown["guided"].endswith("]")
    shares = [each for each in learned([full, part]) if each.fewer]
    assert [(each.method, each.fewer) for each in shares] == [("pets", " (of 8 states)")]


def test_the_best_run_is_not_one_that_was_judged_on_few_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lucky = {**cell_result("traffic", "pets", 0, 1.0), "held_out": 32}
    place = Place(ResultStore("paper", tmp_path))
    monkeypatch.setattr(Place, "newest_run", lambda _, key: key.name)
    assert str(place.best_run([lucky, cell_result("traffic", "guided", 0, 0.97)])).startswith(
        "traffic-guided"
    )


def test_clocks_do_not_share_a_row() -> None:
    documents = [cell_result("traffic", "guided", 0, 0.9)]
    documents += [cell_result("traffic", "guided", 1, 0.9, clock="processor")]
    assert [row.length for row in paper_rows(documents, {})] == ["60 s", "60 s of processor time"]


def test_the_defaults_stand_in_every_table_of_the_ablation() -> None:
    def made(axis: str, value: str, accuracy: float) -> dict[str, Any]:
        result = cell_result("traffic", "gradient", 0, accuracy, axis=axis, value=value)
        return {**result, "training_accuracy": accuracy + 0.01}

    results = [made("base", "", 0.9), made("gamma", "1.0", 0.8), made("samples", "200", 0.5)]
    rows = ablation.table(results, [axis.name for axis in ablation.AXES]).rows
    found = {(row.axis, row.value): row.accuracy for row in rows}
    assert found == {
        **{("gamma", "0.5"): 0.9, ("gamma", "1.0"): 0.8, ("k", "500"): 0.9},
        **{("network", "256x3"): 0.9, ("samples", "200"): 0.5, ("samples", "50000"): 0.9},
    }
    reported = {(row.axis, row.value): row.reported for row in rows}
    assert reported["gamma", "1.0"] == (0.958, 0.955)
    assert reported["k", "500"] is None


def test_how_long_the_rest_takes_is_said_by_budgets() -> None:
    cells = [quick(seed=seed, length=Length(seconds)) for seed, seconds in enumerate([60.0, 300.0, 300.0])]
    assert remaining(cells, [cells[0].name], 2) == "2 left, about 5 min"
    assert remaining(cells, [cell.name for cell in cells], 2) == ""
    assert remaining([quick()], [], 1) == ""
