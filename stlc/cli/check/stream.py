"""`stlc check -`: samples from the standard input, line by line, judged as they come.

The lines are a `.csv` with a header, or one JSON object each. The time step is that of `--dt`, or what the
first two values of a column `t` say, or that of the system; `--resample` lays any times on a grid.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from stlc.cli.check.judge import Question, instant_of, laid_reading, monitor_of, usage
from stlc.cli.check.outcome import WORDS, Outcome
from stlc.cli.check.tallies import Told, outcome_of_tallies
from stlc.cli.check.text import in_unit, signed
from stlc.cli.framework.output import emit, wants_color
from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import visible
from stlc.files import find_spec, read_source

if TYPE_CHECKING:
    from stlc.monitor.online.online import Decision, Online
    from stlc.monitor.signals import Conversion
    from stlc.monitor.verdict import Monitor
    from stlc.trace.live import Sample, Uniform

NAME = "standard input"
CLOCK = "t"


def outcome_of_stream(question: Question, *, talk: bool) -> Outcome:
    """Judge the standard input; where `talk` says so, print verdicts as soon as they are decided.

    Raises:
        UsageError: U101, no specification, or an option that needs the whole trace.
        TraceError: a line that is no sample, or signals that are missing or not finite.
    """
    from stlc.trace.live import MAX_LINE, SampleStream, on_grid

    if question.spec is None:
        raise usage("which specification?", "stlc check SPEC -")
    if question.semantics != "exact":
        raise usage("`--semantics` needs the whole trace, and the standard input is judged line by line")
    begun = time.perf_counter()
    source = read_source(find_spec(question.spec))
    monitor = monitor_of(source, question)
    reading = laid_reading(monitor, question)
    lines = SampleStream(NAME, reading)
    raw = iter(lambda: sys.stdin.buffer.readline(MAX_LINE + 1), b"")
    uniform = on_grid(lines.moments(raw), reading, NAME)
    online = _online(monitor, question, uniform)
    changes = _conversions(online, lines.units)
    for sample in uniform.samples:
        try:
            decisions = online.push(_in_units(sample, changes, online))
        except TraceError as error:
            where = f"sample {online.samples} of the {NAME}"
            raise TraceError(*(finding.with_note(where) for finding in error.diagnostics)) from None
        if talk:
            for decision in decisions:
                _tell(decision, online)
    step = online.compiled.grid.dt
    told = Told(NAME, source, float(step or 0), online.samples, wants_color(sys.stdout))
    return outcome_of_tallies(online, told, (), time.perf_counter() - begun)


def _online(monitor: Monitor, question: Question, uniform: Uniform) -> Online:
    from stlc.monitor.online.online import How

    known = monitor.online(How(), require=question.require, dt=uniform.dt).compiled.grid.dt
    at = instant_of(question.at, f"the {NAME}", float(known or 0), uniform.t0, None)
    how = How(at, question.end, question.tolerance, uniform.t0, reasons=True)
    return monitor.online(how, require=question.require, dt=uniform.dt)


def _conversions(online: Online, units: Mapping[str, str]) -> dict[str, Conversion]:
    """Conversions of recorded numbers whose unit is another one than is declared.

    Raises:
        TraceError: E605, a unit that is none, or of something else.
    """
    from stlc.monitor.signals import conversion
    from stlc.units import CELSIUS, means_celsius, parse_unit

    changes: dict[str, Conversion] = {}
    for column in online.compiled.signature.columns:
        if not units.get(column.name):
            continue
        try:
            recorded = parse_unit(units[column.name])
        except ValueError as error:
            message = f"column `{column.name}` of the {NAME}: {error}"
            help_ = (CELSIUS,) if means_celsius(units[column.name]) else ()
            raise TraceError(Diagnostic("E605", message, help=help_)) from None
        change = conversion(NAME, column, recorded)
        if change is not None:
            changes[column.name] = change
    return changes


def _in_units(sample: Sample, changes: Mapping[str, Conversion], online: Online) -> Sample:
    """The sample in the units that are declared, and its time."""
    converted = {name: change(sample[name]) for name, change in changes.items() if name in sample}
    return {CLOCK: online.time(online.samples), **sample, **converted}


def _tell(decision: Decision, online: Online) -> None:
    """A violation always; that a requirement is satisfied only where it is judged once."""
    repeated = online.repeats(decision.requirement)
    if decision.status == "satisfied" and repeated:
        return
    low, high = decision.low, decision.high
    bounds = signed(low) if low == high else f"[{signed(low)}, {signed(high)}]"
    value = in_unit(bounds, online.rule(decision.requirement).unit)
    judged = f", judged from t = {decision.time:.10g} s" if repeated else ""
    now = online.time(decision.sample)
    emit(f"t = {now:.10g} s  {visible(decision.requirement)}  {WORDS[decision.status]}  {value}{judged}")
