"""Plant files: what they declare, and what is wrong with them, with its place."""

from __future__ import annotations

import contextlib
import math
from fractions import Fraction
from pathlib import Path

import pytest
import yaml
from helpers.plants import FILE, changed, pendulum, read
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from stlc.diagnostics import StlcError, SystemFileError
from stlc.plants.declaration import load_plant_decl, plant_schema
from stlc.plants.kind import KINDS, layout_of

HERE = Path(__file__).parent


def test_a_plant_file_is_read(tmp_path):
    decl = read(FILE, tmp_path)
    assert (decl.name, decl.kind, decl.dt, decl.steps) == ("pendulum", "python", Fraction(1, 100), 100)
    assert decl.options["target"] == "pendulum.py:Pendulum"
    assert [(each.name, each.low, each.high) for each in decl.initial] == [
        ("angle", -1, 1),
        ("rate", 0.5, 0.5),
    ]
    assert decl.param[0].unit.text == "m"
    (torque,) = decl.free
    assert (torque.pieces, torque.interpolate, torque.duration) == (2, "hold", 1)
    assert [each.name for each in decl.outputs] == ["angle", "rate"]
    assert decl.limits.time == 30


def test_values_are_in_the_declared_unit(tmp_path):
    text = changed(
        FILE,
        initial="{angle: {unit: deg, range: [-1 rad, 90 deg]}, rate: 2}",
        param="{length: 50 cm}",
    )
    decl = read(text, tmp_path)
    assert decl.initial[0].low == pytest.approx(-180 / math.pi)
    assert decl.initial[0].high == pytest.approx(90)
    assert (decl.param[0].low, decl.param[0].unit.text) == (50, "cm")


def test_names_of_the_plant(tmp_path):
    gym = changed(
        FILE,
        python="",
        gym="Pendulum-v1",
        output="{sin: {from: 'obs[1]'}, rate: {unit: rad/s}}",
    )
    decl = read(gym, tmp_path)
    assert [each.source for each in decl.outputs] == ["obs[1]", "obs[1]"]
    assert decl.inputs[0].source == "action[0]"
    assert [each.source for each in decl.initial] == ["state[0]", "state[1]"]
    assert decl.param[0].source == "length"


def test_a_controller_writes_the_last_inputs(tmp_path):
    text = changed(
        FILE,
        input="{torque: {range: [-2, 2]}, wind: {range: [0, 1]}}",
        controller="{onnx: net.onnx, reads: [rate, wind, length], writes: [torque], period: 0.1 s, "
        "offset: -3}",
    )
    decl = read(text, tmp_path)
    assert [each.name for each in decl.inputs] == ["wind", "torque"]
    assert [each.name for each in decl.free] == ["wind"]
    assert decl.controller is not None
    assert (decl.controller.period, decl.controller.offset, decl.controller.scale) == (10, -3, 1)
    assert decl.layout("x").free == 1


def test_half_the_time_step_keeps_the_duration_and_the_period(tmp_path):
    text = changed(
        FILE,
        time="{dt: 10 ms, duration: 1 s, halves: true}",
        input="{torque: {range: [-2, 2]}}",
        controller="{onnx: net.onnx, reads: [rate], writes: [torque], period: 0.1 s}",
    )
    decl = read(text, tmp_path)
    finer = decl.at_half_step()
    assert (finer.dt, finer.steps, finer.duration) == (Fraction(1, 200), 200, decl.duration)
    assert finer.controller is not None
    assert finer.controller.period * finer.dt == Fraction(1, 10)
    assert finer.layout("x").halves


def test_the_files_of_a_plant_are_found_without_running_them(tmp_path):
    (tmp_path / "models").mkdir()
    for name, code in {
        "pendulum.py": "import json, deep.missing\nfrom models import rod\nimport models.rod\n",
        "models/__init__.py": "from .bob import mass\n",
        "models/rod.py": "from ..pendulum import x\nfrom . import bob\nraise SystemExit\n",
        "models/bob.py": "import loop\n",
        "loop.py": "import loop, pendulum\n",
        "other.py": "never imported",
    }.items():
        (tmp_path / name).write_text(code)
    controller = "{onnx: net.onnx, reads: [rate], writes: [torque]}"
    decl = read(changed(FILE, input="{torque: {}}", controller=controller), tmp_path)
    found = ["loop.py", "models/__init__.py", "models/bob.py", "models/rod.py", "net.onnx", "pendulum.py"]
    assert sorted(decl.files) == found
    assert decl.packages == ("scipy", "onnxruntime")
    named = read(changed(FILE, python="'models.rod:f'"), tmp_path)
    assert "models/rod.py" in named.files
    elsewhere = read(changed(FILE, python="'email.message:Message'"), tmp_path)
    assert [path.name for path in elsewhere.files.values()] == ["message.py"]
    assert list(elsewhere.files) == ["email.message"]
    assert read(changed(FILE, python="'no.such.module:f'"), tmp_path).files == {}
    gym = read(changed(FILE, python="", gym="other:Swing-v0"), tmp_path)
    assert list(gym.files) == ["other.py"]
    fmu = read(changed(FILE, python="", fmu="{file: parts/a.fmu}"), tmp_path)
    assert fmu.files == {"parts/a.fmu": tmp_path.resolve() / "parts/a.fmu"}
    (tmp_path / "pendulum.py").write_bytes(b"\xff\x00 no python (")
    assert list(read(FILE, tmp_path).files) == ["pendulum.py"]


def test_the_process_is_told_everything(tmp_path):
    text = changed(
        FILE, input="{torque: {unit: N}}", controller="{onnx: net.onnx, reads: [rate], writes: [torque]}"
    )
    layout = read(text, tmp_path).layout("scratch")
    assert layout_of(layout.as_json()) == layout


WRONG = [
    ({"plant": "2"}, "S103", "2"),
    ({"name": ""}, "S102", None),
    ({"nmae": "x"}, "S101", "nmae"),
    ({"python": ""}, "S102", None),
    ({"gym": "Pendulum-v1"}, "S103", None),
    ({"python": "{target: 'a.py:b', shape: 1}"}, "S101", "shape"),
    ({"python": "{form: step}"}, "S102", "{form: step}"),
    ({"python": "[1]"}, "S103", "[1]"),
    ({"python": "{target: 'a.py:b', form: leap}"}, "S103", "leap"),
    ({"time": "{dt: 10 ms, duration: 25 ms}"}, "S103", "25 ms"),
    ({"time": "{dt: 1 ns, duration: 10 s}"}, "S103", "10 s"),
    ({"time": "{dt: 10 ms}"}, "S102", "{dt: 10 ms}"),
    ({"python": "", "gym": "P-v1", "time": "{dt: 1 s, duration: 2 s, halves: true}"}, "S103", "true"),
    ({"time": "{dt: 1 s, duration: 2 s, halves: 2}"}, "S103", "2"),
    ({"initial": "{angle: {range: [1, -1]}}"}, "S204", "[1, -1]"),
    ({"initial": "{angle: {range: [1]}}"}, "S103", "[1]"),
    ({"initial": "{angle: {unit: rad}}"}, "S102", "{unit: rad}"),
    ({"initial": "{angle: {value: 1, range: [1, 2]}}"}, "S103", "{value: 1, range: [1, 2]}"),
    ({"initial": "{angle: {unit: m, range: [0 s, 1 s]}}"}, "E203", "0 s"),
    ({"initial": "{angle: {unit: furlongs, range: [0, 1]}}"}, "S103", "furlongs"),
    ({"initial": "{length: 1}"}, "E102", "1"),
    ({"initial": "{always on: 1}"}, "S103", "always on"),
    ({"param": "{rate: 1}"}, "E102", "{unit: rad/s}"),
    ({"input": "{torque: {range: [0, 1], pieces: 0}}"}, "S103", "0"),
    ({"input": "{torque: {range: [0, 1], interpolate: spline}}"}, "S103", "spline"),
    ({"output": "{t: {unit: s}}"}, "S103", "t"),
    ({"output": "{}"}, "S102", "{}"),
    ({"output": ""}, "S102", None),
    ({"output": "{angle: 1}"}, "S103", "1"),
    ({"limit": "{time: 0 s}"}, "S103", "0 s"),
    ({"limit": "{memory: 1}"}, "S103", "1"),
    ({"controller": "{onnx: n, reads: [rate], writes: [wind]}"}, "S103", "wind"),
    ({"controller": "{onnx: n, reads: [torque], writes: [torque]}"}, "S103", "torque"),
    ({"controller": "{onnx: n, reads: [rate, rate], writes: [torque]}"}, "S103", "rate"),
    ({"controller": "{onnx: n, reads: [], writes: [torque]}"}, "S103", "[]"),
    ({"controller": "{onnx: n, reads: [rate], writes: [torque], period: 15 ms}"}, "S103", "15 ms"),
    ({"controller": "{onnx: n, reads: [rate], writes: [torque]}"}, "S103", "pieces"),
    ({"controller": "{onnx: n, reads: [rate], writes: [torque], scale: x}"}, "E101", "x"),
]


@pytest.mark.parametrize(("changes", "code", "place"), WRONG)
def test_what_is_wrong_has_a_place(tmp_path, changes, code, place):
    with pytest.raises(SystemFileError) as caught:
        read(changed(FILE, **changes), tmp_path)
    found = {(each.code, each.span.text if each.span else "") for each in caught.value.diagnostics}
    assert code in {each for each, _ in found}
    assert place is None or (code, place) in found


def test_all_errors_are_reported_together(tmp_path):
    with pytest.raises(SystemFileError) as caught:
        read(changed(FILE, initial="{angle: {range: [1, 0]}}", limit="{time: no}", plan="1"), tmp_path)
    assert len(caught.value.diagnostics) >= 3


PIECES = ["{", "}", "[", "]", ":", ",", "-", "\n", " ", "1e9", "0 s", "~", "range", "from", "'"]


@settings(max_examples=60)
@given(st.integers(0, len(FILE)), st.integers(0, 12), st.sampled_from(PIECES))
def test_a_damaged_file_is_read_or_refused(start, length, piece):
    text = FILE[:start] + piece + FILE[start + length :]
    with contextlib.suppress(StlcError):
        decl = read(text, HERE)
        assert layout_of(decl.layout("x").as_json()) == decl.layout("x")


@pytest.mark.parametrize("kind", KINDS.names)
def test_every_kind_is_a_key_of_the_file(kind):
    assert kind in plant_schema()["properties"]


def test_the_schema_is_that_of_the_reader():
    Draft202012Validator.check_schema(plant_schema())
    validator = Draft202012Validator(plant_schema())
    assert not list(validator.iter_errors(yaml.safe_load(FILE)))
    assert list(validator.iter_errors({**yaml.safe_load(FILE), "nmae": 1}))


def test_reading_runs_nothing(tmp_path):
    path = pendulum(tmp_path)
    (tmp_path / "pendulum.py").write_text("raise SystemExit('imported')")
    assert load_plant_decl(path).name == "pendulum"
