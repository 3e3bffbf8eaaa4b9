"""One policy for a family: trained once, judged value by value, and nothing is judged twice."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.store import ResultStore, load, spec_path
from benchmarks.table import Table
from benchmarks.tables.family import COLUMNS, FAMILIES, Family, FamilyRow, section
from benchmarks.tables.schema import document_schema
from benchmarks.training import Cell, Length, Place
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.run.config import HELD_OUT_SEED
from stlc.controller.run.run import Run
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import train
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir
from stlc.source import Source

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _in_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_values_lie_inside_of_the_range_and_on_both_sides_of_it(family: Family) -> None:
    low, high = family.sampled()
    assert family.values[0] < low < high < family.values[-1]
    assert sum(low <= value <= high for value in family.values) >= 3
    assert list(family.values) == sorted(set(family.values))
    task = load(family.name)
    drawn = task.sample(500, seed=0, dtype=torch.float64)[:, task.system.names.index(family.parameter)]
    assert low <= float(drawn.min()) < float(drawn.max()) <= high


@pytest.mark.parametrize(
    ("family", "benchmark", "value"), [("ship_radius", "ship_safe", "1m"), ("stop_time", "traffic", "1s")]
)
def test_at_the_value_of_the_benchmark_a_family_is_the_benchmark(
    family: str, benchmark: str, value: str
) -> None:
    (parameter,) = [each.parameter for each in FAMILIES if each.name == family]
    own = load(benchmark)
    spec = Spec.parse(Source(str(spec_path(family)), spec_path(family).read_text()))
    same = Task.of(spec, own.plain, overrides={parameter: value})
    assert [(rule.name, rule.tags) for rule in same.rules] == [(rule.name, rule.tags) for rule in own.rules]
    assert [item for item in spec.items if isinstance(item, ast.Param)]
    x0 = own.sample(200, seed=1, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    share = torch.rand(
        200, own.horizon, len(own.system.decl.controls), generator=generator, dtype=torch.float64
    )
    u = own.system.control_low + share * (own.system.control_high - own.system.control_low)
    here, there = same.judge(x0, u).requirements, own.judge(x0, u).requirements
    torch.testing.assert_close(here, there, rtol=0, atol=1e-12)


def test_what_is_published_is_complete() -> None:
    kept = ResultStore("family_verdicts", ROOT / "benchmarks/results").all().values()
    names = {each["key"]["training"]["benchmark"] for each in kept}
    assert names == {family.name for family in FAMILIES}
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    for family in FAMILIES:
        own = [each["key"] for each in kept if each["key"]["training"]["benchmark"] == family.name]
        assert {key["value"] for key in own} == set(family.values)
        for value in family.values:
            assert re.search(rf"^\| \*?{value:g} {family.unit}\*? \|", page, re.MULTILINE)


@pytest.mark.apart
def test_from_training_to_the_page_and_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _train(Place(ResultStore("family", tmp_path / "bench"), tmp_path / "runs"))
    words = ["family", "--only", "ship_radius", "--steps", "2", "--held-out", "20", "--json"]
    words += ["--out", str(tmp_path / "bench"), "--runs", str(tmp_path / "runs")]
    words += ["--page", str(tmp_path / "results.md")]
    few = [FAMILIES[0].values[0], 1.0]
    monkeypatch.setattr("benchmarks.tables.family.FAMILIES", (_of(FAMILIES[0], (few[1],)),))

    def answer(code: int = 0) -> tuple[dict[str, Any], str]:
        assert measure(words) == code
        said = capsys.readouterr()
        document: dict[str, Any] = json.loads(said.out)
        assert misfits(document, document_schema()) == []
        result: dict[str, Any] = document["result"]
        return result, said.err

    first, said = answer()
    assert (first["trained"], [row["value"] for row in first["rows"]]) == (1, few[1:])
    assert said.count("judging") == 1
    monkeypatch.setattr("benchmarks.tables.family.FAMILIES", (_of(FAMILIES[0], tuple(few)),))
    second, said = answer()
    assert (second["kept"], [row["value"] for row in second["rows"]]) == (1, few)
    assert said.count("judging") == 1
    assert [row["inside"] for row in second["rows"]] == [False, True]
    assert second["rows"][1] == first["rows"][0]

    (folder,) = (tmp_path / "runs").iterdir()
    (run,) = RunDir.every(folder)
    policy = Run.open(run.path, overrides={"radius": "1.0m"}).policy
    states = policy.task.sample(20, seed=HELD_OUT_SEED, dtype=torch.float64)
    assert set(states[:, policy.task.system.names.index("radius")].tolist()) == {1.0}
    good = TOLERANCE.satisfied(policy.plan_judged(states)[1].rho)
    assert second["rows"][1]["accuracy"] == pytest.approx(float(good.double().mean()))
    page = (tmp_path / "results.md").read_text()
    assert "| 1 m | 2 steps | 0 |" in page
    assert f"| *{few[0]:g} m* | 2 steps | 0 |" in page

    (tmp_path / "bench/family_verdicts.json").unlink()
    (tmp_path / "runs").rename(tmp_path / "gone")
    third, said = answer(code=1)
    assert third["rows"] == []
    assert "its run is gone" in third["failed"][0]["why"]


def _train(place: Place) -> None:
    """Files that a process that trains ship_radius leaves behind."""
    cell = Cell(FAMILIES[0].name, "guided", 0, Length(steps=2), held_out=20)
    launch = Launch(root=place.runs_of(cell.key), command=("train",))
    task = load(cell.benchmark)
    train(task, cell.config(), open_folder(task, cell.config(), launch))


def _of(family: Family, values: tuple[float, ...]) -> Family:
    return replace(family, values=values)


def test_the_tables_have_one_row_a_value_and_mark_what_was_never_seen() -> None:
    rows = [
        FamilyRow("stop_time", value, value <= 1.4, "60 s", (0, 1), 0.9, (0.89, 0.91), feasible)
        for value, feasible in ((1.0, 0.95), (1.8, 0.0))
    ]
    text = "\n".join(section([], Table("family", rows, lambda row: row, COLUMNS)))
    assert "### Traffic, how long to stand at a stop sign, trained on 0.6 to 1.4 s" in text
    assert "| 1 s | 60 s | 0, 1 | 0.9000 [0.8900, 0.9100] | 0.9500 | 0.947 |" in text
    assert "| *1.8 s* | 60 s | 0, 1 | 0.9000 [0.8900, 0.9100] | 0.0000 |  |" in text
