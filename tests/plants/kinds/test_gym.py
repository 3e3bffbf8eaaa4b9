"""Gymnasium environments as plants, against the environments themselves."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.plants import read, simulated

from stlc.plants.kind import FaultError, UnfitError

gymnasium = pytest.importorskip("gymnasium")

FILE = """\
plant: 1
name: pendulum
gym: Pendulum-v1
time: {dt: 50 ms, duration: 15 s}
initial: {theta: {unit: rad, range: [-1, 1]}, rate: {range: [-1, 1]}}
param: {g: {range: [9, 10]}}
input: {torque: {range: [-2, 2]}}
output: {cos: , sin: , thetadot: {unit: rad/s}, reward: {from: reward}, again: {from: "state[0]"}}
"""
CART = """\
plant: 1
name: cart
gym: CartPole-v1
time: {dt: 20 ms, duration: 4 s}
input: {push: {range: [0, 1]}}
output: {x: , v: , theta: , omega: , fallen: {from: terminated}}
"""


def test_a_simulation_is_that_of_the_environment(tmp_path):
    decl = read(FILE, tmp_path)
    torque = np.random.default_rng(0).uniform(-2, 2, (decl.steps, 1))
    found = simulated(decl, tmp_path, {"theta": 0.3, "rate": -0.2, "g": 9.5}, torque)
    environment = gymnasium.make("Pendulum-v1", g=9.5).unwrapped
    environment.reset(seed=0)
    environment.state = np.array([0.3, -0.2])
    assert len(found) == 301  # more than the 200 steps after which the registered environment ends
    for row, action in zip(found[1:], torque, strict=True):
        observation, reward, *_ = environment.step(action.astype(np.float32))
        assert row == pytest.approx([*observation, reward, environment.state[0]], abs=1e-6)
    assert found[0, :3] == pytest.approx([np.cos(0.3), np.sin(0.3), -0.2], abs=1e-6)


def test_a_seed_determines_the_start(tmp_path):
    decl = read(FILE.replace("initial: ", "# "), tmp_path)
    one, same, other = (simulated(decl, tmp_path, {"g": 9.5, "seed": seed})[0] for seed in (1, 1, 2))
    assert (one == same).all()
    assert (one != other).any()


def test_an_environment_that_terminates_ends_the_simulation(tmp_path):
    found = simulated(read(CART, tmp_path), tmp_path, {}, np.ones((200, 1)))
    assert len(found) < 20
    assert found[-1, 4] == 1.0
    assert (found[:-1, 4] == 0.0).all()


def test_an_action_that_does_not_exist_is_a_fault(tmp_path):
    with pytest.raises(FaultError, match="no action"):
        simulated(read(CART, tmp_path), tmp_path, {}, np.full((200, 1), 3.0))


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ("Pendulum-v1", "Pendulm-v1", "", "cannot be made"),
        ('again: {from: "state[0]"}', 'again: {from: "obs[3]"}', "output.again", r"`obs\[0\]` to `obs\[2\]`"),
        ('again: {from: "state[0]"}', "again: {from: height}", "output.again", "`reward`"),
        ("rate: {range", "rate: {from: 'state[2]', range", "initial.rate", r"no `state\[2\]`"),
        ("param: {g:", "param: {gravity:", "param.gravity", "no number `gravity`"),
        ("input: {torque: {range: [-2, 2]}}", "input: {}", "input", "1 components"),
    ],
)
def test_ports_that_the_environment_lacks_are_refused(tmp_path, old, new, place, said):
    assert old in FILE
    with pytest.raises(UnfitError, match=said) as caught:
        simulated(read(FILE.replace(old, new), tmp_path), tmp_path, {})
    assert caught.value.place == place


def test_options_go_to_the_environment(tmp_path):
    text = FILE.replace("gym: Pendulum-v1", "gym: {id: Pendulum-v1, options: {g: 0.0}}")
    decl = read(text.replace("param: {g: {range: [9, 10]}}\n", ""), tmp_path)
    assert decl.options["options"] == {"g": 0.0}
    found = simulated(decl, tmp_path, {"theta": 0.5, "rate": 0.0})
    assert found[-1, 0] == pytest.approx(np.cos(0.5), abs=1e-6)


MOODY = """
import gymnasium
import numpy as np


class Moody(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    state = "calm"

    def reset(self, seed=None, options=None):
        return np.zeros(1), {}

    def step(self, action):
        return action, 0.0, False, False, {}


gymnasium.register("Moody-v0", entry_point=Moody)
"""


def test_a_state_that_is_not_numbers_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "moody.py").write_text(MOODY)
    monkeypatch.syspath_prepend(str(tmp_path))
    text = FILE.replace("Pendulum-v1", '"moody:Moody-v0"')
    text = text.partition("initial")[0] + "input: {torque: {range: [-1, 1]}}\noutput: {x: }\n"
    assert (simulated(read(text, tmp_path), tmp_path, {}, np.full((3, 1), 0.5))[1:] == 0.5).all()
