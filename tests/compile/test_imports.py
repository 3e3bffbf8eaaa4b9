"""`import`: names, units, spans and texts of other files; the library of patterns."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers import reference
from helpers.formula_strategies import GRID, traces
from hypothesis import given, settings

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.frontend.resolve import resolve
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import Diagnostic, SpecError, StlcError
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.spec import Spec, file_of
from stlc.monitor.explain.report import explain
from stlc.monitor.verdict import Monitor
from stlc.source import Source
from stlc.trace import Trace, TraceMeta

GEO = """
const margin [m] = 50 cm
enum Sign { stop = 0, go = 1 }
signal x [m] in [-10, 10]
region pond = circle([1, 1], 2)
def clear(p) = p not in pond
def near(limit) = abs(x) < limit + margin
require not_taken: x > 0 m
"""
MAIN = """
import "../shapes/geo.stl" as geo
import std
signal x, y [m]
def p = [x, y]
def near = 3 m
require a: always[0, T] geo.clear(p)
require b: geo.near(near) and p in geo.pond
"""


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "specs").mkdir()
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes/geo.stl").write_text(GEO, encoding="utf-8")
    (tmp_path / "specs/main.stl").write_text(MAIN, encoding="utf-8")
    return tmp_path / "specs/main.stl"


def typed_of(path: Path) -> typed.Spec:
    return resolve(Spec.parse(File(path).read()), sink=[])


def findings(path: Path) -> list[Diagnostic]:
    with pytest.raises(StlcError) as caught:
        typed_of(path)
    return list(caught.value.diagnostics)


def inlined() -> typed.Spec:
    text = GEO.replace("require not_taken: x > 0 m", "signal y [m]") + (
        "def p = [x, y]\nrequire a: always[0, T] clear(p)\nrequire b: near(3 m) and p in pond\n"
    )
    return resolve(Spec.parse(Source("one.stl", text)), sink=[])


def test_an_import_means_what_writing_it_out_means(files: Path) -> None:
    found, wanted = typed_of(files), inlined()
    assert [r.formula for r in found.requirements] == [r.formula for r in wanted.requirements]
    assert [r.name for r in found.requirements] == ["a", "b"]
    assert set(found.signature.names) == {"x", "y"}


def test_places_are_those_of_the_right_file(files: Path) -> None:
    files.write_text(MAIN + "require c: geo.near(2 s)\n", encoding="utf-8")
    (finding,) = findings(files)
    assert finding.code == "E203"
    assert finding.span is not None
    assert finding.span.source.name.endswith("shapes/geo.stl")
    assert finding.labels[-1].span.source.name.endswith("main.stl")
    (files.parent.parent / "shapes/geo.stl").write_text(GEO + "def broken = x + ", encoding="utf-8")
    assert findings(files)[0].span.source.name.endswith("geo.stl")  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('import "nowhere.stl" as n', "E106"),
        ('import "main.stl" as me', "E106"),
        ("import math", "E106"),
        ('import "../shapes/my-geo.stl"', "E106"),
        ('import "../shapes/geo.stl" as a\nimport std as a', "E102"),
        ("require a: geo.clear([1, 2])", "E101"),
        ("import std\nrequire a: std.respons(true, true, 1 s)", "E101"),
        ("import std\nrequire a: std.response(true)", "E105"),
        ('import "../shapes/geo.stl"\nsignal x [s]\nrequire a: geo.near(1)', "E104"),
    ],
)
def test_what_goes_wrong(files: Path, text: str, code: str) -> None:
    files.write_text(text + "\n", encoding="utf-8")
    assert code in [finding.code for finding in findings(files)]


def test_a_longer_way_back_is_found_too(files: Path) -> None:
    (files.parent / "b.stl").write_text('import "c.stl"\n', encoding="utf-8")
    (files.parent / "c.stl").write_text('import "b.stl"\n', encoding="utf-8")
    files.write_text('import "b.stl"\n', encoding="utf-8")
    (finding,) = findings(files)
    assert finding.code == "E106"
    assert finding.note == ("b.stl -> c.stl -> b.stl",)
    assert finding.span is not None
    assert finding.span.source.name.endswith("c.stl")


def test_files_import_files_and_each_has_its_own_names(files: Path) -> None:
    (files.parent / "b.stl").write_text(
        'import "../shapes/geo.stl" as g\nconst margin [m] = 9\ndef far = not g.near(margin)\n',
        encoding="utf-8",
    )
    files.write_text('import "b.stl"\nrequire r: b.far and b.g.near(1 m)\n', encoding="utf-8")
    (rule,) = typed_of(files).requirements
    lowered = Grid().lower(rule.formula, [])
    signal = robustness_signal(lowered, {"x": np.array([[9.75]])}, ops=NUMPY)
    assert signal[0, 0] == pytest.approx(min(9.75 - 9.5, 1.5 - 9.75))


def test_texts_that_are_kept_stand_for_the_files(files: Path) -> None:
    spec = Spec.parse(File(files).read())
    library = spec.imported_texts()
    assert set(library) == {"../shapes/geo.stl", "@std"}
    assert len({file_of(key) for key in library}) == 2
    assert all(".." not in file_of(key) for key in library)
    moved = replace(Spec.parse(Source("elsewhere/spec.stl", MAIN)), library=library)
    assert [r.formula for r in resolve(moved, sink=[]).requirements] == [
        r.formula for r in typed_of(files).requirements
    ]
    other, alone = replace(moved, library={**library, "@std": ""}), Spec.parse(Source("s.stl", ""))
    assert spec.sha256 == moved.sha256 != other.sha256 != alone.sha256


def test_a_trace_carries_what_its_specification_imports(files: Path, tmp_path: Path) -> None:
    spec = Spec.parse(File(files).read())
    compiled = compile_spec(spec, grid=Grid(Fraction(1, 10), 5))
    meta = TraceMeta(spec_name="main", spec_text=MAIN, spec_library=spec.imported_texts(), horizon=5, dt=0.1)
    data = {"x": np.full((1, 6), 0.5), "y": np.full((1, 6), 9.0)}
    Trace(signature=compiled.signature, dt=0.1, data=data, meta=meta).save(tmp_path / "t.npz")
    files.unlink()
    (tmp_path / "shapes/geo.stl").unlink()
    trace = Trace.load(tmp_path / "t.npz")
    assert trace.meta.spec_library == meta.spec_library
    judge = Monitor(replace(Spec.parse(Source("t", trace.meta.spec_text)), library=trace.meta.spec_library))
    verdict = judge.check(trace)
    assert verdict["a"].overall == "satisfied"
    assert verdict["b"].overall == "violated"
    cause = explain(verdict, "b")
    assert cause is not None
    assert "pond" in cause.because or cause.predicate


# ------------------------------------------------------------------------- the library

PATTERNS = {
    "response": ("std.response(x > 0, y > 0, 3 steps)", "x > 0 -> eventually[0, 3 steps] y > 0"),
    "stays": ("std.stays(x > 0, 2 steps)", "rise(x > 0) -> always[0, 2 steps] x > 0"),
    "debounced": ("std.debounced(x > 0, 2 steps)", "historically[0, 2 steps] x > 0"),
    "settles": (
        "std.settles(x, 1, 0.5, 4 steps)",
        "eventually[0, 4 steps] always[0, end] abs(x - 1) <= 0.5",
    ),
}


def pattern(text: str) -> typed.Formula:
    return (
        resolve(Spec.parse(Source("s.stl", f"import std\nsignal x, y\nrequire r: {text}")), sink=[])
        .requirements[0]
        .formula
    )


@pytest.mark.parametrize(("short", "long"), PATTERNS.values(), ids=PATTERNS)
def test_patterns_are_what_they_say(short: str, long: str) -> None:
    assert pattern(short) == pattern(long)


@pytest.mark.parametrize("text", [short for short, _ in PATTERNS.values()], ids=PATTERNS)
@settings(max_examples=15)
@given(env=traces(low=2, batch=1))
def test_patterns_by_the_definition(text: str, env: dict[str, np.ndarray]) -> None:
    formula = pattern(text)
    signal = robustness_signal(GRID.lower(formula, []), env, ops=NUMPY, end="truncate")[:, 0]
    judge = reference.Robustness(
        reference.Trace({name: x[:, 0] for name, x in env.items()}, GRID, "truncate")
    )
    for t, value in enumerate(signal):
        assert judge.at(formula, t) == (pytest.approx(value), pytest.approx(value))


def test_a_bare_time_takes_the_unit_of_the_file_that_calls() -> None:
    text = "time ms\nimport std\nsignal x\nrequire r: std.response(x > 0, x > 1, 200)"
    (rule,) = resolve(Spec.parse(Source("s.stl", text)), sink=[]).requirements
    later = next(node for node in rule.formula.items if isinstance(node, typed.Temporal))  # type: ignore[union-attr]
    assert later.interval.hi is not None
    assert later.interval.hi.seconds == Fraction(1, 5)


def test_the_library_documents_every_pattern() -> None:
    (module,) = Spec.parse(Source("s.stl", "import std\n")).modules()
    spec = module.spec
    assert all(isinstance(item, ast.Def) and item.doc for item in spec.items)
    assert {item.name for item in spec.items} == set(PATTERNS)
    with pytest.raises(SpecError):
        resolve(Spec.parse(Source("s.stl", "import std\nrequire r: std.nothing")), sink=[])


def test_files_that_import_each_other_twice_do_not_multiply(tmp_path: Path) -> None:
    for i in range(40):
        below = f'import "m{i + 1}.stl" as a\nimport "m{i + 1}.stl" as b\n' if i < 39 else "signal x\n"
        (tmp_path / f"m{i}.stl").write_text(below + f"def d = {'a.d' if i < 39 else 'x > 0'}\n")
    (finding,) = findings(tmp_path / "m0.stl")
    assert (finding.code, finding.message) == ("E106", "more than 100 files are imported")
    (tmp_path / "few.stl").write_text('import "m35.stl" as m\nrequire r: m.d\n')
    assert len(typed_of(tmp_path / "few.stl").requirements) == 1


def test_files_that_all_import_each_other(tmp_path: Path) -> None:
    for i in range(12):
        lines = [f'import "m{j}.stl" as a{j}' for j in range(12)]
        (tmp_path / f"m{i}.stl").write_text("\n".join([*lines, "require r: true\n"]))
    found = findings(tmp_path / "m0.stl")
    assert {finding.code for finding in found} == {"E106"}
    assert len(found) == 78, "one for every import that closes a circle"
