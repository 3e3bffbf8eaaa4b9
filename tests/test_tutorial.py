"""The tutorial works: its files are written, its commands are run in order, its output is compared."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from stlc.cli.app import main

PAGE = Path(__file__).resolve().parent.parent / "docs/tutorial.md"
TEXT = PAGE.read_text(encoding="utf-8")
FILES = re.findall(r"<!-- file: ([\w.]+) -->\n```\w*\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
BLOCKS = re.findall(r"^```console\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
CODES = {"check": 1, "explain tank.csv": 1}
"""Commands that say no: the recording violates a requirement. What a short run does is left open."""


def steps() -> list[tuple[str, str]]:
    """(command, how what it prints begins) in order; nothing where the page does not show it."""
    found = []
    for block in BLOCKS:
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            found.append((command, output.strip()))
    return found


def short(words: list[str]) -> list[str]:
    """The same command with less work in it."""
    if words[0] == "train":
        at = words.index("--budget")
        return [*words[:at], "--steps", "15", *words[at + 2 :]]
    if words[0] == "simulate":
        return [*words, "--seeds", "1", "--agents", "2", "--steps", "10"]
    return words


def expected(command: str) -> tuple[int, ...]:
    if command.startswith("stlc check trace.npz"):
        return (0, 1, 4)
    return tuple(code for start, code in CODES.items() if command.startswith(f"stlc {start}")) or (0,)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("tutorial")
    for name, body in FILES:
        (place / name).write_text(body, encoding="utf-8")
    return place


def test_the_files_were_found():
    assert [name for name, _ in FILES] == ["tank.stl", "tank.csv", "tank.yaml", "pump.stl"]
    assert len(steps()) > 10


def test_every_command_does_what_the_page_says(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for command, output in steps():
        words = short(shlex.split(command)[1:])
        code = main(words)
        printed = capsys.readouterr()
        assert code in expected(command), f"{command}\n{printed.err}"
        assert printed.out.startswith(output) or printed.err.startswith(output), command
    assert (folder / "tank.svg").is_file()
    assert list(folder.glob("runs/pump/*/report.html"))
