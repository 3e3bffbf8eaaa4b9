"""Training from beginning to end: steps, search rounds, rows, checkpoints, the verdict on held-out states."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from stlc.controller.autopsy import Step, autopsy
from stlc.controller.checkpoint import load_checkpoint, restoring
from stlc.controller.config import Engine, TrainConfig, decide
from stlc.controller.conflict import conflict
from stlc.controller.held_out import Score, score
from stlc.controller.journal import Journal
from stlc.controller.natives import by_torch
from stlc.controller.pace import PROVISIONAL, Pace, StepSchedule, clock_of, verdict_reserve
from stlc.controller.ranks import ALONE, Ranks
from stlc.controller.run import Run, load_engine, load_task, spec_hash, system_hash
from stlc.controller.symmetry import check_mirror
from stlc.controller.trainer import Look, Trainer
from stlc.diagnostics import Diagnostic, MissingError, RunError, StlcError, UsageError
from stlc.dynamics.memory import keep_freed_memory

if TYPE_CHECKING:
    from collections.abc import Callable

    from stlc.controller.task import Task
    from stlc.rundir import RunDir

DEFAULT_BUDGET = 60.0
BARREN_LOOKS, BARREN_SHARE = 5, 0.1
"""After so many looks, and this share of the steps, a search that never found a plan is given up."""
VERDICT_OVER = 0.04
"""Share of a budget by which the verdict may exceed it before the search for what is feasible is ended."""
SAVE_EVERY = 500
"""Steps between checkpoints at most."""
SAVE_SECONDS = 10.0
"""Seconds between checkpoints at most: what a kill can cost."""


@dataclass(frozen=True, slots=True)
class Watch:
    """How the outside follows a run and ends it early.

    Attributes:
        begun: called once with what the engine chose, the margin and the number of steps among it.
        row: called with every row of `train.jsonl`.
        stop: asked after every step; True saves and ends.
    """

    begun: Callable[[dict[str, Any]], None] = lambda _chosen: None
    row: Callable[[dict[str, Any]], None] = lambda _row: None
    stop: Callable[[], bool] = lambda: False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What training gave.

    Attributes:
        run: the run with its policy.
        score: on held-out states; None where training was interrupted, and on ranks after the first.
        seconds: of training, held-out verdict included.
        steps: that were made in all.
        interrupted: ended by `Watch.stop`.
        ranks: that trained together.
        why: why no plan satisfies the specification, where none was found for any start.
    """

    run: Run
    score: Score | None
    seconds: float
    interrupted: bool
    ranks: int = 1
    why: Diagnostic | None = None
    steps: int = 0


def train(
    task: Task,
    config: TrainConfig,
    folder: RunDir,
    watch: Watch | None = None,
    *,
    ranks: Ranks = ALONE,
) -> Outcome:
    """Train a policy in a new run folder that already holds its specification and system.

    Args:
        task: what to train for.
        config: what the user said.
        folder: of the run.
        watch: progress and interruption.
        ranks: that train together; each calls this at the same time, and the first one writes.

    Raises:
        SystemFileError: S301, hardly any initial state is possible; S304, the mirror of the policy is no
            symmetry.
        MissingError: R201, a checkpoint cannot be written; R302, there is no such device; R403, a rank
            is gone.
        RunError: R401, the loss or its gradient is not finite.
        SystemFileError: S302, states are not.
    """
    begun = clock_of(config.clock)()
    keep_freed_memory()
    task.system.initial.require_many()
    check_mirror(task)
    device = find_device(ranks.device(config.device))
    engine = replace(decide(task, config), ranks=ranks.size)
    torch.set_num_threads(engine.threads)
    journal = Journal(folder, writes=ranks.first)
    journal.engine(engine)
    declared = task.system.decl.train
    told = config.steps or (declared.steps if config.budget is None else None)
    budget = 0.0 if told is not None else config.budget or declared.budget or DEFAULT_BUDGET
    schedule = told if isinstance(told, StepSchedule) else StepSchedule.of(told or PROVISIONAL)
    trainer = Trainer(task, engine, steps=schedule.at(0), device=device, ranks=ranks)
    journal.note({"margin": trainer.margin, "engine": asdict(engine), "seconds_allowed": budget or None})
    return _Session(journal, trainer, watch or Watch(), begun, schedule, budget).finish()


def resume(
    folder: RunDir,
    *,
    steps: int | None = None,
    budget: float | None = None,
    device: str = "cpu",
    watch: Watch | None = None,
    ranks: Ranks = ALONE,
) -> Outcome:
    """Go on with a run that was interrupted; the weights become those of an uninterrupted run, bit for bit.

    Args:
        folder: of the run.
        steps: a new total of steps.
        budget: seconds more; where neither is given, what is left of the budget of the run is used, or its
            schedule of steps is followed to its end.
        device: of torch.
        watch: progress and interruption.
        ranks: that train together: as many as before.

    Raises:
        RunError: R101, R102, or R103 when there is nothing left to do.
        UsageError: R104, the run was trained by another number of ranks.
    """
    keep_freed_memory()
    engine: Engine = load_engine(folder)
    _require_as_many(engine.ranks, ranks.size)
    begun = clock_of(engine.clock)()
    task = load_task(folder)
    saved = load_checkpoint(folder, spec_hash=spec_hash(folder), system_hash=system_hash(folder))
    if engine.threads:
        torch.set_num_threads(engine.threads)
    place = find_device(ranks.device(device))
    seconds = (row.get("seconds") for row in folder.rows())
    before = max((spent for spent in seconds if isinstance(spent, int | float)), default=0.0)
    with restoring(folder):
        trainer = Trainer(task, engine, steps=int(saved.facts["steps"]), device=place, ranks=ranks)
        trainer.restore(saved.tensors, saved.facts)
        schedule = StepSchedule.parse(str(saved.facts.get("schedule", trainer.steps)))
        before = float(saved.facts.get("seconds", before))
        allowed = 0.0 if steps is not None else float(folder.record().get("seconds_allowed") or 0.0)
    if steps is not None:
        schedule = schedule.with_steps(trainer.step, steps)
        trainer.steps = steps
    if budget is not None:
        allowed = before + budget
        schedule = schedule.with_steps(trainer.step, trainer.step + PROVISIONAL)
    if trainer.step >= schedule.steps and folder.status == "finished":
        raise RunError(
            Diagnostic(
                "R103",
                f"run `{folder.name}` is finished: {trainer.step} of {schedule.steps} steps",
                help=(f"stlc train --resume {folder.name} --budget 60s goes on",),
            )
        )
    journal = Journal(folder, writes=ranks.first)
    journal.before(trainer.next_look)
    journal.note({"status": "running", "seconds_allowed": allowed or None})
    return _Session(journal, trainer, watch or Watch(), begun - before, schedule, allowed).finish()


def _require_as_many(before: int, now: int) -> None:
    """Raise UsageError (R104) where a run is not gone on with by as many ranks as it was begun by."""
    if before != now:
        start = f"torchrun --nproc-per-node {before} -m stlc" if before > 1 else "stlc"
        raise UsageError(
            Diagnostic(
                "R104",
                f"the run was trained by {before} process{'es' if before > 1 else ''} together, not by {now}",
                help=(f"{start} train --resume RUN",),
                note=("every one of them has states of its own, which the run goes on with",),
            )
        )


def find_device(name: str) -> torch.device:
    """A torch device. Raises MissingError R302 where it is not there."""
    try:
        best = "cuda" if torch.cuda.is_available() else "cpu"
        device = torch.device(best if name == "auto" else name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise MissingError(
            Diagnostic(
                "R302", f"there is no device `{name}` here", help=("use --device cpu",), note=(reason,)
            )
        ) from error
    return device


def _searching(trainer: Trainer) -> bool:
    """Whether a search goes on beside the steps at this moment."""
    return trainer.repairing is not None and not trainer.repairing.done()


class _Session:
    """One sitting of training: from wherever the trainer stands to the end, or to an interruption."""

    def __init__(
        self,
        journal: Journal,
        trainer: Trainer,
        watch: Watch,
        begun: float,
        schedule: StepSchedule,
        budget: float = 0.0,
    ) -> None:
        """A sitting that counts its time from `begun`.

        `schedule` is followed to its end; with a `budget` (seconds from `begun`) it is planned again and
        again as the pace demands.
        """
        self.journal = journal
        self.trainer = trainer
        self.watch = watch
        self.begun = begun
        self.schedule = schedule
        self.budget = budget
        self.now = clock_of(trainer.engine.clock)
        searching = trainer.engine.method == "guided"
        self.pace = Pace(every=trainer.engine.every, searching=searching, now=self.now(), seconds=budget)
        self.barren = not trainer.ranks.any(trainer.buffer.count > 0)

    def finish(self) -> Outcome:
        """Train to the end, judge, and close the record."""
        trainer = self.trainer
        torch_does = by_torch(trainer.task, trainer.engine, trainer.device.type)
        self.journal.note({"by_torch": dict(torch_does)})
        self._note_schedule()
        chosen = {**asdict(trainer.engine), "margin": trainer.margin, "budget": self.budget or None}
        self.watch.begun({**chosen, "steps": self._known_steps, "by_torch": torch_does})
        saved = time.perf_counter()
        while self._goes_on():
            if trainer.step >= trainer.next_look and self._hopeless(self._look()):
                self._save()
                break
            if not math.isfinite(trainer.advance()):
                raise self._broken()
            self.pace.stepped(trainer.step, self.now(), search_runs=_searching(trainer))
            due = trainer.step % SAVE_EVERY == 0 or time.perf_counter() - saved > SAVE_SECONDS
            if trainer.ranks.any(due):
                self._save()
                saved = time.perf_counter()
            if trainer.ranks.any(self.watch.stop()) and trainer.step < self.schedule.steps:
                return self._interrupted()
        return self._judged() if trainer.ranks.first else self._ended()

    def _goes_on(self) -> bool:
        """Whether there is a step to make; where there is none, everything is saved.

        To save is to wait for the search that goes on beside the steps. Where that took less than was
        expected there is time for more steps.
        """
        if self._planned() > self.trainer.step:
            return True
        self._save()
        return self._planned() > self.trainer.step

    def _planned(self) -> int:
        """The steps of the run as they are planned at this moment: by its budget, or by its schedule."""
        trainer = self.trainer
        if self.budget:
            left = self.begun + self.budget - verdict_reserve(self.budget) - self.now()
            steps = self.pace.plan(trainer.step, trainer.steps, trainer.next_look, left)
            steps = int(trainer.ranks.agree(steps))
            if steps != trainer.steps:
                self.schedule = self.schedule.with_steps(trainer.step, steps)
                self._note_schedule()
        trainer.steps = self.schedule.at(trainer.step)
        return trainer.steps

    @property
    def _known_steps(self) -> int | None:
        """Steps of the whole run; None until those of a budget have been planned."""
        return None if self.budget and not self.pace.planned else self.schedule.steps

    def _note_schedule(self) -> None:
        self.journal.note({"steps": self._known_steps, "schedule": str(self.schedule)})

    def _look(self) -> Look:
        """A search round, and its row."""
        trainer = self.trainer
        self._wait_for_search()
        began = self.now()
        look = trainer.look()
        self.pace.looked(trainer.step, self.now() - began)
        self._row(look)
        return look

    def _wait_for_search(self) -> None:
        """Let the search beside the steps come to its end, as a search round and a checkpoint do."""
        if self.trainer.repairing is not None:
            began = self.now()
            self.trainer.repairing.result()
            self.pace.searched(self.trainer.step, self.now() - began)

    def _hopeless(self, look: Look) -> bool:
        """Whether neither the policy nor the search has ever satisfied the specification for any state."""
        trainer = self.trainer
        self.barren = self.barren and look.accuracy == 0.0 and look.repaired == 0
        enough = max(BARREN_LOOKS * trainer.engine.every, BARREN_SHARE * trainer.steps)
        return self.barren and trainer.engine.method == "guided" and trainer.step >= enough

    def _judged(self) -> Outcome:
        self.trainer.average.cpu()  # verdicts are float64, and the kernel's
        result = score(self.trainer.policy, n=self.trainer.engine.held_out, enough=self._out_of_time)
        self.journal.held_out(self.trainer.task, result)
        seconds = self.now() - self.begun
        why = conflict(self.trainer.task) if result.feasible == 0.0 else None
        found = {"seconds": seconds} if why is None else {"seconds": seconds, "why": why.message}
        self.journal.close("finished", {**result.summary(), **found})
        return replace(self._ended(), score=result, why=why)

    def _out_of_time(self) -> bool:
        """Whether the verdict of a run with a budget has to come to its end."""
        return self.budget > 0.0 and self.now() - self.begun > (1.0 + VERDICT_OVER) * self.budget

    def _interrupted(self) -> Outcome:
        self._save()
        self.journal.close("interrupted")
        return self._ended(interrupted=True)

    def _ended(self, *, interrupted: bool = False) -> Outcome:
        run = Run(self.journal.folder, self.trainer.task, self.trainer.policy)
        seconds, ranks = self.now() - self.begun, self.trainer.ranks.size
        steps = self.trainer.step
        return Outcome(run, None, seconds, interrupted=interrupted, ranks=ranks, steps=steps)

    def _save(self) -> None:
        """Write a checkpoint; it waits for the search that goes on beside the steps."""
        self._wait_for_search()
        began = self.now()
        facts = {**self.trainer.facts(), "schedule": str(self.schedule), "seconds": began - self.begun}
        self.journal.checkpoint(self.trainer.tensors(), facts, step=self.trainer.step)
        self.pace.saved(self.now() - began)

    def _row(self, look: Look) -> None:
        trainer = self.trainer
        rest = max(1, trainer.steps - trainer.step)
        names = [rule.name for rule in trainer.task.rules]
        row = {
            "step": trainer.step,
            "steps": trainer.steps,
            "seconds": self.now() - self.begun,
            "loss": trainer.loss,
            "accuracy": look.accuracy,
            "requirements": dict(zip(names, look.requirements, strict=True)),
            "feasible": look.feasible,
            "lr": trainer.rate,
            "repaired": look.repaired,
            "failing": look.failing,
            "s_per_step": self.pace.remaining(trainer.step, trainer.steps, trainer.next_look) / rest,
        }
        self.journal.row(row)
        self.watch.row(row)

    def _broken(self) -> StlcError:
        """What broke a step, of whichever rank. The weights are those before it: they are kept if good."""
        trainer = self.trainer
        theirs = [part["x0"].to(trainer.device) for part in trainer.ranks.gather({"x0": trainer.learnt})]
        x0 = torch.cat((trainer.learnt, *theirs))
        step = Step.of(trainer.network, trainer.objective, x0, trainer.step, trainer.task)
        good = not trainer.ranks.any(not bool(torch.isfinite(step.u).all()))
        if good:
            self._save()
        self.journal.close("failed")
        error = autopsy(step)
        kept = (
            "the run keeps the weights before that step" if good else "the last checkpoint of the run is kept"
        )
        return type(error)(*(finding.with_note(kept) for finding in error.diagnostics))
