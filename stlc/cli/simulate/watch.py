"""Output while a deployment (closed-loop simulation) runs: progress bar, live view, and JSON lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from stlc.escape import visible
from stlc.files import reported

if TYPE_CHECKING:
    from stlc.controller.deployment.live import LiveMonitor
    from stlc.controller.deployment.simulator import Setting, SimulationStep, Watch
    from stlc.controller.problem.task import Task

STANDARD_OUTPUT = "-"


@dataclass(frozen=True, slots=True)
class Watching:
    """Options for the output while a deployment (closed-loop simulation) runs.

    Attributes:
        title: name of the deployment.
        live: whether the live view is shown instead of a progress bar.
        margins: file for the robustness margins, as JSON lines; `-` is the standard output. None: no margins
            are written.
    """

    title: str
    live: bool = False
    margins: str | None = None

    @contextmanager
    def of(self, task: Task, setting: Setting) -> Iterator[Watch]:
        """Return a context that yields a function to be called after every step of the deployment.

        The function updates the progress bar or the live view. It also writes the robustness margins to the
        file `margins`, if there is one.
        """
        if not self.live and self.margins is None:
            with _bar(self.title) as watch:
                yield watch
            return
        from stlc.controller.deployment.live import LiveMonitor

        monitor = LiveMonitor(task, setting)
        with ExitStack() as stack:
            listeners: list[Callable[[], None]] = []
            if self.margins is not None:
                lines = stack.enter_context(_lines(self.margins))
                listeners.append(lambda: _write(monitor, lines))
            if self.live:
                from stlc.cli.framework.output import console
                from stlc.cli.simulate.live import LiveView

                view = LiveView(monitor, self.title, console(stderr=True))
                stack.callback(view.stop)
                view.start()
                listeners.append(view.update)
            else:
                update = stack.enter_context(_bar(self.title))
                listeners.append(lambda: update(_present(monitor)))

            def watch(moment: SimulationStep) -> None:
                monitor.push(moment)
                for listener in listeners:
                    listener()

            yield watch


def _present(monitor: LiveMonitor) -> SimulationStep:
    assert monitor.moment is not None
    return monitor.moment


def require_writable(where: str | None) -> None:
    """Create the file `where` for JSON lines, before the deployment; do nothing if it is `-` or None.

    Raises MissingError (R201) if the file cannot be created.
    """
    if where is not None and where != STANDARD_OUTPUT:
        _opened(where).close()


@contextmanager
def _lines(where: str) -> Iterator[TextIO]:
    """Context that yields the stream for JSON lines: the file `where`; for `-`, the standard output."""
    if where == STANDARD_OUTPUT:
        yield sys.stdout
        return
    with _opened(where) as stream:
        yield stream


def _opened(where: str) -> TextIO:
    with reported(f"write `{where}`"):
        return Path(where).open("w", encoding="utf-8")


def _write(monitor: LiveMonitor, stream: TextIO) -> None:
    """Write the present robustness margins to a stream: one JSON object for each agent, on its own line."""
    from stlc.cli.framework.output import tolerate_closed
    from stlc.jsontext import dumps

    with tolerate_closed(stream):
        stream.writelines(dumps(record) + "\n" for record in monitor.records())
        stream.flush()


@contextmanager
def _bar(title: str) -> Iterator[Watch]:
    """Context with a progress bar on the standard error, which is shown only if that is a terminal.

    The context yields the function that updates the bar.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from stlc.cli.framework.output import console

    talk = console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=talk, transient=True, disable=not talk.is_terminal) as progress:
        bar = progress.add_task(visible(title), total=None)
        yield lambda moment: progress.update(bar, completed=moment.step, total=moment.steps)
