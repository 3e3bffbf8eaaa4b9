"""Report sections on closed-loop runs: metrics and decisions with and without a guard."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from stlc.controller.evaluation.metrics import HOLDS, METRICS, is_progress
from stlc.controller.guard.kind import named_guard
from stlc.view.contents import RunContents
from stlc.view.html import Child, Html, Section, classed, el, join, table
from stlc.view.words import cause_words, count, drives_of, seconds, share, spread

Record = Mapping[str, Any]

MOST_BROKEN = 12
"""Maximum number of listed runs that violated rules."""
WINDOWS = "Planning windows: how the plans, and the drives from every start, are judged"
"""Title of what is folded away, because its numbers are not those of drives."""
SOURCES = ("policy", "polished", "backup", "safest", "")


def deployment_tiles(contents: RunContents) -> list[tuple[str, str]]:
    """Key figures of the closed-loop runs for the head of the report: (name, value) pairs."""
    return [
        (f"{drives['obeyed']:,} of {drives['count']:,}", f"drives satisfied {named_guard(each).beside}")
        for each, drives in reversed(drives_of(contents.simulation).items())
    ]


def deployment_section(contents: RunContents) -> Section | None:
    """Section with tables of metrics (one column per guard), sources of decisions, and decision times.

    None without closed-loop results.
    """
    simulation = contents.simulation or {}
    guards = simulation.get("guards")
    if not guards or not isinstance(guards, Mapping):
        return None
    seeds, agents, steps = simulation.get("seeds") or (), simulation.get("agents"), simulation.get("steps")
    size = f"{count(len(seeds), 'seed')} of {count(agents or 0, 'agent')}, {count(steps or 0, 'step')} each"
    interval = str(simulation.get("interval") or "").replace(" %", "\N{NO-BREAK SPACE}%")
    size += f". Means over the seeds with their interval ({interval})." if interval else "."
    names = _names(guards)
    body = join(
        el("p", size),
        _compared("", guards, _drive_rows(guards)),
        _broken(contents.simulation),
        _compared(
            "Progress",
            guards,
            [(name.replace("_", " "), *_number_cells(guards, name)) for name in filter(is_progress, names)],
        ),
        _compared("Decisions", guards, _decision_rows(guards)),
        el(
            "details",
            el("summary", WINDOWS),
            _compared("", guards, _share_rows(guards)),
            _model_gap(guards),
            _compared(
                "Requirements at each start",
                guards,
                [
                    (name.removeprefix(HOLDS), *_cells(guards, name, _share_cell))
                    for name in names
                    if name.startswith(HOLDS)
                ],
            ),
        ),
    )
    return Section("deployment", "Drives", body)


def _compared(title: str, guards: Mapping[str, Record], rows: list[tuple[Child, ...]]) -> Html | None:
    """Table `rows` with one column per guard, below the heading `title`; None if there are no rows."""
    if not rows:
        return None
    header = ["", *(named_guard(name).title for name in guards)]
    compared = table(header, rows, numeric=range(1, len(header)), kind="compare")
    return join(el("h3", title), compared) if title else compared


def _model_gap(guards: Mapping[str, Record]) -> Html | None:
    """Paragraph on how often the world (simulated environment) behaved as the model predicts.

    It gives the share of instants from which this was so for the length of a whole plan. The result is None
    if it was always so, or if this was not recorded.
    """
    consistent = _mean(list(guards.values())[-1].get("metrics") or {}, "foreseen")
    if consistent is None or consistent >= 1.0:
        return None
    starts = f"from {share(consistent)} of the starts" if consistent else "from no start"
    return el(
        "p",
        "Plans are judged by the model's prediction, drives by what happened. The world followed the model "
        f"through the whole window {starts}; elsewhere it did what no plan could know.",
    )


def _mean(metrics: Record, name: str) -> float | None:
    found = metrics.get(name)
    return float(found["mean"]) if found else None


def _drive_rows(guards: Mapping[str, Record]) -> list[tuple[Child, ...]]:
    """Table rows: how many closed-loop runs satisfied all rules, the safety rules, and each single rule.

    A run is lost if no satisfying plan is known from its start, or from its state after an exogenous event.
    If any runs are lost, a second row counts the runs that satisfied all rules among those that are not lost.
    """
    each = [drives_of({"guards": {name: guard}}).get(name) for name, guard in guards.items()]
    known = [drives for drives in each if drives is not None]
    if not known:
        return []

    def row(label: Child, counts: Iterable[tuple[int, int] | None]) -> tuple[Child, ...]:
        return label, *(None if each is None else f"{each[0]:,} of {each[1]:,}" for each in counts)

    meaning = el("small", "a drive is one agent over one seed, judged from its first instant to its last")
    label = join("satisfied", meaning)
    rows = [row(label, [None if d is None else (d["obeyed"], d["count"]) for d in each])]
    if any(drives["lost"] for drives in known):
        others = el("small", "without drives from whose start, or after an exogenous event, no plan is known")
        label = join("of those that were not lost", others)
        rows.append(row(label, [None if d is None else (d["obeyed"], d["count"] - d["lost"]) for d in each]))
    if any(drives.get("safe") is not None for drives in known):
        label = join("safe", el("small", "all requirements tagged @safety"))
        safe = [None if d is None or d.get("safe") is None else (d["safe"], d["count"]) for d in each]
        rows.append(row(label, safe))
    for rule in known[-1]["rules"]:
        found = [None if d is None else d["rules"].get(rule) for d in each]
        rows.append(row(rule, [None if r is None else (r["obeyed"], sum(r.values())) for r in found]))
    return rows


def _broken(simulation: Record | None) -> Html | None:
    """Table of the closed-loop runs that violated a rule; None if there are none.

    It shows the runs under the guard that is listed last.
    """
    each = drives_of(simulation)
    guard = next(reversed(each), "")
    broken = each[guard]["broken"] if each else []
    if not broken:
        return None
    rows: list[tuple[Child, ...]] = []
    for drive in sorted(broken, key=lambda each: bool(each["lost"]))[:MOST_BROKEN]:
        rules = ", ".join(
            name if time is None else f"{name} ({time:.3g} s)" for name, time in drive["rules"].items()
        )
        rows.append((f"seed {drive['seed']}, agent {drive['agent']}", rules, cause_words(drive)))
    more = len(broken) - MOST_BROKEN
    note = el("p", f"{more} more are in eval/simulate.json.") if more > 0 else None
    title = f"Drives that violate a requirement, {named_guard(guard).beside}"
    return join(el("h3", title), table(("drive", "violated", "why"), rows), note)


def _names(guards: Mapping[str, Record]) -> list[str]:
    """Names of all metrics, in order of first occurrence among the guards."""
    return list(dict.fromkeys(name for guard in guards.values() for name in guard.get("metrics") or {}))


def _share_rows(guards: Mapping[str, Record]) -> list[tuple[Child, ...]]:
    return [
        (join(metric.label, el("small", metric.meaning)), *_cells(guards, metric.key, _share_cell))
        for metric in METRICS.values()
        if metric.key in _names(guards)
        and (
            metric.key != "foreseen"
            or any(_mean(guard.get("metrics") or {}, metric.key) for guard in guards.values())
        )
    ]


def _cells(guards: Mapping[str, Record], name: str, cell: Callable[[Record | None], Child]) -> list[Child]:
    return [cell((guard.get("metrics") or {}).get(name)) for guard in guards.values()]


def _share_cell(metric: Record | None) -> Child:
    if metric is None:
        return ""
    half = _half(metric)
    mean = classed("span", "whole", share(metric["mean"]))
    return mean if half is None else join(mean, " ", classed("span", "quiet whole", f"± {100 * half:.1f}"))


def _number_cells(guards: Mapping[str, Record], name: str) -> Iterator[Child]:
    for guard in guards.values():
        metric, unit = (guard.get("metrics") or {}).get(name), str((guard.get("units") or {}).get(name, ""))
        if metric is None:
            yield ""
            continue
        mean, half = spread(metric["mean"], _half(metric))
        more = [classed("span", "quiet", f"± {half} ")] if half else []
        yield join(f"{mean} ", classed("span", "whole", *more, unit)) if more or unit else mean


def _half(metric: Record) -> float | None:
    return None if metric.get("high") is None else float(metric["high"]) - float(metric["mean"])


def _decision_rows(guards: Mapping[str, Record]) -> list[tuple[Child, ...]]:
    names = list(dict.fromkeys(name for guard in guards.values() for name in guard.get("decisions") or {}))
    names.sort(key=lambda name: next(i for i, prefix in enumerate(SOURCES) if name.startswith(prefix)))
    rows: list[tuple[Child, ...]] = []
    for name in names:
        shares = [(guard.get("decisions") or {}).get(name) for guard in guards.values()]
        if not any(shares):
            continue  # a rule that was inconclusive in all runs
        rows.append((_decided(name), *(share(value, 2) for value in shares)))
    latencies = [guard.get("latency") or {} for guard in guards.values()]
    for key, label in (("median", "time for one decision, median"), ("p99", "99th percentile")):
        rows.append((label, *(seconds(latency.get(key)) for latency in latencies)))
    return rows


def _decided(name: str) -> Child:
    words = {
        "policy": "the policy decided",
        "polished": "a repaired plan was followed",
        "backup": "the backup decided",
        "safest": "the safest prefix was followed",
    }
    if name.startswith("backup "):
        return classed("span", "quiet", f"of which {name.removeprefix('backup ')}")
    return words.get(name, name)
