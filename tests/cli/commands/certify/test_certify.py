"""`stlc certify`, and the option `--certify` of `simulate` and `check`, on a cart that drives by itself."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.documents import misfits

from stlc.assurance.bounds import Tally, betting_lower, clopper_pearson_lower
from stlc.assurance.campaign import BATCH, FIRST, SEED
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.rundir import RunDir
from stlc.signature import Column, Signature
from stlc.trace import Trace

SPEC = """spec cart
system "cart.yaml"
state signal x [m] in [-2, 2]
state signal v [m/s] in [-2, 2]
const limit = 9 m
require near: always[0, T] x < limit
require slow: always[0, T] abs(v) <= 9 m/s
"""
SYSTEM = """stlc: 1
name: cart
doc: A cart.
spec: cart.stl
time: {dt: 0.1 s, horizon: 5 steps}
state:
  x: {unit: m,   range: [-2, 2]}
  v: {unit: m/s, range: [-2, 2]}
control:
  u: {unit: m/s^2, range: [-3, 3], squash: tanh}
flow: {x: v, v: u}
init:
  mixture:
    - draw: {x: "uniform(-1, 1)", v: "uniform(-0.1, 0.1)"}
test: {steps: 6, agents: 10}
"""
PAIRED = """from stlc.controller.world import ModelWorld


class Paired(ModelWorld):
    pass
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a cart has been trained for a moment."""
    folder = tmp_path_factory.mktemp("certify")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("cart.stl").write_text(SPEC)
        Path("cart.yaml").write_text(SYSTEM)
        Path("paired.py").write_text(PAIRED)
        command = ["train", "cart.stl", "--steps", "2", "--batch", "16", "--held-out", "20"]
        assert main([*command, "--drives", "0", "--no-pictures", "-q"]) == 0
        (RunDir.newest().path / "paired.py").write_text(PAIRED)
    return folder


@pytest.fixture
def there(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunDir:
    monkeypatch.chdir(home)
    capsys.readouterr()
    return RunDir.newest()


def certified(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> dict[str, Any]:
    assert main(["certify", "latest", *words, "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("certify/1")) == []
    result: dict[str, Any] = document["result"]
    return result


def test_drives_stop_when_the_share_is_certified(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", "latest"]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0] == f"cart · run {there.name} · no guard · 450 drives x 6 steps"
    assert lines[2] == "  certified: at least 99 % of drives satisfy everything, with 95 % confidence"
    header = ["satisfied", "share", "at least", "interval", "next drive", "99 % of drives"]
    assert re.split(r"  +", lines[3].strip()) == header
    low = betting_lower(Tally.counted(450, 450))
    assert lines[4].split()[:7] == ["all", "requirements", "450", "of", "450", "100", "%"]
    assert f"{100 * low:.2f} %" in lines[4]
    assert "100 drives: share from" in err
    document = json.loads((there.path / "eval/certificate.json").read_text())
    assert document["overall"]["lower"] == low
    assert document["overall"]["lower_fixed"] == clopper_pearson_lower(450, 450)
    assert document["conditions"]["seeds"] == [[SEED, SEED + 44]]
    assert document["batches"] == 1 + (450 - FIRST) // BATCH
    assert (document["unit"], document["calibration"], document["finished"]) == ("drive", FIRST, True)
    for text in document["assumptions"]:
        assert f"    - {text}" in lines
    assert any("do not influence each other" in text for text in document["assumptions"])
    assert any("at any stopping time" in text for text in document["assumptions"])


GOLDEN = """answer assumptions batches calibration certificate conditions confidence finished
hardware inputs left_out made needed online overall requirements run sequential share shift spec system unit
versions width"""
GOLDEN_INPUTS = "functions guard_version policy rules spec system world"
GOLDEN_CONDITIONS = "agents guard margin overrides replan require scenario seeds steps time_limit"


@pytest.mark.usefixtures("there")
def test_the_keys_of_a_certificate(capsys: pytest.CaptureFixture[str]) -> None:
    result = certified(capsys, "--seeds", "0..1", "--out", "kept/golden.json", code=4)
    assert sorted(result) == GOLDEN.split()
    assert sorted(result["inputs"]) == GOLDEN_INPUTS.split()
    assert sorted(result["conditions"]) == GOLDEN_CONDITIONS.split()
    assert json.loads(Path("kept/golden.json").read_text()) == result


@pytest.mark.usefixtures("there")
def test_fixed_seeds_are_all_driven_and_bounded_exactly(capsys: pytest.CaptureFixture[str]) -> None:
    result = certified(capsys, "--seeds", "0..29")
    overall = result["overall"]
    assert (overall["units"], overall["method"]) == (300, "Clopper-Pearson")
    assert overall["lower"] == overall["lower_fixed"] == clopper_pearson_lower(300, 300)
    assert result["sequential"] is False
    assert result["calibration"] == 300
    assert result["needed"] == {"units": 299, "robustness": 19}
    again = certified(capsys, "--seeds", "0..29")
    assert again["overall"] == overall


@pytest.mark.usefixtures("there")
def test_too_few_drives_decide_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", "latest", "--seeds", "0"]) == 4
    out = capsys.readouterr().out
    assert "undecided, with 95 % confidence, whether at least 99 %" in out
    assert "99 % needs 299 drives without a failure" in out
    assert "a bound on the next robustness needs 19 drives" in out
    assert "unknown" in out


def test_a_share_that_is_too_high_is_refuted(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", "latest", "--set", "limit=0 m"]) == 1
    assert "  refuted: at most " in capsys.readouterr().out
    document = json.loads((there.path / "eval/certificate.json").read_text())
    assert document["conditions"]["overrides"] == {"limit": "0 m"}
    assert document["overall"]["upper"] < 0.99
    rows = {each["name"]: each for each in document["requirements"]}
    assert rows["near"]["satisfied"] < rows["slow"]["satisfied"] == rows["slow"]["drives"]
    assert rows["near"]["next_robustness"] < 0 < rows["slow"]["next_robustness"]
    only = certified(capsys, "--set", "limit=0 m", "--require", "slow")
    assert [each["name"] for each in only["requirements"]] == ["slow"]


@pytest.mark.usefixtures("there")
def test_drives_that_end_before_a_window_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", "latest", "--seeds", "0..2", "--steps", "4"]) == 4
    out = capsys.readouterr().out
    assert "30 of 30 drives have no verdict, as after too few steps, and count as not satisfied" in out


@pytest.mark.usefixtures("there")
def test_the_width_decides_when_to_stop(capsys: pytest.CaptureFixture[str]) -> None:
    result = certified(capsys, "--width", ".3", "--set", "limit=0 m")
    low, high = result["overall"]["interval"]
    assert (result["answer"], result["share"]) == ("measured", None)
    assert high - low <= 0.3
    assert certified(capsys, "--width", ".01", "--drives", "100", code=4)["finished"] is True


@pytest.mark.usefixtures("there")
def test_a_shift_lowers_the_share(capsys: pytest.CaptureFixture[str]) -> None:
    result = certified(capsys, "--seeds", "0..19", "--shift", "0.02", "--share", ".97", code=4)
    overall = result["overall"]
    assert overall["lower_deployed"] == pytest.approx(overall["lower"] - 0.02)
    assert result["shift"] == "tv=0.02"
    assert any("total variation 0.02" in text for text in result["assumptions"])
    plain = certified(capsys, "--seeds", "0..19", "--share", ".97")
    assert overall["next_robustness"] <= plain["overall"]["next_robustness"]


@pytest.mark.usefixtures("there")
def test_agents_of_a_world_that_says_nothing_are_one_observation(capsys: pytest.CaptureFixture[str]) -> None:
    paired = ["--set", "test.world=paired.py:Paired", "--set", "limit=0.5 m"]
    result = certified(capsys, *paired, "--seeds", "0..19", "--share", ".5", code=0)
    assert (result["unit"], result["overall"]["units"], result["overall"]["drives"]) == ("world", 20, 200)
    assert result["overall"]["method"] == "betting"
    assert result["overall"]["lower_fixed"] is None
    assert result["overall"]["whole_units"] < 20
    assert any("a world is one observation" in text for text in result["assumptions"])
    values = dict(map(tuple, result["overall"]["observed"]))
    assert sum(value * count * 10 for value, count in values.items()) == pytest.approx(
        result["overall"]["satisfied"]
    )
    single = certified(capsys, *paired, "--seeds", "0..29", "--agents", "1", "--share", ".5")
    assert (single["unit"], single["overall"]["method"]) == ("world", "Clopper-Pearson")


@pytest.mark.parametrize(
    "words",
    [
        ["--share", "1"],
        ["--confidence", "0"],
        ["--width", "2"],
        ["--shift", "kl=.2"],
        ["--guard", "fool"],
        ["--scenario", "storm"],
        ["--require", "nearer"],
        ["--seeds", "9..0"],
        ["--margin", "near=x"],
        ["--verify", "missing.json"],
    ],
)
def test_bad_options_are_usage_errors(
    words: Sequence[str], there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in there.path.rglob("*")}
    assert main(["certify", "latest", *words]) == 2
    assert "error[U10" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in there.path.rglob("*")} == before


# ------------------------------------------------------------------------- verification


@pytest.fixture
def file(there: RunDir, capsys: pytest.CaptureFixture[str]) -> Path:
    """A fresh certificate."""
    assert main(["certify", there.name, "--seeds", "0..3", "--out", "mine.json", "-q"]) == 4
    capsys.readouterr()
    return Path("mine.json")


def compared(capsys: pytest.CaptureFixture[str], file: Path, code: int) -> dict[str, Any]:
    assert main(["certify", "--verify", str(file), "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("certify/1")) == []
    result: dict[str, Any] = document["result"]
    return result


def test_a_certificate_is_about_its_run(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compared(capsys, file, 0)["same"] is True
    assert main(["certify", "--verify", str(file)]) == 0
    assert "is about this run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changed", "entry"), [("spec.stl", "spec"), ("system.yaml", "system"), ("ckpt", "policy")]
)
def test_what_differs_is_named(
    changed: str, entry: str, file: Path, there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    path = there.path / changed
    path = next(path.glob("*.safetensors")) if path.is_dir() else path
    data = path.read_bytes()
    path.write_bytes(data + b"\n# later\n")
    try:
        found = compared(capsys, file, 1)
        assert [each["name"] for each in found["inputs"]] == [entry]
        assert main(["certify", "--verify", str(file)]) == 1
        assert f"  {entry} differs: " in capsys.readouterr().out
    finally:
        path.write_bytes(data)


def test_numbers_that_were_changed_are_found(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(file.read_text())
    document["overall"]["lower"] += 0.01
    document["answer"] = "certified"
    document["requirements"][0]["upper"] = "nan"
    document["versions"]["torch"] = "0.1"
    file.write_text(json.dumps(document))
    found = compared(capsys, file, 1)
    assert found["numbers"] == ["overall.lower", "near.upper", "answer"]
    assert [each["name"] for each in found["software"]] == ["torch"]
    assert main(["certify", "--verify", str(file)]) == 1
    out = capsys.readouterr().out
    assert "overall.lower does not follow from the counts" in out
    assert "has been changed" in out


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("drives", 4000),
        ("satisfied", 0),
        ("undecided", 1),
        ("interval", [0.99, 1.0]),
        ("lower_any_time", 0.9),
        ("lower_fixed", None),
        ("whole_units", 41),
        ("whole_units_lower", 0.9),
    ],
)
def test_every_count_and_bound_is_compared(
    entry: str, value: object, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads(file.read_text())
    assert document["overall"][entry] != value
    document["overall"][entry] = value
    file.write_text(json.dumps(document))
    assert set(compared(capsys, file, 1)["numbers"]) & {f"overall.{entry}", f"near.{entry}"}


def test_a_certificate_of_more_drives_than_its_seeds_give_is_found(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads(file.read_text())
    document["conditions"]["seeds"] = [[0, 1]]
    file.write_text(json.dumps(document))
    assert compared(capsys, file, 1)["numbers"] == ["conditions.seeds"]


@pytest.mark.usefixtures("there")
@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"certificate": "other"}',
        '{"certificate": "stlc-certificate/1"}',
        '{"certificate": "stlc-certificate/1", "run": "latest", "conditions": {"overrides": 3}}',
    ],
)
def test_what_is_no_certificate_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("odd.json").write_text(text)
    assert main(["certify", "--verify", "odd.json"]) == 3
    assert "error[R108]: `odd.json` is no certificate" in capsys.readouterr().err


@pytest.mark.parametrize(
    "counts", [[], [[0.5, -1]], [[2, 3]], [["a", 1]], [[1, 0]], [[1]], 7, [[1, 1e300]], [[1, 9**15], [0, 2]]]
)
def test_counts_that_are_none_are_refused(
    counts: Any, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads(file.read_text())
    document["overall"]["observed"] = counts
    file.write_text(json.dumps(document))
    assert main(["certify", "--verify", str(file)]) == 3
    assert "error[R108]" in capsys.readouterr().err


# ------------------------------------------------------------------------- simulate and check


@pytest.mark.usefixtures("there")
def test_simulate_bounds_the_share_behind_its_counts(capsys: pytest.CaptureFixture[str]) -> None:
    drive = ["simulate", "latest", "--seeds", "0..9", "--no-pictures"]
    assert main([*drive, "--certify", ".95", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("simulate/1")) == []
    found = document["result"]["guards"]["none"]["assurance"]
    assert found["overall"]["lower"] == clopper_pearson_lower(100, 100)
    assert main([*drive, "--certify", ".99"]) == 4
    assert "undecided, with 95 % confidence" in capsys.readouterr().out
    assert main([*drive, "--certify", ".99", "--fail-under", ".5"]) == 2
    capsys.readouterr()
    assert main(["check", "trace.npz", "--certify", ".95", "--json"]) == 4
    bounds = json.loads(capsys.readouterr().out)["result"]["assurance"]
    assert (bounds["unit"], bounds["overall"]["units"], bounds["overall"]["drives"]) == ("world", 10, 100)


def a_file(name: str, peak: float) -> str:
    signature = Signature((Column("a"),))
    data = {"a": np.array([[0.0, peak, 0.0]])}
    Trace(signature, 0.1, data).save(name)
    return name


@pytest.fixture
def traces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text("signal a\nrequire low: always a < 2\nrequire high: always a > -1\n")
    return [a_file(f"{number:02d}.npz", number / 40) for number in range(60)]


def test_recorded_traces_bound_the_share_of_all(
    traces: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "s.stl", *traces, "--certify", ".95", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("check/1")) == []
    found = document["result"]["assurance"]
    assert found["answer"] == "certified"
    assert (found["unit"], found["overall"]["units"]) == ("trace", 60)
    assert found["overall"]["lower"] == clopper_pearson_lower(60, 60)
    least = sorted(min(2 - number / 40, 1.0) for number in range(60))
    assert found["overall"]["next_robustness"] == pytest.approx(least[2])  # the floor of 61 x .05 = 3rd
    assert main(["check", "s.stl", *traces, "--certify", ".95", "--jobs", "2"]) == 0
    out = capsys.readouterr().out
    assert "satisfied; 60 of 60 files satisfy every requirement" in out
    assert "certified: at least 95 % of traces satisfy everything, with 95 % confidence" in out
    assert "none was chosen or left out by its result" in out


def test_traces_that_violate(traces: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    bad = [a_file(f"bad{number}.npz", 3) for number in range(10)]
    assert main(["check", "s.stl", *traces, *bad, "--certify", ".95"]) == 1
    assert "refuted: at most" in capsys.readouterr().out
    assert main(["check", "s.stl", *traces[:5], "--certify", ".95", "--chunk", "2"]) == 4
    assert "5 of 5" in capsys.readouterr().out
    Path("torn.npz").write_bytes(b"PK")
    assert main(["check", "s.stl", *traces, "torn.npz", "--certify", ".95"]) == 3


@pytest.mark.parametrize("words", [["--certify", "0"], ["--certify", ".9", "--fail-under", ".9"]])
def test_wrong_claims_on_traces(
    words: list[str], traces: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "s.stl", *traces, *words]) == 2
    assert "error[U101]" in capsys.readouterr().err


@pytest.mark.apart
def test_bounds_on_traces_need_no_torch(traces: list[str]) -> None:
    program = (
        "import sys; from stlc.cli.framework.app import main\n"
        "sys.exit(main(sys.argv[1:]) or 'torch' in sys.modules)"
    )
    words = ["check", "s.stl", *traces, "--certify", ".95", "-q"]
    assert subprocess.run([sys.executable, "-c", program, *words], check=False).returncode == 0


def test_a_recording_counts_once(traces: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "s.stl", traces[0], traces[1], traces[0], "--certify", ".5"]) == 2
    assert f"`{traces[0]}` is named twice" in capsys.readouterr().err
    Path("link.npz").symlink_to(traces[0])
    assert main(["check", "s.stl", "*.npz", "--certify", ".5"]) == 2
    assert f"`{traces[0]}` and `link.npz` are the same file" in capsys.readouterr().err
    assert main(["check", "s.stl", traces[0], traces[0]]) == 0


def test_seeds_of_a_certificate_are_apart(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(file.read_text())
    ((first, last),) = document["conditions"]["seeds"]
    document["conditions"]["seeds"] = [[first, first], [first, last - 1]]
    Path("twice.json").write_text(json.dumps(document))
    assert main(["certify", "--verify", "twice.json"]) == 1
    assert "conditions.seeds does not follow from the counts" in capsys.readouterr().out
