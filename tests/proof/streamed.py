"""Checks of a stream on one case, sample by sample.

After every sample the bounds of all open starts are those of `Monitor.bounds` on what came so far, or where
windows run to the end of the trace those of the definition for a trace that may end with any sample. A
verdict is given with the first sample on which they decide it. At the end all is as `Monitor.check` has it,
whatever becomes of windows that the end cuts, and wherever a stream ends, its values are within all bounds
told before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from proof.cases import Case
from proof.draw import Taste
from proof.levels import robustness

from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import SpecError, TraceError
from stlc.monitor.instants import window_of
from stlc.monitor.online.online import How, Online
from stlc.monitor.verdict import Monitor

TASTES = (
    Taste(bools=True),
    Taste(windows=True, bools=True, depth=3),
    Taste(absolute=True, constants=False, bools=True, depth=3),
    Taste(plain=True, constants=False),
)
TOLERANCE = 1e-6
ENDINGS: tuple[Literal["open"], Literal["truncate"]] = ("open", "truncate")
ENDS: tuple[Literal["lower"], Literal["upper"]] = ("lower", "upper")


def drawn(seed: int, tastes: tuple[Taste, ...] = TASTES) -> tuple[Case, Monitor] | None:
    """A case; None where an absolute interval cannot be moved out of the operator around it."""
    case = Case(seed, tastes[seed % len(tastes)])
    try:
        return case, case.monitor()
    except SpecError:
        return None


def check_online(seed: int) -> bool:
    """Bounds and verdicts after each sample, and the end for all policies. Whether there was a case."""
    found = drawn(seed)
    if found is not None:
        check_stream(*found)
    return found is not None


def check_stream(case: Case, monitor: Monitor) -> None:
    (rule,) = monitor.compiled.requirements
    at: Literal["all"] | None = "all" if case.seed % 2 and (rule.windowed or not rule.uses_end) else None
    pushed = monitor.online(How(at=at))
    seen: dict[int, str] = {}
    before: dict[int, tuple[float, float]] = {}
    for k in range(case.samples):
        pushed.push({name: values[k] for name, values in case.signals.items()})
        known = {name: values[: k + 1] for name, values in case.signals.items()}
        bounds = so_far(case, monitor, rule, known, everywhere=pushed.requirement("r").everywhere)
        now = {start: (low, high) for start, low, high in pushed.open_starts("r")}
        for start, (low, high) in now.items():
            if bounds is not None:
                case.same((low, high), bounds[start], f"bounds at {start} after {k + 1}")
            least, most = before.get(start, (-np.inf, np.inf))
            assert least <= low + 1e-9, f"at {start} after {k + 1}\n{case}"
            assert high <= most + 1e-9, f"at {start} after {k + 1}\n{case}"
            before[start] = low, high
        for decision in pushed.verdicts():
            assert decision.start not in seen, case
            seen[decision.start] = decision.status
        for start, (low, high) in (bounds or now).items():
            status = "satisfied" if low >= -TOLERANCE else "violated" if high < -TOLERANCE else None
            assert seen.get(start) == status, f"decided at {start} after {k + 1}\n{case}"
    check_end(case, monitor, pushed, at)
    for end in ("truncate", "strict"):
        fed = monitor.online(How(at=at, end=end))
        cut = case.seed % case.samples
        for low, high in ((0, cut), (cut, case.samples)):
            if high > low:
                fed.feed({name: values[low:high] for name, values in case.signals.items()})
        check_end(case, monitor, fed, at)


def check_promise(seed: int) -> bool:
    """Wherever a stream ends: inside of all bounds, and as decided before. Whether there was a case."""
    found = drawn(seed)
    if found is not None:
        check_promises(*found, How(at="all" if seed % 2 else None, end=ENDINGS[seed // 8 % 2]))
    return found is not None


def check_promises(case: Case, monitor: Monitor, how: How) -> None:
    (rule,) = monitor.compiled.requirements
    if rule.uses_end and not rule.windowed:
        how = How(end=how.end)
    online = monitor.online(how)
    least: dict[int, float] = {}
    most: dict[int, float] = {}
    said: dict[int, str] = {}
    for k in range(case.samples):
        online.push({name: values[k] for name, values in case.signals.items()})
        for decision in online.verdicts():
            said[decision.start] = decision.status
        for start, low, high in online.open_starts("r"):
            least[start] = max(least.get(start, low), low)
            most[start] = min(most.get(start, high), high)
        known = {name: values[: k + 1] for name, values in case.signals.items()}
        final = monitor.check(known, at=how.at, end=how.end)["r"]
        for i in range(final.instants):
            about = f"{how.end}, at {i}, ends with {k}\n{case}"
            assert least.get(i, -np.inf) <= final.low[i, 0] + 1e-9, about
            assert final.high[i, 0] <= most.get(i, np.inf) + 1e-9, about
            if i in said:
                assert (final.holds if said[i] == "satisfied" else final.fails)[i, 0], about


def so_far(
    case: Case, monitor: Monitor, rule: CompiledRequirement, known: dict[str, Any], *, everywhere: bool
) -> dict[int, tuple[float, float]] | None:
    """Start -> bounds from what came so far, None where the definition says only less or something else."""
    if rule.uses_end and window_of(rule, monitor.compiled.grid.horizon) is None:
        if case.folds or "sweep" in str(case) or len(known["x"]) % 3 != case.seed % 3:
            return None
        least, most = (robustness(case.formula, case.growing(len(known["x"]), end))[0] for end in ENDS)
        return {0: (least, most)}
    low, high = monitor.bounds(known)
    return {k: (low[k], high[k]) for k in range(len(low) if everywhere else 1)}


def check_end(case: Case, monitor: Monitor, online: Online, at: Any) -> None:
    end = online.how.end
    wanted, tally = asked(lambda: monitor.check(case.signals, at=at, end=end)), asked(online.finish)
    if isinstance(wanted, str) or isinstance(tally, str):
        assert wanted == tally, case
        return
    case.same((tally.low, tally.high), wanted.bounds, f"{end}, at the end")
    found = (tally.status, tally.instants, tally.holds / tally.instants)
    assert found == (wanted.overall, wanted.instants, wanted.share), case


def asked(question: Callable[[], Any]) -> Any:
    """Statement about the requirement, or the reason why there is none."""
    try:
        return question()["r"]
    except TraceError as error:
        return str(error)
