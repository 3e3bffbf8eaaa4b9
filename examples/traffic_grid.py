"""The traffic of Meng & Fan (2023): cars on a 4 x 5 grid of junctions with lights, stop signs and queues.

The true world for the model of `car.yaml`. Each car moves along its own path by the model's step function;
leaders, lights and signs are simulated here. Right-hand traffic, metres, seconds.

* A leader is the nearest car ahead on the own path, through the junction and into the lane behind it, with
  the constant speed that is safe to assume if it brakes. A car in the junction ahead on a crossing or merging
  path (or that cannot stop before it any more) stands for a leader at rest where the paths begin to conflict.
* At a stop sign one car has the right of way, the nearest of the first cars of all lanes, until it has left
  the junction; all others yield. So `yielding` only goes from 1 to 0 while a car approaches.
* The full cycle of a light is T_total + 2 c. The timer that cars see is held at 0 for 2 c when red begins,
  then runs on; the crossing direction is half a cycle later. So c seconds of red for all lie between greens:
  c = 1.5 s is what a car of 1 m needs at 5 m/s for the box of 6 m. No plan reaches from the start of red to
  the next green, so none relies on green too early.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import torch

from stlc.controller.sketch import (
    GOAL,
    NOTE,
    ROAD,
    STOP_LIGHT,
    deciders,
    outlines,
    plans,
    scale_bar,
    segments,
    tails,
    violations,
)

COLUMNS, ROWS = 4, 5
COLUMN_SPACING = (13.0, 15.0, 18.0, 21.0)
ROW_SPACING = (15.0, 16.0, 18.0, 23.0)
WIDTH = 6.0  # of a road, both directions
LENGTH_CAR, WIDTH_CAR = 1.0, 0.6
SIGHT = 10.0  # m: viewing distance for the stop line and leaders
BRAKE = 10.0  # m/s^2
ALL_RED = 1.5  # s, the c above
START_SPEED = 5.0  # m/s
DIRECTIONS = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])  # east, north, west, south
LEFT, STRAIGHT, RIGHT = 1, 0, -1
RADIUS = {LEFT: 0.75 * WIDTH, RIGHT: 0.25 * WIDTH}
SPAN = {STRAIGHT: WIDTH, LEFT: math.pi / 2 * RADIUS[LEFT], RIGHT: math.pi / 2 * RADIUS[RIGHT]}
STEP, BEFORE = 0.1, 2.0  # m: resolution of the conflict tables, and how long before the box they begin
LANES = {"color": ROAD, "lw": 0}
SHOWN = {-1: NOTE, 0: STOP_LIGHT, 1: GOAL}  # stop sign, red, green
SEEN = np.array([(0.0, -1.0), (1.0, 0.0)])  # map to picture: a quarter turn to the right
CAR = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (0.9 * LENGTH_CAR, 0.9 * WIDTH_CAR)
TAIL = 12  # frames of a visible trail


def right_of(direction: int) -> np.ndarray:
    """The unit vector to the right of a direction of travel."""
    return DIRECTIONS[(direction - 1) % 4]


def turn_pose(direction: int, turn: int, s: float) -> tuple[float, float, float]:
    """Position from the junction's centre, and heading, after `s` metres of a turn from `direction`."""
    forward, right = DIRECTIONS[direction], right_of(direction)
    entry = -WIDTH / 2 * forward + WIDTH / 4 * right
    heading = direction * math.pi / 2
    ahead, aside = s, 0.0
    if turn != STRAIGHT and s > 0:
        radius, over = RADIUS[turn], max(s - SPAN[turn], 0.0)
        angle = (s - over) / radius
        ahead, aside = radius * math.sin(angle), -turn * (radius * (1 - math.cos(angle)) + over)
        heading += turn * angle
    x, y = (entry + ahead * forward + aside * right).tolist()
    return x, y, heading


def overlap(a: np.ndarray, b: np.ndarray, grow: float = 0.0) -> np.ndarray:
    """True if cars at the poses `a`, `b` (..., 3), grown by `grow` metres, intersect (separating axes)."""
    half = np.array([LENGTH_CAR, WIDTH_CAR]) / 2 + grow
    delta = b[..., :2] - a[..., :2]
    turned = np.abs(np.stack([np.cos(b[..., 2] - a[..., 2]), np.sin(b[..., 2] - a[..., 2])], -1))
    reach = half + np.stack([turned @ half, turned @ half[::-1]], -1)  # own half side and the other's shadow
    hit = np.ones(delta.shape[:-1], dtype=bool)
    for pose in (a, b):
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        along = delta[..., 0] * cos + delta[..., 1] * sin
        across = delta[..., 1] * cos - delta[..., 0] * sin
        hit &= (np.abs(along) < reach[..., 0]) & (np.abs(across) < reach[..., 1])
    return hit


def counted_on(v: float, v_lead: float, dt: float) -> float:
    """Constant speed of a leader that requires the same gap as one with maximum braking."""
    slower = max(v_lead - BRAKE * dt, 0.0)
    return slower if v <= slower else v - math.sqrt(v**2 - slower**2)


@cache
def conflicts(relative: int, mine: int, other: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Conflict tables with the turn of a car that entered `relative` quarter turns to the left of mine.

    Both are over the other's position (from 0, every `STEP`): my first position that intersects its remaining
    swept area, and my first position that intersects its present body; infinity for none.
    """
    own = np.arange(-BEFORE, SPAN[mine] + LENGTH_CAR, STEP)
    theirs = np.arange(0.0, SPAN[other] + LENGTH_CAR, STEP)
    a = np.array([turn_pose(0, mine, s) for s in own])[:, None]
    b = np.array([turn_pose(relative, other, s) for s in theirs])[None]

    def first(hit: np.ndarray) -> tuple[float, ...]:
        return tuple(np.where(hit.any(0), own[hit.argmax(0)], np.inf).tolist())

    swept = np.logical_or.accumulate(overlap(a, b, grow=0.05)[:, ::-1], axis=1)[:, ::-1]
    return first(swept), first(overlap(a, b))


def draw_roads(axes: Any, places: np.ndarray, shows: np.ndarray) -> None:
    """Draw roads between junctions (20, 2) of the picture, and stop lines with their signals (20, 2)."""
    from matplotlib.collections import PolyCollection

    low, high = places.min(0), places.max(0)
    (left, bottom), (right, top) = low - WIDTH / 2, high + WIDTH / 2
    roads = [(x - WIDTH / 2, x + WIDTH / 2, bottom, top) for x in set(places[:, 0])]
    roads += [(left, right, y - WIDTH / 2, y + WIDTH / 2) for y in set(places[:, 1])]
    corners = [[(a, c), (b, c), (b, d), (a, d)] for a, b, c, d in roads]
    axes.add_collection(PolyCollection(corners, **LANES))
    marks, lines = list[np.ndarray](), dict[int, list[np.ndarray]]()
    for direction, forward in enumerate(WIDTH * DIRECTIONS @ SEEN):
        known = (np.abs(places - forward - (low + high) / 2) < (high - low) / 2 + 1).all(1)
        marks.append(places[known][:, None] + np.outer((-0.6, -1.1), forward))
        line = np.outer((0.06, 0.44), WIDTH * right_of(direction) @ SEEN) - forward / 2
        for state in SHOWN:
            shown = places[known & (shows[:, direction % 2] == state)]
            lines.setdefault(state, []).append(shown[:, None] + line)
    segments(axes, np.concatenate(marks), "white", 1.0)
    for state, color in SHOWN.items():
        segments(axes, np.concatenate(lines[state]), color, 2.4)


@dataclass(slots=True)
class Car:
    """One car, on the lane from `past` to `here` or `inside` junction `here`; then to `onward`, `beyond`."""

    past: int
    here: int
    onward: int
    beyond: int
    inside: bool = False
    s: float = 0.0  # metres along the lane or the turn
    v: float = START_SPEED
    tau: float = 0.0
    order: float = math.inf  # step at which it entered the junction
    passed: int = 0

    @property
    def way(self) -> tuple[int, int, int]:
        """The route through a junction: the junction, from, to."""
        return self.past, self.here, self.onward


Lead = tuple[float, float]  # bumper gap in metres, speed
Lanes = dict[tuple[int, int], list[Car]]  # first in lane first
Inside = dict[int, list[Car]]  # in a junction, or about to be


@dataclass(slots=True)
class Grid:
    """Positions of the junctions, which have lights, and their phases."""

    places: np.ndarray  # (20, 2)
    light: np.ndarray  # (20,) bool
    phase: np.ndarray  # (20,) seconds
    neighbours: list[dict[int, int]] = field(default_factory=list)  # direction -> junction
    heading: dict[tuple[int, int], int] = field(default_factory=dict)
    length: dict[tuple[int, int], float] = field(default_factory=dict)

    @classmethod
    def drawn(cls, rng: np.random.Generator, cycle: float) -> Grid:
        """Random spacings, signs and phases; the four corners always have stop signs."""
        xs = np.concatenate([[0.0], np.cumsum(rng.choice(COLUMN_SPACING, COLUMNS - 1))])
        ys = np.concatenate([[0.0], np.cumsum(rng.choice(ROW_SPACING, ROWS - 1))])
        places = np.array([(x, y) for y in ys for x in xs])
        light = rng.random(len(places)) < 0.5
        light[[0, COLUMNS - 1, -COLUMNS, -1]] = False
        grid = cls(places, light, rng.uniform(0, cycle, len(places)))
        for junction in range(len(places)):
            row, col = divmod(junction, COLUMNS)
            around = ((row, col + 1), (row + 1, col), (row, col - 1), (row - 1, col))
            arms = [(d, r, c) for d, (r, c) in enumerate(around) if r in range(ROWS) and c in range(COLUMNS)]
            near = {d: r * COLUMNS + c for d, r, c in arms}
            grid.neighbours.append(near)
            for direction, other in near.items():
                grid.heading[junction, other] = direction
                grid.length[junction, other] = float(np.abs(places[other] - places[junction]).sum()) - WIDTH
        return grid

    def turn(self, past: int, here: int, onward: int) -> int:
        """LEFT, STRAIGHT or RIGHT."""
        return (self.heading[here, onward] - self.heading[past, here] + 1) % 4 - 1

    def choose(self, past: int, here: int, rng: np.random.Generator) -> int:
        """A random next junction: no U-turn, and no left turn at a light."""
        ways = [j for j in self.neighbours[here].values() if j != past]
        if self.light[here]:
            ways = [j for j in ways if self.turn(past, here, j) != LEFT]
        return int(ways[rng.integers(len(ways))])

    def pose(self, car: Car) -> tuple[float, float, float]:
        """Position and heading of a car."""
        s = car.s - (0.0 if car.inside else self.length[car.past, car.here])
        x, y, angle = turn_pose(self.heading[car.past, car.here], self.turn(*car.way), s)
        return x + float(self.places[car.here][0]), y + float(self.places[car.here][1]), angle


class TrafficGrid:
    """The world of `car.yaml`; see the module's text. Implements `stlc.controller.world.World`."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents = system, agents
        self.rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
        self.at = {name: index for index, name in enumerate(system.names)}
        self.period = float(system.decl.constants["T_total"][0])
        self.cycle = self.period + 2 * ALL_RED
        self.grid = Grid.drawn(self.rng, self.cycle)
        if agents > len(self.grid.length):
            raise ValueError(f"{agents} cars do not fit on {len(self.grid.length)} lanes")

    def reset(self) -> torch.Tensor:
        """Place every car at 5 m/s at the start of a lane, the first 20 from different junctions."""
        starts: list[tuple[int, int]] = []
        while len(starts) < self.agents:
            for junction in self.rng.permutation(len(self.grid.neighbours)).tolist():
                free = [j for j in self.grid.neighbours[junction].values() if (junction, j) not in starts]
                if free and len(starts) < self.agents:
                    starts.append((junction, int(self.rng.choice(free))))
        self.cars = []
        for past, here in starts:
            onward = self.grid.choose(past, here, self.rng)
            self.cars.append(Car(past, here, onward, self.grid.choose(here, onward, self.rng)))
        self.clock, self.holder = 0, dict[int, Car]()
        self.speeds, self.touched, self.min_gap = 0.0, set[tuple[int, int]](), SIGHT
        return self._observe()

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance every car by one model step; (agents, n), (agents, m) -> (agents, n)."""
        moved = self.system.step(x, action)
        travel = (moved[:, self.at["x"]] - x[:, self.at["x"]]).tolist()
        speed, tau = moved[:, self.at["v"]].tolist(), moved[:, self.at["tau"]].tolist()
        self.clock += 1
        self.speeds += sum(speed)
        for index, car in enumerate(self.cars):
            car.s, car.v, car.tau = car.s + travel[index], speed[index], tau[index]
            self._pass_on(car, travel[index])
        self._count_overlaps()
        return self._observe()

    def progress(self) -> Mapping[str, float]:
        """Mean speed, junctions passed, pairs of cars that ever overlapped, smallest gap in view."""
        return {
            "mean_speed": self.speeds / max(self.clock * self.agents, 1),
            "junctions_passed": float(sum(car.passed for car in self.cars)),
            "overlapping_pairs": float(len(self.touched)),
            "min_gap": self.min_gap,
        }

    def units(self) -> Mapping[str, str]:
        """Units of the entries of `progress`."""
        return {"mean_speed": "m/s", "min_gap": "m"}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Poses (agents, 3), junctions (20, 2), and their signals (20, 2) for east-west and north-south cars.

        `shows` is -1 for a stop sign, 0 for red, 1 for green.
        """
        green = [[self._timer(j, d) > self.period / 2 for d in (0, 1)] for j in range(len(self.grid.places))]
        shows = np.where(self.grid.light[:, None], np.array(green, dtype=np.int8), np.int8(-1))
        return {"pose": self._poses(), "junctions": self.grid.places, "shows": shows}

    def charted(self, states: torch.Tensor) -> np.ndarray:
        """Planned states (agents, k, n) as positions on the path of each car, (agents, k, 2)."""
        x = states[..., self.at["x"]].numpy()
        places = np.full((*x.shape, 2), np.nan)
        for car, own, row in zip(self.cars, x, places, strict=True):
            if np.isfinite(own).all():
                row[:] = [self.grid.pose(replace(car, s=car.s + float(s - own[0])))[:2] for s in own]
        return places

    KEYS: ClassVar = {"red light": SHOWN[0], "green light": SHOWN[1], "stop sign": SHOWN[-1]}

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame, north to the right: roads, signs, and cars coloured by decision source."""
        poses = np.concatenate((scene["pose"][..., :2] @ SEEN, scene["pose"][..., 2:] - math.pi / 2), -1)
        draw_roads(axes, scene["junctions"][index] @ SEEN, scene["shows"][index])
        tails(axes, poses[..., :2], scene, index, frames=TAIL)
        outlines(axes, CAR, poses[index], deciders(scene, index, poses.shape[1]))
        plans(axes, scene, index, lambda places: places @ SEEN)
        violations(axes, poses[index, :, :2], scene, index)
        right, bottom = axes.get_xlim()[1], axes.get_ylim()[0]
        scale_bar(axes, right - 14, bottom - 2, 10)
        axes.set_aspect("equal")
        axes.set_axis_off()

    def _pass_on(self, car: Car, travel: float) -> None:
        if not car.inside and car.s > self.grid.length[car.past, car.here]:
            car.s -= self.grid.length[car.past, car.here]
            car.inside, car.tau, car.order = True, 0.0, self.clock - car.s / travel
        span = SPAN[self.grid.turn(*car.way)]
        if car.inside and car.s > span:
            car.s, car.inside, car.order, car.passed = car.s - span, False, math.inf, car.passed + 1
            car.past, car.here, car.onward = car.here, car.onward, car.beyond
            car.beyond = self.grid.choose(car.here, car.onward, self.rng)

    def _poses(self) -> np.ndarray:
        return np.array([self.grid.pose(car) for car in self.cars]).reshape(-1, 3)

    def _count_overlaps(self) -> None:
        poses = self._poses()
        first, second = np.triu_indices(len(poses), 1)
        near = np.abs(poses[first, :2] - poses[second, :2]).max(-1) < 2 * LENGTH_CAR
        pairs = np.stack((first[near], second[near]), 1)
        self.touched.update(map(tuple, pairs[overlap(*poses[pairs.T])].tolist()))

    def _to_line(self, car: Car) -> float:
        """Metres to the next stop line."""
        if car.inside:
            return SPAN[self.grid.turn(*car.way)] - car.s + self.grid.length[car.here, car.onward]
        return self.grid.length[car.past, car.here] - car.s

    def _committed(self, car: Car) -> bool:
        """True if a car is inside a junction, or too fast to stop before it."""
        return car.inside or car.v**2 / (2 * BRAKE) + car.v * self.system.dt / 2 > self._to_line(car)

    def _rank(self, car: Car) -> tuple[float, float]:
        """Priority key: by time of entry, then cars that cannot stop, the nearest first."""
        return car.order, self._to_line(car) if self._committed(car) else math.inf

    def _timer(self, junction: int, direction: int) -> float:
        """Timer of the light of `junction` for cars that travel in `direction`."""
        shift = self.cycle / 2 if direction % 2 == 0 else 0.0
        now = (self.grid.phase[junction] + self.clock * self.system.dt + shift) % self.cycle
        return max(float(now) - 2 * ALL_RED, 0.0)

    def _grant(self, lanes: Lanes, inside: Inside) -> None:
        """Give each free stop junction to the nearest first-in-lane car."""
        for junction in np.flatnonzero(~self.grid.light).tolist():
            holder = self.holder.get(junction)
            if holder is not None and holder.here == junction:
                continue
            self.holder.pop(junction, None)
            arms = self.grid.neighbours[junction].values()
            queue = [lanes[arm, junction][0] for arm in arms if lanes.get((arm, junction))]
            if queue and not inside.get(junction):
                self.holder[junction] = max(queue, key=lambda c: c.v**2 / (2 * BRAKE) - self._to_line(c))

    def _observe(self) -> torch.Tensor:
        lanes, inside = Lanes(), Inside()
        for car in sorted(self.cars, key=lambda car: -car.s):
            if car.inside:
                inside.setdefault(car.here, []).append(car)
            else:
                lanes.setdefault((car.past, car.here), []).append(car)
        self._grant(lanes, inside)
        for car in self.cars:
            if not car.inside and self._committed(car):
                inside.setdefault(car.here, []).append(car)
        rows = np.zeros((self.agents, len(self.at)))
        for row, car in zip(rows, self.cars, strict=True):
            self._fill(row, car, self._leader(car, lanes, inside))
        return torch.from_numpy(rows)

    def _fill(self, row: np.ndarray, car: Car, lead: Lead) -> None:
        """Fill in the model state as observed by this car."""
        past, ahead = (car.here, car.onward) if car.inside else (car.past, car.here)
        light = bool(self.grid.light[ahead])
        gap, speed = lead
        seen = gap <= SIGHT
        row[self.at["x"]] = max(-self._to_line(car), -SIGHT)
        row[self.at["v"]] = car.v
        row[self.at["sign"]] = light
        row[self.at["tau"]] = self._timer(ahead, self.grid.heading[past, ahead]) if light else car.tau
        row[self.at["dx"]] = max(gap, 0.0) if seen else -1.0
        row[self.at["v_lead"]] = counted_on(car.v, speed, self.system.dt) if seen else 0.0
        row[self.at["yielding"]] = not light and self.holder.get(ahead) is not car

    def _leader(self, car: Car, lanes: Lanes, inside: Inside) -> Lead:
        """The nearest car on the path of `car`, or one in the junction ahead with right of way."""
        found, start = list[Lead](), -car.s  # and where the considered road segment begins
        ways = car.way, (car.here, car.onward, car.beyond)
        route = (ways[0][:2], ways[0], ways[1][:2], ways[1], ways[1][1:])
        for piece in route[car.inside :]:
            if start > SIGHT + LENGTH_CAR or found:
                break
            if len(piece) == 2:
                ahead = [other for other in lanes.get(piece, ()) if other.s > -start]
                found += [(start + other.s - LENGTH_CAR, other.v) for other in ahead]
                start += self.grid.length[piece]
            else:
                others = [other for other in inside.get(piece[1], ()) if other is not car]
                found += [lead for other in others if (lead := self._inside(car, other, piece, -start))]
                start += SPAN[self.grid.turn(*piece)]
        lead = min(found, default=(math.inf, 0.0))
        self.min_gap = min(self.min_gap, lead[0])
        return lead

    def _inside(self, car: Car, other: Car, way: tuple[int, int, int], mine: float) -> Lead | None:
        """Gap to and speed of `other` in the junction of `way`, seen from `mine` metres into it."""
        (past, here, onward), theirs = way, other.s if other.inside else 0.0
        if other.past == past:
            clear = other.onward != onward and self._meet(way, other, theirs)[1] == math.inf
            ahead = other.inside and theirs > mine and not clear
            return (theirs - mine - LENGTH_CAR, other.v) if ahead else None
        waits = not car.inside and not self.grid.light[here] and self.holder.get(here) is not car
        if here != car.here or waits:
            return None
        swept, body = self._meet(way, other, theirs)
        if self._rank(other) < self._rank(car) and mine <= swept < math.inf:
            return swept - mine, 0.0
        return (body - mine, 0.0) if other.inside and mine <= body < math.inf else None

    def _meet(self, way: tuple[int, int, int], other: Car, theirs: float) -> tuple[float, float]:
        relative = (self.grid.heading[other.past, other.here] - self.grid.heading[way[0], way[1]]) % 4
        tables = conflicts(relative, self.grid.turn(*way), self.grid.turn(*other.way))
        index = min(int(theirs / STEP), len(tables[0]) - 1)
        return tables[0][index], tables[1][index]
