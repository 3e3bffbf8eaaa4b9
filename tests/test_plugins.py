"""Plugins of other packages: found without an import, used through the command line, and broken ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from stlc import Run, System
from stlc.cli.framework.app import PROGRAM, main
from stlc.controller.guard.stages import STAGES
from stlc.controller.problem.task import Task
from stlc.controller.run.run import save_config
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.diagnostics import PluginError, SystemFileError, UsageError
from stlc.dynamics.load import load_system_decl
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.plants.declaration import load_plant_decl, plant_schema
from stlc.plants.kind import KINDS
from stlc.plugins import plugins, variable
from stlc.registry import GUARDS, METHODS, PLANNERS, PackageRegistry
from stlc.rundir import RunDir
from stlc.trace.formats.registry import ELSEWHERE, suffixes
from stlc.trace.trace import Trace

ROOT = Path(__file__).resolve().parents[1]
TOY = ROOT / "tests/data/toy"
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")
REGISTRIES: dict[str, PackageRegistry] = {
    "stlc.methods": METHODS,
    "stlc.planners": PLANNERS,
    "stlc.formats": ELSEWHERE,
    "stlc.plants": KINDS,
    "stlc.commands": PROGRAM.elsewhere,
    "stlc.guards": GUARDS,
    "stlc.stages": STAGES,
}
NAMES = {
    **{"stlc.methods": "coasting", "stlc.planners": "levels", "stlc.formats": "ltsv"},
    **{"stlc.plants": "sum", "stlc.commands": "count"},
    "stlc.stages": "full_braking",
}
PLANT = """
plant: 1
name: sum
sum: {gain: 2}
time: {dt: 1 s, duration: 3 s}
initial: {total: {range: [0, 9]}}
input: {push: {range: [0, 1], pieces: 3}}
output: {total: }
"""


@pytest.fixture
def car_task() -> Task:
    return Task.of(Spec.parse(File(SPEC).read()), System.load(CAR))


@pytest.fixture
def car_run(car_task: Task, tmp_path: Path) -> RunDir:
    config = TrainConfig(steps=1)
    folder = open_folder(car_task, config, Launch(root=tmp_path / "runs", name="test"))
    save_config(folder, resolve_config(car_task, config))
    return folder


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOY))


def package(folder: Path, name: str, entries: str, **files: str) -> None:
    """A package as pip installs it."""
    (folder / name).mkdir(parents=True)
    for file, text in {"__init__": "", **files}.items():
        (folder / name / f"{file}.py").write_text(text, encoding="utf-8")
    (folder / f"{name}-2.1.dist-info").mkdir()
    (folder / f"{name}-2.1.dist-info/entry_points.txt").write_text(entries, encoding="utf-8")


def stlc(*words: str, cwd: Path, toy: bool = True) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(ROOT), *([str(TOY)] if toy else [])])
    command = [sys.executable, "-m", "stlc", *words]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


# ------------------------------------------------------------------------ a package with one of each


@pytest.mark.usefixtures("toy")
@pytest.mark.parametrize("group", NAMES)
def test_names_of_packages_are_found_without_an_import(group: str) -> None:
    registry, name = REGISTRIES[group], NAMES[group]
    assert name in registry
    assert name in registry.installed
    assert name not in registry.own
    assert name in registry.suggest("?")
    assert not {each for each in sys.modules if each.startswith("toy.")}
    assert [each.source for each in plugins(group)[name]] == ["the package `toy` 1.0"]
    sys.path.remove(str(TOY))
    assert name not in registry


@pytest.mark.apart
@pytest.mark.usefixtures("toy")
def test_a_method_of_a_package_trains_and_its_run_is_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_system_decl(Path(CAR), {"train.method": "coasting"}).train.method == "coasting"
    words = ["train", SPEC, "--system", CAR, "--method", "coasting", "--held-out", "20"]
    assert main([*words, "--drives", "0", "--no-pictures", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    record = json.loads(Path(result["run"], "run.json").read_text())
    assert record["plugins"] == {"coasting": {"source": "the package `toy` 1.0"}}
    drive = ["simulate", "latest", "--seeds", "0", "--agents", "2", "--steps", "3", "--no-pictures", "--json"]
    assert main(drive) == 0
    capsys.readouterr()
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != str(TOY)])
    assert main(drive) == 3
    (finding,) = json.loads(capsys.readouterr().out)["diagnostics"]
    assert finding["code"] == "S206"
    assert "needs the method `coasting`" in finding["message"]
    assert "it came from the package `toy` 1.0" in finding["note"]
    assert main(["report", "latest", "--json"]) == 0


@pytest.mark.usefixtures("toy")
def test_a_planner_and_a_format_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    plan = ["plan", SPEC, "--system", CAR, "--method", "levels", "--option", "count=5", "--fail-under", "0"]
    assert main([*plan, "-o", "plan.ltsv", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["result"]
    assert (document["method"], document["evaluations"]) == ("levels", 5)
    assert Path("plan.ltsv").read_text().startswith("t:0\tx:")
    trace = Trace.load("plan.ltsv")
    assert trace.dt == 0.1
    code = main(["check", "plan.ltsv", SPEC, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert code in (0, 1), document
    assert document["ok"]
    assert ".ltsv" in suffixes()


@pytest.mark.usefixtures("toy")
def test_a_kind_of_plant_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its process finds it, too: the folder of the package is named by PYTHONPATH."""
    monkeypatch.setenv("PYTHONPATH", str(TOY))
    monkeypatch.chdir(tmp_path)
    Path("sum.yaml").write_text(PLANT)
    Path("sum.stl").write_text("signal total, push\nrequire low: always[0 s, 3 s] total <= 17\n")
    draw = ["simulate", "sum.stl", "--plant", "sum.yaml", "--from", "total=8", "--json"]
    assert main([*draw, "--fail-under", "0"]) == 0, capsys.readouterr()
    assert main(["falsify", "sum.stl", "--plant", "sum.yaml", "--simulations", "20", "--json"]) == 1
    assert "sum" in plant_schema()["properties"]
    Path("sum.yaml").write_text(PLANT.replace("gain: 2", "gian: 2"))
    with pytest.raises(SystemFileError, match="gian"):
        load_plant_decl(Path("sum.yaml"))


@pytest.mark.usefixtures("toy")
def test_a_guard_of_a_package_and_its_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert GUARDS.installed == ("none", "paper", "braking", "full", "certified")
    drive = ["simulate", SPEC, "--system", CAR, "--method", "search", "--budget", "1ms", "--guard", "braking"]
    assert main([*drive, "--seeds", "0", "--agents", "2", "--steps", "2", "--no-pictures"]) == 0
    assert "braking guard" in capsys.readouterr().out
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != str(TOY)])
    assert "braking" not in GUARDS
    assert main(drive) == 2
    assert "unknown guard `braking`" in capsys.readouterr().err


@pytest.mark.apart
def test_a_command_of_a_package(tmp_path: Path) -> None:
    assert stlc("count", SPEC, cwd=tmp_path).stdout.split() == ["4"]
    everything = stlc("--help", cwd=tmp_path)
    assert everything.returncode == 0, everything.stderr
    assert "Count the requirements of a specification." in everything.stdout
    assert json.loads(stlc("count", SPEC, "--json", cwd=tmp_path).stdout)["result"] == {"requirements": 4}


@pytest.mark.apart
def test_commands_of_stlc_look_at_no_package() -> None:
    """With packages installed, `fmt` imports as many modules as without, and reads no list of theirs."""
    code = (
        "import sys; from stlc.cli.framework.app import main; main(['fmt', '--check', sys.argv[1]]); "
        "from stlc.plugins import _installed; "
        "print(len(sys.modules), 'toy' in sys.modules, _installed.cache_info().misses)"
    )
    counts = []
    for toys in ([], [str(TOY)]):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *toys])}
        done = subprocess.run(
            [sys.executable, "-c", code, SPEC], env=environment, capture_output=True, text=True, check=True
        )
        counts.append(done.stdout.splitlines()[-1])
    assert counts[0] == counts[1]
    assert counts[0].endswith("False 0")


# ------------------------------------------------------------------------ broken ones

BROKEN = {
    "unimportable": ("import nothing_of_this_name", "ModuleNotFoundError: No module named"),
    "quitting": ("raise SystemExit(3)", "SystemExit: 3"),
    "faulty": ("1 / 0", "ZeroDivisionError"),
    "empty": ("", "`unsound.empty` has no `THING`"),
    "wrong": ("THING = 'a text'", "`THING` of `unsound.wrong` is no"),
}


@pytest.fixture
def unsound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [
        f"[{group}]\n" + "".join(f"{name} = unsound.{name}:THING\n" for name in (*BROKEN, "absent"))
        for group in REGISTRIES
    ]
    files = {name: text for name, (text, _) in BROKEN.items()}
    package(tmp_path / "site", "unsound", "\n".join(entries), **files)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))


@pytest.mark.usefixtures("unsound")
@pytest.mark.parametrize("group", REGISTRIES)
@pytest.mark.parametrize("name", [*BROKEN, "absent"])
def test_a_broken_plugin_is_an_error_that_names_it_and_its_package(group: str, name: str) -> None:
    why = BROKEN[name][1] if name in BROKEN else "No module named 'unsound.absent'"
    with pytest.raises(PluginError) as caught:
        REGISTRIES[group].get(name)
    (finding,) = caught.value.diagnostics
    assert finding.code == "S206"
    assert finding.message == f"`{name}` of the package `unsound` 2.1 cannot be loaded ({group})"
    assert why in finding.note[0]
    assert name in REGISTRIES[group].names  # listing goes on
    assert all(REGISTRIES[group].get(each) is not None for each in REGISTRIES[group].own)


@pytest.mark.usefixtures("unsound")
def test_broken_plugins_do_not_disturb_anything_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("stlc.cli.framework.program._PARSERS", {})
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert "Check that traces" in shown or "check" in shown
    assert "`faulty` of the package `unsound` 2.1 cannot be loaded" in " ".join(shown.split())
    assert main(["faulty"]) == 3
    assert "S206" in capsys.readouterr().err
    Path("drive.faulty").write_text("t:0\n")
    assert main(["check", "drive.faulty", SPEC]) == 3
    assert "S206" in capsys.readouterr().err
    for words in (["train", SPEC, "--system", CAR, "--method", "faulty"], ["plan", SPEC, "-m", "wrong"]):
        assert main(words) == 3
        assert "S206" in capsys.readouterr().err
    Path("plant.yaml").write_text(PLANT.replace("sum:", "empty:"))
    with pytest.raises(PluginError, match="unsound"):
        load_plant_decl(Path("plant.yaml"))
    assert main(["fmt", "--check", SPEC]) == 0
    assert main(["doctor", "--quick"]) == 0
    assert "unsound" in capsys.readouterr().out
    assert not Path("runs").exists()


def test_damaged_lists_of_entry_points_are_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index, data in enumerate((b"\xff\xfe", b"[stlc.methods", b"[stlc.methods]\nx\n=\n", b"a = b:c\n[\n")):
        (tmp_path / f"p{index}-1.dist-info").mkdir()
        (tmp_path / f"p{index}-1.dist-info/entry_points.txt").write_bytes(data)
    (tmp_path / "q-1.dist-info").mkdir()
    (tmp_path / "q-1.dist-info/entry_points.txt").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert set(METHODS.names) <= {*METHODS.own, ""}


# ------------------------------------------------------------------------ whose name it is


def test_former_names_say_where_they_went(capsys: pytest.CaptureFixture[str]) -> None:
    for registry in (METHODS, PLANNERS):
        assert not set(registry.moved) & set(registry.own)
        assert all((ROOT / path).is_file() for path in registry.moved.values())
    with pytest.raises(SystemFileError) as caught:
        load_system_decl(Path(CAR), {"train.method": "sac"})
    advice = "it is a file of the repository now: --method benchmarks/methods/sac.py"
    assert caught.value.diagnostics[0].help == (advice,)
    assert main(["train", SPEC, "--system", CAR, "--method", "sac"]) == 2
    assert "did you mean --method benchmarks/methods/sac.py" in capsys.readouterr().err


def test_a_name_of_stlc_cannot_be_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path, "taker", "[stlc.methods]\nguided = taker:METHOD\n[stlc.commands]\nfmt = taker:fmt\n")
    before = METHODS.get("guided")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert METHODS.get("guided") is before
    assert METHODS.plugin("guided") is None
    assert PROGRAM.names().count("fmt") == 1
    assert main(["fmt", "--check", SPEC]) == 0
    assert "taker" not in sys.modules


def test_two_packages_with_one_name_are_an_error_when_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("first", "second"):
        package(tmp_path / name, name, f"[stlc.planners]\nswarm = {name}:PLANNER\n")
        monkeypatch.syspath_prepend(str(tmp_path / name))
    assert PLANNERS.names.count("swarm") == 1
    with pytest.raises(PluginError, match=r"second.* 2\.1 cannot be loaded") as caught:
        PLANNERS.get("swarm")
    assert caught.value.diagnostics[0].note == ("the package `first` 2.1 has another of this name",)


# ------------------------------------------------------------------------ files that the user names


@pytest.fixture
def steady(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with the method of the toy package, under a name of its own."""
    monkeypatch.setenv(variable("stlc.methods"), "")
    monkeypatch.setenv(variable("stlc.planners"), "")
    path = tmp_path / "steady.py"
    path.write_text((TOY / "toy/coasting.py").read_text(), encoding="utf-8")
    return path


def test_a_file_is_a_method_for_the_one_who_names_it(steady: Path, car_task: Task) -> None:
    assert resolve_config(car_task, TrainConfig(method=str(steady))).method == "steady"
    assert METHODS.plugin("steady").place == steady
    assert "steady" in METHODS.names
    assert "steady" not in METHODS.installed


def test_the_run_of_a_file_names_it_and_is_opened_only_for_one_who_names_it_again(
    steady: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["train", SPEC, "--system", CAR, "--held-out", "20", "--drives", "0", "--no-pictures", "--json"]
    assert main([*words, "--method", "steady.py"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    noted = json.loads(Path(result["run"], "run.json").read_text())["plugins"]["steady"]
    assert noted["source"] == f"the file `{steady}`"
    assert len(noted["sha256"]) == 64
    drive = ["simulate", "latest", "--seeds", "0", "--agents", "2", "--steps", "3", "--no-pictures", "--json"]
    assert main(drive) == 0
    capsys.readouterr()
    monkeypatch.setenv("STLC_METHODS", "")
    assert main(drive) == 3
    (finding,) = json.loads(capsys.readouterr().out)["diagnostics"]
    assert str(steady) in finding["note"][0]
    assert "STLC_METHODS=FILE.py" in finding["help"][0]
    monkeypatch.setenv("STLC_METHODS", str(tmp_path))  # the folder
    assert main(drive) == 0


@pytest.mark.parametrize("name", ["trap.py", "{folder}/trap.py", "trap", "trap.py:METHOD"])
def test_nothing_that_a_file_names_is_imported(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, car_run: RunDir
) -> None:
    """A system file, a run and a specification choose among what is there; they cannot bring Python."""
    (tmp_path / "trap.py").write_text("open('sprung', 'w')\nMETHOD = PLANNER = None\n")
    monkeypatch.chdir(tmp_path)
    name = name.format(folder=tmp_path)
    with pytest.raises(SystemFileError, match="method"):
        load_system_decl(Path(CAR), {"train.method": json.dumps(name)})
    config = car_run.path / "config.resolved.yaml"
    stored = json.loads(config.read_text())
    for changed in ({"method": name}, {"method": "plan", "planner": name}):
        config.write_text(json.dumps(stored | changed))
        with pytest.raises(PluginError, match="S206"):
            Run.open(car_run.path)
    with pytest.raises(UsageError):
        METHODS.get(name)
    assert not Path("sprung").exists()


def test_files_that_cannot_be_used(
    steady: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "guided.py").write_text("METHOD = None\n")
    (tmp_path / "torn.py").write_text("def (\n")
    (tmp_path / "hollow.py").write_text("")
    cases = {
        "missing.py": (2, "there is no file `missing.py`"),
        "guided.py": (2, "stlc has a method `guided` of its own"),
        "torn.py": (3, "SyntaxError"),
        "hollow.py": (3, "has no `METHOD`"),
    }
    for file, (code, text) in cases.items():
        assert main(["train", SPEC, "--system", CAR, "--method", file]) == code, file
        assert text in capsys.readouterr().err
    assert not Path("runs").exists()
    assert steady.is_file()


def test_a_file_of_a_package_imports_its_neighbours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steady: Path
) -> None:
    neighbour = steady.read_text()
    package(tmp_path / "site", "pack", "", _shared=neighbour, own="from pack._shared import METHOD\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert METHODS.chosen(str(tmp_path / "site/pack/own.py")) == "own"
    assert type(METHODS.get("own")).__module__ == "pack._shared"


def test_a_link_to_a_file_has_the_name_of_the_link(steady: Path, tmp_path: Path) -> None:
    (tmp_path / "linked.py").symlink_to(steady)
    assert METHODS.chosen(str(tmp_path / "linked.py")) == "linked"
    assert METHODS.get("linked") is not None
