"""Tables that fill cell by cell: what is there is kept, what was cut short goes on, what fails is told."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from documents import misfits
from hypothesis import given
from hypothesis import strategies as st

from stlc.bench.ablation import AXES, ablation_cells, ablation_rows
from stlc.bench.ablation import Extent as AblationExtent
from stlc.bench.ceilings import TRIES, ceilings_of, search_on
from stlc.bench.cells import BENCHMARKS, Cell, Length, inputs_of, load, pack, read_json, union, unpack
from stlc.bench.paper import Extent, paper_cells, paper_rows
from stlc.bench.study import Filled, Place, cell_of, fill, runs_of, valid_results, write_result
from stlc.cli.bench.options import _left
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.problem.task import satisfied
from stlc.controller.training.config import HELD_OUT_SEED
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import Watch, train
from stlc.controller.training.run import Run
from stlc.rundir import every_run

ROOT = Path(__file__).parents[2]
QUICK = {"train.batch": "8"}


@pytest.fixture(autouse=True)
def _in_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def schema_of(name: str) -> dict[str, Any]:
    published = load_schema("bench/1")
    return {"$defs": published["$defs"], **published["$defs"][name]}


def quick(**changes: Any) -> Cell:
    cell = Cell("traffic", "gradient", 0, Length(steps=2), held_out=30, axis="k", value="7", overrides=QUICK)
    return replace(cell, **changes)


def trained(cell: Cell, place: Place, watch: Watch | None = None) -> Run:
    """What a process leaves behind."""
    task = load(cell.benchmark, tuple(cell.overrides.items()))
    launch = Launch(root=runs_of(inputs_of(cell), place), overrides=cell.overrides, command=("train",))
    return train(task, cell.config(), open_folder(task, cell.config(), launch), watch).run


def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(errands: list[Any], **_: object) -> list[Any]:
        assert errands == []
        return []

    monkeypatch.setattr("stlc.bench.study.side_by_side", refuse)


# ---------------------------------------------------------------------- cells


@given(st.lists(st.booleans(), min_size=1, max_size=70))
def test_flags_survive_being_written(flags: list[bool]) -> None:
    assert unpack(pack(flags), len(flags)) == flags


@given(st.lists(st.lists(st.booleans(), min_size=9, max_size=9), max_size=4))
def test_the_union_holds_where_any_does(sets: list[list[bool]]) -> None:
    assert union(sets, 9) == [any(flags[i] for flags in sets) for i in range(9)]


def test_cells_have_names_of_their_own() -> None:
    cells = paper_cells(Extent())
    assert len(cells) == len({cell.name for cell in cells}) == 6 * 2 * 3 * 2
    assert cells[0].name == "traffic-guided-60s-seed0"
    ablated = ablation_cells(AblationExtent(seeds=(0,)))
    changed = sum(value != axis.default for axis in AXES for value in axis.reported)
    assert len(ablated) == len({cell.name for cell in ablated}) == changed + 1 == 26


def test_an_ablation_changes_one_number() -> None:
    base, *others = ablation_cells(AblationExtent(seeds=(0,)))
    assert base.overrides["policy.hidden"] == "[256, 256, 256]"
    for cell in others:
        different = [key for key, value in cell.overrides.items() if value != base.overrides[key]]
        assert different == [axis.key for axis in AXES if axis.name == cell.axis]
    engine = inputs_of(next(cell for cell in others if cell.value == "32x2")).values["engine"]
    assert (engine["hidden"], engine["samples"]) == ([32, 32], 50000)


def test_what_a_result_depends_on() -> None:
    inputs = inputs_of(quick())
    assert inputs.made({**inputs.values, "accuracy": 1.0})
    for key in inputs.values:
        assert not inputs.made({**inputs.values, key: "else"}), key
    others = [quick(seed=1), quick(held_out=31), quick(length=Length(steps=3)), quick(method="guided")]
    others.append(quick(overrides={"objective.gamma": "0.3"}))
    assert len({inputs.key, *(inputs_of(cell).key for cell in others)}) == 6


# ---------------------------------------------------------------------- filling


def test_a_finished_run_is_collected_and_then_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_process(monkeypatch)
    place = Place(tmp_path / "bench", tmp_path / "runs")
    cell = quick(overrides={**QUICK, "train.samples": "40"})
    run = trained(cell, place)
    (collected,) = fill([cell], place)
    (kept,) = fill([cell], place)
    assert (collected.kept, kept.kept) == (False, True)
    document = json.loads(place.file(cell).read_text())
    assert document == kept.document
    assert cell_of(document) == cell
    assert misfits(document, schema_of("cell")) == []
    states = load("traffic").sample(30, seed=HELD_OUT_SEED, dtype=torch.float64)
    good = satisfied(run.plan_judged(states)[1].rho)
    assert unpack(document["solved"], 30) == good.tolist()
    assert document["accuracy"] == pytest.approx(float(good.double().mean()))
    assert 0.0 <= document["training_accuracy"] <= 1.0
    assert valid_results(place.out, "ablation") == [document]
    assert valid_results(place.out, "paper") == []
    older = {key: value for key, value in document["engine"].items() if key != "clock"}
    place.file(cell).write_text(json.dumps({**document, "engine": older}))
    assert len(valid_results(place.out, "ablation")) == 1
    place.file(cell).write_text(json.dumps({**document, "engine": {**older, "slope": 7.0}}))
    assert valid_results(place.out, "ablation") == []
    stale = {**document, "engine_version": -1}
    place.file(cell).write_text(json.dumps(stale))
    assert valid_results(place.out) == []


@pytest.mark.slow
def test_a_run_that_was_cut_short_goes_on(tmp_path: Path) -> None:
    place = Place(tmp_path / "bench", tmp_path / "runs")
    cell, count = quick(length=Length(steps=6)), []
    cut = trained(cell, place, Watch(stop=lambda: bool(count.append(1)) or len(count) == 4))
    assert cut.dir.status == "interrupted"
    broken = quick(seed=1, overrides={"train.lr": "1e30"}, length=Length(steps=9))
    found: dict[str, Filled] = {each.cell.name: each for each in fill([cell, broken], replace(place, jobs=2))}
    assert found[cell.name].document["steps"] == 6
    assert [run.path for run in every_run(runs_of(inputs_of(cell), place))] == [cut.dir.path]
    assert cut.dir.status == "finished"
    assert found[broken.name].document == {}
    assert found[broken.name].why
    assert not place.file(broken).exists()


def test_the_command_from_training_to_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["bench", "paper", "--only", "traffic", "--methods", "gradient", "--seeds", "5", "--steps", "2"]
    words += ["--held-out", "40", "--out", str(tmp_path / "bench"), "--runs", str(tmp_path / "runs")]
    words += ["--page", str(tmp_path / "docs" / "results.md"), "--json"]

    def answer(*more: str) -> dict[str, Any]:
        assert main([*words, *more]) == 0
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        assert misfits(document, load_schema("bench/1")) == []
        result: dict[str, Any] = document["result"]
        return result

    first = answer("--passes", "1")
    no_process(monkeypatch)
    second = answer("--passes", "2")
    assert (first["trained"], first["kept"]) == (1, 0)
    assert (second["trained"], second["kept"]) == (0, 1)
    (before,), (after,) = first["ceilings"], second["ceilings"]
    assert (before["passes"], after["passes"]) == (1, 2)
    assert first["rows"][0]["accuracy"] <= before["share"] <= after["share"] <= 1.0
    assert misfits(read_json(tmp_path / "bench" / "ceilings.json"), schema_of("ceilings")) == []
    cell = read_json(tmp_path / "bench" / "traffic-gradient-2steps-seed5.json")
    assert cell["ceiling"] == after["share"]
    page = (tmp_path / "docs" / "results.md").read_text()
    assert page.count("<!-- paper -->") == 1
    assert f"| traffic | gradient | 2 steps | 5 | {cell['accuracy']:.4f} [" in page
    assert (tmp_path / "docs" / "img" / "results.svg").read_text().startswith("<svg")
    ablated = inputs_of(
        quick(held_out=40, overrides={"objective.gamma": "0.3"})
    )  # of the same benchmark, but of another system
    other = {**cell, **ablated.values, "study": "ablation", "axis": "k", "value": "7", "solved": "0" * 10}
    write_result(Place(tmp_path / "bench", tmp_path / "runs"), other)
    assert answer("--passes", "2")["ceilings"] == second["ceilings"]


def test_what_there_is_to_choose_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["paper", "--only", "trafic"], ["ablation", "--only", "lambda"], ["paper", "--only", ","]):
        assert main(["bench", *words, "--out", str(tmp_path / "out")]) == 2
    assert main(["bench", "paper", "--budget", "60s", "--steps", "3"]) == 2
    assert "did you mean `traffic`?" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------- ceilings


@pytest.fixture
def result() -> Callable[..., dict[str, Any]]:
    """The result of a cell that solves nothing unless told."""

    def made(count: int = 24, solved: list[bool] | None = None, **changes: Any) -> dict[str, Any]:
        cell = Cell("traffic", "guided", 0, Length(steps=2), held_out=count)
        facts = {"benchmark": "traffic", "solved": pack(solved or [False] * count), **changes}
        return {**inputs_of(cell).values, **facts}

    return made


def test_a_search_goes_on_where_it_stopped(tmp_path: Path, result: Callable[..., dict[str, Any]]) -> None:
    nothing, told = result(), []
    for passes in (1, 1, 2):
        search_on([nothing], tmp_path, passes=passes, told=lambda number, left: told.append((number, left)))
    assert [number for number, _ in told] == [1, 2]
    known = ceilings_of(tmp_path, [nothing])["traffic"]
    assert (known.passes, known.open) == (2, told[-1][1])
    assert known.share == 1.0 - known.open / 24
    assert known.tries == 2 * TRIES
    assert known.share > 0.7
    assert known.by_search == 24 - known.open


def test_what_any_policy_solves_counts(tmp_path: Path, result: Callable[..., dict[str, Any]]) -> None:
    one, other = ([i < 20 for i in range(24)], [i >= 20 for i in range(24)])
    cells = [result(solved=one), result(solved=other)]
    search_on(cells, tmp_path, passes=3)
    known = ceilings_of(tmp_path, cells)["traffic"]
    assert (known.share, known.open, known.by_search) == (1.0, 0, 0)
    assert ceilings_of(tmp_path / "elsewhere", cells[:1])["traffic"].share == 20 / 24


def test_other_states_are_searched_anew(tmp_path: Path, result: Callable[..., dict[str, Any]]) -> None:
    search_on([result()], tmp_path, passes=1)
    search_on([result(12)], tmp_path, passes=0)
    assert ceilings_of(tmp_path, [result(12)])["traffic"].share == 0.0


# ---------------------------------------------------------------------- tables


def cell_result(benchmark: str, method: str, seed: int, accuracy: float) -> dict[str, Any]:
    facts = {"benchmark": benchmark, "method": method, "seed": seed, "accuracy": accuracy, "held_out": 5000}
    numbers = {"seconds": 60.0 + seed, "steps": 100, "budget": 60.0, "steps_asked": None, "engine": {}}
    return {**facts, **numbers, "requirements": {"stop": accuracy}}


def test_rows_are_means_over_seeds_as_shares_of_the_ceiling() -> None:
    documents = [cell_result("ship_safe", "gradient", seed, 0.8 + 0.01 * seed) for seed in (2, 0, 1)]
    documents += [cell_result("traffic", "guided", 0, 0.96)]
    traffic, ship = paper_rows(documents, {"ship_safe": 0.9})
    assert (traffic.benchmark, traffic.share, traffic.length) == ("traffic", None, "60 s")
    assert ship.seeds == (0, 1, 2)
    assert ship.accuracies == pytest.approx((0.8, 0.81, 0.82))
    assert ship.mean == pytest.approx(0.81)
    assert ship.share == pytest.approx(0.9)
    assert ship.worst_share == pytest.approx(0.8 / 0.9)
    assert ship.requirements == {"stop": pytest.approx(0.81)}
    low, high = ship.interval
    assert low < 0.81 < high < low + 0.014
    assert [row.benchmark for row in paper_rows(documents, {})] == ["traffic", "ship_safe"]
    assert set(BENCHMARKS) >= {"traffic", "ship_safe"}


def test_clocks_do_not_share_a_row() -> None:
    wall, busy = (cell_result("traffic", "guided", seed, 0.9) for seed in (0, 1))
    busy["engine"] = {"clock": "processor"}
    assert [row.length for row in paper_rows([wall, busy], {})] == ["60 s", "60 s of processor time"]


def test_the_defaults_stand_in_every_table_of_the_ablation() -> None:
    def made(axis: str, value: str, accuracy: float) -> dict[str, Any]:
        facts = {"axis": axis, "value": value, "training_accuracy": accuracy + 0.01}
        return {**cell_result("traffic", "gradient", 0, accuracy), **facts}

    rows = ablation_rows([made("base", "", 0.9), made("gamma", "1.0", 0.8), made("samples", "200", 0.5)])
    found = {(row.axis, row.value): row.mean for row in rows}
    assert found == {
        **{("gamma", "0.5"): 0.9, ("gamma", "1.0"): 0.8, ("k", "500"): 0.9},
        **{("network", "256x3"): 0.9, ("samples", "200"): 0.5, ("samples", "50000"): 0.9},
    }
    reported = {(row.axis, row.value): row.reported for row in rows}
    assert reported["gamma", "1.0"] == (0.958, 0.955)
    assert reported["k", "500"] is None


def test_how_long_the_rest_takes_is_said_by_budgets() -> None:
    cells = [quick(seed=seed, length=Length(seconds)) for seed, seconds in enumerate([60.0, 300.0, 300.0])]
    assert _left(cells, [cells[0].name], 2) == "  2 left, about 5 min"
    assert _left(cells, [cell.name for cell in cells], 2) == ""
    assert _left([quick()], [], 1) == ""
