"""A budget of a mission stays open while the rate is held; the weights know nothing of it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from stlc.controller.pace import RESERVE, OpenEnd, clock_of


@dataclass
class Pretended:
    """A trainer whose steps and looks cost what they are told to, on a clock of its own."""

    step: int = 0
    steps: int = 100
    now: float = 0.0
    engine: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(hold=0.7, every=50))


def run(budget: float, cost, look) -> tuple[Pretended, list[int]]:
    trainer, end, said = Pretended(), OpenEnd(budget, 0.0), []
    end.mark(trainer, trainer.now)
    while trainer.step < trainer.steps:
        if trainer.step and trainer.step % 50 == 0:
            held = trainer.step <= trainer.engine.hold * trainer.steps
            end.mark(trainer, trainer.now)
            said.append(trainer.steps)
            assert not held or trainer.step <= trainer.engine.hold * trainer.steps
            trainer.now += look(trainer.step)
        trainer.now += cost(trainer.step)
        trainer.step += 1
    assert end.settled
    return trainer, said


@pytest.mark.parametrize("budget", [30.0, 120.0, 600.0])
@pytest.mark.parametrize(
    "look",
    [
        lambda _step: 1.0,
        lambda step: 4.0 if step < 300 else 0.3,
        lambda step: 0.3 if step < 200 else 2.0,
        lambda step: 3.0 * math.exp(-step / 500),
    ],
)
def test_a_budget_is_met_and_not_wasted(budget: float, look) -> None:
    trainer, said = run(budget, lambda _step: 0.05, look)
    assert 0.85 * budget <= trainer.now <= 1.05 * budget * (1 - RESERVE) + 4.0
    assert said[-1] == trainer.steps


def test_steps_that_get_dearer_are_found_out() -> None:
    trainer, _ = run(120.0, lambda step: 0.05 if step < 400 else 0.1, lambda _step: 1.0)
    assert trainer.now == pytest.approx(120.0, rel=0.1)


def test_processor_time_stands_still_while_nothing_is_done() -> None:
    wall, busy = clock_of("wall"), clock_of("processor")
    first = wall(), busy()
    time.sleep(0.1)
    slept = wall() - first[0], busy() - first[1]
    assert slept[0] >= 0.1
    assert slept[1] < 0.05
    while busy() - first[1] < 0.06:
        math.sqrt(2.0)
