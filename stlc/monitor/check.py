"""Verdicts on recorded files: each is read as it is asked for, judged by its specification, and explained."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from stlc.compile.semantics.tolerance import TOLERANCE, End
from stlc.diagnostics import SpecError, usage
from stlc.files import File
from stlc.source import Source

if TYPE_CHECKING:
    from stlc.grammar.spec import Spec
    from stlc.monitor.instants import At
    from stlc.monitor.judgement import Verdict
    from stlc.monitor.online.online import Decision, Online
    from stlc.monitor.uncertain import Uncertainty
    from stlc.monitor.verdict import Monitor, Subject
    from stlc.trace import Reading, Trace
    from stlc.trace.clocks import ClockSetting
    from stlc.trace.meta import Carried
    from stlc.trace.resample import Between

CHUNK = 250_000
"""Samples per chunk of a file that is read in pieces."""
SMALL = 1_000_000
"""File size in bytes below which the unpacked content always fits into memory."""
_DIGITS = 18
"""Digits of the greatest sample number."""
_SHOWN = 40
"""Characters of a text that a message shows."""
_INSTANT = re.compile(r"(?P<number>\d{1,300}(?:\.\d*)?|\.\d+)\s*(?P<unit>[a-zµ]*)")


@dataclass(frozen=True, slots=True)
class Question:
    """Options on how traces are read and judged.

    Attributes:
        spec: path of the specification; None for the specification stored in the trace.
        system: name of a system file.
        names: name of a signal in the specification -> its name in the trace.
        require: names of the requirements to judge; all requirements if empty.
        at: instant at which requirements are evaluated. It is a sample, a time as text, or "all". None means
            the first sample. If a requirement must hold for every planning window (the steps of one plan),
            None means each sample that has a full window after it.
        end: treatment of traces that are too short: "open" (report bounds), "strict" (an error) or "truncate"
            (end time windows at the last sample).
        tolerance: a requirement is satisfied if its robustness is at least `-tolerance`.
        resample: new time step in seconds, to which traces are resampled; None for no resampling.
        overrides: name of a constant -> its new value, as text.
        semantics: name of the semantics of the reported robustness, such as "exact".
        dt: seconds between samples of a trace without times.
        max_gap: longest time between two samples, in seconds, over which signals count as known.
        uncertain: signal -> greatest error of its samples.
        between: signal -> its values between samples, when traces are resampled.
        clock: the clock of a trace, if the user names it.
        group: name of the column that tells the objects in a table apart.
        columns: names of the columns of a table without a header.
        strict: whether times at which signals of a requirement were not seen are unknown, not left out.
    """

    spec: Path | None = None
    system: str | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    require: tuple[str, ...] = ()
    at: int | str | None = None
    end: End = "open"
    tolerance: float = TOLERANCE
    resample: float | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    semantics: str = "exact"
    dt: float | None = None
    max_gap: float | None = None
    uncertain: Mapping[str, Uncertainty] = field(default_factory=dict)
    between: Mapping[str, Between] = field(default_factory=dict)
    clock: ClockSetting | None = None
    group: str = ""
    columns: tuple[str, ...] = ()
    strict: bool = False


OF_TABLES = {"names", "resample", "dt", "max_gap", "between", "clock", "group", "columns"}
"""Options on how a table is read: a file, a data frame, or arrays by name; a `Trace` has been read."""


def check(
    spec: Spec | str | Path | None,
    trace: Subject,
    *,
    chunk: int = 0,
    **options: Any,
) -> Verdict:
    """Judge a recording by a specification.

    Args:
        spec: a specification, its text, or the path of its file; None: the one that the trace stores.
        trace: path of a trace file, a `Trace`, a data frame of pandas or polars, or arrays by signal name.
        chunk: samples per chunk of a file; 0: a file is read in chunks only if memory is too small for it.
        options: fields of `Question`, such as `at` or `require`; those in `OF_TABLES` are not for a `Trace`.

    Raises:
        SpecError: the specification is invalid.
        TraceError: the trace cannot be read, or does not fit the specification.
        UsageError: U101, an option does not fit; U102, there is no such file.
    """
    from stlc.grammar.spec import Spec
    from stlc.monitor.given import is_frame, trace_of_table
    from stlc.monitor.verdict import Monitor
    from stlc.trace import Trace

    if isinstance(trace, str | Path):
        odd = str(trace).endswith(".stl")
    else:
        odd = spec is None or not (isinstance(trace, Mapping | Trace) or is_frame(trace))
    if odd or not isinstance(spec, Spec | str | Path | None):
        advice = "stlc.check(spec, trace), with a path, a data frame, a `Trace` or arrays by name"
        raise usage("a specification comes first, then the recording", advice)
    question = Question(**options)
    known = None if spec is None else Monitor(spec, system=question.system, overrides=question.overrides)
    if not isinstance(trace, str | Path):
        assert known is not None
        reading = options.keys() & OF_TABLES
        if reading and isinstance(trace, Trace):
            raise usage(f"`{min(reading)}` says how a table is read, and a `Trace` has been read")
        if reading or is_frame(trace):
            trace = trace_of_table(trace, reading_options(known, question))
        return judged_by(known, trace, question)
    found = judge(Path(trace), question, known=known, chunk=chunk)
    if len(found) > 1:
        tracks = ", ".join(each.about.track for each in found)
        raise usage(
            f"`{trace}` holds {len(found)} objects with times of their own", f"group= one of {tracks}"
        )
    return found[0]


def judge(path: Path, question: Question, *, known: Monitor | None = None, chunk: int = 0) -> list[Verdict]:
    """Load a trace file, and judge it.

    There are several results if the file holds objects of different times. A file that is too large for
    memory, or for which a `chunk` is given, is judged in pieces; the verdict is then told.

    Raises:
        StlcError: the trace or the specification is invalid, or the two do not fit together.
    """
    if chunk or too_large(path):
        return [_in_pieces(path, question, known, chunk)]
    loaded = load(path, question, known=known)
    notes = (loaded.note,) if loaded.note else ()
    return [replace(judged_by(loaded.monitor, trace, question), notes=notes) for trace in loaded.traces]


def judged_by(monitor: Monitor, given: Subject, question: Question) -> Verdict:
    """Judge signals by a monitor, and note what the lint rules say of its specification."""
    from stlc.trace import Trace

    known = (
        (given.name, given.dt, given.t0, given.samples) if isinstance(given, Trace) else ("it", 0, 0, None)
    )
    at = instant_of(question.at, *known)
    verdict = monitor.check(
        given,
        at=at,
        end=question.end,
        tolerance=question.tolerance,
        require=question.require,
        semantics=question.semantics,
        uncertain=question.uncertain,
        strict=question.strict,
    )
    return replace(verdict, lint=_lint_codes(monitor, everywhere=question.at == "all"))


@dataclass(frozen=True, slots=True)
class Loaded:
    """Traces of a file, and the specification that judges them.

    Attributes:
        traces: one, or one for each object with times of its own.
        monitor: its monitor.
        note: remark to print; "" if there is none.
    """

    traces: tuple[Trace, ...]
    monitor: Monitor
    note: str


def load(path: Path, question: Question, *, known: Monitor | None = None, planned: bool = False) -> Loaded:
    """Read what a specification needs of a trace file.

    `known` is its monitor, if it is not the one that `question` names. If the trace has two specifications of
    its own, `planned` takes the one that plans were made for.

    Raises:
        StlcError: the trace or the specification is invalid.
    """
    from stlc.trace import read_recording, traces_of

    known = known or _named(question)
    recording = read_recording(path, reading_options(known, question).wanted)
    carried = recording.meta.planned if planned else recording.meta.carried
    note = ""
    if known is None:
        source, note = specification(recording.name, carried)
        known = monitor_of(source, question, carried)
    return Loaded(traces_of(recording, reading_options(known, question)), known, note)


def _named(question: Question) -> Monitor | None:
    """Monitor of the specification that a question names; None if it is that of the trace."""
    return None if question.spec is None else monitor_of(File(File(question.spec).spec()).read(), question)


def too_large(path: Path) -> bool:
    """True if the unpacked content of a file is too large for memory; the file is then read in chunks.

    A file of less than `SMALL` bytes is never too large, however well it is compressed.
    """
    if not path.is_file() or path.stat().st_size < SMALL:
        return False
    from stlc.trace.chunks import LARGE, size_of

    return size_of(path) > LARGE


def _in_pieces(path: Path, question: Question, known: Monitor | None, chunk: int) -> Verdict:
    """Judge a file that is read in pieces.

    Raises:
        UsageError: U101, an option needs the whole trace at once.
        TraceError: the file cannot be read in pieces, or its samples are invalid; see
            `stlc.trace.chunks.pieces`.
    """
    from stlc.monitor.online.online import How
    from stlc.monitor.streamed import verdict_of
    from stlc.trace.chunks import pieces

    whole = {"--resample": question.resample is not None, "--max-gap": question.max_gap is not None}
    whole |= {"--uncertain": bool(question.uncertain), "--semantics": question.semantics != "exact"}
    advice = "leave out --chunk" if chunk else "cut out what is of interest"
    for option, asked in whole.items():
        if asked:
            raise usage(f"`{option}` needs the whole trace, and `{path}` is read in pieces", advice)
    known = known or _named(question)
    read = pieces(path, chunk or CHUNK, reading_options(known, question))
    first = next(read)
    note = ""
    if known is None:
        source, note = specification(str(path), first.meta.carried)
        known = monitor_of(source, question, first.meta.carried)
    at = instant_of(question.at, str(path), first.dt, first.t0, None)
    how = How(at, question.end, question.tolerance, first.t0, reasons=True)
    online = known.online(how, require=question.require, like=first)
    online.feed(first)
    for piece in read:
        online.feed(piece)
    return verdict_of(online, str(path)).but(notes=(note,) if note else ())


def write_robustness(path: Path, verdict: Verdict, question: Question) -> None:
    """Write the robustness of each requirement to the trace file `path`, one signal per requirement.

    `verdict` is that on the whole trace, and `question` the options with which it was judged. A signal has
    the shape (traces, samples). Its value at a sample is the robustness of the requirement at that instant,
    or NaN where the robustness is not defined.

    Raises:
        MissingError: R201, the disk is full, or the user may not write there.
    """
    import numpy as np

    from stlc.signature import Column, Signature
    from stlc.trace import Trace
    from stlc.units import Unit

    trace = verdict.subject.signals.trace
    assert trace is not None
    monitor = monitor_of(verdict.about.source, question, trace.meta.carried)
    end: Literal["strict", "truncate"] = "truncate" if question.end == "truncate" else "strict"
    values = monitor.requirement_robustness(trace, end=end, semantics=question.semantics)
    units = {judged.name: Unit.written(judged.unit) for judged in verdict}
    data = {
        name: np.asarray(values[name], dtype=np.float64).reshape(trace.traces, trace.samples)
        for name in units
    }
    signature = Signature(tuple(Column(name, units[name]) for name in data))
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = replace(trace.meta, spec_text="", spec_path="", judge_text="", judge_path="")
    Trace(signature, trace.dt, data, trace.t0, meta=meta, name=str(path)).save(path)


def judge_lines(
    pieces: Iterator[bytes],
    question: Question,
    name: str,
    tell: Callable[[Decision, Online], object] | None,
) -> Verdict:
    """Judge lines of samples, a table with a header or JSON, as pieces of their text come.

    `name` names them in messages, and `tell` is told each verdict on an instant as soon as it is decided.

    Raises:
        UsageError: U101, there is no specification, or an option needs the whole trace.
        TraceError: a line is not a sample, or signals are missing or not finite.
    """
    from stlc.monitor.online.online import How
    from stlc.monitor.streamed import watched
    from stlc.trace.live import SampleStream, on_grid

    if (monitor := _named(question)) is None:
        raise usage("which specification?", "stlc check SPEC -")
    if question.semantics != "exact":
        raise usage(f"`--semantics` needs the whole trace, and the {name} is judged line by line")
    reading = reading_options(monitor, question)
    stream = SampleStream(name, reading)
    uniform = on_grid(stream.samples(pieces), reading, name)
    try:
        step = uniform.dt or monitor.compiled.grid.dt or 0
        at = instant_of(question.at, f"the {name}", float(step), uniform.t0, None)
        how = How(at, question.end, question.tolerance, uniform.t0, reasons=True)
        online = monitor.online(how, require=question.require, dt=uniform.dt)
    except SpecError as error:
        if uniform.dt is None and {each.code for each in error.diagnostics} == {"E311"}:
            raise uniform.without_step(name) from None
        raise
    return watched(online, uniform, stream.units, name, tell)


def reading_options(monitor: Monitor | None, question: Question) -> Reading:
    """Options for reading trace files: names of signals, time steps, and the longest gap between samples.

    If `monitor` is given, the options also include the signals that its requirements read, and their types.
    """
    from stlc.monitor.signals import reading_of
    from stlc.trace import Reading
    from stlc.trace.clocks import ClockSetting

    options = Reading(
        question.names,
        question.resample,
        question.dt,
        question.max_gap,
        clock=question.clock or ClockSetting(),
        group=question.group,
        columns=question.columns,
        between=question.between,
    )
    return options if monitor is None else reading_of(monitor.spec, options, monitor.reads(question.require))


def specification(name: str, carried: Carried) -> tuple[Source, str]:
    """Return the specification that the trace `name` stores, and a remark to print ("" if there is none)."""
    if not carried.text:
        raise usage(f"`{name}` carries no specification", f"stlc check SPEC {name}", "elsewhere: --spec SPEC")
    source = Source(carried.path or f"{carried.name or 'specification'} in {name}", carried.text)
    changed = ", ".join(f"{constant} = {text}" for constant, text in carried.overrides.items())
    note = f"with {changed}, as it was recorded" if changed else ""
    if carried.path and Path(carried.path).is_file() and File(carried.path).read().text != source.text:
        since = (
            f"{carried.path} has changed since; judging by the text in {name} "
            f"(--spec {carried.path} takes the new one)"
        )
        note = f"{since}; {note}" if note else since
    return source, note


def monitor_of(source: Source, question: Question, carried: Carried | None = None) -> Monitor:
    """Return the monitor of the specification `source`; it is cached and used again for further traces.

    `carried` is what a trace stores: imported files and new values of constants. It is used only if the
    specification is also taken from the trace, that is, if `question` names no specification file.
    """
    library: Mapping[str, str] | None = None
    changed = question.overrides
    if carried is not None and question.spec is None:
        library, changed = carried.library, {**carried.overrides, **changed}
    stored = None if library is None else tuple(library.items())
    return _monitor(source, stored, question.system, tuple(changed.items()))


@lru_cache(maxsize=8)
def _monitor(
    source: Source,
    library: tuple[tuple[str, str], ...] | None,
    system: str | None,
    overrides: tuple[tuple[str, str], ...],
) -> Monitor:
    from stlc.grammar.spec import Spec
    from stlc.monitor.verdict import Monitor

    parsed = replace(Spec.parse(source), library=None if library is None else dict(library))
    return Monitor(parsed, system=system, overrides=dict(overrides))


@lru_cache(maxsize=8)
def _lint_codes(monitor: Monitor, *, everywhere: bool) -> tuple[str, ...]:
    """Codes of the warnings that the lint rules have of a specification; `everywhere`: for `--at all`."""
    from stlc.lint.lint import rule_findings

    found = rule_findings(monitor.spec, resolved=monitor.resolved)
    return tuple(each.code for each in found if not (everywhere and each.code == "W311"))


def instant_of(text: int | str | None, name: str, dt: float, t0: float, samples: int | None) -> At:
    """Return the index of the sample that `--at` selects in a trace; "all" and None are returned unchanged.

    Args:
        text: value of the option: a sample, a time, or "all".
        name: name of the trace.
        dt: time step in seconds; 0 if unknown.
        t0: time of the first sample.
        samples: number of samples; None if unknown.

    Raises:
        UsageError: U101, the text is not an instant, or the trace has no sample there.
    """
    if text is None or isinstance(text, int):
        return text
    if text == "all":
        return "all"
    match = _INSTANT.fullmatch(text.strip())
    shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
    help_ = "a sample (0, 46), a time (4.6s) or all"
    if match is None:
        raise usage(f"`--at {shown}` is not an instant", help_)
    if not match["unit"]:
        if not match["number"].isdigit() or len(match["number"]) > _DIGITS:
            raise usage(f"`--at {shown}` is not a whole number of samples", help_)
        return int(match["number"])
    if not dt:
        raise usage(
            f"`--at {shown}` is a time, and `{name}` has no time step", "a number counts samples: --at 46"
        )
    steps = (seconds_of("--at", text, help_) - t0) / dt
    sample = round(steps) if math.isfinite(steps) else -1
    if abs(steps - sample) > 0.01 or sample < 0 or (samples is not None and sample >= samples):
        last = "" if samples is None else f" to {t0 + (samples - 1) * dt:g} s"
        raise usage(f"`{name}` has no sample at {shown}", f"it runs from {t0:g} s{last} every {dt:g} s")
    return sample


def seconds_of(option: str, text: str, advice: str) -> float:
    """Return a time with its unit, the value of an option, in seconds. Raises UsageError (U101)."""
    from stlc.units import Unit

    match = _INSTANT.fullmatch(text.strip())
    if match is None or not match["unit"]:
        raise usage(f"`{option} {text}` is not a time", advice)
    try:
        unit = Unit.parse(match["unit"])
    except ValueError as error:
        raise usage(f"`{option} {text}`: {error}", advice) from None
    if unit.dims != Unit.parse("s").dims:
        raise usage(f"`{option} {text}` is not a time", advice)
    return float(match["number"]) * unit.scale
