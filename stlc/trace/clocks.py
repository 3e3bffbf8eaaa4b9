"""Clocks of a recording: the array that holds the times, its unit, and the times in seconds.

An array is a candidate by its name (`time`, `timestamp_us`) or by its unit, if its values increase and it is
not read as a signal. Of several candidates, one with a unit precedes one without: a unit in the header, the
name or the form (dates; numbers that are seconds, ms, us or ns since 1970). Then its name counts.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import permutations, takewhile

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.trace.formats.cells import value_of
from stlc.trace.recording import (
    ROSTOPIC,
    Array,
    Clock,
    ClockGroup,
    Recording,
    absent,
    clock_rank,
    is_count_name,
    is_source_time,
)
from stlc.units import Unit

Floats = NDArray[np.float64]
Read = Mapping[str, bool] | None
"""Name of a signal that is read -> whether it may be the time itself; None: all signals are read."""

SPELLINGS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "milli", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanos", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
}
"""Words for a unit of time, in lower case -> its symbol."""
FRAMES, DATES, DAY_TIME = "frames", "dates", "time of day"
"""Clocks that count samples of a given step, and clocks in words."""

_EPOCH = (946_684_800.0, 2_840_140_800.0)
"""The years 2000 to 2059, in seconds since 1970."""
_EPOCH_DIGITS = 6
"""Digits of a second that a float64 of a time since 1970 holds."""
_SUFFIX = re.compile(r"(?:(?<=[_\s./-])|(?<=[a-z])(?=[A-Z])|^)[A-Za-zµμ]+$")
_FUSED = re.compile(r"(?:time|stamp)(us|ms|ns)", re.IGNORECASE)
_DAY = re.compile(r"(?:.*[._\s/])?(?:date|day)", re.IGNORECASE)
_OF_DAY = re.compile(r"(?P<h>\d{1,2}):(?P<m>\d{2})(?::(?P<s>\d{2}(?:[.,]\d+)?))?\s*(?P<half>[AaPp][Mm])?")
_OFFSET = re.compile(r"(.*:.*\d)\s*(?:(?P<sign>[+-])(?P<h>\d{2}):?(?P<m>\d{2})|Z|UTC)", re.IGNORECASE)
_YEAR_LAST = re.compile(r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<y>\d{4})(?P<rest>.*)", re.DOTALL)
_SECONDS, _NANOSECONDS = {"sec", "secs"}, ("nanosec", "nsec", "nsecs")
_SAME = 1e-6
_PACE = 0.02
"""Logarithm of the ratio of the steps of two clocks up to which they agree; crystals drift less."""


@dataclass(frozen=True, slots=True)
class ClockSetting:
    """The clock that a user asks for.

    Attributes:
        name: name of the clock in the file; "" if the file decides.
        unit: its unit, a symbol of `SPELLINGS` or `FRAMES`; "" if the file decides.
        step: seconds of a frame, for clocks that count; None if unknown.
    """

    name: str = ""
    unit: str = ""
    step: float | None = None

    @staticmethod
    def parse(text: str, step: float | None = None) -> ClockSetting:
        """Return the setting that a text such as `timestamp` or `timestamp:us` states.

        Raises:
            ValueError: the text names no clock.
        """
        name, colon, unit = text.rpartition(":")
        known = {FRAMES: FRAMES, "frame": FRAMES, **SPELLINGS}.get(unit.strip().lower(), "")
        if not text or (colon and not (name and unit)):
            raise ValueError("it names no clock, or no unit")
        return ClockSetting(name, known, step) if colon and known else ClockSetting(text, "", step)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An array that may be the clock.

    Attributes:
        name: its name, or two names with a plus.
        unit: unit of its numbers, or the kind of its words; "" if nothing says it.
        sure: 2 if the unit is stated, 1 if it follows from the magnitude, 0 if it is unknown.
        seconds: its times, (samples,), since `origin` if there is one.
        origin: nanoseconds since 1970 of time 0; None for times that are not absolute.
    """

    name: str
    unit: str
    sure: int
    seconds: Floats
    origin: int | None = None

    @property
    def rank(self) -> tuple[int, bool, int]:
        """Order of candidates: by their units, then by their names."""
        return self.sure, not is_count_name(self.name), 2 if "+" in self.name else clock_rank(self.name)

    @property
    def rises(self) -> bool:
        """True if the times increase."""
        with np.errstate(all="ignore"):
            steps = np.diff(self.seconds)
        return not len(steps) or bool((steps >= 0).all() and steps.any())


_WHY = ("its name", "its name and magnitude", "its unit is stated")
"""Reasons of the choice of a clock, by `Candidate.sure`."""

# ------------------------------------------------------------------------------ candidates


def _scale(unit: str) -> float:
    """Seconds in a unit of time; 0 for other units."""
    try:
        parsed = Unit.parse(unit)
    except ValueError:
        return 0.0
    return float(parsed.scale) if parsed.dims == Unit.parse("s").dims else 0.0


def unit_in(name: str, stated: str) -> str:
    """Return the unit of time in a header (`stated`) or at the end of a name, such as `time_ms`; else ""."""
    if stated:
        text = stated.strip()
        return SPELLINGS.get(text.lower()) or (text if _scale(text) else "")
    if name.strip() == ROSTOPIC:
        return "ns"
    if fused := _FUSED.search(name):
        return fused[1].lower()
    match = _SUFFIX.search(name.strip())
    return SPELLINGS.get(match[0].lower(), "") if match and len(name.strip()) > 1 else ""


def _candidate(name: str, values: Array, stated: str, setting: ClockSetting) -> Candidate | None:
    """Return the times in an array; None if it holds none."""
    if values.dtype.kind == "U":
        if len(values) and value_of(str(values[0]).strip()) is None:
            return _of_words(name, values)
        numbers = [value_of(str(word).strip()) for word in values.tolist()]
        if None in numbers:
            return None
        values = np.array(numbers, dtype=np.float64)
    if values.dtype.kind == "M":
        return _absolute(name, DATES, 2, values.astype("M8[ns]").astype(np.int64))
    unit = (setting.unit if setting.name == name else "") or unit_in(name, stated)
    if values.dtype.kind not in "iuf" or (stated and not unit):
        return None
    if unit == FRAMES or (not unit and is_count_name(name)):
        step = setting.step
        return None if step is None else Candidate(name, FRAMES, 2, np.asarray(step * values, np.float64))
    sure, first = (2 if unit else 0), float(values[0]) if len(values) else 0.0
    for guess in ("s", "ms", "us", "ns") if not unit else ():
        if _EPOCH[0] <= first * _scale(guess) <= _EPOCH[1]:
            unit, sure = guess, 1
    scale = _scale(unit or "s")
    if not _EPOCH[0] <= first * scale <= _EPOCH[1]:
        return Candidate(name, unit, sure, np.asarray(values if scale == 1.0 else values * scale, np.float64))
    if values.dtype.kind in "iu":
        return _absolute(name, unit, sure, values.astype(np.int64) * round(scale * 1e9))
    whole = np.floor(first)
    seconds = np.round((values - whole) * scale, _EPOCH_DIGITS)
    return Candidate(name, unit, sure, seconds, round(whole * scale * 1e9))


def _absolute(name: str, unit: str, sure: int, ticks: NDArray[np.int64]) -> Candidate:
    """Times in nanoseconds since 1970."""
    origin = int(ticks[0]) if len(ticks) else 0
    seconds = np.where(ticks == np.iinfo(np.int64).min, np.nan, (ticks - origin) * 1e-9)
    return Candidate(name, unit, sure, seconds, origin)


def _of_words(name: str, words: Array) -> Candidate | None:
    texts = [str(word).strip() for word in words.tolist()]
    if all(map(_OF_DAY.fullmatch, texts)):
        seconds = np.array([_second_of_day(text) for text in texts])
        seconds += 86400.0 * np.cumsum(np.append(0, np.diff(seconds) < -43200.0))  # past midnight
        return Candidate(name, DAY_TIME, 2, seconds)
    ticks = instants(texts)
    return None if ticks is None else _absolute(name, DATES, 2, ticks)


def _second_of_day(text: str) -> float:
    match = _OF_DAY.fullmatch(text)
    assert match is not None
    hour = int(match["h"])
    if match["half"]:
        hour = hour % 12 + (12 if match["half"].lower() == "pm" else 0)
    return hour * 3600.0 + int(match["m"]) * 60.0 + float((match["s"] or "0").replace(",", "."))


def instants(texts: list[str]) -> NDArray[np.int64] | None:
    """Return nanoseconds since 1970 of dates (ISO 8601 and close to it); None if one is no date."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of zones, which NumPy does not read
        try:
            found = np.char.rstrip(np.array(texts), "Zz").astype("M8[ns]").astype(np.int64)
            return found if texts and "-" in texts[0][1:] else None
        except (ValueError, UserWarning, DeprecationWarning):
            ticks = [instant(text) for text in texts]
    return None if None in ticks else np.array(ticks, dtype=np.int64)


def instant(text: str) -> int | None:
    """Return the nanoseconds since 1970 of a date, in UTC if it names no zone; None if it is no date."""
    shift = 0
    if (match := _OFFSET.fullmatch(text)) is not None:
        text = match[1]
        if match["sign"]:
            shift = int(f"{match['sign']}{int(match['h']) * 60 + int(match['m'])}") * 60
    if (match := _YEAR_LAST.fullmatch(text)) is not None:
        text = f"{match['y']}-{int(match['m']):02d}-{int(match['d']):02d}{match['rest']}"
    text = text.replace("/", "-", 2).replace(",", ".").strip()
    if "-" not in text[1:]:
        return None
    try:
        ticks = np.datetime64(text, "ns")
    except ValueError:
        try:
            ticks = np.datetime64(datetime.fromisoformat(text), "ns")
        except ValueError:
            return None
    return None if np.isnat(ticks) else int(ticks.astype(np.int64)) - shift * 10**9


def _combined(arrays: Mapping[str, Array]) -> dict[str, Candidate]:
    """Clocks that stand in two columns: seconds and nanoseconds, and date and time of day."""
    found: dict[str, Candidate] = {}
    numbers = {n: x for n, x in arrays.items() if x.dtype.kind in "iuf" and np.isfinite(x).all()}
    for name in (each for each in numbers if each.rpartition(".")[2].lower() in _SECONDS):
        for other in (f"{name.rpartition('.')[0]}.{each}".lstrip(".") for each in _NANOSECONDS):
            if other in numbers and numbers[other].shape == numbers[name].shape:
                ticks = numbers[name].astype(np.int64) * 10**9 + numbers[other].astype(np.int64)
                found[f"{name}+{other}"] = _absolute(f"{name}+{other}", "s and ns", 2, ticks)
    words = [name for name, values in arrays.items() if values.dtype.kind == "U" and clock_rank(name)]
    for name, other in permutations(words, 2):
        if _DAY.fullmatch(name) and arrays[name].shape == arrays[other].shape:
            days, hours = (_of_words(each, arrays[each]) for each in (name, other))
            if days is not None and hours is not None and (days.unit, hours.unit) == (DATES, DAY_TIME):
                ticks = np.round((days.seconds + hours.seconds % 86400.0) * 1e9).astype(np.int64)
                found[f"{name}+{other}"] = _absolute(f"{name}+{other}", DATES, 2, ticks + (days.origin or 0))
    return found


def candidates(
    recording: Recording, group: ClockGroup, setting: ClockSetting, read: Read
) -> dict[str, Candidate]:
    """Return the arrays of a group that may be its clock, by name."""
    flat = {
        name: values.reshape(-1)
        for name, values in group.arrays.items()
        if name == setting.name or values.ndim == 1 or (values.ndim == 2 and 1 in values.shape)
    }
    free = {name: values for name, values in flat.items() if read is None or name not in read}
    double = {} if setting.name and "+" not in setting.name else _combined(free)
    parts = {part for name in double for part in name.split("+")}
    found = {name: each for name, each in double.items() if setting.name in ("", name)}
    for name, values in flat.items():
        stated = recording.unit(name)
        timed = clock_rank(name) or (stated and unit_in(name, stated))
        usual = timed and name not in parts and (read is None or read.get(name, True))
        if name == setting.name or (usual and not setting.name):
            each = _candidate(name, values, stated, setting)
            found |= {} if each is None else {name: each}
    spare = {name: each for name, each in found.items() if setting.name or name in double or name in free}
    return spare or found


# ------------------------------------------------------------------------------ the choice


def best_of(trace: str, found: Iterable[Candidate]) -> Candidate:
    """Return the best candidate.

    Raises:
        TraceError: E601, the best ones are equally good and differ.
    """
    ranked = sorted(found, key=lambda each: each.rank, reverse=True)
    first = ranked[0]
    rivals = [each for each in ranked if each.rank == first.rank]
    if equal := [each.name for each in rivals if not _alike(each.seconds, first.seconds)]:
        raise _which(trace, [first.name, *equal])
    return first


def _which(trace: str, names: list[str]) -> TraceError:
    message = f"which of {', '.join(f'`{name}`' for name in names)} is the clock of `{trace}`?"
    return TraceError.of(
        "E601", message, help=(f"--clock {names[0]}  or  --clock {names[-1]}:ms  with its unit",)
    )


def _alike(one: Floats, other: Floats) -> bool:
    """True if two clocks tell the same time since their first sample."""
    if len(one) != len(other) or not len(one):
        return len(one) == len(other)
    with np.errstate(all="ignore"):
        a, b = one - one[0], other - other[0]
        span = float(np.abs(a[np.isfinite(a)]).max(initial=1e-300))
        return bool(np.allclose(a, b, rtol=_SAME, atol=_SAME * span, equal_nan=True))


def clocked(recording: Recording, setting: ClockSetting, read: Read) -> Recording:
    """Return the recording with the times of each group of signals in seconds, and with their clocks.

    Absolute times count from the first stamp among the signals that are read. Signals that are not read, and
    times, are left out.

    Raises:
        TraceError: E601, the clock that is asked for is not there, or several arrays may be the clock.
    """
    parts: list[tuple[ClockGroup, Candidate | None, tuple[str, ...]]] = []
    for group in recording.groups:
        if group.clock is not None and setting.name not in group.arrays:
            parts.append((replace(group, arrays=_read(group.arrays, read)), _given(group), ()))
        else:
            parts += _parted(recording, group, setting, read)
    known = {each.name for _, each, _ in parts if each is not None}
    if setting.name and setting.name not in known and any(group.clock is None for group in recording.groups):
        raise TraceError(absent(recording.name, setting.name, (*recording.signals, *recording.others)))
    parts = [part for part in parts if part[0].arrays] or parts[:1]
    origin = min((c.origin for _, c, _ in parts if c is not None and c.origin is not None), default=None)
    groups, clocks = [], []
    for group, clock, others in parts:
        if clock is not None:
            shift = 0.0 if clock.origin is None or origin is None else (clock.origin - origin) * 1e-9
            times = clock.seconds + shift if shift else clock.seconds
            group = replace(group, clock=times, named=clock.name)
            why = "--clock" if clock.name == setting.name else _WHY[clock.sure]
            clocks.append(Clock(clock.name, clock.unit, others, why))
        groups.append(group)
    meta = recording.meta if origin is None else replace(recording.meta, origin=origin)
    there = {part for group in groups for name in (*group.arrays, group.named) for part in name.split("+")}
    left = [name for name in recording.signals if name not in there]
    others, chosen = (*left, *recording.others), tuple(dict.fromkeys(clocks))
    return replace(recording, groups=tuple(groups), meta=meta, others=others, clocks=chosen)


def _given(group: ClockGroup) -> Candidate:
    clock = group.clock
    assert clock is not None
    if clock.dtype.kind == "i":
        return _absolute(group.named, "", 2, clock.astype(np.int64))
    found = _candidate(group.named, clock.reshape(-1), "s", ClockSetting())
    assert found is not None
    return replace(found, unit="")


def _read(arrays: Mapping[str, Array], read: Read) -> dict[str, Array]:
    if read is None:
        return dict(arrays)
    return {
        name: values
        for name, values in arrays.items()
        if name in read or any(each.startswith((f"{name}[", f"{name}.")) for each in read)
    }


def _parted(
    recording: Recording, group: ClockGroup, setting: ClockSetting, read: Read
) -> list[tuple[ClockGroup, Candidate | None, tuple[str, ...]]]:
    """Divide arrays by their clocks: a clock is as long as its arrays, and close to them by name."""
    found = candidates(recording, group, setting, read)
    wanted = _read(group.arrays, read)
    if not found:
        if setting.step is None and recording.meta.dt is None:
            _require_no_other(recording, group, read)
        return [(replace(group, arrays=wanted), None, ())]
    rising = {name: each for name, each in found.items() if each.rises} or found
    clocks = {part for name in found for part in name.split("+")}
    parts: dict[str, dict[str, Array]] = {}
    for name in sorted(wanted, key=clocks.__contains__):  # an array that was not chosen is a signal
        values = wanted[name]
        if read is None and name in clocks and (not parts or any(name in each.split("+") for each in parts)):
            continue
        lengths = {*values.shape[-2:]}
        fits = [each for each in rising.values() if len(each.seconds) in lengths] or [*rising.values()]
        shared = [_shared(name, each.name) for each in fits]
        best = best_of(recording.name, [c for c, n in zip(fits, shared, strict=True) if n == max(shared)])
        parts.setdefault(best.name, {})[name] = values
    if not parts:
        parts = {best_of(recording.name, rising.values()).name: {}}
    near = {name: tuple(n for n in rising if n != name and n not in parts) for name in parts}
    if read is not None and not setting.name:
        for name, others in near.items():
            _require_one_pace(recording.name, rising[name], [rising[other] for other in others])
    return [(ClockGroup(arrays, None, name), rising[name], near[name]) for name, arrays in parts.items()]


def _require_one_pace(trace: str, clock: Candidate, others: list[Candidate]) -> None:
    """Raise TraceError (E606) if another clock of the same samples has steps of another length.

    A clock whose unit nothing says may be in ms, us or ns, or count rows.
    """
    samples, group = len(clock.seconds), clock.name.rpartition(".")[0]
    for other in others:
        beside = other.name.rpartition(".")[0] == group and len(other.seconds) == samples
        if samples < 2 or not beside or not (clock_rank(other.name) == 2 or is_source_time(other.name)):
            continue
        steps = [float(each.seconds[-1] - each.seconds[0]) / (samples - 1) for each in (clock, other)]
        counts = not other.sure and clock.sure and steps[1] == 1.0
        if counts or not (steps[0] > 0 and steps[1] > 0):
            continue
        unsure = not (clock.sure and other.sure)
        scales = (1.0, 1e3, 1e6, 1e9) if unsure else (1.0,)
        if all(abs(math.log(steps[0] * x / steps[1])) > _PACE for s in scales for x in (s, 1.0 / s)):
            message = (
                f"`{trace}` has two clocks: `{clock.name}` with a step of {steps[0]:.6g} s, and "
                f"`{other.name}` with {steps[1]:.6g} s"
            )
            help_ = (f"--clock {clock.name}  or  --clock {other.name}  names the one that counts",)
            raise TraceError.of("E606", message, help=help_)


def _shared(one: str, other: str) -> int:
    """Number of leading parts that two dotted names share."""
    pairs = zip(one.split(".")[:-1], other.partition("+")[0].split(".")[:-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _require_no_other(recording: Recording, group: ClockGroup, read: Read) -> None:
    """Raise TraceError (E603, E605) if an array has the name of a clock, but holds no times."""
    for name, values in group.arrays.items():
        if clock_rank(name) and not is_count_name(name) and (read is None or name not in read):
            _require_time(f"`{recording.name}`", name, recording.unit(name))
            if values.dtype.kind == "U" and values.size:
                first = str(values.flat[0])[:40]
                message = f"the clock `{name}` in `{recording.name}` holds words (`{first}`)"
                advice = ("seconds, or dates and times such as 2026-01-31T12:00:00.5",)
                raise TraceError.of("E603", message, help=advice)


def _require_time(trace: str, name: str, stated: str) -> None:
    """Raise TraceError (E605) if the stated unit of a clock is not of time."""
    if stated and not unit_in(name, stated):
        message = f"the clock `{name}` of {trace} is in [{stated}], which is not a time"
        raise TraceError.of("E605", message)


# ------------------------------------------------------------------------------- streams


@dataclass(slots=True)
class StreamClock:
    """Clock of a stream of lines, chosen by the names and units in its header.

    Attributes:
        name: name of the column with the times.
        setting: unit and step that the user gives.
        stated: unit in the header.
    """

    name: str
    setting: ClockSetting
    stated: str = ""
    _origin: float | None = None
    _scale: float = 1.0

    @staticmethod
    def of(trace: str, units: Mapping[str, str], setting: ClockSetting, read: Read) -> StreamClock | None:
        """Return the clock among columns, name -> unit in the header; None if there is none.

        Raises:
            TraceError: E601, the clock that is asked for is not there, or several may be it; E605, it is in a
                unit that is not of time.
        """
        if setting.name and setting.name not in units:
            raise TraceError(absent(trace, setting.name, units))
        names = [n for n in units if clock_rank(n) and (setting.step is not None or not is_count_name(n))]
        names = [n for n in names if read is None or n not in read] or [
            n for n in names if (read or {}).get(n)
        ]
        names = [setting.name] if setting.name else names
        timed = [n for n in names if not units[n] or unit_in(n, units[n])]
        if not timed:
            for name in names:
                _require_time(trace, name, units[name])
            return None
        ranks = {n: (bool(unit_in(n, units[n])), not is_count_name(n), clock_rank(n)) for n in timed}
        best = [n for n in timed if ranks[n] == max(ranks.values())]
        if len(best) > 1:
            raise _which(trace, best)
        return StreamClock(best[0], replace(setting, name=best[0]), units[best[0]])

    def times(self, numbers: Floats) -> Floats | None:
        """Return the times that numbers state, in seconds, once `seconds` has seen one; None before."""
        with np.errstate(over="ignore", invalid="ignore"):
            return None if self._origin is None else (numbers - float(self._origin)) * self._scale

    def seconds(self, value: object) -> float | None:
        """Return the time that a number or a text states, in seconds; None if it states none."""
        number = value_of(value) if isinstance(value, str) else value
        text = value.strip() if isinstance(value, str) else ""
        if not isinstance(number, (int, float)) or math.isnan(number):
            if _OF_DAY.fullmatch(text):
                return _second_of_day(text)
            if not text or (number := instant(text)) is None:
                return None
            self._scale = 1e-9
        if self._origin is None:  # the first time tells whether times count since 1970
            self._origin = number
            numbers = np.array([number], np.float64)
            if self._scale == 1.0 and (first := _candidate(self.name, numbers, self.stated, self.setting)):
                frames = first.unit == FRAMES
                self._scale = (self.setting.step or 1.0) if frames else _scale(first.unit or "s")
                self._origin = 0 if first.origin is None else number
        return float(number - self._origin) * self._scale
