"""Help texts: every option stands in a group, and a former name tells the present one."""

from __future__ import annotations

import pytest

from stlc.cli.framework.app import PROGRAM, main
from stlc.cli.framework.help import MOVED_OPTIONS, OPTIONS, title_of

PARSER = PROGRAM.parser()


def parameters():
    for name, command in PARSER.commands.items():
        for word, part in (getattr(command, "commands", None) or {name: command}).items():
            yield from ((f"{name} {word}", part.name, param) for param in part.params)


def test_every_option_stands_in_a_group():
    alone = {
        f"{place}: {param.opts[0]}"
        for place, command, param in parameters()
        if title_of(param, command) == "Options"
    }
    assert alone == set()


def test_every_name_of_a_group_is_an_option_and_stands_once():
    names = [name for words in OPTIONS.values() for name in words.split()]
    known = {word.removeprefix("--") for _, _, param in parameters() for word in param.opts}
    assert len(names) == len(set(names))
    assert set(names) <= known


def test_every_command_stands_in_a_group():
    assert {name for names in PROGRAM.groups.values() for name in names} == set(PARSER.commands)


def test_groups_keep_one_column_and_80_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["simulate", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"Guard:", "Verdict:", "Output:"} <= {*lines}
    assert max(map(len, lines)) <= 80
    starts = {line.index(line[3:].split("  ")[-1].strip()) for line in lines if line.startswith("  --json")}
    assert starts == {line.index("A scenario") for line in lines if "--scenario" in line and "NAME" in line}


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["plan", "specs/traffic.stl", "--output", "x.npz"], "--output is now called --out"),
        (["falsify", "specs/arch/transmission.stl", "--time", "3s"], "--time is now called --budget"),
        (["certify", "--max-drives", "3"], "--max-drives is now called --drives"),
        (["simulate", "--ceiling", "3"], "--ceiling is now called --known-feasible"),
        (["certify", "--ceiling", "3"], "no such option: --ceiling"),
    ],
)
def test_a_former_name_tells_the_present_one(words, answer, capsys):
    assert main(words) == 2
    assert answer in capsys.readouterr().err


def test_a_command_has_an_option_by_one_of_its_names():
    """`--clock` is that of a recording in `check`, and was that of the budget in `train`."""
    known: dict[str, set[str]] = {}
    for path, _, param in parameters():
        known.setdefault(str(path), set()).update(param.opts)
    for former, present in MOVED_OPTIONS.items():
        having = [words for words in known.values() if present in words]
        assert having
        assert not any(former in words for words in having)
