"""A text goes down the stages of the compiler once: nothing is resolved, lowered or simplified twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import pytest

from stlc.compile import pipeline
from stlc.compile.frontend import resolve as resolving
from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.grammar.spec import Spec
from stlc.lint.lint import Surroundings, lint
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source

TEXT = """
spec twice
time s
signal x in [-1, 1]
require soon: always[0, 1] (x > 0 <-> eventually[0, 0.5] x < 0.5)
require later: always[0, 1] (x > 0 -> shift(x, 0.1 s) > 0)
require back: always[0, 1] (x > 0 -> once[0, 0.3] x < 0.5)
assume small: always[0, 1] x < 1
"""
GRID = Grid(Fraction(1, 10), 20)
SYSTEM = Interface("plant", Signature((Column("x"),)))

Counted = Counter[tuple[str, object]]


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    """(stage, what goes in) -> how often."""
    found: Counted = Counter()

    def watch(module: Any, name: str, key: Callable[..., object]) -> None:
        plain = getattr(module, name)

        def counting(*args: Any, **settings: Any) -> Any:
            found[name, key(*args)] += 1
            return plain(*args, **settings)

        monkeypatch.setattr(module, name, counting)

    watch(resolving, "declared", lambda spec, *_: spec.name)
    watch(resolving, "resolve_formula", lambda expr, *_: expr.span)
    watch(Grid, "in_samples", lambda _, formula, *_rest: formula.span)
    watch(Grid, "lower", lambda _, formula, *_rest: formula)
    return found


def stage(found: Counted, name: str) -> list[int]:
    return [count for (its, _), count in found.items() if its == name]


@pytest.mark.parametrize("purpose", ["train", "check"])
def test_compiling_takes_every_stage_once(counted: Counted, purpose: pipeline.Purpose) -> None:
    pipeline.compile_spec(Spec.parse(Source("a.stl", TEXT)), grid=GRID, interface=SYSTEM, purpose=purpose)
    assert stage(counted, "declared") == [1]
    assert stage(counted, "resolve_formula") == [1] * 4
    assert stage(counted, "in_samples") == [1] * 4


def test_a_monitor_resolves_once_whatever_it_learns_later(counted: Counted) -> None:
    monitor = Monitor(TEXT)
    assert not stage(counted, "in_samples")
    for dt in (0.1, 0.05):
        monitor.online(dt=dt)
        monitor.online(dt=dt)
    assert stage(counted, "declared") == [1]
    assert stage(counted, "resolve_formula") == [1] * 4
    assert stage(counted, "in_samples") == [2] * 4


@pytest.mark.parametrize("within", [None, Surroundings(SYSTEM, GRID)])
def test_lint_resolves_once_and_tells_once(counted: Counted, within: Surroundings | None) -> None:
    text = TEXT.replace("x > 0 <->", "1 / x > 0 <->") + "require never: always[0, 1] (x > 1 and x < 0.5)\n"
    found = lint(Source("a.stl", text), within=within)
    assert stage(counted, "declared") == [1]
    assert stage(counted, "resolve_formula") == [1] * 5
    assert len(set(found)) == len(found)
    assert Counter(finding.code for finding in found)["W505"] == 1
