"""Forward kinematics of a user's robot compared with pytorch-kinematics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.diagnostics import SystemFileError
from stlc.dynamics import crosscheck
from stlc.dynamics.declaration.functions import FunctionDecl
from stlc.dynamics.declaration.kinematics import chain, position

ROBOT = """<robot name="crane">
  <link name="ground"/><link name="mast"/><link name="boom"/><link name="hook"/>
  <joint name="stand" type="fixed"><parent link="ground"/><child link="mast"/><origin xyz="0 0 1"/></joint>
  <joint name="turn" type="continuous"><parent link="mast"/><child link="boom"/>
    <origin xyz="0 0 2" rpy="0.3 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="reach" type="prismatic"><parent link="boom"/><child link="hook"/>
    <origin xyz="1 0 0" rpy="0 0.5 0"/><axis xyz="0.6 0 0.8"/>
    <limit lower="0" upper="3" effort="1" velocity="1"/></joint>
</robot>"""
library = pytest.mark.skipif(crosscheck.find_spec("pytorch_kinematics") is None, reason="needs the library")


def hook(folder: Path, base: str = "") -> FunctionDecl:
    path = folder / "crane.urdf"
    path.write_text(ROBOT)
    return FunctionDecl("hook", path, "hook", body=position(chain(ROBOT, "hook", base or None)), base=base)


@library
@pytest.mark.parametrize("base", ["", "mast", "boom"])
def test_they_agree(tmp_path, base, capfd):
    found = crosscheck.compared(hook(tmp_path, base))
    assert found.distance is not None, found.why
    assert found.distance < 1e-5
    assert capfd.readouterr() == ("", "")


@library
def test_they_do_not(tmp_path):
    function = replace(hook(tmp_path), body=position(chain(ROBOT.replace("0.3 0 0", "0 0 0.3"), "hook")))
    with pytest.raises(
        SystemFileError, match=r"S208: `hook` is up to .* m from where pytorch-kinematics puts `hook`"
    ):
        crosscheck.compared(function)


@library
def test_what_the_library_does_not_take(tmp_path):
    function = hook(tmp_path)
    function.module.write_text("<robot/>")
    assert "does not take it" in crosscheck.compared(function).why


def test_without_the_library(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(crosscheck, "find_spec", lambda _: None)
    assert "extra `panda`" in crosscheck.compared(hook(tmp_path)).why
    assert main(["system", "check", "panda.yaml", "--steps", "1"]) == 0
    assert "ee: not compared; pytorch-kinematics is not installed" in capsys.readouterr().err
    assert main(["system", "check", "panda.yaml", "--steps", "1", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["result"]["kinematics"]
    assert (row["name"], row["distance_m"]) == ("ee", None)
