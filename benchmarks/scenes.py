"""Recordings of plants like those of the repository, and requirements on them that hold or do not.

A recording is smooth motion within the range of each signal. An incident in its middle violates the
requirement.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.requirements import Atom, Flag, Floats, Formula, Joined, Over, Until, robustness


@dataclass(frozen=True, slots=True)
class Channel:
    """A recorded signal: its name, its unit ("" for none), and its range; `flag` is a truth value."""

    name: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    flag: bool = False


@dataclass(frozen=True, slots=True)
class Plant:
    """A plant: the step of its recorder in seconds, the number of samples, and its signals."""

    name: str
    dt: float
    samples: int
    channels: tuple[Channel, ...]

    def channel(self, name: str) -> Channel:
        """Return the signal `name`."""
        return next(each for each in self.channels if each.name == name)


PLANTS = (
    Plant("car", 0.1, 400, (
        Channel("v", "m/s", 0, 30), Channel("v_lead", "m/s", 0, 30), Channel("dx", "m", -1, 80),
        Channel("braking", flag=True), Channel("steer", "rad", -1, 1),
    )),
    Plant("rover", 0.2, 300, (
        Channel("x", "m", 0, 10), Channel("y", "m", 0, 10), Channel("tau_b", "s", 0, 5),
        Channel("docked", flag=True), Channel("heading", "rad", -3, 3),
    )),
    Plant("ship", 0.5, 240, (
        Channel("y", "m", -2.2, 2.2), Channel("x1", "m", -10, 60), Channel("psi", "rad", -1.5, 1.5),
        Channel("u", "m/s", 3, 15), Channel("alarm", flag=True),
    )),
    Plant("arm", 0.02, 500, (
        Channel("q1", "rad", -2.9, 2.9), Channel("q2", "rad", -1.7, 1.7), Channel("dq1", "rad/s", -4, 4),
        Channel("gripping", flag=True), Channel("force", "N", 0, 120),
    )),
    Plant("tank", 1.0, 600, (
        Channel("level", "m", 0, 5), Channel("inflow", "m/s", 0, 2), Channel("reserve", "m", 0, 5),
        Channel("pump", flag=True), Channel("pressure", "kPa", 0, 400),
    )),
    Plant("transmission", 0.05, 600, (
        Channel("speed", "km/h", 0, 240), Channel("limit_speed", "km/h", 0, 240), Channel("rpm", "", 0, 6000),
        Channel("shifting", flag=True), Channel("throttle", "%", 0, 100),
    )),
    Plant("cruise", 0.1, 300, (
        Channel("gap", "m", 0, 120), Channel("v_ego", "m/s", 0, 40), Channel("v_front", "m/s", 0, 40),
        Channel("warning", flag=True), Channel("a_ego", "m/s^2", -8, 4),
    )),
    Plant("quadrotor", 0.05, 500, (
        Channel("z", "m", 0, 40), Channel("ground", "m", 0, 40), Channel("tilt", "rad", -1.2, 1.2),
        Channel("climbing", flag=True), Channel("vz", "m/s", -12, 12),
    )),
    Plant("oven", 2.0, 400, (
        Channel("oven", "degC", 20, 260), Channel("core", "degC", 20, 260), Channel("power", "kW", 0, 12),
        Channel("door_open", flag=True),
    )),
    Plant("battery", 1.0, 500, (
        Channel("soc", "%", 0, 100), Channel("cell", "V", 2.5, 4.3), Channel("pack", "V", 2.5, 4.3),
        Channel("charging", flag=True), Channel("current", "A", -80, 80),
    )),
    Plant("engine", 0.01, 800, (
        Channel("mu", "", -1, 1), Channel("ratio", "", 8, 22), Channel("target", "", 8, 22),
        Channel("rich", flag=True), Channel("torque", "Nm", 0, 300),
    )),
    Plant("drone", 0.005, 3000, (
        Channel("altitude", "m", 0, 60), Channel("floor", "m", 0, 60), Channel("roll", "rad", -1.2, 1.2),
        Channel("armed", flag=True), Channel("motor", "", 0, 2000),
    )),
    Plant("crane", 0.25, 320, (
        Channel("load", "kg", 0, 9000), Channel("rated", "kg", 0, 9000), Channel("swing", "rad", -0.9, 0.9),
        Channel("lifting", flag=True), Channel("wind", "m/s", 0, 25),
    )),
)  # fmt: skip

Shape = Literal["bound", "windowed", "band", "pair", "guarded", "response", "hold", "sequence"]
SHAPES: tuple[Shape, ...] = ("bound", "windowed", "band", "pair", "guarded", "response", "hold", "sequence")
_TRIES = 60


@dataclass(frozen=True, slots=True)
class Situation:
    """A requirement as meant, with a recording that satisfies it and one that violates it.

    Attributes:
        plant: the plant.
        name: name of the requirement.
        shape: form of the requirement.
        meant: the requirement.
        good: signal -> values of a recording that satisfies it, (samples,).
        bad: the same recording with an incident that violates it.
        incident: first and last sample of the incident.
        ranged: whether the specification declares ranges.
        main: the signal of the incident.
        other: another signal of the same unit, or the one of the condition.
    """

    plant: Plant
    name: str
    shape: Shape
    meant: Formula
    good: Mapping[str, Floats]
    bad: Mapping[str, Floats]
    incident: tuple[int, int]
    ranged: bool
    main: str
    other: str

    @property
    def seconds(self) -> float:
        """Duration of the recording."""
        return self.plant.dt * (self.plant.samples - 1)


def situations(rng: np.random.Generator, *shapes: Shape) -> Iterator[Situation]:
    """Yield random situations of the given shapes without end."""
    while True:
        plant = PLANTS[rng.integers(len(PLANTS))]
        shape = shapes[rng.integers(len(shapes))]
        for _ in range(_TRIES):
            found = _situation(rng, plant, shape)
            holds = robustness(found.meant, found.good, plant.dt)[0] > 0
            if holds and robustness(found.meant, found.bad, plant.dt)[0] < 0:
                yield found
                break


def motion(rng: np.random.Generator, channel: Channel, samples: int) -> Floats:
    """Return smooth values of a signal within the middle of its range, (samples,)."""
    t = np.linspace(0.0, 1.0, samples)
    waves = sum(
        rng.uniform(0.4, 1.0) * np.sin(2 * np.pi * (rng.uniform(0.5, 2.0 + 4 * k) * t + rng.uniform()))
        for k in range(4)
    )
    values: Floats = np.asarray(waves + 0.02 * rng.standard_normal(samples), dtype=np.float64)
    values = (values - values.min()) / (values.max() - values.min())
    if channel.flag:
        return np.where(values > rng.uniform(0.45, 0.7), 1.0, 0.0)
    low, high = sorted(rng.uniform((0.1, 0.55), (0.3, 0.7)))
    return np.asarray(channel.low + (channel.high - channel.low) * (low + (high - low) * values))


def amount(value: float, unit: str, digits: int = 3) -> str:
    """Return a number with its unit as a specification writes it."""
    text = f"{float(f'{value:.{digits}g}'):g}"
    return f"{text} {unit}" if unit else text


def atom(channel: Channel, op: Literal["<", "<=", ">", ">="], value: float) -> Atom:
    """Return a comparison with a number of three digits, written with its unit."""
    return Atom(channel.name, op, float(f"{value:.3g}"), amount(value, channel.unit))


def _situation(rng: np.random.Generator, plant: Plant, shape: Shape) -> Situation:
    good = {each.name: motion(rng, each, plant.samples) for each in plant.channels}
    reals = [each for each in plant.channels if not each.flag]
    main = reals[rng.integers(len(reals))]
    alike = [each for each in reals if each != main and each.unit == main.unit]
    rest = [each for each in plant.channels if each != main]
    other = alike[0] if alike and rng.random() < 0.5 else rest[rng.integers(len(rest))]
    first = int(rng.uniform(0.35, 0.65) * plant.samples)
    last = first + max(3, int(rng.uniform(0.04, 0.1) * plant.samples))
    up = rng.random() < 0.6
    values = good[main.name]
    span = main.high - main.low
    edge = (
        values.max() + rng.uniform(0.04, 0.12) * span if up else values.min() - rng.uniform(0.04, 0.12) * span
    )
    keep = atom(main, "<" if up else ">", edge)
    bad = dict(good)
    beyond = edge + (1 if up else -1) * rng.uniform(0.03, 0.08) * span
    bad[main.name] = _bump(values, first, last, beyond)
    condition: Formula
    if other.flag:
        condition = Flag(other.name)
        bad[other.name] = np.where(np.arange(plant.samples) >= first - 2, 1.0, good[other.name])
        bad[other.name][last + 2 :] = good[other.name][last + 2 :]
    else:
        level = np.quantile(good[other.name], rng.uniform(0.4, 0.7))
        condition = atom(other, ">", level)
        bad[other.name] = _bump(
            good[other.name], first - 2, last + 2, level + 0.15 * (other.high - other.low)
        )
    delay = max(2, int(rng.uniform(0.02, 0.06) * plant.samples)) * plant.dt
    meant = _meant(rng, plant, shape, keep, condition, round(delay, 6), good, main, up)
    if shape == "response":
        bad[main.name] = _bump(values, first - 2, last + 3 * round(delay / plant.dt), beyond)
    if shape == "sequence":
        bad[other.name] = _late(bad[other.name], condition, last + 3)
        good[other.name] = _late(good[other.name], condition, last + 3)
    return Situation(
        plant=plant,
        name=f"{main.name}_{('keeps', 'stays', 'safe', 'rule')[rng.integers(4)]}",
        shape=shape,
        meant=meant,
        good=good,
        bad=bad,
        incident=(first, last),
        ranged=bool(rng.random() < 0.6),
        main=main.name,
        other=other.name,
    )


def _bump(values: Floats, first: int, last: int, to: float) -> Floats:
    found = values.copy()
    found[max(first, 1) : last + 1] = to
    for k in range(1, 4):
        for at in (first - k, last + k):
            if 0 < at < len(found):
                found[at] += (to - found[at]) * (1 - k / 4) * 0.6
    return found


def _late(values: Floats, condition: Formula, until: int) -> Floats:
    """Return values with which a condition does not hold before the sample `until`, and then does."""
    found = values.copy()
    if isinstance(condition, Flag):
        found[:until], found[until:] = 0.0, 1.0
    elif isinstance(condition, Atom):
        width = max(np.ptp(values), 1e-3)
        found[:until] = np.minimum(found[:until], condition.value - 0.1 * width)
        found[until:] = np.maximum(found[until:], condition.value + 0.1 * width)
    return found


def _meant(
    rng: np.random.Generator,
    plant: Plant,
    shape: Shape,
    keep: Atom,
    condition: Formula,
    delay: float,
    good: Mapping[str, Floats],
    main: Channel,
    up: bool,
) -> Formula:
    values, span = good[main.name], main.high - main.low
    match shape:
        case "bound":
            return Over("always", None, keep)
        case "windowed":
            end = round(rng.uniform(0.85, 0.98) * plant.samples) * plant.dt
            return Over("always", (0.0, round(end, 6)), keep)
        case "band":
            far = values.min() - 0.1 * span if up else values.max() + 0.1 * span
            return Over("always", None, Joined("and", atom(main, ">" if up else "<", far), keep))
        case "pair":
            rest = [each for each in plant.channels if not each.flag and each != main]
            second = rest[rng.integers(len(rest))]
            high = good[second.name].max() + 0.2 * (second.high - second.low)
            return Over("always", None, Joined("and", atom(second, "<", high), keep))
        case "guarded":
            return Over("always", None, Joined("->", condition, keep))
        case "response":
            return Over("always", None, Joined("->", condition, Over("eventually", (0.0, delay), keep)))
        case "hold":
            return Over("always", None, Joined("->", condition, Over("always", (0.0, delay), keep)))
        case "sequence":
            return Until(keep, condition)


def steady(situation: Situation, name: str, value: float) -> Situation:
    """Return a situation in which a signal of the good recording has one value."""
    good = dict(situation.good) | {name: np.full(situation.plant.samples, value)}
    return replace(situation, good=good)
