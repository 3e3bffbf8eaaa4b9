"""`stlc certify SPEC --plant FILE` and `--system FILE`: shares of simulations, findings, verification."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from helpers.documents import misfits

from stlc.assurance.bounds import clopper_pearson_lower
from stlc.assurance.campaign import SEED
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main

CODE = """
from parts import decay


def step(state, inputs, dt, param):
    if state[0] > 0.98:
        raise ValueError("too full")
    return [decay(state[0], dt) + param[0] * 0]
"""
PARTS = "def decay(x, dt):\n    return x - dt * x\n"
PLANT = """\
plant: 1
name: tank
python: "tank.py:step"
time: {dt: 0.1 s, duration: 1 s}
initial: {level: {unit: m, range: [0, 1]}}
param: {leak: {range: [0, 1]}}
output: {level: {unit: m}}
"""
SPEC = """\
spec filling
signal level: real [m]
const most = 80 cm
require calm: always[0 s, 1 s] level <= most
require lasting: always[0 s, 1 s] level >= -1 m
"""
SYSTEM = """\
stlc: 1
name: spring
time: {dt: 0.1 s, horizon: 10 steps}
inputs: {f: {range: [-1, 1], pieces: 2}}
state: {x: {range: [-9, 9]}, v: {range: [-9, 9]}}
flow: {x: v, v: "f - x"}
init: {mixture: [{draw: {x: "uniform(-1, 1)", v: 0}}]}
"""
MODEL = """\
system "spring.yaml"
signal x
require right: always[0 s, 1 s] x >= 0
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("draws")
    for name, text in {
        "tank.py": CODE,
        "parts.py": PARTS,
        "tank.yaml": PLANT,
        "filling.stl": SPEC,
        "spring.yaml": SYSTEM,
        "spring.stl": MODEL,
    }.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(autouse=True)
def there(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(home)
    capsys.readouterr()


def certified(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> dict[str, Any]:
    assert main(["certify", *words, "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("certify/1")) == []
    result: dict[str, Any] = document["result"]
    return result


TANK = ("filling.stl", "--plant", "tank.yaml")


def test_a_share_of_simulations_is_certified_and_verified(capsys):
    result = certified(capsys, *TANK, "--share", ".5")
    assert (result["kind"], result["unit"], result["answer"]) == ("plant", "simulation", "certified")
    overall, (calm, lasting) = result["overall"], result["requirements"]
    assert overall["units"] == 100
    assert overall["satisfied"] == calm["satisfied"] < lasting["satisfied"] < 100
    assert result["findings"]["count"] == 100 - lasting["satisfied"]
    first = result["findings"]["first"][0]
    assert (first["reason"], first["message"]) == ("error", "ValueError: too full")
    assert first["point"]["level"] > 0.98
    assert result["conditions"]["seeds"] == [[SEED, SEED + 99]]
    assert sorted(result["inputs"]) == ["file parts.py", "file tank.py", "plant", "spec"]
    assert any("counts as not satisfied" in text for text in result["assumptions"])
    kept = Path("certificates/filling-on-tank.json")
    assert json.loads(kept.read_text()) == result
    assert main(["certify", "--verify", str(kept)]) == 0
    assert "is about this plant: tank.yaml" in capsys.readouterr().out


INPUTS = {"tank.py": "file tank.py", "parts.py": "file parts.py", "tank.yaml": "plant", "filling.stl": "spec"}


def test_a_changed_file_is_named(home, capsys):
    kept = home / "certificates" / "changed.json"
    result = certified(capsys, *TANK, "--seeds", "0", "--out", str(kept), code=4)
    assert result["overall"]["units"] == 1
    for name, entry in INPUTS.items():
        path = home / name
        text = path.read_text()
        try:
            path.write_text(text + "\n")
            assert main(["certify", "--verify", str(kept)]) == 1
            out = capsys.readouterr().out
            assert f"  {entry} differs: " in out
            assert "is not about this plant as it is now" in out
            path.unlink()
            assert main(["certify", "--verify", str(kept)]) in (1, 2)
        finally:
            path.write_text(text)
    assert main(["certify", "--verify", str(kept), *TANK]) == 0
    document = json.loads(kept.read_text())
    kept.write_text(json.dumps(document | {"answer": "certified"}))
    assert main(["certify", "--verify", str(kept)]) == 1
    assert "answer does not follow from the counts" in capsys.readouterr().out


@pytest.mark.apart
def test_fixed_seeds_are_bounded_exactly_whatever_the_jobs(capsys):
    one = certified(capsys, *TANK, "--seeds", "0..19", "--share", ".4", "--require", "calm")
    two = certified(capsys, *TANK, "--seeds", "0..19", "--share", ".4", "--require", "calm", "--jobs", "2")
    overall = one["overall"]
    assert overall == two["overall"]
    assert overall["method"] == "Clopper-Pearson"
    assert overall["lower"] == clopper_pearson_lower(overall["satisfied"], 20)
    assert [each["name"] for each in one["requirements"]] == ["calm"]


def test_the_text_lists_failures_and_how_to_see_them_again(capsys):
    assert main(["certify", *TANK, "--seeds", "80..89", "--set", "most=2 m", "--share", ".5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "filling on tank · 10 simulations"
    start = lines.index("  1 simulation failed:")
    assert lines[start + 1].endswith(": error at t = 0 s: ValueError: too full")
    (again,) = [line for line in lines if line.startswith("  again")]
    words = again.split()[2:]
    assert main(words) == 1
    assert "ValueError: too full" in capsys.readouterr().out


@pytest.mark.apart
def test_simulations_out_of_scope_are_left_out(home, capsys):
    (home / "partly.stl").write_text(SPEC + "assume low: level <= 0.5 m\n")
    result = certified(capsys, "partly.stl", "--plant", "tank.yaml", "--seeds", "75..94", "--share", ".5")
    overall = result["overall"]
    assert result["findings"]["count"] > 0
    assert overall["satisfied"] == overall["units"] - result["findings"]["count"] < 20
    (home / "never.stl").write_text(SPEC + "assume low: level <= -1 m\n")
    (home / "safe.yaml").write_text(PLANT.replace("range: [0, 1]}}\nparam", "range: [0, 0.9]}}\nparam"))
    assert main(["certify", "never.stl", "--plant", "safe.yaml", "--seeds", "0..2"]) == 2
    assert "hold in none of 3 simulations" in capsys.readouterr().err


def test_a_system_without_controls_is_certified_and_verified(home, capsys):
    kept = home / "certificates" / "spring.json"
    given = ("spring.stl", "--system", "spring.yaml", "--seeds", "0..49", "--share", ".2")
    result = certified(capsys, *given, "--out", str(kept))
    assert (result["kind"], result["unit"]) == ("system", "simulation")
    assert 10 < result["overall"]["satisfied"] < 40
    assert certified(capsys, *given)["overall"] == result["overall"]
    assert main(["certify", "--verify", str(kept)]) == 0
    (home / "spring.yaml").write_text(SYSTEM + "# changed\n")
    try:
        assert main(["certify", "--verify", str(kept)]) == 1
    finally:
        (home / "spring.yaml").write_text(SYSTEM)
    assert "system differs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*TANK, "--guard", "full"], "`--guard` is for a policy"),
        ([*TANK, "--time-limit", "1 s"], "`--time-limit` is for a policy"),
        ([*TANK, "--system", "spring.yaml"], "contradict each other"),
        ([*TANK, "--require", "clam"], "clam"),
        (["--plant", "tank.yaml"], "`--plant` needs a specification"),
        (["spring.stl", "--system", "spring.yaml", "--jobs", "2"], "`--jobs` is for plants"),
        (["latest", "--jobs", "2"], "`--jobs` is for plants"),
        (["filling.stl", "--plant", "none.yaml"], "there is no file `none.yaml`"),
    ],
)
def test_bad_input_is_named(words, message, capsys):
    assert main(["certify", *words]) == 2
    assert message in capsys.readouterr().err


def test_a_damaged_certificate_is_refused(home, capsys):
    path = home / "bad.json"
    for document in (
        {"kind": "plant"},
        {"kind": "plant", "spec_file": "filling.stl", "system_file": "tank.yaml"},
    ):
        path.write_text(json.dumps({"certificate": "stlc-certificate/1", **document}))
        assert main(["certify", "--verify", str(path)]) == 3
        assert "is no certificate" in capsys.readouterr().err


def test_verification_runs_nothing(home, capsys):
    kept = home / "certificates" / "still.json"
    certified(capsys, *TANK, "--seeds", "0", "--out", str(kept), code=4)
    code = home / "tank.py"
    code.write_text("raise SystemExit('imported')")
    try:
        assert main(["certify", "--verify", str(kept)]) == 1
    finally:
        code.write_text(CODE)
    assert "imported" not in capsys.readouterr().out
    os.mkfifo(home / "pipe.onnx")  # a file that would never end is not read
    (home / "piped.yaml").write_text(
        PLANT.replace("output:", "input: {u: {}}\noutput:")
        + ("controller: {onnx: pipe.onnx, reads: [level], writes: [u]}\n")
    )
    assert main(["certify", "--verify", str(kept), "--plant", "piped.yaml"]) == 1
    assert "file pipe.onnx differs" in capsys.readouterr().out
