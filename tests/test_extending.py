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
from helpers.tools import load_tool

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
CHANGES = load_tool("structure").changes(TEXT)
FILES = [each for change in CHANGES for each in change.files.items()]
DIFFS = [each for change in CHANGES for each in change.diffs.items()]
CHECKS = [each for change in CHANGES for each in change.checks.items()]

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
    for name, body in FILES:
        assert not (tree / name).exists(), f"{name} is there already"
        (tree / name).parent.mkdir(exist_ok=True)
        (tree / name).write_text(body, encoding="utf-8")
    for name, diff in DIFFS:
        change(tree / name, diff)
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
    assert len(CHECKS) == 18
    assert len(FILES) == 16
    changed = [name for name, _ in DIFFS if name.endswith(".py")]
    # an operator, a trace format, a function, a strategy, a kind of plant, a figure; 2 for an option, 6 for a
    # node
    assert len(changed) == 14


def test_an_extension_needs_the_files_that_the_page_promises():
    """New files and changed lines of source of each section; a table entry counts as one line."""
    promised = dict(re.findall(r"^\| \[([\w -]+)\]\(#[\w-]+\)[^|]* \| (.+?) \|", TEXT, re.MULTILINE))
    names = {"method": "training method"}
    assert {names.get(each.kind, each.kind) for each in CHANGES} == set(promised)
    for each in CHANGES:
        text = promised[names.get(each.kind, each.kind)]
        new = each.counted - len(each.diffs)
        if "changed" in text:
            assert (new, each.counted) == (0, int(text.split()[0])), each.kind
        elif "1 entry" in text:
            assert (new, each.counted) == (0, 1), each.kind
        else:
            lines = re.search(r"(\d) lines?", text)
            promise = (1, 1, int(lines[1])) if lines else (int(re.match(r"\d+", text)[0]), 0, 0)
            assert (new, len(each.diffs), each.lines) == promise, each.kind


@pytest.mark.apart
@pytest.mark.parametrize("name", [name for name, _ in CHECKS])
def test_an_example_works(name, failures):
    assert name not in failures, failures.get(name)


def test_the_examples_are_laid_out_like_the_source(tmp_path):
    pytest.importorskip("ruff")
    for name, body in FILES:
        if name.endswith(".py"):
            (tmp_path / Path(name).name).write_text(body, encoding="utf-8")
    for name, diff in DIFFS:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            shutil.copy(ROOT / name, path)
        change(path, diff)
    ours = 'lint.isort.known-first-party = ["stlc"]'  # new modules too
    config = ["--config", str(ROOT / "pyproject.toml"), "--config", ours]
    for action in (["check", "--ignore", "INP001"], ["format", "--check"]):
        command = [sys.executable, "-m", "ruff", *action, "-q", *config, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
