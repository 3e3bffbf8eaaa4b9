"""The table of disturbed deployments, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

from stlc.bench.disturbed import NOMINAL, Row, disturbed_rows
from stlc.bench.results import WIDTH, commit_of, markdown
from stlc.controller.guard.margin_request import AUTO

_HEAD = """\
Written by `stlc bench disturbed` from `bench/disturbed.json`. Each policy is driven as it is and in worlds
that are not as its model says (the scenarios of every system), from the same starts: without a guard, with
the paper's backup policy, with the full guard, and with a full guard that asks safety requirements for the
margin that is measured there (`--margin auto`). `safe agents` is the share of the agents that can be saved
which were safe all the time, `safe starts` the share of their instants from which what was driven was safe
through the window, `satisfied` that of all instants from which it satisfied the specification. Means over
deployment seeds with half of their 95 % intervals (Student's t).
"""
_QUIET = """\
Where agents are driven unsafely though the model is right and the full guard acts, the world does what no
plan foresees. Of the starts through whose window it did nothing but what the truth of the dynamics does:
"""
MOST = 0.95
"""Share of safe starts below which a world is to blame where the model is right."""
_TITLES = {"none": "no guard", "paper": "paper's", "full": "full"}
_TRAINED = (("accuracy", 3), ("seconds", 0))
COLUMNS = {"safe agents": "saved", "safe starts": "saved_starts", "satisfied": "executed_starts"}
"""What the table shows of each guard."""


def disturbed_section(documents: Sequence[Mapping[str, Any]]) -> str:
    """A table of all deployments, and what they were made with."""
    rows = disturbed_rows(documents)
    guards = sorted({guard for row in rows for guard in row.guards}, key=_order)
    header = ("", "scenario", *(f"{what}, {_title(guard)}" for what in COLUMNS for guard in guards))
    lines = [_HEAD]
    cells, last = [], ""
    for row in rows:
        metrics = (row.metric(guard, name) for name in COLUMNS.values() for guard in guards)
        first = "" if row.spec == last else f"{row.spec}, {_size(row)}"
        cells.append((first, row.scenario, *map(spread, metrics)))
        last = row.spec
    lines += [*markdown(header, cells), "", *_quiet_table(rows, guards)]
    policies = dict.fromkeys(policy_line(each) for row in rows for each in row.guards.values())
    return "\n".join([*lines, *policies, *made(documents)])


def _quiet_table(rows: Sequence[Row], guards: Sequence[str]) -> list[str]:
    """Safe starts without what no plan foresees, where that matters: lines, the last one empty."""
    loud = [row.spec for row in rows if row.scenario == NOMINAL and _lost_to_the_world(row)]
    cells = []
    for row in rows:
        if row.spec in loud:
            share = row.metric("none", "quiet")
            metrics = (row.metric(guard, "quiet_safe_starts") for guard in guards)
            cells.append((row.spec, row.scenario, *map(spread, (share, *metrics))))
    if not cells:
        return []
    header = ("", "scenario", "share of starts", *(f"safe, {_title(guard)}" for guard in guards))
    return [_QUIET, *markdown(header, cells), ""]


def _lost_to_the_world(row: Row) -> bool:
    """Whether the world makes what was driven unsafe: the model is right, and the full guard acts."""
    every, quiet = row.metric("full", "saved_starts"), row.metric("full", "quiet_safe_starts")
    return every is not None and quiet is not None and float(every["mean"]) < min(float(quiet["mean"]), MOST)


def policy_line(document: Mapping[str, Any]) -> str:
    """How the policy of a deployment was trained, as a line."""
    known = document["policy"]
    trained = [f"{known[name]:.{digits}f}" if known[name] is not None else "?" for name, digits in _TRAINED]
    method, (accuracy, seconds) = known["method"] or "?", trained
    told = f"method {method}, seed {known['seed']}, {seconds} s of training"
    return f"- {document['spec']}: run {document['run']}, {told}, plan accuracy {accuracy} on held-out starts"


def _order(guard: str) -> tuple[int, str]:
    mode, _, margin = guard.partition("+")
    return [*_TITLES].index(mode), margin


def _title(guard: str) -> str:
    mode, _, margin = guard.partition("+")
    spared = "margin" if margin == AUTO else f"{margin} to spare"
    return _TITLES[mode] + (f" with {spared}" if margin else "")


def _size(row: Row) -> str:
    return " x ".join(map(str, row.size))


def spread(metric: Mapping[str, Any] | None) -> str:
    """A mean and half its interval: `.957 ± .012`; empty where there is none."""
    if metric is None:
        return ""
    mean, high = float(metric["mean"]), metric["high"]
    text = f"{mean:.3f}" if high is None else f"{mean:.3f} ± {float(high) - mean:.3f}"
    return re.sub(r"\b0\.", ".", text)


def made(documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for every machine and version, with commits and dates."""
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for each in documents:
        machine, known = each["hardware"], each["versions"]
        processor = f"{machine.get('processor') or machine.get('machine')}, {machine.get('cores')} cores"
        groups.setdefault((processor, f"torch {known.get('torch')}"), []).append(each)
    lines = []
    for key, group in groups.items():
        dates = sorted({str(each["date"])[:10] for each in group})
        commits = ", ".join(f"`{commit}`" for commit in sorted({commit_of(each) for each in group}))
        when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        line = f"- {len(group)} deployments (seeds x agents x steps) on {', '.join(key)}; {when}; {commits}"
        lines += wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return lines
