"""Simulations and proofs under errors of parameters, against plants whose text has the other numbers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.uncertain_plants import CARRIED, REFUSED, uncertain_plant
from torch import Tensor

from stlc.assurance.certified_search import Certifier
from stlc.assurance.verification.boxes import Box
from stlc.assurance.verification.plans import ProposedPlans
from stlc.assurance.verification.tubes import Tube, TubeModel
from stlc.assurance.verification.verify import Verifier
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork, Policy
from stlc.controller.problem.task import Task
from stlc.controller.search.plan_traces import RANDOM, following
from stlc.controller.world import ModelWorld
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.perturbable import perturbable
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.perturbed import PerturbedSystem
from stlc.grammar.spec import Spec
from stlc.source import Source

PLANS = 4
LOOSE = 1e-9
CONSTANT = ("derived constant", "table", "table of two")
"""Places that read constants only, not parameters of a trajectory."""


class Case:
    """A random plant, its task, and random plans."""

    def __init__(self, seed: int) -> None:
        self.plant = uncertain_plant(seed, listed=bool(seed % 2))
        self.rng = np.random.default_rng(seed)
        self.task = Task.of(Spec.parse(Source("plant.stl", self.plant.spec)), self.plant.system())
        self.tubes = TubeModel(self.task)
        share = self.rng.uniform(-1, 1, (PLANS, self.task.horizon, 1))
        self.plans = torch.from_numpy(share)
        loose = perturbable(self.task.plain.decl)
        exact = set(loose.exact)
        self.names = [name for name in self.plant.values if name not in exact]

    def rebuilt(self) -> System:
        """The plant with all numbers off, half of the time at the ends of their errors."""
        share = self.rng.uniform(-1, 1, len(self.names))
        share = np.where(self.rng.random(len(share)) < 0.5, np.sign(share), share)
        return self.plant.rebuilt(dict(zip(self.names, 1.0 + self.plant.size * share, strict=True)))

    def follow(self, system: System, x: Tensor) -> Tensor:
        """States of a rebuilt plant under the plans, with the timers of the specification."""
        states = [x]
        for step in range(self.task.horizon):
            x = system.step(x, self.plans[:, step])
            states.append(x)
        return torch.stack(states, 1)

    def contains(self, tube: Tube, states: Tensor) -> bool:
        """True if all states and their robustness are within a tube."""
        inside = True
        for index, name in enumerate(self.task.system.names):
            values, box = states[:, :, index].T.numpy(), tube.states[name]
            inside &= bool(((box.low <= values + LOOSE) & (values <= box.high + LOOSE)).all())
        rho = self.task.requirement_robustness(states)
        return inside and bool(((tube.low <= rho + LOOSE) & (rho <= tube.high + LOOSE)).all())


def outside(seed: int, count: int) -> list[str]:
    """Compare the proofs for one plant with rebuilt plants; return what is outside."""
    case = Case(seed)
    x = case.task.sample(PLANS, seed=seed, dtype=torch.float64)
    tube = case.tubes.tube(x, case.plans, start=following(case.task, RANDOM))
    certifier, found = Certifier(case.task), []
    for number in range(count):
        other = case.rebuilt()
        states = case.follow(other, other.sample(PLANS, seed=seed, dtype=torch.float64))
        if not case.contains(tube, states):
            found.append(f"tube of plant {seed}")
        if number % 4:
            continue
        middle = states[:, int(case.rng.integers(1, case.task.horizon))]
        later = case.follow(other, middle)
        if not case.contains(case.tubes.tube(middle, case.plans), later):
            found.append(f"tube of plant {seed} on the way")
        low = certifier.guaranteed(middle, case.plans)
        safe = case.task.requirement_robustness(later)[:, :2].amin(1)
        if bool((low > safe + LOOSE).any()):
            found.append(f"certificate of plant {seed}")
    return found


def differing(seed: int) -> float:
    """Greatest difference between the drives of a deployment and those of rebuilt plants, agent by agent."""
    case, agents = Case(seed), 3
    worlds = Worlds(case.task, ModelWorld, Setting((seed,), agents, case.task.horizon))
    (truth,) = worlds.truths
    assert isinstance(truth, PerturbedSystem)
    numbers = [each.text for each in perturbable(case.task.plain.decl).numbers]
    values = case.plant.values
    ours = [index for index, text in enumerate(numbers) if text in values]
    assert {numbers[index] for index in ours} == set(case.names)
    # literals of the terms that are the same in all plants have no error here
    truth.values[:, [index for index in range(len(numbers)) if index not in ours]] = 1.0
    x = worlds.reset()
    each = [
        case.plant.rebuilt({numbers[index]: float(truth.values[row, index]) for index in ours})
        for row in range(agents)
    ]
    starts = [other.sample(agents, seed=seed, dtype=torch.float64)[row] for row, other in enumerate(each)]
    moved, worst = torch.stack(starts), float((torch.stack(starts) - x).abs().max())
    for step in range(case.task.horizon):
        act = case.plans[:agents, step]
        x = worlds.advance(x, act, step + 1)
        rows = zip(each, moved.split(1), act.split(1), strict=True)
        moved = torch.cat([other.step(*at) for other, *at in rows])
        worst = max(worst, float((moved - x).abs().max()))
    return worst


def unproved(seed: int, count: int) -> list[str]:
    """Compare bounds of `stlc verify` over parameters of a trajectory with rebuilt plants.

    The parameters are drawn with the initial states; a rebuilt plant has their values as constants.
    """
    plant = uncertain_plant(seed, listed=True)
    text, ranges = plant.text, []
    for name, place in plant.places.items():
        if place not in CONSTANT:
            ends = [plant.values[name] * (1.0 + plant.size * sign) for sign in (-1, 1)]
            text = re.sub(rf"(?m)^  {name}: .*\n", "", text)
            ranges.append(f"  {name}: {{range: {ends}}}")
    text = re.sub(r"(?m)^test: .*\n", "", text).replace("const:\nstate:", "state:")
    text = text.replace("control:\n", "\n".join(["param:", *ranges, "control:\n"]))
    system = System(parse_system(Source("drawn.yaml", text), Path("drawn.yaml")))
    task = Task.of(Spec.parse(Source("plant.stl", plant.spec)), system)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PlanNetwork(task, hidden=(8, 8), plans=2, varied=True).eval()
        network.normalise(task.sample(100, seed=1))
    policy = BestOfKPolicy(task, network)
    verifier = Verifier(ProposedPlans(task, policy), seed=1)
    (mode,) = verifier.modes
    rng = np.random.default_rng(seed)
    half = 0.5 * 10.0 ** rng.uniform(-2, -0.5, (count, len(mode.coordinates)))
    boxes = [Box(*each) for each in zip(rng.uniform(half, 1.0 - half), half, strict=True)]
    low = verifier.bound(mode, boxes, 0).low
    corners = rng.choice([-1.0, 1.0, 0.3], half.shape)
    x0 = verifier.states(mode, np.stack([box.centre for box in boxes]) + corners * half)
    with torch.no_grad():
        plans = policy.candidates(x0)[:, 0].double()
    found = []
    for row in range(count):
        drawn = dict(zip(system.names, x0[row].tolist(), strict=True))
        other = plant.rebuilt(
            {name: drawn[name] / plant.values[name] for name in plant.places if name in drawn}
        )
        start = torch.tensor([[drawn[name] for name in other.names]], dtype=torch.float64)
        columns = dict(zip(other.names, other.rollout(start, plans[row : row + 1]).unbind(2), strict=True))
        steady = torch.ones(1, task.horizon + 1, dtype=torch.float64)
        whole = [columns.get(name, drawn[name] * steady) for name in system.names]
        if float(low[row]) > float(task.robustness(torch.stack(whole, 2))[0]) + LOOSE:
            found.append(f"bound of plant {seed}")
    return found


class Still(Policy):
    """Policy whose only plan does nothing."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.zeros((len(x0), 1, self.task.horizon, 1), dtype=x0.dtype)


def unguarded(seed: int, count: int) -> list[str]:
    """Let the guard `certified` decide in rebuilt plants, and follow its plans there to the end.

    Returns the plans whose guaranteed robustness is greater than that in the rebuilt plant.
    """
    case, found = Case(seed), []
    guard, certifier = Guard(case.task, Still(case.task), "certified"), Certifier(case.task)
    for _ in range(count):
        other = case.rebuilt()
        x = other.sample(PLANS, seed=seed, dtype=torch.float64)
        case.plans = guard.decide(x).plan
        low = certifier.guaranteed(x, case.plans)
        safe = case.task.requirement_robustness(case.follow(other, x))[:, :2].amin(1)
        if bool((low > safe + LOOSE).any()):
            found.append(f"plan of the guard in plant {seed}")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1020))
def test_plans_of_the_guard_keep_their_guarantee_in_rebuilt_plants(seed: int) -> None:
    assert unguarded(seed, 3) == []


@pytest.mark.apart
@pytest.mark.parametrize("seed", range(3))
def test_no_rebuilt_plant_is_outside(seed: int) -> None:
    assert outside(seed, 3) == []
    assert differing(seed) < LOOSE
    assert unproved(seed, 3) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1200))
def test_no_rebuilt_plant_of_two_hundred_is_outside(seed: int) -> None:
    assert outside(seed, 5) == []
    assert differing(seed) < LOOSE
    assert unproved(seed, 5) == []


def test_two_hundred_plants_have_parameters_in_every_place() -> None:
    for listed in (True, False):
        seeds = range(1000 + listed, 1200, 2)
        places = {place for seed in seeds for place in uncertain_plant(seed, listed=listed).places.values()}
        assert places == set(CARRIED)


@pytest.mark.parametrize("seed", range(len(REFUSED)))
def test_a_parameter_whose_error_cannot_be_carried_is_refused_by_name(seed: int) -> None:
    plant = uncertain_plant(seed, listed=True, refused=list(REFUSED)[seed])
    (name,) = (name for name, place in plant.places.items() if place in REFUSED)
    task = Task.of(Spec.parse(Source("plant.stl", plant.spec)), plant.system())
    for use in (TubeModel, Certifier, deployed):
        with pytest.raises(SystemFileError) as caught:
            use(task)
        (found,) = caught.value.diagnostics
        assert found.code == "S212"
        assert f"`{name}`" in found.message
        assert found.span is not None
        assert name in found.span.text


def deployed(task: Task) -> Worlds:
    """The worlds of a deployment."""
    return Worlds(task, ModelWorld, Setting((0,), 2, 3))
