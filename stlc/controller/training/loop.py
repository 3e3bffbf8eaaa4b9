"""Training loop: steps, validations, rows of `train.jsonl`, checkpoints, and the final evaluation."""

from __future__ import annotations

import ctypes
import math
import sys
import time
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import torch

from stlc.controller.evaluation.held_out import silent
from stlc.controller.parallel.ddp import ALONE, Ranks, find_device
from stlc.controller.run.checkpoint import Checkpoint, load_checkpoint, never_saved, restoring
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.run.run import Run, load_config
from stlc.controller.search.conflict import refuted
from stlc.controller.training.budget import PROVISIONAL, Pace, StepSchedule, TimeBudget, clock_of
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.diagnose import check_mirror
from stlc.controller.training.failures import SHARE, FailureSearch
from stlc.controller.training.final_evaluation import FinalEvaluation, TrainingOutcome
from stlc.controller.training.writer import RunWriter
from stlc.diagnostics import RunError, StlcError, usage
from stlc.native import never
from stlc.registry import METHODS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from stlc.controller.problem.task import Task
    from stlc.controller.training.method import Learner, Method, Validation
    from stlc.rundir import RunDir

DEFAULT_BUDGET = 60.0
BARREN_VALIDATIONS, BARREN_SHARE = 5, 0.1
"""If no plan was ever found, training ends after this many validations, but not before this share of steps.

By then the longest search for plans has been made. If bounds prove that no plan exists, training ends at the
first validation.
"""
SAVE_EVERY = 500
"""Maximum number of steps between checkpoints."""
SAVE_SECONDS = 10.0
"""Maximum number of seconds between checkpoints, and so the most that a killed run loses."""


@cache
def keep_freed_memory() -> bool:
    """Tell the C library not to return freed memory to the operating system; True on success.

    A rollout allocates and frees the same few arrays of some 100 kB in every step. By default glibc returns
    them, and mapping and clearing their pages again takes as long as the rollout itself. The setting affects
    the whole process. So programs such as `stlc train` call this function; importing the package does not.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    trim_threshold, mmap_threshold = -1, -3  # of <malloc.h>; 32 MB is the most that glibc accepts
    return bool(mallopt(mmap_threshold, 32 * 2**20)) and bool(mallopt(trim_threshold, 2**31 - 1))


@dataclass(frozen=True, slots=True)
class Watch:
    """Callbacks of a training run.

    Attributes:
        started: receives, at the start, the options of the run. Among them are `margin`, the robustness that
            plans are trained to reach, and `steps`, the number of training steps.
        row: receives every row of `train.jsonl`.
        stop: is called after every step. If it returns True, the state is saved and the training ends.
        deferring: makes a context manager, which is active during the steps. Inside it, an interrupt is
            deferred until the present step is finished and saved. Outside it, an interrupt may be raised
            anywhere.
        late: receives a budget of wall time in seconds. It predicts by how many seconds the whole command
            would exceed the budget if the training used all of it; loading, for example, takes time too.
        evaluating: receives the progress of the final evaluation, as a short text.
    """

    started: Callable[[dict[str, Any]], None] = lambda _chosen: None
    row: Callable[[dict[str, Any]], None] = lambda _row: None
    stop: Callable[[], bool] = never
    deferring: Callable[[], AbstractContextManager[object]] = nullcontext
    late: Callable[[float], float] = lambda _budget: 0.0
    evaluating: Callable[[str], None] = silent


@dataclass(frozen=True, slots=True)
class Preparation:
    """A training that has not begun: what can be refused has been accepted, and no file is written.

    Attributes:
        task: problem to train for.
        config: the resolved options.
        learner: state before the first step; None if the method plans without training.
        schedule: number of steps.
        budget: training time in seconds; 0 if the schedule alone decides.
        now: clock of the budget, in seconds.
        started: time on that clock when the preparation began, which belongs to the budget.
        ranks: processes that train together.
        failures: search for failing drives, of a training with `--falsify`.
    """

    task: Task
    config: ResolvedConfig
    learner: Learner | None
    schedule: StepSchedule
    budget: float
    now: Callable[[], float]
    started: float
    ranks: Ranks
    failures: FailureSearch | None

    def run(self, folder: RunDir, watch: Watch | None = None) -> TrainingOutcome:
        """Train a policy in a new run folder that already holds its specification and system.

        Args:
            folder: folder of the run; of several ranks, only the first writes files.
            watch: functions that are called during the run; see `Watch`.

        Raises:
            MissingError: R201, a checkpoint cannot be written; R403, the process of another rank has ended or
                does not answer.
            RunError: R401, the loss or its gradient is not finite; R109, another process trains there.
        """
        watch, resolved, learner = watch or Watch(), self.config, self.learner
        budget, schedule = self.budget, self.schedule
        with _alone(folder, self.ranks):
            writer = RunWriter(folder, writes=self.ranks.first)
            writer.config(resolved)
            chosen = {"engine": asdict(resolved), "schedule": str(schedule)}
            writer.note({**chosen, "seconds_allowed": budget or None})
            late = watch.late if resolved.clock == "wall" else None
            allowed = TimeBudget.of(self.now, self.started, budget, late)
            if learner is None:
                method: Method = METHODS.get(resolved.method)
                return _without_steps(method, self.task, resolved, writer, allowed, watch)
            writer.note({"margin": learner.margin})
            return _Session(writer, learner, watch, allowed, schedule, self.failures).finish()


def prepare(
    task: Task, config: TrainConfig, *, ranks: Ranks = ALONE, failures: FailureSearch | None = None
) -> Preparation:
    """Prepare a training, so that what is refused leaves no run behind.

    Args:
        task: problem to train for.
        config: the user's options.
        ranks: processes that train together. All of them call this function at the same time.
        failures: search for failing drives; needed if `config.falsify` is True.

    Raises:
        UsageError: U101, the system has no control, or the method does not train with these options, on this
            device or with several ranks.
        SystemFileError: S301, hardly any initial state is admissible; S302, predicted states are not finite;
            S304, the declared mirror is not a symmetry of the system or the specification.
        MissingError: R302, the device does not exist; R403, the process of another rank has ended or does not
            answer; or a package that the method needs is missing.
    """
    task.require_controls()
    now = clock_of(config.clock)
    started = now()
    keep_freed_memory()
    resolved = replace(resolve_config(task, config), ranks=ranks.size)
    _require_search(resolved, failures)
    declared = task.system.decl.train
    fixed = config.steps or (declared.steps if config.budget is None else None)
    budget = 0.0 if fixed is not None else config.budget or declared.budget or DEFAULT_BUDGET
    schedule = fixed if isinstance(fixed, StepSchedule) else StepSchedule.of(fixed or PROVISIONAL)
    device = find_device(ranks.device(config.device))
    task.system.initial.require_many()
    check_mirror(task)
    torch.set_num_threads(resolved.threads)
    method: Method = METHODS.get(resolved.method)
    learner = method.learner(task, resolved, steps=schedule.at(0), device=device, ranks=ranks)
    ranks.any(False)  # the first rank makes the run once all are ready
    return Preparation(task, resolved, learner, schedule, budget, now, started, ranks, failures)


def train(
    task: Task,
    config: TrainConfig,
    folder: RunDir,
    watch: Watch | None = None,
    *,
    ranks: Ranks = ALONE,
    failures: FailureSearch | None = None,
) -> TrainingOutcome:
    """Prepare a training and run it, in a new folder that already holds its specification and system.

    The arguments and errors are those of `prepare` and `run`.
    """
    return prepare(task, config, ranks=ranks, failures=failures).run(folder, watch)


def resume(
    folder: RunDir,
    *,
    steps: int | None = None,
    budget: float | None = None,
    device: str = "cpu",
    watch: Watch | None = None,
    ranks: Ranks = ALONE,
    failures: FailureSearch | None = None,
) -> TrainingOutcome:
    """Resume an interrupted run; its weights become the same as without the interruption, bit for bit.

    Args:
        folder: folder of the run.
        steps: new total number of steps, at least as many as the run has made.
        budget: additional seconds. If neither `steps` nor `budget` is given, the run uses the rest of its
            budget, or completes its step schedule if it has no budget.
        device: torch device.
        watch: functions that are called during the run; see `Watch`.
        ranks: processes that train together; their number must be the same as before.
        failures: search for failing drives; needed if the run trains with `--falsify`.

    Raises:
        RunError: R101, the run is damaged or was never saved; R102, its checkpoint belongs to another
            specification or system; R103, nothing is left to do; R109, another process trains the run.
        UsageError: R104, the run was trained with another number of ranks; U101, more than `steps` steps have
            been made.
    """
    keep_freed_memory()
    with _alone(folder, ranks):
        config = load_config(folder)
        _require_as_many(config.ranks, ranks.size)
        _require_search(config, failures)
        now = clock_of(config.clock)
        started = now()
        task = Run.task_in(folder)
        method: Method = METHODS.get(config.method)
        watch, writer = watch or Watch(), RunWriter(folder, writes=ranks.first)
        if config.threads:
            torch.set_num_threads(config.threads)
        place = find_device(ranks.device(device))
        past = _Past.of(folder).of_length(folder, steps, budget)
        with restoring(folder):
            learner = method.learner(task, config, steps=past.planned, device=place, ranks=ranks)
            if learner is not None and past.saved is not None:
                learner.restore(past.saved.tensors, past.saved.facts)
        late = watch.late if config.clock == "wall" else None
        if learner is None:
            time_ = TimeBudget.of(now, started, past.allowed, late)
            return _without_steps(method, task, config, writer, time_, watch)
        learner.steps = steps or learner.steps
        if learner.step >= past.schedule.steps and folder.status == "finished":
            raise RunError.of(
                "R103",
                f"run `{folder.name}` is finished: {learner.step} of {past.schedule.steps} steps",
                help=(f"stlc train --resume {folder.name} --budget 60s goes on",),
            )
        writer.before(learner.next_validation)
        time_ = TimeBudget.of(now, started - past.seconds, past.allowed, late)
        session = _Session(writer, learner, watch, time_, past.schedule, failures, past.falsified)
        if past.saved is not None and (steps is not None or budget is not None):
            session.save()  # the new length first: a run that is killed now still has its steps to make
        writer.note({"status": "running", "seconds_allowed": past.allowed or None})
        return session.finish()


@contextmanager
def _alone(folder: RunDir, ranks: Ranks) -> Iterator[None]:
    """Context in which no other process trains the run in `folder`. Raises RunError (R109) if one does."""
    with folder.claimed() if ranks.first else nullcontext(True) as own:
        if ranks.any(not own):
            raise RunError.of(
                "R109",
                f"run `{folder.name}` is being trained by another process",
                help=("wait for its end, or end that process: its last checkpoint is kept",),
            )
        yield


@dataclass(frozen=True, slots=True)
class _Past:
    """Past of a run that is resumed: its latest checkpoint, and the length that it was to have.

    Attributes:
        saved: the checkpoint; None if there is none, so that the run begins again.
        made: number of steps made until then.
        planned: total number of steps planned then.
        schedule: record of all plannings until then.
        seconds: time spent until then.
        allowed: budget in seconds; 0 if the schedule alone decides.
        falsified: seconds that rounds of falsification have taken.
    """

    saved: Checkpoint | None
    made: int
    planned: int
    schedule: StepSchedule
    seconds: float
    allowed: float
    falsified: float

    @classmethod
    def of(cls, folder: RunDir) -> _Past:
        """Read the past of a run.

        Raises:
            RunError: R101, the run is damaged; R102, its checkpoint belongs to another specification or
                system.
        """
        saved, record = None, folder.record()
        if not record.keys() >= {"status", "seed", "spec_hash"}:
            raise RunError(folder.damaged("run.json", ValueError("it does not say what was trained")))
        if not never_saved(folder) or "schedule" not in record:
            saved = load_checkpoint(folder, **folder.hashes)
        facts: Mapping[str, Any] = record if saved is None else saved.facts
        spent = (row.get("seconds") for row in folder.rows())
        before = max((seconds for seconds in spent if isinstance(seconds, int | float)), default=0.0)
        with restoring(folder):
            schedule = StepSchedule.parse(str(facts.get("schedule") or facts.get("steps") or PROVISIONAL))
            return cls(
                saved,
                0 if saved is None else int(facts["step"]),
                schedule.at(0) if saved is None else int(facts["steps"]),
                schedule,
                float(facts.get("seconds", before)),
                float(facts.get("seconds_allowed", record.get("seconds_allowed")) or 0.0),
                float(facts.get("falsified") or 0.0),
            )

    def of_length(self, folder: RunDir, steps: int | None, budget: float | None) -> _Past:
        """This past with a new total number of steps, or `budget` additional seconds, if one is given.

        Without a checkpoint, the steps of a budget are planned anew.

        Raises:
            UsageError: U101, more than `steps` steps have been made.
        """
        if steps is not None and steps < self.made:
            message = f"run `{folder.name}` has made {self.made} steps, more than {steps}"
            raise usage(message, f"stlc train --resume {folder.name} --steps {self.made + steps}")
        if budget is not None:
            total, allowed = self.made + PROVISIONAL, self.seconds + budget
        elif steps is not None:
            total, allowed = steps, 0.0
        elif self.saved is None and self.allowed:
            total, allowed = self.planned, self.allowed
        else:
            return self
        if self.saved is None:
            return replace(self, planned=total, schedule=StepSchedule.of(total), allowed=allowed)
        return replace(self, schedule=self.schedule.with_steps(self.made, total), allowed=allowed)


def _without_steps(
    method: Method, task: Task, config: ResolvedConfig, writer: RunWriter, time: TimeBudget, watch: Watch
) -> TrainingOutcome:
    """Evaluate a run whose policy is a planner, without training, and write the result into its folder."""
    margin = task.system.decl.objective.gamma
    writer.note({"margin": margin, "steps": 0, "schedule": None})
    watch.started({**asdict(config), "margin": margin, "budget": time.allowed or None, "steps": 0})
    with watch.deferring():
        policy = method.load(task, writer.folder, config, "cpu")
        return FinalEvaluation(writer, task, config, time, watch.evaluating).of(policy, 0)


def _require_as_many(before: int, now: int) -> None:
    """Raise UsageError (R104) if the number of ranks (processes) has changed since the run was made.

    `before`: number of ranks of the run. `now`: number of ranks at present.
    """
    if before != now:
        start = f"torchrun --nproc-per-node {before} -m stlc" if before > 1 else "stlc"
        raise usage(
            f"the run was trained by {before} process{'es' if before > 1 else ''} together, not by {now}",
            f"{start} train --resume RUN",
            code="R104",
            note=("every one of them has states of its own, which the run goes on with",),
        )


def _require_search(config: ResolvedConfig, failures: FailureSearch | None) -> None:
    """Raise UsageError (U101) if a training with `--falsify` has no search for drives, or several ranks."""
    if config.falsify and config.ranks > 1:
        raise usage("`--falsify` is for a training in one process", "stlc train SPEC --falsify")
    if config.falsify and failures is None:
        raise usage("`falsify` needs a search", "train(..., failures=stlc.assurance.drive_search.round_of)")


class _Session:
    """Training from the learner's present state to the last step or an interruption; then the evaluation."""

    def __init__(
        self,
        writer: RunWriter,
        learner: Learner,
        watch: Watch,
        time: TimeBudget,
        schedule: StepSchedule,
        failures: FailureSearch | None = None,
        falsified: float = 0.0,
    ) -> None:
        """Prepare to make the steps of `schedule`; with a budget, their number is adapted to the pace.

        `failures`: search for failing drives, of a training with `--falsify`; `falsified`: seconds that its
        rounds have taken before.
        """
        self.failures = failures
        self.writer = writer
        self.learner = learner
        self.watch = watch
        self.time = time
        self.schedule = schedule
        self.now = time.now
        self.evaluation = FinalEvaluation(writer, learner.task, learner.config, time, watch.evaluating)
        self.pace = Pace(
            every=learner.config.every, searching=learner.searches, now=self.now(), seconds=time.seconds
        )
        self.barren = not learner.ranks.any(learner.solved)
        self.refuted: bool | None = None
        self.exhausted = False
        self.falsified = falsified

    def finish(self) -> TrainingOutcome:
        """Train to the end, evaluate, and write the status of the run.

        An interruption leaves the last checkpoint, from which `resume` continues.
        """
        learner = self.learner
        reasons = dict(learner.torch_reasons())
        self.writer.note({"by_torch": reasons})
        self._note_schedule()
        chosen = {**asdict(learner.config), "margin": learner.margin, "budget": self.time.allowed or None}
        self.watch.started({**chosen, "steps": self._known_steps, "by_torch": reasons})
        try:
            with self.watch.deferring():
                if not self._trained():
                    self.save()
                    self.writer.close("interrupted")
                    return self._unjudged(interrupted=True)
                self.writer.note({"steps": learner.step})
            if not learner.ranks.first:
                return self._unjudged(interrupted=False)
            return self.evaluation.of(learner.policy, learner.step)
        finally:
            learner.close()

    def _trained(self) -> bool:
        """Make all steps; return False if the training has to stop before the last one."""
        learner, saved = self.learner, time.perf_counter()
        while more := self._goes_on():
            patience = max(BARREN_VALIDATIONS * learner.config.every, BARREN_SHARE * learner.steps)
            # Further search is useless if bounds prove that no plan exists, or the longest search found none.
            useless = bool(self.refuted) or (self.exhausted and learner.step >= patience)
            if self.barren and learner.searches and useless:  # no satisfying plan was ever found
                break
            if not math.isfinite(learner.advance()):
                raise self._broken()
            began = self.now()
            if not learner.settle():
                raise self._broken()
            ended = self.now()
            if learner.settles_rarely:
                self.pace.irregular(ended - began)
            self.pace.stepped(learner.step, ended, search_runs=learner.searching)
            due = learner.step % SAVE_EVERY == 0 or time.perf_counter() - saved > SAVE_SECONDS
            if learner.ranks.any(due):
                self.save()
                saved = time.perf_counter()
            if learner.ranks.any(self.watch.stop()):
                return False
        if more is None:
            return False
        self.save()
        return not learner.ranks.any(self.watch.stop())

    def _goes_on(self) -> bool | None:
        """Validate if a validation is due, and decide whether another step follows.

        A validation and the end of the training wait for the concurrent search. If the wait is shorter than
        expected, further steps may fit into the budget.

        Returns:
            True if another step follows, False after the last one, None if the user ends the training early.
        """
        learner = self.learner
        ends = self._planned() <= learner.step
        if ends or learner.step >= learner.next_validation:
            began = self.now()
            came = learner.wait(self.watch.stop)
            if learner.searches:
                self.pace.searched(learner.step, self.now() - began)
            if learner.ranks.any(not came):
                return None
        if ends and self._planned() <= learner.step:
            return False
        if learner.step >= learner.next_validation:
            if not self._searched_drives():
                return None
            began = self.now()
            if learner.ranks.any(not learner.explore(self.watch.stop)):
                return None
            self._validate(began)
        return True

    def _planned(self) -> int:
        """Return the total number of steps: planned anew from the budget, or taken from the schedule.

        If the number changes, it is recorded in the schedule and in the learner.
        """
        learner = self.learner
        if self.time.allowed:
            left = self.time.started + self.time.seconds - self.evaluation.reserve - self.now()
            steps = self.pace.plan(learner.step, learner.steps, learner.next_validation, left)
            steps = int(learner.ranks.agree(steps))
            if steps != learner.steps:
                self.schedule = self.schedule.with_steps(learner.step, steps)
                self._note_schedule()
        learner.steps = self.schedule.at(learner.step)
        return learner.steps

    @property
    def _known_steps(self) -> int | None:
        """Total number of steps; None if it follows from a budget and has not been planned yet."""
        return None if self.time.allowed and not self.pace.planned else self.schedule.steps

    def _note_schedule(self) -> None:
        self.writer.note({"steps": self._known_steps, "schedule": str(self.schedule)})

    def _validate(self, began: float) -> None:
        """Validate and write a row of `train.jsonl`.

        `began`: clock reading before the search that precedes a validation. The recorded duration includes
        this search.
        """
        learner = self.learner
        found = learner.validate()
        self.pace.validated(learner.step, self.now() - began)
        self._row(found)
        self.barren = self.barren and found.accuracy == 0.0 and found.repaired + found.explored == 0
        self.exhausted = not learner.ranks.any(not learner.exhausted)
        if self.barren and self.refuted is None and learner.searches:
            self.refuted = learner.ranks.any(refuted(learner.task))

    def _searched_drives(self) -> bool:
        """Make a round of falsification if one is due; return False if the user ends the training.

        The recorded schedule decides when rounds are due, as far as it goes.
        """
        learner, known, recorded = self.learner, self.learner.failures, self.schedule.rounds
        if known is None or self.failures is None:
            return True
        step = learner.step
        if known.moment < len(recorded):
            due = step >= recorded[known.moment].step
        else:
            due = known.due(step, learner.steps) and (not recorded or step > recorded[-1].step)
        if not due:
            return True
        began = self.now()
        run = Run(self.writer.folder, learner.task, learner.policy)
        if known.moment < len(recorded):
            count, allowed = recorded[known.moment].simulations, math.inf
        else:
            limit = SHARE * self.time.spent - self.falsified
            allowed = limit if self.time.allowed else math.inf
            states = learner.config.batch + learner.config.hard
            count = known.simulations(run, step, states) if allowed > 0.0 else 0
        made = known.search(
            *(self.failures, run, step, count, learner.generator),
            over=lambda: self.now() - began >= allowed,
            stop=self.watch.stop,
        )
        if made is None:
            return False
        if known.moment > len(recorded):
            self.schedule = self.schedule.with_round(step, made)
            self._note_schedule()
        self.falsified += self.now() - began
        self.pace.irregular(self.now() - began)
        self.writer.note({"falsification": known.summary()})
        return True

    def _unjudged(self, *, interrupted: bool) -> TrainingOutcome:
        """Outcome of a training run that ended before its evaluation.

        `interrupted`: whether the user ended it.
        """
        learner = self.learner
        run = Run(self.writer.folder, learner.task, learner.policy)
        return TrainingOutcome(
            run, None, self.time.spent, interrupted, learner.ranks.size, steps=learner.step
        )

    def save(self) -> None:
        """Write a checkpoint.

        If a search is running, its inputs are saved, not its result.
        """
        began = self.now()
        facts = {
            **self.learner.facts(),
            "schedule": str(self.schedule),
            "seconds": began - self.time.started,
            "seconds_allowed": self.time.allowed or None,
            "falsified": self.falsified,
        }
        self.writer.checkpoint(self.learner.tensors(), facts, step=self.learner.step)
        self.pace.saved(self.now() - began)

    def _row(self, found: Validation) -> None:
        learner = self.learner
        rest = max(1, learner.steps - learner.step)
        names = [rule.name for rule in learner.task.rules]
        row = {
            "step": learner.step,
            "steps": learner.steps,
            "seconds": self.time.spent,
            "loss": learner.loss,
            "accuracy": found.accuracy,
            "requirements": dict(zip(names, found.requirements, strict=True)),
            "feasible": found.feasible,
            "lr": learner.rate,
            "repaired": found.repaired,
            "failing": found.failing,
            "explored": found.explored,
            "s_per_step": self.pace.remaining(learner.step, learner.steps, learner.next_validation) / rest,
        }
        self.writer.row(row)
        self.watch.row(row)

    def _broken(self) -> StlcError:
        """Return the error that explains why a loss or its gradient is not finite; mark the run as failed.

        The weights before that step are saved if they are finite.
        """
        error, good = self.learner.diagnose()
        if good:
            self.save()
        self.writer.close("failed")
        note = (
            "the run keeps the weights before that step" if good else "the last checkpoint of the run is kept"
        )
        return type(error)(*(finding.with_note(note) for finding in error.diagnostics))
