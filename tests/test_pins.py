"""Answers of monitors, guards and commands, pinned in golden files that hold on every machine."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from helpers.tools import load_tool

from stlc.controller.policies.policy import Policy

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "data" / "pins"
TOLERANCE = 1e-6
FORMULAS = 30
SPECS = {
    "specs/traffic.stl": {
        "x": -3.0,
        "v": 0.0,
        "sign": 0.0,
        "tau": 2.0,
        "dx": 5.0,
        "v_lead": 0.0,
        "yielding": 1.0,
    },
    "specs/patrol.stl": {"x": -4.0, "y": 2.0, "psi": 0.0, "v": 0.5},
}
"""Specifications, and where their traces begin."""
GUARDED = ("specs/traffic.stl", "specs/ship_safe.stl", "specs/ship_track.stl", "specs/patrol.stl")


@pytest.fixture(scope="module")
def pins() -> ModuleType:
    return load_tool("pins")


@pytest.fixture
def place(pins: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    return pins.Place(tmp_path, None)


@pytest.fixture
def regenerate(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--regenerate"))


def hold(pins: ModuleType, name: str, found: Any, regenerate: bool) -> None:
    path = GOLDEN / f"{name}.json"
    if regenerate:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, ensure_ascii=False, separators=(",", ":")) + "\n", encoding="utf-8")
    new = json.loads(json.dumps(found))
    different = list(pins.differences(name, pins.read(path), new, TOLERANCE))
    assert not different, "\n".join(map(str, different[:20]))


@pytest.mark.apart
def test_random_formulas(pins: ModuleType, regenerate: bool) -> None:
    """Cases of the golden file, judged anew: they do not depend on the generator."""
    path = GOLDEN / "formulas.json"
    if regenerate:
        cases = [pins.drawn(seed) for seed in range(FORMULAS)]
    else:
        cases = [(each["text"], each["signals"]) for each in pins.read(path)]
    assert len(cases) == FORMULAS
    hold(pins, "formulas", [pins.formula(*case) for case in cases], regenerate)


def trace(start: dict[str, float], samples: int = 60) -> dict[str, list[float]]:
    """Columns that move to and fro in steps of 1/8, which are the same on every machine."""
    return {
        name: [value + ((k * (3 + i)) % 17 - 8) / 8 for k in range(samples)]
        if name not in ("sign", "yielding")
        else [float(k // 20 % 2) for k in range(samples)]
        for i, (name, value) in enumerate(start.items())
    }


@pytest.mark.apart
def test_verdicts(pins: ModuleType, place: Any, regenerate: bool) -> None:
    found = {}
    for spec, start in SPECS.items():
        columns, name = trace(start), pins.stem(spec)
        (place.work / f"{name}.csv").write_text(pins.table(columns, 0.1), encoding="utf-8")
        short = {signal: values[:9] for signal, values in columns.items()}
        (place.work / f"{name}_short.csv").write_text(pins.table(short, 0.1), encoding="utf-8")
        holes = pins.table(columns, 0.1, lambda k: k % 11 not in (4, 5, 6))
        (place.work / f"{name}_holes.csv").write_text(holes, encoding="utf-8")
        found |= dict(pins.judged(place, spec, 0.1))
    hold(pins, "verdicts", found, regenerate)


@pytest.mark.apart
def test_documents(pins: ModuleType, place: Any, regenerate: bool) -> None:
    def words() -> Iterator[str]:
        for spec in SPECS:
            yield from (
                f"compile {spec} --json",
                f"lint {spec} --select ALL --json",
                f"explain {spec} --json",
            )
        yield from ("system show examples/car.yaml --json", "fmt specs --check --json")
        yield from pins.WRONG

    hold(pins, "documents", [place.stlc(each) for each in words()], regenerate)


class Held(Policy):
    """A policy that holds the middle of every control, but the first where a state's first number is even."""

    def candidates(self, x0: torch.Tensor) -> torch.Tensor:
        low, high = self.task.system.control_low.to(x0), self.task.system.control_high.to(x0)
        share = 0.5 + 0.25 * (x0[:, :1].floor() % 2)
        return (low + (high - low) * share)[:, None, None].expand(-1, 1, self.task.horizon, -1).clone()


@pytest.mark.apart
def test_decisions_of_guards(pins: ModuleType, place: Any, regenerate: bool) -> None:
    """By the paper's rule what, how and how well; of the full guard, which climbs, only what it comes to."""
    found = {}
    for spec in GUARDED:
        task = pins.Task.of(pins.load(place.work / spec), pins.system_of(place, spec))
        policy = Held(task)
        x = pins.on_the_way(task, policy, 6, 1).mul(1024).round().div(1024)
        # where a grid of prefixes takes seconds, the paper's rule is left out
        for mode in ("none", "full") if "patrol" in spec else ("none", "paper", "full"):
            limits = pins.SMALL if mode == "full" else pins.NO_LIMIT
            decision = pins.said(pins.Guard(task, policy, mode, limits=limits).decide(x))
            names = (
                ("source", "safe")
                if mode == "full"
                else ("action", "source", "t0", "rho", "safe", "policy_rho")
            )
            found[f"{pins.stem(spec)}/{mode}"] = {
                **{name: decision[name] for name in names},
                "satisfied": [rho >= -TOLERANCE for rho in decision["rho"]],
            }
        found[f"{pins.stem(spec)}/states"] = x.tolist()
    hold(pins, "guards", found, regenerate)


def test_differences_are_named(pins: ModuleType) -> None:
    old = {"a": [1.0, float("nan"), True], "b": "one\ntwo\n", "gone": 0}
    new = {"a": [1.0 + 1e-9, float("nan"), 1], "b": "one\nthree\n", "more": None}
    places = [each.where for each in pins.differences("pin", old, new)]
    assert places == ["pin.a[0]", "pin.a[2]", "pin.b:2", "pin.gone", "pin.more"]
    assert [each.where for each in pins.differences("pin", old, new, 1e-6)] == places[1:]
    assert not list(pins.differences("pin", old, old))


def test_only_what_is_volatile_is_masked(pins: ModuleType) -> None:
    document = {"stlc": "1", "result": {"seconds": 3.0, "horizon": {"seconds": 2.5}, "accuracy": 0.5}}
    said = pins.masked(document, "train/1")
    assert said["result"] == {"seconds": "<processor time>", "horizon": {"seconds": 2.5}, "accuracy": 0.5}
    assert pins.masked(document, "compile/1")["result"] == document["result"]


def test_the_tool_writes_and_checks(
    pins: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"one": {"x": 0.1}, "two/text": "a\nb\n"}
    monkeypatch.setattr(pins, "PARTS", {"small": lambda _: iter(values.items())})
    pins.write(tmp_path / "kept", None)
    with pytest.raises(pins.typer.Exit) as left:
        pins.check(tmp_path / "kept", None)
    assert left.value.exit_code == 0
    values |= {"one": {"x": 0.2}, "new": 1}
    del values["two/text"]
    with pytest.raises(pins.typer.Exit) as left:
        pins.check(tmp_path / "kept", None)
    assert left.value.exit_code == 1
    out = capsys.readouterr().out
    assert "small/one.x\n  old  0.1\n  new  0.2\n" in out
    assert "small/new\n  old  <absent>" in out
    assert "small/two/text\n  old  <pinned>\n  new  <absent>" in out
