"""Mistakes that pass in silence: the literal reading, RTAMT's, and a case of each kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.answers import Answer, Remark, ask, noticed, rtamt_notices
from benchmarks.correct import hard, ordinary
from benchmarks.mistakes import KINDS, Kind, Read
from benchmarks.requirements import Atom, Flag, Formula, Joined, Over, Until, for_rtamt, robustness, written
from benchmarks.scenes import SHAPES, situations
from benchmarks.tables.silent import mistaken
from stlc.monitor.verdict import Monitor

pytestmark = pytest.mark.apart

DT = 0.5
HEAD = "signal x, y\nsignal go : bool\n"
WINDOW = st.one_of(
    st.none(), st.tuples(st.integers(0, 3), st.integers(0, 3)).map(lambda w: (DT * min(w), DT * max(w)))
)
LEAF: st.SearchStrategy[Formula] = st.one_of(
    st.builds(
        lambda name, op, value: Atom(name, op, float(value), str(value)),
        st.sampled_from("xy"),
        st.sampled_from(("<", "<=", ">", ">=")),
        st.integers(-3, 3),
    ),
    st.just(Flag("go")),
)
FORMULA = st.recursive(
    LEAF,
    lambda part: st.one_of(
        st.builds(Joined, st.sampled_from(("and", "or", "->")), part, part),
        st.builds(Over, st.sampled_from(("always", "eventually", "historically", "once")), WINDOW, part),
        st.builds(Until, part, part),
    ),
    max_leaves=5,
)
ROWS = st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.booleans()), min_size=2, max_size=9)


@given(FORMULA, ROWS)
def test_the_literal_value_is_the_monitor_s(formula, rows):
    data = {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(("x", "y", "go"))}
    monitor = Monitor(f"{HEAD}require r: {written(formula)}", dt=DT)
    found = monitor.robustness(data, end="truncate")
    assert robustness(formula, data, DT) == pytest.approx(np.asarray(found))


@settings(max_examples=12)
@given(FORMULA, ROWS)
def test_rtamt_takes_the_same_formula(formula, rows):
    data = {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(("x", "y", "go"))}
    value = robustness(formula, data, DT)[0]
    if "until" not in for_rtamt(formula) and np.isfinite(value) and value != 0:
        assert rtamt_notices(Read(formula, data, DT)) == (value < 0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_case_is_violated_as_meant_and_satisfied_as_read(kind: Kind):
    (case,) = mistaken(kind, 1, seed=5)
    assert robustness(case.read.formula, case.read.data, case.read.dt)[0] >= 0
    assert case.files != case.right
    assert case.place


def test_situations_hold_and_do_not():
    for shape in SHAPES:
        one = next(situations(np.random.default_rng(1), shape))
        assert (
            robustness(one.meant, one.good, one.plant.dt)[0]
            > 0
            > robustness(one.meant, one.bad, one.plant.dt)[0]
        )


def test_what_counts_as_noticed():
    near = frozenset({"low"})
    quiet = Answer("satisfied", frozenset())
    told = Answer("satisfied", frozenset({Remark("W1", "read once", "fact", near)}))
    elsewhere = Answer("satisfied", frozenset({Remark("W1", "read once", "fact", frozenset({"high"}))}))
    assert noticed(told, quiet, near)
    assert noticed(replace(quiet, verdict="violated"), quiet, near)
    assert not noticed(quiet, quiet, near)
    assert not noticed(told, told, near), "a remark that correct files get, too"
    assert not noticed(elsewhere, quiet, near)


BY_LINT = (
    *("`always` forgotten", "past operator at top level", "requirement commented out", "degrees for radians"),
    *("name used twice", "nothing required", "parentheses forgotten", "`or` for `and`"),
)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.name in BY_LINT], ids=lambda kind: kind.name)
def test_lint_notices_a_mistake_in_the_text(kind: Kind, tmp_path):
    (case,) = mistaken(kind, 1, seed=0)
    assert noticed(ask(case.files, tmp_path), ask(case.right, tmp_path), case.place)


def test_correct_files_get_no_warning(tmp_path):
    rng = np.random.default_rng(0)
    for files in (*ordinary(rng, 6), *hard(rng, 12)):
        assert [remark.code for remark in ask(files, tmp_path).warnings] == []


BY_FACTS = (
    *("clock in ms, µs or ns", "column starts late", "column ends early", "spike dropped by `--resample`"),
    *("run of NaN over the violation", "wrong `--map`", "column twice", "sensor stuck", "row of units"),
    *(
        "recording of a few samples",
        "signal never updated",
        "left side never holds",
        "window beyond the recording",
    ),
    *("constant far out of range", "two objects in one table", "runs strung together"),
)


@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind.name in BY_FACTS], ids=lambda kind: kind.name
)
def test_check_notices_a_mistake_in_the_recording(kind: Kind, tmp_path):
    pytest.importorskip("stlc.monitor.facts")
    (case,) = mistaken(kind, 1, seed=0)
    assert noticed(ask(case.files, tmp_path), ask(case.right, tmp_path), case.place)
