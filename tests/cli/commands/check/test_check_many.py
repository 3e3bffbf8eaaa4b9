"""`stlc check` on many files, in pieces, from the standard input; its tables, XML and signals."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from stlc.cli.framework.app import main
from stlc.signature import Column, Signature
from stlc.trace import Trace
from stlc.trace.chunks import size_of
from stlc.units import Unit

SPEC = """spec small
const top = 2
signal a [m]
signal on : bool
assume moving: a > -100 m
@safety
require low: always a < top * 1 m
require soon: always[0 s, 1 s] (on -> eventually[0 s, 0.5 s] a > 0 m)
require window: always[0 s, 0.3 s] a > -5 m
"""
N = 60


@pytest.fixture(autouse=True)
def _a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text(SPEC)


def a_trace(peak: float = 1.0, samples: int = N, first: float = 0.5, unit: str = "m") -> Trace:
    a = np.full((1, samples), first)
    a[0, samples // 2] = peak
    on = (np.arange(samples) % 7 == 0).astype(float)[None]
    signature = Signature((Column("a", Unit.parse(unit)), Column("on", kind="bool")))
    return Trace(signature, 0.1, {"a": a, "on": on})


def files(*traces: Trace, suffix: str = ".npz") -> list[str]:
    names = [f"{i}{suffix}" for i in range(len(traces))]
    for name, trace in zip(names, traces, strict=True):
        trace.save(name)
    return names


def check(*arguments: str) -> int:
    return main(["check", *arguments])


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    check(*arguments, "--json")
    return json.loads(capsys.readouterr().out)


# --------------------------------------------------------------------------- many files


def test_files_of_different_lengths_and_one_that_is_broken(capsys: pytest.CaptureFixture[str]) -> None:
    names = files(a_trace(), a_trace(peak=3), a_trace(samples=8))
    Path("broken.npz").write_bytes(b"PK\x03\x04")
    assert check("s.stl", *names, "broken.npz") == 3
    out, err = capsys.readouterr()
    assert "error[E603]" in err
    assert [
        line.split()[:2] for line in out.splitlines() if line.startswith(("  0.", "  1.", "  2.", "  br"))
    ] == [
        ["0.npz", "satisfied"],
        ["1.npz", "VIOLATED"],
        ["2.npz", "inconclusive"],
        ["broken.npz", "INVALID"],
    ]
    assert "violated; 1 of 4 files satisfy every requirement, 1 cannot be judged" in out
    assert check("s.stl", *names, "-q") == 1
    assert check("s.stl", "broken.npz", "-q") == 3


def test_jobs_change_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    names = files(*(a_trace(peak=k / 2) for k in range(6)))
    one, two = (document(capsys, "s.stl", *names, "--jobs", jobs)["result"] for jobs in ("1", "2"))
    assert one == two
    assert [entry["verdict"] for entry in one["files"]] == ["satisfied"] * 5 + ["violated"]


def test_traces_out_of_scope(capsys: pytest.CaptureFixture[str]) -> None:
    good, outside = files(a_trace(), a_trace(peak=9, first=-200))
    assert check("s.stl", outside) == 4
    assert "out of scope: the assumptions do not hold" in capsys.readouterr().out
    assert check("s.stl", good, outside, "-q") == 0
    both = a_trace()
    data = {name: np.concatenate([both.data[name], a_trace(9, first=-200).data[name]]) for name in both.data}
    Trace(both.signature, 0.1, data).save("both.npz")
    assert check("s.stl", "both.npz") == 0
    assert (
        "1 of 1 traces satisfy every requirement; 100 % of 1 starts; 1 out of scope"
        in capsys.readouterr().out
    )
    assert document(capsys, "s.stl", "both.npz")["result"]["in_scope"] == 1
    assert document(capsys, "s.stl", outside)["result"]["verdict"] == "out of scope"


def test_a_constant_that_is_changed(capsys: pytest.CaptureFixture[str]) -> None:
    (name,) = files(a_trace(peak=3))
    assert check("s.stl", name, "-q") == 1
    assert check("s.stl", name, "-q", "--set", "top=4") == 0
    assert check("s.stl", name, "-q", "--set", "tip=4") == 2
    assert "did you mean `top`" in capsys.readouterr().err


def test_junit() -> None:
    names = files(a_trace(), a_trace(peak=3), a_trace(samples=4))
    Path("bro<ken.npz").write_bytes(b"")
    assert check("s.stl", *names, "bro<ken.npz", "--junit", "out/f.xml", "-q") == 3
    root = ElementTree.parse("out/f.xml").getroot()
    assert (root.get("tests"), root.get("failures"), root.get("errors"), root.get("skipped")) == (
        "10",
        "1",
        "1",
        "1",
    )
    (failure,) = root.iter("failure")
    assert "a = 3 m" in (failure.text or "")
    assert [suite.get("name") for suite in root] == [*names, "bro<ken.npz"]


@pytest.mark.parametrize("suffix", [".npz", ".mcap", ".csv"])
def test_robustness_signals_have_units(suffix: str) -> None:
    Path("u.stl").write_text(
        "signal temp [degC]\nsignal speed [km/h]\n"
        "require hot: always[0 s, 0.1 s] temp <= 60 degC\n"
        "require fast: always[0 s, 0.1 s] speed <= 30 m/s\n"
        "require both: always[0 s, 0.1 s] (temp <= 60 degC and speed <= 30 m/s)\n",
        encoding="utf-8",
    )
    Path("u.csv").write_text("t,temp [K],speed [m/s]\n0,293.15,10\n0.1,333.15,20\n", encoding="utf-8")
    assert check("u.stl", "u.csv", "--out", f"margins{suffix}", "-q") == 0
    margins = Trace.load(f"margins{suffix}")
    assert [(c.name, c.unit.text) for c in margins.signature.columns] == [
        ("hot", "K"),
        ("fast", "km/h"),
        ("both", ""),
    ]
    assert [margins.data[name][0, 0] for name in ("hot", "fast", "both")] == pytest.approx(
        [0, 36, 0], abs=1e-9
    )


def test_robustness_signals() -> None:
    names = files(a_trace(), a_trace(peak=3))
    check("s.stl", names[1], "--out", "rob.npz", "-q")
    rob = Trace.load("rob.npz")
    assert list(rob.data) == ["low", "soon", "window"]
    assert (rob.data["low"][0, 0], rob.data["low"][0, -1]) == (-1.0, 1.5)
    assert np.isnan(rob.data["window"][0, -1])
    check("s.stl", *names, "--out", "folder", "-q")
    assert sorted(path.name for path in Path("folder").iterdir()) == ["0.npz", "1.npz"]
    assert check("s.stl", *names, "--out", "one.npz") == 2


# ----------------------------------------------------------------------- other readings


def test_resampling_and_units_and_the_name_of_the_clock(capsys: pytest.CaptureFixture[str]) -> None:
    t = np.cumsum(np.tile([0.05, 0.15], N // 2))
    on = np.arange(N) % 7 == 0
    np.savez("a.npz", time=t, height=np.full(N, 0.5), on=on)
    arguments = ("s.stl", "a.npz", "--map", "t=time", "--map", "a=height")
    assert check(*arguments) == 3
    assert "--resample 0.05s" in capsys.readouterr().err  # not its own step
    assert check(*arguments, "-q", "--resample", "100ms") == 0
    for text in ("0.1", "0 s", "1 m", "x"):
        assert check(*arguments, "--resample", text) == 2
    (name,) = files(a_trace(peak=150, unit="cm"))
    assert check("s.stl", name, "-q") == 0
    (name,) = files(a_trace(peak=250, unit="cm"))
    assert check("s.stl", name, "-q") == 1
    (name,) = files(a_trace(unit="s"))
    assert check("s.stl", name, "-q") == 3


@pytest.mark.parametrize("end", ["open", "truncate"])
@pytest.mark.parametrize(
    ("suffix", "at"),
    [
        *((".npz", at) for at in ((), ("--at", "2.5s"), ("--at", "31"))),
        (".npz", ("--at", "all", "--require", "window", "--require", "soon")),
        (".csv", ()),
        (".parquet", ()),
    ],
)
@pytest.mark.parametrize("peak", [1.0, 3.0])
def test_pieces_give_what_the_whole_gives(
    capsys: pytest.CaptureFixture[str], suffix: str, end: str, at: Sequence[str], peak: float
) -> None:
    trace = a_trace(peak)
    (name,) = files(trace, suffix=".csv" if suffix == ".csv" else ".npz")
    if suffix == ".parquet":
        pyarrow = pytest.importorskip("pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        columns = {"t": trace.times, **{n: x[0] for n, x in trace.data.items()}}
        name = "0.parquet"
        parquet.write_table(pyarrow.table(columns), name, row_group_size=11)
    arguments = ("s.stl", name, "--end", end, *at)
    whole = document(capsys, *arguments)["result"]
    for size in ("7", "59", "1000"):
        found = document(capsys, *arguments, "--chunk", size)["result"]
        assert (found["verdict"], found["samples"]) == (whole["verdict"], whole["samples"])
        for one, other in zip(found["requirements"], whole["requirements"], strict=True):
            assert (one["name"], one["verdict"], one["starts"]) == (
                other["name"],
                other["verdict"],
                other["starts"],
            )
            assert one["robustness"]["min"] == other["robustness"]["min"]
            assert one["satisfied_share"] == other["satisfied_share"]
            assert one["robustness"]["argmin"]["trace"] == other["robustness"]["argmin"]["trace"]
            assert one["cause"] == other["cause"]


def test_pieces_that_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    (name,) = files(a_trace())
    for option in (("--resample", "1s"), ("--out", "x.npz"), ("--semantics", "agm")):
        assert check("s.stl", name, "--chunk", "9", *option) == 2
        assert "help: leave out --chunk" in capsys.readouterr().err
    several = Trace(a_trace().signature, 0.1, {n: np.repeat(x, 3, axis=0) for n, x in a_trace().data.items()})
    for suffix in (".npz", ".csv"):
        (name,) = files(several, suffix=suffix)
        assert check("s.stl", name, "--chunk", "9", "-q") == 3
    t = np.arange(N) * 0.1
    t[40] += 0.04
    np.savez("odd.npz", t=t, a=np.zeros(N), on=np.zeros(N))
    assert check("s.stl", "odd.npz", "--chunk", "9") == 3
    assert "t[40]" in capsys.readouterr().err


def test_a_file_that_is_too_large_is_read_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    (name,) = files(a_trace(peak=3))
    monkeypatch.setattr("stlc.trace.chunks.LARGE", 100)
    monkeypatch.setattr("stlc.monitor.check.SMALL", 100)
    monkeypatch.setattr("stlc.trace.formats.registry.MAX_BYTES", size_of(Path(name)) - 1)
    monkeypatch.setattr("stlc.monitor.check.CHUNK", N // 2)
    assert check("s.stl", name, "-q") == 1
    assert check("s.stl", name, "-q", "--resample", "1s") == 2


# ------------------------------------------------------------------- the standard input


def stream(monkeypatch: pytest.MonkeyPatch, text: str | bytes, *arguments: str) -> int:
    raw = text.encode() if isinstance(text, str) else text
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(raw)))
    return check("s.stl", "-", *arguments)


def as_csv(trace: Trace) -> str:
    trace.save("stream.csv")
    return Path("stream.csv").read_text()


def as_json(trace: Trace) -> str:
    rows = zip(trace.times.tolist(), *(x[0].tolist() for x in trace.data.values()), strict=True)
    return "\n".join(json.dumps(dict(zip(["t", *trace.data], row, strict=True))) for row in rows)


@pytest.mark.parametrize("form", [as_csv, as_json])
def test_a_stream(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, form) -> None:
    assert stream(monkeypatch, form(a_trace(peak=3))) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "t = 0.3 s  window  satisfied  +5.500 m"
    assert "t = 3 s  low  VIOLATED  [-inf, -1.000] m" in lines
    assert "  = because: `a < top * 1 m` is false where a = 3 m, at t = 3 s" in lines
    assert lines[-1] == "violated"
    assert stream(monkeypatch, form(a_trace()), "-q") == 0
    assert capsys.readouterr() == ("", "")


def test_a_stream_gives_what_the_trace_gives(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = as_csv(a_trace(peak=3))
    whole = document(capsys, "s.stl", "stream.csv")["result"]
    stream(monkeypatch, text, "--json")
    found = json.loads(capsys.readouterr().out)["result"]
    for one, other in zip(found["requirements"], whole["requirements"], strict=True):
        assert (one["name"], one["verdict"]) == (other["name"], other["verdict"])
        assert one["robustness"]["min"] == other["robustness"]["min"]
        assert one["cause"] == other["cause"]
    assert (
        found["requirements"][0]["cause"]["because"] == "`a < top * 1 m` is false where a = 3 m, at t = 3 s"
    )


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("", 3, "holds no samples"),
        ("t,a,on\n", 3, "holds no samples"),
        ("t,a,on\n0,1,1\n0.1,x,1\n", 3, "line 3 of the standard input has `x` where a number is expected"),
        ("t,a,on\n0,1,1\n0.1,1\n", 3, "line 3 of the standard input has 2 cells"),
        ("t,a,on\n0,1,1\n0.1,1,1\n0.3,1,1\n", 3, "sample 2 has 0.3 s, not 0.2 s\n  = help: --max-gap 0.3s"),
        ("t,a,on\n0,1,1\n0,1,1\n", 3, "does not increase"),
        ("t,a,a\n0,1,1\n", 3, "names one twice"),
        ("0,1,2\n", 3, "numbers where the columns are named\n  = help: --columns t,x,v  names the columns"),
        ("a,on\n1,1\n2,1\n", 3, "the standard input has no `t`"),
        ("t,a,on\n0,1,1\n0.1,1,1\n0.23,1,1\n", 3, "help: --resample 0.05s"),
        ("t [m],a,on\n0,1,1\n", 3, "is in [m], which is not a time"),
        ("t,a [s],on\n0,1,1\n0.1,1,1\n", 3, "is in [s] in `standard input`, the specification declares [m]"),
        ("t,a [what],on\n0,1,1\n0.1,1,1\n", 3, "unknown unit `what`"),
        ("t,a,on\nsoon,1,1\n", 3, "line 2 of the standard input has `soon` for a time"),
        ("t,b,on\n0,1,1\n0.1,1,1\n", 3, "no signal `a`"),
        ('{"t": 0, "a": 1, "on": 1}\n[1]\n', 3, "line 2 of the standard input is not a JSON object"),
        (
            '{"t": 0, "a": "x", "on": 1}\n{"t": 1, "a": 1, "on": 1}\n',
            3,
            "line 1 of the standard input has `x` where",
        ),
        (b"\xff\xfe\x00", 3, "is not UTF-8"),
        ('{"t": 0, "a": [1, 2], "on": 1}\n{"t": 1, "a": 1, "on": 1}\n', 3, "no signal `a`"),
        ("t,a,on\n0,1," + "1" * 1_000_001, 3, "line 2 of the standard input is longer than"),
    ],
)
def test_streams_that_are_refused(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    text: str | bytes,
    code: int,
    words: str,
) -> None:
    assert stream(monkeypatch, text) == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("at", ["31", "3.1s", "2.9s"])
def test_a_stream_at_one_of_its_samples(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    text = as_csv(a_trace(peak=3))
    whole = document(capsys, "s.stl", "stream.csv", "--at", at)["result"]
    stream(monkeypatch, text, "--json", "--at", at)
    found = json.loads(capsys.readouterr().out)["result"]
    for row in (*found["requirements"], *whole["requirements"]):
        del row["facts"]  # a stream tells fewer
    assert found["requirements"] == whole["requirements"]


@pytest.mark.parametrize(
    ("at", "words"),
    [
        ("60", "there is no sample 60: the trace has 60"),
        ("9s", "there is no sample 90: the trace has 60"),
        ("2.55s", "has no sample at 2.55s"),
        ("noon", "`--at noon` is not an instant"),
        ("9" * 5000, "is not an instant"),
    ],
)
def test_instants_that_a_stream_does_not_have(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, at: str, words: str
) -> None:
    assert stream(monkeypatch, as_csv(a_trace()), "--at", at) == 2
    assert words in capsys.readouterr().err


def test_options_that_need_the_whole_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    assert stream(monkeypatch, "", "--out", "x.npz") == 2
    assert stream(monkeypatch, "", "--semantics", "agm") == 2
    assert check("-") == 2
    assert check("s.stl", "-", "other.npz") == 2


def test_a_stream_in_other_units_with_a_date_for_a_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [f"2026-01-31T12:00:{k / 10:06.3f}Z,{100 * 0.5:g},1" for k in range(60)]
    assert stream(monkeypatch, "\n".join(["timestamp,a [cm],on", *rows]), "-q") == 0
    rows = [f"{100 * k},{100 * 2.5:g},1" for k in range(60)]
    assert stream(monkeypatch, "\n".join(["time [ms];a [cm];on", *rows]).replace(",", ";"), "-q") == 1


def test_columns_of_a_stream_may_be_renamed(monkeypatch: pytest.MonkeyPatch) -> None:
    text = as_csv(a_trace()).replace("a [m]", "height")
    assert stream(monkeypatch, text, "-q") == 3
    assert stream(monkeypatch, text, "-q", "--map", "a=height") == 0
    assert stream(monkeypatch, text, "-q", "--map", "a=width") == 3


def test_of_thousands_of_violations_the_first_are_explained(tmp_path: Path, capsys) -> None:
    rules = "".join(f"require r{i}: x > {i}\n" for i in range(503))
    (tmp_path / "many.stl").write_text(f"spec many\nsignal x\n{rules}")
    (tmp_path / "many.csv").write_text("t,x\n0,-1\n0.1,-2\n")
    assert main(["check", str(tmp_path / "many.stl"), str(tmp_path / "many.csv")]) == 1
    said = capsys.readouterr().out
    assert said.count("= because:") == 500
    assert "3 more are violated; --require NAME says why." in said
