"""The examples of docs/extending.md: written into a copy of the source, changed as shown, and run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^<!-- (file|change|check): (.+?) -->\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLOCKS = BLOCK.findall(TEXT)
CHECKS = [(name, body) for kind, name, body in BLOCKS if kind == "check"]

RUNNER = """
import json, sys, traceback
failures = {}
for name, body in json.load(sys.stdin):
    try:
        exec(compile(body, name, "exec"), {"__name__": name})
    except BaseException:
        failures[name] = traceback.format_exc()
json.dump(failures, open("failures.json", "w"))
"""


def change(path: Path, diff: str) -> None:
    """Replace the lines of a diff that are there now by those that should be, at each of its places."""
    text = path.read_text(encoding="utf-8")
    for place in re.split(r"^@@.*\n", diff, flags=re.MULTILINE):
        lines = place.splitlines()
        before = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "+")
        after = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "-")
        assert text.count(before) == 1, f"{path.name} has changed: docs/extending.md shows\n{before}"
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def failures(tmp_path_factory) -> dict[str, str]:
    """Check -> traceback, of those that fail in the extended copy."""
    tree = tmp_path_factory.mktemp("extended")
    skipped = shutil.ignore_patterns("results")
    for folder in ("stlc", "benchmarks", "specs", "examples"):
        shutil.copytree(ROOT / folder, tree / folder, ignore=skipped)
    for kind, name, body in BLOCKS:
        if kind == "file":
            assert not (tree / name).exists(), f"{name} is there already"
            (tree / name).parent.mkdir(exist_ok=True)
            (tree / name).write_text(body, encoding="utf-8")
        elif kind == "change":
            change(tree / name, body)
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", RUNNER],
        input=json.dumps(CHECKS),
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads((tree / "failures.json").read_text(encoding="utf-8"))
    return found


def test_the_page_has_an_example_of_each_extension():
    assert len(CHECKS) == 15
    assert len([kind for kind, *_ in BLOCKS if kind == "file"]) == 15
    changed = [name for kind, name, _ in BLOCKS if kind == "change" and name.endswith(".py")]
    assert len(changed) == 10  # an operator, a trace format, a function, a kind of plant; 6 for a node


def test_an_extension_needs_the_files_that_the_page_promises():
    """New files and changed lines of source of each section; a table entry counts as one line."""
    promised = dict(re.findall(r"^\| \[([\w -]+)\]\(#[\w-]+\)[^|]* \| (.+?) \|", TEXT, re.MULTILINE))
    sections = re.split(r"^## An? ", TEXT, flags=re.MULTILINE)[1:]
    found = {}
    for section in sections:
        blocks = [
            (kind, body)
            for kind, name, body in BLOCK.findall(section)
            if kind == "change" or name[-3:] == ".py"
        ]
        added = [body for kind, body in blocks if kind == "change"]
        lines = sum(line.startswith("+") for body in added for line in body.splitlines())
        found[section.partition("\n")[0]] = (sum(kind == "file" for kind, _ in blocks), len(added), lines)
    entry, line = (0, 1), (1, 1, 1)
    names = {"method": "training method"}
    assert {names.get(name, name) for name in found} == set(promised)
    for name, counts in found.items():
        text = promised[names.get(name, name)]
        if "changed" in text:
            assert counts[:2] == (0, int(text.split()[0])), name
        elif "1 entry" in text:
            assert counts[:2] == entry, name
        else:
            assert counts == (line if "1 line" in text else (int(re.match(r"\d+", text)[0]), 0, 0)), name


@pytest.mark.apart
@pytest.mark.parametrize("name", [name for name, _ in CHECKS])
def test_an_example_works(name, failures):
    assert name not in failures, failures.get(name)


def test_the_examples_are_laid_out_like_the_source(tmp_path):
    for kind, name, body in BLOCKS:
        if kind == "file" and name.endswith(".py"):
            (tmp_path / Path(name).name).write_text(body, encoding="utf-8")
        elif kind == "change":
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                shutil.copy(ROOT / name, path)
            change(path, body)
    config = ["--config", str(ROOT / "pyproject.toml")]
    for action in (["check", "--ignore", "INP001"], ["format", "--check"]):
        command = [sys.executable, "-m", "ruff", *action, "-q", *config, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
