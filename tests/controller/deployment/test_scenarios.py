"""Scenarios: overlays of a deployment that the model does, or does not, know about."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.guard.candidates import grid_of
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.deployment import ErrorsDecl
from stlc.dynamics.load import parse_system
from stlc.dynamics.scenario import standard, under
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.disturbance import Disturbance, errors_of
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: boat
time: {dt: 0.5 s, horizon: 4 steps}
const: {speed: 1 m/s, drift: 0 m/s}
state:
  x: {unit: m}
  y: {unit: m, range: [-1, 1], clamp: true}
  p: {size: 2, unit: m, role: env}
  calls: {role: env}
control: {u: {unit: m/s, range: [-1, 1]}}
flow: {x: speed, y: u + drift}
init: {mixture: [{draw: {x: 0, y: 0, p: 0, calls: 0}}]}
test: {steps: 4, agents: 3}
scenario:
  nominal: {}
  fast: {const: {speed: 3 m/s}}
  far: {expect: ood, doc: "starts\n  far away", override: {x: "uniform(10, 11)", p: [1, 2]}}
  called: {events: [{name: call, at: 1 s, set: {calls: calls + 1}}]}
  current: {disturb: {y: "0.4 m/s * sin(t / 1 s)", p: [0, 1]}}
  blurred: {noise: {x: "normal(0, 0.1)"}}
  drifting: {model_mismatch: {drift: 0.5 m/s}, override: {x: 5}}
  shaky: {errors: {actuator_gain: 10 %, parameters: 20 %, actuator_noise: 0.05, sensor_noise: 2 %}}
  fragile:
    backup: {levels: {u: [-1, 0.5]}, T0: [1, 3]}
    prefer: [{name: low, weight: 2, expr: y - 1 m}, {expr: "u^2"}]
"""
SPEC = "signal x [m]\nsignal p: real[2] [m]\nconst speed = 1 m/s\nrequire a: always[0, T] x > -speed * 1 s\n"


class Still(Policy):
    """Remembers what it saw, and does nothing."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.saw: list[Tensor] = []

    def candidates(self, x0: Tensor) -> Tensor:
        self.saw.append(x0)
        return torch.zeros((len(x0), 1, self.task.horizon, 1), dtype=x0.dtype)


def task_of(scenario: str) -> Task:
    decl = under(parse_system(Source("boat.yaml", SYSTEM), Path("boat.yaml")), scenario)
    return Task.of(Spec.parse(Source("a.stl", SPEC)), System(decl), overrides=decl.scenario.constants)  # type: ignore[union-attr]


@pytest.fixture
def driven() -> Callable[[str], tuple[DeploymentRecording, Still]]:
    def drive_in(scenario: str) -> tuple[DeploymentRecording, Still]:
        task = task_of(scenario)
        policy, recorder = Still(task), Recorder(3)
        simulate(Guard(task, policy), world_type(task.system.decl), Setting((0, 1), 3, 4), recorder)
        found = recorder.recording()
        assert found is not None
        return found, policy

    return drive_in


Driven = Callable[[str], tuple[DeploymentRecording, Still]]


def test_nothing_is_different_in_the_nominal_one(driven: Driven) -> None:
    states = driven("nominal")[0].states
    assert states[0, :, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert not states[:, :, 1:].any()


def test_constants_change_model_and_truth(driven: Driven) -> None:
    assert driven("fast")[0].states[0, :, 0].tolist() == [0.0, 1.5, 3.0, 4.5, 6.0]
    model = task_of("fast").system
    assert float(model.step(torch.zeros(1, 5), torch.zeros(1, 1))[0, 0]) == 1.5


def test_initial_values_are_drawn_last(driven: Driven) -> None:
    states = driven("far")[0].states
    assert ((states[:, 0, 0] >= 10) & (states[:, 0, 0] <= 11)).all()
    assert len(set(states[:, 0, 0].tolist())) == 6
    assert states[:, 0, 2:4].tolist() == [[1.0, 2.0]] * 6
    far = task_of("far").system.decl.scenario
    assert far is not None
    assert (far.doc, far.expect) == ("starts far away", "ood")


def test_events_are_added(driven: Driven) -> None:
    assert driven("called")[0].states[0, :, 4].tolist() == [0, 0, 1, 1, 1]


def test_a_disturbance_moves_the_truth_alone(driven: Driven) -> None:
    states = torch.from_numpy(driven("current")[0].states)
    pushes = 0.5 * 0.4 * torch.sin(0.5 * torch.arange(4, dtype=torch.float64))
    torch.testing.assert_close(states[0, 1:, 1], pushes.cumsum(0))
    torch.testing.assert_close(states[0, :, 3], 0.5 * torch.arange(5, dtype=torch.float64))
    model = task_of("current").system
    assert not bool(model.step(torch.zeros(1, 5), torch.zeros(1, 1))[0, 1:].any())


def test_noise_is_in_what_agents_see_alone(driven: Driven) -> None:
    recording, policy = driven("blurred")
    assert recording.states[0, :, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    seen = torch.stack([x[:, 0] for x in policy.saw], 1)
    errors = seen - torch.from_numpy(recording.states[:, :4, 0])
    assert 0.03 < float(errors.std()) < 0.3
    assert len(set(errors.flatten().tolist())) == errors.numel()


def test_the_truth_has_constants_of_its_own(driven: Driven) -> None:
    states = driven("drifting")[0].states
    assert states[0, :, 0].tolist() == [5.0, 5.5, 6.0, 6.5, 7.0]
    assert states[0, :, 1].tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert not bool(task_of("drifting").system.step(torch.zeros(1, 5), torch.zeros(1, 1))[0, 1:].any())


def test_a_scenario_may_name_a_world_of_its_own() -> None:
    text = SYSTEM.replace("  nominal: {}\n", '  nominal: {}\n  else: {world: "river.py:Else"}\n')
    decl = parse_system(Source("boat.yaml", text), Path("boat.yaml"))
    assert decl.test.world is None
    world = under(decl, "else").test.world
    assert world is not None
    assert (world.path.name, world.name) == ("river.py", "Else")
    assert decl.worlds == (world,)


# ------------------------------------------------------- scenarios of every system


class Steady(Still):
    """Commands the same always."""

    def candidates(self, x0: Tensor) -> Tensor:
        return super().candidates(x0) + 0.5


def steady(scenario: str, agents: int = 40) -> tuple[DeploymentRecording, Steady]:
    task = task_of(scenario)
    policy, recorder = Steady(task), Recorder(agents)
    simulate(Guard(task, policy), world_type(task.system.decl), Setting((0, 1), agents, 2), recorder)
    found = recorder.recording()
    assert found is not None
    return found, policy


@pytest.mark.parametrize(("scenario", "off"), [("mismatch", 0.1), ("mismatch-5", 0.05), ("mismatch-20", 0.2)])
def test_actuators_give_more_or_less_all_the_time(scenario: str, off: float) -> None:
    states = steady(scenario)[0].states[:, :, 1]
    moves = (states[:, 1:] - states[:, :-1]) / 0.25
    low, high = moves[:, 0] < 1, moves[:, 0] > 1
    assert moves[low] == pytest.approx(1 - off)
    assert moves[high] == pytest.approx(1 + off)
    assert 20 < low.sum() < 60
    actions = steady(scenario)[0].actions
    assert (actions == 0.5).all()  # as commanded


def test_a_direction_is_off_by_a_part_of_a_radian() -> None:
    text = SYSTEM.replace("range: [-1, 1]}}", "range: [-3.14159, 3.14159], squash: angle}}").replace(
        "m/s, r", "rad, r"
    )
    text = text.replace("y: u + drift", "y: speed * sin(u) + drift")
    decl = under(parse_system(Source("boat.yaml", text), Path("boat.yaml")), "mismatch-20")
    made = Disturbance(System(decl), [torch.Generator().manual_seed(0)], 50)
    given = made.acted(torch.full((50, 1), 3.0, dtype=torch.float64)) - 3.0
    assert sorted(set(given.flatten().tolist())) == pytest.approx([-0.2, 0.2])


def test_actuators_are_noisy_anew_at_every_step() -> None:
    states = steady("disturb-20", 400)[0].states[:, :, 1]
    moves = (states[:, 1:] - states[:, :-1]) / 0.5
    assert moves.mean() == pytest.approx(0.5, abs=0.03)
    assert moves.std() == pytest.approx(0.2, rel=0.1)  # of half of the range [-1, 1]
    assert abs(np.corrcoef(moves[:, 0], moves[:, 1])[0, 1]) < 0.15


def test_agents_see_states_with_noise_where_a_range_is_known() -> None:
    recording, policy = steady("noise-10", 400)
    errors = policy.saw[1] - torch.from_numpy(recording.states[:, 1])
    assert float(errors[:, 1].std()) == pytest.approx(0.2, rel=0.1)  # of [-1, 1]
    assert not bool(errors[:, [0, 2, 3, 4]].any())


def test_a_file_may_ask_for_all_of_them() -> None:
    scenario = task_of("shaky").system.decl.scenario
    assert scenario is not None
    assert scenario.errors == ErrorsDecl(0.1, 0.2, 0.05, 0.02)


def test_a_direction_has_noise_of_a_radian() -> None:
    """A full circle has no half that an actuator could give."""
    text = SYSTEM.replace("u: {unit: m/s, range: [-1, 1]}", "u: {unit: rad, range: [-3, 3], squash: angle}")
    text = text.replace("y: u + drift", "y: drift")
    decl = under(parse_system(Source("boat.yaml", text), Path("boat.yaml")), "disturb-20")
    disturbance = Disturbance(System(decl), [torch.Generator().manual_seed(0)], 4000)
    given = disturbance.acted(torch.ones(4000, 1, dtype=torch.float64))
    assert float(given.std()) == pytest.approx(0.2, rel=0.05)


def test_numbers_of_the_dynamics_are_wrong_for_each_agent_in_its_way() -> None:
    found = steady("mismatch-20", 200)[0].states
    speeds = np.diff(found[:, :, 0], axis=1) / 0.5
    assert np.ptp(speeds, axis=1).max() < 1e-12  # always
    assert set(np.round(speeds[:, 0], 9)) == {0.8, 1.2}
    assert 150 < int((speeds[:, 0] > 1).sum()) < 250
    moves = np.round(np.diff(found[:, :, 1], axis=1)[:, 0], 9)
    assert len({*zip(np.round(speeds[:, 0], 9), moves, strict=True)}) == 4  # whatever its gain
    again = steady("mismatch-20", 200)[0].states
    assert (found == again).all()
    model = task_of("mismatch-20").system
    assert float(model.step(torch.zeros(1, 5), torch.zeros(1, 1))[0, 0]) == 0.5


def test_who_meets_nothing_is_quiet_however_wrong_the_model_is(driven: Driven) -> None:
    eventless = {
        name: driven(name)[0].eventless for name in ("nominal", "mismatch-20", "disturb", "noise", "called")
    }
    for name in ("nominal", "mismatch-20", "disturb", "noise"):
        assert eventless[name].all(), name  # type: ignore[union-attr]
    assert eventless["called"].tolist() == [[True, False, True, True]] * 6  # type: ignore[union-attr]


def test_what_is_wrong_is_told() -> None:
    assert errors_of(task_of("mismatch-20").system.truth) == {
        "actuator_gain": 0.2,
        "parameters": 0.2,
        "numbers": ["drift (of y)", "speed (of x)"],
    }
    assert errors_of(task_of("noise").system.truth) == {"sensor_noise": 0.005}
    assert errors_of(task_of("nominal").system.truth) == {}


def test_worlds_are_the_same_whatever_is_disturbed() -> None:
    text = SYSTEM.replace("draw: {x: 0, y: 0", 'draw: {x: "uniform(0, 1)", y: 0')
    found = []
    for scenario in ("nominal", "mismatch-20", "noise-10"):
        decl = under(parse_system(Source("boat.yaml", text), Path("boat.yaml")), scenario)
        task, recorder = Task.of(Spec.parse(Source("a.stl", SPEC)), System(decl)), Recorder(3)  # type: ignore[arg-type]
        simulate(Guard(task, Steady(task)), world_type(decl), Setting((0, 1), 3, 1), recorder)
        found.append(recorder.recording().states[:, 0, 0].tolist())  # type: ignore[union-attr]
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("name", ["mismatch-0", "mismatch-101", "noise-", "noisy", "disturb-5%"])
def test_what_is_no_scenario_of_every_system(name: str) -> None:
    assert standard(name) is None
    with pytest.raises(StlcError) as caught:
        task_of(name)
    assert "every system has mismatch-5" in caught.value.diagnostics[0].help[1]


def test_a_scenario_of_the_file_goes_first() -> None:
    text = SYSTEM.replace("  nominal: {}\n", "  noise: {const: {speed: 2 m/s}}\n")
    decl = under(parse_system(Source("boat.yaml", text), Path("boat.yaml")), "noise")
    assert decl.constants["speed"][0] == 2.0


def test_an_unknown_scenario_is_said() -> None:
    with pytest.raises(StlcError) as caught:
        task_of("fats")
    assert "did you mean `fast`?" in caught.value.diagnostics[0].help[0]


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("speed: 3 m/s", "sped: 3 m/s", "S101"),
        ("speed: 3 m/s", "speed: 3 m/s +", "S201"),
        ("p: [1, 2]", "q: [1, 2]", "S202"),
        ("p: [0, 1]", "p: [0, 1, 2]", "S203"),
        ("0.4 m/s * sin", "0.4 m * sin", "E203"),
        ("expect: ood", "expect: bad", "S103"),
        ("at: 1 s, ", "", "S102"),
        ("sensor_noise: 2 %", "sensors: 2 %", "S101"),
        ("sensor_noise: 2 %", "sensor_noise: 200 %", "S103"),
    ],
)
def test_scenarios_are_checked_whether_chosen_or_not(old: str, new: str, code: str) -> None:
    assert SYSTEM.count(old) == 1
    with pytest.raises(StlcError) as caught:
        parse_system(Source("boat.yaml", SYSTEM.replace(old, new)), Path("boat.yaml"))
    assert code in {finding.code for finding in caught.value.diagnostics}


def test_a_scenario_brings_a_backup_and_preferences_of_its_own() -> None:
    usual, fragile = task_of("nominal"), task_of("fragile")
    assert grid_of(fragile).values == ((-1.0, 0.5),)
    assert grid_of(fragile).lengths == (1, 3)
    assert len(grid_of(usual).values[0]) == usual.system.decl.backup.bins
    x, u = usual.sample(1, seed=0, dtype=torch.float64), torch.full((1, 4, 1), 0.5, dtype=torch.float64)
    y = usual.rollout(x, u)[0, :, usual.system.names.index("y")]
    assert float(usual.cost(usual.judge(x, u))) == 0.0
    assert float(fragile.cost(fragile.judge(x, u))) == pytest.approx(2.0 * float((y - 1.0).mean()) + 0.25)
    assert fragile.system.decl.learnt != usual.system.decl.learnt  # only where it is laid over
    plain = parse_system(Source("boat.yaml", SYSTEM), Path("boat.yaml"))
    without = parse_system(Source("boat.yaml", SYSTEM[: SYSTEM.index("  fragile:")]), Path("boat.yaml"))
    assert plain.learnt == without.learnt
