"""Deployments under disturbances: driven once, kept, and laid out as a table."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.documents import misfits

from benchmarks import deployments
from benchmarks.__main__ import main as measure
from benchmarks.deployments import (
    NOMINAL,
    SCENARIOS,
    DeploymentOptions,
    DeploymentRow,
    Deployments,
    mean_and_half,
    rows_of,
)
from benchmarks.store import BENCHMARKS, ResultStore
from benchmarks.tables.disturbed import METRICS, section
from benchmarks.tables.schema import document_schema
from benchmarks.tables.worlds import section as worlds_section
from benchmarks.tables.worlds import wholly_viable
from stlc.cli.framework.app import main
from stlc.controller.guard import kind
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[2]
SPEC = "signal p [m]\n@safety\nrequire near: always[0, T] abs(p) <= 1.2 m\n"
SYSTEM = """\
stlc: 1
name: dot
time: {dt: 0.5 s, horizon: 4 steps}
state: {p: {unit: m, range: [-2, 2]}, w: {unit: m/s, range: [-2, 2]}}
control: {u: {unit: m/s^2, range: [-1, 1]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: "uniform(-1, 1)", w: 0}}]}
policy: {hidden: [8]}
backup: {bins: 3, T0: [1], batch: 64}
test: {steps: 12, agents: 4}
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    (folder / "dot.stl").write_text(SPEC)
    (folder / "dot.yaml").write_text(SYSTEM)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        command = ["train", "dot.stl", "--system", "dot.yaml", "--steps", "3", "--batch", "16"]
        assert main([*command, "--held-out", "50", "--no-pictures"]) in (0, 1)
    return folder


@pytest.fixture
def run(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunDir:
    monkeypatch.chdir(home)
    capsys.readouterr()
    return RunDir.newest()


def bench(run: RunDir, out: Path, *options: str) -> int:
    page = ["--page", str(out / "page.md"), "--out", str(out)]
    return measure(["disturbed", str(run.path), "--seeds", "0,1", *page, *options])


def results(folder: Path, table: str = "disturbed") -> dict[str, Any]:
    return ResultStore(table, folder).all()


def at(result: dict[str, Any]) -> tuple[str, str]:
    return result["key"]["scenario"], result["key"]["guard"]


@pytest.mark.apart
def test_what_was_driven_is_kept(
    run: RunDir, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    some = ["--scenarios", "as it is,mismatch-20,noise", "--guards", "none,paper"]
    assert bench(run, tmp_path, *some) == 0
    captured = capsys.readouterr()
    assert captured.err.count("deploying") == 6
    first = results(tmp_path)
    (name,) = {each["key"]["spec"] for each in first.values()}
    assert len(first) == 6
    page = (tmp_path / "page.md").read_text()
    assert f"| {name}, 2 x 4 x 12 | as it is |" in page
    columns = [f"{what}, {guard}" for what in METRICS for guard in ("no guard", "paper's")]
    assert f"| {' | '.join(columns)} |" in page

    with monkeypatch.context() as patch:
        patch.setattr(deployments, "simulate", lambda *_: pytest.fail("driven twice"))
        assert bench(run, tmp_path, *some, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    result = document["result"]
    assert (result["driven"], result["kept"]) == (0, 6)
    assert [row["scenario"] for row in result["rows"]] == ["as it is", "mismatch-20", "noise"]
    assert results(tmp_path) == first

    with monkeypatch.context() as patch:
        patch.setattr(kind, "GUARD_VERSION", kind.GUARD_VERSION + 1)
        assert bench(run, tmp_path, "--scenarios", "noise", "--guards", "none") == 0
    assert capsys.readouterr().err.count("deploying") == 1  # by another guard
    assert bench(run, tmp_path, "--scenarios", "noise", "--guards", "none", "--steps", "6") == 0
    assert capsys.readouterr().err.count("deploying") == 1  # of another size


def test_guards_and_scenarios_begin_alike_and_end_otherwise(run: RunDir, tmp_path: Path) -> None:
    """An agent is savable under every scenario and guard or under none: only so can they be compared."""
    assert bench(run, tmp_path, "--guards", "none,full", "--scenarios", "as it is,mismatch-20") == 0
    found = results(tmp_path).values()
    assert {each["metrics"]["savable"]["mean"] for each in found} == {1.0}
    safe = {at(each): each["metrics"]["saved"]["mean"] for each in found}
    assert safe[NOMINAL, "full"] == 1.0
    assert safe[NOMINAL, "full"] >= safe[NOMINAL, "none"]
    acted = {at(each)[1]: each["acted"] for each in found if at(each)[0] == NOMINAL}
    assert acted["none"] == 0.0


@pytest.mark.apart
def test_a_margin_is_measured_under_each_scenario(run: RunDir, tmp_path: Path) -> None:
    some = ["--scenarios", "as it is,mismatch-20", "--guards", "full,full+0.1,full+auto"]
    assert bench(run, tmp_path, *some) == 0
    found = {at(each): each for each in results(tmp_path).values()}
    assert "margin" not in found["mismatch-20", "full"]
    assert "margin" not in found[NOMINAL, "full+auto"]
    assert found[NOMINAL, "full+auto"]["metrics"] == found[NOMINAL, "full"]["metrics"]
    assert found["mismatch-20", "full+0.1"]["margin"] == {"near": 0.1}
    assert 0.0 < found["mismatch-20", "full+auto"]["margin"]["near"] < 0.3
    titles = "safe starts, full | safe starts, full with margin 0.1 | safe starts, full with margin"
    assert titles in (tmp_path / "page.md").read_text()


def test_starts_are_searched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def search(_task: Any, x0: torch.Tensor) -> torch.Tensor:
        asked.append(len(x0))
        return x0[:, 0] > 0

    monkeypatch.setattr(deployments, "viable", search)
    starts, x0 = Deployments(ResultStore("some"), DeploymentOptions()), torch.tensor([[1.0], [-1.0]])
    for _ in range(3):
        assert starts.viable(None, x0.clone()).tolist() == [True, False]  # type: ignore[arg-type]
    assert starts.viable(None, -x0).tolist() == [False, True]  # type: ignore[arg-type]
    assert asked == [2, 2]


def test_worlds_are_driven_kept_and_laid_out(
    run: RunDir, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "worlds.md"
    command = ["worlds", str(run.path), "--seeds", "0..2", "--guards", "none,full", "--json"]
    assert measure([*command, "--known-feasible", "30", "--page", str(page), "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    (row,) = document["result"]["rows"]
    shares = {name: each["metrics"]["feasible_followed"]["mean"] for name, each in row["guards"].items()}
    assert 0.0 < shares["none"] <= shares["full"] == 1.0
    assert results(tmp_path, "worlds")
    assert not results(tmp_path)
    text = page.read_text()
    assert text.count(f"| {row['spec']}, as it is, 3 x 4 x 12 | none |") == 1
    assert "|  | full |" in text


def test_seeds_without_lost_starts_are_told_apart() -> None:
    def document(accuracy: list[float], saved: list[float]) -> dict[str, Any]:
        values = {"savable": [1.0, 0.9, 1.0], "plan_accuracy": accuracy, "saved": saved}
        return {"metrics": {name: {"values": each} for name, each in values.items()}}

    guards = {"none": document([0.6, 0.1, 0.8], [0.5, 0, 0.5]), "full": document([0.9, 0, 0.7], [1, 0, 1])}
    line = " ".join(part.strip() for part in wholly_viable(DeploymentRow("a", "b", 3, 2, 1, guards)))
    assert "in the 2 of 3 seeds" in line
    assert line.endswith("none 0.700 and 0.500; full 0.800 and 1.000")
    guards = {"none": {"metrics": {"savable": {"values": [1.0]}}}}
    assert list(wholly_viable(DeploymentRow("a", "b", 1, 2, 1, guards))) == []


def test_without_policies_that_is_said(
    run: RunDir, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure(["disturbed", "--out", str(tmp_path), "--runs", str(tmp_path)]) == 2
    assert "no policies of the benchmarks" in capsys.readouterr().err
    assert bench(run, tmp_path, "--guards", "fulll") == 2
    assert "did you mean `full`" in capsys.readouterr().err
    assert bench(run, tmp_path, "--scenarios", "nois") == 2
    assert "there is no scenario `nois`" in capsys.readouterr().err


# ------------------------------------------------------------------------- the table


def document(spec: str, scenario: str, guard: str, seeds: int = 2) -> dict[str, Any]:
    share = {"mean": 0.5, "low": 0.25, "high": 0.75, "values": [0.5] * seeds}
    key = {"spec": spec, "scenario": scenario, "guard": guard, "seeds": list(range(seeds))}
    made = {"versions": {"torch": "2"}, "hardware": {"cores": 2}, "git": {"commit": "0123456789ab"}}
    return {
        "key": {**key, "agents": 4, "steps": 12},
        "made": {**made, "date": "2026-01-02T03"},
        **{"run": "0001-a-b", "policy": {"method": "guided", "seed": 0, "accuracy": 0.5, "seconds": None}},
        **{"metrics": {"saved": share}, "progress": {}, "acted": 0.0},
    }


def test_rows_are_in_order_and_guards_side_by_side() -> None:
    documents = [
        document("own", "noise", "none"),
        document("ship_safe", "shifted", "none"),
        document("ship_safe", NOMINAL, "none"),
        document("traffic", "noise", "full"),
        document("traffic", "noise", "none"),
        document("traffic", "mismatch-5", "none"),
    ]
    rows = rows_of(documents)
    assert [(row.spec, row.scenario) for row in rows] == [
        ("traffic", "mismatch-5"),
        ("traffic", "noise"),
        ("ship_safe", NOMINAL),
        ("ship_safe", "shifted"),
        ("own", "noise"),
    ]
    assert set(rows[1].guards) == {"none", "full"}
    page = "\n".join(section(documents))
    assert "| traffic, 2 x 4 x 12 | mismatch-5 | .500 ± .250 |  |  |  |  |  |" in page
    assert "|  | noise | .500 ± .250 | .500 ± .250 |  |  |  |  |" in page
    assert "6 deployments" in page
    assert page.count("- traffic: run 0001-a-b, method guided, seed 0, ? s of training") == 1


def test_where_the_world_is_to_blame_quiet_starts_are_told() -> None:
    def driven(spec: str, scenario: str, guard: str, every: float, quiet: float) -> dict[str, Any]:
        shares = {"saved_starts": every, "quiet_safe_starts": quiet, "quiet": 0.4}
        metrics = {
            name: {"mean": mean, "low": mean, "high": mean, "values": []} for name, mean in shares.items()
        }
        return {**document(spec, scenario, guard), "metrics": metrics}

    documents = [
        driven(spec, scenario, guard, every, quiet)
        for spec, every, quiet in (("traffic", 0.5, 1.0), ("navigation", 1.0, 1.0), ("maze", 0.5, 0.5))
        for scenario in (NOMINAL, "noise")
        for guard in ("none", "full")
    ]
    page = "\n".join(section(documents))
    assert "| traffic | noise | .400 ± .000 | 1.000 ± .000 | 1.000 ± .000 |" in page
    assert page.count("| .400 ± .000 |") == 2  # the others have nothing to explain, or no explanation
    assert "no exogenous event" in page
    assert "no exogenous event" not in "\n".join(section(documents[4:]))


def test_shares_are_short() -> None:
    assert mean_and_half({"mean": 1.0, "high": 1.0}) == "1.000 ± .000"
    assert mean_and_half({"mean": 0.957, "high": 1.5}) == ".957 ± .543"
    assert mean_and_half({"mean": 0.25, "high": None}) == ".250"
    assert mean_and_half(None) == ""


@pytest.mark.parametrize(("table", "made"), [("disturbed", section), ("worlds", worlds_section)])
def test_what_is_published_is_what_is_kept(table: str, made: Any) -> None:
    page = (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8")
    (shown,) = re.findall(rf"<!-- {table} -->\n(.*?)<!-- /{table} -->", page, re.DOTALL)
    kept = list(results(ROOT / "benchmarks/results", table).values())
    assert shown.strip() == "\n".join(made(kept)).strip()


def test_what_is_published_is_complete() -> None:
    """All six benchmarks under every scenario, without and with the guard, as the page says."""
    rows = rows_of(results(ROOT / "benchmarks/results").values())
    assert [(row.spec, row.scenario) for row in rows] == [
        (spec, scenario) for spec in BENCHMARKS for scenario in SCENARIOS
    ]
    assert all({"none", "paper"} <= set(row.guards) for row in rows)
