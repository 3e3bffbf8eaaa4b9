"""Plant files of the tests, and simulations in this process, which take no second to start."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.plants.declaration import PlantDecl, parse_plant
from stlc.plants.worker import ControlledPlant
from stlc.source import Source

PENDULUM = """
import math

import numpy as np


class Pendulum:
    def __init__(self, dt):
        self.dt = dt

    def reset(self, initial, params):
        self.x, self.v, self.length = initial["angle"], initial["rate"], params["length"]
        return [self.x, self.v]

    def step(self, inputs):
        for _ in range(100):
            h = self.dt / 100
            self.v += h * (-9.81 / self.length * math.sin(self.x) + inputs["torque"])
            self.x += h * self.v
        return {"rate": self.v, "angle": self.x}


def flow(t, x, u, p):
    return [x[1], -9.81 / p[0] * math.sin(x[0]) + u[0]]


def step(state, inputs, dt):
    return state + dt * np.array([state[1], inputs[0]])


def ambiguous(a, b, c):
    return a


class Idle:
    def reset(self, initial, params):
        return [0.0, 0.0]
"""

FILE = """\
plant: 1
name: pendulum
python: "pendulum.py:Pendulum"
time: {dt: 10 ms, duration: 1 s}
initial: {angle: {unit: rad, range: [-1, 1]}, rate: {unit: rad/s, value: 0.5}}
param: {length: {unit: m, range: [0.5, 2]}}
input: {torque: {unit: rad/s^2, range: [-1, 1], pieces: 2}}
output: {angle: {unit: rad}, rate: {unit: rad/s}}
"""


def pendulum(folder: Path, **changes: str) -> Path:
    """Write pendulum.py and pendulum.yaml, with the given lines in place of those with the same key."""
    (folder / "pendulum.py").write_text(PENDULUM)
    path = folder / "pendulum.yaml"
    path.write_text(changed(FILE, **changes))
    return path


def changed(text: str, **changes: str) -> str:
    """The text of a plant file with other lines; new keys are added, empty ones removed."""
    lines = {line.partition(":")[0]: line for line in text.splitlines()}
    lines |= {name: f"{name}: {value}" for name, value in changes.items()}
    return "".join(f"{line}\n" for name, line in lines.items() if changes.get(name) != "")


def read(text: str, folder: Path) -> PlantDecl:
    return parse_plant(Source("plant.yaml", text), folder / "plant.yaml")


def simulated(
    decl: PlantDecl, folder: Path, values: Mapping[str, float], inputs: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Outputs of a simulation in this process, (samples, outputs and commands).

    `values` are start values and parameters; `inputs` is (steps, free inputs), by default zeros.
    """
    simulator = ControlledPlant(decl.layout(str(folder)))
    start = [values.get(each.name, each.low) for each in (*decl.initial, *decl.param)]
    u = np.zeros((decl.steps, len(decl.free))) if inputs is None else inputs
    first = simulator.start({"seed": int(values.get("seed", 0))}, np.array([[*start, *u[0]]]))
    rest = simulator.advance({}, u)
    wide = np.zeros((1, rest.array.shape[1]))
    wide[:, : first.array.shape[1]] = first.array
    return np.concatenate((wide, rest.array))
