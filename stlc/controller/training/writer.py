"""Writer of a run's folder while a policy is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from stlc.controller.evaluation.held_out import Score, save_states
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import save_checkpoint
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.run.run import save_config
from stlc.rundir import RunDir, Status


@dataclass(frozen=True, slots=True)
class RunWriter:
    """Writer of a run's folder during training. If several ranks (processes) train, only the first writes.

    Attributes:
        folder: folder of the run.
        writes: whether this process writes.
    """

    folder: RunDir
    writes: bool = True

    def config(self, config: ResolvedConfig) -> None:
        """Write the resolved options of the run."""
        if self.writes:
            save_config(self.folder, config)

    def note(self, facts: Mapping[str, object]) -> None:
        """Add facts to `run.json`."""
        if self.writes:
            self.folder.update(facts)

    def before(self, step: int) -> None:
        """Remove the rows of validations at step `step` and later from `train.jsonl`.

        A resumed training makes these steps again.
        """
        if self.writes:
            self.folder.keep_rows(lambda row: row.get("step", 0) < step)

    def row(self, row: Mapping[str, Any]) -> None:
        """Append a row to `train.jsonl`."""
        if self.writes:
            self.folder.append_row(row)

    def checkpoint(self, tensors: Mapping[str, Tensor], facts: Mapping[str, object], *, step: int) -> None:
        """Write a checkpoint at a step.

        Raises:
            MissingError: R201, the checkpoint cannot be written; the last good one stays.
        """
        if self.writes:
            hashes = self.folder.hashes
            save_checkpoint(self.folder, tensors, {**facts, **hashes}, step=step)

    def held_out(self, task: Task, score: Score) -> None:
        """Save the held-out states and their verdicts."""
        if self.writes:
            save_states(self.folder.place(RunDir.HELD_OUT), task, score)

    def close(self, status: Status, result: object = None) -> None:
        """Write the final status of the run and its result into `run.json`."""
        if self.writes:
            self.folder.finish(status, result)
