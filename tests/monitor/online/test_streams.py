"""Transducers against the evaluator of recordings, sample by sample: bounds, first verdicts, ends."""

from __future__ import annotations

import os
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.simplify import simplify
from stlc.compile.pipeline import Compiled
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.monitor.instants import rule_bounds
from stlc.monitor.online import kernel, recompute
from stlc.monitor.online.kernel import Streamed
from stlc.monitor.online.online import How, Online
from stlc.monitor.online.recompute import Recomputed
from stlc.monitor.online.tally import Asked
from stlc.monitor.prefix_bounds import FAR, lengthened, prefix_bound, with_seen
from stlc.monitor.values import Record, bounds, decisive
from stlc.monitor.verdict import Monitor

EXAMPLES = int(os.environ.get("STLC_CASES", "20"))
"""Number of random formulas and traces."""

Ends = tuple[np.ndarray, np.ndarray]


@cache
def compiled() -> Compiled:
    return Monitor("signal x\nsignal y\nsignal z\nrequire r: x + y + z > 0\n", dt=0.1).compiled


def at_ends(formula: ir.Formula, known: dict[str, np.ndarray], starts: range, *, cut: bool = False) -> Ends:
    """Bounds wherever the trace ends, by the evaluator: endless windows run over many unknown samples."""
    record, found = Record.of(with_seen(known, NUMPY), NUMPY), []
    for i, end in enumerate(("lower", "upper")):
        longer = lengthened(prefix_bound(formula, end, cut=cut), record.samples + 60)
        found.append(record.values([record.sides(longer)[i]], starts, end, FAR)[0][:, 0])
    return found[0], found[1]


def so_far(
    formula: ir.Formula, known: dict[str, np.ndarray], starts: range, settled: int, *, cut: bool
) -> Ends:
    """The same; where the end cuts windows, settled instants have the value that the ended trace gives."""
    low, high = at_ends(formula, known, starts, cut=cut)
    count = max(min(settled, starts.stop) - starts.start, 0) if cut else 0
    if count:
        certain = bounds(formula, Record.of(known, NUMPY), starts[:count], "truncate")
        low[:count], high[:count] = (end[:, 0] for end in certain)
    return low, high


def holed(trace: dict[str, np.ndarray], seed: int, share: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: np.where(rng.random(x.shape) < share, np.nan, x) for name, x in trace.items()}


def check_stream(formula: ir.Formula, trace: dict[str, np.ndarray], how: How) -> Online:
    """Compare a stream with the evaluator after each sample, and at its end."""
    rule = random_formulas.a_rule(formula)
    online = Online(compiled(), [rule], how)
    name, values = rule.name, Asked([rule], 0, False, None, "truncate")
    deciding = decisive(rule, how.tolerance, compiled().signature).formula
    everywhere, cut, said = online.requirement(name).everywhere, how.end == "truncate", {}
    for k in range(len(trace["x"])):
        known = {each: x[: k + 1] for each, x in trace.items()}
        assert online.push({each: x[k, 0] for each, x in known.items()}) == len(online.verdicts())
        starts = range(k + 1 if everywhere else 1)
        settled = values.settled(k + 1)
        low, high = so_far(formula, known, starts, settled, cut=cut)
        for decision in online.verdicts():
            assert decision.start not in said
            said[decision.start] = decision.status
            assert online.bounds(name, decision.start) == (low[decision.start], high[decision.start])
        if last := online.requirement(name).everywhere and online._find(name).tally.next:
            assert online.bounds(name, last - 1) == (low[last - 1], high[last - 1])
        for start, least, most in online.open_starts(name):
            assert (least, most) == (low[start], high[start])
        low, high = so_far(deciding, known, starts, settled, cut=cut)
        wanted = {s: "satisfied" for s in starts if low[s] >= -how.tolerance}
        wanted |= {s: "violated" for s in starts if high[s] < -how.tolerance}
        assert said == wanted
    samples = len(trace["x"])
    starts = range(max(samples - rule.reach, 1) if everywhere else 1)
    low, high = (
        end[:, 0]
        for end in rule_bounds(rule, Record.of(trace, NUMPY), starts, None, "truncate" if cut else "open")
    )
    tally = online.finish()[name]
    assert (tally.low, tally.high, tally.instants) == (low.min(), high.min(), len(starts))
    return online


@settings(max_examples=EXAMPLES, deadline=None)
@given(
    written=random_formulas.formulas(),
    trace=random_formulas.traces(1, 24, 1),
    end=st.sampled_from(["open", "truncate"]),
    tolerance=st.sampled_from([TOLERANCE, 0.0]),
    share=st.sampled_from([0.0, 0.0, 0.15]),
)
def test_a_stream_gives_what_the_whole_trace_gives(written, trace, end, tolerance, share) -> None:
    formula = simplify(random_formulas.GRID.lower(written, []))
    at = None if random_formulas.a_rule(formula).uses_end else "all"
    check_stream(formula, holed(trace, 0, share), How(at, end, tolerance))


@settings(max_examples=EXAMPLES // 2, deadline=None)
@given(written=random_formulas.formulas(held=()), trace=random_formulas.traces(1, 14, 1))
def test_frozen_values_and_other_samples_give_what_the_whole_trace_gives(written, trace) -> None:
    formula = simplify(random_formulas.GRID.lower(written, []))
    at = None if random_formulas.a_rule(formula).uses_end else "all"
    check_stream(formula, trace, How(at))


@settings(max_examples=EXAMPLES // 2, deadline=None)
@given(random_formulas.formulas(), random_formulas.traces(1, 14, 1), st.sampled_from(["open", "truncate"]))
def test_without_a_compiler_a_stream_is_evaluated_anew(written, trace, end) -> None:
    formula = simplify(random_formulas.GRID.lower(written, []))
    at = None if random_formulas.a_rule(formula).uses_end else "all"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "_library", lambda _: None)
        online = check_stream(formula, trace, How(at, end))
    assert isinstance(online._find(online.requirements[0]), Recomputed)


def test_what_is_decided_has_bounds_where_many_starts_are_taken_together(monkeypatch) -> None:
    monkeypatch.setattr(kernel, "_library", lambda _: None)
    monkeypatch.setattr(recompute, "_NARROW", 8)
    monitor, x = Monitor("signal x\nrequire r: eventually[0 s, 40 s] x > 0", dt=1.0), np.full(150, -1.0)
    x[67], online, several = 1.0, monitor.online(How("all")), False
    for k in range(len(x)):
        online.push([x[k]])
        told = [each.start for each in online.verdicts()]
        least, most = monitor.bounds({"x": x[: k + 1]})
        assert [online.bounds("r", start) for start in told] == [(least[i], most[i]) for i in told]
        several |= len(told) > 1
    assert several


@pytest.mark.parametrize("every", [False, True])
@pytest.mark.parametrize(("lo", "hi", "back", "steps"), [(1, 3, 3, 1), (0, 5, 2, 1), (2, 2, 6, 4)])
def test_a_truth_that_lasts_decides_windows_that_reach_it(every, lo, hi, back, steps) -> None:
    """`eventually[1..3] once[3..3] next(false)` is false before its window has passed, and its dual true."""
    future, past = ("always", "historically") if every else ("eventually", "once")
    part = ir.Shift(steps, ir.Truth(every), weak=every)
    formula = ir.Temporal(future, ir.Window(lo, hi), ir.PastTemporal(past, ir.Window(back, back), part))
    check_stream(formula, dict.fromkeys("xyz", np.zeros((9, 1))), How("all", "truncate"))


OPERATORS = {
    "windows": "always[0, 3 s] eventually[1 s, 2 s] x > 0",
    "past": "historically[1 s, 3 s] (once[0 s, 2 s] x > 0)",
    "whole past": "always[0, 1 s] (once x > 0 or y < 1)",
    "until": "x > 0 until[1 s, 4 s] y > 0",
    "since": "not (x > 0 since[1 s, 4 s] y > 0)",
    "edges": "always[0, 3 s] (rise(x > 0) -> next(y > 0))",
    "to the end": "always (x > 0 -> eventually[0, 2 s] y > 0)",
    "response": "always (x > 0 -> eventually y > 0)",
    "steps": "always[0, 2 s] abs(next(x) - x) < 3",
    "mission": "always@[1 s, 3 s] x > 0 and eventually@[0, 2 s] y > 0",
    "chosen": "(if x > 0 then y else z) > 0",
}


@pytest.mark.parametrize("name", OPERATORS)
def test_every_operator_has_transducers(name: str) -> None:
    text = "signal x\nsignal y\nsignal z\nrequire r: " + OPERATORS[name]
    (watched,) = Monitor(text, dt=1.0).online()._watched.values()
    assert isinstance(watched, Streamed)


# ------------------------------------------------------------------------- cost and memory


def test_wide_windows_are_never_late() -> None:
    monitor = Monitor("signal x\nrequire r: always[0 s, 100000 s] eventually[0 s, 30000 s] x > 0", dt=1.0)
    online = monitor.online()
    assert online.push_block(np.ones((1500, 1)))[0] == 0
    assert online.push_block(-np.ones((30_000, 1)))[0] == 0
    assert online.push([-1.0]) == 1
    (decision,) = online.verdicts()
    assert (decision.status, decision.sample) == ("violated", 31_500)
    assert online.bounds("r", decision.start)[1] == -1.0


def test_windows_of_more_samples_than_memory_holds_are_evaluated_anew() -> None:
    (watched,) = Monitor("signal x\nrequire r: always[0 s, 1e10 s] x > 0", dt=1.0).online()._watched.values()
    assert isinstance(watched, Recomputed)


def test_rows_dicts_and_blocks_are_the_same() -> None:
    text = "signal a\nsignal b\nrequire r: always[0, 2 s] (a > 0 or b > 0)\nrequire s: always a > -3"
    rows = np.random.default_rng(0).normal(size=(50, 2))
    monitors = [Monitor(text, dt=1.0).online() for _ in range(4)]
    for row in rows.tolist():
        assert monitors[0].push(row) == monitors[1].push(dict(zip("ab", row, strict=True)))
    monitors[2].push_block(rows)
    taken = 0
    while taken < len(rows):
        decided, more = monitors[3].push_block(rows[taken:], pause=True)
        taken += more
        assert decided == len(monitors[3].verdicts())
    assert all(each.finish() == monitors[0].finish() for each in monitors)


@pytest.mark.parametrize("row", [[1.0], [1.0, 2.0, 3.0], ["a", "b"], [[1.0], 2.0]])
def test_rows_that_are_refused(row: Any) -> None:
    online = Monitor("signal a\nsignal b\nrequire r: a > b", dt=1.0).online()
    with pytest.raises(Exception, match=r"E605.*one number for each of a, b"):
        online.push(row)
