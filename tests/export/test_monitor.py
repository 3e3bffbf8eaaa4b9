"""The monitor as C: warnings, what it says of random formulas, names that are not C."""

from __future__ import annotations

import os
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stlc.cli.framework.app import main
from stlc.compile.backends.c.streams import streams_of
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.diagnostics import UsageError
from stlc.export.monitor import _texts, export_monitor
from stlc.monitor.instants import At
from stlc.monitor.online.kernel import streamed_rule
from stlc.monitor.online.online import How, Online
from stlc.monitor.verdict import Monitor
from stlc.toolchain import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")

EXAMPLES = int(os.environ.get("STLC_CASES", "1"))
SPEC = """spec demo
signal x
signal y
require window: always[0, 10 s] (x > 0.1 -> eventually[0, 3 s] sin(y) > 0)
require lasting: always (x > -5 until[1 s, 4 s] y > 1)
require past: once[2 s, 9 s] x ^ 2 > 3 and historically norm([x, y]) < 9
"""
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-ffp-contract=off", "-O1")
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def built(folder: Path, *flags: str) -> Path:
    program = folder / "program"
    sources = [str(path) for path in sorted(folder.glob("*.c"))]
    subprocess.run(["cc", *STRICT, *flags, *sources, "-o", str(program), "-lm"], check=True)
    return program


def said(program: Path, rows: np.ndarray, names: tuple[str, ...]) -> list[tuple[float, float]]:
    lines = [",".join(names), *(",".join(f"{value:.17g}" for value in row) for row in rows)]
    done = subprocess.run(
        [program], input="\n".join(lines) + "\n", capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    words = [
        line.rsplit("robustness from ", 1)[1].split(",")[0].split(" to ") for line in done.stdout.splitlines()
    ]
    return [(float(low), float(high)) for low, high in words]


@pytest.mark.parametrize(
    ("language", "single", "at"),
    [
        (("-std=c99",), False, None),
        (("-x", "c++", "-std=c++17"), True, 3),
        pytest.param(("-std=c99",), True, None, marks=pytest.mark.apart),
        pytest.param(("-x", "c++", "-std=c++17"), False, None, marks=pytest.mark.apart),
    ],
)
def test_a_monitor_is_built_without_warnings_and_says_what_python_says(
    tmp_path: Path, language: tuple[str, ...], single: bool, at: At
) -> None:
    monitor = Monitor(SPEC, dt=1.0)
    assert export_monitor(monitor, tmp_path, at=at, single=single).files == (
        "demo_monitor.h",
        "demo_monitor.c",
        "main.c",
    )
    rows = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32).astype(float)
    online = monitor.online(How(at=at))
    online.push_block(rows)
    found = said(built(tmp_path, *language), rows, ("x", "y"))
    wanted = [(each.low, each.high) for each in online.finish().values()]
    np.testing.assert_allclose(found, wanted, rtol=1e-6 if single else 1e-12)


X, Y = (typed.Predicate(random_formulas.SPAN, ir.Signal(name), strict=False) for name in ("x", "y"))


@pytest.mark.apart
@settings(max_examples=EXAMPLES, deadline=None)
@example(
    [typed.Edge(random_formulas.SPAN, "rise", X), Y], {name: np.ones((2, 1)) for name in ("x", "y", "z")}
)
@given(
    written=st.lists(random_formulas.formulas(), min_size=1, max_size=12),
    trace=random_formulas.traces(1, 30, 1),
)
def test_random_formulas_under_sanitizers(written, trace) -> None:
    compiled = Monitor("spec s\nsignal x\nsignal y\nsignal z\nrequire r: x + y + z > 0\n", dt=0.1).compiled
    forms = [simplify(random_formulas.GRID.lower(each, [])) for each in written]
    rules = [replace(random_formulas.a_rule(form), name=f"r{i}") for i, form in enumerate(forms)]
    asked = Online(compiled, rules, How()).asked
    rules = [each.rule for each in asked if streamed_rule(each, ("x", "y", "z"))]
    if not rules:
        return
    online = Online(compiled, rules, How())
    names, rows = (
        online.signals,
        np.concatenate([trace[name] for name in online.signals] or [trace["x"]], axis=1),
    )
    program = streams_of(
        [rule for each in online.asked if (rule := streamed_rule(each, names))], names, cut=False
    )
    with tempfile.TemporaryDirectory() as folder:
        for name, text in _texts(online, program, single=False)[0].items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        found = said(built(Path(folder), "-std=c99", *SANITIZED), rows, names)
    online.push_block(rows[:, : len(names)])
    assert found == [(each.low, each.high) for each in online.finish().values()]


@pytest.mark.apart
def test_a_monitor_in_c_judges_at_every_sample(tmp_path: Path) -> None:
    text = "signal x\nsignal y\nrequire r: always[0, 3 s] (x > -1 or y > 0)\nrequire s: once[0, 2 s] x > 1"
    monitor, rows = Monitor(text, dt=1.0), np.random.default_rng(1).normal(size=(40, 2))
    export_monitor(monitor, tmp_path, at="all")
    online = monitor.online(How(at="all"))
    online.push_block(rows)
    tallies = online.finish().values()
    assert said(built(tmp_path, "-std=c99", *SANITIZED), rows, ("x", "y")) == [
        (each.low, each.high) for each in tallies
    ]
    assert [each.instants for each in tallies] == [37, 40]


def test_the_header_says_what_values_mean_and_when_requirements_are_known(tmp_path: Path) -> None:
    text = "spec demo\nenum Mode { off, fast = 7 }\nsignal x [m]\nsignal m : Mode\nassume begin: x > 0\n"
    text += "require a: x < 9 until[0, 2 s] m == fast\nrequire b: always x < 9\nrequire c: once[0, 1 s] x > 3"
    export_monitor(Monitor(text, dt=0.1), tmp_path)
    head = (tmp_path / "demo_monitor.h").read_text()
    assert "0  x: m\n     1  m: 0 off, 7 fast\n" in head
    assert "a: at sample 0, known after 20 samples more" in head
    assert "b: at sample 0, known at the end" in head
    assert "c: at sample 0, known after 0 samples more" in head
    assert "Not judged, as they are assumptions: begin\n   Time step: 0.1 s." in head


@pytest.mark.apart
@pytest.mark.parametrize(("cell", "code"), [(" 2 ", 0), ("", 0), ("nan", 0), ("fast", 2), ("2x", 2)])
def test_what_is_no_number_is_not_taken_as_unknown(tmp_path: Path, cell: str, code: int) -> None:
    export_monitor(Monitor("signal x\nsignal y\nrequire r: always (x < 9 and y < 9)", dt=1.0), tmp_path)
    table = f"x,y\n1,1\n\n{cell},1\n"
    done = subprocess.run([built(tmp_path)], input=table, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert done.stderr == ("" if code == 0 else f"x is not a number: {cell}\n")
    assert ("satisfied" in done.stdout) == (cell == " 2 ")


def test_a_specification_is_exported_without_a_run(tmp_path: Path) -> None:
    spec = tmp_path / "demo.stl"
    spec.write_text(SPEC)
    assert main(["export", str(spec), "--to", "c", "--dt", "1s", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "demo_monitor.c").is_file()
    assert main(["export", "latest", "--to", "c", "--float"]) == 2
    assert main(["export", str(spec), "--to", "c", "--dt", "1s", "--at", "soon"]) == 2


def test_numbers_beyond_the_range_of_float(tmp_path: Path) -> None:
    monitor = Monitor("signal x\nrequire r: always x < 1e300\nrequire s: always x * 1e-60 < 1", dt=1.0)
    export_monitor(monitor, tmp_path, single=True)
    assert said(built(tmp_path, "-std=c99"), np.array([[1e30], [2.5]]), ("x",)) == [(np.inf, np.inf), (1, 1)]


def test_what_has_no_transducers_is_refused(tmp_path: Path) -> None:
    monitor = Monitor("signal x\nrequire r: always (freeze a = x in eventually[0, 2 s] x > a)", dt=1.0)
    with pytest.raises(UsageError, match=r"U101.*`r` has no form as C"):
        export_monitor(monitor, tmp_path)
    assert not list(tmp_path.iterdir())
