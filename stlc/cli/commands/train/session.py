"""Terminal interface of a training run: its panel, Ctrl-C, its pictures and its final lines."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import typer

from stlc.activity import PULSE
from stlc.cli.commands.train.progress import TrainingDisplay, final_screen
from stlc.cli.commands.train.trained import JudgedTraining, TrainedRun
from stlc.cli.framework.errors import INTERRUPTED, TERMINATED
from stlc.cli.framework.output import Answer, console, say, show_diagnostics
from stlc.controller.training.failures import FalsificationRounds
from stlc.controller.training.final_evaluation import TrainingOutcome
from stlc.controller.training.loop import Watch
from stlc.diagnostics import StlcError
from stlc.records import from_json
from stlc.rundir import RunDir, Status
from stlc.stopping import age, leaving
from stlc.view.learning import Commands, learning_of_run

if TYPE_CHECKING:
    from types import FrameType, TracebackType

    from stlc.controller.training.tensorboard import Opener, TensorBoardLogger

BESIDE = 10.0
"""Seconds of a command beyond its budget."""
AFTER = 1.2
"""Seconds for pictures and process exit, besides those before the training."""
FAILURES = "failures.png"
"""File name of the picture of failing starts."""


@dataclass(slots=True)
class Session:
    """Progress display of a training run, as a context manager that also handles Ctrl-C and SIGTERM.

    During the training steps, the first signal ends the run after the present step, and saves a checkpoint. A
    second signal ends the run immediately. Before and after the training steps, the first signal already ends
    the run immediately.

    Attributes:
        folder: folder of the run.
        outcome: result of the training, once finished.
        progress: display of the progress.
        logger: function that opens an additional logger, if any.
        writes: whether this process writes the run's folder; of several processes only the first one does.
        before: seconds from the start of the process to that of the training; None: to the start of the
            session.
        new: whether the run has been made for this training, instead of being gone on with.
    """

    folder: RunDir
    outcome: TrainingOutcome | None = None
    progress: TrainingDisplay = field(default_factory=TrainingDisplay)
    logger: Opener | None = None
    writes: bool = True
    before: float | None = None
    new: bool = False
    _log: TensorBoardLogger | None = None
    _signals: list[int] = field(default_factory=list)
    _deferring: bool = False
    _seconds_before: float = 0.0
    _begun: bool = False
    _status_before: Status | None = None
    _forced: ExitStack = field(default_factory=ExitStack)
    _handlers: dict[int, Any] = field(default_factory=dict)

    @property
    def watch(self) -> Watch:
        """Functions that the training calls while it runs.

        For example, one function stores a row of results, one tells whether to stop, and one shows the
        current activity.
        """
        stop = lambda: bool(self._signals)  # noqa: E731
        return Watch(self._resolved, self._row, stop, self._steps, self._late, PULSE.now)

    def _late(self, budget: float) -> float:
        """Seconds by which a run that trains for all of `budget` would exceed it; may be negative.

        The time beside the training (pictures, end) is estimated from the time of the imports.
        """
        return (1.0 + AFTER) * self._seconds_before - BESIDE - 0.1 * budget

    @contextmanager
    def _steps(self) -> Iterator[None]:
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False

    def _resolved(self, engine: dict[str, Any]) -> None:
        self._begun = True
        self.progress.chosen(engine)
        if self._log is not None:
            self._log.started(engine)

    def _row(self, row: dict[str, Any]) -> None:
        self.progress.update(row)
        if self._log is not None:
            self._log.row(row)

    def __enter__(self) -> Self:
        self._seconds_before = age() if self.before is None else self.before
        with suppress(StlcError):
            self._status_before = self.folder.status
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, self._interrupt)
        if self.writes:
            self._forced.enter_context(leaving(self._ended))
            self._forced.enter_context(PULSE.doing("training and evaluation"))
            self._log = None if self.logger is None else self.logger(self.folder.path)
            self.progress.start(self.folder.record(), self.folder.name)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()
        if self._log is not None:
            self._log.close()
        if error is not None and self.writes:
            if isinstance(error, KeyboardInterrupt | SystemExit):
                self._ended()
            else:
                self._close("failed")
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._forced.close()

    def _ended(self, _code: int = INTERRUPTED) -> None:
        """Record the status "interrupted" for a run that is killed; its last checkpoint remains."""
        self._close("interrupted")
        self._say_interrupted()

    def _close(self, status: Status) -> None:
        """Record how the run ended; one whose continuation was refused, or did not begin, stays as it was."""
        with suppress(StlcError):
            if self.new or self._begun or self.folder.status != self._status_before:
                self.folder.finish(status)

    def _say_interrupted(self) -> None:
        ranks = 1 if self.outcome is None else self.outcome.ranks
        say(f"interrupted, saved: {self.folder.shown}")
        say(f"go on with: {_commands(self.folder, ranks).train_on}")

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        at_once = bool(self._signals) or not self._deferring
        self._signals.append(number)
        if at_once:
            raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(TERMINATED)

    def conclude(self, *, pictures: bool) -> Answer[TrainedRun]:
        """Draw the pictures of the finished training and return its record, with the final lines as text.

        Raises:
            typer.Exit: this process does not write the run's folder.
        """
        outcome, folder = self.outcome, self.folder
        assert outcome is not None
        interrupted = TERMINATED if signal.SIGTERM in self._signals else INTERRUPTED
        if not self.writes:
            raise typer.Exit(interrupted if outcome.interrupted else 0)
        if outcome.score is None:
            self._say_interrupted()
            return Answer(TrainedRun(folder.shown, outcome.seconds), lambda: None, interrupted)
        if pictures:
            draw_report(folder)
        record = folder.record()
        rounds = record.get("falsification")
        judged = JudgedTraining(
            **outcome.score.summary(),
            closed_loop=outcome.simulated,
            verdict=learning_of_run(folder, _commands(folder, outcome.ranks)),
            steps=record.get("steps"),
            schedule=record.get("schedule"),
            falsification=None
            if rounds is None
            else from_json(FalsificationRounds, rounds, f"{folder.shown}/run.json"),
        )
        result = TrainedRun(folder.shown, outcome.seconds, judged)
        reasons = () if outcome.why is None else (outcome.why,)

        def show() -> None:
            self.progress.finish(_screen(outcome, result, self.progress.spark, pictures), to=console())
            show_diagnostics(reasons)

        return Answer(result, show, 0 if outcome.score.feasible > 0.0 else 1, reasons)


def _commands(folder: RunDir, ranks: int = 1) -> Commands:
    """The commands that the final lines suggest, for a run trained by `ranks` processes.

    The commands name the run as briefly as possible. The newest run is not named, and a run below `runs` is
    named without its path.
    """
    newest = (RunDir.RUNS / RunDir.LATEST).resolve() == folder.path.resolve()
    usual = folder.path.resolve().parent.parent == RunDir.RUNS.resolve()
    start = "stlc" if ranks == 1 else f"torchrun --nproc-per-node {ranks} -m stlc"
    name = folder.name if usual else folder.shown
    return Commands.of(name, folder.record(), newest=newest, start=start)


def _screen(outcome: TrainingOutcome, result: TrainedRun, spark: str, pictures: bool) -> list[str]:
    """Return the lines printed at the end of a training run.

    The lines describe the held-out initial states (never used in training) from which the requirement with
    most violations fails. With `pictures`, the path of a picture of these states is added.
    """
    from stlc.view.held_out import load_held_out

    folder = outcome.run.dir
    held = load_held_out(folder)
    weakness = None if held is None else held.weakness()
    if held is None or weakness is None:
        return final_screen(result, spark)
    drawn = pictures and folder.has(FAILURES)
    return final_screen(
        result,
        spark,
        region=weakness.text(held, outcome.run.task.system.signature),
        unsolved=held.unsolved_text,
        picture=f"{folder.shown}/{FAILURES}" if drawn else "",
    )


def draw_report(folder: RunDir) -> None:
    """Write the report of a run with its pictures, or print how to install matplotlib if it is missing."""
    from stlc.view import available

    if not available():
        say("no pictures: they need the extra `plot` (see `stlc doctor`)")
        return
    from stlc.view.report import write_report

    with PULSE.doing("drawing the report"):
        write_report(folder)
