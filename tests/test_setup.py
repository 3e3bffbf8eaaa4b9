"""The set-up of the repository: what `make` does before it does anything."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml
from helpers.tools import load_tool

from stlc.cli.framework.app import main
from stlc.version import __version__

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def environment(monkeypatch, tmp_path):
    """`tools/environment.py` on a tree of its own, with the commands recorded instead of run."""
    module = load_tool("environment")
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
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "stlc/version.py"
    assert f"[{__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_torch_is_pinned_and_only_in_the_constraints():
    assert "\ntorch==" in (ROOT / "constraints.txt").read_text()
    assert '"torch>=' in (ROOT / "pyproject.toml").read_text()


def test_the_script_that_has_to_be_green_can_be_run():
    script = ROOT / ".ci/run"
    assert script.stat().st_mode & 0o111
    assert "make test" in script.read_text()


# ---------------------------------------------------------------------- for those who use or cite it


def hooks():
    return yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text())


def test_the_hooks_are_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("wide.stl").write_text("signal   x\nrequire low:   x<5\n")
    Path("wrong.stl").write_text("require low: y < 5\n")
    codes = {}
    for hook in hooks():
        assert re.search(hook["files"], "specs/wide.stl")
        assert not re.search(hook["files"], "car.yaml")
        program, *words = shlex.split(hook["entry"])
        assert program == "stlc"
        codes[hook["id"]] = [main([*words, name]) for name in ("wide.stl", "wrong.stl")]
    assert codes == {"stlc-lint": [0, 3], "stlc-fmt": [0, 0]}
    assert Path("wide.stl").read_text() == "signal x\nrequire low: x < 5\n"
    capsys.readouterr()


def test_the_hooks_are_as_pre_commit_wants_them():
    known = {"id", "name", "description", "entry", "language", "files", "types"}
    for hook in hooks():
        assert set(hook) == known
        assert hook["language"] in ("system", "python")
    pre_commit = pytest.importorskip("pre_commit.clientlib")
    pre_commit.load_manifest(str(ROOT / ".pre-commit-hooks.yaml"))


def test_the_documents_show_these_hooks():
    text = (ROOT / "docs/editors.md").read_text()
    assert all(f"id: {hook['id']}" in text for hook in hooks())


def test_the_citation():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["cff-version"] == "1.2.0"
    assert cited["version"] == __version__
    assert {"message", "title", "authors", "license"} <= set(cited)
    paper = cited["preferred-citation"]
    assert re.fullmatch(r"10\.\d{4}/\S+", paper["doi"])
    assert [author["family-names"] for author in paper["authors"]] == ["Meng", "Fan"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["urls"]["Paper"].endswith(paper["doi"])
    assert paper["title"] in (ROOT / "README.md").read_text()
