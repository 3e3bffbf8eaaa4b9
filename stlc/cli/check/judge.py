"""One recorded trace: read, judged by its specification, and explained."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stlc.cli.framework.output import ColorMode
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import usage
from stlc.escape import operand
from stlc.files import find_spec, read_source
from stlc.source import Source

if TYPE_CHECKING:
    from stlc.cli.check.outcome import Checked
    from stlc.monitor.instants import At
    from stlc.monitor.uncertain import Uncertainty
    from stlc.monitor.verdict import Monitor
    from stlc.trace import Reading, Trace
    from stlc.trace.clocks import ClockSetting
    from stlc.trace.meta import Carried
    from stlc.trace.resample import Between

End = Literal["open", "strict", "truncate"]

_DIGITS = 18
"""Digits of the greatest sample number."""
_SHOWN = 40
"""Characters of a text that a message shows."""
_INSTANT = re.compile(r"(?P<number>\d{1,300}(?:\.\d*)?|\.\d+)\s*(?P<unit>[a-zµ]*)")


@dataclass(frozen=True, slots=True)
class Question:
    """Options on how traces are read and judged, the same for all traces of a command.

    Attributes:
        spec: path of the specification; None for the specification stored in the trace.
        system: name of a system file.
        names: name of a signal in the specification -> its name in the trace.
        require: names of the requirements to judge; all requirements if empty.
        at: instant at which requirements are evaluated, as text. It is a sample, a time, or `all`. None means
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
    at: str | None = None
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


@dataclass(frozen=True, slots=True)
class Work:
    """Request to judge one trace file, as sent to a worker process.

    Attributes:
        name: name of the file as given.
        question: options of reading and judging.
        runs: folder of all runs.
        out: file to which the robustness signals are written.
        chunk: samples per chunk; 0: the file is read as a whole if it fits into memory.
        color: whether the text of the result has colour codes.
        mode: value of `--color`; the worker process uses the same value.
        certify: whether the traces are returned as a sample for bounds.
        table: whether the times of first violations are looked for.
        evidence: whether the record of the result says what it was made from.
    """

    name: str
    question: Question
    runs: Path
    out: Path | None = None
    chunk: int = 0
    color: bool = False
    mode: ColorMode = "never"
    certify: bool = False
    table: bool = False
    evidence: bool = False


def found(name: str, runs: Path) -> Path:
    """Return the path of a trace file called `name`.

    It is `name` itself if that file exists, else the file of that name in the newest run below `runs`.
    """
    from stlc.files import find_trace

    path = find_trace(name, runs)
    if path == Path(name):
        return path
    path = path.resolve()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def judge(name: str, question: Question, runs: Path) -> list[Checked]:
    """Load the trace called `name`, judge it with the options in `question`, and explain its violations.

    If there is no file at the path `name`, the file is looked for in the newest run below `runs`. There are
    several results if the file holds objects of different times.

    Raises:
        StlcError: the trace or the specification is invalid, or the two do not fit together.
    """
    path = found(name, runs)
    loaded = load(path, question)
    remarks = (
        *(() if path == Path(name) else (f"taking {path}, of the newest run",)),
        *([loaded.note] if loaded.note else ()),
    )
    return [_judged(trace, loaded, question, remarks) for trace in loaded.traces]


@dataclass(frozen=True, slots=True)
class Loaded:
    """Traces of a file, and the specification that judges them.

    Attributes:
        traces: one, or one for each object with times of its own.
        source: text of the specification.
        monitor: its monitor.
        note: remark to print; "" if there is none.
    """

    traces: tuple[Trace, ...]
    source: Source
    monitor: Monitor
    note: str


def load(path: Path, question: Question, *, planned: bool = False) -> Loaded:
    """Read what a specification needs of a trace file.

    If the trace has two specifications of its own, `planned` takes the one that plans were made for.

    Raises:
        StlcError: the trace or the specification is invalid.
    """
    from stlc.trace import read_recording, traces_of

    known = None if question.spec is None else monitor_of(read_source(find_spec(question.spec)), question)
    recording = read_recording(path, reading_options(known, question).wanted)
    carried = recording.meta.planned if planned else recording.meta.carried
    source, note = specification(recording.name, question.spec, carried)
    monitor = known or monitor_of(source, question, carried)
    return Loaded(traces_of(recording, reading_options(monitor, question)), source, monitor, note)


def _judged(trace: Trace, loaded: Loaded, question: Question, remarks: tuple[str, ...]) -> Checked:
    from stlc.cli.check.outcome import Checked
    from stlc.monitor.explain.report import explain_all

    verdict = loaded.monitor.check(
        trace,
        at=instant_of(question.at, trace.name, trace.dt, trace.t0, trace.samples),
        end=question.end,
        tolerance=question.tolerance,
        require=question.require,
        semantics=question.semantics,
        uncertain=question.uncertain,
        strict=question.strict,
    )
    causes, options = explain_all(verdict), _replayed(question)
    lint = _lint_codes(loaded.monitor, everywhere=question.at == "all")
    known = (trace, loaded.source, verdict, causes, options, remarks, question.uncertain)
    return Checked(*known, facts=verdict.facts, lint=lint)


def options_of(question: Question) -> dict[str, tuple[str, ...]]:
    """Command-line options that state `question`: name -> the values of all its occurrences."""

    def seconds(value: float | None) -> tuple[str, ...]:
        return () if value is None else (f"{value!r}s",)

    clock, aged = question.clock, {name: f"{each.how}" for name, each in question.between.items()}
    aged |= {name: f"hold:{each.age!r}s" for name, each in question.between.items() if each.age is not None}
    found: dict[str, tuple[str, ...]] = {
        "--spec": () if question.spec is None else (str(question.spec),),
        "--system": () if question.system is None else (question.system,),
        "--map": tuple(f"{name}={value}" for name, value in question.names.items()),
        "--set": tuple(f"{name}={value}" for name, value in question.overrides.items()),
        "--resample": seconds(question.resample),
        "--dt": seconds(question.dt),
        "--max-gap": seconds(question.max_gap),
        "--between": tuple(f"{name}={how}" for name, how in aged.items()),
        "--clock": (f"{clock.name}:{clock.unit}".rstrip(":"),) if clock is not None and clock.name else (),
        "--fps": () if clock is None or clock.step is None else (repr(1.0 / clock.step),),
        "--group": (question.group,) if question.group else (),
        "--columns": (",".join(question.columns),) if question.columns else (),
        "--uncertain": tuple(
            f"{signal}={str(error).replace(' ', '')}" for signal, error in question.uncertain.items()
        ),
        "--require": question.require,
        "--at": () if question.at is None else (question.at,),
        "--end": (question.end,),
        "--tolerance": (repr(question.tolerance),),
        "--semantics": (question.semantics,),
        "--strict": ("",) if question.strict else (),
    }
    return {name: values for name, values in found.items() if values}


_REPLAYED = (
    *("--system", "--map", "--set", "--resample", "--dt", "--max-gap", "--between", "--clock", "--fps"),
    *("--columns", "--uncertain"),
)


def _replayed(question: Question) -> tuple[str, ...]:
    """Words of a command line that reads the same trace, to explain one of its violations."""
    given = options_of(question)
    words = [operand(spec) for spec in given.get("--spec", ())]
    words += [word for name in _REPLAYED for value in given.get(name, ()) for word in (name, value)]
    return (*words, *(("--group", "none") if question.group == "none" else ()))


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


def specification(name: str, spec: Path | None, carried: Carried) -> tuple[Source, str]:
    """Return the specification for the trace `name`, and a remark to print ("" if there is none).

    The specification is the file `spec`, or else the text that is stored in the trace (`carried`).
    """
    if spec is not None:
        return read_source(find_spec(spec)), ""
    if not carried.text:
        raise usage(f"`{name}` carries no specification", f"stlc check SPEC {name}", "elsewhere: --spec SPEC")
    source = Source(carried.path or f"{carried.name or 'specification'} in {name}", carried.text)
    changed = ", ".join(f"{constant} = {text}" for constant, text in carried.overrides.items())
    note = f"with {changed}, as it was recorded" if changed else ""
    if carried.path and Path(carried.path).is_file() and read_source(carried.path).text != source.text:
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
    from stlc.grammar.parse.parser import parse
    from stlc.monitor.verdict import Monitor

    parsed = replace(parse(source), library=None if library is None else dict(library))
    return Monitor(parsed, system=system, overrides=dict(overrides))


@lru_cache(maxsize=8)
def _lint_codes(monitor: Monitor, *, everywhere: bool) -> tuple[str, ...]:
    """Codes of the warnings that the lint rules have of a specification; `everywhere`: for `--at all`."""
    from stlc.lint.lint import rule_findings

    found = rule_findings(monitor.spec, resolved=monitor.resolved)
    return tuple(each.code for each in found if not (everywhere and each.code == "W311"))


# ------------------------------------------------------------------------ instants


def instant_of(text: str | None, name: str, dt: float, t0: float, samples: int | None) -> At:
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
    if text is None or text == "all":
        return "all" if text else None
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
    steps = (_seconds("--at", text, help_) - t0) / dt
    sample = round(steps) if math.isfinite(steps) else -1
    if abs(steps - sample) > 0.01 or sample < 0 or (samples is not None and sample >= samples):
        last = "" if samples is None else f" to {t0 + (samples - 1) * dt:g} s"
        raise usage(f"`{name}` has no sample at {shown}", f"it runs from {t0:g} s{last} every {dt:g} s")
    return sample


def uncertainties(pairs: Mapping[str, str]) -> dict[str, Uncertainty]:
    """Parse the values of `--uncertain`: signal -> text such as `0.1m` or `2%`.

    Raises:
        UsageError: U101, a text is not an amount, or its unit is unknown.
    """
    from stlc.monitor.uncertain import Uncertainty

    found = {}
    for name, text in pairs.items():
        try:
            found[name] = Uncertainty.parse(text)
        except ValueError as error:
            raise usage(f"`--uncertain {name}={text}`: {error}", "write --uncertain x=0.1m") from None
    return found


def betweens(pairs: Mapping[str, str]) -> dict[str, Between]:
    """Parse the values of `--between`: signal -> text such as `hold`, `hold:0.5s`, `linear` or `angle`.

    Raises:
        UsageError: U101, a text is none of these.
    """
    from stlc.trace.resample import Between

    found = {}
    for name, text in pairs.items():
        how, colon, age = (part.strip() for part in text.partition(":"))
        if how not in ("hold", "linear", "angle") or (colon and how != "hold"):
            help_ = "write hold, hold:0.5s, linear or angle"
            raise usage(f"`--between {name}={text}` is no way to continue a signal", help_)
        found[name] = Between(how, time_step("--between", age) if colon else None)  # type: ignore[arg-type]
    return found


def clock_setting(text: str | None, fps: float | None) -> ClockSetting | None:
    """Parse the values of `--clock` and `--fps`; None if neither is given.

    Raises:
        UsageError: U101, a value is malformed.
    """
    from stlc.trace.clocks import ClockSetting

    if fps is not None and not 0.0 < fps < math.inf:
        raise usage(f"`--fps {fps}` is not a number above 0")
    step = None if fps is None else 1.0 / fps
    if text is None:
        return None if step is None else ClockSetting(step=step)
    try:
        return ClockSetting.parse(text.strip(), step)
    except ValueError as error:
        raise usage(f"`--clock {text}`: {error}", "write --clock NAME  or  --clock NAME:us") from None


def time_step(option: str, text: str | None) -> float | None:
    """Parse the value of `option` as a time step and return it in seconds; None is returned unchanged.

    Raises:
        UsageError: U101, the text is not a time with a unit, or the time is not positive.
    """
    if text is None:
        return None
    seconds = _seconds(option, text, "a time with its unit: 0.1s, 20ms")
    if not 0 < seconds < float("inf"):
        raise usage(f"`{option} {text}` is not a time above 0")
    return seconds


def _seconds(option: str, text: str, advice: str) -> float:
    from stlc.units import parse_unit

    match = _INSTANT.fullmatch(text.strip())
    if match is None or not match["unit"]:
        raise usage(f"`{option} {text}` is not a time", advice)
    try:
        unit = parse_unit(match["unit"])
    except ValueError as error:
        raise usage(f"`{option} {text}`: {error}", advice) from None
    if unit.dims != parse_unit("s").dims:
        raise usage(f"`{option} {text}` is not a time", advice)
    return float(match["number"]) * unit.scale
