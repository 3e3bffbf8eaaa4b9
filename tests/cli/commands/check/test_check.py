"""`stlc check` from the outside: exit codes, texts, the document, and what it refuses."""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stlc.cli.commands.check.text import inconclusive
from stlc.cli.framework.app import main
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.trace import Trace, TraceMeta

ROOT = Path(__file__).parents[4]
GOLDEN = ROOT / "tests" / "golden" / "check"
SPEC = "specs/traffic.stl"
SAMPLES = 41


@pytest.fixture(autouse=True)
def _a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("specs/traffic.stl", "examples/car.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)


def drive(traces: int = 3, samples: int = SAMPLES) -> Trace:
    """Cars that wait before the junction, with nobody ahead: every requirement holds."""
    meta = TraceMeta("traffic", SPEC, Path(SPEC).read_text(encoding="utf-8"), run="r", seed=1, horizon=25)
    still = {"x": -3.0, "v": 0.0, "sign": 0.0, "tau": 2.0, "dx": 5.0, "v_lead": 0.0, "yielding": 1.0}
    data = {name: np.full((traces, samples), value) for name, value in still.items()}
    return Trace(Signature(tuple(map(Column, still))), 0.1, data, meta=meta)


def bad_drive(samples: int = SAMPLES) -> Trace:
    """The second car runs into the junction from 3 s on, to 0.27 m, although it has to give way."""
    trace = drive(samples=samples)
    trace.data["x"][1, 30:] = 0.27
    return trace


def saved(trace: Trace, name: str = "trace.npz") -> str:
    trace.save(name)
    return name


def check(*arguments: str) -> int:
    return main(["check", *arguments])


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict]:
    code = check(*arguments, "--json")
    out, err = capsys.readouterr()
    assert err == ""
    found = json.loads(out)
    assert found["schema"] == "check/1"
    assert found["exit_code"] == code
    assert found["ok"] is (code == 0)
    return code, found


# ------------------------------------------------------------------- answers and texts


def test_satisfied(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(saved(drive())) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "specs/traffic.stl on trace.npz    3 traces x 41 samples, dt 0.1 s" in out
    assert out.endswith("3 of 3 traces satisfy every requirement; 100 % of 48 starts\n")


def test_the_golden_text_of_a_violation(
    capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    assert check(saved(bad_drive())) == 1
    out = capsys.readouterr().out
    golden = GOLDEN / "give_way.txt"
    if request.config.getoption("--regenerate"):
        golden.write_text(out, encoding="utf-8")
    assert out == golden.read_text(encoding="utf-8")


def test_the_replay_says_how_the_trace_was_read(capsys: pytest.CaptureFixture[str]) -> None:
    Path("low.stl").write_text(
        "const top = 1\nsignal x\nsignal mode : Mode\nenum Mode { up, down }\n"
        "require low: always[0 s, 0.2 s] (mode == up -> x < top)\n"
    )
    Path("drive.csv").write_text("clock,height,mode,note\n0,1,up,a\n0.1,4,up,b\n0.2,9,down,c\n")
    words = ["check", "low.stl", "drive.csv", "--map", "t=clock", "--map", "x=height", "--set", "top=3"]
    assert main(words) == 1
    out = capsys.readouterr().out
    (replay,) = [line.split("replay: ")[1] for line in out.splitlines() if "replay: " in line]
    assert main(replay.split()[1:]) == 1
    assert "x = 4" in capsys.readouterr().out
    assert main([*words, "--chunk", "2"]) == 1
    capsys.readouterr()
    assert main([*words[:5], "--map", "mode=note"]) == 3
    assert "`note` in `drive.csv` cannot be `a`" in capsys.readouterr().err
    assert main(words[:5]) == 3
    assert "trace `drive.csv` has no signal `x`" in capsys.readouterr().err


def test_the_replay_shows_the_same_violation(capsys: pytest.CaptureFixture[str]) -> None:
    check(saved(bad_drive()))
    out = capsys.readouterr().out
    (replay,) = [line.split("replay: ")[1] for line in out.splitlines() if "replay: " in line]
    assert main(replay.split()[1:]) == 1
    again = capsys.readouterr().out
    assert "give_way" in again
    assert "no_collision" not in again
    assert "x = 0.27" in again


def test_inconclusive(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(saved(drive(samples=20))) == 4
    out = capsys.readouterr().out
    assert "give_way is inconclusive: it needs 2.5 s of signal, the trace has 1.9 s." in out
    assert "[-0.500, +2.500]" in out


def test_a_sample_that_is_not_read_leaves_nothing_open() -> None:
    monitor = Monitor("signal x, y\nrequire r: x > 0 or y > 0", dt=1)
    x, y = np.array([-1.0, np.nan]), np.array([np.nan, 1.0])
    verdict = monitor.check({"x": x, "y": y}).told()
    text = "r is inconclusive: `y` is unknown at 1 of 2 samples (t = 0 s)."
    assert inconclusive(verdict["r"], verdict) == text


def test_a_violation_outweighs_what_is_not_known() -> None:
    trace = drive(samples=20)
    trace.data["dx"][0, 5] = 0.5
    assert check(saved(trace), "-q") == 1


@pytest.mark.parametrize(("end", "code"), [("open", 4), ("truncate", 0), ("strict", 3)])
def test_ends(capsys: pytest.CaptureFixture[str], end: str, code: int) -> None:
    assert check(saved(drive(samples=20)), "--end", end) == code
    if end == "strict":
        err = capsys.readouterr().err
        assert "error[E306]: this needs 2.5 s of signal; the trace has 1.9 s" in err
        assert "`--end truncate`" in err


def test_one_trace_needs_no_numbers_of_traces(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(saved(drive(traces=1))) == 0
    out = capsys.readouterr().out
    assert "1 trace x 41 samples" in out
    assert "trace 0" not in out
    assert "satisfied; all requirements hold at 100 % of 16 starts" in out


def test_boundary(capsys: pytest.CaptureFixture[str]) -> None:
    trace = drive()
    trace.data["dx"][:] = 1.0
    assert check(saved(trace)) == 0
    assert "boundary" in capsys.readouterr().out
    assert check("trace.npz", "--tolerance", "0") == 1


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(saved(bad_drive()), "-q") == 1
    assert capsys.readouterr() == ("", "")


def test_several_traces_count_together(capsys: pytest.CaptureFixture[str]) -> None:
    good, bad, short = saved(drive(), "a.npz"), saved(bad_drive(), "b.npz"), saved(drive(samples=9), "c.npz")
    assert check(good, short) == 4
    assert check(good, short, bad) == 1
    out = capsys.readouterr().out
    assert all(f"on {name}" in out for name in (bad, short))
    assert f"on {good}" not in out
    assert out.endswith("violated; 1 of 3 files satisfy every requirement\n")
    code, found = document(capsys, good, bad)
    assert code == 1
    assert found["result"]["verdict"] == "violated"
    assert [entry["verdict"] for entry in found["result"]["files"]] == ["satisfied", "violated"]


# -------------------------------------------------------------------------- options


def test_one_requirement() -> None:
    path = saved(bad_drive())
    assert check(path, "-q", "--require", "no_collision", "--require", "stop_sign") == 0
    assert check(path, "-q", "--require", "give_way") == 1
    assert check(path, "--require", "give_why") == 2


@pytest.mark.parametrize(
    ("at", "code"), [("0", 0), ("4", 0), ("5", 1), ("0.5s", 1), ("0.4 s", 0), ("500ms", 1), ("all", 1)]
)
def test_at(at: str, code: int) -> None:
    assert check(saved(bad_drive()), "-q", "--at", at) == code


@pytest.mark.parametrize("at", ["x", "-1", "99", "9.9s", "0.55s", "1 m", "1.5", "1 q", "1" * 5000])
def test_instants_that_are_none(capsys: pytest.CaptureFixture[str], at: str) -> None:
    assert check(saved(drive()), f"--at={at}") == 2
    assert "error[U101]" in capsys.readouterr().err


@pytest.mark.parametrize(("least", "code"), [("0.7", 0), ("0.77", 0), ("0.78", 1), ("1", 1)])
def test_fail_under(least: str, code: int) -> None:
    assert check(saved(bad_drive()), "-q", "--fail-under", least) == code


def test_fail_under_of_what_is_not_known() -> None:
    assert check(saved(drive(samples=20)), "-q", "--fail-under", "0.5") == 4


def test_map(capsys: pytest.CaptureFixture[str]) -> None:
    trace = drive()
    path = saved(replace(trace.renamed({"gap": "dx"}), meta=trace.meta))
    assert check(path) == 3
    assert "trace `trace.npz` has no signal `dx`" in capsys.readouterr().err
    assert check(path, "-q", "--map", "dx=gap") == 0
    assert check(path, "--map", "dx=nothing") == 3
    assert check(path, "--map", "dx") == 2
    assert check(path, "--map", "dx=gap", "--map", "dx=x") == 2


@pytest.mark.parametrize(
    "option", [("--tolerance", "-1"), ("--tolerance", "nan"), ("--end", "never"), ("--at", "")]
)
def test_options_that_make_no_sense(option: tuple[str, str]) -> None:
    assert check(saved(drive()), *option) == 2


# ----------------------------------------------------------------- which trace, which spec


def test_the_trace_of_the_newest_run(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("runs/traffic/0001-quiet-heron")
    folder.mkdir(parents=True)
    (folder / "run.json").write_text("{}")
    Path("runs/latest").symlink_to("traffic/0001-quiet-heron")
    saved(drive(), str(folder / "trace.npz"))
    assert check("trace.npz") == 0
    out, err = capsys.readouterr()
    assert err == "taking runs/traffic/0001-quiet-heron/trace.npz, of the newest run\n"
    assert out.endswith("next: stlc report runs/traffic/0001-quiet-heron\n")
    saved(bad_drive())
    assert check("trace.npz", "-q") == 1


def test_a_trace_that_is_nowhere(capsys: pytest.CaptureFixture[str]) -> None:
    assert check("trace.npz") == 2
    assert "there is no trace `trace.npz`" in capsys.readouterr().err


@pytest.mark.parametrize("before", [True, False])
def test_another_specification(before: bool) -> None:
    Path("other.stl").write_text("signal x [m]\nrequire far: x < -100\n")
    path = saved(drive())
    arguments = ["other.stl", path] if before else [path, "--spec", "other.stl"]
    assert check("-q", *arguments) == 1


def test_a_specification_that_has_changed_since(capsys: pytest.CaptureFixture[str]) -> None:
    path = saved(bad_drive())
    Path(SPEC).write_text("signal x\nrequire r: x < 1\n")
    assert check(path) == 1
    assert f"{SPEC} has changed since" in capsys.readouterr().err
    assert check(path, "-q", "--spec", SPEC) == 0


def test_a_foreign_trace_needs_a_specification(capsys: pytest.CaptureFixture[str]) -> None:
    path = saved(replace(drive(), meta=TraceMeta()), "foreign.csv")
    assert check(path) == 2
    assert "carries no specification" in capsys.readouterr().err
    assert check(SPEC, path) == 0
    assert check(SPEC) == 2
    assert check(SPEC, SPEC, path) == 2


def test_a_system_is_checked_too() -> None:
    path = saved(drive())
    assert check(path, "-q", "--system", "car.yaml") == 0
    assert check(path, "--system", "lorry.yaml") == 2
    Path("small.yaml").write_text(Path("examples/car.yaml").read_text().replace("  dx: ", "  gap: "))
    assert check(path, "--system", "small.yaml") == 3


# ------------------------------------------------------------------------ the document


def test_the_document(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = document(capsys, saved(bad_drive()))
    assert code == 1
    result = found["result"]
    assert (result["traces"], result["satisfied_traces"], result["verdict"]) == (3, 2, "violated")
    assert result["horizon"] == {"seconds": 2.5, "steps": 25}
    give_way = {entry["name"]: entry for entry in result["requirements"]}["give_way"]
    assert give_way["tags"] == ["safety"]
    assert give_way["robustness"]["min"] == -0.5
    assert give_way["robustness"]["argmin"] == {"trace": 1, "start": 0.5, "time": 0.5}
    cause = give_way["cause"]
    assert (cause["signal"], cause["value"], cause["predicate"]) == ("sign", 0.0, "sign == stop")
    assert cause["span"]["line"] == 33
    assert "before_junction means" in cause["because"]


def test_infinite_numbers_are_texts(capsys: pytest.CaptureFixture[str]) -> None:
    Path("other.stl").write_text("signal dx [m]\nrequire far: always[0 s, 9 s] dx > 1 m\n")
    code, found = document(capsys, "other.stl", saved(drive(samples=20)))
    assert code == 4
    far = found["result"]["requirements"][0]["robustness"]
    assert (far["min"], far["low"], far["high"]) == ("nan", "-inf", 4.0)


@pytest.mark.parametrize("arguments", [("nowhere.npz",), ("trace.npz", "--at", "x"), ("--what",)])
def test_failures_are_documents_too(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]) -> None:
    saved(drive())
    code, found = document(capsys, *arguments)
    assert code == 2
    assert found["diagnostics"][0]["code"].startswith("U")
    assert found["result"] is None


# ----------------------------------------------------------------------- hostile traces


def without(name: str) -> Trace:
    trace = drive()
    columns = tuple(column for column in trace.signature.columns if column.name != name)
    return replace(
        trace,
        signature=Signature(columns),
        data={key: values for key, values in trace.data.items() if key != name},
    )


def truncated() -> None:
    saved(drive())
    Path("trace.npz").write_bytes(Path("trace.npz").read_bytes()[:-200])


def with_a_pickle() -> None:
    columns = {name: values.astype(object) for name, values in drive().data.items()}
    np.savez("trace.npz", t=np.arange(SAMPLES) * 0.1, **columns)


def a_bare_pickle() -> None:
    Path("trace.npz").write_bytes(pickle.dumps({"x": 1}))


HOSTILE: dict[str, tuple[Callable[[], object], str, str]] = {
    "missing": (lambda: saved(without("dx")), "E601", "needed by: no_collision"),
    "truncated": (truncated, "E603", "damaged or cut short"),
    "objects": (with_a_pickle, "E603", "Python objects"),
    "pickle": (a_bare_pickle, "E603", "it is a pickle"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_traces(capsys: pytest.CaptureFixture[str], name: str) -> None:
    make, code, words = HOSTILE[name]
    make()
    assert check(SPEC, "trace.npz") == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert f"error[{code}]" in err
    assert words in err
    assert "Traceback" not in err


def test_a_specification_with_errors(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.stl").write_text("signal x [m]\nsignal v [m/s]\nrequire a: x < v\nrequire b: w > 1\n")
    assert check("bad.stl", saved(drive())) == 3
    err = capsys.readouterr().err
    assert "E203" in err
    assert "E101" in err


@pytest.mark.apart
def test_torch_is_not_imported() -> None:
    saved(bad_drive())
    code = (
        "import sys\n"
        "from stlc.cli.framework.app import main\n"
        "assert main(['check', 'trace.npz']) == 1\n"
        "assert 'torch' not in sys.modules and 'yaml' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_the_mean_of_huge_margins_is_a_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "huge.stl").write_text("spec huge\nsignal x\nrequire r: x > 0\n")
    (tmp_path / "huge.csv").write_text("t,x\n0,1.5e308\n0.1,1.5e308\n")
    assert (
        main(["check", str(tmp_path / "huge.stl"), str(tmp_path / "huge.csv"), "--at", "all", "--json"]) == 0
    )
    (found,) = json.loads(capsys.readouterr().out)["result"]["requirements"]
    assert found["robustness"]["mean"] == pytest.approx(1.5e308)


def test_a_robustness_of_several_units_has_no_unit(tmp_path, capsys):
    spec, path = tmp_path / "s.stl", tmp_path / "t.csv"
    path.write_text("t,p,w\n0,1,1\n1,2,0\n")
    signals, both = "signal p [W]\nsignal w [rad/s]\n", "require a: always (p < 3 W and w < 2 rad/s)\n"
    spec.write_text(f"{signals}{both}require b: always p < 3 W\n")
    assert main(["check", str(spec), str(path)]) == 0
    rows = capsys.readouterr().out
    assert re.search(r"a +satisfied +\+1\.000\n", rows)
    assert re.search(r"b +satisfied +\+1\.000 W\n", rows)


def test_what_is_violated_is_red_on_a_terminal_alone(monkeypatch, capsys):
    monkeypatch.chdir(ROOT / "examples/recording")
    assert main(["check", "tank.stl", "tank.csv", "--color", "always"]) == 1
    colored = capsys.readouterr().out
    assert "  filled       \x1b[1;31mVIOLATED\x1b[0m     -0.091 m" in colored
    assert "no_overflow  satisfied" in colored
    assert main(["check", "tank.stl", "tank.csv"]) == 1
    plain = capsys.readouterr().out
    assert "\x1b" not in plain
    assert re.sub(r"\x1b\[[\d;]*m", "", colored) == plain
