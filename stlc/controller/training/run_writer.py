"""What a training leaves in its run's folder. Of several ranks the first alone writes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stlc.controller.evaluation.held_out import Score, save_states
from stlc.controller.training.checkpoint import save_checkpoint
from stlc.controller.training.run import save_config, spec_hash, system_hash

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig
    from stlc.rundir import RunDir, Status


@dataclass(frozen=True, slots=True)
class RunWriter:
    """A run's folder while its training goes on.

    Attributes:
        folder: of the run.
        writes: whether this process keeps it.
    """

    folder: RunDir
    writes: bool = True

    def engine(self, engine: ResolvedConfig) -> None:
        """Keep what the engine decided."""
        if self.writes:
            save_config(self.folder, engine)

    def note(self, facts: Mapping[str, object]) -> None:
        """Enter facts into `run.json`."""
        if self.writes:
            self.folder.update(facts)

    def before(self, look: int) -> None:
        """Keep the rows of looks before the one at step `look`, which is still to come."""
        if self.writes:
            self.folder.keep_rows(lambda row: row.get("step", 0) < look)

    def row(self, row: Mapping[str, Any]) -> None:
        """Append a row to `train.jsonl`."""
        if self.writes:
            self.folder.append_row(row)

    def checkpoint(self, tensors: Mapping[str, Tensor], facts: Mapping[str, object], *, step: int) -> None:
        """Write a checkpoint of a step. Raises MissingError (R201); the last good one stays."""
        if self.writes:
            hashes = {"spec_hash": spec_hash(self.folder), "system_hash": system_hash(self.folder)}
            save_checkpoint(self.folder, tensors, {**facts, **hashes}, step=step)

    def held_out(self, task: Task, score: Score) -> None:
        """Keep the held-out states and their verdicts."""
        if self.writes:
            save_states(self.folder.path / "eval" / "held_out.npz", task, score)

    def close(self, status: Status, result: object = None) -> None:
        """Say how the training ended."""
        if self.writes:
            self.folder.finish(status, result)
