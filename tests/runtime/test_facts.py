"""A controller's folder is whole or is not used."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.exported import exported, mission

from stlc.diagnostics import RunError, UsageError
from stlc.runtime.facts import read_facts


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    return Path(shutil.copytree(exported("traffic", "car")[1], tmp_path / "controller"))


def test_facts_are_those_of_the_run(folder: Path) -> None:
    facts = read_facts(folder)
    assert facts.spec["name"] == "traffic"
    assert len(facts.spec["sha256"]) == len(facts.system["sha256"]) == 64
    assert (facts.dt, facts.horizon) == (0.1, 25)
    assert facts.grid.lengths == (1, 2, 3)
    assert [each.name for each in facts.controls] == ["u"]
    assert facts.added == ()
    assert read_facts(folder / "judge.onnx") == facts


def test_what_a_mission_adds_is_told() -> None:
    added = read_facts(mission()[1]).added
    assert [(each.name, each.added, each.initial) for each in added[:1]] == [("far", "parameter", None)]
    assert {each.added for each in added[1:]} == {"timer"}
    assert all(each.initial is not None for each in added[1:])


def damaged(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return damage


def _without(key: str) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        read = json.loads(data)
        del read[key]
        return json.dumps(read).encode()

    return change


def _with(key: str, value: object, *, add: bool = False) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        read = json.loads(data)
        read[key] = {**read[key], **value} if add and isinstance(value, dict) else value
        return json.dumps(read).encode()

    return change


def _in_place_of(path: Path, make: Callable[[Path], None]) -> None:
    path.unlink()
    make(path)


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (damaged("decide.onnx", lambda data: data[:-1]), "decide.onnx is damaged"),
        (damaged("controller.json", lambda data: data[:40]), "JSON"),
        (damaged("controller.json", _without("backup")), "backup"),
        (damaged("controller.json", lambda data: data.replace(b"controller/1", b"controller/9")), "format"),
        (lambda folder: (folder / "fall.onnx").unlink(), "fall.onnx"),
        (lambda folder: _in_place_of(folder / "fall.onnx", os.mkfifo), "fall.onnx is not a file"),
        (lambda folder: _in_place_of(folder / "controller.json", os.mkdir), "controller.json is not a file"),
        (damaged("controller.json", _with("files", ["a"])), "dictionary"),
        (damaged("controller.json", _with("files", {})), "its graphs are"),
        (damaged("controller.json", _with("files", {"/etc/passwd": "0"}, add=True)), "/etc/passwd"),
        (damaged("controller.json", _with("files", {"../a.onnx": "0"}, add=True)), "../a.onnx"),
        (damaged("controller.json", _with("horizon", math.inf)), "OverflowError"),
        (damaged("controller.json", lambda _: b"[" * 200_000), "RecursionError"),
        (damaged("controller.json", lambda _: b"\xff"), "Unicode"),
        (lambda folder: (folder / "controller.json").unlink(), "controller.json"),
    ],
)
def test_what_is_missing_or_mixed_is_told(damage: Callable[[Path], None], why: str, folder: Path) -> None:
    damage(folder)
    with pytest.raises(RunError) as caught:
        read_facts(folder)
    (finding,) = caught.value.diagnostics
    assert finding.code == "R106"
    assert why in finding.note[0]


def test_no_folder_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="U102"):
        read_facts(tmp_path / "nothing")
