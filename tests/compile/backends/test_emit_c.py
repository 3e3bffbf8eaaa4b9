"""The emitted C equals the array evaluators: numbers and conditions."""

from __future__ import annotations

import platform
import subprocess
from dataclasses import is_dataclass
from pathlib import Path

import numpy as np
import pytest
from helpers.emitted import OPERATIONS, STEPS, follower, kernel_of, values_agree
from helpers.formula_strategies import NAMES

from stlc import native
from stlc.compile.backends.c.emit import emit
from stlc.compile.backends.c.plan import Called, Frozen, Tabled
from stlc.compile.backends.c.printer import FORMS
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.ir import nodes as ir
from stlc.native import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


def test_every_function_equals_the_evaluator() -> None:
    columns = tuple(ir.Signal(name) for name in NAMES)
    nums = [ir.Op(name, columns[:arity]) for name, arity in OPERATIONS.items()]
    positive = ir.Op("abs", (columns[0],))
    nums += [ir.Op("sqrt", (positive,)), ir.Op("log", (positive,)), ir.Op("pow", (positive, columns[1]))]
    nums += [ir.Op(name, (ir.Op("sin", (columns[0],)),)) for name in ("asin", "acos")]
    cond = ir.BoolOp("or", (ir.Predicate(columns[0], strict=True), ir.Predicate(columns[1], sign=-1)))
    nums += [ir.Indicator(cond), ir.Where(cond, columns[2], ir.Const(0.1))]
    rules = [ir.Predicate(num) for num in nums] + [ir.Predicate(columns[0], guard=True)]
    rng = np.random.default_rng(1)
    trace = rng.normal(0, 2, (STEPS + 1, 200, 3))
    values_agree(rules, trace)


def test_the_remainder_is_exact_where_the_quotient_rounds_up() -> None:
    """1 / 0.1 rounds to 10, but the double 0.1 is in 1 nine times only."""
    rule = ir.Predicate(ir.Op("mod", (ir.Signal("x"), ir.Signal("y"))))
    pairs = [(1.0, 0.1), (9.0, -0.3), (-1.0, 0.1), (-9.0, -0.3), (0.6, 0.2), (3.0, 1.5), (0.0, -2.0)]
    row = np.array([(x, y, 0.0) for x, y in pairs])
    trace = np.broadcast_to(row, (STEPS + 1, *row.shape)).copy()
    values_agree([rule], trace)
    judged, _ = kernel_of(follower(), [rule]).judge(trace[0], trace[1:].transpose(1, 0, 2))
    assert judged[:, 0].tolist() == [x % y for x, y in pairs]


def test_every_node_is_printed() -> None:
    kinds = (each for each in vars(ir).values() if isinstance(each, type) and is_dataclass(each))
    formulas = {kind for kind in kinds if issubclass(kind, ir.Formula)}
    assert set(FORMS) == {*formulas, Called, Frozen, Tabled} - {ir.Freeze}


def test_what_has_no_c_form_is_said() -> None:
    late = [
        ir.Temporal("always", ir.Window(lo, hi), ir.Predicate(ir.Signal("x")))
        for lo, hi in ((0, 99), (20, None))
    ]
    before = ir.Shift(-1, ir.Predicate(ir.Signal("x")))
    for rule in (
        ir.Predicate(ir.Extern("f", (ir.Signal("x"),))),
        ir.Predicate(ir.ShiftedSignal("x", 15)),
        before,
        *late,
    ):
        with pytest.raises(Untranslatable):
            emit(follower(), [rule])


def test_nan_is_not_lost_in_minima_and_maxima(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))
    root, one = ir.Op("sqrt", (ir.Signal("x"),)), ir.Const(1.0)
    nums = [ir.Op("min", (one, root)), ir.Op("max", (one, root)), ir.Op("clip", (one, root, ir.Const(2.0)))]
    trace = np.random.default_rng(3).normal(0, 2, (STEPS + 1, 64, 3))
    for num in nums:
        values_agree([ir.Predicate(num)], trace)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="vector units are of these")
def test_loops_of_minima_and_maxima_vectorise(tmp_path: Path) -> None:
    version = subprocess.run([compiler() or "cc", "--version"], check=False, capture_output=True, text=True)
    if "Free Software Foundation" not in version.stdout:
        pytest.skip("the report of what was vectorised is that of GCC")
    x, y, z = (ir.Signal(name) for name in NAMES)
    deep = ir.Op("max", (ir.Op("min", (x, y)), ir.Op("min", (y, ir.Op("clip", (z, x, y))))))
    source = tmp_path / "kernel.c"
    source.write_text(emit(follower(), [ir.Predicate(deep)]))
    line = next(at for at, text in enumerate(source.read_text().splitlines(), 1) if "= LEAST(" in text)
    flags = (*native.FLAGS, "-O3", "-fopt-info-vec-optimized", "-o", str(tmp_path / "kernel.so"))
    command = [compiler() or "cc", *flags, str(source), "-lm"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert f"kernel.c:{line}:" in done.stderr
