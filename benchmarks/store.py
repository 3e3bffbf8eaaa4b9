"""Stored results: a JSON file per table, each result under a key of its inputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from stlc.compile.frontend.modules import library_of
from stlc.controller.problem.task import Task
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.model.system import System
from stlc.dynamics.robots.functions import function_files
from stlc.files import SPECS, find_system, read_source, write_atomic
from stlc.grammar.parse.parser import parse
from stlc.jsontext import dumps, plain
from stlc.provenance import git_state, hardware, sha256, versions
from stlc.rundir import now

FORMAT = "benchmark-results/1"
RESULTS = Path("benchmarks/results")
BENCHMARKS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
"""The tasks of the paper, in its order; each is a specification of that name."""

Result = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Key:
    """The inputs of a result; if they change, the result is computed again.

    Attributes:
        name: of the result, unique in its file.
        values: plain data: specification, system, method and its version, version of the guard, seeds, sizes.
    """

    name: str
    values: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """Hash of all values, ten hexadecimal digits."""
        return sha256(dumps(plain(self.values)))[:10]


@dataclass(frozen=True, slots=True)
class ResultStore:
    """The results of one table, in `FOLDER/TABLE.json`, a line each."""

    table: str
    folder: Path = RESULTS

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.folder / f"{self.table}.json"

    def get(self, key: Key, compute: Callable[[], Result]) -> Result:
        """The stored result of `key`, else that of `compute`, which is then stored."""
        found = self.find(key)
        return found if found is not None else self.put(key, compute())

    def find(self, key: Key) -> Result | None:
        """The stored result of these inputs, or None."""
        kept = self.all().get(key.name)
        return kept if kept is not None and kept.get("key") == plain(key.values) else None

    def put(self, key: Key, result: Result) -> Result:
        """Store a result under its name, replacing an older one, with its provenance."""
        document = {"name": key.name, "key": key.values, "made": made_here(), **result}
        kept = {**self.all(), key.name: plain(document)}
        lines = ",\n".join(f"{dumps(name)}: {dumps(each)}" for name, each in kept.items())
        write_atomic(self.path, f'{{"format": {dumps(FORMAT)}, "results": {{\n{lines}\n}}}}\n')
        return self.all()[key.name]

    def all(self) -> dict[str, dict[str, Any]]:
        """All results by name, outdated ones included."""
        with suppress(OSError, ValueError):
            document = json.loads(self.path.read_text(encoding="utf-8"))
            if isinstance(document, dict) and document.get("format") == FORMAT:
                return dict(document["results"])
        return {}


def made_here() -> dict[str, Any]:
    """Date, software, commit and machine."""
    return {"date": now(), "versions": versions(), "git": git_state(), "hardware": hardware()}


# ----------------------------------------------------------------------- tasks


def spec_path(benchmark: str) -> Path:
    """The specification of a benchmark: in `specs/`, else the installed one. Raises UsageError (U102)."""
    name = f"{benchmark}.stl"
    for path in (folder / part / name for folder in (Path("specs"), SPECS) for part in ("", "families")):
        if path.is_file():
            return path
    raise UsageError(Diagnostic("U102", f"there is no benchmark `{benchmark}`", help=BENCHMARKS))


def load(benchmark: str, overrides: tuple[tuple[str, str], ...] = ()) -> Task:
    """The task of a benchmark, compiled once for each set of overrides."""
    return _load(spec_path(benchmark).resolve(), spec_path(benchmark), overrides)


@cache
def _load(_where: Path, path: Path, overrides: tuple[tuple[str, str], ...]) -> Task:
    spec = parse(read_source(path))
    if spec.system is None:
        raise UsageError(Diagnostic("U101", f"`{path}` names no system"))
    changed = dict(overrides)
    system = System.load(find_system(spec.system, path), changed)
    return Task.of(spec, system, overrides=changed)


def inputs_of(task: Task) -> dict[str, str]:
    """Hashes of the specification with its imports, and of what a policy learns from in the system file."""
    spec, decl = task.compiled.spec, task.system.decl
    texts = [spec.source.text, *(f"{key}\n{text}" for key, text in sorted(library_of(spec).items()))]
    named = (f"{name} {sha256(path.read_bytes())}" for name, path in sorted(function_files(decl).items()))
    return {
        "spec_sha256": sha256("\0".join(texts)),
        "system_sha256": sha256("\0".join([decl.learnt, *named])),
    }
