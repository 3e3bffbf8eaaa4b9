"""Formulas of equal shape as loops over tables: the same numbers as written out, forwards and backwards."""

from __future__ import annotations

import resource
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.emitted import (
    STEPS,
    adjoint_of,
    follower,
    gathered,
    gradients_agree,
    kernel_of,
    planned,
    traces_of,
    values_agree,
)
from helpers.formula_strategies import NAMES, formulas

from stlc import native
from stlc.compile.backends.c import families as c_families
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import emit
from stlc.compile.backends.c.families import families
from stlc.compile.backends.c.plan import Tabled, plan_of
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.kernel import ObjectiveSlopes

X, Y, Z = (ir.Signal(name) for name in NAMES)
WHOLE = ir.Window(0, STEPS)

compiler = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many formulas in one text: the compiler is to spend little on it."""
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))


def box(*sides: float) -> ir.Num:
    """The signed distance to a box of the plane: west, east, south, north."""
    west, east, south, north = map(ir.Const, sides)
    room = [
        ir.Op("min", (ir.Op("sub", (point, low)), ir.Op("sub", (high, point))))
        for point, low, high in ((X, west, east), (Y, south, north))
    ]
    beyond = tuple(ir.Op("relu", (ir.Op("neg", (side,)),)) for side in room)
    inside = ir.Op("relu", (ir.Op("min", tuple(room)),))
    return ir.Op("sub", (inside, ir.Op("norm", beyond)))


def ball(x: float, y: float, radius: float) -> ir.Num:
    gap = ir.Op("norm", (ir.Op("sub", (X, ir.Const(x))), ir.Op("sub", (Y, ir.Const(y)))))
    return ir.Op("sub", (ir.Const(radius), gap))


def boxes(count: int, seed: int = 0) -> list[ir.Num]:
    drawn = np.random.default_rng(seed).uniform(0.1, 2.0, (count, 4)) * [-1, 1, -1, 1]
    return [box(*map(float, sides)) for sides in drawn]


def balls(count: int, seed: int = 1) -> list[ir.Num]:
    drawn = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 3))
    return [ball(float(x), float(y), abs(float(r))) for x, y, r in drawn]


def loops(rules: Sequence[ir.Formula]) -> list[int]:
    """Numbers of rows of the outermost tables of a plan."""
    steps = plan_of(rules, STEPS + 1).schedule.steps
    return [step.node.table.rows for step in steps if isinstance(step.node, Tabled)]


# ---------------------------------------------------------------------- what is found


def test_what_differs_is_a_table_and_the_rest_the_shape() -> None:
    both = [box(-1.0, 2.0, -float(i), 3.0) for i in range(1, 9)]
    found = families([ir.Predicate(num) for num in [*balls(3), *both]], 5)
    (family,) = found
    assert family.members == tuple(range(3, 11))
    assert family.table.constants == {"t5_0": tuple(-float(i) for i in range(1, 9))}
    assert family.table.columns == {}
    assert family.shape == ir.Predicate(_put(both[0], ir.Const(-1.0), ir.FrozenVar("\0t5_0"), after=X))


def _put(num: ir.Num, old: ir.Num, new: ir.Num, *, after: ir.Num) -> ir.Num:
    """The number with a constant replaced, but where it is subtracted from `after`."""
    if not isinstance(num, ir.Op) or num == ir.Op("sub", (after, old)):
        return num
    return ir.Op(num.name, tuple(new if arg == old else _put(arg, old, new, after=after) for arg in num.args))


def test_columns_are_data_too() -> None:
    atoms = [
        ir.Predicate(ir.Op("sub", (ir.Signal(NAMES[i % 3]), ir.ShiftedSignal(NAMES[i % 2], 2))))
        for i in range(9)
    ]
    (family,) = families(atoms, 1)
    assert list(family.table.columns.values()) == [tuple(NAMES[i % m] for i in range(9)) for m in (3, 2)]
    other = [ir.Predicate(ir.ShiftedSignal("x", i)) for i in range(9)]  # samples are the shape
    assert families(other, 1) == []


def test_exponents_and_calls_are_the_shape() -> None:
    powers = [ir.Predicate(ir.Op("pow", (X, ir.Const(float(i))))) for i in range(9)]
    calls = [ir.Predicate(ir.Extern("f", (ir.Const(float(i)),))) for i in range(9)]
    assert families([*powers, *calls], 1) == []


def test_few_are_written_out() -> None:
    few, many = (ir.BoolOp("or", tuple(ir.Predicate(num) for num in boxes(n))) for n in (7, 8))
    assert loops([few]) == []
    assert loops([many]) == [8]


def test_unions_dilated_ones_and_requirements_are_loops() -> None:
    union = ir.Op("max", tuple(boxes(20)))
    near = [
        ir.Op("add", (union, ir.Const(0.5))),
        ir.Op("sub", (ir.Const(0.5), union)),
        ir.Op("neg", (union,)),
    ]
    assert [loops([ir.Temporal("always", WHOLE, ir.Predicate(num))]) for num in (union, *near)] == [[20]] * 4
    assert loops([ir.Temporal("always", WHOLE, ir.Predicate(num, sign=-1)) for num in boxes(12)]) == [12]
    mixed = ir.BoolOp(
        "or", tuple(ir.Predicate(num) for pair in zip(boxes(9), balls(9), strict=True) for num in pair)
    )
    assert loops([mixed]) == [9, 9]


def test_texts_hardly_grow_with_the_number_of_regions() -> None:
    few, many = (_union(count) for count in (10, 100))
    row = 120  # characters of six constants
    assert len(emit(follower(), many)) - len(emit(follower(), few)) < 90 * row
    assert len(emit_adjoint(follower(), many)) - len(emit_adjoint(follower(), few)) < 2 * 90 * row


def _union(count: int) -> list[ir.Formula]:
    return [ir.Temporal("eventually", WHOLE, ir.Predicate(ir.Op("max", tuple(boxes(count)))))]


# ---------------------------------------------------------------------- the same numbers


@compiler
@pytest.mark.usefixtures("quickly")
def test_regions_equal_the_evaluator() -> None:
    many = [*boxes(20), *balls(20)]
    reach = [
        ir.Temporal("eventually", WHOLE, ir.Temporal("always", ir.Window(0, 0), ir.Predicate(num)))
        for num in many
    ]
    staying = [
        ir.Temporal("eventually", ir.Window(0, 9), ir.Temporal("always", ir.Window(0, 4), ir.Predicate(b)))
        for b in many
    ]
    union = ir.Op("max", tuple(many))
    rules = [
        ir.Temporal("always", WHOLE, ir.Predicate(union, sign=-1)),
        ir.Temporal("eventually", WHOLE, ir.Predicate(ir.Op("sub", (union, ir.Const(0.3))))),
        ir.BoolOp("or", tuple(reach)),
        ir.BoolOp("or", tuple(staying)),
        *(
            ir.Temporal("always", ir.Window(i, STEPS), ir.Predicate(num, sign=-1))
            for i in (0, 3)
            for num in many
        ),
        ir.Freeze((("f", X),), ir.BoolOp("and", tuple(_from("f", num) for num in boxes(9)))),
    ]
    values_agree(rules, traces_of(1, 40))
    gradients_agree(rules, traces_of(2, 40), 3)


def _from(held: str, num: ir.Num) -> ir.Formula:
    """A region seen from where a value was frozen."""
    return ir.Temporal("always", ir.Window(0, 3), ir.Predicate(ir.Op("add", (num, ir.FrozenVar(held)))))


def _varied(formula: ir.Formula, count: int, seed: int) -> list[ir.Formula]:
    """Formulas of the same shape with other constants and columns."""
    rng = np.random.default_rng(seed)

    def other(leaf: c_families.Entry) -> ir.Num:
        if isinstance(leaf, ir.Const):
            return ir.Const(leaf.value + float(rng.integers(0, 3)) / 8)
        name = leaf.name if rng.random() < 0.7 else str(rng.choice(NAMES))
        return (
            ir.ShiftedSignal(name, leaf.steps, leaf.clamped)
            if isinstance(leaf, ir.ShiftedSignal)
            else ir.Signal(name)
        )

    return [formula, *(c_families._changed(formula, other) for _ in range(count - 1))]


def _families_of(count: int, seed: int) -> list[ir.Formula]:
    drawn = [node for node in map(planned, gathered(formulas(), count, first=seed)) if node is not None]
    several = [_varied(node, 2 + i % 3, seed + i) for i, node in enumerate(drawn)]
    joined = [ir.BoolOp("and" if i % 2 else "or", tuple(some)) for i, some in enumerate(several)]
    return [*joined, *(member for some in several[::4] for member in some)]


def _both(rules: list[ir.Formula], seed: int, patched: pytest.MonkeyPatch) -> None:
    """Loops and what is written out: the same bits, and the same gradient up to the order of sums."""
    trace = traces_of(seed, 40)
    x0, u = trace[0].copy(), trace[1:].transpose(1, 0, 2).copy()
    weights = np.random.default_rng(seed).uniform(0.5, 1.5, (40, len(rules)))
    found = []
    for least in (2, 10**9):
        patched.setattr(c_families, "LEAST", least)
        assert bool(loops(rules)) == (least == 2)
        rho, _ = kernel_of(follower(), rules).judge(x0, u)
        found.append(
            (rho + 0.0, adjoint_of(follower(), rules).pull(x0, u, ObjectiveSlopes(weights, None, 5.0)))
        )
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-9, atol=1e-9)


@compiler
@pytest.mark.usefixtures("quickly")
def test_random_families_are_the_same_written_out(monkeypatch: pytest.MonkeyPatch) -> None:
    _both(_families_of(24, 1), 1, monkeypatch)


@compiler
@pytest.mark.slow
@pytest.mark.usefixtures("quickly")
@pytest.mark.parametrize("seed", range(2, 32))
def test_many_random_families_are_the_same_written_out(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    _both(_families_of(60, seed), seed, monkeypatch)


FORMS = {
    "100 boxes to reach": _union(100),
    "100 circles to avoid": [
        ir.Temporal("always", WHOLE, ir.Predicate(ir.Op("max", tuple(balls(100))), sign=-1))
    ],
    "50 boxes, 50 circles": [
        ir.BoolOp(
            "or",
            tuple(ir.Temporal("eventually", WHOLE, ir.Predicate(num)) for num in [*boxes(50), *balls(50)]),
        )
    ],
    "100 requirements": [ir.Temporal("always", WHOLE, ir.Predicate(num, sign=-1)) for num in boxes(100)],
}


@compiler
@pytest.mark.bench
@pytest.mark.parametrize("form", FORMS)
def test_compilers_take_seconds_for_a_hundred_regions(form: str, tmp_path: Path) -> None:
    motion, rules = follower(), FORMS[form]
    for text in (emit(motion, rules), emit_adjoint(motion, rules)):
        source = tmp_path / "kernel.c"
        source.write_text(text)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        native._compile(str(native.compiler()), source, tmp_path / "kernel.so", form)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        sys.stdout.write(f"{form}: {len(text) / 1000:.0f} kB, {took:.2f} s of the processor\n")
        assert took < 5.0
