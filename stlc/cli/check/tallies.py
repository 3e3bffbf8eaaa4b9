"""What a monitor of samples says at the end of a stream or of a trace that was read in pieces."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stlc.cli.check.document import cause_entry, gap_entry
from stlc.cli.check.outcome import WORDS, Outcome, Row
from stlc.cli.check.text import in_unit, percent, signed
from stlc.cli.framework.output import table
from stlc.cli.framework.render import render_place
from stlc.compile.ir.support import columns
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.escape import visible
from stlc.monitor.prepared import beside, gap_text
from stlc.source import Source

if TYPE_CHECKING:
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.judgement import Status
    from stlc.monitor.online.online import Online
    from stlc.monitor.online.tally import Tally


@dataclass(frozen=True, slots=True)
class Told:
    """What was judged.

    Attributes:
        name: of the trace.
        source: text of the specification.
        dt: time step in seconds.
        samples: how many there were.
        color: reasons are printed in colours.
    """

    name: str
    source: Source
    dt: float
    samples: int
    color: bool = False


def outcome_of_tallies(online: Online, told: Told, said: tuple[str, ...], seconds: float) -> Outcome:
    """The outcome of a stream that is over. Raises TraceError as `Online.finish`."""
    tallies = online.finish()
    status = status_of(online, tallies)
    causes = {
        name: cause
        for name, tally in tallies.items()
        if tally.status == "violated" and (cause := online.cause(name)) is not None
    }
    rows = tuple(_row(name, tally, online, causes.get(name)) for name, tally in tallies.items())
    counts = [tally.instants for tally in tallies.values()]
    most = max(tallies.values(), key=lambda tally: tally.instants)
    return Outcome(
        name=told.name,
        status=status,
        rows=rows,
        text="\n".join([*_text(told, online, rows, tallies, causes), "", WORDS[status].lower()]),
        entry=_entry(told, online, tallies, status)
        | {"requirements": _requirements(online, tallies, causes)},
        traces=0 if status == "out of scope" else 1,
        holds=min(tally.share for tally in tallies.values()) if counts else 0.0,
        fails=max(tally.fails / max(tally.instants, 1) for tally in tallies.values()) if most else 0.0,
        seconds=seconds,
        warnings=online.compiled.warnings,
        said=said,
    )


def status_of(online: Online, tallies: Mapping[str, Tally]) -> Status:
    """Over all requirements."""
    if online.in_scope is False:
        return "out of scope"
    found = {tally.status for tally in tallies.values()}
    return "violated" if "violated" in found else "satisfied" if found == {"satisfied"} else "inconclusive"


def robustness_text(tally: Tally, unit: str) -> str:
    """The least robustness, or its bounds."""
    if tally.status == "inconclusive":
        return in_unit(f"[{signed(tally.low)}, {signed(tally.high)}]", unit)
    near = abs(tally.robustness) <= TOLERANCE
    return "boundary" if near else in_unit(signed(tally.robustness), unit)


def _row(name: str, tally: Tally, online: Online, cause: Cause | None) -> Row:
    where = f"from t = {online.time(tally.worst):.10g} s" if tally.instants > 1 else ""
    unit = online.rule(name).unit or ("" if cause is None else cause.unit)
    value = robustness_text(tally, unit)
    if cause is not None:
        start = online.time(tally.worst) if tally.instants > 1 else cause.time
        where = beside(f"t = {cause.time:.10g} s", f"t = {start:.10g} s")
        return Row(name, tally.status, value, where, cause.because)
    if tally.status == "satisfied":
        return Row(name, tally.status, value, where)
    if tally.status == "violated":
        why = f"violated at {tally.fails:,} of {tally.instants:,} starts"
    else:
        read = columns(online.rule(name).formula)
        gaps = [text for signal, text in _gap_texts(online).items() if signal in read]
        why = ", ".join(gaps) or "the trace is too short to say"
    return Row(name, tally.status, value, where, why)


def _gap_texts(online: Online) -> dict[str, str]:
    """Samples that are unknown, a line a signal."""
    return {
        name: gap_text(name, gap, online.samples, (_moment(online, gap.first), _moment(online, gap.last)))
        for name, gap in online.gaps.items()
    }


def _moment(online: Online, sample: int) -> str:
    return f"t = {online.time(sample):.10g} s"


def _text(
    told: Told,
    online: Online,
    rows: tuple[Row, ...],
    tallies: Mapping[str, Tally],
    causes: Mapping[str, Cause],
) -> Iterator[str]:
    head = f"{visible(told.source.name)} on {visible(told.name)}"
    yield f"{head}    1 trace x {told.samples} samples, dt {told.dt:g} s"
    yield ""
    columns = ("requirement", "verdict", "robustness", "starts", "where")
    lines = [
        (row.name, WORDS[row.status], row.robustness, _share(tallies[row.name]), row.where) for row in rows
    ]
    yield table(lines, header=columns)
    for gap in _gap_texts(online).values():
        yield f"  {gap}"
    for row in rows:
        if row.status == "inconclusive":
            yield ""
            yield f"{visible(row.name)} is inconclusive: {row.why}."
    for name, cause in causes.items():
        yield ""
        yield _violation(name, tallies[name], cause, color=told.color)


def _violation(name: str, tally: Tally, cause: Cause, *, color: bool) -> str:
    count = f", at {tally.fails:,} of {tally.instants:,} starts" if tally.instants > 1 else ""
    place = render_place(cause.place, cause.labels, [("because", cause.because)], color=color)
    return f"{visible(name)} is violated{count}.\n{place}".rstrip("\n")


def _share(tally: Tally) -> str:
    return "" if tally.instants == 1 else percent(tally.share)


def _entry(told: Told, online: Online, tallies: Mapping[str, Tally], status: Status) -> dict[str, Any]:
    horizon = online.compiled.grid.horizon
    known = [tally.robustness for tally in tallies.values()]
    return {
        "trace": told.name,
        "spec": told.source.name,
        "spec_sha256": hashlib.sha256(told.source.text.encode()).hexdigest(),
        "dt": told.dt,
        "horizon": None if horizon is None else {"seconds": horizon * told.dt, "steps": horizon},
        "end": online.how.end,
        "traces": 1,
        "samples": told.samples,
        "unknown": {name: gap_entry(gap, online.time) for name, gap in online.gaps.items()},
        "in_scope": int(online.in_scope is not False),
        "verdict": status,
        "robustness": math.nan if any(map(math.isnan, known)) else min(known),
        "satisfied_traces": int(status == "satisfied"),
        "satisfied_share": min(tally.share for tally in tallies.values()),
    }


def _requirements(
    online: Online, tallies: Mapping[str, Tally], causes: Mapping[str, Cause]
) -> list[dict[str, Any]]:
    return [_requirement(name, tally, online, causes.get(name)) for name, tally in tallies.items()]


def _requirement(name: str, tally: Tally, online: Online, cause: Cause | None) -> dict[str, Any]:
    rule = online.rule(name)
    time = online.time(tally.worst)
    return {
        "name": name,
        "doc": rule.doc,
        "tags": sorted(rule.tags),
        "verdict": tally.status,
        "robustness": {
            "min": tally.robustness,
            "mean": tally.robustness,
            "low": tally.low,
            "high": tally.high,
            "unit": rule.unit or ("" if cause is None else cause.unit),
            "argmin": {"trace": 0, "start": time, "time": time if cause is None else cause.time},
        },
        "starts": tally.instants,
        "satisfied_share": tally.share,
        "violated_traces": int(tally.status == "violated"),
        "cause": None if cause is None else cause_entry(cause),
    }
