"""The specifications by which drives of the worlds are judged: good drives obey, bad ones break one rule."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import stlc
from stlc.dynamics.load import load_system_decl
from stlc.monitor.verdict import Monitor

ROOT = Path(__file__).parents[2]
SYSTEMS = ("car", "maze", "rover", "panda", "ship_safe", "ship_track")
Columns = dict[str, np.ndarray]


def broken(name: str, columns: Columns) -> set[str]:
    """The rules that a drive breaks; it is never undecided."""
    system = "examples/panda.yaml" if name == "manipulation_rules" else None
    monitor = Monitor(stlc.load(ROOT / f"specs/{name}.stl"), system=None if system is None else ROOT / system)
    verdict = monitor.check(columns)
    assert "inconclusive" not in {judgement.status for judgement in verdict}
    return {judgement.name for judgement in verdict if judgement.status == "violated"}


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_names_a_judge_that_fits_it(name: str) -> None:
    path = ROOT / f"examples/{name}.yaml"
    decl = load_system_decl(path)
    assert decl.test.judge is not None
    assert decl.test.judge.path.is_file()
    spec = stlc.load(decl.test.judge.path)
    assert Monitor(spec, system=path).requirements
    assert spec.system == f"../examples/{name}.yaml"


# ------------------------------------------------------------------------ reach-n-avoid


def shaft(goals: tuple[float, ...], xs: tuple[float, ...], *, obstacle: float = 1.5) -> Columns:
    """A ball that rises past levels with an obstacle from 0 on, at xs while it is on each level."""
    columns: dict[str, list[float]] = {
        name: [] for name in ("x", "v", "dy", "x0", "l0", "g0", "x1", "l1", "g1")
    }
    for k in range(int(2.5 * len(goals) / 0.2)):
        height = 0.2 * k
        level = min(int(height / 2.5 - 1e-9), len(goals) - 2)
        row = {"x": xs[level], "v": 0.0, "dy": height - 2.5 * (level + 1), "x0": 0.0, "l0": obstacle}
        row |= {"g0": goals[level], "x1": 0.0, "l1": obstacle, "g1": goals[level + 1]}
        for name, value in row.items():
            columns[name].append(value)
    return {name: np.array(values) for name, values in columns.items()}


def test_a_ball_that_keeps_away_and_reaches_each_goal_obeys() -> None:
    assert broken("reach_n_avoid_rules", shaft((3.0, -1.0, 4.0, -1.0, -1.0), (3.1, 2.0, 3.8, 2.0))) == set()


def test_a_ball_in_an_obstacle_or_past_a_goal_is_told() -> None:
    hit = shaft((3.0, -1.0, -1.0), (3.1, 1.0, 2.0))
    assert broken("reach_n_avoid_rules", hit) == {"no_hit"}
    missed = shaft((3.0, -1.0, 4.0, -1.0, -1.0), (3.1, 2.0, 3.5, 2.0))
    assert broken("reach_n_avoid_rules", missed) == {"every_goal"}
    assert broken("reach_n_avoid_rules", shaft((-1.0, 4.0), (2.0, 2.0))) == set()  # passed by nobody yet
    late = shaft((3.0, 3.0, 3.0, -1.0, -1.0), (3.1, 3.1, 2.0, 2.0))
    assert broken("reach_n_avoid_rules", late) == {
        "every_goal"
    }  # that of the level before counts for nothing


# -------------------------------------------------------------------------- navigation


def way(seconds: float = 30.0, every: float = 8.0) -> Columns:
    """A rover in the open that reaches a destination every so many seconds and keeps its charge."""
    k = np.arange(int(seconds / 0.2) + 1)
    number = k // round(every / 0.2)
    xd = np.where(number % 2 == 0, 4.0, 9.0)
    near = k % round(every / 0.2) == round(every / 0.2) - 1
    x = np.where(near, xd, 6.5)
    still = np.ones(len(k))
    return {
        **{"x": x, "y": 5.0 * still, "xd": xd, "yd": 5.0 * still, "xc": 1.0 * still, "yc": 6.0 * still},
        **{"tau_b": 3.0 * still, "tau_s": 0.6 * still},
    }


def test_a_rover_that_arrives_with_charge_obeys() -> None:
    open_ground = way() | {
        "y": np.full(151, 3.3),
        "yd": np.full(151, 3.3),
    }  # south of the block in the middle
    assert broken("navigation_rules", open_ground) == set()


def test_a_rover_that_crashes_runs_empty_or_never_arrives_is_told() -> None:
    good = way() | {"y": np.full(151, 3.3), "yd": np.full(151, 3.3)}
    jump = {name: value.copy() for name, value in good.items()}
    jump["x"][60:], jump["y"][60:] = 6.5, 6.9
    jump["yd"][60:] = 6.9
    jump["x"] = np.where(
        (jump["x"] == 4.0) | (jump["x"] == 9.0), jump["x"], np.where(np.arange(151) < 60, 4.6, 5.4)
    )
    assert "no_crash" in broken("navigation_rules", jump)  # through the block between two samples
    assert broken("navigation_rules", good | {"y": np.full(151, 10.2), "yd": np.full(151, 10.2)}) >= {
        "stay_on_map"
    }
    empty = good["tau_b"].copy()
    empty[40:42] = (0.0, -0.2)
    assert broken("navigation_rules", good | {"tau_b": empty}) == {"battery"}
    assert broken("navigation_rules", good | {"yd": np.full(151, 9.0)}) == {"every_destination"}
    slow = way(every=14.0) | {"y": np.full(151, 3.3), "yd": np.full(151, 3.3)}
    assert broken("navigation_rules", slow) == {"every_destination"}


# ------------------------------------------------------------------------ manipulation

HOME = (0.0, 0.2, 0.0, -1.5, 0.0, 1.8, 0.0)


def arm(goal: tuple[float, float, float], q: tuple[float, ...] = HOME, samples: int = 41) -> Columns:
    columns = {f"q[{joint}]": np.full(samples, angle) for joint, angle in enumerate(q)}
    return columns | {f"goal[{axis}]": np.full(samples, value) for axis, value in enumerate(goal)}


def flange(q: tuple[float, ...]) -> tuple[float, float, float]:
    from stlc.controller.world import world_type
    from stlc.dynamics.system import System

    links = sys.modules[world_type(System.load(ROOT / "examples/panda.yaml").decl).__module__].links
    x, y, z = links(np.array([q]))[0, -1].tolist()
    return x, y, z


def test_an_arm_at_its_goals_obeys_and_one_that_is_not_is_told() -> None:
    there = flange(HOME)
    assert broken("manipulation_rules", arm(there)) == set()
    away = (there[0] - 0.3, there[1], there[2])
    assert broken("manipulation_rules", arm(away)) == {"every_goal"}
    beyond = arm(there)
    beyond["q[3]"] = np.where(np.arange(41) == 7, 0.0, beyond["q[3]"])
    assert "joints" in broken("manipulation_rules", beyond)


def test_an_arm_in_the_post_is_told() -> None:
    towards = (np.pi / 4, -0.4, 0.0, -2.4, 0.0, 2.0, 0.0)
    place = np.array(flange(towards))
    assert np.linalg.norm(place - (0.3, 0.3, 0.5)) < 0.2
    assert broken("manipulation_rules", arm(flange(towards), towards)) == {"clear"}


# ------------------------------------------------------------------------------- ships


def river(y: np.ndarray, *, obstacles: tuple[tuple[float, float, float], ...], passed: float) -> Columns:
    """A ship at 4 m/s; obstacles (x, y, r) in order, passed when it is `passed` metres behind the centre."""
    x = 0.6 * np.arange(len(y))
    front = np.array([sum(at > ox + passed for ox, _, _ in obstacles[:-2]) for at in x])
    columns = {"x": x, "y": y, "psi": 0 * y, "u": 0 * y + 4, "v": 0 * y, "r": 0 * y, "tau": 0 * y + 2}
    for offset in (0, 1):
        for index, name in enumerate("xyr"):
            seen = [obstacles[k + offset][index] for k in front]
            columns[f"{name}{offset + 1}"] = np.array(seen)
    return columns


STONES = ((6.3, 1.5, 1.0), (13.8, -1.5, 1.0), (30.0, 0.0, 1.0), (60.0, 0.0, 1.0))


@pytest.mark.parametrize(("rules", "passed"), [("ship_safe_rules", 0.0), ("ship_track_rules", 1.0)])
def test_ships_that_hit_nothing_obey_and_others_are_told(rules: str, passed: float) -> None:
    y = np.full(30, 0.1)
    assert broken(rules, river(y, obstacles=STONES, passed=passed)) == set()
    bank = np.where(np.arange(30) == 20, 2.1, y)
    assert broken(rules, river(bank, obstacles=STONES, passed=passed)) == {"in_river"}
    hit = np.where(np.arange(30) == 10, 1.0, y)  # x = 6.0, before the centre of the first one
    assert broken(rules, river(hit, obstacles=STONES, passed=passed)) == {"no_hit"}
    behind = np.where(np.arange(30) == 11, 1.0, y)  # x = 6.6, behind it
    assert broken(rules, river(behind, obstacles=STONES, passed=passed)) == {"no_hit"}


def test_a_ship_returns_to_the_line_in_time() -> None:
    allowance = np.concatenate([np.linspace(2.0, 0.0, 15), np.full(15, -0.15)])
    y = np.where(np.arange(30) < 14, -0.5, 0.1)
    good = river(y, obstacles=((20.0, 3.0, 0.6),) * 4, passed=1.0) | {"tau": allowance}
    assert broken("ship_track_rules", good) == set()
    late = good | {"y": np.where(np.arange(30) < 17, -0.5, 0.1)}
    assert broken("ship_track_rules", late) == {"return_to_line"}
    begun = good | {"tau": np.full(30, -0.75), "y": np.full(30, 1.0)}
    assert broken("ship_track_rules", begun) == set()  # nobody has given it an allowance
    given = begun | {"tau": np.where(np.arange(30) == 3, 3.0, -0.75)}
    assert broken("ship_track_rules", given) == {"return_to_line"}
