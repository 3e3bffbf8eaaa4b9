"""Verdicts on streams: on samples that come one by one, and on files that are read in pieces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.monitor.facts.requirements import part_facts
from stlc.monitor.facts.rules import unsilenced
from stlc.monitor.judgement import About, Counts, RequirementVerdict, Verdict, overall_robustness
from stlc.monitor.prepared import Part, Timeline
from stlc.trace.resample import TimeRange

if TYPE_CHECKING:
    from stlc.monitor.online.online import Decision, Online
    from stlc.trace.live import Samples, Uniform
    from stlc.trace.recording import Conversion

CLOCK = "t"


def verdict_of(online: Online, name: str = "the stream") -> Verdict:
    """End the monitoring of a stream, and return the verdict on it, which is told.

    `online` has received all samples. The shares of instants at which all requirements hold, and at which one
    is violated, are bounds.

    Raises:
        TraceError: E306, the trace is too short and `end` is "strict"; E605, there is no sample.
    """
    tallies, compiled, samples = online.finish(), online.compiled, online.samples
    dt = None if compiled.grid.dt is None else float(compiled.grid.dt)
    timeline = Timeline(dt, online.time(0), TimeRange(online.time(0), online.time(samples - 1)))
    scope = np.zeros(1, dtype=np.bool_) if online.in_scope is False else None
    rows = []
    for rule, tally in ((online.requirement(name).rule, tally) for name, tally in tallies.items()):
        low, high = (np.array([[value]]) for value in (tally.low, tally.high))
        held, failed = (np.array([[tally.status == word]]) for word in ("satisfied", "violated"))
        seen = (np.array([each]) for each in (tally.holds, tally.fails, tally.low_at, tally.high_at))
        made = RequirementVerdict(
            *(rule, tally.first, low, high, held, failed, (), Part(0, samples), timeline),
            tolerance=online.how.tolerance,
            scope=scope,
            counts=Counts(tally.instants, *seen),
        )
        cause = online.cause(rule.name) if made.overall == "violated" else None
        told = replace(made, facts=tuple(unsilenced(list(part_facts(made)))))
        rows.append(told.knowing(None if cause is None else cause.told()))
    source, step = compiled.spec.source, compiled.grid.horizon
    about = About(name, "", "", source, compiled.name, samples, (), dt, step, warnings=compiled.warnings)
    return Verdict(tuple(rows), about, online.how.end, streamed=True).knowing(
        facts=tuple(fact for row in rows for fact in row.facts),
        gaps=dict(online.gaps),
        share=min(row.share for row in rows),
        failed_share=max(float(row.failed[0]) / max(row.instants, 1) for row in rows),
        robustness=overall_robustness(rows, ()),
    )


def watched(
    online: Online,
    uniform: Uniform,
    units: Mapping[str, str],
    name: str,
    tell: Callable[[Decision, Online], object] | None = None,
) -> Verdict:
    """Judge samples as they come, and return the verdict when they end.

    Args:
        online: the monitor.
        uniform: the samples, on a grid.
        units: units of the recorded signals.
        name: name of the stream.
        tell: function that is told each verdict on an instant as soon as it is decided, and the monitor.

    Raises:
        TraceError: a sample lacks a signal, or a value or unit does not fit.
    """
    from stlc.trace.recording import conversion, unit_of

    # conversions from the recorded units to the declared ones
    columns = [column for column in online.compiled.signature.columns if column.name in units]
    recorded = {column: unit_of(name, column.name, units[column.name]) for column in columns}
    converted = {column.name: conversion(name, column, unit) for column, unit in recorded.items()}
    changes = {signal: change for signal, change in converted.items() if change is not None}
    for samples in uniform.samples:
        try:
            rows = _rows(samples, changes, online)
        except TraceError as error:
            where = f"sample {online.samples} of the {name}"
            raise TraceError(*(finding.with_note(where) for finding in error.diagnostics)) from None
        while len(rows):
            decided, taken = online.push_block(rows, pause=tell is not None)
            rows = rows[taken:]
            if decided and tell is not None:
                for decision in online.verdicts():
                    tell(decision, online)
    found = verdict_of(online, name)
    if not (aside := uniform.aside()):
        return found
    message = f"samples of the {name} between the instants of the grid are not judged: {aside:,}"
    finding = Diagnostic("W305", message, help=("stlc check SPEC FILE  judges every sample of a recording",))
    return found.but(about=replace(found.about, warnings=(finding, *found.about.warnings)))


def _rows(samples: Samples, changes: Mapping[str, Conversion], online: Online) -> NDArray[np.float64]:
    """Return samples as rows, (samples, signals), in the units that the specification declares.

    `changes` maps the name of a signal to the function that converts its values. If the samples have no
    signal `t`, it is their time, which follows from the time step and the number of samples before.
    """
    begin, found = online.samples, dict(samples.columns)
    if CLOCK in online.signals or not found:
        found = {CLOCK: np.array([online.time(begin + k) for k in range(samples.count)]), **found}
    found |= {name: change(found[name]) for name, change in changes.items() if name in found}
    if online.signals and found.keys() >= {*online.signals}:
        return np.stack([found[name] for name in online.signals], axis=1)
    return online.rows(found)
