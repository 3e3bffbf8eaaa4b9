"""`stlc plan --tube`: bounds for all errors of a scenario, as text, as a document, and in the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main

ROOT = Path(__file__).parents[3]
SPEC = str(ROOT / "specs" / "traffic.stl")
START = "x=-10, v=2, sign=light, tau=5, dx=2.5, v_lead=2, yielding=0"


def planned(folder: Path, *options: str) -> int:
    usual = ("--from", START, "--target", "max", "--evaluations", "3000", "-o", str(folder / "plan.npz"))
    return main(["plan", SPEC, *usual, *options])


def test_a_guaranteed_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert planned(tmp_path, "--tube", "mismatch-5") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "mismatch-5: the plan is guaranteed to satisfy it"
    assert lines[3].startswith("  taken as exact, as conditions or limits read them: ")
    assert lines[4].split()[0] == "no_collision"
    assert lines[-1].startswith("trace ")


def test_a_plan_without_a_guarantee_and_noise_that_is_cut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert planned(tmp_path) == 0
    capsys.readouterr()
    assert planned(tmp_path, "--tube", "disturb-50") == 1
    said = "no guarantee that the plan satisfies it, noise within 3 standard deviations"
    assert f"disturb-50: {said}" in capsys.readouterr().out


def test_the_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert planned(tmp_path, "--tube", "mismatch-5", "--starts", "3", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("plan/1")) == []
    tube = document["result"]["tube"]
    assert tube["scenario"] == "mismatch-5"
    assert tube["deviations"] is None
    assert tube["guaranteed"] == 3
    low, high = tube["robustness"]
    nominal = document["result"]["robustness"]
    assert low - 1e-9 <= nominal["least"] <= nominal["greatest"] <= high + 1e-9
    assert all(each["low"] <= each["high"] for each in tube["requirements"].values())


def test_several_plans_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planned(tmp_path, "--tube", "mismatch-5", "--starts", "3")
    assert "mismatch-5: 3 of 3 plans are guaranteed to satisfy it" in capsys.readouterr().out


def test_an_unknown_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert planned(tmp_path, "--tube", "mismach") == 2
    assert "there is no scenario `mismach`" in capsys.readouterr().err
    assert not (tmp_path / "plan.npz").exists()
