"""Explanations are true, minimal in what they pick, and read as golden texts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import reference
from helpers.formula_strategies import GRID, formulas, traces
from hypothesis import HealthCheck, assume, given, settings

from stlc.cli.framework.render import render_place
from stlc.compile.backends.array.graph import evaluate_parts
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import typed
from stlc.diagnostics import UsageError
from stlc.monitor.explain.causes import CauseFinder, CauseNode
from stlc.monitor.explain.report import explain, names_in, shown, violations
from stlc.monitor.explain.tree import explanation
from stlc.monitor.online.online import How
from stlc.monitor.values import Record
from stlc.monitor.verdict import Monitor
from stlc.signature import Column
from stlc.units import Unit

GOLDEN = Path(__file__).parents[1] / "golden" / "check"


def nodes(blame: CauseNode) -> Iterator[CauseNode]:
    yield blame
    for part in blame.parts:
        yield from nodes(part)


ENDS = {"open": "upper", "truncate": "truncate"}
"""End of a trace -> that of a finder of causes."""


@pytest.mark.parametrize("end", ENDS)
@settings(max_examples=15)
@given(formula=formulas(), env=traces(low=3, batch=1))
def test_every_node_is_what_it_is_said_to_be(
    end: str, formula: typed.Formula, env: dict[str, np.ndarray]
) -> None:
    trace = reference.Trace({name: column[:, 0] for name, column in env.items()}, GRID, end)
    judge = reference.Robustness(trace)
    value = judge.at(formula, 0)
    assert value is not None
    assume(value[1] < 0)
    tree = CauseFinder(Record(env, NUMPY), GRID, ENDS[end]).blame(formula, 0)
    assert -abs(tree.rho) == pytest.approx(value[1])
    for node in nodes(tree):
        for sample in node.during or (node.sample,):
            found = judge.at(node.formula, sample, not node.holds)
            assert found is not None
            assert (found[0] > 0) if node.holds else (found[1] < 0), node
        assert not node.reads or 0 <= node.sample < trace.samples
        assert all(name in env for name, _ in node.reads)


@pytest.mark.parametrize("end", ENDS)
@settings(max_examples=18, suppress_health_check=[HealthCheck.filter_too_much])
@given(formula=formulas(), env=traces(low=3, batch=1))
def test_the_cause_is_the_value_behind_the_number(
    end: str, formula: typed.Formula, env: dict[str, np.ndarray]
) -> None:
    """The path of minima and maxima ends at it; where it decides alone, changing it changes the number."""

    def worth(signals: dict[str, np.ndarray]) -> float:
        trace = reference.Trace({name: column[:, 0] for name, column in signals.items()}, GRID, end)
        value = reference.Robustness(trace).at(formula, 0)
        assert value is not None
        return value[1]

    value = worth(env)
    assume(-np.inf < value < 0)
    tree, alone = CauseFinder(Record(env, NUMPY), GRID, ENDS[end]).why(formula, 0)
    assert (tree.leaf.rho if not tree.leaf.holds else -tree.leaf.rho) == pytest.approx(value)
    if not alone:
        return
    found = []
    for name, later in tree.leaf.reads:
        for change in (1e-4, -1e-4, 0.6, -0.6, 1.2, -1.2, 3.0, -3.0):
            if 0 <= (there := tree.leaf.sample + later) < len(env[name]):
                changed = env | {name: env[name].copy()}
                changed[name][there] += change
                found.append(worth(changed))
    assert max(found) > value


@settings(max_examples=18)
@given(formula=formulas(bounded_only=True), env=traces(low=3, batch=1))
def test_an_operator_that_never_succeeds_is_explained_by_its_best(
    formula: typed.Formula, env: dict[str, np.ndarray]
) -> None:
    trace = reference.Trace({name: column[:, 0] for name, column in env.items()}, GRID, "open")
    judge = reference.Robustness(trace)
    value = judge.at(formula, 0)
    assert value is not None
    assume(value[1] < 0)
    tree = CauseFinder(Record(env, NUMPY), GRID).blame(formula, 0)
    for node in nodes(tree):
        match node:
            case CauseNode(parts=(CauseNode(during=range()) as best,)):
                wanted = not best.holds
                ends = [judge.at(best.formula, k, wanted) for k in best.during or ()]
                margins = [end[1] if wanted else -end[0] for end in ends if end is not None]
                assert -abs(best.rho) == pytest.approx(max(margins))


# --------------------------------------------------------------------------- texts

HEAD = """\
spec demo
enum Light { red = 0, green = 1 }
signal x [m]
signal v [m/s]
signal light : Light
signal ready : bool
def near(limit) = x > -limit
def fast = v > 3
def reckless = near(2 m) and fast
def calm = not fast
def soon = eventually[0 s, 2 s] ready
"""

CASES = {
    "always": ("always[0 s, 3 s] v < 4", {"v": [1, 2, 6, 5]}),
    "eventually": ("eventually[0 s, 3 s] v > 4", {"v": [1, 3.5, 2, 1]}),
    "premise": (
        "light == red and ready -> always[0 s, 2 s] x < 0",
        {"light": [0] * 3, "ready": [1] * 3, "x": [-2, 1, 0.5]},
    ),
    "definitions": ("always[0 s, 2 s] not reckless", {"x": [-3, -1, 0], "v": [5, 4, 2]}),
    "until": ("v < 4 until[0 s, 3 s] ready", {"v": [1, 5, 1, 1], "ready": [0, 0, 0, 1]}),
    "until_never": ("v < 4 until[0 s, 2 s] ready", {"v": [1, 1, 1], "ready": [0, 0, 0]}),
    "release": ("ready release[0 s, 2 s] v < 4", {"v": [1, 5, 1], "ready": [0, 0, 1]}),
    "or": (
        "always[0 s, 1 s] (v < 4 or x > 2 or light == green)",
        {"v": [1, 9], "x": [0, 1], "light": [1, 0]},
    ),
    "equivalence": ("always[0 s, 1 s] (ready <-> light == green)", {"ready": [1, 1], "light": [1, 0]}),
    "rise": ("eventually[0 s, 2 s] rise(ready)", {"ready": [1, 1, 1]}),
    "past": ("always[0 s, 2 s] (fast -> once[0 s, 1 s] ready)", {"v": [1, 1, 5], "ready": [1, 0, 0]}),
    "two_signals": ("always[0 s, 1 s] x + v * 1 s < 3", {"x": [1, 2], "v": [1, 1.5]}),
    "chain": ("always[0 s, 1 s] 0 <= v < 4", {"v": [1, -1]}),
    "every_line": ("light == green ->\n    always[0 s, 1 s]\n        v < 4", {"light": [1, 1], "v": [1, 8]}),
    "not_in": ("always[0 s, 1 s] [x, 1 m] not in box([0, 0], [2, 2])", {"x": [9, 1]}),
    "not_in_range": ("always[0 s, 1 s] x not in [0 m, 2 m]", {"x": [9, 1]}),
    "not_equal": ("always[0 s, 1 s] light != red", {"light": [1, 0]}),
    "false": ("false", {}),
    "clock": ("always@[1 s, 2 s] v < 4", {"v": [9, 1, 7]}),
    "if_then": ("always (if x > -1.4 m then v < 2 else v > 5)", {"x": [-2, 0.72, -2], "v": [9, 3, 9]}),
    "if_else": ("always (if x > -1.4 m then v < 2 else v > 5)", {"x": [-2, 0.72, -2], "v": [9, 1, 3]}),
    "if_condition": ("if x > 0 m then v < 2 else v > 5", {"x": [0.5], "v": [9]}),
    "not_if": ("not (if x > 0 m then v < 2 else v > 5)", {"x": [-2], "v": [9]}),
    "xor": ("always (fast xor ready)", {"v": [1, 5, 5], "ready": [1, 0, 1]}),
    "unless": ("always (v < 4 unless[0 s, 2 s] ready)", {"v": [1, 5, 6, 7], "ready": [0, 0, 0, 0]}),
    "negated_definition": ("always calm", {"v": [1, 5, 2]}),
    "window_in_definition": ("always soon", {"ready": [1, 0, 0, 0]}),
    "not_equal_formulas": ("always ((v > 3) != ready)", {"v": [1, 5], "ready": [1, 1]}),
    "freeze": (
        "always (freeze x0 = x in historically[0 s, 2 s] x < x0 + 1 m)",
        {"x": [1, 2, 2.5, 4, 1, 6]},
    ),
    "freeze_speed": (
        "always (freeze v0 = v in next(v) < v0 + 5 km/h)",
        {"v": [1, 2, 6, 6]},
    ),
}


def text_of(formula: str, columns: dict[str, list[float]]) -> str:
    monitor = Monitor(f"{HEAD}require r: {formula}\n", dt=1)
    verdict = monitor.check(columns or {"v": [0.0]})
    cause = explain(verdict, "r")
    assert cause is not None
    return render_place(cause.place, cause.labels, [("because", cause.because)], color=False)


def test_the_golden_texts(request: pytest.FixtureRequest) -> None:
    text = "\n".join(f"# {name}\n{text_of(*case)}" for name, case in CASES.items())
    golden = GOLDEN / "causes.txt"
    if request.config.getoption("--regenerate"):
        golden.write_text(text, encoding="utf-8")
    assert text == golden.read_text(encoding="utf-8")


def test_a_cause_in_numbers() -> None:
    monitor = Monitor(f"{HEAD}require r: always[0 s, 2 s] fast\n", dt=0.5)
    v = np.array([[4.0, 4, 4, 4, 4, 4], [4, 4, 4, 1, 4, 4]])
    verdict = monitor.check({"v": v})
    cause = explain(verdict, "r")
    assert cause is not None
    assert (cause.trace, cause.start, cause.sample, cause.time) == (1, 0, 3, 1.5)
    assert cause.predicate == "v > 3"
    assert cause.span.line == 8
    assert [(r.signal, r.value, r.text) for r in cause.readings] == [("v", 1.0, "v = 1 m/s")]
    assert cause.tree.leaf.rho == verdict.robustness[1] == -2.0


def test_a_window_that_the_end_cuts_is_explained_at_the_end() -> None:
    monitor = Monitor("signal x, y\nrequire r: always (x > 0 -> eventually[0, 2] y > 0)", dt=1)
    x, y = [1.0, 1, -1, -2, 1, 0, 1, 2, 1], [0.0, -1, 1, -1, -1, 0, 1, -1, -1]
    verdict = monitor.check({"x": np.array(x), "y": np.array(y)}, end="truncate")
    cause = explain(verdict, "r")
    online = monitor.online(How(end="truncate", reasons=True))
    online.push_block(np.c_[x, y])
    for found in (cause, online.cause("r")):
        assert found is not None
        assert (found.because, found.sample) == ("`y > 0` comes closest at t = 8 s, where y = -1", 8)


@pytest.mark.parametrize(
    ("written", "end", "spans"),
    [
        ("always (x > 0 -> eventually[0, 2] y > 0)", "truncate", [(3, 4), (8, 8)]),
        ("always (x > 0 -> eventually[0, 2] y > 0)", "open", [(3, 4)]),
        ("always[0, 1] always@[0, 3] x > 0", "open", [(2, 2)]),
        ("always@[4, 4] always@[1, 2] x > 0", "open", [(2, 2)]),
    ],
)
def test_marks_are_at_the_instants_that_count(written: str, end: str, spans: list[tuple[int, int]]) -> None:
    x, y = [1.0, 1, -1, 1, 1, 0, 0, 0, 1], [0.0, 1, -1, -9, -1, -1, -1, 1, -1]
    verdict = Monitor(f"signal x, y\nrequire r: {written}", dt=1).check(
        {"x": np.array(x), "y": np.array(y)}, end=end
    )
    assert [(each.first, each.last) for each in violations(verdict, "r", 0, 9)] == spans


def test_a_value_that_a_cut_window_needs_too_does_not_decide_alone() -> None:
    monitor = Monitor("signal x\nrequire r: always[0, 3] eventually[0, 1] x > 0", dt=1)
    cause = explain(monitor.check({"x": np.array([1.0, 1, -1, -1])}, end="truncate"), "r")
    assert cause is not None
    assert (cause.sample, cause.alone) == (3, True)


@pytest.mark.parametrize(
    ("written", "because"),
    [
        ("always[0, 1] (once x > 2 unless[2, inf] y > 0)", "`x > 2` is false where x = 1, at t = 0 s"),
        ("prev(always[1, 1] y > 0)", "`prev(always[1, 1] y > 0)` is false whatever the signals are"),
        ("x > 2 and eventually[4, 5] y > 0", "`x > 2` is false where x = 1, at t = 0 s"),
    ],
)
def test_the_robustness_of_a_window_beyond_the_end_is_that_of_the_verdict(written: str, because: str) -> None:
    monitor = Monitor(f"signal x, y\nrequire r: {written}", dt=1)
    verdict = monitor.check({"x": np.array([1.0]), "y": np.array([-1.0])}, end="truncate")
    cause = explain(verdict, "r")
    assert cause is not None
    assert (cause.because, cause.tree.rho) == (because, verdict["r"].robustness)


def test_values_that_are_equal_are_told_as_they_are() -> None:
    monitor = Monitor("signal x\nrequire r: not (x > 0 until[0, 2] x > 3)", dt=1)
    cause = explain(monitor.check({"x": np.array([1.0, 4, 5])}), "r")
    assert cause is not None
    assert (cause.tree.rho, cause.tree.leaf.rho) == (-1.0, 1.0)


def test_an_absolute_window_is_violated_where_it_is_required() -> None:
    monitor = Monitor("signal x\nrequire r: always[1, 3] eventually@[0, 0] x > 0", dt=1)
    cause = explain(monitor.check({"x": -np.ones(5)}), "r")
    assert cause is not None
    assert (cause.sample, cause.violated) == (0, 1)


def test_what_comes_closest_is_closest_in_the_whole_window() -> None:
    monitor = Monitor("signal x, y\nrequire r: x > 0 until[0, 2] y > 0", dt=1)
    cause = explain(monitor.check({"x": np.array([1.0, -9, 1]), "y": np.array([-5.0, -1, -1])}), "r")
    assert cause is not None
    assert cause.because == "`y > 0` is false where y = -5, at t = 0 s"


def test_an_unknown_sample_has_no_value() -> None:
    monitor = Monitor("signal x, y\nrequire r: x <= prev(x)", dt=1)
    cause = explain(monitor.check({"x": np.array([np.nan, 2.0])}, end="truncate"), "r")
    assert cause is not None
    assert cause.because == "`x <= prev(x)` is false whatever the signals are"


@pytest.mark.parametrize(
    ("written", "because", "spans"),
    [
        ("x >= 0 and y > 0", "`y > 0` is false where y = 0, at t = 0 s", [(0, 0)]),
        ("always (y > 0 or x < 0)", "`y > 0` is false where y = 0, at t = 0 s", [(0, 0), (2, 2)]),
        ("always not x >= 0", "`x >= 0` is true where x = 0, at t = 0 s", [(0, 0), (2, 2)]),
    ],
)
def test_without_tolerance_what_is_blamed_is_false(
    written: str, because: str, spans: list[tuple[int, int]]
) -> None:
    monitor = Monitor(f"signal x, y\nrequire r: {written}", dt=1)
    columns = {"x": np.array([0.0, -1, 0]), "y": np.array([0.0, 0, 0])}
    verdict = monitor.check(columns, tolerance=0)
    online = monitor.online(How(tolerance=0, reasons=True))
    online.feed(columns)
    for cause in (explain(verdict, "r"), online.cause("r")):
        assert cause is not None
        assert (cause.because, cause.tree.rho) == (because, 0.0)
    assert [(each.first, each.last) for each in violations(verdict, "r", 0, 9)] == spans


def test_without_tolerance_the_worst_start_is_a_violated_one() -> None:
    verdict = Monitor("signal x, y\nrequire r: x >= 0 and y > 0", dt=1).check(
        {"x": np.array([0.0, 1, 2]), "y": np.array([1.0, 0, 1])}, at="all", tolerance=0
    )
    cause = explain(verdict, "r")
    assert cause is not None
    assert cause.because == "`y > 0` is false where y = 0, at t = 1 s"
    assert verdict.told()["r"].worst == (0, 1)


def test_a_planning_window_that_the_end_cuts_is_explained_in_the_recording() -> None:
    monitor = Monitor("signal x\nrequire r: eventually[0, T] always[0, end] x > 0", dt=1, horizon=3)
    cause = explain(monitor.check({"x": np.array([1.0, -2.0])}, end="truncate"), "r")
    assert cause is not None
    assert (cause.sample, cause.predicate) == (1, "x > 0")


def test_what_comes_closest_does_so_in_scope() -> None:
    monitor = Monitor("signal x, y\nassume s: x > -9\nrequire a: x > 0\nrequire b: y > 0", dt=1)
    columns = {"x": np.array([[5.0, 5], [-10, -10]]), "y": np.array([[1.0, 1], [2, 2]])}
    found = explanation(monitor.check(columns))
    assert found.closest == "nothing is violated (satisfied); b comes closest: 1 at trace 0"
    outside = explanation(monitor.check({name: values[1:] for name, values in columns.items()}))
    assert outside.closest.startswith("nothing is violated (out of scope)")


def test_what_is_not_violated_has_no_cause() -> None:
    verdict = Monitor("signal a\nrequire r: always[0 s, 2 s] a > 0\n", dt=1).check({"a": [1.0]})
    assert verdict.status == "inconclusive"
    assert explain(verdict, "r") is None
    with pytest.raises(UsageError, match="no requirement `q`"):
        explain(verdict, "q")


def test_a_violation_before_the_end_of_a_short_trace() -> None:
    verdict = Monitor("signal a\nrequire r: always[0 s, 9 s] a > 0\n", dt=1).check({"a": [1.0, -2, -1]})
    cause = explain(verdict, "r")
    assert cause is not None
    assert (cause.sample, cause.tree.rho) == (1, -2.0)


def test_values_as_one_reads_them() -> None:
    light = Column("light", kind="enum", labels=(("red", 0.0), ("green", 1.0)))
    assert [shown(value, light) for value in (0.0, 1.0, 0.5)] == ["red", "green", "0.5"]
    assert shown(0.27000000001, Column("x", Unit.parse("m"))) == "0.27 m"


def test_names_are_found_in_every_kind_of_expression() -> None:
    monitor = Monitor(
        f"{HEAD}require r: if ready then forall i in 0..1: near(i * 1 m) else max(v, 1) > 2\n", dt=1
    )
    formula = monitor.spec.items[-1].formula
    assert [name.name for name in names_in(formula) if name.name in ("ready", "near", "v")] == [
        "ready",
        "near",
        "v",
    ]


def test_a_deep_formula_is_evaluated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    deep = "always[0, 50 s] once[0, 50 s] " * 30
    verdict = Monitor(f"signal x\nrequire r: {deep}x > 0", dt=0.1).check({"x": -np.ones(12)})
    seen = []

    def counted(*given, **more):
        seen.append(given)
        return evaluate_parts(*given, **more)

    monkeypatch.setattr("stlc.monitor.explain.causes.evaluate_parts", counted)
    cause = explain(verdict, "r")
    assert cause is not None
    assert (cause.predicate, cause.sample) == ("x > 0", 0)
    assert len(seen) == 1


def test_all_causes_are_those_of_each() -> None:
    text = "signal x\nrequire a: always x > 0\nrequire b: x > -5\nrequire c: eventually x > 2"
    verdict = Monitor(text, dt=0.1).check({"x": -np.ones(12)})
    causes = verdict.causes
    assert list(causes) == ["a", "c"]
    assert causes == {name: explain(verdict, name) for name in causes}


@pytest.mark.parametrize(
    ("written", "because"),
    [
        (
            "(x > 0 or historically y > 0) and always[0 s, 3 s] false",
            "`false` is false whatever the signals are",
        ),
        ("x > 1 and not (freeze k = y in eventually[0 s, 2 s] (x > k or true))", "`true` is true whatever"),
        ("always (x > 0 -> (y > 0 and false))", "`x > 0` is true where x = 7, at t = 5 s"),
        ("not eventually (y > 3 or true)", "`true` is true whatever the signals are"),
        ("x > 9 and (y > 3 or true)", "`x > 9` is false where x = 2, at t = 0 s"),
        ("x > 3 until[8 s, 9 s] false", "`false` is false whatever the signals are"),
        ("x > 3 until[2 s, 9 s] false", "`false` is false whatever the signals are"),
    ],
)
def test_a_signal_that_makes_no_difference_need_not_be_there(written: str, because: str) -> None:
    monitor = Monitor(f"signal x\nsignal y\nrequire r: {written}", dt=1)
    cause = explain(monitor.check({"x": np.arange(2.0, 8.0)}, end="truncate"), "r")
    assert cause is not None
    assert cause.because.startswith(because)


@pytest.mark.parametrize(
    ("written", "alone"),
    [
        ("freeze a = x in x - a > 1", False),
        ("freeze a = x in eventually[0 s, 2 s] x > a + 1", False),
        ("freeze a = x in eventually[1 s, 2 s] x > a + 1", True),
        ("freeze a = x in next(prev(x) > a + 1)", False),
        ("freeze a = x in (x > a + 9 or always[1 s, 2 s] x > 1.75)", False),
        ("x > 3 and x < 1", False),
        ("x > 3 and x < 1.5", True),
        ("x > 4 and y > 4", False),
    ],
)
def test_a_value_decides_alone_where_its_change_is_enough(written: str, alone: bool) -> None:
    monitor = Monitor(f"signal x\nsignal y\nrequire r: {written}", dt=1)
    columns = {"x": np.array([2.0, 1.5, 1.5]), "y": np.array([2.0, 1.5, 1.25])}
    cause = explain(monitor.check(columns), "r")
    assert cause is not None
    assert cause.alone is alone


def test_a_window_that_the_end_cuts_is_explained_by_what_there_is() -> None:
    monitor = Monitor("signal x\nrequire r: eventually[0 s, 3 s] eventually[0 s, 7 s] next(x > 9)", dt=1)
    cause = explain(monitor.check({"x": np.arange(2.0, 8.0)}, end="truncate"), "r")
    assert cause is not None
    assert cause.sample == 5
    alone = explain(monitor.check({"x": np.array([2.0])}, end="truncate"), "r")
    assert alone is not None
    assert alone.readings == ()
