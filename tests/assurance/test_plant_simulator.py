"""Simulations of black boxes as a search sees them: visible inputs, guidance, half steps, scope."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stlc.assurance.falsify import SearchBudget, falsify
from stlc.assurance.plant_simulator import PlantSimulator
from stlc.assurance.sharing import SharedSimulator
from stlc.plants.plant import Plant

CODE = """
def rates(t, x, u):
    return [u[0] * 1000.0, u[1]]


def leap(state, inputs, dt):
    return [state[0] + 1.0, dt]
"""
PLANT = """\
plant: 1
name: pair
python: "pair.py:rates"
time: {dt: 0.1 s, duration: 2 s}
initial: {big: 0, small: 0}
input: {f: {range: [-1, 1], pieces: 4}, g: {range: [-1, 1], pieces: 2, interpolate: linear}}
output: {big: {}, small: {}}
"""
SPEC = """
signal big, small
require early: always[0 s, 0.5 s] big <= 100
require whole: always[0 s, 2 s] big <= 100
require endless: always small <= 100
require mixed: always[0 s, 1 s] (big <= 800 or small <= 0.8)
require mild: always[0 s, 2 s] (big <= 800 or small <= 0.8)
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("pair.py").write_text(CODE)
    Path("pair.yaml").write_text(PLANT)
    Path("pair.stl").write_text(SPEC)
    return tmp_path


def load(spec: str = "pair.stl", plant: str = "pair.yaml") -> PlantSimulator:
    return PlantSimulator.load(spec, Path(plant), {})


@pytest.mark.usefixtures("home")
def test_only_inputs_that_a_requirement_sees_are_searched():
    simulator = load()
    held = PLANT.replace(", g: {range: [-1, 1], pieces: 2, interpolate: linear}", "")
    Path("held.yaml").write_text(held.replace("u[1]", "0"))
    alone = load(plant="held.yaml")
    assert alone.seen(0) == pytest.approx(0.3)  # five steps and the sample at their end, of twenty steps
    assert simulator.seen(0) == pytest.approx(0.3)
    assert simulator.space.visible(simulator.seen(0)).space.dim == 4  # a line leads to a value a second later
    assert [simulator.seen(index) for index in (1, 2)] == [1.0, 1.0]
    assert alone.space.visible(alone.seen(0)).space.dim == 2
    assert alone.space.visible(alone.seen(1)).space.dim == 4
    Path("long.stl").write_text(SPEC + "assume calm: always[0 s, 2 s] small <= 100\n")
    assert load("long.stl", "held.yaml").seen(0) == 1.0


@pytest.mark.usefixtures("home")
def test_a_requirement_does_not_depend_on_inputs_that_are_left_out():
    """Inputs of which a requirement is said to see nothing change its robustness by nothing."""
    simulator = load()
    rng = np.random.default_rng(0)
    for requirement in (0, 3):
        part = simulator.space.visible(simulator.seen(requirement))
        kept = list(part.coordinates)
        points = rng.random((4, simulator.space.dim))
        points[:, kept] = points[0, kept]
        with simulator.plant:
            margins = simulator.simulate(points, requirement).margins
        assert len(kept) < simulator.space.dim
        assert (margins == margins[0]).all()


@pytest.mark.usefixtures("home")
def test_a_counterexample_must_remain_at_half_the_time_step():
    counted = PLANT.replace("rates", "leap").replace("duration: 2 s", "duration: 2 s, halves: true")
    Path("half.yaml").write_text(counted)
    Path("half.stl").write_text(
        "signal big, small\n"
        "require few: always[0 s, 1 s] big <= 15\n"
        "require coarse: always[0.1 s, 1 s] small <= 0.05\n"
    )
    simulator = load("half.stl", "half.yaml")
    budget = SearchBudget(3)
    few, coarse = (falsify(simulator, index, budget=budget, seed=0, shrinks=False) for index in range(2))
    simulator.close()
    assert few.found is None  # 10 steps in a second are within the limit, 20 half steps are not
    assert few.least == 5.0
    assert coarse.found is None
    assert [each.half_step for each in coarse.spurious] == [pytest.approx(0.0)] * 3


@pytest.mark.usefixtures("home")
def test_a_plant_has_a_half_step_only_if_its_file_says_so():
    simulator = load()
    assert simulator.at_half_step(np.full((1, simulator.space.dim), 0.5), 0) is None
    Path("half.yaml").write_text(PLANT.replace("duration: 2 s", "duration: 2 s, halves: true"))
    halved = load(plant="half.yaml")
    ones = np.ones((1, halved.space.dim))
    found = halved.at_half_step(ones, 4)
    outcome = halved.simulate(ones, 4)
    halved.close()
    assert found is not None
    assert found.margins == pytest.approx(
        outcome.margins
    )  # the right-hand side is integrated exactly at both steps


@pytest.mark.usefixtures("home")
def test_a_failure_at_half_the_time_step_confirms_nothing_and_refutes_nothing():
    code = "def rates(t, x, u, n=[0]):\n    return [1 / (0.05 - t if t == 0.05 else 1), 0.0]\n"
    Path("pair.py").write_text(code)
    Path("half.yaml").write_text(PLANT.replace("duration: 2 s", "duration: 2 s, halves: true"))
    simulator = load(plant="half.yaml")
    found = simulator.at_half_step(np.ones((1, simulator.space.dim)), 0)
    simulator.close()
    assert found is not None
    assert not found.judged.any()
    assert simulator.findings == []


@pytest.mark.usefixtures("home")
def test_simulations_out_of_scope_are_not_admissible():
    Path("scoped.stl").write_text(SPEC + "assume calm: always[0 s, 2 s] big <= 500\n")
    simulator = load("scoped.stl")
    points = np.stack([np.ones(simulator.space.dim), np.zeros(simulator.space.dim)])
    with simulator.plant:
        assert simulator.simulate(points, 0).admissible.tolist() == [False, True]


@pytest.mark.usefixtures("home")
def test_a_requirement_that_counts_samples_has_no_half_step():
    Path("half.yaml").write_text(PLANT.replace("duration: 2 s", "duration: 2 s, halves: true"))
    Path("half.stl").write_text(
        "signal big\n"
        "require counted: always[0 s, 5 steps] big <= 100\n"
        "require timed: always[0 s, 1 s] big <= 100\n"
    )
    simulator = load("half.stl", "half.yaml")
    ones = np.ones((1, simulator.space.dim))
    counted, timed = (simulator.at_half_step(ones, index) for index in range(2))
    simulator.close()
    assert counted is None
    assert timed is not None


@pytest.mark.usefixtures("home")
def test_shared_simulations_use_all_processes_of_a_plant(monkeypatch: pytest.MonkeyPatch):
    simulator = PlantSimulator.load("pair.stl", Path("pair.yaml"), {}, jobs=2)
    sizes: list[int] = []
    simulate = Plant.simulate

    def counted(self: Plant, points: np.ndarray, **options: Any) -> Any:
        sizes.append(len(points))
        return simulate(self, points, **options)

    monkeypatch.setattr(Plant, "simulate", counted)
    points = np.random.default_rng(0).random((5, simulator.space.dim))
    shared = SharedSimulator(simulator, None, 5).simulate(points, 0)
    alone = simulator.simulate(points, 0)
    simulator.close()
    assert sizes == [2, 2, 1, 5]
    assert np.array_equal(shared.margins, alone.margins)


@pytest.mark.usefixtures("home")
def test_simulations_that_end_before_a_verdict_are_counted():
    Path("long.stl").write_text(
        "signal big, small\n"
        "require long: always[0 s, 5 s] big <= 1e6\n"
        "require part: small > 0.5 -> always[0 s, 5 s] big <= 1e6\n"
        "require hit: always[0 s, 5 s] (big <= 200 and big >= -200)\n"
    )
    Path("long.yaml").write_text(PLANT.replace("small: 0", "small: {range: [0, 1]}"))
    simulator = load("long.stl", "long.yaml")
    with simulator.plant:
        long, part, hit = (
            falsify(simulator, index, budget=SearchBudget(12), seed=0, shrinks=False) for index in range(3)
        )
    assert (long.simulations, long.inconclusive, long.least, long.coverage) == (12, 12, np.inf, 0.0)
    assert 0 < part.inconclusive < part.simulations == 12
    assert part.least < np.inf
    assert part.coverage > 0.0
    assert hit.found is not None  # a violation needs no end


@pytest.mark.usefixtures("home")
def test_a_half_step_without_verdict_confirms_nothing_and_refutes_nothing():
    Path("long.stl").write_text("signal big, small\nrequire long: always[0 s, 5 s] big <= 1e6\n")
    Path("half.yaml").write_text(PLANT.replace("duration: 2 s", "duration: 2 s, halves: true"))
    simulator = load("long.stl", "half.yaml")
    found = simulator.at_half_step(np.ones((1, simulator.space.dim)), 0)
    simulator.close()
    assert found is not None
    assert not found.judged.any()
