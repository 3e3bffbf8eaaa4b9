"""Training from beginning to end: steps, search rounds, rows, checkpoints, the verdict on held-out states."""

from __future__ import annotations

import math
import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from stlc.controller.evaluation.closed_loop import ClosedLoop, closed_loop
from stlc.controller.evaluation.closed_loop import reserve as drive_reserve
from stlc.controller.evaluation.held_out import Score, score
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.natives import by_torch
from stlc.controller.problem.symmetry import check_mirror
from stlc.controller.training.budget import PROVISIONAL, Pace, StepSchedule, clock_of, verdict_reserve
from stlc.controller.training.checkpoint import load_checkpoint, never_saved, restoring
from stlc.controller.training.config import ResolvedConfig, TrainConfig, resolve_config
from stlc.controller.training.conflict import conflict, refuted
from stlc.controller.training.divergence import Step, diagnose
from stlc.controller.training.learner import Trainer, Validation
from stlc.controller.training.run import Run, load_config, load_task, spec_hash, system_hash
from stlc.controller.training.run_writer import RunWriter
from stlc.diagnostics import Diagnostic, MissingError, RunError, StlcError, UsageError
from stlc.dynamics.model.memory import keep_freed_memory
from stlc.native import never

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import AbstractContextManager

    from stlc.controller.problem.task import Task
    from stlc.rundir import RunDir

DEFAULT_BUDGET = 60.0
BARREN_LOOKS, BARREN_SHARE = 5, 0.1
"""After so many looks, and this share of the steps, a search that never found a plan is given up.

It has explored with all the effort there is by then; where it is proved that there is no plan, the first look
is the last.
"""
VERDICT_OVER = 0.04
"""Share of a budget by which the verdict may exceed it before the search for what is feasible is ended."""
DRIVE_SHARE = 0.15
"""Share of the seconds that a training without a budget took, in which the policy is driven."""
VERDICT_LEAST, VERDICT_SHARE = 20.0, 0.2
"""Seconds, and share of the seconds that the steps took, which the verdict of a run without a budget has."""
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
        deferring: holds while steps are made: who asks to stop then has the step finished and saved.
            Otherwise an interruption may be raised anywhere.
        late: seconds by which what is done before and after the training would exceed a budget of wall time.
    """

    begun: Callable[[dict[str, Any]], None] = lambda _chosen: None
    row: Callable[[dict[str, Any]], None] = lambda _row: None
    stop: Callable[[], bool] = never
    deferring: Callable[[], AbstractContextManager[object]] = nullcontext
    late: Callable[[float], float] = lambda _budget: 0.0


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
        why: which requirements no plan was found for, where none was found for any start.
        driven: the policy in closed loop; None where it was not driven.
    """

    run: Run
    score: Score | None
    seconds: float
    interrupted: bool
    ranks: int = 1
    why: Diagnostic | None = None
    steps: int = 0
    driven: ClosedLoop | None = None


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
    engine = replace(resolve_config(task, config), ranks=ranks.size)
    declared = task.system.decl.train
    told = config.steps or (declared.steps if config.budget is None else None)
    budget = 0.0 if told is not None else config.budget or declared.budget or DEFAULT_BUDGET
    schedule = told if isinstance(told, StepSchedule) else StepSchedule.of(told or PROVISIONAL)
    journal = RunWriter(folder, writes=ranks.first)
    journal.engine(engine)
    journal.note({"engine": asdict(engine), "schedule": str(schedule), "seconds_allowed": budget or None})
    task.system.initial.require_many()
    check_mirror(task)
    device = find_device(ranks.device(config.device))
    torch.set_num_threads(engine.threads)
    trainer = Trainer(task, engine, steps=schedule.at(0), device=device, ranks=ranks)
    journal.note({"margin": trainer.margin})
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
    engine: ResolvedConfig = load_config(folder)
    _require_as_many(engine.ranks, ranks.size)
    begun = clock_of(engine.clock)()
    task = load_task(folder)
    if engine.threads:
        torch.set_num_threads(engine.threads)
    place = find_device(ranks.device(device))
    facts: Mapping[str, Any] = folder.record()
    saved = None
    if not never_saved(folder) or "schedule" not in facts:
        saved = load_checkpoint(folder, spec_hash=spec_hash(folder), system_hash=system_hash(folder))
        facts = saved.facts
    seconds = (row.get("seconds") for row in folder.rows())
    before = max((spent for spent in seconds if isinstance(spent, int | float)), default=0.0)
    with restoring(folder):
        schedule = StepSchedule.parse(str(facts.get("schedule", facts.get("steps"))))
        before = float(facts.get("seconds", before))
        allowed = 0.0 if steps is not None else float(folder.record().get("seconds_allowed") or 0.0)
        planned = schedule.at(0) if saved is None else int(facts["steps"])
        trainer = Trainer(task, engine, steps=planned, device=place, ranks=ranks)
        if saved is not None:
            trainer.restore(saved.tensors, saved.facts)
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
    journal = RunWriter(folder, writes=ranks.first)
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
        journal: RunWriter,
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
        late = watch.late(budget) if budget and trainer.engine.clock == "wall" else 0.0
        self._seconds = min(budget, max(budget - late, 0.5 * budget))
        self.now = clock_of(trainer.engine.clock)
        self.trained = begun
        searching = trainer.engine.method == "guided"
        self.pace = Pace(
            every=trainer.engine.every, searching=searching, now=self.now(), seconds=self._seconds
        )
        self.barren = not trainer.ranks.any(trainer.buffer.count > 0)
        self.refuted: bool | None = None
        self.exhausted = False

    def finish(self) -> Outcome:
        """Train to the end, judge, and close the record.

        Whatever interrupts it leaves the last checkpoint, from which `resume` goes on.
        """
        trainer = self.trainer
        torch_does = by_torch(trainer.task, trainer.engine, trainer.device.type)
        self.journal.note({"by_torch": dict(torch_does)})
        self._note_schedule()
        chosen = {**asdict(trainer.engine), "margin": trainer.margin, "budget": self.budget or None}
        self.watch.begun({**chosen, "steps": self._known_steps, "by_torch": torch_does})
        try:
            with self.watch.deferring():
                whole = self._trained()
                if not whole:
                    return self._interrupted()
            return self._judged() if trainer.ranks.first else self._ended()
        finally:
            trainer.close()

    def _trained(self) -> bool:
        """Make all steps; False where the run is to stop before."""
        trainer, saved = self.trainer, time.perf_counter()
        while (more := self._goes_on()) and not self._hopeless():
            if not math.isfinite(trainer.advance()):
                raise self._broken()
            self.pace.stepped(trainer.step, self.now(), search_runs=_searching(trainer))
            due = trainer.step % SAVE_EVERY == 0 or time.perf_counter() - saved > SAVE_SECONDS
            if trainer.ranks.any(due):
                self._save()
                saved = time.perf_counter()
            if trainer.ranks.any(self.watch.stop()):
                return False
        if more is None:
            return False
        self._save()
        return not trainer.ranks.any(self.watch.stop())

    def _goes_on(self) -> bool | None:
        """Whether there is a step to make, after a search round where one is due; None: the run is to stop.

        Both the end and a round wait for the search that goes on beside the steps. Where at the end that
        takes less than was expected there is time for more steps.
        """
        trainer = self.trainer
        ends = self._planned() <= trainer.step
        if (ends or trainer.step >= trainer.next_look) and not self._wait_for_search():
            return None
        if ends and self._planned() <= trainer.step:
            return False
        if trainer.step >= trainer.next_look:
            began = self.now()
            if trainer.ranks.any(not trainer.explore(self.watch.stop)):
                return None
            self._look(began)
        return True

    def _planned(self) -> int:
        """The steps of the run as they are planned at this moment: by its budget, or by its schedule."""
        trainer = self.trainer
        if self.budget:
            left = self.begun + self._seconds - self._reserve - self.now()
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

    def _look(self, began: float) -> None:
        """A search round that began at a time, and its row."""
        trainer = self.trainer
        look = trainer.look()
        self.pace.looked(trainer.step, self.now() - began)
        self._row(look)
        self.barren = self.barren and look.accuracy == 0.0 and look.repaired + look.explored == 0
        self.exhausted = not trainer.ranks.any(not trainer.exhausted)
        if self.barren and self.refuted is None and trainer.engine.method == "guided":
            self.refuted = trainer.ranks.any(refuted(trainer.task))

    def _wait_for_search(self) -> bool:
        """Let the search beside the steps come to its end; False where the run is to stop before."""
        came = True
        if self.trainer.repairing is not None:
            began = self.now()
            came = self.trainer.repairing.result(self.watch.stop) is not None
            self.pace.searched(self.trainer.step, self.now() - began)
        return not self.trainer.ranks.any(not came)

    def _hopeless(self) -> bool:
        """Whether neither the policy nor the search has ever satisfied the specification for any state."""
        trainer = self.trainer
        enough = max(BARREN_LOOKS * trainer.engine.every, BARREN_SHARE * trainer.steps)
        if not self.barren or trainer.engine.method != "guided":
            return False
        return bool(self.refuted) or (self.exhausted and trainer.step >= enough)

    def _judged(self) -> Outcome:
        self.trained = self.now()
        self.trainer.average.cpu()  # verdicts are float64, and the kernel's
        result = score(self.trainer.policy, n=self.trainer.engine.held_out, enough=self._out_of_time)
        self.journal.held_out(self.trainer.task, result)
        why = conflict(self.trainer.task, self._late) if result.feasible == 0.0 else None
        driven = self._driven() if why is None else None
        found: dict[str, object] = {"seconds": self.now() - self.begun}
        if why is not None:
            found |= {"why": why.message, "proved": refuted(self.trainer.task)}
        found |= {} if driven is None else {"closed_loop": driven.summary()}
        self.journal.close("finished", {**result.summary(), **found})
        return replace(self._ended(), score=result, why=why, driven=driven)

    def _driven(self) -> ClosedLoop | None:
        """The policy in closed loop, for as long as there is time."""
        drives = self.trainer.engine.drives
        if not drives:
            return None
        run = Run(self.journal.folder, self.trainer.task, self.trainer.policy)
        begun = self.now()
        if self.budget:
            end = self.begun + (1.0 + VERDICT_OVER) * self._seconds
            end = max(end, begun + 0.5 * drive_reserve(self._seconds))
        else:
            end = begun + DRIVE_SHARE * (begun - self.begun)
        return closed_loop(run, lambda: end - self.now(), drives)

    @property
    def _reserve(self) -> float:
        """Seconds of the budget for what follows the steps."""
        drives = drive_reserve(self._seconds) if self.trainer.engine.drives else 0.0
        return verdict_reserve(self._seconds) + drives

    def _out_of_time(self) -> bool:
        """Whether the verdict has to come to its end."""
        return self.now() - self.trained > self._verdict_seconds

    def _late(self) -> bool:
        """Whether what follows the verdict has to come to its end, too."""
        return self.now() - self.trained > 2.0 * self._verdict_seconds

    @property
    def _verdict_seconds(self) -> float:
        """What is left of the budget for the verdict; without a budget a share of what the steps took."""
        spent = self.trained - self.begun
        if not self.budget:
            return max(VERDICT_LEAST, VERDICT_SHARE * spent)
        drives = self._reserve - verdict_reserve(self._seconds)
        left = (1.0 + VERDICT_OVER) * self._seconds - drives - spent
        return max(left, 0.5 * verdict_reserve(self._seconds))

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
        """Write a checkpoint; of a search that goes on beside the steps it keeps what that begins with."""
        began = self.now()
        facts = {**self.trainer.facts(), "schedule": str(self.schedule), "seconds": began - self.begun}
        self.journal.checkpoint(self.trainer.tensors(), facts, step=self.trainer.step)
        self.pace.saved(self.now() - began)

    def _row(self, look: Validation) -> None:
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
            "explored": look.explored,
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
        error = diagnose(step)
        kept = (
            "the run keeps the weights before that step" if good else "the last checkpoint of the run is kept"
        )
        return type(error)(*(finding.with_note(kept) for finding in error.diagnostics))
