"""Numbers and names formatted as text for readers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from stlc.controller.guard.kind import named_guard
from stlc.registry import GUARDS


def share(value: float | None, digits: int = 1) -> str:
    """Format a share: 0.957 is `95.7 %`, None is "".

    A share below 1 is never rounded to 100 %, and a share above 0 is never rounded to 0 %.
    """
    if value is None:
        return ""
    while digits < 4 and 0 < value < 1 and round(100 * value, digits) in (0, 100):
        digits += 1
    return f"{100 * value:.{digits}f} %"


def interval(ends: Sequence[float] | None) -> str:
    """Format an interval of shares: (0.951, 0.962) as `95.1 to 96.2 %`."""
    return "" if not ends else f"{100 * ends[0]:.1f} to {100 * ends[1]:.1f} %"


def number(value: float | None, unit: str = "") -> str:
    """Format a number with three significant digits, grouped thousands, and its unit."""
    if value is None:
        return ""
    text = f"{value:,.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.3g}"
    return f"{text} {unit}".rstrip()


def spread(mean: float, half: float | None) -> tuple[str, str]:
    """Format a mean and the half-width of its interval, as two texts.

    The half-width has two significant digits, and the mean has as many decimals as the half-width.
    """
    if not half:
        return number(mean), "" if half is None else "0"
    decimals = max(0, 1 - math.floor(math.log10(float(f"{half:.1e}"))))
    return f"{mean:,.{decimals}f}", f"{half:,.{decimals}f}"


def seconds(value: float | None) -> str:
    """Format a duration: `0.7 ms`, `61 s`, `5 min 12 s`."""
    if value is None:
        return ""
    if value < 1:
        return f"{1000 * value:.3g} ms"
    if value < 120:
        return f"{value:.3g} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes} min {rest} s" if rest else f"{minutes} min"


def listing(names: Sequence[str]) -> str:
    """Join names, of which the first 12 are shown, and the others are counted."""
    more = len(names) - 12
    return ", ".join(names[:12]) + (f" and {more:,} more" if more > 0 else "")


def labelled(name: str, unit: str) -> str:
    """Format a name with its unit, `v [m/s]`, for axes; only the name if there is no unit."""
    return f"{name} [{unit}]" if unit not in ("", "1") else name


def count(many: int, what: str) -> str:
    """Format a number of things: `1 trace`, `20 traces`."""
    return f"{many:,} {what}{'' if many == 1 else 's'}"


def drives_of(simulation: Mapping[str, Any] | None) -> dict[str, Mapping[str, Any]]:
    """Return the results of the drives under each guard, from `eval/simulate.json`: guard -> results.

    A drive is the closed-loop run of one agent with one seed. The mapping is empty if the file is too old.
    """
    guards = (simulation or {}).get("guards")
    each = guards.items() if isinstance(guards, Mapping) else ()
    found = {name: guard.get("drives") for name, guard in each if isinstance(guard, Mapping)}
    return {name: drives for name, drives in found.items() if isinstance(drives, Mapping)}


def satisfied_sentence(simulation: Mapping[str, Any]) -> str:
    """Sentence `198 of 200 drives satisfied driving_rules; without the guard 150`, from `eval/simulate.json`.

    A drive is the closed-loop run of one agent with one seed, in the scenario that the sentence names. It is
    judged by the separate specification for drives. If there is none, the sentence counts the drives that
    satisfy, from every instant on, the specification of the plans. It is "" if the file contains no drives.
    """
    each = drives_of(simulation)
    if not each:
        return ""
    name, drives = list(each.items())[-1]
    judge, scenario = simulation.get("judge"), simulation.get("scenario")
    what = judge["spec"] if judge else f"{simulation['spec']} at every instant"
    words = f"{drives['obeyed']:,} of {count(drives['count'], 'drive')} satisfied {what}"
    if scenario:
        words = f"In scenario {scenario}, {words}"
    if drives["undecided"]:
        words += f", {drives['undecided']:,} ended too early to say"
    if named_guard(name).intervenes and GUARDS.default in each:
        words += f"; without the guard {each[GUARDS.default]['obeyed']:,}"
    return words


CAUSES = {
    "told": "lost at {}, by an exogenous event after which no plan is known",
    "later": "no plan is known from {} on, although the plan followed until then satisfied",
    "missed": "a plan is known at {}, but another plan was followed",
    "near": "the best plans known from {} on miss by little",
    "rules": "the plans followed until {} satisfied their specification",
}
"""Causes of a violation, from `stlc.controller.evaluation.causes.Lost`."""


def viable_sentence(simulation: Mapping[str, Any]) -> str:
    """Sentence with the number of lost drives, and with the number of others that satisfied the requirements.

    A drive is the closed-loop run of one agent with one seed. A drive is lost if no satisfying plan is known
    from its start, or after an exogenous event. The sentence is "" if no drive was lost.
    """
    each = list(drives_of(simulation).values())
    if not each or not each[-1]["lost"]:
        return ""
    drives, later = each[-1], each[-1].get("told", 0)
    start, parts = drives["lost"] - later, []
    if start:
        were = "was" if start == 1 else "were"
        parts.append(f"{count(start, 'drive')} {were} lost from the start, where no plan is known")
    if later:
        number = f"{later:,}" if parts else count(later, "drive")
        were = "was" if later == 1 else "were"
        parts.append(f"{number} {were} lost by an exogenous event after which no plan is known")
    others = drives["count"] - drives["lost"]
    return f"{', and '.join(parts)}: {drives['obeyed']} of the {others} others satisfied it"


def cause_words(broken: Mapping[str, Any]) -> str:
    """Text with the reason why a drive violated a rule; "" if it is unknown.

    A drive is the closed-loop run of one agent with one seed. `broken` is an entry of the list `broken` in
    `eval/simulate.json`.
    """
    cause = broken.get("cause") or {"why": "start" if broken["lost"] else ""}
    if cause["why"] in ("start", ""):
        return "lost from its start" if cause["why"] else ""
    return CAUSES.get(cause["why"], "").format(f"{cause['time']:.3g} s")
