"""Terminal interface of a training: the panel, Ctrl-C, pictures, the final screen."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self

import typer

from stlc.cli.framework.errors import INTERRUPTED, TERMINATED
from stlc.cli.framework.output import PULSE, console, emit_json, say, show_diagnostics
from stlc.cli.train.progress import Progress, RunInfo, Summary
from stlc.controller.training.final_evaluation import TrainingOutcome
from stlc.controller.training.loop import Watch
from stlc.diagnostics import StlcError
from stlc.rundir import LATEST, RUNS
from stlc.stopping import age, leaving
from stlc.view.learning import Commands, Learning, driven_lines, learning_of_run, recommended

if TYPE_CHECKING:
    from types import FrameType, TracebackType

    from stlc.controller.training.tensorboard import Opener, TensorBoardLogger
    from stlc.rundir import RunDir

BESIDE = 10.0
"""Seconds of a command beyond its budget."""
AFTER = 1.2
"""Seconds for pictures and process exit, besides those before the training."""
FAILURES = "failures.png"
"""File name of the picture of failing starts."""


@dataclass(slots=True)
class Sitting:
    """Progress display of a training as a context manager; Ctrl-C or SIGTERM saves and stops.

    During training steps the first signal requests the stop and a second one stops at once; at other times
    the first one does.

    Attributes:
        folder: of the run.
        outcome: result of the training, once finished.
        progress: the panel.
        logbook: opener of an additional logger, if any.
        keeps: whether this process writes the run's folder; the first of several ranks does.
    """

    folder: RunDir
    outcome: TrainingOutcome | None = None
    progress: Progress = field(default_factory=Progress)
    logbook: Opener | None = None
    keeps: bool = True
    _log: TensorBoardLogger | None = None
    _asked: list[int] = field(default_factory=list)
    _deferring: bool = False
    _before_it: float = 0.0
    _forced: ExitStack = field(default_factory=ExitStack)
    _before: dict[int, Any] = field(default_factory=dict)

    @property
    def watch(self) -> Watch:
        """The callbacks of the training."""
        stop = lambda: bool(self._asked)  # noqa: E731
        return Watch(self._begun, self._row, stop, self._steps, self._late)

    def _late(self, budget: float) -> float:
        """Expected delay in seconds at the end on a slow machine, estimated from the time of imports."""
        return (1.0 + AFTER) * self._before_it - BESIDE - 0.1 * budget

    @contextmanager
    def _steps(self) -> Iterator[None]:
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False

    def _begun(self, chosen: dict[str, Any]) -> None:
        self.progress.chosen(chosen)
        if self._log is not None:
            self._log.started(chosen)

    def _row(self, row: dict[str, Any]) -> None:
        self.progress.update(row)
        if self._log is not None:
            self._log.row(row)

    def __enter__(self) -> Self:
        self._before_it = age()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._ask)
        if self.keeps:
            self._forced.enter_context(leaving(self._ended))
            self._forced.enter_context(PULSE.doing("training and evaluation"))
            self._log = None if self.logbook is None else self.logbook(self.folder.path)
            self.progress.start(_info(self.folder))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()
        if self._log is not None:
            self._log.close()
        if error is not None and self.keeps:
            if isinstance(error, KeyboardInterrupt | SystemExit):
                self._ended()
            else:
                with suppress(StlcError):
                    self.folder.finish("failed")
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._forced.close()

    def _ended(self, _code: int = INTERRUPTED) -> None:
        """Record a killed run as interrupted; its last checkpoint remains."""
        with suppress(StlcError):
            self.folder.finish("interrupted")
        self._say_interrupted()

    def _say_interrupted(self) -> None:
        ranks = 1 if self.outcome is None else self.outcome.ranks
        say(f"interrupted, saved: {self.folder.shown}")
        say(f"go on with: {_commands(self.folder, ranks).train_on}")

    def _ask(self, number: int, _frame: FrameType | None) -> None:
        at_once = bool(self._asked) or not self._deferring
        self._asked.append(number)
        if at_once:
            raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(TERMINATED)

    @property
    def _signalled(self) -> int:
        """The exit code of the received signal."""
        return TERMINATED if signal.SIGTERM in self._asked else INTERRUPTED

    def conclude(self, *, pictures: bool, json: bool) -> NoReturn:
        """Draw pictures, print the final screen or the JSON document; raises `typer.Exit` with the code."""
        outcome = self.outcome
        assert outcome is not None
        if not self.keeps:
            raise typer.Exit(self._signalled if outcome.interrupted else 0)
        if outcome.score is None:
            self._say_interrupted()
            code = self._signalled
            if json:
                result = {"run": self.folder.shown, "seconds": outcome.seconds}
                emit_json("train/1", ok=False, exit_code=code, result=result)
            raise typer.Exit(code)
        if pictures:
            draw_report(self.folder)
        why = () if outcome.why is None else (outcome.why,)
        found = outcome.score.feasible > 0.0
        code = 0 if found else 1
        if json:
            learning = _learning(outcome)
            result = {"run": self.folder.shown, "seconds": outcome.seconds, **outcome.score.summary()}
            result |= {} if outcome.simulated is None else {"closed_loop": outcome.simulated.summary()}
            result |= {} if learning is None else {"verdict": learning.summary()}
            result |= {key: self.folder.record().get(key) for key in ("steps", "schedule")}
            emit_json("train/1", ok=found, exit_code=code, diagnostics=why, result=result)
        else:
            self.progress.finish(_summary(outcome, pictures=pictures), to=console())
            show_diagnostics(why)
        raise typer.Exit(code)


def started(ranks: int) -> str:
    """The program to start: `stlc`, or `torchrun` for several ranks."""
    return "stlc" if ranks == 1 else f"torchrun --nproc-per-node {ranks} -m stlc"


def spoken(folder: RunDir) -> str:
    """Reference to the run for other commands: its name in the default folder, else its path."""
    usual = folder.path.resolve().parent.parent == RUNS.resolve()
    return folder.name if usual else folder.shown


def _commands(folder: RunDir, ranks: int = 1) -> Commands:
    """The commands of the final screen; the newest run needs no name."""
    newest = (RUNS / LATEST).resolve() == folder.path.resolve()
    guard = recommended(folder.record())
    return Commands.of(spoken(folder), newest=newest, start=started(ranks), guard=guard)


def _learning(outcome: TrainingOutcome) -> Learning | None:
    """The verdict on the training in its record."""
    return learning_of_run(outcome.run.dir, _commands(outcome.run.dir, outcome.ranks))


def _info(folder: RunDir) -> RunInfo:
    record = folder.record()
    path = str(record.get("system_path"))
    return RunInfo(
        spec=str(record.get("spec")),
        system=Path(path).name,
        system_path=path,
        run=folder.name,
        seed=int(record.get("seed", 0)),
        threads=int(record.get("threads", 1)),
        device=str(record.get("device", "cpu")),
        steps=record.get("steps"),
    )


def _summary(outcome: TrainingOutcome, *, pictures: bool) -> Summary:
    from stlc.view.held_out import find_weakness, load_held_out, unsolved_text, weakness_text

    learning = _learning(outcome)
    score, folder = outcome.score, outcome.run.dir
    assert score is not None
    held = load_held_out(folder.path / "eval" / "held_out.npz")
    weakness = find_weakness(held) if held is not None else None
    where = unsolved = ""
    if held is not None and weakness is not None:
        where = weakness_text(weakness, held, outcome.run.task.system.signature)
        unsolved = unsolved_text(held)
    drawn = folder.path / FAILURES
    return Summary(
        accuracy=score.accuracy,
        interval=score.interval,
        held_out=score.states.shape[0],
        requirements=score.requirements,
        feasible=score.feasible,
        seconds=outcome.seconds,
        folder=folder.shown,
        steps=outcome.steps,
        searched=int(score.searched.sum()),
        learning=learning,
        driven=driven_lines(
            {} if outcome.simulated is None else {"closed_loop": outcome.simulated.summary()}
        ),
        judged=score.endless,
        where=where,
        unsolved=unsolved,
        picture=f"{folder.shown}/{FAILURES}" if pictures and weakness and drawn.is_file() else "",
    )


def draw_report(folder: RunDir) -> None:
    """Draw the report, or print how to install matplotlib if it is missing."""
    from stlc.view import available

    if not available():
        say("no pictures: pip install 'stlc[plot]'")
        return
    from stlc.view.report import write_report

    with PULSE.doing("drawing the report"):
        write_report(folder)
