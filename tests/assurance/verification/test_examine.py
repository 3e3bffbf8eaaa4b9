"""Batches of boxes: what is proved and what is left, and the same results from other processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pytest
from helpers.small_policies import policy

from stlc.assurance.verification.boxes import Box, whole
from stlc.assurance.verification.examine import BatchResult, BoxBatch, Examiner, SharedExaminer
from stlc.assurance.verification.judged import BoxVerdicts
from stlc.assurance.verification.plans import ProposedPlans
from stlc.assurance.verification.verify import HOPELESS, Verification, Verifier, _Front
from stlc.controller.parallel.workers import NO_FILES, CallFiles, CallWorkers, LostCall


@dataclass(frozen=True)
class Source:
    """The plans of a small random network."""

    def load(self) -> ProposedPlans:
        return ProposedPlans(policy().task, policy())


class Shuffled(CallWorkers):
    """Workers in this process that answer the latest call first, and lose some.

    Attributes:
        losing: numbers of calls that are lost, every time.
    """

    size = 3

    def __init__(self, losing: tuple[int, ...] = ()) -> None:
        self.losing = losing
        self._calls: list[tuple[int, Callable[[Any], Any], object]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._calls.clear()

    @property
    def free(self) -> int:
        return self.size - len(self._calls)

    def submit(
        self,
        key: int,
        function: Callable[[Any], Any],
        argument: object,
        files: CallFiles = NO_FILES,  # noqa: ARG002
    ) -> None:
        self._calls.append((key, function, argument))

    def result(self) -> tuple[int, Any]:
        key, function, argument = self._calls.pop()
        return key, LostCall("gone") if key in self.losing else function(argument)


def batch(mode: int, width: float, count: int = 60, *, dive: bool = False) -> BoxBatch:
    plans, rng = Source().load(), np.random.default_rng(mode)
    coordinates = len(plans.modes[mode].coordinates)
    half = np.full(coordinates, 0.5 * width)
    boxes = [Box(each, half) for each in rng.uniform(half, 1.0 - half, (count, coordinates))]
    return BoxBatch(mode, tuple(boxes), np.ones(coordinates), 3, dive)


@pytest.mark.parametrize(
    ("mode", "dive"),
    [
        (1, False),
        pytest.param(3, False, marks=pytest.mark.apart),
        pytest.param(6, False, marks=pytest.mark.apart),
        (3, True),
        pytest.param(6, True, marks=pytest.mark.apart),
    ],
)
def test_the_boxes_of_a_result_cover_the_batch(mode: int, dive: bool) -> None:
    plans, given = Source().load(), batch(mode, 0.02, dive=dive)
    found = Examiner(plans).examined(given)
    assert found.proved
    parts = [*found.proved, *found.left]
    assert sum(box.volume for box in parts) == pytest.approx(sum(box.volume for box in given.boxes))
    for box in found.proved:
        assert not box.refuted
        assert (plans.choices(plans.states(plans.modes[mode], box.centre[None])).max() >= -1e-6).all()
    if not dive:
        assert len(found.left) == 2 * (60 - len(found.proved))


def test_bounds_that_are_no_numbers_prove_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    plans, given = Source().load(), batch(3, 0.02)
    bound = plans.bound

    def unknown(*args: Any) -> BoxVerdicts:
        found = bound(*args)
        return replace(found, low=np.full_like(found.low, np.nan))

    monkeypatch.setattr(plans, "bound", unknown)
    assert not Examiner(plans).examined(given).proved


def test_a_witness_is_the_worst_sample_that_the_policy_violates() -> None:
    plans = Source().load()
    found = Examiner(plans).examined(batch(2, 0.9, 5))
    assert found.witness is not None
    assert found.witness.robustness < 0
    assert any(box.refuted for box in found.left)


def summary(found: Verification) -> list[tuple[float, float, int]]:
    return [(each.proved, each.refuted, each.examined) for each in found.modes]


@pytest.mark.apart
def test_other_processes_give_the_same_result() -> None:
    here = Verifier(Source().load(), seed=2).run(1e6, boxes=6)
    with SharedExaminer(Source(), Shuffled()) as shared:
        there = Verifier(Source().load(), seed=2, examiner=shared).run(1e6, boxes=6)
    assert shared.processor_time() > 0.0
    assert summary(there) == summary(here)


def test_lost_batches_stay_open() -> None:
    with SharedExaminer(Source(), Shuffled(losing=(0,))) as shared:
        found = Verifier(Source().load(), seed=2, examiner=shared).run(1e6, boxes=1)
    assert shared.lost == ["gone"] * 4  # one call
    assert sum(each.examined == 0 for each in found.modes) == 4
    for each in found.modes:
        assert each.proved + each.refuted + each.open == pytest.approx(1.0)
        assert each.open == pytest.approx(1.0) or each.examined


def test_results_come_in_order() -> None:
    batches = [batch(mode, 0.02, 3) for mode in (0, 1, 2, 3)]
    with SharedExaminer(Source(), Shuffled()) as shared:
        found = list(shared(batches))
    for each, given in zip(found, batches, strict=True):
        assert isinstance(each, BatchResult)
        volume = sum(box.volume for box in (*each.proved, *each.left))
        assert volume == pytest.approx(sum(box.volume for box in given.boxes))


def test_the_largest_box_is_next_and_hopeless_ones_wait() -> None:
    mode = Source().load().modes[0]
    front = _Front(mode)
    (first,) = front.take(5)
    assert (first.volume, whole(mode).volume, len(front)) == (1.0, 1.0, 0)
    half = np.full(2, 0.25)
    front.add(Box(half, half, hopeless=True))
    front.add(Box(half, 0.5 * half))
    assert front.size == pytest.approx(0.0625)
    assert [box.hopeless for box in front.take(2)] == [False, True]
    front.add(Box(half, half, hopeless=True))
    assert front.size == pytest.approx(0.25 / HOPELESS)
