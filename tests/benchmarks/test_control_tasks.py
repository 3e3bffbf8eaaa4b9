"""Judges of the control tasks: each rejects what violates one rule alone, and agrees with the monitor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.judged import judged, tasks_in
from stlc.monitor.verdict import Monitor

pytestmark = pytest.mark.apart

TASKS = {task.name: task for task in tasks_in(Path(__file__).parents[2] / "benchmarks" / "tasks")}
Arrays = dict[str, np.ndarray]
Change = Callable[[Arrays], None]
Where = slice | int | np.ndarray


def constant(samples: int, **values: float) -> Arrays:
    """Signals that do not change."""
    return {name: np.full(samples, float(value)) for name, value in values.items()}


def put(**changes: tuple[Where, float]) -> Change:
    """Return a change of signals at some samples."""

    def change(signals: Arrays) -> None:
        for name, (where, value) in changes.items():
            signals[name][where] = value

    return change


def steps(samples: int, *parts: tuple[int, float]) -> np.ndarray:
    """A signal that is constant from some samples on."""
    found = np.zeros(samples)
    for first, value in parts:
        found[first:] = value
    return found


def farm() -> Arrays:
    """A day of the farm on which little is bought in the evening."""
    made = constant(97, hour=0, soc=15, charge=0, diesel=0, bill=0, fuel=0)
    made["hour"] = np.arange(97) / 4
    made["charge"][66:84], made["diesel"][66:84] = -4.5, 1
    return made


def with_grid(signals: Arrays) -> Arrays:
    """Power that the farm buys: it follows from the rest."""
    hour = signals["hour"]
    demand = np.interp(hour, (0, 5, 7, 9, 12, 16, 18, 20, 22, 24), (1.5, 1.5, 4, 3, 3.5, 3, 6, 7, 3, 1.5))
    sun = np.interp(hour, (0, 6, 9, 12, 15, 19, 24), (0, 0, 4, 7, 5, 0, 0))
    return {**signals, "grid": demand - sun + signals["charge"] - signals["diesel"]}


DT = {
    **{"quadtank": 3, "ballbeam": 0.1, "swingup": 0.05, "rotors": 0.05, "microgrid": 900, "imager": 2},
    **{"bus": 0.5, "trailer": 0.25, "handover": 0.5, "hvac": 300, "glucose": 300, "arm": 0.1},
}
GOOD: dict[str, Arrays] = {
    "quadtank": {
        **constant(101, h3=2, h4=2),
        **{"h1": steps(101, (0, 15), (60, 11)), "h2": steps(101, (0, 12), (60, 14))},
    },
    "ballbeam": {**constant(181, v=0, tilt=0, rate=0), "x": steps(181, (0, 0.3), (85, -0.3))},
    "swingup": constant(161, x=0, v=0, angle=0, rate=0),
    "rotors": constant(121, x=5, z=2, tilt=0, vx=0, vz=0, rate=0),
    "microgrid": farm(),
    "imager": {**constant(101, rate=0, wheel=0), "angle": steps(101, (0, 25), (38, -20), (63, 0))},
    "bus": {
        **constant(241, v=0),
        "s": steps(241, (20, 150), (72, 200), (106, 340), (186, 520)),
        "door": steps(241, (20, 1), (72, 0), (106, 1)),
    },
    "trailer": constant(181, x=6.5, y=0, heading=0, trailer=0, v=0, wheel=0),
    "handover": {
        **constant(151, ax=1, ay=1, avx=0, avy=0, bx=11, by=1, bvx=0, bvy=0),
        "part": steps(151, (20, 1), (50, 2), (70, 3)),
    },
    "hvac": constant(169, hour=8, t1=21.5, t2=21.5, on=0, starts=0, used=0),
    "glucose": constant(121, g=100, x=0, i=15, gut=0),
    "arm": {
        **constant(241, q1=0, q2=2.2, w1=0, w2=0, phase=0, wait=0),
        "part": steps(241, (30, 1), (100, 2)),
    },
}
"""Signals that obey all rules of a task; they need not obey its dynamics."""
BAD: dict[str, dict[str, Change]] = {
    "quadtank": {
        "overflow": put(h3=(5, 9)),
        "pumps_wet": put(h1=(2, 4)),
        "first": put(h1=(slice(60), 13)),
        "second": put(h2=(95, 13)),
    },
    "ballbeam": {
        "on_beam": put(x=(87, 0.6)),
        "shallow": put(tilt=(50, 0.5)),
        "to_right": put(x=(slice(85), 0.2)),
        "to_left": put(x=(slice(85, None), -0.2)),
        "level": put(tilt=(175, 0.1)),
    },
    "swingup": {"track": put(x=(3, 3)), "upright": put(angle=(120, 0.5))},
    "rotors": {"floor_": put(z=(10, 0.2)), "upright": put(tilt=(4, 1.5)), "hover": put(vx=(100, 1))},
    "microgrid": {
        "battery": put(soc=(1, 1)),
        "generator": put(diesel=(40, 4.5), charge=(40, 4.5)),
        "contract": put(charge=(48, -3)),
        "evening": put(charge=(76, 0)),
        "quiet": put(diesel=(4, 1)),
        "morning": put(soc=(slice(20, 29), 13)),
        "refilled": put(soc=(95, 9)),
        "cheap": put(bill=(96, 9)),
    },
    "imager": {
        "saturation": put(wheel=(3, 0.55)),
        "gyro": put(rate=(10, 2.5)),
        "camera": put(angle=(2, 50)),
        "harbour": put(angle=(27, 24)),
        "dam": put(angle=(50, -21)),
        "downlink": put(angle=(slice(70, None, 8), 5)),
        "unloaded": put(wheel=(99, 0.1)),
    },
    "bus": {
        "limit": put(v=(5, 15)),
        "doors": put(door=(2, 0.5)),
        "light_1": put(s=(slice(84, 106), 240)),
        "light_2": put(s=(slice(170, 186), 450), door=(slice(170, 186), 0)),
        "call_market": put(door=(slice(20, 72), 0.5)),
        "early": put(s=(60, 152), door=(60, 0)),
        "call_school": put(door=(slice(106, 180), 0.5)),
        "terminus": put(door=(230, 0.5)),
    },
    "trailer": {
        "jackknife": put(heading=(170, 1)),
        "walls_": put(y=(170, 0.8)),
        "parked": put(v=(slice(None), 0.1)),
        "yard": put(x=(0, 31)),
    },
    "handover": {
        "sides": put(ax=(5, 0.1)),
        "apart": put(ax=(60, 5.45), bx=(60, 6.3)),
        "bench_": put(ax=(60, 3), ay=(60, 4.5)),
        "careful": put(avx=(30, 1.2)),
        "pick": put(part=(slice(20, 40), 0)),
        "deliver": put(part=(slice(70, 100), 2)),
        "home": put(ax=(145, 2)),
    },
    "hvac": {
        "limits": put(t2=(2, 13)),
        "morning": put(t2=(60, 20)),
        "afternoon": put(t1=(130, 20)),
        "runs": put(on=(slice(20, 24), 1)),
        "rests": put(on=(np.r_[20:40, 42:60], 1)),
        "few": put(starts=(3, 6)),
        "thrift": put(used=(168, 35)),
    },
    "glucose": {
        "no_hypo": put(g=(20, 65)),
        "no_peak": put(g=(20, 230)),
        "back": put(g=(slice(20, 40), 180)),
        "lunch_ready": put(g=(56, 120)),
        "evening": put(g=(118, 120)),
    },
    "arm": {
        "joints": put(q2=(5, 2.55)),
        "hand_": put(q1=(50, np.pi / 2), phase=(50, -np.pi / 6)),
        "table": put(q1=(50, -0.15), q2=(50, -1)),
        "gentle": put(w1=(50, 1.2)),
        "pick": put(part=(slice(30, 90), 0)),
        "order": put(part=(slice(20, 30), 2)),
        "place": put(part=(slice(100, None), 1)),
        "rest": put(q2=(235, 1.9)),
    },
}
"""For each rule a change of the good signals that violates this rule and no other."""


def test_each_task_has_its_cases() -> None:
    assert set(GOOD) == set(BAD) == set(DT) == set(TASKS)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_a_judge_rejects_what_violates_one_rule_and_agrees_with_the_monitor(
    name: str, tmp_path: Path
) -> None:
    rows = [{key: value.copy() for key, value in GOOD[name].items()} for _ in range(len(BAD[name]) + 1)]
    for row, change in zip(rows[1:], BAD[name].values(), strict=True):
        change(row)
    rows = [with_grid(row) if name == "microgrid" else row for row in rows]
    signals = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    times = DT[name] * np.arange(next(iter(signals.values())).shape[1])
    np.savez(tmp_path / "trace.npz", t=times, **signals)
    found = judged(TASKS[name], tmp_path / "trace.npz")
    assert found.rules == {rule: len(rows) - 1 for rule in BAD[name]}
    assert (found.obeyed, found.count) == (1, len(rows))
    verdict = Monitor(TASKS[name].spec).check(str(tmp_path / "trace.npz"))
    violated = {
        each.name: [row for row, status in enumerate(each.statuses) if status != "satisfied"]
        for each in verdict.requirements
    }
    assert violated == {rule: [row + 1] for row, rule in enumerate(BAD[name])}
