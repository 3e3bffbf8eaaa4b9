"""`stlc report`: the page of a run, found by name."""

import json

import pytest
from helpers.documents import misfits

import stlc.view
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.extras import installation
from stlc.rundir import RunDir


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = RunDir.create(tmp_path / "runs", "traffic", "quiet-heron")
    made.write_json("run.json", {"status": "running", "spec": "traffic"})
    return made


def test_the_newest_run_is_shown(run, capsys):
    assert main(["report"]) == 0
    assert capsys.readouterr().out == "runs/traffic/0001-quiet-heron/report.html\n"
    assert (run.path / "report.html").read_text().startswith("<!doctype html>")


def test_a_run_can_be_named_and_the_answer_be_json(run, capsys):
    assert main(["report", "quiet-heron", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "report/1"
    assert misfits(document, load_schema("report/1")) == []
    assert document["result"]["report"] == f"{run.shown}/report.html"


@pytest.mark.usefixtures("run")
def test_an_unknown_run_is_a_usage_error(capsys):
    assert main(["report", "quiet-hero"]) == 2
    assert "did you mean `quiet-heron`?" in capsys.readouterr().err


def test_without_matplotlib_it_says_what_to_install(run, capsys, monkeypatch):
    monkeypatch.setattr(stlc.view, "find_spec", lambda _: None)
    assert main(["report"]) == 5
    assert installation("plot") in capsys.readouterr().err
    assert not (run.path / "report.html").exists()
