"""Plants in Python: classes, steps and right-hand sides, against solutions that are known."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers.plants import FILE, changed, pendulum, read, simulated
from scipy.integrate import solve_ivp

from stlc.plants.kind import FaultError, UnfitError

START = {"angle": 0.9, "length": 1.3}


@pytest.fixture(autouse=True)
def _own_path(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))


@pytest.fixture
def folder(tmp_path):
    pendulum(tmp_path)
    return tmp_path


def exact(times, torque=0.0):
    slope = lambda _t, x: [x[1], -9.81 / START["length"] * np.sin(x[0]) + torque]  # noqa: E731
    return solve_ivp(slope, (0, times[-1]), [0.9, 0.5], t_eval=times, rtol=1e-11, atol=1e-12).y.T


def error(folder, **changes):
    decl = read(changed(FILE, **changes), folder)
    found = simulated(decl, folder, START, np.full((decl.steps, 1), 0.3))
    times = float(decl.dt) * np.arange(decl.steps + 1)
    return np.abs(found - exact(times, 0.3)).max()


def test_fixed_steps_are_of_order_four(folder):
    coarse = error(folder, python='"pendulum.py:flow"', time="{dt: 0.2 s, duration: 1 s}")
    fine = error(
        folder, python="{target: 'pendulum.py:flow', substeps: 2}", time="{dt: 0.2 s, duration: 1 s}"
    )
    assert 11 < coarse / fine < 22


@pytest.mark.parametrize(
    ("python", "most"),
    [
        ("{target: 'pendulum.py:flow', integrator: scipy}", 1e-6),
        ("{target: 'pendulum.py:flow', form: flow, substeps: 4}", 1e-8),
        ("'pendulum.py:Pendulum'", 2e-3),
    ],
)
def test_the_motion_is_that_of_the_equation(folder, python, most):
    assert error(folder, python=python) < most


def test_a_step_gives_the_next_state(folder):
    decl = read(changed(FILE, python='"pendulum.py:step"', output="{rate: }"), folder)
    found = simulated(decl, folder, {"angle": 1.0}, np.ones((100, 1)))
    assert found[:, 0] == pytest.approx(0.5 + 0.01 * np.arange(101))


def test_every_simulation_has_its_own_object(folder):
    decl = read(FILE, folder)
    first, again = (simulated(decl, folder, START) for _ in range(2))
    assert (first == again).all()


def test_files_beside_the_plant_can_be_imported(folder):
    (folder / "beside_the_plant.py").write_text("from pendulum import Pendulum\n")
    decl = read(changed(FILE, python='"beside_the_plant:Pendulum"'), folder)
    assert simulated(decl, folder, START).shape == (101, 2)


@pytest.mark.parametrize(
    ("python", "output", "said"),
    [
        ('"gone.py:f"', "", "no file"),
        ('"pendulum.py:Pendulm"', "", "did you mean `Pendulum`"),
        ('"pendulum.py"', "", "not of the form"),
        ('"no_such_module_here:f"', "", "importing"),
        ('"pendulum.py:ambiguous"', "", "give `form`"),
        ('"pendulum.py:Idle"', "", "lacks the method `step`"),
        ('"pendulum.py:flow"', "{anlge: {unit: rad}}", "did you mean `angle`"),
    ],
)
def test_a_plant_that_does_not_fit_is_refused(folder, python, output, said):
    text = changed(FILE, python=python, **({"output": output} if output else {}))
    with pytest.raises(UnfitError, match=said):
        simulated(read(text, folder), folder, START)


@pytest.mark.parametrize(
    ("body", "reason", "said"),
    [
        ("return [1.0]", "wrong shape", "1 components"),
        ("return 'abc'", "wrong shape", "not a vector"),
        ("return None", "not finite", "is nan"),
        ("return [x[0], float('inf')]", "not finite", "`rate` is inf"),
    ],
)
def test_what_is_no_state_is_a_fault(folder, body, reason, said):
    (folder / "faulty.py").write_text(f"def step(x, u, dt):\n    {body}\n")
    text = changed(FILE, python="{target: 'faulty.py:step', form: step}")
    if body == "return None":
        text = changed(text, initial="{angle: 0}", output="{angle: }")
        said = "is nan"
    with pytest.raises(FaultError, match=said) as caught:
        simulated(read(text, folder), folder, START)
    assert caught.value.reason == reason


@pytest.mark.parametrize("given", ["{}", "{'angle': 1}", "[1]", "[[1, 2], [3]]", "{'angle': 'x', 'rate': 1}"])
def test_outputs_of_a_class_have_the_declared_names(folder, given):
    (folder / "faulty.py").write_text(f"""
class P:
    def reset(self, initial, params):
        return {given}

    def step(self, inputs):
        pass
""")
    with pytest.raises(FaultError) as caught:
        simulated(read(changed(FILE, python="'faulty.py:P'"), folder), folder, START)
    assert caught.value.reason == "wrong shape"
