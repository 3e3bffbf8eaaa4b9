"""The table of disturbed deployments, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

from stlc.bench.disturbed import Row, disturbed_rows
from stlc.bench.results import WIDTH, commit_of, markdown

_HEAD = """\
Written by `stlc bench disturbed` from `bench/disturbed.json`. Each policy is driven as it is and in worlds
that are not as its model says (the scenarios of every system), from the same starts, without a guard, with
the paper's backup policy and with the full guard. `safe` is the share of the agents that can be saved which
were driven safely, `satisfied` the share of starts from which what was driven satisfies the specification.
Means over deployment seeds with half of their 95 % intervals (Student's t; of few seeds they are wide).
"""
_TITLES = {"none": "no guard", "paper": "paper's", "full": "full"}
_TRAINED = (("accuracy", 3), ("seconds", 0))
_COLUMNS = {"safe": "saved", "satisfied": "executed_starts"}


def disturbed_section(documents: Sequence[Mapping[str, Any]]) -> str:
    """A table of all deployments, and what they were made with."""
    rows = disturbed_rows(documents)
    guards = sorted({guard for row in rows for guard in row.guards}, key=_order)
    header = ("", "scenario", *(f"{what}, {_title(guard)}" for what in _COLUMNS for guard in guards))
    lines = [_HEAD]
    cells, last = [], ""
    for row in rows:
        metrics = (row.metric(guard, name) for name in _COLUMNS.values() for guard in guards)
        first = "" if row.spec == last else f"{row.spec}, {_size(row)}"
        cells.append((first, row.scenario, *map(spread, metrics)))
        last = row.spec
    policies = dict.fromkeys(policy_line(each) for row in rows for each in row.guards.values())
    return "\n".join([*lines, *markdown(header, cells), "", *policies, *made(documents)])


def policy_line(document: Mapping[str, Any]) -> str:
    """How the policy of a deployment was trained, as a line."""
    known = document["policy"]
    trained = [f"{known[name]:.{digits}f}" if known[name] is not None else "?" for name, digits in _TRAINED]
    method, (accuracy, seconds) = known["method"] or "?", trained
    told = f"method {method}, seed {known['seed']}, {seconds} s of training"
    return f"- {document['spec']}: run {document['run']}, {told}, plan accuracy {accuracy} on held-out starts"


def _order(guard: str) -> tuple[int, float]:
    mode, _, margin = guard.partition("+")
    return [*_TITLES].index(mode), float(margin or 0)


def _title(guard: str) -> str:
    mode, _, margin = guard.partition("+")
    return _TITLES[mode] + (f", {margin} to spare" if margin else "")


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
