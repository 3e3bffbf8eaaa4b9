"""Commands for writing specifications: their changes of files, and their output."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.cli.framework.watch import watch
from stlc.dynamics.load import load_system_decl
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir

ROOT = Path(__file__).resolve().parents[2]
SPEC = "signal x [m]\nrequire low: G[0 s, 1 s] x < 3 m && always x > 0 m\n"
FORMATTED = "signal x [m]\nrequire low: (always[0 s, 1 s] x < 3 m) and always x > 0 m\n"


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.stl").write_text(SPEC)


# ---------------------------------------------------------------------- fmt, lint, parse


@pytest.mark.parametrize(("name", "spec"), [("car", "traffic"), ("patrol", "patrol")])
def test_a_project_may_begin_with_an_installed_example(name, spec, capsys):
    assert main(["init", "mine", "--example", name]) == 0
    out, err = capsys.readouterr()
    assert f"mine/specs/{spec}.stl" in out.splitlines()
    assert f"next: cd mine && stlc train specs/{spec}.stl" in err
    assert main(["compile", f"mine/specs/{spec}.stl"]) == 0
    assert "system mine/systems/" in capsys.readouterr().err
    for path in Path("mine").rglob("*.yaml"):
        assert main(["system", "check", str(path), "--steps", "0"]) == 0
    assert main(["init", "other", "--example", "cra"]) == 2
    assert "did you mean `car`?" in capsys.readouterr().err


def test_a_warning_of_a_system_is_said_once(capsys):
    Path("tank.yaml").write_text(
        "stlc: 1\nname: tank\ntime: {dt: 1 s, horizon: 9 steps}\nconst: {top: 2 m}\n"
        "state: {x: {range: [0, top]}}\ncontrol: {u: {range: [0, 1]}}\nflow: {x: u}\n"
        "init: {mixture: [{draw: {x: 1}}]}\n"
    )
    assert main(["system", "check", "tank.yaml", "--steps", "2"]) == 0
    assert capsys.readouterr().err.count("W108") == 1


def test_fmt_writes_in_place(capsys):
    assert main(["fmt", "a.stl"]) == 0
    assert Path("a.stl").read_text() == FORMATTED
    assert "changed a.stl" in capsys.readouterr().err
    assert main(["fmt", "a.stl"]) == 0
    assert "1 file left as it is" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--check", "--diff"])
def test_a_dry_fmt_writes_nothing(option, capsys):
    assert main(["fmt", "a.stl", option]) == 1
    assert Path("a.stl").read_text() == SPEC
    out = capsys.readouterr().out
    if option == "--diff":
        assert "-require low: G" in out
        assert "+require low: (always" in out


def test_a_folder_stands_for_its_specifications(capsys):
    Path("deep/.hidden").mkdir(parents=True)
    Path("deep/b.stlc").write_text(FORMATTED)
    Path("deep/.hidden/c.stl").write_text("nonsense")
    assert main(["fmt", ".", "--check", "--json"]) == 1
    result = json.loads(capsys.readouterr().out)["result"]
    assert result == {"files": ["a.stl", "deep/b.stlc"], "changed": ["a.stl"], "written": False}
    Path("empty").mkdir()
    assert main(["lint", "empty"]) == 2


def test_one_unreadable_file_does_not_keep_others_from_being_formatted(capsys):
    Path("b.stl").write_text("require")
    assert main(["fmt", "b.stl", "a.stl"]) == 3
    assert Path("a.stl").read_text() == FORMATTED
    assert "error[E010]" in capsys.readouterr().err


def test_lint_repairs(capsys):
    assert main(["lint", "a.stl"]) == 0
    said = capsys.readouterr()
    assert "warning[W106]" in said.out
    assert "3 warnings in 1 file; 3 can be repaired: stlc lint --fix" in said.err
    assert main(["lint", "a.stl", "--fix"]) == 0
    assert "fixed 3 findings; 1 file, nothing to say" in capsys.readouterr().err
    assert Path("a.stl").read_text() == FORMATTED


def test_annotations_for_github(capsys):
    assert main(["lint", "a.stl", "--format", "github"]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    place = "file=a.stl,line=2,endLine=2,col=14,endColumn=15"
    assert first == f"::warning title=W106,{place}::`G` is spelled `always` here"


def test_sarif(capsys):
    assert main(["lint", "a.stl", "--format", "sarif"]) == 0
    log = json.loads(capsys.readouterr().out)
    (run,) = log["runs"]
    assert log["version"] == "2.1.0"
    assert [rule["id"] for rule in run["tool"]["driver"]["rules"]] == ["W106", "W301"]
    region = run["results"][0]["locations"][0]["physicalLocation"]["region"]
    assert region == {"startLine": 2, "startColumn": 14, "endLine": 2, "endColumn": 15}
    assert all(run["tool"]["driver"]["rules"][r["ruleIndex"]]["id"] == r["ruleId"] for r in run["results"])


@pytest.mark.parametrize("layout", ["ast", "json", "dot"])
def test_trees(layout, capsys):
    words = ["--show", "ast", "--json"] if layout == "json" else ["--show", layout]
    assert main(["compile", "a.stl", *words]) == 0
    out = capsys.readouterr().out
    match layout:
        case "ast":
            assert out.splitlines()[:2] == ["Spec", "  Signal x unit=m"]
            assert "      Temporal always alias=G" in out
        case "json":
            tree = json.loads(out)["result"]["tree"]
            assert [item["node"] for item in tree["items"]] == ["Signal", "Require"]
            assert tree["items"][1]["line"] == 2
        case "dot":
            assert out.startswith("digraph stlc {")
            assert out.count(" -> ") == out.count("label=") - 1


def test_a_deep_tree(capsys):
    text = "not " * 140
    Path("deep.stl").write_text(f"signal x [m]\nrequire deep: {text}x > 0 m\n")
    for words in (["ast"], ["dot"], ["ast", "--json"]):
        assert main(["compile", "deep.stl", "--show", *words]) == 0
    assert main(["fmt", "deep.stl"]) == 0
    assert main(["explain", "deep.stl"]) == 0
    assert capsys.readouterr().out


def test_watching(monkeypatch, capsys):
    rounds = []
    monkeypatch.setattr("stlc.cli.framework.watch.PERIOD", 0.0)

    def action():
        rounds.append(Path("a.stl").read_text())
        if len(rounds) == 1:
            Path("a.stl").write_text(FORMATTED)
            os.utime("a.stl", ns=(1, 1))

    watch(["a.stl"], action, rounds=4)
    assert rounds == [SPEC, FORMATTED]
    assert "watching a.stl" in capsys.readouterr().err


def test_lint_watches(monkeypatch, capsys):
    monkeypatch.setattr("stlc.cli.framework.watch.watch", lambda files, action: [action() for _ in files])
    assert main(["lint", "a.stl", "--watch", "--strict"]) == 0
    assert "warning[W106]" in capsys.readouterr().out


# ---------------------------------------------------------------------- init, system


def test_a_project_is_valid_and_formatted(capsys):
    assert main(["init", "mine"]) == 0
    listed = capsys.readouterr().out.split()
    assert "mine/specs/cart.stl" in listed
    assert all(Path(name).is_file() for name in listed)
    assert main(["lint", "mine/specs", "--strict", "--system", "mine/systems/cart.yaml"]) == 0
    assert main(["fmt", "mine/specs", "--check"]) == 0
    assert main(["compile", "mine/specs/cart.stl"]) == 0
    json.loads(Path("mine/.vscode/settings.json").read_text())


def test_nothing_is_overwritten(capsys):
    assert main(["init", "--spec", "parking"]) == 0
    text = Path("parking.stl").read_text()
    assert main(["init", "--spec", "parking"]) == 2
    assert "parking.stl is there already" in capsys.readouterr().err
    assert Path("parking.stl").read_text() == text
    assert main(["init", "--spec", "parking", "--force"]) == 0


@pytest.mark.parametrize("arguments", [[], ["--from", "systems/wagon.yaml"], ["--from", "car"]])
def test_a_new_specification_is_valid(arguments, capsys):
    for folder in ("specs", "systems", "examples"):
        Path(folder).mkdir()
    (Path("examples") / "car.yaml").write_text((ROOT / "examples/car.yaml").read_text())
    assert main(["init", "--system", "wagon"]) == 0
    assert main(["init", "--spec", "parking", *arguments]) == 0
    path = Path("specs/parking.stl")
    assert main(["fmt", str(path), "--check"]) == 0
    system = ["--system", arguments[1]] if arguments else []
    assert main(["lint", str(path), "--strict", *system]) == 0, capsys.readouterr().out
    spec = Spec.parse(File(path).read())
    assert spec.name == "parking"
    if arguments:
        decl = load_system_decl(Path("specs") / str(spec.system))
        declared = {item.name for item in spec.items if type(item).__name__ == "Signal"}
        assert declared == set(decl.signature.names)


def test_systems_are_listed(capsys):
    main(["init"])
    Path("systems/broken.yaml").write_text("stlc: 1\n")
    capsys.readouterr()
    assert main(["system", "list"]) == 0
    out = capsys.readouterr().out
    assert "A cart on a rail" in out
    assert "invalid: S102" in out


# ---------------------------------------------------------------------- runs


def make_run(spec: str, words: str, **facts: object) -> RunDir:
    run = RunDir.create(Path("runs"), spec, words)
    run.update({"status": "finished", "spec": spec, "seed": 0, **facts})
    return run


@pytest.mark.parametrize("name", ["", ".", "/"])
@pytest.mark.parametrize("kind", ["--spec", "--system"])
def test_a_file_without_a_name_is_a_usage_error(kind, name, capsys):
    assert main(["init", kind, name]) == 2
    assert "cannot be a name" in capsys.readouterr().err


def test_runs_are_listed_sorted_and_compared(capsys):
    make_run("cart", "good", started="2026-01-01", result={"accuracy": 0.9, "seconds": 10.0})
    make_run("cart", "bad", started="2026-01-02", result={"accuracy": 0.2, "seconds": 10.0}, seed=3)
    broken = make_run("boat", "torn")
    (broken.path / "run.json").write_text("{")
    assert main(["runs", "list", "--sort", "acc", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["result"]["runs"]
    assert [row["run"] for row in rows] == ["boat/0001-torn", "cart/0002-bad", "cart/0001-good"]
    assert rows[0]["status"] == "damaged"
    assert main(["runs"]) == 0
    assert "0.9000" in capsys.readouterr().out
    assert main(["runs", "diff", "good", "bad", "--json"]) == 1
    facts = {fact["key"]: fact["values"] for fact in json.loads(capsys.readouterr().out)["result"]["facts"]}
    assert facts == {"seed": ["0", "3"], "result.accuracy": ["0.9", "0.2"]}


@pytest.mark.parametrize("value", ["NaN", "1e999", "1" + "0" * 400, '"x"'])
def test_a_result_that_is_no_finite_number_is_left_out(value, capsys):
    make_run("cart", "good", result={"accuracy": 0.5, "seconds": 1.0})
    odd = make_run("cart", "odd")
    (odd.path / "run.json").write_text(f'{{"result": {{"accuracy": {value}, "seconds": {value}}}}}')
    assert main(["runs", "list", "--sort", "acc"]) == 0
    capsys.readouterr()
    assert main(["runs", "list", "--sort", "acc", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["result"]["runs"]
    assert [row["accuracy"] for row in rows] == [None, 0.5]


def test_an_interrupted_run_tells_its_steps_from_those_that_were_planned(capsys):
    make_run("cart", "whole", steps=300)
    stopped = make_run("cart", "stopped", steps=7500, status="interrupted")
    (stopped.path / "train.jsonl").write_text('{"step": 0}\n{"step": 120}\n')
    assert main(["runs", "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if "cart/" in line}
    assert lines["cart/0002-stopped"].rstrip().endswith(" 120 of 7500")
    assert lines["cart/0001-whole"].split()[-1] == "300"


def test_the_links_follow_when_a_run_is_removed(capsys):
    make_run("cart", "first")
    make_run("cart", "second")
    assert main(["runs", "rm", "second"]) == 0
    assert RunDir.newest().name == "0001-first"
    assert Path("runs/cart/latest").readlink() == Path("0001-first")
    assert main(["runs", "rm", "first"]) == 0
    assert not Path("runs/latest").is_symlink()
    assert main(["runs"]) == 0
    assert "there is no run" in capsys.readouterr().err


def test_a_run_that_is_going_needs_force():
    make_run("cart", "busy", status="running")
    assert main(["runs", "rm", "busy"]) == 2
    assert main(["runs", "rm", "busy", "--force"]) == 0
    assert not list(Path("runs/cart").glob("0*"))


def test_a_damaged_run_needs_force():
    damaged = make_run("cart", "torn")
    (damaged.path / "run.json").write_text("{")
    assert main(["runs", "rm", "torn"]) == 3
    assert main(["runs", "rm", "torn", "--force"]) == 0
    assert not damaged.path.exists()
    Path("folder").mkdir()
    assert main(["runs", "rm", "folder", "--force"]) == 3
    assert Path("folder").exists()


def test_a_run_that_is_named_twice_is_removed_once(capsys):
    folder = make_run("cart", "first").path
    assert main(["runs", "rm", "1", "first", str(folder)]) == 0
    assert capsys.readouterr().err.count("removed") == 1
    assert not folder.exists()


# ---------------------------------------------------------------------- explain, plot


def test_a_violation_is_traced_back(capsys):
    Path("drive.csv").write_text("t,x\n0,1\n0.5,4\n1,1\n")
    assert main(["explain", "drive.csv", "--spec", "a.stl"]) == 1
    out = capsys.readouterr().out
    assert "low is violated" in out
    last = out.splitlines()[-1]
    assert last.strip().startswith("x < 3 m    is false at t = 0.5 s, x = 4 m")


@pytest.mark.parametrize("suffix", [".svg", ".png", ".pdf"])
def test_a_picture(suffix, capsys):
    Path("drive.csv").write_text("t,x\n0,1\n0.5,4\n1,1\n")
    assert main(["plot", "drive.csv", "--spec", "a.stl", "-o", f"out{suffix}", "--trace", "0"]) == 0
    assert Path(f"out{suffix}").stat().st_size > 1000
    assert main(["plot", "drive.csv", "--spec", "a.stl", "--trace", "3"]) == 2
    assert main(["plot", "drive.csv", "--spec", "a.stl", "-o", "out.doc"]) == 2
    assert main(["plot", "drive.csv", "--spec", "a.stl", "--require", "lov"]) == 2
    assert "did you mean `low`" in capsys.readouterr().err
