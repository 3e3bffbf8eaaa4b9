"""A synthetic run folder: what training and deployment leave behind, made in milliseconds."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stlc.rundir import RunDir
from stlc.signature import Column, Signature
from stlc.trace import Trace, TraceMeta
from stlc.units import Unit

FRAMES = 4


@pytest.fixture(autouse=True)
def _few_frames(monkeypatch):
    """Reports whose films have few instants: each takes a tenth of a second to draw."""
    monkeypatch.setattr("stlc.view.player.MOST_FRAMES", FRAMES)


ROOT = Path(__file__).parents[2]
SPEC = (ROOT / "specs/traffic.stl").read_text()
SYSTEM = (ROOT / "examples/car.yaml").read_text()
REQUIREMENTS = ("no_collision", "stop_sign", "give_way", "red_light")

M, S, MS = Unit.parse("m"), Unit.parse("s"), Unit.parse("m/s")
SIGNATURE = Signature(
    (
        Column("x", M, low=-10, high=8),
        Column("v", MS, low=-0.01, high=10),
        Column("sign", kind="enum", role="env", labels=(("stop", 0.0), ("light", 1.0))),
        Column("tau", S, low=0, high=8),
        Column("dx", M, low=-1, high=10),
        Column("v_lead", MS, role="env", low=0, high=10),
        Column("yielding", kind="bool", role="env"),
    )
)


def training_rows(count=60):
    rng = np.random.default_rng(0)
    rows = []
    for i in range(count):
        warm = math.exp(-i / 7)
        rows.append(
            {
                "step": 100 * i,
                "steps": 100 * count,
                "seconds": 2 + 1.03 * i,
                "loss": 0.3 * math.exp(-i / 12) + 0.01 + abs(rng.normal(0, 0.004)),
                "accuracy": 0.957 - 0.337 * warm + rng.normal(0, 0.004),
                "requirements": {
                    "no_collision": 0.996 - 0.1 * warm,
                    "stop_sign": 0.971 - 0.27 * warm,
                    "give_way": 0.999 - 0.07 * warm,
                    "red_light": 0.984 - 0.13 * warm,
                },
                "feasible": None if i < 3 else 0.969 - 0.02 * warm,
                "lr": 1e-3 * min(1, (i + 1) / 3) * 0.5 * (1 + math.cos(math.pi * i / count)),
                "repaired": 41,
                "failing": 55,
                "s_per_step": 0.0103,
            }
        )
    return rows


def held_out_arrays(count=5000):
    """Starts like those of the car; fast starts short of a stop sign and of a red light fail."""
    rng = np.random.default_rng(1)
    light = rng.random(count) < 0.5
    x = rng.uniform(-10, -1, count)
    v = rng.random(count) * np.minimum(10, np.sqrt(20 * (-x - 1)))
    tau = np.where(light, rng.uniform(0, 8, count), 0.0)
    lead = rng.random(count) < 0.5
    dx = np.where(lead, rng.uniform(1, 10, count), -1.0)
    v_lead = np.where(lead, rng.uniform(0, 10, count), 0.0)
    yielding = (~light & (rng.random(count) < 0.5)).astype(float)
    need = v**2 / 20 + 1 + x + rng.normal(0, 0.15, count)
    stop = np.where(light, 0.5, np.minimum(0.4, -2.2 * (need + 0.12)))
    red = np.where(light & (tau < 2.5), np.minimum(0.3, -(need + 0.1)), 0.5)
    gap = np.where(lead, np.clip(dx - 1 + 0.2 * (v_lead - v), -0.4, 4) + 0.3, 0.5)
    way = np.where(yielding > 0, np.maximum(-0.5 - x, 0.02) * 0.3, 0.5)
    each = np.stack([gap, stop, way, red], axis=1)
    x0 = np.stack([x, v, light.astype(float), tau, dx, v_lead, yielding], axis=1)
    meta = {"names": list(SIGNATURE.names), "requirements": list(REQUIREMENTS)}
    return {"x0": x0, "rho": each.min(axis=1), "requirements": each, "meta": np.array(json.dumps(meta))}


def drive(agents=20, steps=150, seed=2):
    """Cars that brake before stop signs and red lights, and now and then too late."""
    rng = np.random.default_rng(seed)
    x, v = rng.uniform(-10, -2, agents), rng.uniform(0, 3, agents)
    light = rng.random(agents) < 0.5
    tau = np.where(light, rng.uniform(0, 8, agents), 0.0)
    dx = np.where(rng.random(agents) < 0.5, rng.uniform(3, 10, agents), -1.0)
    v_lead = np.where(dx >= 0, rng.uniform(1, 6, agents), 0.0)
    careless = rng.random(agents) < 0.15
    rows, actions, decisions = [], [], []
    for _ in range(steps + 1):
        yielding = (~light & (x < -0.5) & (rng.random(agents) < 0.1)).astype(float)
        rows.append(np.stack([x, v, light.astype(float), tau, dx, v_lead, yielding]))
        must_stop = (x < -0.2) & np.where(light, tau < 4.2, tau < 1.0)
        room = np.maximum(-x - np.where(light, 1.15, 0.45), 0.0)
        wanted = np.where(must_stop & ~careless, np.sqrt(2 * 4 * room), 6.0)
        wanted = np.where(dx >= 0, np.minimum(wanted, np.sqrt(8 * np.maximum(dx - 1.3, 0))), wanted)
        u = np.clip((wanted - v) / 0.3, -10, 8)
        near = must_stop & (rng.random(agents) < 0.08)
        decisions.append(np.where(near, np.where(rng.random(agents) < 0.1, 2, 1), 0))
        actions.append(u)
        x = x + v * 0.1
        tau = np.where(
            light, (tau + 0.1) % 8, np.where((x > -1) & (x < 0), tau + 0.1, np.where(x > 0, 0, tau))
        )
        dx = np.where(dx >= 0, np.maximum(dx + (v_lead - v) * 0.1, 0.0), dx)
        v = np.clip(v + u * 0.1, -0.01, 10)
        gone = x > 8
        fresh = rng.random(agents) < 0.5
        x, light = np.where(gone, -10, x), np.where(gone, fresh, light)
        tau = np.where(gone, np.where(fresh, rng.uniform(0, 8, agents), 0.0), tau)
        dx = np.where(gone, np.where(rng.random(agents) < 0.5, rng.uniform(4, 10, agents), -1.0), dx)
        v_lead = np.where(gone, np.where(dx >= 0, rng.uniform(1, 6, agents), 0.0), v_lead)
    data = dict(zip(SIGNATURE.names, np.stack(rows).transpose(1, 2, 0), strict=True))
    extras = {
        "action.u": np.stack(actions[:-1]).T,
        "decision": np.stack(decisions[:-1]).T.astype(np.int8),
        "t0": np.stack(decisions[:-1]).T.astype(np.int8),
        "plan_rho": np.full((agents, steps), 0.2),
        "seed": np.arange(agents) // 10,
        "agent": np.arange(agents) % 10,
    }
    meta = TraceMeta(
        spec_name="traffic",
        spec_path="specs/traffic.stl",
        spec_text=SPEC,
        system_name="car",
        system_path="examples/car.yaml",
        system_text=SYSTEM,
        run="0001-quiet-heron",
        seed=0,
        horizon=25,
        dt=0.1,
    )
    return Trace(SIGNATURE, 0.1, data, extras=extras, meta=meta)


def record():
    shares = {"no_collision": 0.996, "stop_sign": 0.971, "give_way": 0.999, "red_light": 0.984}
    return {
        "stlc": "0.1.0",
        "command": ["train", "specs/traffic.stl", "--system", "car.yaml", "--budget", "60s"],
        "spec": "traffic",
        "spec_path": "specs/traffic.stl",
        "spec_hash": "5d1c0ffee",
        "system": "car",
        "system_path": "examples/car.yaml",
        "system_hash": "0b5e55ed",
        "overrides": {"T_red": "3 s"},
        "seed": 0,
        "steps": 5900,
        "budget": 60.0,
        "device": "cpu",
        "threads": 2,
        "versions": {"python": "3.11.7", "stlc": "0.1.0", "torch": "2.13.0", "numpy": "2.4.0"},
        "git": {"commit": "0123456789abcdef", "dirty": True},
        "hardware": {"system": "Linux", "processor": "a processor", "cores": 2, "memory_gib": 7.8},
        "started": "2025-01-01T10:00:00+00:00",
        "finished": "2025-01-01T10:01:10+00:00",
        "status": "finished",
        "result": {
            "accuracy": 0.957,
            "interval": [0.951, 0.962],
            "held_out": 5000,
            "requirements": shares,
            "feasible": 0.969,
            "seconds": 61.2,
        },
    }


@pytest.fixture
def trained(tmp_path):
    """A run that was trained and not yet deployed."""
    run = RunDir.create(tmp_path / "runs", "traffic", "quiet-heron")
    run.write_json("run.json", record())
    (run.path / "spec.stl").write_text(SPEC)
    (run.path / "system.yaml").write_text(SYSTEM)
    for row in training_rows():
        run.append_row(row)
    (run.path / "eval").mkdir()
    np.savez(run.path / "eval/held_out.npz", **held_out_arrays())
    return run


def metric(mean, half):
    return {"mean": mean, "low": mean - half, "high": mean + half, "values": [mean - half, mean + half]}


def simulation():
    def guard(accuracy, acted, speed):
        return {
            "metrics": {
                "plan_accuracy": metric(accuracy, 0.012),
                "policy_accuracy": metric(0.93, 0.02),
                "plan_safety": metric(0.99, 0.004),
                "executed": metric(accuracy - 0.2, 0.05),
                "executed_safe": metric(accuracy - 0.1, 0.05),
                "executed_starts": metric(accuracy - 0.02, 0.01),
                "executed_safe_starts": metric(accuracy - 0.01, 0.01),
                "foreseen": metric(0.71, 0.03),
                "foreseen_starts": metric(0.995, 0.002),
                "holds.no_collision": metric(0.999, 0.001),
                "holds.stop_sign": metric(0.97, 0.01),
                "holds.give_way": metric(0.99, 0.01),
                "holds.red_light": metric(0.995, 0.002),
                "mean_speed": metric(speed, 0.1),
                "junctions_passed": metric(61.0, 3.2),
                "overlapping_pairs": metric(0.0, 0.0),
            },
            "units": {"mean_speed": "m/s"},
            "decisions": {
                "policy": 1 - acted,
                "backup": acted * 0.93,
                "safest": acted * 0.07,
                "backup T0=1": acted * 0.9,
            },
            "latency": {"median": 0.0006, "p99": 0.0213, "samples": 200},
        }

    return {
        "spec": "traffic",
        "system": "car",
        "run": "0001-quiet-heron",
        "world": "traffic_grid.py",
        "seeds": [0, 1],
        "agents": 10,
        "steps": 150,
        "replan": 1,
        "interval": "95 %, Student's t over the deployment seeds",
        "guards": {"none": guard(0.93, 0.0, 4.1), "paper": guard(0.981, 0.031, 4.0)},
    }


@pytest.fixture
def deployed(trained, recording):
    """The same run with a recorded deployment that was animated."""
    recording.save(trained.path / "trace.npz")
    trained.write_json("eval/simulate.json", simulation())
    Image.new("P", (8, 8)).save(trained.path / "traffic.gif")
    return trained


@pytest.fixture
def signature():
    return SIGNATURE


@pytest.fixture(scope="session")
def recording():
    """A deployment of 20 agents over 150 steps."""
    return drive()
