"""Checks of a monitor against the definitions, one a case.

Every case goes the whole way: a formula is written as `.stl`, parsed, resolved, compiled and judged by
`stlc.Monitor`. `proof.levels` says what has to come out; `reference`, which shares no idea with it, says so
again from the resolved formula.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from helpers import reference
from proof.cases import Case
from proof.draw import HORIZON, Taste
from proof.levels import robustness, truth
from proof.whole import defined

from stlc.monitor.instants import beyond
from stlc.monitor.verdict import Monitor

ENDS = ("truncate", "lower", "upper")


def varied(seed: int) -> Case:
    """A case of the whole language; one in three with choices between bools."""
    return Case(seed, Taste(bools=seed % 3 == 0))


def check_values(seed: int) -> None:
    """Robustness and both bounds at every sample, and at one sample alone; where a strict value exists."""
    case = varied(seed)
    monitor = case.monitor()
    wanted = {end: np.array(robustness(case.formula, case.record(end))) for end in ENDS}
    low, high = monitor.bounds(case.signals)
    if not case.folds:
        case.same(low, wanted["lower"], "lower bound")
        case.same(high, wanted["upper"], "upper bound")
    assert (wanted["lower"] <= low + 1e-9).all(), f"lower bound\n{case}"
    assert (low <= high).all(), f"bounds\n{case}"
    assert (high <= wanted["upper"] + 1e-9).all(), f"upper bound\n{case}"
    case.same(monitor.robustness(case.signals, end="truncate"), wanted["truncate"], "truncate")
    check_strict(case, monitor.robustness(case.signals), wanted["truncate"], (low, high))
    at = seed % case.samples
    case.same(monitor.robustness(case.signals, end="truncate", at=at), wanted["truncate"][at], f"at {at}")
    case.same(monitor.bounds(case.signals, at=at), (low[at], high[at]), f"bounds at {at}")


def check_strict(case: Case, found: Any, wanted: Any, bounds: tuple[Any, Any]) -> None:
    """NaN where a window leaves the trace, or what a constant inside of it decides all the same."""
    here = np.array([bool(defined(case.formula, case.rows) >> t & 1) for t in range(case.samples)])
    case.same(found[here], wanted[here], "strict")
    decided = ~here & ~np.isnan(found)
    assert case.folds or not decided.any(), f"strict has a value where a window leaves the trace\n{case}"
    for end in bounds:
        case.same(found[decided], end[decided], "strict by a constant")


def check_other(seed: int) -> None:
    """`reference` against `proof.levels`, all end policies."""
    case = Case(seed)
    monitor = case.monitor()
    (rule,) = monitor.compiled.requirements
    columns = {name: values for name, values in case.signals.items() if values.ndim == 1}
    columns.update({f"q[{i}]": case.signals["q"][:, i] for i in range(3)})
    grid = monitor.compiled.grid
    for policy, ends in (("truncate", ("truncate", "truncate")), ("open", ("lower", "upper"))):
        judge = reference.Robustness(reference.Trace(columns, grid, policy))
        values = [judge.at(rule.typed.formula, t) for t in range(case.samples)]
        for side, end in enumerate(ends):
            case.same([v[side] for v in values], robustness(case.formula, case.record(end)), policy)
    judge = reference.Robustness(reference.Trace(columns, grid, "strict"))
    whole = defined(case.formula, case.rows)
    for t in range(case.samples):
        value = judge.at(rule.typed.formula, t)
        assert (value is not None) is bool(whole >> t & 1), f"defined at {t}\n{case}"


def check_truth(seed: int) -> None:
    """Boolean verdicts without tolerance, and that the sign agrees."""
    case = varied(seed)
    monitor = case.monitor()
    _check_truth(case, monitor, "all")
    _check_truth(case, monitor, seed % case.samples)


def _check_truth(case: Case, monitor: Monitor, at: Any) -> None:
    exact = monitor.check(case.signals, at=at, end="truncate", tolerance=0)["r"]
    judged = slice(exact.start, exact.start + exact.instants)
    wanted = np.array(truth(case.formula, case.record("truncate")))[judged]
    starts = range(exact.start, exact.start + exact.instants)
    whole = ~beyond(exact.rule, starts, case.samples, monitor.compiled.grid.horizon)
    held, failed = exact.holds[:, 0], exact.fails[:, 0]
    np.testing.assert_array_equal(held[whole], wanted[whole], err_msg=f"holds\n{case}")
    np.testing.assert_array_equal(failed[whole], ~wanted[whole], err_msg=f"fails\n{case}")
    assert wanted[held].all(), f"holds where a window has no sample\n{case}"
    assert not wanted[failed].any(), f"fails where a window has no sample\n{case}"
    assert wanted[exact.low[:, 0] > 0].all(), f"positive and violated\n{case}"
    assert not wanted[exact.high[:, 0] < 0].any(), f"negative and satisfied\n{case}"
    still_open = monitor.check(case.signals, at=at, tolerance=0)["r"]
    certain = np.array(truth(case.formula, case.record("lower")))[judged]
    possible = np.array(truth(case.formula, case.record("upper")))[judged]
    holds, fails = still_open.holds[:, 0], still_open.fails[:, 0]
    if case.folds:  # a constant may decide what nobody knows
        assert (holds >= certain).all(), f"certainly\n{case}"
        assert (fails >= ~possible).all(), f"certainly not\n{case}"
        assert not (holds & fails).any(), f"both\n{case}"
    else:
        np.testing.assert_array_equal(holds, certain, err_msg=f"certainly\n{case}")
        np.testing.assert_array_equal(fails, ~possible, err_msg=f"certainly not\n{case}")
    lenient = monitor.check(case.signals, at=at, end="truncate")["r"]
    np.testing.assert_array_equal(lenient.holds, lenient.low >= -1e-6, err_msg=f"tolerance\n{case}")
    np.testing.assert_array_equal(lenient.fails, lenient.high < -1e-6, err_msg=f"tolerance\n{case}")


def check_clock(seed: int) -> None:
    """Absolute intervals anywhere: judged once, at the first sample, whatever stands around them."""
    taste = Taste(absolute=True, constants=False, bools=seed % 2 == 0, depth=3)
    case = Case(seed, taste, longest=30)
    monitor = case.monitor()
    cut, least, most = (robustness(case.formula, case.record(end))[0] for end in ENDS)
    case.same(monitor.robustness(case.signals, end="truncate", at=0), cut, "truncate")
    case.same(monitor.bounds(case.signals, at=0), (least, most), "bounds")
    strict = monitor.robustness(case.signals, at=0)
    case.same(strict, cut if defined(case.formula, case.rows) & 1 else math.nan, "strict")
    judged = monitor.check(case.signals)["r"]
    if judged.rule.absolute:
        case.same(judged.bounds, (least, most), "check")
        status = "satisfied" if least >= -1e-6 else "violated" if most < -1e-6 else "inconclusive"
        assert judged.overall == status, f"check says {judged.overall}\n{case}"


def check_windows(seed: int) -> None:
    """Formula in which `end` is the end of each planning window, where `T` and `end` are both meant."""
    case = Case(seed, Taste(windows=True, constants=False, bools=seed % 2 == 0, depth=3))
    monitor = case.monitor()
    (rule,) = monitor.compiled.requirements
    low, high = monitor.bounds(case.signals)
    found = {"lower": low, "upper": high, "truncate": monitor.robustness(case.signals, end="truncate")}
    for k in range(seed % 4, case.samples, 4):
        until = k + HORIZON + 1 if rule.windowed and rule.uses_end else None
        goes_on = until is not None and until > case.samples
        for end in ENDS:
            if goes_on and end != "truncate" and "sweep" in str(case):
                continue  # the last sample of a trace that goes on is not the end of a segment
            wanted = robustness(case.formula, case.record(end, until))[k]
            case.same(found[end][k], wanted, f"{end}, at {k}")
