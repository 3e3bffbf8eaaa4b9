"""Every JSON document fits its published schema."""

from __future__ import annotations

import inspect
import json
import re
from importlib import import_module
from pathlib import Path

import pytest
from helpers.documents import misfits
from jsonschema import Draft202012Validator

from stlc.cli.commands.schema import load_schema, names
from stlc.cli.framework.app import main
from stlc.cli.framework.results import RESULTS
from stlc.rundir import RunDir

ROOT = Path(__file__).resolve().parents[3]
SUPERFLUOUS = {"Verdict"}
"""Results without keys that those of another result do not have."""


def test_the_checker_finds_what_does_not_fit():
    schema = {"type": "object", "properties": {"a": {"items": {"type": "integer"}}}, "required": ["b"]}
    assert len(misfits({"a": [1, "x"], "c": 1}, schema)) == 3


@pytest.mark.parametrize("name", names())
def test_a_schema_is_one(name):
    Draft202012Validator.check_schema(load_schema(name))


@pytest.mark.parametrize("name", sorted(RESULTS.keys() - {"stlc"}))
def test_commands_declare_the_records_that_they_print(name):
    module = import_module(f"stlc.cli.commands.{name}")
    declared = [
        re.sub(r"Answer\[(.*)\]", r"\1", answer).split(" | ")
        for function in vars(module).values()
        if inspect.isfunction(function)
        and function.__module__ == module.__name__
        and not function.__name__.startswith("_")
        and "Answer[" in (answer := str(function.__annotations__.get("return")))
    ]
    named = {name.rpartition(".")[2] for one in declared for name in one}
    assert {place.partition(":")[2] for place in RESULTS[name]} == named - SUPERFLUOUS


@pytest.fixture(autouse=True)
def _project(tmp_path, monkeypatch):
    """Specs that are clean, unclear and wrong, a system and a trace."""
    monkeypatch.chdir(tmp_path)
    main(["init"])
    Path("good.stl").write_text("signal x [m]\n\nrequire low: always[0 s, 0.2 s] x < 3 m\n")
    Path("unclear.stl").write_text("signal x [m]\nrequire low: always[0 s, 1 s] x < 3 m and x > 0 m\n")
    Path("bad.stl").write_text("signal x [m]\nrequire low: always[0 s, 1 s] y < 3 m\n")
    Path("drive.csv").write_text("t,x\n0,1\n0.1,4\n0.2,1\n")
    Path("short.csv").write_text("t,x\n0,1\n0.1,2\n")
    Path("torn.csv").write_text("t,x\n0,1\n0.1\n")
    Path("scope.stl").write_text("signal x [m]\nassume high: x > 5 m\nrequire low: always[0, T] x < 3 m\n")
    for number, words in enumerate(["first", "second"]):
        RunDir.create(Path("runs"), "cart", words).update({"status": "finished", "seed": number})


DOCUMENTS = {
    "tree": ["compile", "good.stl", "--show", "ast"],
    "trees": ["compile", "good.stl", "unclear.stl", "--show", "ast"],
    "trees of bad files": ["compile", "bad.stl", "missing.stl", "--show", "ast"],
    "lint": ["lint", "good.stl", "unclear.stl", "bad.stl"],
    "lint usage": ["lint", "--sellect", "W1"],
    "fmt": ["fmt", "good.stl", "unclear.stl", "--check"],
    "fmt diff": ["fmt", "unclear.stl", "--diff"],
    "compile": ["compile", "specs/cart.stl"],
    "compile fails": ["compile", "bad.stl"],
    "check": ["check", "good.stl", "drive.csv"],
    "check several": ["check", "good.stl", "drive.csv", "short.csv", "torn.csv"],
    "check short": ["check", "good.stl", "short.csv"],
    "check in pieces": ["check", "good.stl", "drive.csv", "--chunk", "2"],
    "check out of scope": ["check", "scope.stl", "drive.csv", "-s", "systems/cart.yaml"],
    "check all starts": ["check", "good.stl", "drive.csv", "--at", "all"],
    "check fails": ["check", "bad.stl", "drive.csv"],
    "explain": ["explain"],
    "explain code": ["explain", "E203"],
    "explain spec": ["explain", "specs/cart.stl"],
    "explain trace": ["explain", "drive.csv", "--spec", "good.stl"],
    "plot": ["plot", "drive.csv", "--spec", "good.stl"],
    "init": ["init", "elsewhere"],
    "init spec": ["init", "--spec", "parking", "--from", "systems/cart.yaml"],
    "init system": ["init", "--system", "wagon"],
    "doctor": ["doctor", "--quick"],
    "runs": ["runs", "list"],
    "runs show": ["runs", "show", "7"],
    "runs diff": ["runs", "diff", "first", "second"],
    "runs rm": ["runs", "rm", "first"],
    "system list": ["system", "list"],
    "system show": ["system", "show", "systems/cart.yaml"],
    "system check": ["system", "check", "systems/cart.yaml", "--steps", "4"],
}


@pytest.mark.parametrize("words", DOCUMENTS.values(), ids=DOCUMENTS)
def test_a_document_fits_its_schema(words, capsys):
    capsys.readouterr()
    code = main([*words, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["exit_code"] == code
    assert found["ok"] == (code == 0)
    schema = load_schema(words[0])
    assert found["schema"] == f"{words[0]}/1"
    assert misfits(found, schema) == []
    if code < 2 or code == 4:
        assert found["result"] is not None


def test_schemas_are_listed_and_printed(capsys):
    assert main(["schema"]) == 0
    listed = capsys.readouterr().out.split()
    assert listed == names()
    assert {"check/1", "lint/1", "train/1", "simulate/1"} <= set(listed)
    for name in listed:
        assert main(["schema", name]) == 0
        schema = json.loads(capsys.readouterr().out)
        assert schema["title"] == name


def test_an_unknown_schema(capsys):
    assert main(["schema", "chek/1"]) == 2
    assert "did you mean `check/1`" in capsys.readouterr().err
