"""Correct specifications with correct recordings: ordinary ones, and hard ones that look like mistakes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import cycle

import numpy as np

from benchmarks.mistakes import Files, cells, clock, correct, recorded, spec_text, table
from benchmarks.requirements import written
from benchmarks.scenes import SHAPES, Situation, amount, situations, steady

Rng = np.random.Generator


def ordinary(rng: Rng, count: int) -> Iterator[Files]:
    """Yield correct pairs; every third recording violates its requirement, and the answer is right."""
    for index, situation in zip(range(count), situations(rng, *SHAPES), strict=False):
        yield correct(situation, bad=index % 3 == 2)


def hard(rng: Rng, count: int) -> Iterator[Files]:
    """Yield correct pairs that look like mistakes, of each kind in turn."""
    for _, make, situation in zip(range(count), cycle(_HARD), situations(rng, *SHAPES), strict=False):
        yield make(rng, situation)


def _with(situation: Situation, line: str) -> Files:
    return Files(spec_text(situation, situation.meant, after=line), recorded(situation, situation.good))


def _initial(_: Rng, situation: Situation) -> Files:
    name = situation.main
    channel = situation.plant.channel(name)
    first, width = situation.good[name][0], 0.2 * (channel.high - channel.low)
    return _with(situation, f"require start: always[0 s, 0 s] {name} < {amount(first + width, channel.unit)}")


def _short_window(_: Rng, situation: Situation) -> Files:
    end = 10 * situation.plant.dt
    name = situation.main
    channel = situation.plant.channel(name)
    most = situation.good[name][:11].max() + 0.05 * (channel.high - channel.low)
    return _with(situation, f"require early: always[0 s, {end:g} s] {name} < {amount(most, channel.unit, 4)}")


def _parked(_: Rng, situation: Situation) -> Files:
    name = situation.main
    return correct(steady(situation, name, float(situation.good[name].mean())))


def _spike(_: Rng, situation: Situation) -> Files:
    name = situation.main
    values = situation.good[name].copy()
    values[len(values) // 2] += 0.4 * (values.min() - values.mean())
    return correct(replace(situation, good=dict(situation.good) | {name: values}))


def _unit_test(rng: Rng, situation: Situation) -> Files:
    samples = int(rng.integers(3, 9))
    every = situation.plant.samples // samples
    data = {name: values[::every][:samples] for name, values in situation.good.items()}
    return Files(spec_text(situation, situation.meant), recorded(situation, data))


def _idle(_: Rng, situation: Situation) -> Files:
    flag = next(each for each in situation.plant.channels if each.flag)
    name = situation.main
    channel = situation.plant.channel(name)
    high = amount(situation.good[name].max() + 0.02 * (channel.high - channel.low), channel.unit, 4)
    still = steady(situation, flag.name, 0.0)
    line = f"signal {flag.name} : bool\n" if flag.name not in written(situation.meant) else ""
    window = f"[0 s, {5 * situation.plant.dt:g} s]"
    return _with(still, f"{line}require idle: always ({flag.name} -> eventually{window} {name} < {high})")


def _steps(_: Rng, situation: Situation) -> Files:
    name = situation.main
    values = situation.good[name]
    held = np.repeat(values[::25], 25)[: len(values)]
    return correct(replace(situation, good=dict(situation.good) | {name: held}))


def _soon(_: Rng, situation: Situation) -> Files:
    name = situation.main
    channel = situation.plant.channel(name)
    high = amount(situation.good[name].max() + 0.02 * (channel.high - channel.low), channel.unit, 4)
    return _with(situation, f"require soon: eventually[0 s, {9 * situation.plant.dt:g} s] {name} < {high}")


def _two_clocks_that_agree(_: Rng, situation: Situation) -> Files:
    samples = situation.plant.samples
    epoch = [f"{1.7e9 + k * situation.plant.dt:.6f}" for k in range(samples)]
    columns = {"time": clock(situation, samples), "time_utc": epoch, **cells(situation, situation.good)}
    return Files(spec_text(situation, situation.meant), table(columns))


def _one_object(_: Rng, situation: Situation) -> Files:
    samples = situation.plant.samples
    columns = {"time": clock(situation, samples), "run": ["7"] * samples, **cells(situation, situation.good)}
    return Files(spec_text(situation, situation.meant), table(columns))


def _past(_: Rng, situation: Situation) -> Files:
    name = situation.main
    channel = situation.plant.channel(name)
    high = amount(situation.good[name].max() + 0.02 * (channel.high - channel.low), channel.unit, 4)
    window = f"[0 s, {5 * situation.plant.dt:g} s]"
    return _with(
        situation, f"require past: always (once{window} {name} < {high})  # as asked for in `require x`"
    )


def _apart(_: Rng, situation: Situation) -> Files:
    name = situation.main
    channel = situation.plant.channel(name)
    values = situation.good[name]
    low, high = (
        amount(end, channel.unit)
        for end in (values.mean(), values.mean() + 1e-3 * (channel.high - channel.low))
    )
    return _with(situation, f"require apart: eventually ({name} < {low} or {name} > {high})")


_HARD: tuple[Callable[[Rng, Situation], Files], ...] = (
    *(_initial, _short_window, _parked, _spike, _unit_test, _idle, _steps, _soon, _two_clocks_that_agree),
    *(_one_object, _past, _apart),
)
