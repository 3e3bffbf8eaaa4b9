"""Tables of proofs: policies on boxes of initial states, and closed loops with networks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.tables.ainncs import CASES, PUBLISHED, layers_of, published_in
from benchmarks.tables.schema import document_schema
from stlc.cli.framework.app import main
from stlc.diagnostics import UsageError

ROOT = Path(__file__).parents[2]


@pytest.mark.apart
def test_a_policy_is_verified_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = "--steps 2 --batch 16 --held-out 10 --drives 0 --no-pictures --threads 1"
    spec = str(ROOT / "specs" / "traffic.stl")
    assert main(["train", spec, "--method", "guided", "--runs", str(tmp_path), *small.split()]) == 0
    run = str(next(tmp_path.glob("*/0001-*")))
    page = tmp_path / "page.md"
    line = ["verify", run, "--budget", "0.001s", "--states", "8", "--points", "5", "--out", str(tmp_path)]
    capsys.readouterr()
    documents = []
    for _ in range(2):
        assert measure([*line, "--page", str(page), "--json"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    assert misfits(documents[0], document_schema()) == []
    rows = documents[0]["result"]["rows"]
    assert rows == documents[1]["result"]["rows"]
    assert len(rows) == 7
    assert sum(row["states"] for row in rows) == 8
    assert all(row["violations"] == 0 for row in rows)
    assert "| policy | network | initial states |" in page.read_text(encoding="utf-8")


NNET = """\
// a network in the format NNet
2, 2, 1, 3,
2, 3, 1,
0,
0,
0,
0,
0,
-0.3, -0.2,
-0.3, -0.3,
0.5, 0.1,
0.1,
0.2,
0.0,
-0.4, 0.2, 0.3,
-0.1,
"""


def test_networks_of_the_format_nnet(tmp_path: Path) -> None:
    (tmp_path / "net.nnet").write_text(NNET, encoding="utf-8")
    first, last = layers_of(tmp_path / "net.nnet")
    np.testing.assert_allclose(first.weight, [[-0.3, -0.2], [-0.3, -0.3], [0.5, 0.1]])
    assert (first.bias.tolist(), last.bias.tolist()) == ([0.1, 0.2, 0.0], [-0.1])
    assert (first.activation, last.activation) == ("relu", "linear")
    with pytest.raises(UsageError, match="known format"):
        layers_of(tmp_path / "net.txt")


def test_a_closed_loop_is_verified_beside_another_tool(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = tmp_path / "models" / "Single-Pendulum"
    models.mkdir(parents=True)
    (models / "controller_single_pendulum.nnet").write_text(NNET, encoding="utf-8")
    other = tmp_path / "results.csv"
    other.write_text("benchmark,instance,result,time\nSinglePendulum,,falsified,0.25\n", encoding="utf-8")
    line = ["ainncs", str(models.parent), "--only", "single_pendulum", "--published", str(other), "--json"]
    assert measure([*line, "--out", str(tmp_path), "--page", str(tmp_path / "page.md")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    (row,) = document["result"]["rows"]
    assert row["result"] in ("falsified", "verified", "unknown")
    assert (row["published"], row["violations"]) == ("falsified, 0.2 s", 0)


def test_published_results_are_shown_with_their_sources(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = tmp_path / "models" / "Single-Pendulum"
    models.mkdir(parents=True)
    (models / "controller_single_pendulum.nnet").write_text(NNET, encoding="utf-8")
    results = {"instance": "single pendulum", "result": "falsified", "seconds": 150}
    place = {"repository": "o/r", "commit": "0123456789abcdef", "path": "times.csv"}
    tool = {"tool": "T", "year": 2025, **place, "about": "whole scripts", "results": [results]}
    (tmp_path / PUBLISHED).write_text(json.dumps({"tools": [tool]}), encoding="utf-8")
    page = tmp_path / "page.md"
    line = ["ainncs", str(models.parent), "--only", "single_pendulum", "--json", "--out", str(tmp_path)]
    assert measure([*line, "--page", str(page)]) == 0
    (row,) = json.loads(capsys.readouterr().out)["result"]["rows"]
    assert row["published"] == "T: falsified, 2 min"
    source = "- T, 2025: whole scripts; github.com/o/r at `0123456789`, `times.csv`\n"
    assert source in page.read_text(encoding="utf-8")


def test_published_results_name_instances_and_sources() -> None:
    tools = published_in(ROOT / "benchmarks" / "results")
    names = {case.name for case in CASES}
    assert tools
    for tool in tools:
        assert tool["repository"].count("/") == 1
        assert len(tool["commit"]) == 40
        assert {each["instance"] for each in tool["results"]} <= names
        assert all(each.get("result") or each.get("seconds", 0) > 0 for each in tool["results"])


def test_networks_that_are_not_there_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert measure(["ainncs", str(tmp_path), "--only", "acc", "--out", str(tmp_path)]) == 2
    assert "there is no network" in capsys.readouterr().err
