"""Mistakes after which a requirement seems satisfied that is violated as meant.

A mistake turns a situation into the files that stlc is asked about, and into what a literal reading of them
sees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from benchmarks.requirements import Atom, Floats, Formula, Joined, Over, Until, signals_of, written
from benchmarks.scenes import SHAPES, Channel, Shape, Situation, amount

Rows: TypeAlias = Mapping[str, list[str]]


@dataclass(frozen=True, slots=True)
class Files:
    """A specification and a recording, as they lie on the disk, with options of `stlc check`.

    Attributes:
        spec: text of the specification.
        table: text of the recording, as CSV.
        options: options of `stlc check`.
    """

    spec: str
    table: str
    options: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Read:
    """Input of a literal reading: a formula, and signal -> values at steps of `dt` seconds."""

    formula: Formula
    data: Mapping[str, Floats]
    dt: float


@dataclass(frozen=True, slots=True)
class Mistaken:
    """A situation with a mistake.

    Attributes:
        files: the files with the mistake.
        right: the files without it, and a recording that satisfies the requirement.
        read: what a literal reading sees of `files`.
        place: words of which a remark has one that names the place: names of requirements, signals, columns.
        rtamt: whether the mistake can be made with RTAMT.
    """

    files: Files
    right: Files
    read: Read
    place: frozenset[str]
    rtamt: bool = True


Rng: TypeAlias = np.random.Generator
Mistake: TypeAlias = Callable[[Rng, Situation], Mistaken | None]


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of mistake.

    Attributes:
        name: the kind in words.
        make: function that makes such a mistake.
        shapes: the forms of requirements that it suits.
        at: where it lies, "specification" or "recording".
    """

    name: str
    make: Mistake
    shapes: tuple[Shape, ...] = SHAPES
    at: str = field(default="specification")


# ------------------------------------------------------------------------ files


def spec_text(
    situation: Situation,
    formula: Formula | None,
    *,
    text: str = "",
    before: str = "",
    after: str = "",
) -> str:
    """Return a specification that declares the signals of a formula, and requires it.

    Args:
        situation: plant and name.
        formula: the requirement; None for none.
        text: the formula as written, if it differs.
        before: lines before the requirement.
        after: lines after it.
    """
    read = signals_of(situation.meant) | (frozenset() if formula is None else signals_of(formula))
    lines = ["## Requirements on a recording."]
    lines += [
        declaration(channel, ranged=situation.ranged)
        for channel in situation.plant.channels
        if channel.name in read
    ]
    lines += ["", *([before] if before else [])]
    if formula is not None:
        lines.append(f"require {situation.name}: {text or written(formula)}")
    return "\n".join([*lines, *([after] if after else []), ""])


def declaration(channel: Channel, *, ranged: bool) -> str:
    """Return the declaration of a signal, with its range if `ranged`."""
    if channel.flag:
        return f"signal {channel.name} : bool"
    unit = f" [{channel.unit}]" if channel.unit else ""
    return f"signal {channel.name}{unit}" + (f" in [{channel.low:g}, {channel.high:g}]" if ranged else "")


def cells(situation: Situation, data: Mapping[str, Floats]) -> dict[str, list[str]]:
    """Return the columns of a recording as texts of cells; flags are 0 and 1."""
    found = {}
    for name, values in data.items():
        known = [each for each in situation.plant.channels if each.name == name]
        flag = bool(known) and known[0].flag
        found[name] = ["" if np.isnan(v) else f"{v:.0f}" if flag else f"{v:.6g}" for v in values]
    return found


def clock(situation: Situation, samples: int, dt: float | None = None) -> list[str]:
    """Return the times of the samples in seconds, as texts."""
    return [f"{k * (dt or situation.plant.dt):.6g}" for k in range(samples)]


def table(columns: Mapping[str, list[str]], header: list[str] | None = None) -> str:
    """Return columns as CSV."""
    rows = [",".join(header or columns), *map(",".join, zip(*columns.values(), strict=True))]
    return "\n".join([*rows, ""])


def recorded(situation: Situation, data: Mapping[str, Floats]) -> str:
    """Return a recording as CSV, with the column `time` first."""
    samples = len(next(iter(data.values())))
    return table({"time": clock(situation, samples), **cells(situation, data)})


def correct(situation: Situation, *, bad: bool = False) -> Files:
    """Return the files of a situation without a mistake."""
    return Files(
        spec_text(situation, situation.meant), recorded(situation, situation.bad if bad else situation.good)
    )


def _written_wrong(situation: Situation, formula: Formula, text: str = "", *, rtamt: bool = True) -> Mistaken:
    """Return a situation in which the requirement is written as another formula."""
    return Mistaken(
        Files(spec_text(situation, formula, text=text), recorded(situation, situation.bad)),
        correct(situation),
        Read(formula, situation.bad, situation.plant.dt),
        frozenset({situation.name}) | signals_of(formula),
        rtamt,
    )


def _recorded_wrong(
    situation: Situation,
    file: str,
    data: Mapping[str, Floats],
    *place: str,
    dt: float | None = None,
    options: tuple[str, ...] = (),
    rtamt: bool = True,
) -> Mistaken:
    """Return a situation in which the recording is another one than meant."""
    return Mistaken(
        Files(spec_text(situation, situation.meant), file, options),
        correct(situation),
        Read(situation.meant, data, dt or situation.plant.dt),
        frozenset({*place}) or signals_of(situation.meant),
        rtamt,
    )


_LARGER: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        **{
            "m": ("km", 1e3),
            "m/s": ("km/s", 1e3),
            "s": ("min", 60.0),
            "km/h": ("m/s", 3.6),
            "N": ("kN", 1e3),
        },
        **{"kPa": ("bar", 100.0), "kW": ("MW", 1e3), "A": ("kA", 1e3), "Nm": ("kNm", 1e3)},
    }
)
"""Unit -> a larger one of the same dimension, and its size in the first."""


# ------------------------------------------------------------------------ the recording


_CLOCK = ("clock", "time", "step", "steps")
"""Words of remarks on the clock of a recording."""


def clock_in_other_units(rng: Rng, situation: Situation) -> Mistaken | None:
    """The clock counts milliseconds, microseconds or nanoseconds, and nothing says so.

    In most cases, a window still has a few samples, so that its size alone does not show it.
    """
    factor = (1e3, 1e6, 1e9)[rng.integers(3)] if rng.random() < 0.3 else 1e3
    if factor == 1e3 and situation.plant.dt * factor > 0.4 * situation.seconds:
        return None
    name = ("time", "t", "stamp", "timestamp")[rng.integers(4)]
    times = [f"{k * situation.plant.dt * factor:.0f}" for k in range(situation.plant.samples)]
    file = table({name: times, **cells(situation, situation.bad)})
    return _recorded_wrong(situation, file, situation.bad, name, *_CLOCK, dt=situation.plant.dt * factor)


def two_clocks(rng: Rng, situation: Situation) -> Mistaken | None:
    """Beside the clock there is another one that runs at another rate, and is taken for it."""
    rate = (10.0, 0.1, 100.0)[rng.integers(3)]
    samples = situation.plant.samples
    false = [f"{k * situation.plant.dt * rate:.6g}" for k in range(samples)]
    name = ("time_received", "t_host", "stamp", "elapsed", "rx_time", "time_s")[rng.integers(6)]
    columns = {"time": false, name: clock(situation, samples), **cells(situation, situation.bad)}
    dt = situation.plant.dt * rate
    return _recorded_wrong(situation, table(columns), situation.bad, name, *_CLOCK, dt=dt)


def starts_late(rng: Rng, situation: Situation) -> Mistaken | None:
    """A column is empty until after the incident."""
    return _empty(rng, situation, slice(0, situation.incident[1] + 4))


def ends_early(rng: Rng, situation: Situation) -> Mistaken | None:
    """A column is empty from before the incident on."""
    return _empty(rng, situation, slice(max(situation.incident[0] - 4, 2), None))


def run_of_nan(_: Rng, situation: Situation) -> Mistaken | None:
    """The incident is a run of NaN."""
    return _empty(None, situation, slice(situation.incident[0] - 3, situation.incident[1] + 4), "nan")


def _empty(rng: Rng | None, situation: Situation, part: slice, cell: str = "") -> Mistaken:
    data = {name: values.copy() for name, values in situation.bad.items()}
    data[situation.main][part] = np.nan
    columns = cells(situation, data)
    columns[situation.main] = [text or cell for text in columns[situation.main]]
    file = table({"time": clock(situation, situation.plant.samples), **columns})
    known = ~np.isnan(data[situation.main])
    step = f"{situation.plant.dt:g}s"
    options = ("--resample", step) if rng is not None and rng.random() < 0.5 else ()
    seen = {name: values[known] for name, values in data.items()}
    return _recorded_wrong(situation, file, seen, situation.main, options=options)


def spike_dropped(rng: Rng, situation: Situation) -> Mistaken | None:
    """The incident lies between two samples of the grid to which the recording is resampled."""
    every = int(rng.integers(4, 9))
    first = situation.incident[0] // every * every + 1
    data = {name: values.copy() for name, values in situation.good.items()}
    for name in signals_of(situation.meant):
        data[name][first : first + 2] = situation.bad[name][situation.incident[0] + 2]
    step = f"{situation.plant.dt * every:g}s"
    seen = {name: values[::every] for name, values in data.items()}
    dt = situation.plant.dt * every
    file = recorded(situation, data)
    return _recorded_wrong(situation, file, seen, dt=dt, options=("--resample", step), rtamt=False)


def last_part_missing(rng: Rng, situation: Situation) -> Mistaken | None:
    """The recording ends before the incident."""
    end = situation.incident[0] - int(rng.integers(4, 12))
    data = {name: values[:end] for name, values in situation.bad.items()}
    return _recorded_wrong(situation, recorded(situation, data), data)


def wrong_map(rng: Rng, situation: Situation) -> Mistaken | None:
    """`--map` reads a column of a similar name, such as the set-point."""
    other = f"{situation.main}_{('cmd', 'ref', 'est', 'raw')[rng.integers(4)]}"
    columns = cells(situation, situation.bad)
    columns[other] = cells(situation, situation.good)[situation.main]
    file = table({"time": clock(situation, situation.plant.samples), **columns})
    data = dict(situation.bad) | {situation.main: situation.good[situation.main]}
    return _recorded_wrong(
        situation,
        file,
        data,
        situation.main,
        other,
        options=("--map", f"{situation.main}={other}"),
        rtamt=False,
    )


def column_twice(_: Rng, situation: Situation) -> Mistaken | None:
    """A column stands in the file twice, with different values."""
    columns = cells(situation, situation.bad)
    columns["\0"] = cells(situation, situation.good)[situation.main]
    whole = {"time": clock(situation, situation.plant.samples), **columns}
    file = table(whole, [situation.main if name == "\0" else name for name in whole])
    data = dict(situation.bad) | {situation.main: situation.good[situation.main]}
    return _recorded_wrong(situation, file, data, situation.main, rtamt=False)


def runs_strung_together(rng: Rng, situation: Situation) -> Mistaken | None:
    """Two runs stand in one file; what the first owes at its end, the second one does.

    The second run goes on in time, at once or after a pause, or starts from 0 again.
    """
    cut = situation.incident[0] + 1
    joined = {
        name: np.concatenate((situation.bad[name][:cut], situation.good[name])) for name in situation.bad
    }
    samples = situation.plant.samples
    first = clock(situation, cut)
    start = (0, cut, cut + 2, cut + samples)[rng.integers(4)] * situation.plant.dt
    rest = [f"{start + k * situation.plant.dt:.6g}" for k in range(samples)]
    file = table({"time": first + rest, **cells(situation, joined)})
    words = (*_CLOCK, "gap", situation.main, situation.other)
    return _recorded_wrong(situation, file, joined, *words)


def two_objects(rng: Rng, situation: Situation) -> Mistaken | None:
    """Rows of two objects alternate in one table; what one owes, the other does."""
    name = ("id", "agent", "vehicle_id", "track")[rng.integers(4)]
    both: dict[str, Floats] = {}
    for key in situation.bad:
        both[key] = np.empty(2 * situation.plant.samples)
        both[key][::2], both[key][1::2] = situation.bad[key], situation.good[key]
    samples = 2 * situation.plant.samples
    columns = {"time": clock(situation, samples, situation.plant.dt / 2), name: ["1", "2"] * (samples // 2)}
    file = table({**columns, **cells(situation, both)})
    return _recorded_wrong(situation, file, both, name, dt=situation.plant.dt / 2)


def sensor_stuck(rng: Rng, situation: Situation) -> Mistaken | None:
    """The sensor gives one value from before the incident on."""
    first = situation.incident[0] - int(rng.integers(3, 20))
    data = dict(situation.bad) | {situation.main: situation.bad[situation.main].copy()}
    data[situation.main][first:] = data[situation.main][first]
    return _recorded_wrong(situation, recorded(situation, data), data, situation.main)


def row_of_units(_: Rng, situation: Situation) -> Mistaken | None:
    """A row of units follows the header, and names a larger unit than the specification."""
    channel = situation.plant.channel(situation.main)
    if channel.unit not in _LARGER:
        return None
    unit, size = _LARGER[channel.unit]
    data = dict(situation.bad) | {situation.main: situation.bad[situation.main] / size}
    columns = {"time": ["s", *clock(situation, situation.plant.samples)]}
    for name, texts in cells(situation, data).items():
        own = unit if name == situation.main else situation.plant.channel(name).unit
        columns[name] = [own, *texts]
    return _recorded_wrong(situation, table(columns), data, situation.main, "unit", "number", rtamt=False)


def set_point(rng: Rng, situation: Situation) -> Mistaken | None:
    """The column holds the set-point: a few values, each held for long."""
    pieces = int(rng.integers(1, 4))
    values = situation.good[situation.main]
    held = np.repeat([part[0] for part in np.array_split(values, pieces)], -(-len(values) // pieces))
    data = dict(situation.bad) | {situation.main: held[: len(values)]}
    return _recorded_wrong(situation, recorded(situation, data), data, situation.main)


def sentinel(rng: Rng, situation: Situation) -> Mistaken | None:
    """The incident is recorded as a number that stands for "missing"."""
    value = (-999.0, -9999.0, -1.0, 9999.0, 65535.0)[rng.integers(5)]
    data = dict(situation.bad) | {situation.main: situation.bad[situation.main].copy()}
    data[situation.main][situation.incident[0] - 3 : situation.incident[1] + 4] = value
    return _recorded_wrong(situation, recorded(situation, data), data, situation.main)


def few_samples(rng: Rng, situation: Situation) -> Mistaken | None:
    """The recording has a few samples, none of them in the incident."""
    every = situation.plant.samples // int(rng.integers(3, 8))
    data = {name: values[::every] for name, values in situation.bad.items()}
    file = table(
        {
            "time": clock(situation, len(next(iter(data.values()))), situation.plant.dt * every),
            **cells(situation, data),
        }
    )
    return _recorded_wrong(situation, file, data, "sample", "samples", "step", dt=situation.plant.dt * every)


def never_updated(_: Rng, situation: Situation) -> Mistaken | None:
    """A signal keeps its first value throughout: its topic was never written."""
    changed = signals_of(situation.meant)
    name = (
        situation.main
        if len(changed) == 1 or situation.shape in ("bound", "windowed", "band")
        else situation.other
    )
    data = dict(situation.bad) | {name: np.full(situation.plant.samples, situation.bad[name][0])}
    row = (
        () if name == situation.main else (situation.name,)
    )  # a condition that never holds is told in the row
    return _recorded_wrong(situation, recorded(situation, data), data, name, *row)


# ------------------------------------------------------------------------ the specification


def _body(formula: Formula) -> Formula:
    return formula.body if isinstance(formula, Over) else formula


def _changed(formula: Formula, old: Formula, new: Formula) -> Formula:
    """Return a formula with one part replaced by another."""
    if formula == old:
        return new
    match formula:
        case Joined(_, left, right) | Until(left, right):
            return replace(formula, left=_changed(left, old, new), right=_changed(right, old, new))
        case Over(_, _, body):
            return replace(formula, body=_changed(body, old, new))
        case _:
            return formula


def _atoms(formula: Formula) -> list[Atom]:
    match formula:
        case Atom():
            return [formula]
        case Joined(_, left, right) | Until(left, right):
            return _atoms(left) + _atoms(right)
        case Over(_, _, body):
            return _atoms(body)
        case _:
            return []


def _main_atom(situation: Situation) -> Atom:
    return next(each for each in _atoms(situation.meant) if each.signal == situation.main)


def always_forgotten(_: Rng, situation: Situation) -> Mistaken | None:
    """`always` is not written."""
    return _written_wrong(situation, _body(situation.meant))


def eventually_for_always(_: Rng, situation: Situation) -> Mistaken | None:
    """`eventually` is written for `always`."""
    assert isinstance(situation.meant, Over)
    return _written_wrong(situation, replace(situation.meant, op="eventually"))


def wrong_bound(rng: Rng, situation: Situation) -> Mistaken | None:
    """A bound of an interval is wrong by a factor of 10 or more, or stands in milliseconds."""
    outer = situation.meant
    inner = outer.body.right if isinstance(outer, Over) and isinstance(outer.body, Joined) else outer
    if not isinstance(inner, Over) or inner.window is None:
        return None
    factor = (0.1, 0.01, 0.001)[rng.integers(3)] if inner.op == "always" else (10.0, 60.0)[rng.integers(2)]
    window = (inner.window[0], round(inner.window[1] * factor, 9))
    return _written_wrong(situation, _changed(outer, inner, replace(inner, window=window)))


def wrong_unit(_: Rng, situation: Situation) -> Mistaken | None:
    """The number stands with another unit than meant."""
    old = _main_atom(situation)
    channel = situation.plant.channel(situation.main)
    if channel.unit not in _LARGER or old.op[0] != "<":
        return None
    unit, factor = _LARGER[channel.unit]
    new = replace(old, value=old.value * factor, text=f"{old.value:g} {unit}")
    return _written_wrong(situation, _changed(situation.meant, old, new))


def left_side_never(rng: Rng, situation: Situation) -> Mistaken | None:
    """The condition is written such that it never holds, though it does as meant."""
    assert isinstance(situation.meant, Over)
    assert isinstance(situation.meant.body, Joined)
    old = situation.meant.body.left
    new: Formula
    if isinstance(old, Atom):
        channel = situation.plant.channel(old.signal)
        top = situation.bad[old.signal].max()
        value = top + rng.uniform(0.02, 0.9) * max(channel.high - top, 0.05 * (channel.high - channel.low))
        new = replace(old, value=float(f"{value:.4g}"), text=amount(value, channel.unit, 4))
    else:
        least = [each for each in situation.plant.channels if not each.flag]
        channel = least[rng.integers(len(least))]
        value = channel.high + 0.05 * (channel.high - channel.low)
        new = Joined("and", old, Atom(channel.name, ">", value, amount(value, channel.unit, 4)))
    return _written_wrong(situation, _changed(situation.meant, old, new))


def past_at_top(rng: Rng, situation: Situation) -> Mistaken | None:
    """An operator of the past stands at the top, where only the first sample lies in the past."""
    window = None if rng.random() < 0.5 else (0.0, round(20 * situation.plant.dt, 6))
    return _written_wrong(situation, Over("historically", window, _body(situation.meant)))


def window_beyond(rng: Rng, situation: Situation) -> Mistaken | None:
    """The interval lies beyond the end of the recording, and windows are cut."""
    start = round(situation.seconds * rng.uniform(1.1, 3.0), 1)
    formula = Over("always", (start, round(2 * start, 1)), _body(situation.meant))
    found = _written_wrong(situation, formula)
    options = ("--end", "truncate") if rng.random() < 0.5 else ()
    return replace(found, files=replace(found.files, options=options))


def constant_far_off(rng: Rng, situation: Situation) -> Mistaken | None:
    """The constant has digits too many, or lacks its decimal point."""
    old = _main_atom(situation)
    factor = (10.0, 100.0, 1000.0)[rng.integers(3)]
    value = old.value * factor if (old.op[0] == "<") == (old.value > 0) else -abs(old.value) * factor
    channel = situation.plant.channel(situation.main)
    new = replace(old, value=float(f"{value:.4g}"), text=amount(value, channel.unit, 4))
    return _written_wrong(situation, _changed(situation.meant, old, new))


def signals_swapped(_: Rng, situation: Situation) -> Mistaken | None:
    """Another signal is named than meant."""
    old = _main_atom(situation)
    alike = [
        each
        for each in situation.plant.channels
        if not each.flag and each.name != old.signal and each.unit == situation.plant.channel(old.signal).unit
    ]
    if not alike:
        return None
    return _written_wrong(situation, _changed(situation.meant, old, replace(old, signal=alike[0].name)))


def commented_out(rng: Rng, situation: Situation) -> Mistaken | None:
    """The requirement stands in a comment; another one is left."""
    rest = [each for each in situation.plant.channels if not each.flag and each.name != situation.main]
    channel = rest[rng.integers(len(rest))]
    high = situation.bad[channel.name].max() + 0.05 * (channel.high - channel.low)
    kept = Over("always", None, Atom(channel.name, "<", high, amount(high, channel.unit, 4)))
    hidden = f"{('# ', '// ', '#')[rng.integers(3)]}require {situation.name}: {written(situation.meant)}"
    files = Files(
        spec_text(replace(situation, name="other"), kept, before=hidden), recorded(situation, situation.bad)
    )
    place = frozenset({situation.name})
    return Mistaken(
        files, correct(situation), Read(kept, situation.bad, situation.plant.dt), place, rtamt=False
    )


def until_at_once(_: Rng, situation: Situation) -> Mistaken | None:
    """The right side of `until` holds at the first sample already."""
    assert isinstance(situation.meant, Until)
    old = situation.meant.right
    if not isinstance(old, Atom):
        return None
    new = replace(old, op="<")
    return _written_wrong(situation, _changed(situation.meant, old, new))


def strict_for_not(_: Rng, situation: Situation) -> Mistaken | None:
    """The recording reaches the bound, which must not be reached."""
    keep = _main_atom(situation)
    data = dict(situation.bad) | {situation.main: situation.good[situation.main].copy()}
    data[situation.main][slice(*situation.incident)] = keep.value
    return _recorded_wrong(situation, recorded(situation, data), data, situation.name, situation.main)


def degrees_for_radians(rng: Rng, situation: Situation) -> Mistaken | None:
    """The number is meant in degrees, and the signal is in radians."""
    old = _main_atom(situation)
    if situation.plant.channel(situation.main).unit not in ("rad", "rad/s") or (old.op[0] == "<") != (
        old.value > 0
    ):
        return None
    value = float(f"{np.degrees(old.value):.{int(rng.integers(2, 4))}g}")
    new = replace(old, value=value, text=f"{value:g}")
    return _written_wrong(situation, _changed(situation.meant, old, new))


def name_twice(_: Rng, situation: Situation) -> Mistaken | None:
    """Two requirements have one name."""
    weak = replace(_main_atom(situation), value=0.0, text="0")
    kept = Over("eventually", None, weak)
    text = spec_text(situation, situation.meant, after=f"require {situation.name}: {written(kept)}")
    files = Files(text, recorded(situation, situation.bad))
    read = Read(kept, situation.bad, situation.plant.dt)
    return Mistaken(files, correct(situation), read, frozenset({situation.name}), rtamt=False)


def nothing_required(_: Rng, situation: Situation) -> Mistaken | None:
    """The requirement is a definition that nothing requires."""
    text = spec_text(situation, None, before=f"def {situation.name} = {written(situation.meant)}")
    everything = Over("eventually", None, replace(_main_atom(situation), op=">", value=-1e9, text=""))
    files = Files(text, recorded(situation, situation.bad))
    read = Read(everything, situation.bad, situation.plant.dt)
    return Mistaken(
        files, correct(situation), read, frozenset({situation.name, "requires", "nothing"}), rtamt=False
    )


def parentheses_forgotten(_: Rng, situation: Situation) -> Mistaken | None:
    """`always p and q` is written for `always (p and q)`."""
    meant = situation.meant
    assert isinstance(meant, Over)
    assert isinstance(meant.body, Joined)
    left, right = meant.body.left, meant.body.right
    formula = Joined("and", Over("always", None, left), right)
    return _written_wrong(situation, formula, f"always {written(left)} and {written(right)}")


def or_for_and(_: Rng, situation: Situation) -> Mistaken | None:
    """`or` is written for `and`, so that every value satisfies it."""
    assert isinstance(situation.meant, Over)
    assert isinstance(situation.meant.body, Joined)
    return _written_wrong(situation, replace(situation.meant, body=replace(situation.meant.body, op="or")))


def turned_round(_: Rng, situation: Situation) -> Mistaken | None:
    """The implication goes the other way; its condition holds throughout the recording."""
    meant = situation.meant
    assert isinstance(meant, Over)
    assert isinstance(meant.body, Joined)
    old = meant.body.left
    if isinstance(old, Atom):
        channel = situation.plant.channel(old.signal)
        least = situation.bad[old.signal].min() - 0.02 * (channel.high - channel.low)
        condition: Formula = replace(old, value=float(f"{least:.4g}"), text=amount(least, channel.unit, 4))
        meant = replace(meant, body=replace(meant.body, left=condition))
        situation = replace(situation, meant=meant)
    else:
        ones = {situation.other: np.ones(situation.plant.samples)}
        situation = replace(situation, good=dict(situation.good) | ones, bad=dict(situation.bad) | ones)
    assert isinstance(meant.body, Joined)
    body = replace(meant.body, left=meant.body.right, right=meant.body.left)
    return _written_wrong(situation, replace(meant, body=body))


_ALWAYS: tuple[Shape, ...] = ("bound", "band", "guarded", "response", "hold", "pair")
_IMPLIES: tuple[Shape, ...] = ("guarded", "response", "hold")

KINDS = (
    Kind("clock in ms, µs or ns", clock_in_other_units, ("windowed", "hold"), "recording"),
    Kind("two clocks", two_clocks, ("windowed", "hold", "response"), "recording"),
    Kind("column starts late", starts_late, at="recording"),
    Kind("column ends early", ends_early, at="recording"),
    Kind(
        "spike dropped by `--resample`", spike_dropped, ("bound", "band", "windowed", "guarded"), "recording"
    ),
    Kind("run of NaN over the violation", run_of_nan, at="recording"),
    Kind("last part missing", last_part_missing, at="recording"),
    Kind("wrong `--map`", wrong_map, at="recording"),
    Kind("column twice", column_twice, at="recording"),
    Kind("runs strung together", runs_strung_together, ("response",), "recording"),
    Kind("two objects in one table", two_objects, ("response",), "recording"),
    Kind("sensor stuck", sensor_stuck, at="recording"),
    Kind("row of units", row_of_units, at="recording"),
    Kind("set-point held", set_point, at="recording"),
    Kind("sentinel for missing", sentinel, at="recording"),
    Kind("recording of a few samples", few_samples, at="recording"),
    Kind("signal never updated", never_updated, at="recording"),
    Kind("`always` forgotten", always_forgotten, _ALWAYS),
    Kind(
        "`eventually` for `always`",
        eventually_for_always,
        ("bound", "windowed", "band", "guarded", "response"),
    ),
    Kind("wrong bound", wrong_bound, ("windowed", "hold", "response")),
    Kind("wrong unit", wrong_unit),
    Kind("left side never holds", left_side_never, _IMPLIES),
    Kind("past operator at top level", past_at_top, _ALWAYS),
    Kind("window beyond the recording", window_beyond, _ALWAYS),
    Kind("constant far out of range", constant_far_off),
    Kind("signals swapped", signals_swapped),
    Kind("requirement commented out", commented_out),
    Kind("`until` true at once", until_at_once, ("sequence",)),
    Kind("strict for not strict", strict_for_not, ("bound", "band", "windowed")),
    Kind("degrees for radians", degrees_for_radians),
    Kind("name used twice", name_twice),
    Kind("nothing required", nothing_required),
    Kind("parentheses forgotten", parentheses_forgotten, ("pair",)),
    Kind("`or` for `and`", or_for_and, ("band",)),
    Kind("implication turned round", turned_round, _IMPLIES),
)
