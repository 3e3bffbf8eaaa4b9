"""FMUs that are simulated, falsified and certified by the same process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.assurance.campaign import Campaign, campaign
from stlc.assurance.certificate import Claim
from stlc.assurance.draws import PlantDraws
from stlc.assurance.falsify import SearchBudget, falsify
from stlc.assurance.plant_judge import PlantJudge
from stlc.assurance.plant_simulator import PlantSimulator
from stlc.toolchain import compiler

pytest.importorskip("fmpy")
if compiler() is None:
    pytest.skip("no C compiler", allow_module_level=True)

from helpers.fmus import build

FMUS = {
    "ball": (
        3,
        "initial: {h: {unit: m, range: [0.5, 2]}}\nparam: {e: {range: [0.5, 0.9]}}\noutput: {h: {unit: m}}\n",
        "signal h: real [m]\n"
        "require above: always[0 s, 2 s] h >= -1 mm\n"
        "require low: always[1 s, 2 s] h <= 0.9 m\n",
    ),
    "oscillator": (
        2,
        "initial: {x0: {range: [-3, 3]}}\nparam: {mu: {range: [0.2, 4]}}\noutput: {x0: , x1: }\n",
        "signal x0, x1\n"
        "require bounded: always[0 s, 2 s] abs(x0) <= 20\n"
        "require slow: always[0 s, 2 s] abs(x1) <= 4\n",
    ),
    "decay": (
        3,
        "initial: {x: {range: [0.5, 2]}}\ninput: {force: {range: [-1, 1], pieces: 2}}\noutput: {x: }\n",
        "signal x\nrequire finite: always[0 s, 2 s] x <= 9\nrequire falls: always[1 s, 2 s] x <= 1\n",
    ),
}


@pytest.mark.apart
@pytest.mark.parametrize("name", FMUS)
def test_an_fmu_is_simulated_falsified_and_certified(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    version, sections, spec = FMUS[name]
    halves = "true" if name == "oscillator" else "false"
    build(tmp_path, name, version)
    Path("plant.yaml").write_text(
        f"plant: 1\nname: {name}\nfmu: {{file: {name}.fmu, interface: model exchange, tolerance: 1e-8}}\n"
        f"time: {{dt: 20 ms, duration: 2 s, halves: {halves}}}\n{sections}"
    )
    Path("spec.stl").write_text(spec)
    judge = PlantJudge.load("spec.stl", "plant.yaml", {})
    searcher = PlantSimulator(judge)
    draws = PlantDraws(judge, Path("spec.stl"))
    first, second = searcher.requirements
    runs = list(judge.runs(judge.random_points(range(4)), range(4)))
    budget = SearchBudget(20)
    open_, found = (falsify(searcher, index, budget=budget, seed=0, shrinks=False) for index in range(2))
    (last,) = campaign(Campaign(draws, Claim(0.3), seeds=tuple(range(20))))
    searcher.close()
    assert all(run.finding is None for run in runs)
    held = [all(each.verdict == "satisfied" for each in run.requirements) for run in runs]
    assert open_.found is None
    assert open_.simulations == 20
    assert found.found is not None
    if name == "oscillator":
        assert found.found.half_step == pytest.approx(found.found.margin, abs=0.05)
    overall, (kept, broken) = last.assessment.overall, last.assessment.requirements
    assert (kept.name, kept.satisfied, kept.units) == (first, 20, 20)
    assert (broken.name, overall.satisfied) == (second, broken.satisfied)
    assert np.sum(held) <= broken.satisfied < 20
    assert last.assessment.answer == "certified"
