"""Results of `stlc train`: a run with its verdict, and the runs of several specifications and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from stlc.jsontext import keys_below

if TYPE_CHECKING:
    from stlc.controller.evaluation.closed_loop import ClosedLoop
    from stlc.controller.training.failures import FalsificationRounds
    from stlc.view.learning import Learning


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedTraining:
    """Verdict on a policy: its plans on held-out starts, its drives, and the steps that it took.

    Attributes:
        accuracy: share of held-out starts whose plan satisfies the specification.
        interval: 95 % interval of the accuracy.
        held_out: number of held-out starts.
        requirements: name of a requirement -> share of the starts whose plan satisfies it.
        feasible: share of starts with a known satisfying plan.
        searched: number of starts that were searched or solved.
        judged_seconds: length of the missions, if missions have no end.
        closed_loop: results of drives; None if there were none.
        verdict: how well the policy has learned, and what to do next.
        steps: number of training steps.
        schedule: totals of steps, with which another run repeats the training; None if there are none.
        falsification: rounds of `--falsify`.
    """

    JSON: ClassVar = (
        "accuracy interval held_out requirements feasible searched judged_seconds?? closed_loop?? verdict?? "
        "steps schedule falsification??"
    )
    NAMES: ClassVar = {
        "ClosedLoop": "stlc.controller.evaluation.closed_loop",
        "FalsificationRounds": "stlc.controller.training.failures",
        "Learning": "stlc.view.learning",
    }

    accuracy: float
    interval: Sequence[float]
    held_out: int
    requirements: Mapping[str, float]
    feasible: float
    searched: int
    judged_seconds: float | None = None
    closed_loop: ClosedLoop | None = None
    verdict: Learning | None = None
    steps: int | None = None
    schedule: str | None = None
    falsification: FalsificationRounds | None = None


@dataclass(frozen=True, slots=True)
class TrainedRun:
    """A run, the duration of its training in seconds, and its verdict; None if it was interrupted."""

    JSON: ClassVar = f"run seconds {keys_below('judged', JudgedTraining)}"

    run: str
    seconds: float
    judged: JudgedTraining | None = None


@dataclass(frozen=True, slots=True)
class TrainedJob:
    """One training of several, as its process told it.

    Attributes:
        spec: file of the specification.
        seed: seed of the run; None: that of the system file.
        exit_code: exit code of its process.
        why: cause of a failure; None if it did not fail.
        trained: its run; None if there is none. What the run has of verdict and drives is JSON data.
    """

    JSON: ClassVar = f"spec seed?? exit_code why?? {keys_below('trained', TrainedRun)}"

    spec: str
    seed: int | None
    exit_code: int
    why: str | None = None
    trained: TrainedRun | None = None


@dataclass(frozen=True, slots=True)
class TrainedRuns:
    """Several trainings."""

    runs: Sequence[TrainedJob]
