"""Whatever goes wrong in a deployment ends with a diagnosis; what was driven until then can be checked."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from stlc.cli.framework.app import main
from stlc.controller.run.checkpoint import load_checkpoint, save_checkpoint
from stlc.rundir import RunDir
from stlc.trace import Trace

SPEC = "signal p [m]\nrequire near: always[0, T] abs(p) <= 3 m\n"
SYSTEM = """\
stlc: 1
name: dot
time: {dt: 0.5 s, horizon: 4 steps}
state:
  p: {unit: m, range: [-3, 3]}
  w: {unit: m/s, range: [-2, 2]}
control: {u: {unit: m/s^2, range: [-1, 1]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: "uniform(-1, 1)", w: 0}}]}
policy: {hidden: [8]}
backup: {bins: 3, T0: [1], batch: 64}
test: {world: "yard.py:Yard", steps: 8, agents: 3}
"""
WORLD = """\
import numpy as np

AT = 5


class Yard:
    def __init__(self, system, agents, generator):
        self.system, self.agents, self.generator, self.step = system, agents, generator, 0

    def reset(self):
        return self.system.sample(self.agents, generator=self.generator)

    def advance(self, x, action):
        self.step += 1
        moved = self.system.step(x, action)
        return fault(moved) if self.step == AT else moved

    def progress(self):
        return {"steps": self.step}

    def units(self):
        return {}

    def snapshot(self):
        return {"step": np.array(self.step)}

    @staticmethod
    def draw(axes, scene, index):
        pass


def fault(moved):
    return moved
"""
SMALL = ["--seeds", "0..1", "--no-pictures"]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    for name, text in (("dot.stl", SPEC), ("dot.yaml", SYSTEM), ("yard.py", WORLD)):
        (folder / name).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        command = ["train", "dot.stl", "--system", "dot.yaml", "--steps", "3", "--batch", "16"]
        assert main([*command, "--held-out", "50", "--no-pictures"]) in (0, 1)
    return folder


@pytest.fixture
def run(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunDir:
    monkeypatch.chdir(home)
    capsys.readouterr()
    found = RunDir.newest()
    (found.path / "trace.npz").unlink(missing_ok=True)
    (found.path / "yard.py").write_text(WORLD)
    return found


def deployed(run: RunDir, world: str, *options: str) -> int:
    """The exit code of a deployment in another world."""
    (run.path / "yard.py").write_text(world)
    return main(["simulate", *SMALL, *options])


def checked(run: RunDir, samples: int) -> None:
    """The trace of the run has so many samples, and `stlc check` reads it."""
    assert Trace.load(run.path / "trace.npz").samples == samples
    assert main(["check", str(run.path / "trace.npz")]) in (0, 1)


@pytest.mark.parametrize(
    ("body", "code", "said", "line"),
    [
        ("return 1 / 0", "S207", "the world cannot take step 5: division by zero", "return 1 / 0"),
        ("return moved[:, 9]", "S207", "cannot take step 5", "return moved[:, 9]"),
        ("raise SystemExit(7)", "S207", "SystemExit", "raise SystemExit(7)"),
        ("return moved[:2]", "S207", "gives states of shape (2, 2), not (3, 2)", "def advance"),
        ("return moved.tolist()", "S207", "gives a list, not a tensor of shape (3, 2)", "def advance"),
        ("return None", "S207", "gives nothing", "def advance"),
        (
            "return moved * float('nan')",
            "S302",
            "gives nan for `p` of agent 0 at step 5 (seed 0)",
            "def advance",
        ),
        ("return moved / 0", "S302", "at step 5", "def advance"),
    ],
)
def test_a_world_that_fails(
    run: RunDir, capsys: pytest.CaptureFixture[str], body: str, code: str, said: str, line: str
) -> None:
    world = WORLD.replace("    return moved\n", f"    {body}\n")
    assert deployed(run, world, "--backup") == 3
    error = capsys.readouterr().err
    assert f"error[{code}]" in error
    assert said in error
    number = next(i for i, text in enumerate(world.splitlines(), 1) if line in text)
    assert f"yard.py:{number}:" in error
    assert line in error
    assert "the first 4 steps are in" in error
    assert "Traceback" not in error
    checked(run, 5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('return {"steps": self.step}', "return 1 // (4 - self.step)", "say its progress"),
        ('return {"steps": self.step}', 'return {"steps": "many"}', "say its progress"),
        ("np.array(self.step)}", "np.zeros(self.step)}", "gives `step` of shape (1,), and (0,) before"),
        ("np.array(self.step)}", "object()}", "no array of numbers"),
        ("return {}", "return 3", "say its units"),
        ("self.step = system, agents, generator, 0", "self.step = system", "be made"),
        ("return self.system.sample(", "return (", "`reset` of the world gives a tuple"),
    ],
)
def test_a_world_that_tells_nonsense_of_itself(
    run: RunDir, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    assert old in WORLD
    world = WORLD.replace(old, new)
    if "reset" in said:
        world = world.replace("(self.agents, generator=self.generator)", "(self.agents, 2)")
    assert deployed(run, world) == 3
    error = capsys.readouterr().err
    assert "error[S207]" in error
    assert said in error
    assert "yard.py:" in error
    assert "Traceback" not in error


def test_a_world_that_writes_into_what_it_gets_changes_nothing_else(run: RunDir) -> None:
    world = WORLD.replace(
        "        moved = ", "        x += 0 * x + 100\n        action *= 0\n        moved = "
    )
    assert deployed(run, world) == 0
    trace = Trace.load(run.path / "trace.npz")
    assert abs(trace.data["p"][:, 0]).max() <= 1.0
    assert abs(trace.extras["action.u"]).max() > 0.0


@pytest.mark.parametrize("value", ["1e9", "1e300"])
def test_a_state_out_of_range(run: RunDir, capsys: pytest.CaptureFixture[str], value: str) -> None:
    """The guard acts where the policy knows no number, and the deployment goes on."""
    world = WORLD.replace("    return moved\n", f"    return moved * 0 + {value}\n")
    assert deployed(run, world, "--guard", "full", "--seeds", "0") == 0
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert ("error[R402]" in error) == (value == "1e300")  # too large for a network: only the guard goes on
    checked(run, 9)
    assert max(map(len, capsys.readouterr().out.splitlines())) < 200


@pytest.fixture
def broken(run: RunDir) -> RunDir:
    """A run whose network gives no numbers."""
    shutil.copytree(run.path, run.path.parent / "0002-broken", dirs_exist_ok=True)
    found = RunDir(run.path.parent / "0002-broken")
    saved = load_checkpoint(found, **found.hashes)
    tensors = {
        name: torch.full_like(each, torch.nan) if each.is_floating_point() else each
        for name, each in saved.tensors.items()
    }
    save_checkpoint(found, tensors, saved.facts, step=4)
    return found


def test_a_policy_that_gives_no_numbers(broken: RunDir, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", str(broken.path), *SMALL]) == 3
    error = capsys.readouterr().err
    assert "error[R402]: the policy's plan at step 0 is not a number, for 6 of 6 agents" in error
    assert "--backup" in error
    assert not (broken.path / "trace.npz").exists()
    for guard in ("paper", "full"):
        assert main(["simulate", str(broken.path), *SMALL, "--guard", guard]) == 0
        captured = capsys.readouterr()
        assert "error[R402]" in captured.err  # of the deployment without a guard
        assert "guard acted in 100.0 % of decisions" in captured.out
        decisions = broken.read_json("eval/simulate.json")["guards"][guard]["decisions"]
        assert decisions["policy"] == 0.0
        checked(broken, 9)
