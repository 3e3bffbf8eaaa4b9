"""`stlc check -`: samples from the standard input, line by line, judged as they come.

The lines are a `.csv` with a header, or one JSON object each. With a column `t` its first two values say the
time step; without one the system does.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

from stlc.cli.judge import Question, instant_of, monitor_of, usage
from stlc.cli.outcome import WORDS, Outcome
from stlc.cli.output import emit, wants_color
from stlc.cli.tallies import Told, outcome_of_tallies
from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import visible
from stlc.files import find_spec, read_source
from stlc.jsontext import loads

if TYPE_CHECKING:
    from stlc.monitor.online import Decision, Online
    from stlc.monitor.verdict import Monitor

NAME = "standard input"
MAX_LINE = 1_000_000

Sample = Mapping[str, object]


def outcome_of_stream(question: Question, *, talk: bool) -> Outcome:
    """Judge the standard input; where `talk` says so, print verdicts as soon as they are decided.

    Raises:
        UsageError: U101, no specification, or an option that needs the whole trace.
        TraceError: a line that is no sample, or signals that are missing or not finite.
    """
    if question.spec is None:
        raise usage("which specification?", "stlc check SPEC -")
    whole = {
        "--resample": question.resample is not None,
        "--semantics": question.semantics != "exact",
    }
    for option, given in whole.items():
        if given:
            raise usage(f"`{option}` needs the whole trace, and the standard input is judged line by line")
    begun = time.perf_counter()
    source = read_source(find_spec(question.spec))
    monitor = monitor_of(source, question)
    samples = _timed(_renamed(_samples(_lines(sys.stdin.buffer)), question.names))
    first, dt = next(samples)
    online = _online(monitor, question, first, dt)
    for sample in _from(first, samples):
        try:
            decisions = online.push(sample)
        except TraceError as error:
            where = f"sample {online.samples} of the {NAME}"
            raise TraceError(*(finding.with_note(where) for finding in error.diagnostics)) from None
        if talk:
            for decision in decisions:
                _tell(decision, online)
    step = online.compiled.grid.dt
    told = Told(NAME, source, float(step or 0), online.samples, wants_color(sys.stdout))
    return outcome_of_tallies(online, told, (), time.perf_counter() - begun)


def _from(first: Sample, rest: Iterator[tuple[Sample, float | None]]) -> Iterator[Sample]:
    yield first
    for sample, _ in rest:
        yield sample


def _online(monitor: Monitor, question: Question, first: Sample, dt: float | None) -> Online:
    from stlc.monitor.online import How

    start = first.get("t", 0.0)
    t0 = float(start) if isinstance(start, (int, float)) else 0.0
    known = monitor.online(How(), require=question.require, dt=dt).compiled.grid.dt
    at = instant_of(question.at, f"the {NAME}", float(known or 0), t0, None)
    how = How(at, question.end, question.tolerance, t0, reasons=True)
    return monitor.online(how, require=question.require, dt=dt)


def _tell(decision: Decision, online: Online) -> None:
    """A violation always; that a requirement is satisfied only where it is judged once."""
    repeated = online.repeats(decision.requirement)
    if decision.status == "satisfied" and repeated:
        return
    low, high = decision.low, decision.high
    value = f"{low:+.3f}" if low == high else f"[{low:+.3f}, {high:+.3f}]"
    judged = f", judged from t = {decision.time:.10g} s" if repeated else ""
    now = online.time(decision.sample)
    emit(f"t = {now:.10g} s  {visible(decision.requirement)}  {WORDS[decision.status]}  {value}{judged}")


# -------------------------------------------------------------------------- samples


@dataclass(frozen=True, slots=True)
class _Header:
    names: tuple[str, ...]
    delimiter: str


def _samples(lines: Iterable[bytes]) -> Iterator[Sample]:
    """The samples that lines hold; empty lines are passed over."""
    header: _Header | None = None
    is_json: bool | None = None
    for number, raw in enumerate(lines, 1):
        text = _text(raw, number)
        if not text:
            continue
        if is_json is None:
            is_json = text.startswith("{")
        if is_json:
            yield _json(text, number)
        elif header is None:
            header = _header(text, number)
        else:
            yield _row(text, header, number)


def _lines(stream: BinaryIO) -> Iterator[bytes]:
    """Lines, of those that are too long as much as shows it."""
    return iter(lambda: stream.readline(MAX_LINE + 1), b"")


def _text(raw: bytes, number: int) -> str:
    if len(raw) > MAX_LINE:
        raise _bad(number, f"is longer than {MAX_LINE:,} bytes")
    try:
        return raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise _bad(number, "is not UTF-8") from None


def _bad(number: int, what: str, code: str = "E603") -> TraceError:
    return TraceError(Diagnostic(code, f"line {number} of the {NAME} {what}"))


def _json(text: str, number: int) -> Sample:
    try:
        found = loads(text)
    except (ValueError, RecursionError):
        raise _bad(number, "is not a JSON object") from None
    if not isinstance(found, dict):
        raise _bad(number, "is not a JSON object")
    for name, value in found.items():
        if not _is_number(value) and not (isinstance(value, list) and all(map(_is_number, value))):
            found[name] = None
    return {name: value for name, value in found.items() if value is not None}


def _is_number(value: object) -> bool:
    if isinstance(value, int):
        return abs(value) < 2**1000
    return isinstance(value, float)


def _header(text: str, number: int) -> _Header:
    from stlc.trace_csv import delimiter_of, head_cells, split_head

    delimiter = delimiter_of(text)
    names = tuple(split_head(cell)[0] for cell in head_cells(text, delimiter))
    if len(set(names)) < len(names) or not all(names):
        raise _bad(number, "does not name every column, or names one twice", "E605")
    if all(_number(name) is not None for name in names):
        raise _bad(number, "has numbers where the columns are named", "E605")
    return _Header(names, delimiter)


def _row(text: str, header: _Header, number: int) -> Sample:
    cells = [cell.strip().strip('"') for cell in text.split(header.delimiter)]
    if len(cells) != len(header.names):
        raise _bad(number, f"has {len(cells)} cells, the header names {len(header.names)} columns", "E605")
    values = [_number(cell) for cell in cells]
    odd = [cell for cell, value in zip(cells, values, strict=True) if value is None]
    if odd:
        raise _bad(number, f"has `{odd[0][:40]}` where a number is expected")
    return dict(zip(header.names, values, strict=True))


def _number(text: str) -> float | None:
    words = {"true": 1.0, "false": 0.0}
    if text.lower() in words:
        return words[text.lower()]
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def _renamed(samples: Iterable[Sample], names: Mapping[str, str]) -> Iterator[Sample]:
    """Signals called as in the specification. Raises TraceError (E601) for one that is not there."""
    for sample in samples:
        for old in names.values():
            if old not in sample:
                raise TraceError(Diagnostic("E601", f"the {NAME} has no signal `{old}`"))
        back = {old: new for new, old in names.items()}
        kept = {name: value for name, value in sample.items() if name in back or name not in names}
        yield {back.get(name, name): value for name, value in kept.items()}


def _timed(samples: Iterator[Sample]) -> Iterator[tuple[Sample, float | None]]:
    """Each sample, and the time step, which two samples with a `t` tell. Raises TraceError (E602, E605)."""
    from stlc.trace_time import TOLERANCE, snapped

    first = next(samples, None)
    if first is None:
        raise TraceError(Diagnostic("E605", f"the {NAME} holds no samples"))
    second = next(samples, None)
    start, then = _time(first), None if second is None else _time(second)
    if start is None or second is None or then is None:
        yield first, None
        if second is not None:
            yield second, None
        yield from ((sample, None) for sample in samples)
        return
    dt = snapped(then - start)
    if not dt > 0:
        raise TraceError(Diagnostic("E602", f"time in the {NAME} does not increase: {start:g} s, {then:g} s"))
    yield first, dt
    yield second, dt
    for number, sample in enumerate(samples, 2):
        now, wanted = _time(sample), start + number * dt
        if now is None or not abs(now - wanted) <= TOLERANCE * dt + 1e-9 * abs(wanted):
            found = "no time" if now is None else f"{now:.6g} s"
            message = f"time in the {NAME} is not uniform: sample {number} has {found}, not {wanted:.6g} s"
            raise TraceError(Diagnostic("E602", message))
        yield sample, dt


def _time(sample: Sample) -> float | None:
    value = sample.get("t")
    return float(value) if isinstance(value, (int, float)) else None
