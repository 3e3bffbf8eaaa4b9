"""Plants of the field in `examples/tasks/`: the files are sound, and a minute of training satisfies them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.dynamics.model.feedback import growth_of
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec

TASKS = Path(__file__).parents[2] / "examples" / "tasks"
PLANTS = ("cart_pole", "quadrotor_rates", "quadrotor_rotors", "thermostat", "watch")


def task(name: str) -> Task:
    return Task.of(Spec.parse(File(TASKS / f"{name}.stl").read()), System.load(TASKS / f"{name}.yaml"))


@pytest.mark.parametrize("name", PLANTS)
def test_the_files_are_sound(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lint", str(TASKS / f"{name}.stl")]) == 0
    assert main(["fmt", "--check", str(TASKS / f"{name}.stl")]) == 0
    assert main(["system", "check", str(TASKS / f"{name}.yaml")]) == 0
    assert "nothing to say" in "".join(capsys.readouterr())


def test_rotors_hold_the_weight_and_forget_a_tilt() -> None:
    """With nothing planned the feedback levels the quadrotor; without it a tilt of 0.1 rad ends in a fall."""
    held = task("quadrotor_rotors").plain
    free = System.load(TASKS / "quadrotor_rotors.yaml", {"policy.feedback": "null"})
    x0 = torch.tensor([[0.0, 1.0, 0.0, 0.0, 0.1, 0.5]], dtype=torch.float64)
    none = torch.zeros(1, 40, 2, dtype=torch.float64)
    weight = torch.full_like(none, 0.5 * 0.5 * 9.81)
    last = held.rollout(x0, none)[0, -1]
    assert float(last[4].abs()) < 0.02
    assert float(last[2:4].abs().max()) < 0.3
    assert float(free.rollout(x0, weight)[0, -1, 4].abs()) > 1.5


def test_the_pole_swings_and_keeps_its_energy() -> None:
    system = System.load(TASKS / "cart_pole.yaml", {"policy.feedback": "null"})
    x0 = torch.tensor([[0.0, 0.0, 2.0, 0.0]], dtype=torch.float64)
    x = system.rollout(x0, torch.zeros(1, 60, 1, dtype=torch.float64))[0].numpy()
    (_, v, a, w), (m, cart, half, g) = x.T, (0.1, 1.0, 0.5, 9.8)
    kinetic = 0.5 * (m + cart) * v**2 + m * half * v * w * np.cos(a) + (2 / 3) * m * half**2 * w**2
    energy = kinetic + m * g * half * np.cos(a)
    assert np.ptp(a) > 2.0
    np.testing.assert_allclose(energy, energy[0], atol=2e-3)


def test_the_pump_stays_in_a_mode_for_ten_minutes() -> None:
    system = task("thermostat").plain
    generator = torch.Generator().manual_seed(0)
    x0 = system.sample(50, seed=1, dtype=torch.float64)
    low, high = system.control_low.double(), system.control_high.double()
    u = low + (high - low) * torch.rand((50, 30, 1), generator=generator, dtype=torch.float64)
    x = system.rollout(x0, u).numpy()
    mode, held = (x[..., system.names.index(name)] for name in ("mode", "held"))
    changes = np.diff(mode, axis=1) != 0
    assert changes.sum() > 100
    assert (held[:, :-1][changes] >= 600 - 1e-6).all()
    assert (held[:, 1:][changes] == 0).all()


def test_upright_is_where_a_pole_falls_from() -> None:
    free = System.load(TASKS / "cart_pole.yaml", {"policy.feedback": "null"})
    assert growth_of(free.decl) > 1e3
    assert growth_of(task("cart_pole").plain.decl) < 1.0
    assert growth_of(task("quadrotor_rotors").plain.decl) < 10.0
