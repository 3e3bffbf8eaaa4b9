"""The examples of docs/plants.md: its files are written, its commands and programs are run."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.toolchain import compiler

PAGE = Path(__file__).parents[1] / "docs" / "plants.md"
BLOCK = re.compile(r"<!-- (file|run)(?:: ([^>]*?))? -->\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)


BLOCKS = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
RUNS = [(needs, body) for kind, needs, body in BLOCKS if kind == "run"]
FIRST = "first"
"""Mark of a block that writes a file which a later one reads."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files of the page, its FMU, and what the blocks marked `first` write."""
    path = tmp_path_factory.mktemp("page")
    for kind, name, body in BLOCKS:
        if kind == "file":
            (path / name).write_text(body, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        for needs, body in RUNS:
            if FIRST in needs and all(find_spec(package) for package in packages(needs)):
                ran(body)
    return path


def packages(needs: str) -> list[str]:
    """Packages that a block needs."""
    named = (each for each in needs.split(", ") if each not in ("", FIRST))
    return ["fmpy" if each == "fmu" else each for each in named]


def ran(body: str) -> None:
    """Run a block."""
    if not body.startswith("$ "):
        exec(compile(body, "plants.md", "exec"), {})
        return
    command, _, _ = body.partition("\n")
    assert main(shlex.split(command)[2:]) in (0, 1)


def test_every_kind_has_an_example():
    text = PAGE.read_text(encoding="utf-8")
    assert len(RUNS) >= 7
    for word in ("python:", "fmu:", "gym:", "onnx:"):
        assert word in text


@pytest.mark.apart
@pytest.mark.parametrize("index", range(len(RUNS)))
def test_an_example_runs(index, folder, request, monkeypatch, capsys):
    needs, body = RUNS[index]
    for package in packages(needs):
        pytest.importorskip(package)
    if needs == "fmu":
        if compiler() is None:
            pytest.skip("no C compiler")
        from helpers.fmus import build

        if not (folder / "ball.fmu").exists():
            build(folder, "ball", 3)
    capsys.readouterr()
    monkeypatch.chdir(folder)
    ran(body)
    if not body.startswith("$ "):
        return
    command, _, wanted = body.partition("\n")
    shown = capsys.readouterr().out
    if request.config.getoption("--regenerate"):
        text = PAGE.read_text(encoding="utf-8")
        assert text.count(f"{command}\n{wanted}```") == 1
        PAGE.write_text(text.replace(f"{command}\n{wanted}```", f"{command}\n{shown}```"), encoding="utf-8")
        return
    assert shown == wanted
