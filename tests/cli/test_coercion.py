"""Light commands stay light: values that are texts already bring no converter of typer's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
import typer

from stlc.cli.framework.program import spare_adapters

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "numpy", "pydantic", "yaml", "rich", "matplotlib")


@pytest.mark.apart
@pytest.mark.parametrize(
    ("words", "needed"),
    [
        (["lint", "specs/traffic.stl"], ["numpy", "yaml"]),  # it reads the system that the file names
        (["lint", "tests/golden/resolve/tag_misuse.stl"], []),
        (["compile", "specs/traffic.stl", "--show", "ast"], []),
        (["explain", "E203"], []),
        (["schema"], []),
        (
            ["check", "examples/recording/tank.csv", "--spec", "examples/recording/tank.stl", "--jobs", "1"],
            ["numpy"],
        ),
    ],
)
def test_a_light_command_imports_little(words, needed):
    program = (
        "import sys; from stlc.cli.framework.app import main; code = main(sys.argv[1:]); "
        f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr); sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *words], cwd=ROOT, check=False, capture_output=True, text=True
    )
    assert done.returncode == {"lint": 3 * ("golden" in words[-1]), "check": 1}.get(words[0], 0)
    assert done.stderr.splitlines()[-1] == str(needed)


@pytest.mark.bench
def test_lint_is_quick():
    """CPU seconds of `stlc lint specs/traffic.stl`, the least of five; it reads the system, too."""
    seconds = []
    for _ in range(5):
        before = sum(os.times()[2:4])
        words = [sys.executable, "-m", "stlc", "lint", "specs/traffic.stl"]
        subprocess.run(words, cwd=ROOT, check=True, capture_output=True)
        seconds.append(sum(os.times()[2:4]) - before)
    sys.stdout.write(f"stlc lint specs/traffic.stl: {min(seconds):.2f} s\n")
    assert min(seconds) < 0.45


Word = Literal["one", "two"]


@pytest.fixture
def values():
    """Run a command with one parameter of each kind; what it was called with."""
    program = typer.Typer(rich_markup_mode=None)
    found = {}

    @program.command()
    def act(
        names: Annotated[list[str], typer.Argument()],
        word: Annotated[Word, typer.Option()] = "one",
        number: Annotated[int | None, typer.Option()] = None,
        share: Annotated[float, typer.Option(min=0.0)] = 0.5,
        path: Annotated[Path, typer.Option()] = Path("runs"),
        flag: Annotated[bool, typer.Option("--flag")] = False,
        several: Annotated[list[str] | None, typer.Option()] = None,
    ) -> None:
        found.update(locals())

    def run(*words: str):
        command = typer.main.get_command(program)
        spare_adapters(command)
        found.clear()
        command.main(list(words), standalone_mode=False)
        return dict(found)

    return run


def test_defaults(values):
    given = values("a", "b")
    assert given["names"] == ["a", "b"]
    assert (given["word"], given["number"], given["share"], given["path"]) == ("one", None, 0.5, Path("runs"))
    assert (given["flag"], given["several"] or []) == (False, [])


def test_values_are_converted(values):
    given = values(
        *("a", "--word", "two", "--number", "3", "--share", "2", "--path", "x/y", "--flag"),
        *("--several", "p", "--several", "q"),
    )
    assert (given["word"], given["number"], given["share"], given["path"]) == ("two", 3, 2.0, Path("x/y"))
    assert (given["flag"], given["several"]) == (True, ["p", "q"])


@pytest.mark.parametrize("words", [["--word", "three"], ["--number", "x"], ["--share", "-1"], []])
def test_what_does_not_fit_is_refused(values, words):
    arguments = ["a", *words] if words else []
    with pytest.raises(Exception) as caught:  # noqa: PT011 - its class is not public
        values(*arguments)
    assert caught.value.exit_code == 2
