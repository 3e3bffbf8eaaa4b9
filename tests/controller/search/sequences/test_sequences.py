"""Relaxed plans, phases, and plans as sequences of phases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import Recorder, simulate
from stlc.controller.guard.guard import Guard
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.controller.search.planner_policy import PlannerPolicy
from stlc.controller.search.sequences.phases import PhaseRequest
from stlc.controller.search.sequences.sequences import Sequences
from stlc.controller.world import world_type

MISSIONS = Path(__file__).parents[3] / "data/sequences"


@pytest.fixture(scope="module")
def handover() -> Task:
    return Task.load(MISSIONS / "handover.stl")


def names_of(sequences: Sequences, steps: frozenset[int]) -> set[str]:
    each = (sequences._relaxation.steps[step].jump for step in steps)
    return {"wait" if jump is None else jump.name for jump in each}


def test_a_relaxed_plan_has_the_jumps_that_the_goals_need(handover: Task) -> None:
    x0 = handover.sample(1, seed=0)[0].double()
    sequences = Sequences(handover, x0)
    root = sequences.root(x0)
    assert root is not None
    wanted = {f"{verb} {part}" for verb in ("grip", "put", "fetch", "drop") for part in "ab"}
    assert names_of(sequences, root.steps) == wanted
    possible = frozenset(filter(root.relaxed.possible, root.steps))
    assert names_of(sequences, possible) == {"grip a"}  # the other part needs a free cart or a filled place


@pytest.mark.apart
def test_a_phase_reaches_its_target_and_stays_safe(handover: Task) -> None:
    x0 = handover.sample(1, seed=0)[0].double()
    sequences = Sequences(handover, x0)
    root = sequences.root(x0)
    assert root is not None
    if sequences._phases is None:
        pytest.skip("no C compiler")
    step = next(filter(root.relaxed.possible, root.steps))
    request = PhaseRequest(sequences._first_step + step, 0, sequences.steps - 1)
    phase = sequences._phases.reach(x0.numpy(), request, np.random.default_rng(0))
    assert phase.margin >= 0.0
    names = handover.system.names
    p, q = (phase.states[: phase.sample + 2, names.index(name)] for name in "pq")
    assert (q - p >= 1.0).all()
    assert p[phase.sample] <= 0.5
    part = phase.states[:, names.index("part")]
    assert part[phase.sample] == 0.0
    assert part[phase.sample + 1] == 1.0  # the jump happens in the next step
    again = sequences._phases.reach(x0.numpy(), request, np.random.default_rng(0))
    assert np.array_equal(phase.plan, again.plan)


@pytest.mark.apart
def test_a_phase_is_short_where_safety_binds_the_way_to_its_target(tmp_path: Path) -> None:
    """The arm goes out only in front of the station, where no sequence of whole turns leads."""
    (tmp_path / "arm.yaml").write_text(
        "stlc: 1\nname: arm\ntime: {dt: 0.5 s, horizon: 108 s}\n"
        "state: {th: {range: [-1, 5]}, out: {range: [0, 1], clamp: true}, got: {bool: true}}\n"
        "control: {turn: {range: [-1.2, 1.2]}, push: {range: [-0.8, 0.8]}}\n"
        "flow: {th: turn, out: push}\n"
        "jump: [{name: take, guard: out >= 0.9 and abs(th) <= 0.12, reset: {got: true}}]\n"
        "init: {mixture: [{draw: {th: 3.74, out: 0, got: false}}]}\n"
    )
    (tmp_path / "take.stl").write_text(
        'spec take\nsystem "arm.yaml"\nstate signal th, out\nstate signal got : bool\n'
        "def facing(a) = abs(th - a) <= 0.12\n"
        "@safety\nrequire aligned: always[0, T] (out > 0.15 -> facing(0) or facing(2.1) or facing(4.2))\n"
        "require taken: eventually[0, T] got\n"
    )
    task = Task.load(tmp_path / "take.stl")
    x0 = task.sample(1, seed=0)[0].double()
    sequences = Sequences(task, x0)
    if sequences._phases is None:
        pytest.skip("no C compiler")
    request = PhaseRequest(sequences._first_step, 0, sequences.steps - 1)
    found = [sequences._phases.reach(x0.numpy(), request, np.random.default_rng(seed)) for seed in range(6)]
    assert min(phase.margin for phase in found) >= 0.0
    assert max(phase.sample for phase in found) <= 18


@pytest.mark.apart
def test_a_phase_begins_with_what_reached_another_target(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(
        "stlc: 1\nname: arm\ntime: {dt: 0.5 s, horizon: 40 s}\n"
        "state: {th: {range: [-1, 5]}, out: {range: [0, 1], clamp: true},"
        " got: {bool: true}, fed: {bool: true}}\n"
        "control: {turn: {range: [-1.2, 1.2]}, push: {range: [-0.8, 0.8]}}\n"
        "flow: {th: turn, out: push}\n"
        "jump:\n"
        "  - {name: take, guard: out >= 0.9 and abs(th) <= 0.12 and not got, reset: {got: true}}\n"
        "  - {name: feed, guard: out >= 0.9 and abs(th) <= 0.12 and not fed, reset: {fed: true}}\n"
        "init: {mixture: [{draw: {th: 1, out: 0, got: false, fed: false}}]}\n"
    )
    (tmp_path / "take.stl").write_text(
        'spec take\nsystem "arm.yaml"\nstate signal th, out\nstate signal got, fed : bool\n'
        "@safety\nrequire aligned: always[0, T] (out > 0.15 -> abs(th) <= 0.12)\n"
        "require taken: eventually[0, T] got\nrequire fed: eventually[0, T] fed\n"
    )
    task = Task.load(tmp_path / "take.stl")
    x0 = task.sample(1, seed=0)[0].double()
    sequences = Sequences(task, x0)
    if sequences._phases is None:
        pytest.skip("no C compiler")
    tried = []
    for target in (0, 1):
        before = sequences._phases.tried
        request = PhaseRequest(sequences._first_step + target, 0, sequences.steps - 1)
        assert sequences._phases.reach(x0.numpy(), request, np.random.default_rng(0)).margin >= 0.0
        tried.append(sequences._phases.tried - before)
    assert tried[1] < 0.5 * tried[0], tried


def test_a_target_out_of_reach_is_approached(handover: Task) -> None:
    x0 = handover.sample(1, seed=0)[0].double()
    sequences = Sequences(handover, x0)
    if sequences._phases is None:
        pytest.skip("no C compiler")
    root = sequences.root(x0)
    assert root is not None
    step = next(filter(root.relaxed.possible, root.steps))
    request = PhaseRequest(sequences._first_step + step, 0, 1)
    phase = sequences._phases.reach(x0.numpy(), request, np.random.default_rng(0))
    assert sequences._phases.margin(x0.numpy(), request) <= phase.margin < 0.0


@pytest.mark.parametrize(
    "mission",
    [
        "handover",
        pytest.param("recipe", marks=pytest.mark.slow),
        pytest.param("glider", marks=pytest.mark.slow),
    ],
)
def test_missions_of_many_steps_are_planned(mission: str) -> None:
    task = Task.load(MISSIONS / f"{mission}.stl")
    if task.native is None:
        pytest.skip("no C compiler")
    found = plan(task, task.sample(1, seed=4), budget=PlanBudget(30.0), seed=1)
    assert bool(found.satisfied.all())


def test_timers_and_heaters_are_regressed_to_jumps() -> None:
    task = Task.load(MISSIONS / "recipe.stl")
    x0 = task.sample(1, seed=0)[0].double()
    sequences = Sequences(task, x0)
    root = sequences.root(x0)
    assert root is not None
    assert names_of(sequences, root.steps) >= {"to one", "to two", "cooked 1", "cooked 2", "wait"}
    waits = [step for step in root.steps if root.relaxed.wait(step) is not None]
    assert sorted(root.relaxed.wait(step) for step in waits) == pytest.approx([20.0, 20.0])


def test_each_goal_in_a_chain_is_a_step() -> None:
    task = Task.load(MISSIONS / "glider.stl")
    state = task.sample(1, seed=0)[0].double()
    root = Sequences(task, state).root(state)
    assert root is not None
    assert (root.missing, len(root.goals)) == (4, 1)  # only the first is pending


def test_a_search_goes_on_where_the_last_one_ended(handover: Task) -> None:
    x0 = handover.sample(1, seed=0)[0].double()
    sequences = Sequences(handover, x0)
    if sequences._phases is None:
        pytest.skip("no C compiler")
    search = sequences.plans(x0, np.random.default_rng(0))
    best = next(plan for plan in search if plan is not None)
    search.close()
    later = handover.rollout(x0[None], best[None])[0, 1]
    longest = max(len(node.plan) for node in sequences._open)
    earlier = sequences._reopened(later)
    assert max(len(node.plan) for node in earlier) == longest - 1
    assert np.allclose(earlier[-1].states[0], later.numpy())
    assert sequences._reopened(x0) == []


@pytest.mark.slow
def test_calls_that_no_plan_foresees_are_answered() -> None:
    task = Task.load(MISSIONS / "lift.stl", whole=True)
    if task.native is None:
        pytest.skip("no C compiler")
    policy = PlannerPolicy(task, planner_named("search"), PlanBudget(1.0, 12_000), seed=0)
    recorder = Recorder(2, pictured=False)
    steps = task.system.decl.test.steps
    simulate(Guard(task, policy, "none"), world_type(task.system.decl), Setting((1,), 2, steps), recorder)
    states = recorder.recording().states
    names = task.system.names
    calls = states[:, :, [names.index(f"call[{i}]") for i in range(3)]]
    assert (np.diff(calls, axis=1) > 0.0).any()  # there were events
    assert (states[:, -1, [names.index(name) for name in names if name.startswith("answer")]] >= 0.0).all()
