"""Pages that are typed from the top: files are written and commands run, in the order of the page.

`<!-- file: NAME -->` stands before a block that is the text of a file. A block of language `console` holds
commands behind `$`, each with how what it prints begins. A block of language `text` shows what the last
command printed where that depends on the machine: what its lines begin with has to be there. Python is run.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from stlc.cli.framework.app import main

BLOCK = re.compile(r"^(?:<!-- file: ([\w./]+) -->\n)?```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Step:
    """Next action of a reader, or output that the reader sees.

    Attributes:
        kind: what `text` is: a file to write, a command or program to run, lines that were printed.
        text: the file, the command, the program, or the lines.
        name: of the file.
        shown: how what the command prints begins.
    """

    kind: Literal["file", "command", "python", "shown"]
    text: str
    name: str = ""
    shown: str = ""


def steps(page: Path) -> list[Step]:
    """The files, commands and pictures of screens of a page, in order."""
    return list(_steps(page.read_text(encoding="utf-8")))


def _steps(text: str) -> Iterator[Step]:
    for name, language, body in BLOCK.findall(text):
        if name:
            yield Step("file", body, name)
        elif language == "console":
            for part in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
                command, _, output = part.partition("\n")
                yield Step("command", command, shown=output.strip())
        elif language in ("text", "python"):
            yield Step("shown" if language == "text" else "python", body)


def short(words: list[str]) -> list[str]:
    """The same command with less work in it."""
    match words[0]:
        case "train":
            at = next(index for index, word in enumerate(words) if word in ("--budget", "--steps"))
            return [*words[:at], "--steps", "15", "--held-out", "200", *words[at + 2 :]]
        case "simulate":
            return [*words, "--seeds", "0", "--agents", "2", "--steps", "35", "--no-pictures"]
        case _:
            return words


def codes(command: str, special: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Exit codes that a command may have: 0, unless another one is known for how it begins."""
    return next((found for start, found in special.items() if command.startswith(start)), (0,))


def walk(page: Path, special: dict[str, tuple[int, ...]], capsys: pytest.CaptureFixture[str]) -> None:
    """Do what a page says, in the current folder."""
    printed = ""
    for step in steps(page):
        match step.kind:
            case "file":
                Path(step.name).write_text(step.text, encoding="utf-8")
            case "shown":
                missing = [label for label in labels(step.text) if label not in printed]
                assert not missing, f"no longer printed: {missing}\n{printed}"
            case "python":
                exec(compile(step.text, page.name, "exec"), {})
            case "command":
                printed = _run(step, special, capsys)


def _run(step: Step, special: dict[str, tuple[int, ...]], capsys: pytest.CaptureFixture[str]) -> str:
    words = shlex.split(step.text, comments=True)
    if words[0] == "cd":
        os.chdir(words[1])
        return ""
    code = main(short(words[1:]))
    printed = capsys.readouterr()
    assert code in codes(step.text, special), f"{step.text}\n{printed.err}"
    assert printed.out.startswith(step.shown) or printed.err.startswith(step.shown), step.text
    return printed.out + printed.err


def labels(text: str) -> list[str]:
    """Beginnings of lines, up to a wide gap; numbers are those of one run."""
    lines = [line.strip() for line in text.splitlines()]
    found = [re.split(r"\s{2,}", line)[0] for line in lines if re.search(r"\S\s{2,}\S", line)]
    return [label for label in found if not re.search(r"(?<!_)\d", label)]
