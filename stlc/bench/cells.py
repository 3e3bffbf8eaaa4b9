"""One cell of a table: a benchmark trained once, and the file that says everything about it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from stlc.compile.frontend.modules import library_of
from stlc.controller.problem.task import Task
from stlc.controller.training.config import (
    ENGINE_VERSION,
    HELD_OUT,
    HELD_OUT_SEED,
    ResolvedConfig,
    TrainConfig,
    resolve_config,
)
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.model.system import System
from stlc.dynamics.robots.functions import function_files
from stlc.files import SPECS, find_system, read_source
from stlc.grammar.parse.parser import parse
from stlc.jsontext import dumps, plain
from stlc.provenance import sha256

if TYPE_CHECKING:
    from stlc.controller.training.config import Clock

Study: TypeAlias = Literal["paper", "ablation", "family"]

FORMAT = "bench-cell/1"
BENCHMARKS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
"""The paper's, in its order; each is a specification of that name."""


@dataclass(frozen=True, slots=True)
class Length:
    """How long is trained: a budget in seconds of a clock, or a number of steps."""

    seconds: float | None = None
    steps: int | None = None
    clock: Clock = "wall"

    @property
    def name(self) -> str:
        """Such as `60s` or `200steps`."""
        return f"{self.steps}steps" if self.steps is not None else f"{self.seconds:g}s"

    @property
    def text(self) -> str:
        """The same for people."""
        if self.steps is not None:
            return f"{self.steps:,} steps"
        return f"{self.seconds:g} s" + (" of processor time" if self.clock == "processor" else "")

    @property
    def options(self) -> tuple[str, ...]:
        """For `stlc train`."""
        if self.steps is not None:
            return ("--steps", str(self.steps))
        return ("--budget", f"{self.seconds:g}s", "--clock", self.clock)


def length_of(document: Mapping[str, Any]) -> Length:
    """How long the result `document` was trained."""
    return Length(document["budget"], document["steps_asked"], document["engine"].get("clock", "wall"))


@dataclass(frozen=True, slots=True)
class Cell:
    """A benchmark trained once.

    Attributes:
        benchmark: name of the specification.
        method: of training.
        seed: of training.
        length: of training.
        held_out: states of the verdict.
        axis: what an ablation varies here; "" outside of ablations.
        value: what it is set to.
        overrides: of the system file.
    """

    benchmark: str
    method: str
    seed: int
    length: Length
    held_out: int = HELD_OUT
    axis: str = ""
    value: str = ""
    overrides: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of its file, such as `traffic-guided-60s-seed0`."""
        first = ("ablation", self.axis, self.value) if self.axis else (self.benchmark, self.method)
        return "-".join([*filter(None, first), self.length.name, f"seed{self.seed}"])

    @property
    def study(self) -> Study:
        """The table that it stands in."""
        if self.axis:
            return "ablation"
        return "paper" if self.benchmark in BENCHMARKS else "family"

    def config(self) -> TrainConfig:
        """What `stlc train` is told."""
        return TrainConfig(
            method=self.method,
            budget=self.length.seconds,
            steps=self.length.steps,
            seed=self.seed,
            held_out=self.held_out,
            clock=self.length.clock,
            drives=0,
        )


@dataclass(frozen=True, slots=True)
class Inputs:
    """What the result of a cell depends on, as plain data; a result of other inputs is taken anew."""

    cell: Cell
    values: Mapping[str, Any]

    @property
    def key(self) -> str:
        """All of them in a few digits."""
        return sha256(dumps(self.values))[:10]

    def made(self, document: Mapping[str, Any]) -> bool:
        """Whether the result `document` came of these inputs.

        A number that engines did not have when it was made stood at what is its default now.
        """
        known = {
            field.name: field.default for field in fields(ResolvedConfig) if field.default is not MISSING
        }
        engine = document.get("engine")
        then = {**document, "engine": {**known, **engine} if isinstance(engine, dict) else None}
        return all(then.get(key) == value for key, value in self.values.items())


def inputs_of(cell: Cell) -> Inputs:
    """Read the specification and the system of a cell, and decide what the engine will do.

    Raises:
        UsageError: there is no such benchmark.
        SpecError, SystemFileError: a file is invalid.
    """
    task = load(cell.benchmark, tuple(cell.overrides.items()))
    engine = plain(asdict(resolve_config(task, cell.config())))
    spec = task.compiled.spec
    texts = [spec.source.text, *(f"{key}\n{text}" for key, text in sorted(library_of(spec).items()))]
    return Inputs(
        cell,
        {
            "spec_sha256": sha256("\0".join(texts)),
            "system_sha256": _system_hash(task),
            "overrides": dict(cell.overrides),
            "engine_version": ENGINE_VERSION,
            "engine": engine,
            "held_out": cell.held_out,
            "held_out_seed": HELD_OUT_SEED,
            "seed": cell.seed,
            "budget": cell.length.seconds,
            "steps_asked": cell.length.steps,
        },
    )


def _system_hash(task: Task) -> str:
    """Of what a policy learns from in the system file, and of the files that it names."""
    decl = task.system.decl
    named = (f"{name} {sha256(path.read_bytes())}" for name, path in sorted(function_files(decl).items()))
    return sha256("\0".join([decl.learnt, *named]))


def spec_path(benchmark: str) -> Path:
    """The specification of a benchmark: in `specs/`, else the installed one. Raises UsageError (U102)."""
    name = f"{benchmark}.stl"
    places = [Path("specs"), SPECS]
    for path in (folder / part / name for folder in places for part in ("", "families")):
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


def read_cells(folder: Path) -> list[dict[str, Any]]:
    """The results of all cells in a folder, by name; files that are none are passed over."""
    found = (read_json(path) for path in sorted(folder.glob("*.json")))
    return [document for document in found if document.get("format") == FORMAT]


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; empty where there is none."""
    with suppress(OSError, ValueError):
        document = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(document, dict):
            return document
    return {}


def pack(flags: Sequence[bool]) -> str:
    """Truth values as hexadecimal digits, the first one in the highest place."""
    bits = "".join("1" if flag else "0" for flag in flags)
    return f"{int(bits or '0', 2):0{-(-len(flags) // 4)}x}"


def unpack(digits: str, count: int) -> list[bool]:
    """The `count` truth values that `pack` wrote."""
    return [bit == "1" for bit in f"{int(digits or '0', 16):0{count}b}"]


def union(sets: Iterable[Sequence[bool]], count: int) -> list[bool]:
    """Where any of the sets of `count` truth values holds."""
    found = [False] * count
    for flags in sets:
        found = [one or other for one, other in zip(found, flags, strict=True)]
    return found
