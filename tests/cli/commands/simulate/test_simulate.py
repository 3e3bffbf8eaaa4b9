from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers.documents import misfits
from helpers.other_guard import PACKAGES, write_guard

from stlc.cli.commands.schema import load_schema
from stlc.cli.commands.simulate.text import screen
from stlc.cli.framework.app import main
from stlc.controller.deployment.batched import Worlds
from stlc.dynamics.scenario import DISTURBED
from stlc.monitor.verdict import Monitor
from stlc.rundir import RunDir
from stlc.trace import Trace

ROOT = Path(__file__).parents[4]
SCENARIO = "scenario: {slippery: {expect: ood, doc: wet leaves, model_mismatch: {vmax: 9 m/s}}}\n"
SMALL = ["--seeds", "0..1", "--agents", "4", "--steps", "6", "--no-pictures"]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a run has been trained for a moment."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        spec, system = ROOT / "specs/traffic.stl", folder / "car.yaml"
        text = (ROOT / "examples/car.yaml").read_text().replace("../specs", str(ROOT / "specs"))
        system.write_text(text + SCENARIO)
        (folder / "traffic_grid.py").write_text((ROOT / "examples/traffic_grid.py").read_text())
        command = ["train", str(spec), "--system", str(system), "--steps", "5"]
        assert main([*command, "--batch", "64", "--held-out", "100", "--no-pictures"]) == 0
    return folder


@pytest.fixture
def there(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunDir:
    monkeypatch.chdir(home)
    capsys.readouterr()
    return RunDir.newest()


@pytest.mark.apart
def test_the_newest_run_is_simulated_with_and_without_guard(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "--backup", *SMALL, "--steps", "16", "--record", "trace.npz"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"run {there.name}" in lines[0]
    assert "world traffic_grid.py" in lines[0]
    assert "2 seeds x 4 agents x 16 steps" in lines[0]
    assert lines[1] == ""
    document = there.read_json("eval/simulate.json")
    drives = {name: guard["drives"] for name, guard in document["guards"].items()}
    told = f"  {drives['paper']['obeyed']} of 8 drives satisfied driving_rules; without the guard "
    assert lines[2] == f"{told}{drives['none']['obeyed']}"
    assert ["no", "guard", "paper's", "guard"] in [line.split() for line in lines]
    (rule,) = (line for line in lines if line.strip().startswith("red_light"))
    each = [f"{found['rules']['red_light']['obeyed']} of 8" for found in drives.values()]
    assert rule.split() == ["red_light", *" ".join(each).split()]
    assert not any("plan accuracy" in line for line in lines)
    assert any(line.strip().startswith("mean speed") and "m/s" in line for line in lines)
    assert any("guard acted in" in line for line in lines)
    assert lines[-1].split(maxsplit=1) == ["next", "stlc check trace.npz"]
    for path in (Path("trace.npz"), there.path / "trace.npz"):
        trace = Trace.load(path)
        assert (trace.traces, trace.samples) == (8, 17)
        assert trace.meta.run == there.name
    document = there.read_json("eval/simulate.json")
    assert set(document["guards"]) == {"none", "paper"}
    assert document["seeds"] == [0, 1]
    assert (there.path / "scene.npz").exists()


@pytest.mark.apart
def test_a_trace_is_judged_by_the_constants_it_was_driven_with(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    many = ["--seeds", "0", "--agents", "20", "--steps", "50", "--no-pictures", "--json"]
    assert main(["simulate", *many, "--set", "x_inter=-19 m", "--set", "vmax=9"]) == 0
    guard = json.loads(capsys.readouterr().out)["result"]["guards"]["none"]
    windows, driven = (
        guard["metrics"]["holds.give_way"]["mean"],
        guard["drives"]["rules"]["give_way"]["obeyed"] / 20,
    )
    trace = str(there.path / "trace.npz")
    meta = Trace.load(Path(trace)).meta
    assert meta.spec_set == meta.judge_set == {"x_inter": "-19 m"}  # the other is the system's

    def share(*options: str) -> float:
        main(["check", trace, "--json", *options])
        requirements = json.loads(capsys.readouterr().out)["result"]["requirements"]
        return next(float(r["satisfied_share"]) for r in requirements if r["name"] == "give_way")

    assert driven < 1.0
    assert share() == pytest.approx(driven)
    assert share("--set", "x_inter=19 m") > driven
    assert share("--spec", str(ROOT / "specs/driving_rules.stl")) > driven
    assert share("--spec", str(ROOT / "specs/traffic.stl"), "--set", "x_inter=-19 m") == pytest.approx(
        windows
    )
    main(["check", trace])
    assert "with x_inter = -19 m, as it was recorded" in capsys.readouterr().err


def test_windows_are_shown_where_they_are_asked_for(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", there.name, *SMALL, "--steps", "16", "--windows"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.strip().startswith("plan accuracy") and "±" in line for line in lines)
    assert any("driven safely" in line for line in lines)


def test_safety_is_spoken_of_only_where_something_is_tagged(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", there.name, *SMALL, "--steps", "16", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["safety"]
    assert any("safely" in line for line in screen(result, windows=True))
    assert not any("plan safety" in line for line in screen(result | {"safety": []}, windows=True))


def test_without_rules_drives_are_judged_as_plans_are(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", there.name, *SMALL, "--steps", "30", "--set", "test.judge=null"]
    assert main(command) == 0
    assert "of 8 drives satisfied traffic at every instant\n" in capsys.readouterr().out
    assert Trace.load(there.path / "trace.npz").meta.judge_text == ""
    assert main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("simulate/1")) == []
    result = document["result"]
    assert result["judge"] is None
    drives, metrics = (result["guards"]["none"][name] for name in ("drives", "metrics"))
    assert drives["obeyed"] / 8 == metrics["executed"]["mean"]
    assert set(drives["rules"]) == {"no_collision", "stop_sign", "give_way", "red_light"}


def test_what_was_driven_is_checked_by_the_rules_that_travel_with_it(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", there.name, *SMALL, "--steps", "16", "--json"]) == 0
    drives = json.loads(capsys.readouterr().out)["result"]["guards"]["none"]["drives"]
    obeyed = drives["obeyed"] == drives["count"] == 8
    assert main(["check", str(there.path / "trace.npz"), "--json"]) == (0 if obeyed else 1)
    result = json.loads(capsys.readouterr().out)["result"]
    assert {each["name"] for each in result["requirements"]} == set(drives["rules"])
    main(["check", str(ROOT / "specs/traffic.stl"), str(there.path / "trace.npz"), "--json"])
    windows = json.loads(capsys.readouterr().out)["result"]
    assert "stop_sign" in {each["name"] for each in windows["requirements"]}


def test_without_backup_nothing_is_guarded(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", there.name, *SMALL, "--seeds", "5..6", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "simulate/1"
    assert misfits(document, load_schema("simulate/1")) == []
    assert document["ok"] is True
    result = document["result"]
    assert set(result["guards"]) == {"none"}
    assert result["seeds"] == [5, 6]
    assert result["guards"]["none"]["decisions"]["policy"] == 1.0


def test_the_same_seed_gives_the_same_trace(there: RunDir) -> None:
    found = []
    for name in ("a.npz", "b.npz"):
        assert main(["simulate", "--guard", "paper", *SMALL, "--record", name]) == 0
        found.append(Trace.load(there.path.parents[2] / name))
    assert all((found[0].data[signal] == found[1].data[signal]).all() for signal in found[0].data)


def test_the_papers_guard_is_hurried_only_where_that_is_asked_for(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(*words: str) -> dict[str, Any]:
        assert main(["simulate", there.name, *SMALL, "--guard", "paper", *words, "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert misfits(document, load_schema("simulate/1")) == []
        result: dict[str, Any] = document["result"]
        return result

    calm, hurried = told(), told("--time-limit", "0.001ms")
    assert (calm["time_limit"], calm["paper_time_limit"]) == (0.1, None)
    assert hurried["paper_time_limit"] == pytest.approx(1e-6)
    decided = hurried["guards"]["paper"]["decisions"]
    assert {rule for rule, share in decided.items() if share and "T0" in rule} == {"backup T0=1"}


def test_the_full_guard_is_shown_beside_none(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", there.name, *SMALL, "--guard", "full", "--time-limit", "none", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("simulate/1")) == []
    guards = document["result"]["guards"]
    assert list(guards) == ["none", "full"]
    assert document["result"]["time_limit"] is None
    accuracy = [guard["metrics"]["plan_accuracy"]["mean"] for guard in guards.values()]
    assert accuracy[1] > accuracy[0]
    assert guards["full"]["decisions"]["polished"] > 0.0


def test_all_scenarios_are_driven_and_compared(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    spec = str(ROOT / "specs/traffic.stl")
    assert main(["simulate", spec, "--backup", "--scenario", "all", *SMALL]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"run {there.name}" in lines[0]
    assert "scenario" not in lines[0]
    rows = [line.split() for line in lines]
    (header,) = (row for row in rows if row[:1] == ["scenario"])
    assert header.count("guard:") == 2
    assert {row[0] for row in rows if len(row) > 5} >= {"none", "slippery"}
    assert main(["simulate", spec, "--scenario", "all", *SMALL, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("simulate/1")) == []
    (found,) = document["result"]["scenarios"].items()
    assert (found[0], found[1]["doc"], found[1]["expect"]) == ("slippery", "wet leaves", "ood")
    assert found[1]["guards"] != document["result"]["guards"]
    assert there.read_json("eval/simulate.json")["scenario"] is None


@pytest.mark.apart
def test_margins_are_measured_and_what_is_wrong_is_told(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", *SMALL, "--scenario", "mismatch-20", "--guard", "full", "--margin", "auto"]
    assert main([*command, "--margin", "give_way=0.25"]) == 0
    text = capsys.readouterr().out
    assert "wrong: gains of actuators by 20 %" in text
    assert "numbers of the dynamics" not in text  # a car has none
    told = there.read_json("eval/simulate.json")
    assert told["margin"]["give_way"] == 0.25
    assert set(told["margin"]) <= {"no_collision", "give_way", "red_light"}
    assert 0.0 < told["margin"]["red_light"] < 3.0
    assert f"give_way 0.25, red_light {told['margin']['red_light']:.3g}" in text
    assert told["errors"] == {
        "actuator_gain": 0.2,
        "parameters": 0.2,
        "numbers": [],
        "exact": ["T_total", "x_stop"],
    }
    assert main([*command, "--json"]) == 0
    assert misfits(json.loads(capsys.readouterr().out), load_schema("simulate/1")) == []


@pytest.mark.usefixtures("there")
def test_fail_under_is_the_share_of_drives_that_satisfy_everything(
    capsys: pytest.CaptureFixture[str],
) -> None:
    many = ["--seeds", "0", "--agents", "10", "--steps", "60", "--no-pictures"]
    assert main(["simulate", *many, "--json", "--fail-under", "1"]) == 1
    drives = json.loads(capsys.readouterr().out)["result"]["guards"]["none"]["drives"]
    share = drives["obeyed"] / drives["count"]
    assert 0.0 < share < 1.0
    assert main(["simulate", *many, "--fail-under", str(share)]) == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--guard", "fuller"], "unknown guard `fuller`"),
        (["--guard", "full", "--time-limit", "soon"], "not a duration"),
        (["--backup", "--guard", "none"], "contradict"),
        (["--no-backup", "--guard", "paper"], "contradict"),
        (["0099"], "0099"),
        (["--robustness", "-", "--json"], "both want the standard output"),
        (["--robustness", "nowhere/m.jsonl"], "cannot write"),
        (["--scenario", "mismatch-200"], "every system has mismatch-5"),
        (["--scenario", "storm"], "what counts is the system that the run stores: add it to "),
        (["--margin", "wide"], "`wide` is no margin"),
        (["--guard", "full", "--margin", "gap=1"], "safety requirements: no_collision, give_way, red_light"),
        (["--agents", "63"], "63 cars"),
        (["--seeds", "0..-1"], "seeds"),
    ],
)
@pytest.mark.usefixtures("there")
def test_what_cannot_be_done_is_said(
    capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    rest = [] if "--agents" in options or "--seeds" in options else SMALL
    code = main(["simulate", *options, *rest])
    captured = capsys.readouterr()
    assert code == {"63 cars": 3, "cannot write": 5}.get(said, 2)
    assert said in captured.err + captured.out
    assert "Traceback" not in captured.err


def test_a_world_that_fails_on_the_way_leaves_a_trace(
    there: RunDir, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    world = there.path / "traffic_grid.py"
    text = world.read_text()
    broken = text.replace(
        "        self.clock += 1\n", "        self.clock += 1\n        1 / (5 - self.clock)\n"
    )
    assert broken != text
    world.write_text(broken)
    try:
        code = main(["simulate", *SMALL, "--record", str(tmp_path / "t.npz")])
    finally:
        world.write_text(text)
    error = capsys.readouterr().err
    assert code == 3
    assert "S207" in error
    assert "the first 4 steps" in error
    assert Trace.load(tmp_path / "t.npz").samples == 5


def test_margins_come_as_json_lines(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    """One object an agent and step, whose statuses at the end are those of `stlc check`."""
    options = [*SMALL, "--steps", "16", "--backup", "--robustness", "m.jsonl", "--live"]
    assert main(["simulate", there.name, *options]) == 0
    captured = capsys.readouterr()
    assert "step 16 / 16" in captured.err
    lines = [json.loads(line) for line in Path("m.jsonl").read_text().splitlines()]
    assert len(lines) == 17 * 8
    wanted = load_schema("robustness-line")
    assert [misfits(line, wanted) for line in lines] == [[]] * len(lines)
    assert [(line["step"], line["seed"], line["agent"]) for line in lines] == [
        (step, seed, agent) for step in range(17) for seed in (0, 1) for agent in range(4)
    ]
    trace = Trace.load(there.path / "trace.npz")
    decided = [["policy", "backup", "safest"].index(line["decided"].split()[0]) for line in lines[:-8]]
    assert decided == trace.extras["decision"].T.flatten().tolist()
    assert [line["plan_rho"] for line in lines[:-8]] == trace.extras["plan_rho"].T.flatten().tolist()
    assert lines[-1]["decided"] is lines[-1]["plan_rho"] is None
    verdict = Monitor(there.path / "spec.stl", system=there.path / "system.yaml").check(trace)
    for judgement in verdict:  # starts whose window has closed by the end
        fails = judgement.fails.sum(0).tolist()
        told = [line["margins"][judgement.name]["violated"] for line in lines[-8:]]
        assert all(later >= sooner for later, sooner in zip(told, fails, strict=True))


def test_margins_may_be_the_standard_output(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", there.name, *SMALL, "--robustness", "-"]) == 0
    captured = capsys.readouterr()
    assert [json.loads(line)["step"] for line in captured.out.splitlines()][::8] == list(range(7))
    assert "of 8 drives satisfied driving_rules" in captured.err


@pytest.mark.slow
def test_the_disturbed_scenarios_of_every_system(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", there.name, *SMALL, "--scenario", "disturbed", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("simulate/1")) == []
    assert list(document["result"]["scenarios"]) == list(DISTURBED)
    assert main(["simulate", there.name, *SMALL, "--scenario", "mismatch-15", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["scenario"] == "mismatch-15"


@pytest.mark.usefixtures("there")
def test_an_interruption_leaves_the_trace_and_the_margins(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C, in the midst of a step."""
    real = Worlds.progress

    def interrupted(worlds: Worlds) -> object:
        if worlds.worlds[0].clock == 3:  # type: ignore[attr-defined]
            signal.raise_signal(signal.SIGINT)
        return real(worlds)

    monkeypatch.setattr(Worlds, "progress", interrupted)
    assert main(["simulate", *SMALL, "--live", "--robustness", "m.jsonl", "--record", "t.npz"]) == 130
    assert "the first 3 steps are in" in capsys.readouterr().err
    assert Trace.load("t.npz").samples == 4
    assert len(Path("m.jsonl").read_text().splitlines()) == 3 * 8
    assert main(["check", "t.npz"]) in (0, 1, 4)


@pytest.mark.usefixtures("there")
def test_an_interruption_while_it_is_judged_keeps_everything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "stlc.controller.evaluation.deployment.judge_executed", lambda *_: signal.raise_signal(signal.SIGINT)
    )
    assert main(["simulate", *SMALL]) == 130
    assert "the first 6 steps are in" in capsys.readouterr().err


@pytest.mark.apart
def test_pictures_are_drawn(
    there: RunDir, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("stlc.view.player.MOST_FRAMES", 4)
    assert main(["simulate", "--backup", "--pictures", *SMALL[:-1]]) == 0
    out = capsys.readouterr().out
    assert "report.html" in out
    assert "traffic.gif" in out
    assert (there.path / "report.html").exists()
    assert (there.path / "traffic.gif").read_bytes()[:6] in (b"GIF89a", b"GIF87a")


def test_a_window_is_refused_before_anything_is_driven(
    there: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", there.name, *SMALL, "--window"]) == 2
    assert "`--window` shows robots, and `car` has none" in capsys.readouterr().err


OTHER = """
import sys
from importlib import import_module

for package, folder in zip(sys.argv[1::2], sys.argv[2::2]):
    import_module(package).__path__.append(folder)

import stlc.controller.evaluation.deployment as deployment
from stlc.cli.framework.app import main
from stlc.diagnostics import UsageError
from stlc.runtime import Controller

deployment.LATENCY_SECONDS = 0.01
small = "--guard braking --seeds 0 --agents 4 --steps 6 --no-pictures"
for words in ("simulate --help", f"simulate {small}", "report", "schema certify", "simulate --guard brakng"):
    print(f"## {words}", flush=True)
    main(words.split())
print("## export", flush=True)
try:
    Controller(None, "braking")
except UsageError as error:
    print(error)
from benchmarks.tables.disturbed import _title
print("## table", _title("braking+auto"))
"""


@pytest.mark.apart
def test_a_guard_of_two_files_is_known_everywhere(there: RunDir, tmp_path: Path) -> None:
    write_guard(tmp_path)
    added = [word for folder, package in PACKAGES.items() for word in (package, str(tmp_path / folder))]
    done = subprocess.run(
        [sys.executable, "-c", OTHER, *added],
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    parts = re.split("^## ", done.stdout, flags=re.MULTILINE)[1:]
    names = ("help", "simulation", "report", "schema", "slip", "export", "table")
    told = dict(zip(names, parts, strict=True))
    assert "none|paper|braking|full|certified" in told["help"]
    assert "`braking` brakes first, `full` also repairs plans" in " ".join(told["help"].split())
    assert re.search(r"^ +no guard +braking guard$", told["simulation"], re.MULTILINE)
    report = (there.path / "report.html").read_text()
    assert "with the braking guard" in report
    assert "--guard braking" in report
    assert '"braking"' in told["schema"]
    assert "did you mean `braking`?" in done.stderr
    assert "exported controllers do not contain the guard `braking`" in told["export"]
    assert told["table"].strip() == "table braking with margin"


@pytest.mark.usefixtures("there")
def test_a_planner_stands_beside_the_policy_and_says_what_it_left_of_its_budget(
    capsys: pytest.CaptureFixture[str],
) -> None:
    beside = ["simulate", "latest", "--method", "search", "--budget", "5ms", "--guard", "paper", *SMALL]
    assert main(beside) == 0
    lines = capsys.readouterr().out.splitlines()
    (header,) = (line for line in lines if "no guard" in line and "paper's guard" in line)
    assert header.rstrip().endswith("planner search")
    for label in ("satisfied", "decision, median"):
        (row,) = (line for line in lines if line.startswith(f"  {label} "))
        assert len(re.split(r" {2,}", row.strip())) == 4
    (row,) = (line for line in lines if line.startswith("  search, budget"))
    assert row.split() == ["search,", "budget", "5", "ms"]
    assert any(line.startswith("  ended early") for line in lines)
    assert main([*beside, "--json"]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert misfits(whole, load_schema("simulate/1")) == []
    document = whole["result"]
    assert set(document["guards"]) == {"none", "paper"}
    use = document["planners"]["search"]["search"]
    assert (use["budget"], use["searches"]) == (0.005, 2 * 4 * 6)
    assert "search" not in document["guards"]["none"]
    assert main([*beside, "--system", "car.yaml"]) == 2


def test_a_planner_alone_is_guarded_and_certified(there: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    spec = str(ROOT / "specs/traffic.stl")
    alone = ["--method", "search", "--budget", "2ms", "--guard", "paper", "--certify", "0.5", *SMALL]
    assert main(["simulate", spec, "--system", str(Path.cwd() / "car.yaml"), *alone]) in (0, 1, 4)
    captured = capsys.readouterr()
    assert "drives" in captured.out
    run = RunDir.newest()
    assert run.path != there.path
    found = run.read_json("eval/simulate.json")["guards"]
    assert {"search", "assurance"} <= set(found["paper"]) & set(found["none"])
    few = ["--share", "0.1", "--drives", "4", "--agents", "2", "--steps", "6", "--guard", "paper"]
    assert main(["certify", run.shown, *few]) in (0, 1, 4)
