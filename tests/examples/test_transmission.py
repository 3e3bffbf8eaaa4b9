"""`examples/tasks/transmission.stl` on logs with a jittered clock: `check -` says what `check FILE` does."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stlc.cli.framework.app import main

pytestmark = pytest.mark.apart

SPEC = Path(__file__).parents[2] / "examples/tasks/transmission.stl"
GEARS = ("first", "second", "third", "fourth")
RATIOS = (2.4, 1.45, 1.0, 0.68)
UP, DOWN = (30, 55, 90), (20, 40, 70)  # km/h: where it shifts


def a_log(seed: int, *, seconds: float = 60.0, rate: float = 100.0, hunting: bool = False) -> list[str]:
    """A drive: throttle in steps, an engine that follows, gears by speed; lines of a .csv, clock jittered."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.5, 1.5, int(seconds * rate)) / rate
    speed, gear, throttle = 0.0, 0, 30.0
    lines = ["time,speed [km/h],rpm,gear,throttle [%]"]
    since = 0.0
    for time, dt in zip(np.cumsum(steps), steps, strict=True):
        if rng.random() < dt / 6:
            throttle = float(rng.uniform(0, 95 if time < 0.7 * seconds else 20))
        speed = max(speed + dt * (0.16 * throttle - 0.0012 * speed**1.7), 0.0)
        since += dt
        wait = 0.4 if hunting else 3.0
        if gear < 3 and speed > UP[gear] and since > wait:
            gear, since = gear + 1, 0.0
        elif gear > 0 and speed < DOWN[gear - 1] + 13 * hunting and since > wait:
            gear, since = gear - 1, 0.0
        rpm = 800 + 26 * speed * RATIOS[gear] + 5 * throttle + float(rng.normal(0, 15))
        lines.append(f"{time:.6f},{speed:.4f},{rpm:.2f},{GEARS[gear]},{throttle:.2f}")
    return lines


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    code = main(["check", str(SPEC), *arguments, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["exit_code"] == code, found["diagnostics"]
    return found


def both(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, lines: list[str], *options: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    text = "\n".join(lines) + "\n"
    Path("log.csv").write_text(text)
    file = run(capsys, "log.csv", *options)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    return file, run(capsys, "-", *options)


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def agree(file: dict[str, Any], stream: dict[str, Any], *, resampled: bool = False) -> dict[str, str]:
    """Everything that is said about every requirement is the same; the verdicts.

    Of a file that is resampled every sample counts, of a stream those at the instants of the grid.
    """
    assert resampled or stream["exit_code"] == file["exit_code"]
    for key in ("samples", "dt", *(() if resampled else ("verdict", "unknown"))):
        assert stream["result"][key] == file["result"][key], key
    for one, other in zip(stream["result"]["requirements"], file["result"]["requirements"], strict=True):
        if resampled:
            assert {one["verdict"], other["verdict"]} != {"satisfied", "violated"}
            assert float(other["robustness"]["low"]) <= float(one["robustness"]["high"]) + 1e-9
        else:
            assert {**one, "facts": []} == {**other, "facts": []}  # pieces tell less about a recording
    return {each["name"]: each["verdict"] for each in file["result"]["requirements"]}


@pytest.mark.parametrize(
    ("seed", "seconds", "rate"),
    [
        (1, 12.0, 10.0),
        pytest.param(1, 60.0, 100.0, marks=pytest.mark.slow),
        pytest.param(2, 60.0, 100.0, marks=pytest.mark.slow),
    ],
)
def test_a_jittered_clock(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    seed: int,
    seconds: float,
    rate: float,
) -> None:
    log = a_log(seed, seconds=seconds, rate=rate, hunting=seed == 2)
    found = agree(*both(capsys, monkeypatch, log, "--resample", f"{1 / rate}s"), resampled=True)
    assert found["no_hunting"] == ("violated" if seed == 2 else "satisfied"), found
    assert set(found.values()) <= {"satisfied", "violated"}


@pytest.mark.parametrize(
    "options", [("--resample", "100ms"), pytest.param(("--max-gap", "0.3s"), marks=pytest.mark.slow)]
)
def test_a_jittered_log_with_holes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...]
) -> None:
    head, *lines = a_log(3, seconds=20, rate=10)
    del lines[50:170]
    lines[2:5] = [line.rpartition(",")[0] + "," for line in lines[2:5]]  # throttle is missing
    lines[25] = ",".join(cell if i != 3 else "" for i, cell in enumerate(lines[25].split(",")))
    file, stream = both(capsys, monkeypatch, [head, *lines], *options)
    found = agree(file, stream, resampled=True)
    assert found["red_line"] == "inconclusive"
    unknown = file["result"]["unknown"]["rpm"]
    assert 11 <= unknown["samples"] * file["result"]["dt"] <= 13
    assert unknown["first"] == pytest.approx(5, abs=0.5)


def test_a_clock_that_nobody_recorded(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [line.partition(",")[2] for line in a_log(4, seconds=1)]
    found = agree(*both(capsys, monkeypatch, lines, "--dt", "0.01s"))
    assert found["top_speed"] == "satisfied"
    agree(*both(capsys, monkeypatch, lines, "--dt", "10ms", "--resample", "25ms"), resampled=True)
    assert both(capsys, monkeypatch, lines)[0]["exit_code"] == 3
