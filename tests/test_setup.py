"""The set-up of the repository: what `make` does before it does anything."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

import pytest

from stlc.version import __version__

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def environment(monkeypatch, tmp_path):
    """`tools/environment.py` on a tree of its own, with the commands recorded instead of run."""
    spec = importlib.util.spec_from_file_location("environment", ROOT / "tools/environment.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in module.INPUTS:
        (tmp_path / name).write_text((ROOT / name).read_text())
    ran = []

    def run(command):
        ran.append(command)
        module.PYTHON.parent.mkdir(parents=True, exist_ok=True)
        module.PYTHON.touch()

    for name, value in {
        "ROOT": tmp_path,
        "VENV": tmp_path / ".venv",
        "PYTHON": tmp_path / ".venv/bin/python",
        "STAMP": tmp_path / ".venv/stlc-stamp",
        "run": run,
    }.items():
        monkeypatch.setattr(module, name, value)
    module.ran = ran
    return module


def test_the_second_time_nothing_is_done(environment):
    environment.ensure()
    assert [command[1:3] for command in environment.ran] == [["-m", "venv"], ["-m", "pip"]]
    assert "constraints.txt" in environment.ran[1]
    environment.ran.clear()
    assert environment.ensure() == 0.0
    assert environment.ran == []


@pytest.mark.parametrize("name", ["pyproject.toml", "constraints.txt"])
def test_a_change_of_what_is_needed_is_noticed(environment, name):
    environment.ensure()
    environment.ran.clear()
    with (environment.ROOT / name).open("a") as file:
        file.write("# changed\n")
    environment.ensure()
    assert environment.ran


def test_an_old_python_gets_a_sentence(environment, monkeypatch):
    monkeypatch.setattr(environment, "NEEDED", (99, 0))
    with pytest.raises(
        SystemExit, match=r"needs Python 3\.11 or newer, and this is 3\.\d+ at .*make PYTHON="
    ):
        environment.ensure()
    assert environment.ran == []


def test_the_version_is_said_once():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["hatch"]["version"]["path"] == "stlc/version.py"
    assert f"[{__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_torch_is_pinned_and_only_in_the_constraints():
    assert "\ntorch==" in (ROOT / "constraints.txt").read_text()
    assert '"torch>=' in (ROOT / "pyproject.toml").read_text()


def test_the_script_that_has_to_be_green_can_be_run():
    script = ROOT / ".ci/run"
    assert script.stat().st_mode & 0o111
    assert "make test" in script.read_text()
