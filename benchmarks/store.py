"""Stored results: one JSON file per table, in which each result has a name and a record of its inputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.dynamics.system import System
from stlc.files import File, alone_in
from stlc.grammar.spec import Spec
from stlc.jsontext import dumps, plain
from stlc.provenance import git_state, hardware, sha256, versions
from stlc.rundir import RunDir

FORMAT = "benchmark-results/1"
RESULTS = Path("benchmarks/results")
BENCHMARKS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
"""The benchmarks of the paper, in its order. Each is the name of a specification."""

Result = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Key:
    """Name and inputs of a result; if the inputs change, the result is computed again.

    Attributes:
        name: name of the result, unique in its file.
        values: inputs as plain data: specification, system, method and its version, version of the guard,
            seeds, sizes.
    """

    name: str
    values: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """Hash of all inputs: ten hexadecimal digits."""
        return sha256(dumps(plain(self.values)))[:10]


@dataclass(frozen=True, slots=True)
class ResultStore:
    """Stored results of one table, in the file `FOLDER/TABLE.json`, one line per result."""

    table: str
    folder: Path = RESULTS

    @property
    def path(self) -> Path:
        """Path of the file with the results."""
        return self.folder / f"{self.table}.json"

    def get(self, key: Key, compute: Callable[[], Result]) -> Result:
        """Return the stored result of `key`, or else the result of `compute`, which is then stored."""
        found = self.find(key)
        return found if found is not None else self.put(key, compute())

    def find(self, key: Key) -> Result | None:
        """Return the stored result with the name and inputs of `key`, or None."""
        kept = self.all().get(key.name)
        return kept if kept is not None and kept.get("key") == plain(key.values) else None

    def put(self, key: Key, result: Result) -> Result:
        """Store `result`, with its date, versions and machine, under the name in `key`; return it as stored.

        An older result of that name is replaced. Processes that store results in the same folder at the same
        time wait for each other.

        Raises:
            UsageError: U102, the file is there, but its results cannot be read.
        """
        document = {"name": key.name, "key": key.values, "made": made_here(), **result}
        self.folder.mkdir(parents=True, exist_ok=True)
        with alone_in(self.folder, wait=True):
            kept = {**self.all(), key.name: plain(document)}
            lines = ",\n".join(f"{dumps(name)}: {dumps(each)}" for name, each in kept.items())
            File(self.path).write(f'{{"format": {dumps(FORMAT)}, "results": {{\n{lines}\n}}}}\n')
        return self.all()[key.name]

    def all(self) -> dict[str, dict[str, Any]]:
        """Return all stored results by name, including outdated ones; empty if there is no file.

        Raises:
            UsageError: U102, the file is there, but its results cannot be read.
        """
        if not self.path.exists():
            return {}
        try:
            document = json.loads(self.path.read_text(encoding="utf-8"))
            if document["format"] != FORMAT:
                raise ValueError(f"its format is {document['format']}")
            return dict(document["results"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            message = f"the results in `{self.path}` cannot be read: {error}"
            raise usage(message, "move the file away, or repair it", code="U102") from None


def made_here() -> dict[str, Any]:
    """Return the provenance of a result that is computed now: date, software versions, commit and machine."""
    return {"date": RunDir.now(), "versions": versions(), "git": git_state(), "hardware": hardware()}


# ----------------------------------------------------------------------- tasks


def spec_path(benchmark: str) -> Path:
    """Return the path of a benchmark's specification: in `specs/`, or else among the installed files.

    Raises:
        UsageError: U102, there is no such benchmark.
    """
    name = f"{benchmark}.stl"
    for path in (folder / part / name for folder in (Path("specs"), File.SPECS) for part in ("", "families")):
        if path.is_file():
            return path
    raise usage(f"there is no benchmark `{benchmark}`", *BENCHMARKS, code="U102")


def load(benchmark: str, overrides: tuple[tuple[str, str], ...] = ()) -> Task:
    """Return the task of a benchmark; it is compiled once for each set of `overrides` (name, value)."""
    return _load(spec_path(benchmark).resolve(), spec_path(benchmark), overrides)


@cache
def _load(_where: Path, path: Path, overrides: tuple[tuple[str, str], ...]) -> Task:
    spec = Spec.parse(File(path).read())
    if spec.system is None:
        raise usage(f"`{path}` names no system")
    changed = dict(overrides)
    system = System.load(File(spec.system).system(path), changed)
    return Task.of(spec, system, overrides=changed)


def inputs_of(task: Task) -> dict[str, str]:
    """Return hashes of the specification (with imports) and of the system's parts that affect training."""
    spec, decl = task.compiled.spec, task.system.decl
    texts = [spec.source.text, *(f"{key}\n{text}" for key, text in sorted(spec.imported_texts().items()))]
    named = (f"{name} {sha256(path.read_bytes())}" for name, path in sorted(decl.files.items()))
    return {
        "spec_sha256": sha256("\0".join(texts)),
        "system_sha256": sha256("\0".join([decl.learnt, *named])),
    }
