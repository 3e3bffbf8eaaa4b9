"""Judged traces as a sample of independent observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stlc.assurance.certificate import Judged, Sample, together

if TYPE_CHECKING:
    from stlc.assurance.certificate import Assessment, Noun
    from stlc.cli.check.outcome import Checked, Outcome, VerdictRow


def sample_of_verdict(checked: Checked) -> Sample | None:
    """Sample of the traces of a file to which the specification applies; None if there are none.

    Traces of one deployment that were recorded with the same seed belong to one world; else each trace is
    independent of the others.
    """
    verdict = checked.verdict
    scope = verdict.requirements[0].scope
    inside = np.ones(verdict.traces, dtype=bool) if scope is None else scope
    if not inside.any():
        return None
    judged, weights = [], {}
    for each in verdict:
        statuses, least = np.array(each.statuses)[inside], each.low.min(axis=0)[inside]
        least = np.nan_to_num(least, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
        weights[each.name] = each.rule.factor
        judged.append(Judged(each.name, each.unit, statuses == "satisfied", statuses == "violated", least))
    seeds = checked.trace.extras.get("seed")
    units, noun = np.arange(int(inside.sum())), "trace"
    if seeds is not None and seeds.shape == (verdict.traces,):
        found, units = np.unique(seeds[inside], return_inverse=True)
        noun = "world" if len(found) < len(units) else "trace"
    named: Noun = "world" if noun == "world" else "trace"
    return Sample(together(judged, weights), tuple(judged), units, named)


def sample_of_rows(rows: Sequence[VerdictRow]) -> Sample | None:
    """Sample of a single trace that was judged in chunks; None if the specification does not apply to it."""
    if not rows or any(row.status == "out of scope" for row in rows):
        return None
    judged = [
        Judged(
            row.name,
            "",
            np.array([row.status == "satisfied"]),
            np.array([row.status == "violated"]),
            np.array([-np.inf if np.isnan(row.least) else row.least]),
        )
        for row in rows
    ]
    return Sample(together(judged), tuple(judged), np.zeros(1, dtype=np.int64), "trace")


def assess_outcomes(outcomes: Sequence[Outcome], share: float) -> Assessment | None:
    """Bounds from all judged files in their order; None if no trace is in scope.

    Raises:
        UsageError: U101, the files are judged by different requirements.
    """
    from stlc.assurance.certificate import Claim, assess, joined
    from stlc.diagnostics import usage

    samples = [outcome.sample for outcome in outcomes if outcome.sample is not None]
    if not samples:
        return None
    try:
        return assess(joined(samples), Claim(share))
    except ValueError as error:
        raise usage(f"`--certify`: {error}", "--spec SPEC judges all traces by one specification") from None
