"""`stlc verify`: text, document, exit codes, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main

ROOT = Path(__file__).parents[3]


def trained(folder: Path, spec: str, method: str = "plan") -> str:
    spec_path = str(ROOT / "specs" / f"{spec}.stl")
    small = "--steps 2 --batch 16 --held-out 10 --drives 0 --no-pictures --threads 1"
    assert main(["train", spec_path, "--method", method, "--runs", str(folder), *small.split()]) == 0
    return str(next(folder.glob("*/0001-*")))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    return trained(tmp_path_factory.mktemp("runs"), "traffic", "guided")


def test_the_text_says_shares_and_counterexamples(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", run, "--boxes", "3"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["initial", "states", "probability", "proved", "refuted", "open"]
    assert lines[-1].partition(":")[2].startswith(" violated from x=")
    (total,) = (line for line in lines if line.split()[:1] == ["all"])
    assert total.split()[1] == "100.0"


def test_the_document(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", run, "--boxes", "3", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("verify/1")) == []
    result = document["result"]
    assert result["proved"] + result["refuted"] + result["open"] == pytest.approx(1.0)
    assert sum(mode["probability"] for mode in result["modes"]) == pytest.approx(1.0)


@pytest.mark.slow
def test_processes_give_the_same_result(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for options in ([], ["--jobs", "2"], ["--jobs", "2", "--budget-clock", "processor"]):
        assert main(["verify", run, "--boxes", "40", "--budget", "1h", "--json", *options]) == 1
        found.append(json.loads(capsys.readouterr().out)["result"]["modes"])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(("least", "code"), [("0", 0), ("1", 1)])
def test_a_least_share_decides_the_exit_code(run: str, least: str, code: int) -> None:
    assert main(["verify", run, "--boxes", "3", "--fail-under", least]) == code


@pytest.mark.apart
def test_boxes_around_random_states(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", run, "--boxes", "1", "--states", "3", "--json"]) == 1
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["states"] == sum(mode["states"] for mode in result["modes"]) == 3
    assert result["states_proved"] + result["states_violated"] <= 3
    assert result["states_share"] <= result["states_proved"] / 3
    main(["verify", run, "--boxes", "1", "--states", "3", "--budget-clock", "processor"])
    text = capsys.readouterr().out
    assert " of 3 random initial states are in a proved box" in text
    (least,) = re.findall(r"at least (\d+\.\d\d) % of all", text)  # rounded down
    assert float(least) <= 100 * result["states_share"] + 1e-6


def test_what_cannot_be_verified_is_refused(
    run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shooting = trained(tmp_path, "traffic", "plan")
    capsys.readouterr()
    assert main(["verify", shooting]) == 2
    assert "can be verified" in capsys.readouterr().err
    assert main(["verify", run, "--budget-clock", "moon"]) == 2
