"""Guards as registered objects: names, order, words, versions, and a guard from elsewhere."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
import torch
from helpers.other_guard import PACKAGES, write_guard

from stlc.controller.guard import kind
from stlc.controller.guard.candidates import POLICY, REPAIRED
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kind import GuardKind, compared_guards, named_guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.stages import STAGES
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.registry import GUARDS
from tests.controller.guard.test_prefix_shooting import Constant, failing


def test_guards_are_listed_by_the_cost_of_a_decision() -> None:
    assert GUARDS.names == ("none", "paper", "full", "certified")
    for name, guard in GUARDS.loaded().items():
        assert (guard.name, {*guard.stages} <= {*STAGES}) == (name, True)
    costs = [guard.cost for guard in GUARDS.loaded().values()]
    assert costs == sorted({*costs})
    with pytest.raises(UsageError, match="unknown guard `certifed`") as caught:
        GUARDS.get("certifed")
    assert "did you mean `certified`?" in caught.value.diagnostics[0].help[0]


def test_the_default_guard_is_the_only_one_that_never_intervenes() -> None:
    assert [name for name, guard in GUARDS.loaded().items() if not guard.intervenes] == [GUARDS.default]
    assert compared_guards() == ("none", "paper", "full")


def test_guards_are_listed_without_libraries() -> None:
    program = "import sys\nfrom stlc.registry import GUARDS\nprint(*GUARDS.loaded())\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    names, modules = (line.split() for line in done.stdout.splitlines())
    assert names == [*GUARDS]
    assert not {"torch", "numpy", "lark", "yaml", "typer"} & {*modules}


@pytest.mark.parametrize(
    ("name", "noun", "beside", "option"),
    [
        ("none", "no guard", "without a guard", ""),
        ("paper", "the paper's guard", "with the paper's guard", "--backup"),
        ("full", "the full guard", "with the full guard", "--guard full"),
        ("theirs", "the guard theirs", "with the guard theirs", "--guard theirs"),
    ],
)
def test_words(name: str, noun: str, beside: str, option: str) -> None:
    """Records may name a guard that is not installed."""
    guard = named_guard(name)
    assert (guard.noun, guard.beside, guard.option) == (noun, beside, option)
    assert (name in GUARDS) == (guard is GUARDS.loaded().get(name))


def test_versions_rise_with_what_all_guards_share_and_with_what_is_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    revised = GuardKind(name="revised", title="revised guard", cost=1, revision=2)
    assert (PAPER.version, revised.version) == (1, 3)
    monkeypatch.setattr(kind, "GUARD_VERSION", kind.GUARD_VERSION + 1)
    assert (PAPER.version, revised.version) == (2, 4)


@pytest.fixture
def braking(tmp_path: Path) -> Iterator[str]:
    """Name of a guard in files of its own."""
    for folder, package in PACKAGES.items():
        import_module(package).__path__.append(str(tmp_path / folder))
    yield write_guard(tmp_path)
    for package, module in zip(PACKAGES.values(), ("braking", "full_braking"), strict=True):
        import_module(package).__path__.pop()
        sys.modules.pop(f"{package}.{module}", None)
        for registry in (GUARDS, STAGES):
            registry._entries.pop(module, None)


def test_a_guard_is_its_file_and_its_stage(car_task: Task, braking: str) -> None:
    """Full braking first; what it cannot save is left to prefix shooting, now a last resort."""
    x, plan = failing(car_task, 10.0, n=60)
    guard = Guard(car_task, Constant(car_task, 10.0), braking)
    assert [type(stage).__name__ for stage in guard.backup.stages] == ["Braking", "PrefixShooting"]  # type: ignore[union-attr]
    assert guard.backup.stages[1].last_resort  # type: ignore[union-attr]
    decision = guard.decide(x)
    braked = decision.source == REPAIRED
    assert bool(braked.any())
    assert bool((decision.plan[braked] == car_task.system.control_low).all())
    followed = decision.source == POLICY
    assert torch.equal(decision.plan[followed], plan[followed])
