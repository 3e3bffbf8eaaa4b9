"""Every JSON document fits its published schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stlc.cli.app import main
from stlc.cli.schema import load_schema, names

ROOT = Path(__file__).resolve().parents[2]
KINDS = {
    "string": str,
    "integer": int,
    "number": (int, float),
    "boolean": bool,
    "object": dict,
    "array": list,
    "null": type(None),
}


def misfits(value: Any, schema: dict[str, Any], path: str = "$") -> list[str]:
    """Where a value is not what the part of JSON Schema that is used here allows."""
    found: list[str] = []
    if "const" in schema and value != schema["const"]:
        found.append(f"{path} is not {schema['const']}")
    if "enum" in schema and value not in schema["enum"]:
        found.append(f"{path} is none of {schema['enum']}")
    if "anyOf" in schema:
        each = [misfits(value, option, path) for option in schema["anyOf"]]
        if all(each):
            found += min(each, key=len)
    wanted = schema.get("type", [])
    kinds = [wanted] if isinstance(wanted, str) else wanted
    if kinds and not any(is_a(value, kind) for kind in kinds):
        found.append(f"{path} is no {' or '.join(kinds)}: {value!r}")
    if isinstance(value, dict):
        found += [f"{path} has no {key}" for key in schema.get("required", ()) if key not in value]
        for key, item in value.items():
            inner = schema.get("properties", {}).get(key, schema.get("additionalProperties", {}))
            found += misfits(item, inner, f"{path}.{key}")
    if isinstance(value, list):
        for number, item in enumerate(value):
            found += misfits(item, schema.get("items", {}), f"{path}[{number}]")
    return found


def is_a(value: Any, kind: str) -> bool:
    return isinstance(value, KINDS[kind]) and (kind == "boolean" or not isinstance(value, bool))


def test_the_checker_finds_what_does_not_fit():
    schema = {
        "type": "object",
        "properties": {"a": {"type": "array", "items": {"type": "integer"}}},
        "required": ["b"],
    }
    assert misfits({"a": [1, "x"]}, schema) == ["$ has no b", "$.a[1] is no integer: 'x'"]


@pytest.fixture(autouse=True)
def _project(tmp_path, monkeypatch):
    """Specs that are clean, unclear and wrong, a system and a trace."""
    monkeypatch.chdir(tmp_path)
    main(["init"])
    Path("good.stl").write_text("signal x [m]\n\nrequire low: always[0 s, 0.2 s] x < 3 m\n")
    Path("unclear.stl").write_text("signal x [m]\nrequire low: always[0 s, 1 s] x < 3 m and x > 0 m\n")
    Path("bad.stl").write_text("signal x [m]\nrequire low: always[0 s, 1 s] y < 3 m\n")
    Path("drive.csv").write_text("t,x\n0,1\n0.1,4\n0.2,1\n")


DOCUMENTS = {
    "parse": ["parse", "good.stl"],
    "parse two": ["parse", "good.stl", "unclear.stl"],
    "parse bad": ["parse", "bad.stl", "missing.stl"],
    "lint": ["lint", "good.stl", "unclear.stl", "bad.stl"],
    "lint usage": ["lint", "--sellect", "W1"],
    "fmt": ["fmt", "good.stl", "unclear.stl", "--check"],
    "fmt diff": ["fmt", "unclear.stl", "--diff"],
    "compile": ["compile", "specs/cart.stl"],
    "compile fails": ["compile", "bad.stl"],
    "check": ["check", "good.stl", "drive.csv"],
    "check fails": ["check", "bad.stl", "drive.csv"],
    "explain": ["explain"],
    "explain code": ["explain", "E203"],
    "explain spec": ["explain", "specs/cart.stl"],
    "explain trace": ["explain", "drive.csv", "--spec", "good.stl"],
    "plot": ["plot", "drive.csv", "--spec", "good.stl"],
    "init": ["init", "elsewhere"],
    "new": ["new", "spec", "parking", "--from", "systems/cart.yaml"],
    "doctor": ["doctor", "--quick"],
    "bench": ["bench", "robustness", "--samples", "20", "--traces", "1", "--seconds", "0"],
    "runs": ["runs", "list"],
    "runs show": ["runs", "show", "7"],
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
