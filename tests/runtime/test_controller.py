"""The runtime decides as the torch controller does, without torch."""

from __future__ import annotations

import functools
import hashlib
import json
import operator
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.exported import ROOT, exported, mission, run_of

from stlc.controller.guard.candidates import SOURCES
from stlc.controller.guard.guard import Guard
from stlc.controller.run.run import Run
from stlc.diagnostics import MissingError, RunError, StlcError, UsageError
from stlc.export.write import export
from stlc.runtime import Controller
from stlc.runtime.facts import read_facts

MANY = [
    ("ship_safe", "ship_safe"),
    ("reach_n_avoid", "maze"),
    ("ship_track", "ship_track"),
    ("navigation", "rover"),
    ("manipulation", "panda"),
    ("patrol", "unicycle"),
]


@cache
def loaded(guard: str = "none") -> Controller:
    """The controller of traffic; who takes it calls `reset`."""
    return Controller.load(exported("traffic", "car")[1], guard)  # type: ignore[arg-type]


def driven(run: Run, folder: Path, mode: str, *, agents: int, steps: int) -> set[str]:
    """Both controllers through the same states; the rules that decided."""
    mine, theirs = Controller.load(folder, mode), Guard(run.task, run.policy, mode)  # type: ignore[arg-type]
    x, begun, rules = run.task.sample(agents, seed=5, dtype=torch.float64), None, set()
    high = float(run.task.system.control_high.abs().max())
    for _ in range(steps):
        found, wanted = mine.decide(x.numpy()), theirs.decide(x, begun)
        assert found.source.tolist() == [SOURCES[source] for source in wanted.source]
        assert found.t0.tolist() == wanted.t0.tolist()
        np.testing.assert_allclose(found.control, wanted.action, rtol=0.0, atol=1e-6 * high)
        np.testing.assert_allclose(found.plan, wanted.plan, rtol=0.0, atol=1e-6 * high)
        np.testing.assert_allclose(found.rho, wanted.rho, rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(found.policy_rho, wanted.policy_rho, rtol=0.0, atol=1e-4)
        assert (np.asarray(found.safe) >= -1e-6).tolist() == wanted.safe.tolist()
        again = run.task.judge(x, torch.from_numpy(found.plan)).requirements
        np.testing.assert_allclose(np.stack(list(found.robustness.values()), 1), again, rtol=0.0, atol=1e-9)
        rules |= set(found.rule)
        x, begun = run.task.system.step(x, wanted.action), wanted.later(1)
    return rules


@pytest.mark.apart
def test_every_decision_is_that_of_the_guard() -> None:
    run, folder = exported("traffic", "car")
    assert driven(run, folder, "none", agents=6, steps=8) == {"policy", "kept"}
    assert driven(run, folder, "paper", agents=4, steps=5) == {"policy", "kept", "backup"}


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "system"), MANY)
def test_every_benchmark_decides_as_the_guard(spec: str, system: str, tmp_path: Path) -> None:
    run = run_of(spec, system, tmp_path / "runs")
    folder = export(run, "onnx", tmp_path / "out").folder
    driven(run, folder, "none", agents=12, steps=12)
    few = spec in ("manipulation", "patrol")  # thousands of prefixes
    assert "backup" in driven(run, folder, "paper", agents=2 if few else 4, steps=2 if few else 6)


@pytest.mark.parametrize("made", [lambda: exported("traffic", "car"), mission])
def test_a_loop_of_ones_own_calls_both_alike(made: Any) -> None:
    run, folder = made()
    system, names = run.task.plain, run.task.plain.names
    x = system.sample(1, seed=3, dtype=torch.float64)[0].numpy()
    first = run.task.system.with_added(torch.from_numpy(x)[None], torch.Generator().manual_seed(0))[0]
    added = {k: float(v) for k, v in zip(run.task.names, first, strict=True) if k not in names}
    mine, theirs = Controller.load(folder, "none", parameters=added), run.guard("none")
    high = float(system.control_high.abs().max())
    for step in range(6):
        state: Any = dict(zip(names, x, strict=True)) if step % 2 else x
        found, wanted = mine(state), theirs(state)
        assert found.shape == wanted.shape == (len(system.control_names),)
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-6 * high)
        x = system.step(torch.from_numpy(x)[None], torch.from_numpy(wanted)[None])[0].numpy()
    assert theirs(np.stack([x])).shape == (1, len(wanted))
    theirs.reset()
    assert theirs.decision is None
    for bad in (np.full(len(x), np.nan), x[:-1], np.zeros((2, 2, len(x)))):
        with pytest.raises(RunError, match="R107"):
            theirs(bad)


def test_promises_are_gone_on_with_as_the_guard_does() -> None:
    run, folder = mission()
    assert run.task.pending_goals.items
    assert "kept" in driven(run, folder, "none", agents=30, steps=15)


def test_one_agent_a_batch_and_names_are_one_question() -> None:
    run, folder = exported("traffic", "car")
    x = run.task.sample(3, seed=4, dtype=torch.float64).numpy()
    controller = Controller.load(folder / "decide.onnx")
    batch = controller.decide(x)
    for row, state in enumerate(x):
        controller.reset()
        alone = controller.decide(state)
        controller.reset()
        named = controller.decide(dict(zip(run.task.system.names, state, strict=True)))
        assert alone.rule == named.rule == batch.rule[row] == "policy"
        for each in (alone, named):
            np.testing.assert_allclose(each.plan, batch.plan[row], rtol=0.0, atol=1e-6)
            np.testing.assert_array_equal(each.control, each.plan[0])
            assert each.rho == pytest.approx(np.asarray(batch.rho)[row], abs=1e-6)
        assert set(alone.robustness) == {rule.name for rule in run.task.rules}


def test_a_mission_keeps_its_clock() -> None:
    run, folder = mission()
    x = run.task.sample(2, seed=6, dtype=torch.float64)
    x[:, 2] = 0.25
    short, whole = Controller.load(folder, parameters={"far": 0.25}), Controller.load(folder)
    assert short.states[2:] == ("far", *(timer.name for timer in run.task.system.timers))
    begun = whole.decide(x.numpy()).plan
    np.testing.assert_array_equal(short.decide(x[:, :2].numpy()).plan, begun)
    first = x[:, :2].numpy()
    for _ in range(3):
        x = run.task.system.step(x, torch.from_numpy(whole.decide(x.numpy()).control))
        whole.reset()
        whole.decide(x.numpy())
        short.decide(x[:, :2].numpy())
    again = short.decide(x[:, :2].numpy()).robustness
    assert set(again) == {"there", "back", "slow"}
    with pytest.raises(RunError, match=r"R107.*timers follow from every step"):
        short.decide(first, elapsed=2)
    short.reset()
    np.testing.assert_array_equal(short.decide(first).plan, begun)
    with pytest.raises(RunError, match=r"R107.*`far` has no value"):
        Controller.load(folder).decide(first)


def test_a_plan_is_gone_on_with_after_several_steps() -> None:
    run, folder = mission()
    controller, guard = Controller.load(folder), Guard(run.task, run.policy, "none")
    x = run.task.sample(60, seed=1, dtype=torch.float64)
    controller.decide(x.numpy())
    begun = guard.decide(x)
    for ahead in range(2):
        x = run.task.system.step(x, begun.later(ahead).action)
    found, wanted = controller.decide(x.numpy(), elapsed=2), guard.decide(x, begun.later(2))
    np.testing.assert_allclose(found.plan, wanted.plan, rtol=0.0, atol=1e-5)
    assert "kept" in found.rule


@pytest.mark.parametrize(
    ("state", "why"),
    [
        (np.zeros(3), "shape"),
        (np.zeros((2, 2, 7)), "shape"),
        (np.array([np.nan, 0, 0, 0, 0, 0, 0]), "x is not a finite number"),
        (np.array([[0.0] * 7, [0, np.inf, 0, 0, 0, 0, 0]]), "v is not a finite number"),
        ({"x": 0.0}, "tau"),
        ({**dict.fromkeys(("x", "v", "sign", "tau", "dx", "v_lead", "yielding"), 0.0), "y": 1.0}, "y"),
        (["fast", 0.0], "no array of numbers"),
        ([[0.0, 1.0], [0.0]], "no array of numbers"),
        (
            {**{key: [0.0, 1.0] for key in ("x", "v", "sign", "tau", "dx", "yielding")}, "v_lead": [0.0] * 3},
            "no array of numbers",
        ),
    ],
)
def test_a_state_that_does_not_fit_is_told(state: object, why: str) -> None:
    with pytest.raises(RunError, match=f"R107.*{why}"):
        loaded().decide(state)  # type: ignore[arg-type]


def test_another_number_of_agents_is_told() -> None:
    controller = loaded()
    controller.reset()
    x = exported("traffic", "car")[0].task.sample(3, seed=4, dtype=torch.float64).numpy()
    controller.decide(x)
    with pytest.raises(RunError, match=r"R107.*2 agents where 3 were"):
        controller.decide(x[:2])
    controller.reset()
    controller.decide(x[:2])


def test_beyond_the_range_of_states_the_guard_acts() -> None:
    run, folder = mission()
    x = run.task.sample(4, seed=4, dtype=torch.float64)
    x[:, 1] = torch.tensor([1.9, 2.4, 6.0, 0.0])  # m/s, where 2 is usual and 1.5 allowed
    found, wanted = Controller.load(folder, "paper").decide(x.numpy()), Guard(run.task, run.policy).decide(x)
    assert found.source.tolist() == [SOURCES[source] for source in wanted.source]
    assert "safest" in found.source
    assert found.t0.tolist() == wanted.t0.tolist()
    np.testing.assert_allclose(found.plan, wanted.plan, rtol=0.0, atol=1e-5)


def test_a_policy_that_is_no_number_is_stopped_or_guarded() -> None:
    run, _ = exported("traffic", "car")
    x = run.task.sample(1, seed=4, dtype=torch.float64)
    x[0, 0] = 1e300  # the network is float32, so this becomes infinite there
    loaded().reset()
    with pytest.raises(RunError, match="R402"):
        loaded().decide(x[0].numpy())
    loaded("paper").reset()
    found = loaded("paper").decide(x[0].numpy())
    assert found.source != "policy"
    assert np.isfinite(found.control).all()
    assert found.policy_rho == -np.inf


def test_time_does_not_run_backwards() -> None:
    with pytest.raises(RunError, match=r"R107.*-1 steps since"):
        loaded().decide(np.zeros(7), elapsed=-1)


def test_without_onnxruntime_the_way_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    _, folder = exported("traffic", "car")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingError, match="onnxruntime"):
        Controller.load(folder)


def test_an_unknown_guard_is_told() -> None:
    with pytest.raises(UsageError, match="full"):
        Controller.load(exported("traffic", "car")[1], "full")  # type: ignore[arg-type]


ALONE = """
import sys

class Bare:  # an environment after `pip install numpy onnxruntime` and `pip install --no-deps .`
    there = {"stlc", "numpy", "onnxruntime", "google", "flatbuffers", "packaging"}

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in self.there | sys.stdlib_module_names:
            raise ModuleNotFoundError(f"no {name}", name=name)

sys.meta_path.insert(0, Bare())
import numpy as np
from stlc.runtime import Controller
from stlc.runtime.facts import read_facts

controller = Controller.load(sys.argv[1], guard="paper")
decision = controller.decide(np.zeros(len(controller.states)))
print(decision.rule)
try:
    import torch
except ModuleNotFoundError:
    print("no torch")
"""


@pytest.mark.apart
def test_numpy_and_onnxruntime_are_enough() -> None:
    command = [sys.executable, "-c", ALONE, str(exported("traffic", "car")[1])]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    rule, torch = done.stdout.splitlines()
    assert rule in ("policy", "backup", "safest")
    assert torch == "no torch"


@pytest.mark.apart
def test_the_page_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    (block,) = [part.split("```")[0] for part in text.split("```python\n")[1:] if "stlc.runtime" in part]
    run, folder = exported("traffic", "car")
    monkeypatch.chdir(folder.parent)
    exec(compile(block.replace('"controller"', repr(folder.name)), "export.md", "exec"), {})
    said = capsys.readouterr().out
    assert all(f"{rule.name}: " in said for rule in run.task.rules)


JUNK = (None, -1, 0, 1.5, 1e300, True, "", "x", [], [[]], {}, [0.0], 10**30)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    pairs = value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ())
    for key, each in pairs:
        yield from _places(each, (*path, key))


def _damage(folder: Path, rng: random.Random) -> None:
    """Change a value of the description, or a byte of a graph whose digest is then written anew."""
    facts = folder / "controller.json"
    read = json.loads(facts.read_text())
    if rng.random() < 0.6:
        *path, last = rng.choice([each for each in _places(read) if each and each[0] != "format"])
        functools.reduce(operator.getitem, path, read)[last] = rng.choice(JUNK)
    else:
        name = rng.choice(sorted(read["files"]))
        data = bytearray((folder / name).read_bytes())
        for _ in range(rng.choice((1, 1, 20))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        cut = rng.randrange(len(data)) if rng.random() < 0.2 else len(data)
        (folder / name).write_bytes(data[:cut])
        read["files"][name] = hashlib.sha256(data[:cut]).hexdigest()
    facts.write_text(json.dumps(read))


@pytest.mark.apart
@pytest.mark.parametrize("count", [5, pytest.param(600, marks=pytest.mark.slow)])
def test_a_damaged_export_ends_in_a_diagnostic(count: int, tmp_path: Path) -> None:
    whole = exported("traffic", "car")[1]
    state = np.zeros(len(read_facts(whole).states))
    refused = 0
    for seed in range(count):
        folder = Path(shutil.copytree(whole, tmp_path / str(seed)))
        _damage(folder, random.Random(seed))
        with np.errstate(all="ignore"):
            try:
                controller = Controller.load(folder, "paper" if seed % 5 == 0 else "none")
                for _ in range(2):
                    controller.decide(state)
            except StlcError:
                refused += 1
        shutil.rmtree(folder)
    assert refused > count / 4
