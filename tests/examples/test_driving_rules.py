"""`specs/driving_rules.stl` against a count from the world's geometry, and drives that break each rule."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.traffic_drivers import Driver, careful, driver, reckless
from torch import Tensor

import stlc
from stlc.controller.world import world_type
from stlc.dynamics.system import System
from stlc.monitor.verdict import Monitor

pytestmark = pytest.mark.apart  # worlds of the examples: their own programs

ROOT = Path(__file__).parents[2]
DT = 0.1
AREA, HALF = 1.0, 0.5  # m: the stop area before a line, and how close to it who is told to yield may come
STAND, CLOSE = 0.1, 3.0
PATIENCE, GREEN = 51, 31  # samples of 5 s and of 3 s
RULES = ("no_collision", "red_light", "full_stop", "give_way", "get_on")


@pytest.fixture(scope="module")
def system() -> System:
    return System.load(ROOT / "examples/car.yaml")


@pytest.fixture(scope="module")
def monitor() -> Monitor:
    return Monitor(stlc.load(ROOT / "specs/driving_rules.stl"))


@dataclass(frozen=True)
class Seen:
    """A car at one sample, as the world knows it; nothing here is taken from the state that the car sees.

    Attributes:
        junction: that it drives to, or that it is in.
        inside: in a junction.
        left: metres to the next stop line.
        v: speed.
        passed: how many lines it went over.
        light: whether lights are at the next line, else a stop sign.
        red: what they show.
        granted: whether it may go over a line with a stop sign.
    """

    junction: int
    inside: bool
    left: float
    v: float
    passed: int
    light: bool
    red: bool
    granted: bool


@dataclass
class Film:
    """A drive of all cars: their states (cars, samples, n), what the world knows, who touched whom."""

    states: np.ndarray
    seen: list[list[Seen]]
    touches: set[tuple[int, int]]
    entered: list[set[int]]


def filmed(system: System, drive: Driver, seed: int, steps: int) -> Film:
    world: Any = world_type(system.decl)(system, 20, torch.Generator().manual_seed(seed))
    module = sys.modules[type(world).__module__]
    x = world.reset()
    states, seen, entered = [x], [look(world)], [set[int]()]
    for _ in range(steps):
        before = ways(world)
        x = world.advance(x, drive(x))
        states.append(x)
        seen.append(look(world))
        entered.append(in_the_way(world, module, before))
    return Film(torch.stack(states, 1).numpy(), seen, set(world.touched), entered)


def look(world: Any) -> list[Seen]:
    found, grid, shown = [], world.grid, world.snapshot()["shows"]
    for car in world.cars:
        past, ahead = (car.here, car.onward) if car.inside else (car.past, car.here)
        turn = grid.turn(*car.way)
        span = sys.modules[type(world).__module__].SPAN[turn]
        left = (
            span - car.s + grid.length[car.here, car.onward]
            if car.inside
            else grid.length[car.way[:2]] - car.s
        )
        light = bool(grid.light[ahead])
        shows = shown[ahead, grid.heading[past, ahead] % 2]
        passed = car.passed + car.inside
        granted = light or world.holder.get(ahead) is car
        found.append(Seen(ahead, car.inside, left, car.v, passed, light, light and shows == 0, granted))
    return found


@dataclass(frozen=True)
class Way:
    """A car in a junction, or too fast to stop before it: where, from where to where, whom it goes before."""

    here: int
    heading: int
    turn: int
    s: float
    rank: tuple[float, float]


def ways(world: Any) -> dict[int, Way]:
    """The cars that are in junctions, by number."""
    found = {}
    for index, car in enumerate(world.cars):
        if world._committed(car):
            heading, turn = world.grid.heading[car.past, car.here], world.grid.turn(*car.way)
            found[index] = Way(car.here, heading, turn, car.s if car.inside else 0.0, world._rank(car))
    return found


def in_the_way(world: Any, module: Any, before: dict[int, Way]) -> set[int]:
    """Cars that came to where a car in their junction was, or had to go before them: by their bodies."""
    poses, found = world._poses(), set()
    for index, mine in ways(world).items():
        for other, way in before.items():
            if other == index or way.here != mine.here:
                continue
            last = module.SPAN[way.turn] + module.LENGTH_CAR if way.rank < mine.rank else way.s + module.STEP
            rest = np.arange(way.s, last, module.STEP)
            swept = np.array([module.turn_pose(way.heading, way.turn, s) for s in rest]).reshape(-1, 3)
            swept += [*world.grid.places[way.here], 0.0]
            if module.overlap(poses[index], swept, grow=0.1).any():
                found.add(index)
    return found


# -------------------------------------------------------------------- an independent count


def broken(film: Film, car: int) -> set[str]:
    """The rules that a car broke, counted sample by sample; collisions are counted apart."""
    rows, dx = [seen[car] for seen in film.seen], film.states[car, :, 4]
    found = set()
    for now, later in pairwise(rows):
        if later.passed > now.passed and now.red:
            found.add("red_light")
        if later.passed > now.passed and not now.granted:
            found.add("give_way")
    for now in rows:
        if now.red and 0.0 < now.left < AREA:
            found.add("red_light")
        if not now.granted and now.left < HALF:
            found.add("give_way")
    if any(len(stop) < 10 or min(stop) > STAND for stop in stops(rows)):
        found.add("full_stop")
    longest = at_green = run = green = 0
    for k, now in enumerate(rows):
        waits = now.v <= STAND and not now.red and now.granted and not 0 <= dx[k] <= CLOSE
        waits &= now.light or now.left > AREA or long_here(rows, k)
        run, green = (run + 1 if waits else 0), (green + 1 if waits and now.light else 0)
        longest, at_green = max(longest, run), max(at_green, green)
    if longest >= PATIENCE or at_green >= GREEN:
        found.add("get_on")
    return found


def stops(rows: list[Seen]) -> list[list[float]]:
    """Speeds in the stop area before each line with a stop sign that a car went over, sample by sample."""
    found, speeds = [], list[float]()
    for now, later in pairwise(rows):
        speeds = [*speeds, now.v] if now.left <= AREA else []
        if later.passed > now.passed:
            if not now.light:
                found.append(speeds)
            speeds = []
    return found


def long_here(rows: list[Seen], k: int) -> bool:
    """True if a car has been in the stop area for 1 s."""
    return k >= 10 and all(row.left <= AREA and row.passed == rows[k].passed for row in rows[k - 10 : k + 1])


def verdicts(monitor: Monitor, film: Film, system: System) -> list[set[str]]:
    """The rules that each car broke, by the specification."""
    columns = np.moveaxis(film.states, -1, 0)
    verdict = monitor.check(dict(zip(system.names, columns, strict=True)))
    assert verdict.satisfied is not None, "undecided on a finished drive"
    assert tuple(judgement.name for judgement in verdict) == RULES
    return [
        {judgement.name for judgement in verdict if judgement.statuses[car] == "violated"}
        for car in range(len(film.states))
    ]


def compare(monitor: Monitor, film: Film, system: System) -> list[set[str]]:
    """Verdicts of the specification, after they have been compared with the count."""
    told = verdicts(monitor, film, system)
    for car, rules in enumerate(told):
        assert rules - {"no_collision"} == broken(film, car), f"car {car}"
    collided = {car for car, rules in enumerate(told) if "no_collision" in rules}
    for pair in film.touches:
        assert collided & {*pair}, f"{pair} overlap and nobody is to blame"
    touched = {car for pair in film.touches for car in pair} | set().union(*film.entered)
    assert collided <= touched, f"{collided - touched} touched nobody, nor came into anybody's way"
    return told


# ----------------------------------------------------------------------------------- drives

SOME = (0, 5, 9, 13)  # the cars that break a rule, among careful ones


def among_careful(bad: Driver, cars: tuple[int, ...] = SOME) -> Driver:
    def both(x: Tensor) -> Tensor:
        good, other = careful(x), bad(x)
        chosen = torch.zeros(len(x), 1, dtype=torch.bool)
        chosen[list(cars)] = True
        return torch.where(chosen, other, good)

    return both


@pytest.mark.parametrize("seed", range(3))
def test_careful_cars_obey_every_rule(monitor: Monitor, system: System, seed: int) -> None:
    assert compare(monitor, filmed(system, careful, seed, 100), system) == [set()] * 20


@pytest.mark.parametrize(
    ("rule", "bad"),
    [
        ("no_collision", driver(blind=True)),
        ("red_light", driver(reds=False)),
        ("full_stop", driver(stay=0.0)),
        pytest.param("full_stop", driver(stay=0.45), marks=pytest.mark.apart),
        pytest.param("full_stop", driver(stay=0.0, creep=0.5), marks=pytest.mark.apart),
        ("give_way", driver(yields=False)),
        ("get_on", driver(lazy=True)),
    ],
)
def test_a_rule_is_broken_by_who_breaks_it(monitor: Monitor, system: System, rule: str, bad: Driver) -> None:
    """Cars that keep all rules but one, among careful ones: some break it, and nobody breaks another."""
    seeds = range(2 if rule == "give_way" else 1)
    found = [compare(monitor, filmed(system, among_careful(bad), seed, 150), system) for seed in seeds]
    assert any(rule in told[car] for told in found for car in SOME)
    others = set().union(*(told[car] for told in found for car in range(20) if car not in SOME))
    assert others <= {"no_collision"}, "who is run into may break off no rule of its own"
    if rule != "give_way":  # who takes the way of another may hit it, too
        assert set().union(*(told[car] for told in found for car in SOME)) <= {rule, "no_collision"}


@pytest.mark.parametrize("seed", range(2))
def test_reckless_cars_are_told_what_they_did(monitor: Monitor, system: System, seed: int) -> None:
    told = compare(monitor, filmed(system, reckless(seed), seed, 100), system)
    assert {"red_light", "full_stop", "give_way"} <= set().union(*told)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 130))
def test_the_count_and_the_rules_agree_on_many_drives(monitor: Monitor, system: System, seed: int) -> None:
    bad = (
        careful,
        reckless(seed),
        among_careful(reckless(seed)),
        *(
            among_careful(driver(**how), tuple(range(seed % 3, 20, 3)))  # type: ignore[arg-type]
            for how in ({"blind": True}, {"reds": False}, {"stay": 0.5}, {"yields": False}, {"lazy": True})
        ),
    )
    for drive in bad:
        compare(monitor, filmed(system, drive, seed, 150), system)
