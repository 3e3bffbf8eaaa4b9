"""Random, mutated and malicious inputs: diagnostics, no hang, no memory without end (`tools/fuzz.py`)."""

from __future__ import annotations

import argparse
import itertools
import json
import random
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from stlc.cli.framework.render import render_text
from stlc.diagnostics import StlcError
from stlc.dynamics.load import parse_system
from stlc.source import Source

TOOLS = Path(__file__).resolve().parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import fuzz  # noqa: E402
from fuzzing import bombs as fuzz_bombs  # noqa: E402
from fuzzing import grammar as fuzz_grammar  # noqa: E402
from fuzzing import hostile as fuzz_hostile  # noqa: E402
from fuzzing import inputs as fuzz_inputs  # noqa: E402
from fuzzing import valid as fuzz_valid  # noqa: E402
from fuzzing.laws import HangError, laws, stage  # noqa: E402
from fuzzing.specs import SYSTEM  # noqa: E402

SECONDS = 4.0


def every(bombs: list[tuple[str, str]], count: int) -> list[tuple[str, str]]:
    """So many of them, spread evenly."""
    return list(itertools.islice(bombs, 0, None, max(1, len(bombs) // count)))


def tread_system(text: str) -> None:
    with stage("the system", SECONDS):
        try:
            parse_system(Source("b.yaml", text), Path("b.yaml"))
        except StlcError as error:
            render_text(error.diagnostics, color=False)


def test_drawn_specifications() -> None:
    numbers = random.Random(11)
    codes = [laws(Source("a.stl", fuzz_grammar.specification(numbers)), SECONDS) for _ in range(20)]
    assert set(codes) == {0, 3}


@pytest.mark.apart
def test_bombs_of_every_construct() -> None:
    for _, text in every(list(fuzz_bombs.specifications(12)), 41):
        laws(Source("a.stl", text), SECONDS)
    for _, text in every(list(fuzz_bombs.systems(12, SYSTEM)), 23):
        tread_system(text)


@pytest.mark.slow
@pytest.mark.parametrize("size", [12, 300, 3000, 100_000])
def test_every_bomb(size: int) -> None:
    for _, text in fuzz_bombs.specifications(size):
        laws(Source("a.stl", text), SECONDS)
    for _, text in fuzz_bombs.systems(size, SYSTEM):
        tread_system(text)


def endless() -> None:
    while True:
        pass


def test_a_hang_is_noticed() -> None:
    with pytest.raises(HangError, match="a loop takes more than 0"), stage("a loop", 0.05):
        endless()


LIGHT = tuple(kind for kind in fuzz_inputs.KINDS if kind not in ("run", "hostile", "bomb"))
"""Kinds that need no training, and nothing that takes long to make."""


@pytest.mark.parametrize("kinds", [LIGHT, pytest.param(("run",), marks=pytest.mark.apart)])
def test_the_same_seed_draws_the_same_inputs(kinds: tuple[str, ...]) -> None:
    for seed in range(20 if kinds == LIGHT else 1):
        first, second = (fuzz_inputs.draw(random.Random(seed), kinds) for _ in range(2))
        assert first == second


def run(
    count: int, seed: int, kinds: tuple[str, ...] = LIGHT, seconds: float = SECONDS
) -> list[fuzz.Outcome]:
    outcomes, _ = fuzz.fuzz(count, seed, fuzz.Limits(seconds, 1024), kinds=kinds)
    assert [(outcome.index, outcome.fault) for outcome in outcomes if outcome.fault] == []
    assert len(outcomes) == count
    return outcomes


def test_random_inputs_through_the_program() -> None:
    kinds = {outcome.kind for outcome in run(60, seed=3)}
    assert {"text", "spec", "system", "trace", "stream", "csv", "bag"} <= kinds


@pytest.mark.apart
def test_run_folders_of_strangers() -> None:
    run(24, seed=5, kinds=("hostile",), seconds=10.0)


@pytest.mark.slow
def test_many_run_folders_of_strangers() -> None:
    run(5000, seed=6, kinds=("hostile",), seconds=10.0)


def test_what_happens_outside_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (fuzz_hostile.OUTSIDE, "runs"):
        (tmp_path / name).mkdir()
    (tmp_path / fuzz_hostile.OUTSIDE / "secret").write_text(fuzz_hostile.SECRET)
    (tmp_path / "runs" / "f.py").write_text("")
    with fuzz_hostile.watched(drives=False) as wrong:
        secret = (tmp_path / fuzz_hostile.OUTSIDE / "secret").read_text()
        (tmp_path / fuzz_hostile.OUTSIDE / "new").write_text("")
        (tmp_path / "runs" / "report.html").write_text(secret)
        exec(compile("", str(tmp_path / "runs" / "f.py"), "exec"))
    told = " ".join(wrong)
    for words in ("open ", "exec ", "outside has changed", "a secret is in runs/report.html"):
        assert words in told
    with fuzz_hostile.watched(drives=True) as wrong:
        exec(compile("", str(tmp_path / "runs" / "f.py"), "exec"))
    assert wrong == ["a secret is in runs/report.html"]


def test_a_run_that_was_stopped_goes_on(tmp_path: Path) -> None:
    asked = argparse.Namespace(seed=3, kind=["csv"], seconds=2.0, memory=1024)
    assert fuzz.logged(tmp_path / "log", asked) == []
    first = [fuzz.Outcome(0, "csv", 3, 0.1), fuzz.Outcome(2, "csv", 0, 0.1, "hang")]
    with (tmp_path / "log").open("a") as lines:
        lines.writelines(json.dumps(asdict(outcome)) + "\n" for outcome in first)
        lines.write('{"index": 1, "ki')
    assert fuzz.logged(tmp_path / "log", asked) == first
    asked.seed = 4
    with pytest.raises(SystemExit, match="another run"):
        fuzz.logged(tmp_path / "log", asked)


def test_what_is_not_installed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(_: random.Random) -> tuple[str, bytes]:
        raise ModuleNotFoundError("No module named 'nothing'", name="nothing")

    monkeypatch.setitem(fuzz_valid.FORMATS, "parquet", absent)
    given = fuzz_inputs.draw(random.Random(1), ("parquet",))
    assert (given.kind, given.missing) == ("parquet", "nothing")
    outcome = fuzz.run_one(fuzz.Plan(1, ("parquet",)), 0, fuzz.Limits(SECONDS, 1024))
    assert "skipped: 1 (nothing missing)" in fuzz.table([outcome], 0)


@pytest.mark.slow
def test_many_random_inputs_through_the_program() -> None:
    """All 100,000 take an hour: `python tools/fuzz.py --count 100000`."""
    run(10_000, seed=4, kinds=())
