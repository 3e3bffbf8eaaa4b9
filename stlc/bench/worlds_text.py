"""The table of policies in their worlds, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from textwrap import wrap
from typing import Any

from stlc.bench.disturbed import Row, disturbed_rows
from stlc.bench.disturbed_text import made, policy_line, spread
from stlc.bench.results import WIDTH, markdown

FILE = "worlds.json"
HEADER = (
    *("", "guard", "plan accuracy", "of what can be", "plans that are safe", "driven safely, of the savable"),
    *("safe starts, as foreseen", "progress"),
)
_HEAD = """\
Written by `stlc bench worlds` from `bench/worlds.json`: one policy for each specification, the most accurate
of `stlc bench paper`, in its world. `of what can be` is the share of visited states with a satisfying plan,
the followed one or one that a search of up to 80,000 plans finds, whose followed plan satisfies the
specification. `savable` agents were driven safely, or a search finds a plan from their start that is safe
through the horizon. `as foreseen` are starts from which the world did as the model says through the window;
some worlds never do. Means over deployment seeds with half of their 95 % intervals (Student's t).
"""
_SHARES = ("plan_accuracy", "feasible_followed", "plan_safety", "saved", "foreseen_safe_starts")


def worlds_section(documents: Sequence[Mapping[str, Any]]) -> str:
    """A table of all deployments, what it hides, and what they were made with."""
    rows = disturbed_rows(documents)
    cells = [line for row in rows for line in table_lines(row)]
    told = [line for row in rows for line in wholly_savable(row)]
    policies = dict.fromkeys(policy_line(each) for row in rows for each in row.guards.values())
    parts = [_HEAD, *markdown(HEADER, cells), "", *told, *policies, *made(documents)]
    return "\n".join(parts)


def table_lines(row: Row) -> Iterator[tuple[str, ...]]:
    """A line for every guard; the first one names the deployment and its seeds x agents x steps."""
    size = " x ".join(map(str, row.size))
    named = f"{row.spec}, {row.scenario}, {size}"
    for guard, document in row.guards.items():
        shares = (spread(row.metric(guard, name)) for name in _SHARES)
        yield (named, guard, *shares, _progress(document))
        named = ""


def _progress(document: Mapping[str, Any]) -> str:
    """What the world tells, means alone: `mean speed 4.28, junctions passed 76`."""
    told = document["progress"].items()
    return ", ".join(f"{name.replace('_', ' ')} {float(metric['mean']):.3g}" for name, metric in told)


def wholly_savable(row: Row) -> Iterator[str]:
    """Where some starts are lost: the seeds in which none is."""
    first = next(iter(row.guards.values()))["metrics"].get("savable") or {"values": ()}
    whole = [index for index, share in enumerate(first["values"]) if share == 1.0]
    if not whole or len(whole) == len(first["values"]):
        return
    parts = []
    for guard, document in row.guards.items():
        accuracy, saved = (document["metrics"][name]["values"] for name in ("plan_accuracy", "saved"))
        chosen = [fmean(values[index] for index in whole) for values in (accuracy, saved)]
        parts.append(f"{guard} {chosen[0]:.3f} and {chosen[1]:.3f}")
    where = f"in the {len(whole)} of {len(first['values'])} seeds in which every start can be saved"
    figures = "; ".join(parts)
    line = f"- {row.spec}, {row.scenario}: {where}, plan accuracy and share driven safely: {figures}"
    yield from wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
