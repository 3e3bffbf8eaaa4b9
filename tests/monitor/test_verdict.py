"""The monitor against the definitions, and what it promises about shapes, ends and libraries."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import reference
from hypothesis import given, settings
from hypothesis import strategies as st

import stlc
from stlc.diagnostics import SpecError, StlcError, TraceError, UsageError
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.trace import Trace, TraceMeta
from stlc.units import Unit

ROOT = Path(__file__).parents[2]
TRAFFIC = ROOT / "specs" / "traffic.stl"

HEAD = "spec small\nsignal a\nsignal b\n"
FORMULAS = {
    "state": "a > 0",
    "windowed": "a > 0 -> eventually[0, T] b > 0",
    "nested": "always[0, T] (a > 0 or eventually[0.1 s, 0.3 s] b > 0)",
    "bounded": "always[0 s, 0.4 s] (a > 0 or b > 0)",
    "to_end": "always[0, end] (a > 0 or b > 0.5)",
    "until": "a > 0 until[0.1 s, 0.5 s] b > 0",
    "past": "always[0, T] (once[0 s, 0.2 s] a > 0 or historically[0 s, 0.3 s] b > 0)",
    "window_to_end": "always[0, T] (a > 0 or eventually[0, end] b > 0)",
    "window_to_end_with_past": "always[0, T] (once[0 s, 0.2 s] a > 0 or eventually[0, end] b > 0)",
    "since": "eventually[0, T] (a > 0 since[0 s, 0.3 s] b > 0)",
    "edge": "always[0, T] (rise(a > 0) -> b > -1)",
}
T = 6


def monitor_of(formula: str) -> Monitor:
    return Monitor(f"{HEAD}require r: {formula}\n", dt=0.1, horizon=T / 10)


def signals(samples: int, batch: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.integers(-16, 16, (batch, samples)) / 8 for name in ("a", "b")}


def by_definition(monitor: Monitor, columns: dict[str, np.ndarray], k: int, end: str) -> tuple[float, float]:
    """Value at sample `k`; a requirement with `T` and `end` sees its own window and what was before."""
    (rule,) = monitor.compiled.requirements
    stop = k + T + 1 if rule.windowed and rule.uses_end else None
    columns = {name: values[:stop] for name, values in columns.items()}
    trace = reference.Trace(columns, monitor.compiled.grid, end, stop=stop or 0)
    value = reference.Robustness(trace).at(rule.typed.formula, k)
    return (np.nan, np.nan) if value is None else value


# -------------------------------------------------------------- against the definition


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("end", ["strict", "truncate"])
@settings(max_examples=8)
@given(samples=st.integers(2, 16), seed=st.integers(0, 2**32 - 1))
def test_every_sample_is_the_definition(name: str, end: str, samples: int, seed: int) -> None:
    monitor = monitor_of(FORMULAS[name])
    given_signals = signals(samples, 2, seed)
    found = monitor.robustness(given_signals, end=end)
    assert found.shape == (2, samples)
    for trace in range(2):
        columns = {key: values[trace] for key, values in given_signals.items()}
        wanted = [by_definition(monitor, columns, k, end)[0] for k in range(samples)]
        if end == "strict" and name.startswith("window_to_end"):
            wanted[max(samples - T, 0) :] = [np.nan] * min(T, samples)
        np.testing.assert_allclose(found[trace], wanted, atol=1e-12)
        at = [monitor.robustness(columns, end=end, at=k) for k in range(samples)]
        np.testing.assert_allclose(at, wanted, atol=1e-12)


@pytest.mark.parametrize("name", FORMULAS)
@settings(max_examples=8)
@given(samples=st.integers(2, 12), seed=st.integers(0, 2**32 - 1))
def test_bounds_are_the_definition(name: str, samples: int, seed: int) -> None:
    monitor = monitor_of(FORMULAS[name])
    given_signals = signals(samples, 1, seed)
    low, high = monitor.bounds(given_signals)
    columns = {key: values[0] for key, values in given_signals.items()}
    wanted = np.array([by_definition(monitor, columns, k, "open") for k in range(samples)])
    np.testing.assert_allclose(np.stack([low[0], high[0]], axis=1), wanted, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in FORMULAS if "end" not in name])
@settings(max_examples=15)
@given(known=st.integers(2, 12), more=st.integers(0, 30), seed=st.integers(0, 2**32 - 1))
def test_bounds_hold_every_continuation(name: str, known: int, more: int, seed: int) -> None:
    monitor = monitor_of(FORMULAS[name])
    whole = signals(known + more, 3, seed)
    low, high = monitor.bounds({key: values[:, :known] for key, values in whole.items()}, at=0)
    least, most = monitor.bounds(whole, at=0)
    assert (low <= least).all()
    assert (most <= high).all()
    settled = low == high
    assert (least[settled] == low[settled]).all()


@pytest.mark.parametrize("name", FORMULAS)
@settings(max_examples=8)
@given(samples=st.integers(2, 14), seed=st.integers(0, 2**32 - 1))
def test_verdicts_follow_from_the_bounds(name: str, samples: int, seed: int) -> None:
    monitor = monitor_of(FORMULAS[name])
    given_signals = signals(samples, 4, seed)
    judged = monitor.check(given_signals)["r"]
    (rule,) = monitor.compiled.requirements
    starts = range(max(samples - T, 1)) if rule.windowed else range(1)
    assert (judged.start, judged.instants) == (0, len(starts))
    low, high = monitor.bounds(given_signals)
    for trace, status in enumerate(judged.status):
        lows, highs = low[trace, : len(starts)], high[trace, : len(starts)]
        if (highs < 0).any():
            assert status == "violated"
        elif (lows >= 0).all():
            assert status == "satisfied"
        else:
            assert status == "inconclusive"


def test_the_paper_traffic_specification_at_every_start() -> None:
    monitor = Monitor(TRAFFIC)
    rng = np.random.default_rng(3)
    samples = 60
    columns = {
        "x": np.cumsum(rng.normal(0.05, 0.1, samples)) - 1,
        "sign": np.ones(samples),
        "tau": (np.arange(samples) * 0.1 + 2) % 8,
        "dx": np.abs(np.cumsum(rng.normal(0, 0.3, samples))) + 0.5,
        "yielding": np.zeros(samples),
    }
    found = monitor.requirement_robustness(columns)
    for rule in monitor.compiled.requirements:
        for k in range(0, samples - 25, 7):
            window = {name: values[k : k + 26] for name, values in columns.items()}
            trace = reference.Trace(window, monitor.compiled.grid)
            wanted = reference.Robustness(trace).at(rule.typed.formula, 0)
            assert wanted is not None
            assert found[rule.name][k] == pytest.approx(wanted[0], abs=1e-9)
        assert np.isnan(found[rule.name][samples - 25 :]).all()


# ------------------------------------------------------------------- truth and ties


@pytest.mark.parametrize(
    ("value", "relation", "tolerance", "status"),
    [
        (0.0, ">", 1e-6, "satisfied"),
        (-0.9e-6, ">", 1e-6, "satisfied"),
        (-1.1e-6, ">=", 1e-6, "violated"),
        (0.0, ">=", 0.0, "satisfied"),
        (0.0, ">", 0.0, "violated"),
        (1e-12, ">", 0.0, "satisfied"),
        (-1e-12, ">=", 0.0, "violated"),
    ],
)
def test_ties(value: float, relation: str, tolerance: float, status: str) -> None:
    monitor = Monitor(f"signal a\nrequire r: a {relation} 0\n", dt=1)
    verdict = monitor.check({"a": [value]}, tolerance=tolerance)
    assert verdict.status == status


def test_what_is_false_is_never_within_a_tolerance() -> None:
    text = "signal a\nsignal b: bool\nenum M { lo, hi }\nsignal m: M\nrequire r: a > 0 until[0 s, 2 s] b\n"
    monitor = Monitor(f"{text}require s: m == hi\nrequire v: a > 0\n", dt=1)
    given_signals = {"a": [-1.5] * 3, "b": [0.0] * 3, "m": [0.0] * 3}
    for tolerance, violated in ((1e-6, "rsv"), (0.4, "rsv"), (0.5, "rsv"), (2.0, "rs")):
        verdict = monitor.check(given_signals, tolerance=tolerance)
        assert "".join(each.name for each in verdict if each.overall == "violated") == violated
        online = monitor.online(How(tolerance=tolerance))
        for row in zip(*given_signals.values(), strict=True):
            online.push(dict(zip(given_signals, row, strict=True)))
        statuses = {name: each.status for name, each in online.finish().items()}
        assert "".join(name for name, status in statuses.items() if status == "violated") == violated
    assert monitor.check(given_signals | {"b": [0.0, 1.0, 0.0]}, tolerance=2.0)["r"].overall == "satisfied"


def test_strictness_under_negation_and_windows() -> None:
    monitor = Monitor("signal a\nrequire r: not eventually[0 s, 2 s] a > 0\n", dt=1)
    assert monitor.check({"a": [0.0, 0.0, 0.0]}, tolerance=0).satisfied is True
    monitor = Monitor("signal a\nrequire r: not eventually[0 s, 2 s] a >= 0\n", dt=1)
    assert monitor.check({"a": [-1.0, 0.0, -1.0]}, tolerance=0).satisfied is False
    assert monitor.check({"a": [-1.0, -1.0]}, tolerance=0).satisfied is None


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_clear_robustness_decides_without_tolerance(seed: int) -> None:
    for name, formula in FORMULAS.items():
        monitor = monitor_of(formula)
        given_signals = {key: values + 1 / 16 for key, values in signals(14, 2, seed).items()}
        with_slack, without = monitor.check(given_signals), monitor.check(given_signals, tolerance=0)
        assert list(with_slack.status) == list(without.status), name


def test_weights_and_scales_count_in_the_whole_alone() -> None:
    text = "signal a\n@weight(2)\nrequire r: a > 0\n@scale(4)\nrequire s: a > -1\n"
    verdict = Monitor(text, dt=1).check({"a": [[1.0, 9.0], [-0.5, 9.0]]})
    assert verdict["r"].robustness.tolist() == [1.0, -0.5]
    assert verdict["s"].robustness.tolist() == [2.0, 0.5]
    assert verdict.robustness.tolist() == [0.5, pytest.approx(-1.0)]
    assert Monitor(text, dt=1).robustness({"a": [1.0]}, at=0) == 0.5


# ------------------------------------------------------------------- which instants


def test_which_instants_count() -> None:
    text = HEAD + "require w: always[0, T] a > 0\nrequire once_only: a > 0\n"
    monitor = Monitor(text, dt=0.1, horizon=0.2)
    given_signals = {"a": np.array([1.0, 1, 1, -1, 1, 1, 1]), "b": np.zeros(7)}
    verdict = monitor.check(given_signals)
    assert [(j.name, j.instants, j.overall) for j in verdict] == [
        ("w", 5, "violated"),
        ("once_only", 1, "satisfied"),
    ]
    assert verdict["w"].share == pytest.approx(2 / 5)
    assert verdict["w"].worst == (0, 1)
    assert verdict.share == pytest.approx(2 / 5)
    assert verdict.failed_share == pytest.approx(3 / 5)
    assert monitor.check(given_signals, at=0).satisfied is True
    everywhere = monitor.check(given_signals, at="all")
    assert [(j.name, j.instants) for j in everywhere] == [("w", 5), ("once_only", 7)]
    third = monitor.check(given_signals, at=3)
    assert [(j.name, j.start, j.overall) for j in third] == [
        ("w", 3, "violated"),
        ("once_only", 3, "violated"),
    ]
    with pytest.raises(UsageError, match="no sample 7"):
        monitor.check(given_signals, at=7)


def test_a_short_trace_satisfies_violates_or_does_not_say() -> None:
    monitor = Monitor("signal a\nrequire r: always[0 s, 3 s] a > 0\n", dt=1)
    assert monitor.check({"a": [1.0, 1]}).satisfied is None
    assert monitor.check({"a": [1.0, -1]}).satisfied is False
    assert monitor.check({"a": [1.0, 1, 1, 2]}).satisfied is True
    judged = monitor.check({"a": [[1.0, 2], [1.0, -3]]})["r"]
    assert judged.status.tolist() == ["inconclusive", "violated"]
    assert judged.bounds[0].tolist() == [-np.inf, -np.inf]
    assert judged.bounds[1].tolist() == [1.0, -3.0]
    assert np.isnan(judged.robustness[0])
    assert judged.robustness[1] == -3.0
    either = Monitor("signal a\nrequire r: a > 0 or eventually[0 s, 3 s] a < -5\n", dt=1)
    known = either.check({"a": [2.0]})["r"]
    assert (known.satisfied, known.robustness, known.bounds) == (True, 2.0, (2.0, np.inf))


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"at": 1.5}, "`at` is the number"),
        ({"at": "each"}, "`at` is the number"),
        ({"end": "cut"}, "`end` is one of open, strict, truncate, not 'cut'"),
        ({"tolerance": np.inf}, "the tolerance is a finite number"),
        ({"tolerance": np.nan}, "the tolerance is a finite number"),
    ],
)
def test_what_means_nothing_is_no_question(asked: dict, told: str) -> None:
    monitor = Monitor("signal a\nrequire r: always[0, 2] a > 0", dt=1)
    for ask in (lambda: monitor.check({"a": np.ones(4)}, **asked), lambda: monitor.online(How(**asked))):
        with pytest.raises(UsageError, match=told):
            ask()
    with pytest.raises(UsageError, match="strict or truncate"):
        monitor.robustness({"a": np.ones(4)}, end="open")


def test_an_index_of_numpy_is_a_sample() -> None:
    monitor, signals = Monitor("signal a\nrequire r: a > 0", dt=1), {"a": np.array([1.0, -1.0])}
    assert not monitor.check(signals, at=np.argmin(signals["a"])).satisfied
    online = monitor.online(How(at=np.argmin(signals["a"])))
    online.feed(signals)
    assert online.finish()["r"].status == "violated"


@pytest.mark.parametrize("samples", [1, 2, 9, 60])
@pytest.mark.parametrize(
    "formula",
    ["always (a > 0 -> eventually[0 s, 2 s] a > 1)", "prev(a) > 0", "eventually[T, T] next(a) > 0"],
)
def test_no_trace_is_long_enough_for_some_requirements(formula: str, samples: int) -> None:
    monitor = Monitor(f"signal a\nrequire r: {formula}\n", dt=1, horizon=3)
    with pytest.raises(TraceError, match=r"E306: this reads samples outside the trace") as caught:
        monitor.check({"a": np.ones(samples)}, end="strict")
    (finding,) = caught.value.diagnostics
    assert finding.help == ("`--end truncate` evaluates on what there is",)


def test_strict_and_truncate() -> None:
    monitor = Monitor("signal a\nrequire r: always[0 s, 3 s] a > 0\n", dt=0.5)
    with pytest.raises(TraceError, match=r"E306: this needs 3 s of signal; the trace has 0.5 s") as caught:
        monitor.check({"a": [1.0, 2]}, end="strict")
    finding = caught.value.diagnostics[0]
    assert finding.span is not None
    assert finding.span.text == "always[0 s, 3 s] a > 0"
    assert monitor.check({"a": [1.0, 2]}, end="truncate").robustness == 1.0
    assert np.isnan(monitor.robustness({"a": [1.0, 2]})).all()
    assert monitor.robustness({"a": [1.0, 2]}, end="truncate").tolist() == [1.0, 2.0]


def test_requirements_on_the_mission_clock_have_one_value() -> None:
    monitor = Monitor("signal a\nrequire r: eventually@[1 s, 2 s] a > 0\n", dt=1)
    values = np.array([5.0, -1, 2, -3, -4])
    assert monitor.robustness({"a": values}).tolist() == [2.0] * 5
    assert monitor.check({"a": values}, at="all")["r"].instants == 1


# ------------------------------------------------------------------ shapes, libraries


def test_shapes() -> None:
    monitor = monitor_of(FORMULAS["bounded"])
    one = signals(9, 1)
    flat = {name: values[0] for name, values in one.items()}
    deep = {name: np.broadcast_to(values, (2, 3, 9)) for name, values in one.items()}
    assert monitor.robustness(flat).shape == (9,)
    assert monitor.robustness(one).shape == (1, 9)
    assert monitor.robustness(deep).shape == (2, 3, 9)
    assert monitor.robustness(deep, at=0).shape == (2, 3)
    assert isinstance(monitor.robustness(flat, at=0), np.float64)
    assert monitor.check(deep).status.shape == (2, 3)
    assert isinstance(monitor.check(flat).status, str)
    assert isinstance(monitor.check(flat).robustness, float)
    assert (
        monitor.robustness({name: values.astype(np.float32) for name, values in one.items()}).dtype
        == np.float64
    )
    assert monitor.robustness({"a": flat["a"], "b": one["b"]}).shape == (1, 9)
    assert monitor.robustness({"a": flat["a"].tolist(), "b": 1}).shape == (9,)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_keeps_gradients_and_dtype(dtype: torch.dtype) -> None:
    monitor = monitor_of(FORMULAS["until"])
    plain = signals(12, 3)
    tensors = {name: torch.tensor(values, dtype=dtype, requires_grad=True) for name, values in plain.items()}
    for options in ({}, {"end": "truncate"}, {"at": 0}, {"at": 0, "smoothing": 50}):
        value = monitor.robustness(tensors, **options)
        assert value.dtype == dtype
        np.testing.assert_allclose(
            value.detach().numpy(),
            monitor.robustness(plain, **options),
            atol=1e-5 if dtype == torch.float32 else 1e-12,
        )
        (gradient,) = torch.autograd.grad(torch.nan_to_num(value).sum(), [tensors["b"]])
        assert torch.isfinite(gradient).all()
        assert gradient.abs().sum() > 0
    assert monitor.check(tensors).robustness.dtype == np.float64


def test_torch_integers_take_the_default_dtype() -> None:
    monitor = Monitor("signal a\nrequire r: a > 0\n", dt=1)
    assert monitor.robustness({"a": torch.tensor([1, 2])}).dtype == torch.get_default_dtype()


def test_smoothing_tends_to_exact() -> None:
    monitor, given_signals = monitor_of(FORMULAS["nested"]), signals(20, 4)
    exact = monitor.robustness(given_signals, at=0)
    for k in (10.0, 100.0, 1000.0):
        assert (
            np.abs(monitor.robustness(given_signals, at=0, smoothing=k) - exact).max() <= 2 * np.log(28) / k
        )


def test_vectors_by_component_and_whole() -> None:
    monitor = Monitor("signal p : real[2]\nrequire r: norm(p) < 5\n", dt=1)
    p = np.array([[3.0, 3.5], [0.0, 1.0]])
    assert monitor.robustness({"p": p}, at=1) == pytest.approx(4.0)
    assert monitor.robustness({"p[0]": p[:, 0], "p[1]": p[:, 1]}, at=1) == pytest.approx(4.0)
    assert monitor.robustness({"p": torch.tensor(p)}, at=1).item() == pytest.approx(4.0)


def test_torch_is_not_imported() -> None:
    code = (
        "import sys, numpy as np, stlc\n"
        "m = stlc.Monitor(stlc.load('specs/traffic.stl'))\n"
        "s = {c.name: np.zeros((2, 40)) for c in m.compiled.signature.columns}\n"
        "m.check(s); m.robustness(s); m.bounds(s)\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


# ---------------------------------------------------------------------- specs, times


def test_as_the_documentation_has_it(tmp_path: Path) -> None:
    spec = stlc.load(TRAFFIC)
    monitor = stlc.Monitor(spec, dt=0.1)
    assert monitor.horizon == pytest.approx(2.5)
    values = {"x": -5.0, "v": 3.0, "sign": 0, "tau": 2.0, "dx": 4.0, "v_lead": 0.0, "yielding": 0}
    given_signals = {name: np.full((2, 30), value) for name, value in values.items()}
    verdict = monitor.check(given_signals)
    assert verdict.satisfied
    assert verdict["give_way"].robustness.tolist() == [4.5, 4.5]
    assert verdict.status.tolist() == ["satisfied", "satisfied"]
    low, high = monitor.bounds(given_signals, at=0)
    assert (low == high).all()
    path = tmp_path / "trace.npz"
    signature = Signature(tuple(Column(name) for name in values))
    trace = Trace(signature, 0.1, given_signals)
    trace.save(path)
    for subject in (trace, path, str(path)):
        assert monitor.check(subject).robustness.tolist() == verdict.robustness.tolist()


def test_the_specification_as_text_and_as_path() -> None:
    assert Monitor(TRAFFIC).requirements == Monitor(str(TRAFFIC)).requirements
    assert Monitor(TRAFFIC.read_text(), dt=0.1, horizon=2.5).requirements[0] == "no_collision"
    assert Monitor("signal a\nrequire r: a > 0").requirements == ("r",)


def test_dt_and_horizon_come_from_who_knows_them() -> None:
    assert Monitor(TRAFFIC).compiled.grid.horizon == 25
    assert Monitor(TRAFFIC, dt=0.05).compiled.grid.horizon == 50
    assert Monitor(TRAFFIC, dt=0.1, horizon=1).compiled.grid.horizon == 10
    assert Monitor(TRAFFIC, system=ROOT / "examples" / "car.yaml").compiled.grid.horizon == 25
    text = "signal a\nrequire r: always[0, T] a > 0\n"
    with pytest.raises(SpecError, match="E311"):
        _ = Monitor(text, dt=0.1).compiled
    with pytest.raises(SpecError, match="E311") as caught:
        _ = Monitor(f'system "lorry.yaml"\n{text}', dt=0.1).compiled
    assert "`lorry.yaml`, but there is no such file" in caught.value.diagnostics[0].note[-1]
    with pytest.raises(UsageError, match="not a whole number of steps"):
        Monitor(text, dt=0.1, horizon=0.25)
    odd = Trace(Signature((Column("a"),)), 0.03, {"a": np.ones((1, 50))}, name="odd.csv")
    with pytest.raises(TraceError, match=r"E602.*`odd.csv` has dt 0.03 s, and T = 0.25 s is no whole"):
        Monitor(text, horizon=0.25).check(odd)
    with pytest.raises(UsageError, match="above 0"):
        Monitor(text, dt=-1)


def test_a_trace_says_what_time_means() -> None:
    text = "signal a\nrequire r: always[0, T] a > 0\n"
    trace = Trace(Signature((Column("a"),)), 0.5, {"a": np.ones((1, 10))}, meta=TraceMeta(horizon=4))
    monitor = Monitor(text)
    assert monitor.check(trace)["r"].instants == 6
    assert Monitor(text, horizon=1).check(trace)["r"].instants == 8
    with pytest.raises(TraceError, match=r"E602.*dt 0.5 s, the monitor was told 0.1 s"):
        Monitor(text, dt=0.1, horizon=1).check(trace)


def test_bad_specifications_and_names() -> None:
    with pytest.raises(SpecError, match="E101"):
        Monitor("signal a\nrequire r: aa > 0\n", dt=1)
    with pytest.raises(UsageError, match="no requirement to judge"):
        Monitor("signal a\n", dt=1).check({"a": [1.0]})
    monitor = Monitor(TRAFFIC)
    with pytest.raises(UsageError, match="no requirement `giveway`") as caught:
        monitor.check({}, require=["giveway"])
    assert caught.value.diagnostics[0].help == ("did you mean `give_way`?",)
    with pytest.raises(UsageError, match="a list of names") as letters:
        Monitor("signal x\nrequire a: x > 0\nrequire b: x > 1\n", dt=1).check({"x": [2.0]}, require="ab")
    assert letters.value.diagnostics[0].help == ('["ab"]',)


# --------------------------------------------------------------------------- signals


def test_missing_signals_are_named_with_those_who_need_them() -> None:
    monitor = Monitor("signal v_lead\nsignal x\nrequire a: x > 0\nrequire b: x + v_lead > 0\n", dt=1)
    with pytest.raises(TraceError, match="E601") as caught:
        monitor.check({"x": [1.0], "vlead": [1.0]})
    (finding,) = caught.value.diagnostics
    assert finding.label == "needed by: b"
    assert finding.span is not None
    assert finding.span.line == 1
    assert "did you mean `vlead`?" in finding.help[0]
    assert monitor.check({"x": [1.0]}, require=["a"]).satisfied


def test_infinity_is_a_value() -> None:
    monitor = Monitor(
        "signal a\nsignal b\nrequire far: always a > 1\nrequire apart: always a - b > 1\n", dt=1
    )
    values = {"a": [5.0, np.inf, 4.0], "b": [0.0, 0.0, 0.0]}
    verdict = monitor.check(values)
    assert (verdict["far"].robustness, verdict["apart"].robustness) == (3.0, 3.0)
    assert monitor.check({**values, "a": [5.0, -np.inf, 4.0]}).status == "violated"
    both = monitor.check({**values, "b": [0.0, np.inf, 0.0]})  # inf - inf is no number
    assert (both["far"].status, both["apart"].status) == ("satisfied", "inconclusive")


@pytest.mark.parametrize(
    ("given_signals", "words"),
    [
        ({"a": [1.0, 2.0], "b": [1.0]}, "`b` has 1 samples, `a` has 2"),
        ({"a": np.zeros((2, 3)), "b": np.zeros((4, 3))}, "do not fit together"),
        ({"a": 1.0, "b": 2.0}, "no signal has a time axis"),
        ({"a": [], "b": []}, "no samples"),
        ({"a": np.zeros((0, 3)), "b": np.zeros((0, 3))}, "no traces"),
    ],
)
def test_signals_that_do_not_fit(given_signals: dict[str, object], words: str) -> None:
    with pytest.raises(TraceError, match=f"E605.*{words}"):
        monitor_of("a > b").check(given_signals)


def test_a_constant_formula_counts_samples_where_nothing_is_read() -> None:
    monitor = Monitor("signal a\nsignal q : real[2]\nrequire r: true\n")
    for lead in ((), (4,)):
        given_signals = {"a": np.zeros((*lead, 5)), "q": np.zeros((*lead, 5, 2))}
        assert monitor.robustness(given_signals).shape == (*lead, 5)


def test_units_of_a_trace_are_converted() -> None:
    monitor = Monitor("signal v [m/s]\nrequire r: v < 10\n")
    fast = Trace(Signature((Column("v", Unit.parse("km/h")),)), 1.0, {"v": np.array([[30.0, 40.0]])})
    assert monitor.check(fast, at="all")["r"].robustness[0] == pytest.approx(10 - 40 / 3.6)
    wrong = Trace(Signature((Column("v", Unit.parse("m")),)), 1.0, {"v": np.array([[30.0, 40.0]])})
    with pytest.raises(TraceError, match=r"E605: `v` is in \[m\]"):
        monitor.check(wrong)


def test_time_is_a_signal_of_a_trace() -> None:
    monitor = Monitor("signal t [s]\nsignal a\nrequire r: always[0, end] (t < 1 or a > 0)\n")
    trace = Trace(Signature((Column("a"),)), 0.5, {"a": np.array([[-1.0, -1.0, 1.0, 1.0]])})
    assert monitor.check(trace).satisfied


def test_a_million_samples_take_seconds() -> None:
    text = HEAD + "".join(
        f"require r{i}: always[0, T] (a > {i} or eventually[0 s, 0.5 s] b > 0)\n" for i in range(6)
    )
    monitor = Monitor(text, dt=0.1, horizon=2.5)
    given_signals = {name: values[0] for name, values in signals(200_000, 1).items()}
    verdict = monitor.check(given_signals)
    assert verdict["r5"].instants == 199_975


def test_deadlines_far_beyond_a_short_trace() -> None:
    text = "signal a\nrequire far: always[0, 1e9 steps] eventually[0, 1e9 steps] a > 0\n"
    verdict = Monitor(text, dt=0.1).check({"a": np.array([1.0, -1.0])}, at="all")
    assert verdict.overall == "inconclusive"
    seen = "signal a\nrequire seen: always[0, 1e9 steps] once[0, 1e9 steps] a > 0\n"
    with pytest.raises(StlcError) as caught:
        Monitor(seen, dt=0.1).check({"a": np.array([1.0, -1.0])})
    (finding,) = caught.value.diagnostics
    assert finding.code == "E306"
    assert finding.span is not None
    assert Monitor(seen, dt=0.1).check({"a": np.array([1.0, -1.0])}, end="truncate").satisfied


# ------------------------------------------------------------- bounds under every semantics


@pytest.mark.parametrize("semantics", ["exact", "smooth", "agm", "dgmsr"])
@pytest.mark.parametrize("formula", [*(name for name in FORMULAS if name != "to_end"), "joined"])
def test_no_continuation_leaves_the_bounds(formula: str, semantics: str) -> None:
    """Of a mean a value that is not known yet may be more than all that is: nothing bounds it but its sign.

    (`end` outside of a window of `T` is the last sample that there is, so `to_end` asks something else then.)
    """
    text = FORMULAS.get(formula, "(always[0, 0.6 s] a > 0.1 or b > 2) and eventually[0, 0.6 s] b > -3")
    monitor = Monitor(f"{HEAD}require r: {text}\n", dt=0.1, horizon=T / 10)
    long = {name: values.copy() for name, values in signals(2 * T + 3, 60).items()}
    long["a"][::2] = (
        np.abs(long["a"][::2]) + 0.125
    )  # where nothing is violated a mean grows with what follows
    long["a"][::4, 4:] *= 100.0
    whole = monitor.check(long, end="truncate", semantics=semantics).requirements[0].margins[0][0]
    for known in (2, 3, T, T + 2):
        cut = {name: values[:, :known] for name, values in long.items()}
        low, high = monitor.check(cut, semantics=semantics).requirements[0].margins
        assert (low[0] <= whole + 1e-9).all()
        assert (whole <= high[0] + 1e-9).all()


@pytest.mark.parametrize(
    "formula",
    [
        *("always[0, 5 s] x > 0", "next(x > 0)", "always (x > -9)", "once x > 2", "always@[2 s, 9 s] x > -1"),
        *("historically[1 s, 4 s] x < y", "always[0 s, 3 s] prev(x) > y", "x > 0 since[2 s, 3 s] y > 0"),
        *("once[2 s, 3 s] eventually[0 s, 9 s] x > 2", "freeze p = x in eventually[1 s, 4 s] x > p + y"),
        "rise(x > 0) -> eventually[0 s, 2 s] y > 0",
    ],
)
@pytest.mark.parametrize("at", [0, 3, 20, 38])
def test_a_value_at_one_sample_is_that_of_the_whole_signal(formula: str, at: int) -> None:
    monitor = Monitor(f"signal x\nsignal y\nrequire r: {formula}", dt=1.0)
    x, y, *_ = np.random.default_rng(0).normal(size=(3, 40))
    y[31] = np.nan
    others = ({"y": y.tolist(), "x": x}, {"x": x[:, None], "y": np.repeat(y, 2)[::2]}, {"x": [x], "y": [y]})
    for end in ("strict", "truncate"):
        whole = monitor.robustness({"x": x, "y": y}, end=end)
        found = [monitor.robustness(signals, end=end, at=at) for signals in ({"x": x, "y": y}, *others)]
        assert {np.ndim(value) for value in found} == {0, 1}
        np.testing.assert_array_equal(np.concatenate([np.ravel(value) for value in found]), whole[at])
    low, high = monitor.bounds({"x": x, "y": y})
    assert monitor.bounds({"x": x, "y": y}, at=at) == (low[at], high[at])


def test_a_robustness_that_is_a_signal_is_a_copy_of_it() -> None:
    monitor, x = Monitor("signal x\nrequire r: x >= 0", dt=1.0), np.arange(4.0)
    for _ in range(2):  # the second time, the plan is known
        found = [monitor.robustness({"x": x}), monitor.requirement_robustness({"x": x})["r"]]
        assert [each.tolist() for each in found] == [x.tolist()] * 2
        assert not any(np.shares_memory(each, x) for each in found)


@pytest.mark.parametrize("at", [3, 4, 7, -1])
def test_a_sample_beyond_the_trace_is_refused_each_time(at: int) -> None:
    monitor = Monitor("signal x\nrequire r: once[0 s, 3 s] x > 0", dt=1.0)
    for _ in range(2):
        assert monitor.robustness({"x": np.arange(3.0)}, at=2) == 2.0
        with pytest.raises(StlcError, match=f"U101.*no sample {at}"):
            monitor.robustness({"x": np.arange(3.0)}, at=at)


def test_a_value_at_one_sample_reads_only_what_it_needs() -> None:
    monitor = Monitor("signal x\nrequire r: once[0 s, 2 s] always[0 s, 5 s] x > 0", dt=1.0)
    ready = monitor._prepare({"x": np.zeros(1000)}, at=500)
    assert (ready.signals.first, ready.signals.samples) == (498, 8)
    with pytest.raises(StlcError, match=r"U101.*no sample 1000: the trace has 1000"):
        monitor.robustness({"x": np.zeros(1000)}, at=1000)
