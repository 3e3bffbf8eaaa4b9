"""`stlc compile` from the outside."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stlc.cli.framework.app import main

ROOT = Path(__file__).resolve().parents[3]
SPEC = "specs/traffic.stl"


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def document(capsys, *arguments):
    code = main(["compile", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_watching_compiles_again_when_a_file_changes(tmp_path, monkeypatch, capsys):
    for folder in ("specs", "examples"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    edits = iter(
        [
            lambda: _replace("examples/car.yaml", "T_red:   4 s", "T_red:   3 s"),
            lambda: _replace("specs/traffic.stl", "T_red   = 4 s", "T_red   = 3 s"),
        ]
    )

    def change(_seconds: float) -> None:
        edit = next(edits, None)
        if edit is None:
            raise KeyboardInterrupt
        edit()

    monkeypatch.setattr("stlc.cli.framework.watch.time.sleep", change)
    assert main(["compile", "specs/traffic.stl", "--watch"]) == 130
    out, err = capsys.readouterr()
    assert out.count("phi_safe") == 2
    assert (out.count("tau % 8 > 4"), out.count("tau % 8 > 3")) == (1, 1)
    assert err.count("E104") == 1
    assert err.count("watching specs/traffic.stl, examples/car.yaml") == 3


def _replace(path: str, old: str, new: str) -> None:
    text = Path(path).read_text()
    assert old in text
    Path(path).write_text(text.replace(old, new))


def test_what_the_solver_sees(capsys):
    assert main(["compile", SPEC]) == 0
    out, err = capsys.readouterr()
    for word in ("traffic", "dt 0.1 s", "2.5 s", "25 steps", "phi_safe", "no_collision", "give_way"):
        assert word in out, word
    assert "system examples/car.yaml" in err


@pytest.mark.parametrize("part", ["steps", "states", "ir"])
def test_one_part_is_part_of_all(capsys, part):
    assert main(["compile", SPEC]) == 0
    everything = capsys.readouterr().out
    assert main(["compile", SPEC, "--show", part]) == 0
    some = capsys.readouterr().out
    assert some.strip()
    assert some != everything


@pytest.mark.parametrize("system", ["car.yaml", "car", "examples/car.yaml"])
def test_it_says_which_system_it_took(capsys, system):
    assert main(["compile", SPEC, "--system", system]) == 0
    assert "system examples/car.yaml" in capsys.readouterr().err


def test_the_document(capsys):
    code, found = document(capsys, SPEC)
    result = found["result"]
    assert (code, found["schema"], found["ok"], found["exit_code"]) == (0, "compile/1", True, 0)
    assert result["system"] == "examples/car.yaml"
    assert result["horizon"] == {"seconds": 2.5, "steps": 25}
    assert result["states"] == ["x", "v", "sign", "tau", "dx", "v_lead", "yielding"]
    assert result["added"] == []
    assert result["safety"] == ["no_collision", "give_way", "red_light"]
    names = [requirement["name"] for requirement in result["requirements"]]
    assert names == ["no_collision", "stop_sign", "give_way", "red_light"]
    for requirement in result["requirements"]:
        assert requirement["reach"]["steps"] <= 25
        (interval,) = requirement["intervals"]
        assert interval["operator"] == ("eventually" if requirement["name"] == "stop_sign" else "always")
        assert interval["steps"][0] == 0


def test_a_changed_horizon_changes_the_steps(capsys):
    code, found = document(capsys, SPEC, "--set", "time.horizon=30 steps")
    assert code == 0
    assert found["result"]["horizon"]["steps"] == 30


@pytest.mark.apart
def test_torch_is_not_needed():
    program = (
        "import sys; from stlc.cli.framework.app import main; "
        "sys.exit(main(sys.argv[1:]) or 'torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "compile", SPEC], cwd=ROOT, check=False, capture_output=True
    )
    assert done.returncode == 0, done.stderr


BROKEN = {
    "an unknown name": ("require a: always[0, T] xx > 0 m", "E101"),
    "units": ("require a: always[0, T] x > 1 s", "E203"),
    "a reversed interval": ("require a: always[2 s, 1 s] x > 0 m", "E301"),
    "a formula that is cut off": ("require a: always[0, T] x >", "E010"),
}


@pytest.mark.parametrize(("text", "code"), BROKEN.values(), ids=BROKEN)
def test_a_broken_specification(tmp_path, capsys, text, code):
    path = tmp_path / "broken.stl"
    path.write_text(f'system "{ROOT}/examples/car.yaml"\nstate signal x [m]\n{text}\n')
    exit_code, found = document(capsys, str(path))
    assert exit_code == found["exit_code"] == 3
    assert found["result"] is None
    assert code in [finding["code"] for finding in found["diagnostics"]]
    assert found["diagnostics"][0]["file"] == str(path)
    assert main(["compile", str(path)]) == 3
    err = capsys.readouterr().err
    assert f"error[{code}]" in err
    assert "^" in err


def test_a_malicious_system_is_not_run(tmp_path, capsys):
    text = (ROOT / "examples/car.yaml").read_text()
    evil = text.replace("  x:   v\n", "  x:   __import__('os').system('touch pwned')\n")
    assert evil != text
    (tmp_path / "evil.yaml").write_text(evil)
    assert main(["compile", SPEC, "--system", str(tmp_path / "evil.yaml")]) == 3
    assert "error[S" in capsys.readouterr().err
    assert not Path("pwned").exists()


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["no-such.stl"], "U102"),
        ([SPEC, "--system", "lorry.yaml"], "U102"),
        ([SPEC, "--set", "T_red"], "U101"),
        ([SPEC, "--show", "everything"], "U101"),
    ],
)
def test_usage(capsys, arguments, code):
    exit_code, found = document(capsys, *arguments)
    assert exit_code == 2
    assert found["diagnostics"][0]["code"] == code


def test_a_spec_without_a_system(tmp_path, capsys):
    path = tmp_path / "alone.stl"
    path.write_text("state signal x [m]\nrequire a: always[0, 1 s] x > 0 m\n")
    assert main(["compile", str(path)]) == 2
    assert "--system FILE" in capsys.readouterr().err


@pytest.mark.parametrize("system", ["car", "maze", "panda", "rover", "ship_safe", "ship_track"])
def test_the_specification_that_judges_drives_is_compiled_for_recorded_traces(capsys, system):
    text = (ROOT / f"examples/{system}.yaml").read_text()
    (rules,) = re.findall(r"judge: \.\./(specs/\w+_rules\.stl)", text)
    exit_code, found = document(capsys, str(ROOT / rules))
    assert exit_code == 0
    assert found["result"]["requirements"]
    assert main(["lint", str(ROOT / rules), "--system", str(ROOT / f"examples/{system}.yaml")]) == 0
