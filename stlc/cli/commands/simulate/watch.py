"""Output while a deployment (closed-loop simulation) runs: progress bar, live view, and JSON lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from stlc.cli.framework.output import console, tolerate_closed
from stlc.files import reported
from stlc.view.simulated import bar

if TYPE_CHECKING:
    from stlc.controller.deployment.batched import Setting
    from stlc.controller.deployment.live import LiveMonitor
    from stlc.controller.deployment.simulator import SimulationStep, Watch
    from stlc.controller.problem.task import Task

STANDARD_OUTPUT = "-"


@dataclass(frozen=True, slots=True)
class Watching:
    """Options for the output while a deployment (closed-loop simulation) runs.

    Attributes:
        live: whether the live view is shown instead of a progress bar.
        margins: file for the robustness margins, as JSON lines; `-` is the standard output. None: no margins
            are written.
        check: called before the deployment.
    """

    live: bool = False
    margins: str | None = None
    check: Callable[[Task], object] | None = None

    @contextmanager
    def of(self, task: Task, setting: Setting, title: str, asked: bool) -> Iterator[Watch]:
        """Return a context that yields a function to be called after every step of the deployment `title`.

        The function updates the progress bar or the live view. If the deployment is the one that was `asked`
        for, it also writes the robustness margins to the file `margins`.
        """
        if self.check is not None:
            self.check(task)
        margins = self.margins if asked else None
        if not self.live and margins is None:
            with bar(title, console(stderr=True)) as watch:
                yield watch
            return
        from stlc.controller.deployment.live import LiveMonitor

        monitor = LiveMonitor(task, setting)
        with ExitStack() as stack:
            listeners: list[Watch] = []
            if margins is not None:
                lines = stack.enter_context(_lines(margins))
                listeners.append(lambda _: _write(monitor, lines))
            if self.live:
                from stlc.cli.commands.simulate.live import LiveView

                view = LiveView(monitor, title, console(stderr=True))
                stack.callback(view.stop)
                view.start()
                listeners.append(lambda _: view.update())
            else:
                listeners.append(stack.enter_context(bar(title, console(stderr=True))))

            def watch(moment: SimulationStep) -> None:
                monitor.push(moment)
                for listener in listeners:
                    listener(moment)

            yield watch


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
    from stlc.jsontext import dumps

    with tolerate_closed(stream):
        stream.writelines(dumps(line) + "\n" for line in monitor.lines())
        stream.flush()
