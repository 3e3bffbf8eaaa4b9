"""Plants in processes of their own: points, traces, parts, seeds, jobs."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers.plants import FILE, changed, pendulum, read, simulated

from stlc.diagnostics import MissingError, SystemFileError, UsageError
from stlc.extras import installation
from stlc.monitor.verdict import Monitor
from stlc.plants.plant import Plant, load_plant
from stlc.trace import Trace

SPEC = """
signal angle: real [rad]
signal torque: real [rad/s^2]
param length: real [m] in [0, 5]
require near: always[0 s, 1 s] abs(angle) <= 57 deg
require weak: always[0 s, 1 s] torque <= 0.5 rad/s^2
"""


COUNTING = """
import os


class P:
    count = 0

    def reset(self, initial, params):
        P.count += 1
        return [P.count, os.getpid()]

    def step(self, inputs):
        return [P.count, os.getpid()]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("plant")
    pendulum(
        path, input="{torque: {unit: rad/s^2, range: [-1, 1], pieces: 3, interpolate: pchip, times: free}}"
    )
    return path


@pytest.fixture(scope="module")
def plant(folder):
    with load_plant(folder / "pendulum.yaml") as found:
        yield found


def test_variables_are_what_may_vary(plant):
    names = [each.name for each in plant.variables]
    values, times = [f"torque_values[{i}]" for i in range(4)], [f"torque_times[{i}]" for i in range(2)]
    assert names == ["angle", "length", *values, *times]
    assert (plant.low == [-1, 0.5, *[-1] * 4, 0, 0]).all()
    assert (plant.high == [1, 2, *[1] * 4, 1, 1]).all()
    assert [each.unit.text for each in plant.variables][-1] == "s"


def test_points_fill_the_ranges_and_times_are_sorted(plant):
    points = plant.points_of(np.random.default_rng(0).random((200, 8)))
    assert (points >= plant.low).all()
    assert (points <= plant.high).all()
    assert (np.diff(points[:, 6:], axis=1) >= 0).all()
    assert (plant.points_of(np.zeros((1, 8)))[0, :6] == plant.low[:6]).all()
    assert (plant.random_point(3) == plant.random_point(3)).all()


@pytest.mark.parametrize("ends", ["[-4.01, -1.55]", "[-2.33, 2.31]", "[-7.3, 4.43]"])
def test_no_value_leaves_its_range_by_rounding(tmp_path, ends):
    inputs = f"{{torque: {{unit: rad/s^2, range: {ends}, pieces: 3, interpolate: linear}}}}"
    pendulum(tmp_path, input=inputs, initial=f"{{angle: {{range: {ends}, unit: rad}}, rate: 0}}")
    with load_plant(tmp_path / "pendulum.yaml") as plant:
        cube = np.random.default_rng(0).integers(0, 2, (50, len(plant.variables))).astype(float)
        points = plant.points_of(cube)
        assert (plant.low <= points).all()
        assert (points <= plant.high).all()
        (signal,) = plant.decl.free
        (run,) = plant.simulate(points[:1])
        assert isinstance(run.outcome, Trace)
        torque = run.outcome.data["torque"]
        assert (signal.low <= torque).all()
        assert (torque <= signal.high).all()


def test_a_trace_has_outputs_inputs_and_parameters(plant, folder, monkeypatch):
    point = plant.random_point(1)
    (run,) = plant.simulate(point[None])
    trace = run.outcome
    assert isinstance(trace, Trace)
    assert trace.signature.names == ("angle", "rate", "torque", "length")
    assert [column.unit.text for column in trace.signature.columns] == ["rad", "rad/s", "rad/s^2", "m"]
    assert (trace.samples, trace.dt, trace.t0) == (101, 0.01, 0.0)
    wanted = plant.decl.free[0].at(point[None, 2:], trace.times)
    assert (trace.data["torque"] == wanted).all()
    assert (trace.data["length"] == point[1]).all()
    monkeypatch.setattr("sys.path", [])
    here = simulated(
        plant.decl, folder, {"angle": point[0], "length": point[1]}, trace.data["torque"][0, :-1, None]
    )
    assert (trace.data["angle"][0] == here[:, 0]).all()


def test_parts_are_the_whole(plant):
    point = plant.random_point(2)
    whole = plant.simulate(point[None])[0].outcome
    for samples in (2, 7, 100, 101, 102):
        parts = list(plant.parts(point, samples=samples))
        assert all(part.samples <= samples for part in parts[:-1])
        for name in whole.data:
            assert (np.concatenate([part.data[name][0] for part in parts]) == whole.data[name][0]).all()
        starts = np.cumsum([0, *(part.samples for part in parts[:-1])]) * 0.01
        assert [part.t0 for part in parts] == pytest.approx(starts)


def test_jobs_give_the_same_runs_in_order(plant):
    points = np.array([plant.random_point(seed) for seed in range(5)])
    one, two = plant.simulate(points), plant.simulate(points, jobs=2, seeds=range(5))
    assert [run.seed for run in two] == [0, 1, 2, 3, 4]
    for left, right in zip(one, two, strict=True):
        assert (left.point == right.point).all()
        assert all((left.outcome.data[name] == right.outcome.data[name]).all() for name in left.outcome.data)


def test_a_trace_is_judged_as_a_stream_is(plant):
    monitor = Monitor(SPEC, dt=plant.decl.dt)
    for seed in range(4):
        point = plant.random_point(seed)
        verdict = monitor.check(plant.simulate(point[None])[0].outcome)
        online = monitor.online()
        assert plant.watch(point, online) is None
        tallies = online.finish()
        for judgement in verdict:
            assert tallies[judgement.name].status == judgement.overall
            assert tallies[judgement.name].robustness == pytest.approx(float(judgement.least[0]), abs=1e-12)


def test_a_long_simulation_takes_no_more_memory(tmp_path):
    (tmp_path / "still.py").write_text("def step(state, inputs, dt):\n    return state\n")
    peaks = []
    for seconds in (6, 40):
        time = f"{{dt: 1 ms, duration: {seconds} s}}"
        text = changed(
            FILE, python='"still.py:step"', time=time, input="{torque: {range: [0, 1], pieces: 3}}"
        )
        with Plant(read(text, tmp_path)) as plant:
            online = Monitor(
                "signal angle: real [rad]\nrequire low: always angle <= 90 deg", dt=0.001
            ).online()
            tracemalloc.start()
            assert plant.watch(plant.random_point(0), online) is None
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert online.samples == 1000 * seconds + 1
        assert online.finish()["low"].status == "satisfied"
    assert peaks[1] < peaks[0] + 300_000  # the samples alone would be 0.8 MB more


def test_points_of_another_size_are_refused(plant):
    with pytest.raises(UsageError, match="8 numbers"):
        plant.simulate(np.zeros((1, 3)))
    with pytest.raises(UsageError, match="2 seeds"):
        plant.simulate(np.zeros((1, 8)), seeds=[1, 2])


def test_processes_are_used_again_and_end(folder):
    with load_plant(folder / "pendulum.yaml") as plant:
        point = plant.random_point(0)[None]
        plant.simulate(point)
        (process,) = plant._processes
        plant.simulate(point)
        assert plant._processes == [process]
        pid, scratch = process._process.pid, process._watchdog.folder
    assert not Path(f"/proc/{pid}").exists()
    assert not Path(scratch).exists()


def test_a_new_process_for_every_simulation(tmp_path):
    (tmp_path / "counting.py").write_text(COUNTING)
    text = changed(FILE, python="counting.py:P", limit="{fresh: true}", output="{count: , pid: }")
    with Plant(read(text, tmp_path)) as plant:
        runs = plant.simulate(np.array([plant.random_point(0)] * 2))
        assert [run.outcome.data["count"][0, 0] for run in runs] == [1, 1]
        assert len({run.outcome.data["pid"][0, 0] for run in runs}) == 2
        assert plant._processes == []


@pytest.mark.parametrize(
    ("changes", "place", "said"),
    [
        (
            {"python": '"pendulum.py:flow"', "output": "{anlge: {unit: rad}}"},
            "{unit: rad}",
            "not a state",
        ),
        ({"python": '"broken.py:f"'}, '"broken.py:f"', "ended by SIGABRT"),
        ({"python": '"leaving.py:f"'}, '"leaving.py:f"', "cannot be opened: SystemExit: 4"),
    ],
)
def test_a_plant_that_cannot_be_opened_has_a_place(tmp_path, changes, place, said):
    pendulum(tmp_path)
    (tmp_path / "broken.py").write_text("import os\nos.abort()\n")
    (tmp_path / "leaving.py").write_text("import sys\nsys.exit(4)\n")
    with (
        Plant(read(changed(FILE, **changes), tmp_path)) as plant,
        pytest.raises(SystemFileError, match=said) as caught,
    ):
        plant.simulate(plant.random_point(0)[None])
    (finding,) = caught.value.diagnostics
    assert (finding.code, finding.span.text) == ("S401", place)
    assert plant._processes == []


def test_a_plant_that_does_not_open_says_how_long_it_had(tmp_path, monkeypatch):
    monkeypatch.setattr("stlc.plants.process.OPENING", 0.25)
    (tmp_path / "endless.py").write_text("import time\ntime.sleep(600)\n")
    text = changed(FILE, python='"endless.py:f"', limit="{time: 0.1 s}")
    with (
        Plant(read(text, tmp_path)) as plant,
        pytest.raises(SystemFileError, match=r"not finished within 0\.25 s"),
    ):
        plant.simulate(plant.random_point(0)[None])


def test_a_time_limit_may_be_of_years(tmp_path):
    pendulum(tmp_path)
    with Plant(read(changed(FILE, limit="{time: 1e9 s}"), tmp_path)) as plant:
        (run,) = plant.simulate(plant.random_point(0)[None])
    assert isinstance(run.outcome, Trace)


def test_a_missing_package_is_named(tmp_path):
    pendulum(tmp_path)
    (tmp_path / "fmpy.py").write_text("raise ImportError")
    (tmp_path / "gymnasium.py").write_text("raise ImportError")
    text = changed(FILE, python="", gym="Pendulum-v1")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        with Plant(read(text, tmp_path)) as plant, pytest.raises(MissingError, match="gymnasium") as caught:
            plant.simulate(plant.random_point(0)[None])
    assert caught.value.diagnostics[0].help == (installation("gym"),)


def test_units_of_the_plant_must_be_those_of_the_file(tmp_path):
    from stlc.plants.process import _require_units

    decl = read(FILE, tmp_path)
    _require_units(decl, {"angle": "rad", "length": "m", "rate": "what?", "torque": 3})
    for units in ({"angle": "deg"}, {"length": "s"}, {"length": "mm"}):
        with pytest.raises(SystemFileError, match="the file declares") as caught:
            _require_units(decl, units)
        assert caught.value.diagnostics[0].code == "S401"
        assert caught.value.diagnostics[0].span is not None
