"""Falsification of systems without controls and of black boxes."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from stlc.assurance.draws import ModelDraws
from stlc.assurance.falsify import SearchBudget, SearchOrder, falsify, falsify_each
from stlc.assurance.model_simulator import ModelSimulator
from stlc.assurance.plant_simulator import PlantSimulator
from stlc.assurance.sharing import SharedSimulator, SimulatorWorkers
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.parallel.workers import LocalProcesses
from stlc.trace import Trace

SYSTEM = """
stlc: 1
name: oscillator
time: {dt: 0.05 s, horizon: 200 steps, integrator: rk4}
inputs: {f: {range: [-1, 1], pieces: 10, duration: 10 s}}
state: {x: {range: [-9, 9]}, v: {range: [-9, 9]}}
flow: {x: v, v: "f - x - 0.2 * v"}
init: {mixture: [{draw: {x: "uniform(-0.1, 0.1)", v: 0}}]}
"""
SPEC = """
system "oscillator.yaml"
signal x, v, f
require resonance: always[0 s, 10 s] x < 2.2
require bounded: always[0 s, 10 s] x < 50
require early: always[0 s, 2 s] x < 0.9
require mixed: always[0 s, 5 s] (x < 1.5 or 1000 * v < 500)
"""
PLANT = """
plant: 1
name: fall
python: "fall.py:rates"
time: {dt: 50 ms, duration: 1 s}
initial: {h: {range: [1, 3]}, w: {value: 0}}
input: {lift: {range: [0, 4], pieces: 4}}
output: {h: {}, w: {}}
"""
FALL = """
def rates(t, x, u):
    if x[0] < -3:
        raise RuntimeError("below the ground")
    return [x[1], u[0] - 9.81]
"""


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("oscillator.yaml").write_text(SYSTEM)
    Path("oscillator.stl").write_text(SPEC)
    return tmp_path


@pytest.mark.apart
def test_resonance_is_found_at_half_the_step_too_and_shrunk():
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    (block,) = simulator.space.blocks
    assert (block.name, len(block.values), simulator.space.dim) == ("f", 10, 11)
    found = falsify(simulator, 0, budget=SearchBudget(200), seed=3)
    assert found.found is not None
    assert found.found.margin < 0.0
    assert found.found.half_step == pytest.approx(found.found.margin, abs=0.01)
    assert found.shrunk is not None
    assert found.shrunk.margin < 0.0
    switches, before = (np.count_nonzero(np.diff(each.point[:10])) for each in (found.shrunk, found.found))
    assert switches <= before
    again = falsify(ModelSimulator.load("oscillator.stl", None, {}), 0, budget=SearchBudget(200), seed=3)
    assert np.array_equal(again.found.point, found.found.point)


def test_inputs_after_the_last_sample_that_matters_are_not_searched():
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    assert simulator.seen(simulator.requirements.index("early")) == pytest.approx(0.2)
    found = falsify(simulator, 2, budget=SearchBudget(30), seed=0)
    assert found.found is not None
    assert (found.found.point[2:10] == 0.5).all() or (found.found.point[3:] == 0.5).all()


@pytest.mark.apart
@pytest.mark.parametrize(("interpolate", "kept"), [("hold", 2), ("linear", 3), ("pchip", 4)])
def test_exactly_the_values_that_a_requirement_sees_are_searched(interpolate, kept):
    """Always up to 2 s, with values every second: a line from 1 s to 2 s leads to the value at 2 s."""
    keys = {"inputs.f.interpolate": interpolate, "inputs.f.pieces": "10"}
    simulator = ModelSimulator.load("oscillator.stl", None, keys)
    early = simulator.requirements.index("early")
    part = simulator.space.visible(simulator.seen(early))
    (block,) = part.space.blocks
    assert len(block.values) == kept
    rising = np.linspace(0.6, 0.9, simulator.space.dim) * np.ones((simulator.space.dim, 1))
    first = simulator.simulate(rising, early).margins
    changed = simulator.simulate(rising + 0.01 * np.eye(simulator.space.dim), early).margins != first
    assert set(np.flatnonzero(changed)) == set(part.coordinates)


def test_an_input_that_a_requirement_reads_counts_at_the_last_sample():
    Path("read.stl").write_text(SPEC.replace("x < 0.9", "x + 0.01 * f < 0.9"))
    simulator = ModelSimulator.load("read.stl", None, {})
    assert len(simulator.space.visible(simulator.seen(2)).space.blocks[0].values) == 3


def test_a_search_without_success_reports_what_it_did():
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    found = falsify(simulator, 1, budget=SearchBudget(12), seed=0)
    assert (found.found, found.simulations) == (None, 12)
    assert sum(found.strategies.values()) == 12
    assert 0.0 < found.coverage < 1.0
    assert 45.0 < found.least < 50.0


def test_gradients_agree_with_differences_and_count_as_simulations():
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    point = np.random.default_rng(2).random(simulator.space.dim)
    slope = simulator.gradient(point, 0)
    if slope is None:
        pytest.skip("there is no C compiler")
    moved = simulator.simulate(point + 1e-5 * np.eye(len(point)), 0).margins
    assert np.allclose(slope, (moved - simulator.simulate(point[None], 0).margins) / 1e-5, atol=1e-4)
    found = falsify(simulator, 1, budget=SearchBudget(24), seed=2)
    assert found.strategies["gradient"] >= 2
    assert sum(found.strategies.values()) == found.simulations >= 24


def test_models_with_jumps_or_whole_numbers_have_no_gradient():
    Path("oscillator.yaml").write_text(SYSTEM + "jump: [{guard: x > 8, reset: {x: 0}}]\n")
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    assert simulator.gradient(np.full(simulator.space.dim, 0.5), 0) is None


SWITCHED = """
stlc: 1
name: switched
time: {dt: 0.1 s, horizon: 40 steps, integrator: euler}
inputs: {f: {range: [0, 1], pieces: 4, duration: 4 s}}
state: {x: {range: [-9, 9]}}
held: {level: {int: true, range: [0, 3], value: round(3 * f)}, z: {value: x}}
flow: {x: -15 * x}
init: {mixture: [{draw: {x: 1}}]}
"""


def test_a_violation_that_half_the_step_does_not_have_is_spurious():
    Path("switched.yaml").write_text(SWITCHED)
    Path("switched.stl").write_text(
        'system "switched.yaml"\nsignal x, z\nsignal level : int\nrequire up: always[0 s, 3 s] x > -0.1\n'
        "require steps: always[0 s, 3 s] (level != 2 or eventually[0.1 s, 1 s] level == 0)\n"
    )
    simulator = ModelSimulator.load("switched.stl", None, {})
    found = falsify(simulator, 0, budget=SearchBudget(8), seed=0)
    assert found.found is None
    assert len(found.spurious) >= 5
    assert found.spurious[0].margin == pytest.approx(-0.4)
    assert found.spurious[0].half_step == pytest.approx(0.1)  # values of `held` keep their period
    assert (simulator.graded(0), simulator.graded(1)) == (True, False)
    discrete = falsify(simulator, 1, budget=SearchBudget(60), seed=0, shrinks=False)
    assert discrete.found is not None
    assert set(discrete.strategies) <= {"uniform", "vertices"}  # nothing can be learnt


def test_inputs_of_different_durations_are_cut_at_the_same_time(home: Path):
    inputs = (
        "{f: {range: [-1, 1], pieces: 10, duration: 10 s}, g: {range: [-1, 1], pieces: 10, duration: 5 s}}"
    )
    file = SYSTEM.replace("{f: {range: [-1, 1], pieces: 10, duration: 10 s}}", inputs)
    (home / "oscillator.yaml").write_text(file.replace("f - x", "f + g - x"))
    simulator = ModelSimulator.load("oscillator.stl", None, {})
    blocks = simulator.space.visible(simulator.seen(simulator.requirements.index("early"))).space.blocks
    assert [len(block.values) for block in blocks] == [2, 4]  # pieces of 1 s and of .5 s, until 2 s


def test_the_command_writes_what_it_can_replay(capsys):
    assert main(["falsify", "oscillator.stl", "--require", "early", "--simulations", "30"]) == 1
    assert "early: violated, robustness -" in capsys.readouterr().out
    assert main(["check", "counterexamples/early.npz", "--require", "early"]) == 1
    assert main(["falsify", "oscillator.stl", "--replay", "counterexamples/early.json"]) == 1
    assert "bit for bit" in capsys.readouterr().out
    stored = json.loads(Path("counterexamples/early.json").read_text())
    trace = Trace.load("counterexamples/early.npz")
    assert float((0.9 - trace.data["x"][0, :41]).min()) == pytest.approx(stored["margin"], abs=1e-9)
    Path("oscillator.yaml").write_text(SYSTEM.replace("0.2 * v", "0.1 * v"))
    main(["falsify", "oscillator.stl", "--replay", "counterexamples/early.json"])
    assert "different: x, v" in capsys.readouterr().out


@pytest.fixture
def fall() -> None:
    Path("fall.yaml").write_text(PLANT)
    Path("fall.py").write_text(FALL)
    Path("fall.stl").write_text(
        "signal h\nrequire up: always[0 s, 0.6 s] h > 0\nrequire deep: always[0 s, 1 s] h > -50\n"
    )


@pytest.mark.apart
@pytest.mark.usefixtures("fall")
def test_black_boxes_are_falsified_and_their_failures_reported(capsys):
    simulator = PlantSimulator.load("fall.stl", Path("fall.yaml"), {})
    with simulator.plant:
        assert [block.name for block in simulator.space.blocks] == ["lift"]
        outcome = simulator.simulate(np.stack([np.ones(5), np.zeros(5)]), 0)
    assert outcome.admissible.tolist() == [True, True]
    assert outcome.margins[1] == np.inf
    assert "below the ground" in simulator.findings[0].finding.message
    assert main(["falsify", "fall.stl", "--plant", "fall.yaml", "--simulations", "20"]) == 1
    text = capsys.readouterr().out
    assert "up: violated, robustness -" in text
    assert "does not repeat itself" not in text
    assert re.search(r"deep: no violation in \d+ simulations", text), text
    assert re.search(r"failed, error at t = \S+ s: RuntimeError: below the ground", text)
    replay = ["--plant", "fall.yaml", "--replay", "counterexamples/up.json"]
    assert main(["falsify", "fall.stl", *replay]) == 1
    assert "bit for bit" in capsys.readouterr().out
    assert main(["falsify", "latest", "--plant", "fall.yaml"]) == 2


@pytest.mark.usefixtures("fall")
def test_a_failure_is_a_file_that_replays(capsys):
    command = ["falsify", "fall.stl", "--plant", "fall.yaml"]
    assert main([*command, "--require", "deep", "--simulations", "12", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert not misfits(document, load_schema("falsify/1"))
    result = document["result"]
    assert result["requirements"][0]["verdict"] == "open"
    (finding,) = result["findings"]
    assert finding["reason"] == "error"
    assert 0.8 <= finding["time"] <= 1.0
    assert finding["simulations"] >= 1
    assert result["failures"] == ["error: RuntimeError: below the ground"]
    assert "Traceback" in finding["stderr"]
    replay = shlex.split(finding["replay"])[1:]
    assert main([*replay, "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert not misfits(document, load_schema("falsify/1"))
    assert document["result"]["identical"] is True
    Path("fall.py").write_text(FALL.replace("< -3", "< -100"))
    assert main(replay) == 0
    assert "gives a trace; before: error" in capsys.readouterr().out
    assert main([*replay, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["reason"] is None
    stored = json.loads(Path(finding["file"]).read_text())
    Path("torn.json").write_text(json.dumps({**stored, "point": stored["point"][1:]}))
    for words in (
        [*command, "--replay", "torn.json"],
        ["falsify", "oscillator.stl", "--replay", finding["file"]],
    ):
        assert main(words) == 2


@pytest.mark.apart
@pytest.mark.usefixtures("fall")
def test_a_counterexample_whose_plant_fails_now(capsys):
    command = ["falsify", "fall.stl", "--plant", "fall.yaml", "--require", "up", "--simulations", "8"]
    assert main(command) == 1
    trace = Trace.load("counterexamples/up.npz")
    assert (trace.meta.spec_name, trace.meta.dt) == ("fall", 0.05)
    assert main(["check", "counterexamples/up.npz"]) == 1
    Path("fall.py").write_text(FALL.replace("< -3", "< 99"))
    capsys.readouterr()
    assert main(["falsify", "fall.stl", "--plant", "fall.yaml", "--replay", "counterexamples/up.json"]) == 1
    assert "the simulation fails, before: a violation of up; error at t = 0 s" in capsys.readouterr().out


@pytest.mark.apart
def test_a_counterexample_outside_of_the_assumptions_violates_nothing(home: Path, capsys):
    assert main(["falsify", "oscillator.stl", "--require", "early", "--simulations", "30"]) == 1
    before = (home / "oscillator.stl").read_text()
    (home / "oscillator.stl").write_text(before + "assume never: f <= -2\n")
    replay = ["falsify", "oscillator.stl", "--replay", "counterexamples/early.json"]
    capsys.readouterr()
    assert main(replay) == 0
    assert "early: out of scope" in capsys.readouterr().out
    assert main([*replay, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert not misfits(document, load_schema("falsify/1"))
    assert document["result"]["verdict"] == "out of scope"
    assert main(["falsify", "oscillator.stl", "--require", "early", "--simulations", "5"]) == 2
    assert re.search("`assume` or `where` excludes all of .* points", capsys.readouterr().err)


@pytest.mark.parametrize(
    "changed", [{"trace": "a\0b"}, {"trace": ""}, {"trace": "x/y.npz"}, {"margin": "nan"}]
)
def test_an_edited_counterexample_is_none(changed, capsys):
    assert main(["falsify", "oscillator.stl", "--require", "early", "--simulations", "30"]) == 1
    stored = json.loads(Path("counterexamples/early.json").read_text())
    Path("counterexamples/edited.json").write_text(json.dumps({**stored, **changed}))
    capsys.readouterr()
    assert main(["falsify", "oscillator.stl", "--replay", "counterexamples/edited.json"]) == 2
    assert "is not a counterexample" in capsys.readouterr().err


@pytest.mark.apart
@pytest.mark.usefixtures("fall")
def test_a_plant_that_does_not_repeat_itself_is_told(capsys):
    """The file of the counterexample has the robustness of its trace."""
    count = "TIMES = [0]\n\n\n"
    Path("fall.py").write_text(count + FALL.replace("    return", "    TIMES[0] += 1\n    return", 1))
    text = Path("fall.py").read_text()
    Path("fall.py").write_text(re.sub(r"return \[(.*?),", r"return [\1 + 1e-3 * TIMES[0],", text, count=1))
    command = ["falsify", "fall.stl", "--plant", "fall.yaml", "--require", "up", "--simulations", "8"]
    assert main([*command, "--json"]) == 1
    (found,) = json.loads(capsys.readouterr().out)["result"]["requirements"]
    assert found["trace_margin"] != (found["simpler"] or found["found"])["margin"]
    assert found["trace_margin"] == json.loads(Path(found["file"]).read_text())["margin"]
    trace = Trace.load("counterexamples/up.npz")
    assert float(trace.data["h"][0, :13].min()) == pytest.approx(found["trace_margin"], abs=1e-9)
    assert main(command) == 1
    assert "the plant does not repeat itself" in capsys.readouterr().out


@dataclass(frozen=True)
class Oscillator:
    """The oscillator, for processes that load it."""

    folder: Path

    def load(self) -> ModelSimulator:
        return ModelSimulator.load(str(self.folder / "oscillator.stl"), None, {})


@pytest.mark.slow
def test_workers_search_several_requirements_with_the_results_of_one_process(home: Path):
    source = Oscillator(home)
    simulator, order = source.load(), SearchOrder(SearchBudget(30), seed=1, shrinks=False)
    points = np.random.default_rng(0).random((5, simulator.space.dim))
    with SimulatorWorkers(source, LocalProcesses(2, fresh=True)) as workers:
        apart = list(falsify_each(simulator, (0, 1), order, workers))
        (one,) = falsify_each(simulator, (1,), order, workers)
        shared = SharedSimulator(simulator, workers)
        assert shared.batch == 2
        together = shared.simulate(points, 3)
    alone = list(falsify_each(simulator, (0, 1), order))
    for left, right in zip(apart, alone, strict=True):
        assert (left.requirement, left.simulations, left.least) == (
            right.requirement,
            right.simulations,
            right.least,
        )
    assert one.simulations == 30
    expected = simulator.simulate(points, 3)
    assert np.array_equal(together.margins, expected.margins)


@pytest.mark.slow
def test_jobs_of_the_command_change_nothing_for_several_requirements(capsys):
    main(["falsify", "oscillator.stl", "--simulations", "12", "--json"])
    alone = json.loads(capsys.readouterr().out)["result"]["requirements"]
    main(["falsify", "oscillator.stl", "--simulations", "12", "--jobs", "2", "--json"])
    shared = json.loads(capsys.readouterr().out)["result"]["requirements"]
    for each in (*alone, *shared):
        del each["seconds"]
    assert alone == shared


RAMP = """
stlc: 1
name: ramp
time: {dt: 1/3 s, horizon: 4 s, integrator: rk4}
state: {x: {}}
flow: {x: 1}
init: {mixture: [{draw: {x: "uniform(0, 0.5)"}}]}
"""


def ramp(requirement: str) -> ModelSimulator:
    Path("ramp.yaml").write_text(RAMP)
    Path("ramp.stl").write_text(f'system "ramp.yaml"\nsignal x\n{requirement}\n')
    return ModelSimulator.load("ramp.stl", None, {})


@pytest.mark.parametrize(
    "formula",
    [
        "always[0 s, 3 steps] x <= 0.9",
        "always[0 s, 3 * dt] x <= 0.9",
        "always[1 s, 2 s] x - prev(x) <= 0.2",
        "always[1 s, 2 s] not prev(x >= 1)",
    ],
)
def test_a_requirement_that_counts_samples_is_judged_by_the_same_samples_at_half_the_step(formula: str):
    found = falsify(ramp(f"require r: {formula}"), 0, budget=SearchBudget(5), seed=0)
    assert found.found is not None
    assert found.spurious == ()
    assert found.found.half_step == pytest.approx(found.found.margin)


def test_half_of_a_step_that_is_no_decimal_fraction_is_exact():
    found = falsify(ramp("require r: eventually[1 s, 1 s] x <= 1.2"), 0, budget=SearchBudget(5), seed=0)
    assert found.found is not None
    assert found.found.half_step == pytest.approx(found.found.margin)


def test_a_simulation_in_which_an_assumption_fails_violates_nothing_and_is_not_counted():
    simulator = ramp("assume low: always[0 s, 1 s] x <= 1.2\nrequire r: always[0 s, 1 s] x <= 1.1")
    outcome = simulator.simulate(np.array([[0.1], [0.3], [0.9]]), 0)
    assert outcome.admissible.tolist() == [True, True, False]
    found = falsify(simulator, 0, budget=SearchBudget(20), seed=0)
    assert found.found is not None
    assert found.found.margin >= -0.1 - 1e-9
    assert found.rejected > 0
    draws = ModelDraws(simulator, Path("ramp.stl"))
    (sample,) = draws.observed(range(40))
    assert 0 < sample.drives < 40
    assert sample.overall.robustness.min() >= -0.1 - 1e-9


def test_a_replay_makes_the_changes_of_the_search(capsys: pytest.CaptureFixture[str]):
    ramp("const most = 9\nrequire r: always[0 s, 1 s] x <= most")
    assert main(["falsify", "ramp.stl", "--set", "most=1.2"]) == 1
    command = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert main(command[1:]) == 1
    assert "the same, bit for bit" in capsys.readouterr().out
    assert main([*command[1:], "--set", "most=5"]) == 0


def test_a_counterexample_without_finite_states_can_be_replayed(capsys: pytest.CaptureFixture[str]):
    ramp("require r: always[0 s, 4 s] x <= 9")
    Path("ramp.yaml").write_text(RAMP.replace("flow: {x: 1}", "flow: {x: 9 * x ^ 4 + 9}"))
    assert main(["falsify", "ramp.stl"]) == 1
    capsys.readouterr()
    assert main(["falsify", "ramp.stl", "--replay", "counterexamples/r.json"]) == 1
    assert "robustness -inf; the trace is the same, bit for bit" in capsys.readouterr().out


@pytest.mark.parametrize("changed", [{"margin": 10**400}, {"margin": "low"}, {"point": [10**400]}])
def test_a_counterexample_with_numbers_beyond_all_bounds_is_refused(
    changed: dict, capsys: pytest.CaptureFixture[str]
):
    ramp("require r: always[0 s, 1 s] x <= 1.2")
    stored = {"format": "stlc-counterexample/1", "requirement": "r", "margin": -1.0, "trace": "r.npz"}
    stored |= {"settings": {}, "point": [0.5]} | changed
    Path("r.json").write_text(json.dumps(stored))
    assert main(["falsify", "ramp.stl", "--replay", "r.json"]) == 2
    assert "U101" in capsys.readouterr().err


def test_a_requirement_that_is_always_true_has_traces(capsys: pytest.CaptureFixture[str]):
    ramp("require r: true")
    assert main(["falsify", "ramp.stl", "--simulations", "2"]) == 0
    assert "no violation in 2 simulations, least robustness inf" in capsys.readouterr().out
