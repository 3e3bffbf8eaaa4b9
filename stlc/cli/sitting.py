"""One sitting of training as a person sees it: the panel, Ctrl-C, pictures, the closing screen."""

from __future__ import annotations

import signal
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self

import typer

from stlc.cli.errors import INTERRUPTED, TERMINATED
from stlc.cli.output import console, emit_json, say, show_diagnostics
from stlc.cli.progress import Progress, RunInfo, Summary
from stlc.controller.train import Outcome, Watch
from stlc.diagnostics import StlcError
from stlc.rundir import LATEST, RUNS
from stlc.view.learning import Commands, Learning, learning_of_run

if TYPE_CHECKING:
    from types import FrameType, TracebackType

    from stlc.controller.logbook import Logbook, Opener
    from stlc.rundir import RunDir

FAILURES = "failures.png"
"""What the report draws of the starts that fail."""


@dataclass(slots=True)
class Sitting:
    """Shows progress while it is open; the first Ctrl-C or SIGTERM asks to save and stop, a second one stops.

    Attributes:
        folder: of the run.
        outcome: what training gave, once it did.
        progress: the panel.
        logbook: how a log beside `train.jsonl` is opened, if one is wanted.
        keeps: whether this process keeps the run's folder; of several ranks the first does.
    """

    folder: RunDir
    outcome: Outcome | None = None
    progress: Progress = field(default_factory=Progress)
    logbook: Opener | None = None
    keeps: bool = True
    _log: Logbook | None = None
    _asked: list[int] = field(default_factory=list)
    _before: dict[int, Any] = field(default_factory=dict)

    @property
    def watch(self) -> Watch:
        """What training reports to."""
        return Watch(begun=self._begun, row=self._row, stop=lambda: bool(self._asked))

    def _begun(self, chosen: dict[str, Any]) -> None:
        self.progress.chosen(chosen)
        if self._log is not None:
            self._log.begun(chosen)

    def _row(self, row: dict[str, Any]) -> None:
        self.progress.update(row)
        if self._log is not None:
            self._log.row(row)

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._ask)
        if self.keeps:
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
            with suppress(StlcError):
                self.folder.finish("interrupted" if kind is KeyboardInterrupt else "failed")
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, _frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked.append(number)

    @property
    def _signalled(self) -> int:
        """The exit code of what asked to stop."""
        return TERMINATED if signal.SIGTERM in self._asked else INTERRUPTED

    def conclude(self, *, pictures: bool, json: bool) -> NoReturn:
        """Pictures, then the closing screen or the JSON document; raises `typer.Exit` with the exit code."""
        outcome = self.outcome
        assert outcome is not None
        if not self.keeps:
            raise typer.Exit(self._signalled if outcome.interrupted else 0)
        if outcome.score is None:
            say(f"interrupted, saved: {self.folder.shown}")
            say(f"go on with: {_commands(self.folder, outcome.ranks).train_on}")
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
            result |= {} if learning is None else {"verdict": learning.summary()}
            result |= {key: self.folder.record().get(key) for key in ("steps", "schedule")}
            emit_json("train/1", ok=found, exit_code=code, diagnostics=why, result=result)
        else:
            self.progress.finish(_summary(outcome, pictures=pictures), to=console())
            show_diagnostics(why)
        raise typer.Exit(code)


def started(ranks: int) -> str:
    """How so many processes are started that train together."""
    return "stlc" if ranks == 1 else f"torchrun --nproc-per-node {ranks} -m stlc"


def spoken(folder: RunDir) -> str:
    """What other commands find the run by: its name in the usual place, its path elsewhere."""
    usual = folder.path.resolve().parent.parent == RUNS.resolve()
    return folder.name if usual else folder.shown


def _commands(folder: RunDir, ranks: int = 1) -> Commands:
    """The commands that a closing screen names; the run need not be named while it is the newest."""
    newest = (RUNS / LATEST).resolve() == folder.path.resolve()
    return Commands.of(spoken(folder), newest=newest, start=started(ranks))


def _learning(outcome: Outcome) -> Learning | None:
    """The verdict on the training, as its record has it."""
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


def _summary(outcome: Outcome, *, pictures: bool) -> Summary:
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
        where=where,
        unsolved=unsolved,
        picture=f"{folder.shown}/{FAILURES}" if pictures and weakness and drawn.is_file() else "",
    )


def draw_report(folder: RunDir) -> None:
    """The report, where pictures can be drawn; nothing fails for their lack."""
    from stlc.view import available

    if not available():
        say("no pictures: pip install 'stlc[plot]'")
        return
    from stlc.view.report import write_report

    write_report(folder)
