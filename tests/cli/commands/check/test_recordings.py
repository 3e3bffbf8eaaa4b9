"""Recordings as people have them: tables, clocks and objects, as `stlc check` reads them and says so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stlc.cli.framework.app import main

LIMIT = "signal v [m/s]\nrequire limit: always v < 3 m/s\n"
WINDOW = "signal v\nrequire w: always[0 s, 1 s] v < 3\n"


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def check(capsys: pytest.CaptureFixture[str], spec: str, table: str, *options: str) -> tuple[int, str]:
    Path("s.stl").write_text(spec)
    Path("l.csv").write_text(table)
    code = main(["check", "s.stl", "l.csv", *options])
    said = capsys.readouterr()
    return code, said.out + said.err


def rows(head: str, step: float, count: int = 20, peak: int = 8) -> str:
    return "\n".join([head, *(f"{k * step:.10g},{9 if k == peak else 1}" for k in range(count))]) + "\n"


@pytest.mark.parametrize(
    ("table", "options", "code", "said"),
    [
        (rows("time_ms,v", 100), (), 1, "clock `time_ms` (ms)"),
        (rows("timestamp,v", 100_000), (), 3, "--clock timestamp:us"),
        (rows("timestamp,v", 100_000), ("--clock", "timestamp:us"), 1, "clock `timestamp` (us)"),
        (rows("frame,v", 1), (), 3, "--fps 25  if `frame` counts frames"),
        (rows("frame,v", 1), ("--fps", "10"), 1, "clock `frame` (frames)"),
        (rows("frame,v", 1), ("--clock", "frame:frames", "--fps", "10"), 1, "t = 0.8 s"),
        (rows("-0.1,1", 0.1, 20), ("--columns", "t,v"), 1, ""),
        (rows("t,v", 0.1), ("--clock", "when"), 3, "has no signal `when`"),
        (rows("t,v", 0.1), ("--clock", ":us"), 2, "names no clock"),
        (rows("t,v", 0.1), ("--fps", "-1"), 2, "not a number above 0"),
        (rows("t,v", 0.1), ("--between", "v=spline"), 2, "no way to continue a signal"),
        (rows("t,v", 0.1), ("--between", "w=hold"), 2, "has no signal `w`"),
        (rows("t,v", 0.1), ("--map", "w=v"), 2, "has no signal `w`"),
    ],
)
def test_clocks(
    capsys: pytest.CaptureFixture[str], table: str, options: tuple[str, ...], code: int, said: str
) -> None:
    found, out = check(capsys, WINDOW, table, *options)
    assert found == code, out
    assert said in out


def test_objects_of_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    table = "t,trackId,v\n0,1,1\n1,1,1\n2,1,1\n1,2,1\n2,2,1\n3,2,9\n4,2,1\n"
    code, out = check(capsys, LIMIT, table)
    assert code == 1
    assert "replay: stlc check s.stl l.csv --group trackId=2 --require limit --at 1s" in out
    assert "1 of 2 objects satisfy every requirement" in out
    assert check(capsys, LIMIT, table, "--group", "trackId=1")[0] == 0
    assert check(capsys, LIMIT, table, "--group", "trackId=2", "--require", "limit", "--at", "1s")[0] == 1
    code, out = check(capsys, LIMIT, table, "--group", "none")
    assert code == 3
    assert "line 5: t[2] = 2 s, t[3] = 1 s" in out
    assert check(capsys, LIMIT, table, "--group", "trackId=7")[0] == 3
    assert check(capsys, LIMIT, table, "--group", "lane")[0] == 3


def test_what_was_judged_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    spec = "signal a\nsignal b\nrequire one: always a < 3\nrequire both: always (b > 0 -> a < 3)\n"
    times, later = np.round(0.1 * np.arange(603), 6), np.round(1.0 + 0.1 * np.arange(591), 6)
    values = np.where(times == 0.5, 9.0, 1.0)
    np.savez("l.npz", **{"a.t": times, "a.v": values, "b.t": later, "b.v": np.ones(591), "odd": np.eye(3)})
    Path("s.stl").write_text(spec)
    words = ["check", "s.stl", "l.npz", "--resample", "0.1s", "--map", "a=a.v", "--map", "b=b.v"]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "read 1 s to 60 s of 60.2 s" in out
    assert main([*words, "--json"]) == 1
    found: dict[str, Any] = json.loads(capsys.readouterr().out)["result"]
    one, both = found["requirements"]
    assert (one["verdict"], one["judged"], both["verdict"]) == ("violated", None, "satisfied")
    assert both["judged"] == pytest.approx({"first": 1.0, "last": 60.0, "of": 60.2})
    assert main([*words, "--require", "both"]) == 0
    assert main([*words, "--require", "both", "--strict"]) == 4


def test_a_stream_tells_how_many_samples_it_does_not_judge(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import io
    import sys

    Path("s.stl").write_text(LIMIT)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"t,v\n0,1\n0.05,9\n0.1,1\n0.2,1\n")))
    assert main(["check", "s.stl", "-", "--resample", "0.1s"]) == 0
    assert "between the instants of the grid are not judged: 1" in capsys.readouterr().err
