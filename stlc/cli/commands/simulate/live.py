"""Live view of a deployment (closed-loop simulation): robustness margins as bars, agents, and decisions.

Without a terminal, the view is ten lines of text.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from stlc.cli.commands.check.text import percent, signed
from stlc.cli.framework.output import table
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import SOURCES

if TYPE_CHECKING:
    from stlc.controller.deployment.live import LiveMonitor
    from stlc.monitor.online.online import Margin
    from stlc.signature import Column

REDRAWN = 0.5
"""Seconds between redraws on a terminal."""
LINES = 10
"""Number of lines without a terminal."""
HALF = 10
"""Half the width of a bar in characters; the right half shows positive margins."""
NARROW = 4
"""Half the width of a bar in characters in a narrow terminal."""
FIRST = ("agent", "decided by", "plan", "least margin")
"""Headers of the columns before the states of an agent."""


class LiveView:
    """Display of a running deployment: redrawn in place on a terminal, else ten lines of text in total.

    Args:
        monitor: computes the robustness margins of all agents and counts the decisions of the guard.
        title: name of the deployment.
        console: console to which the view is written.
        clock: function that returns the time in seconds, to limit the rate of redrawing.
    """

    def __init__(
        self,
        monitor: LiveMonitor,
        title: str,
        console: Console,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.monitor, self.title, self.console = monitor, title, console
        self._clock = clock
        self._drawn_at = -1e9
        self._scales: dict[str, float] = {}
        self._seconds = 0.0
        terminal = console.is_terminal and not console.is_dumb_terminal
        self._live = Live(console=console, auto_refresh=False) if terminal else None
        self._unicode = "utf" in (console.encoding or "").lower()

    def start(self) -> None:
        """Open the view."""
        if self._live is not None:
            self._live.start()
        else:
            self.console.print(Text(self.title))

    def stop(self) -> None:
        """Close the view; its last state stays on the screen."""
        if self._live is not None:
            self._live.stop()

    def update(self) -> None:
        """Update the view after a step of the deployment."""
        moment = self.monitor.moment
        assert moment is not None
        if moment.planned:
            self._seconds = moment.seconds
        over = moment.decision is None
        if self._live is None:
            if over or moment.step * LINES // moment.steps > (moment.step - 1) * LINES // moment.steps:
                self.console.print(Text(self.line()), soft_wrap=True)
        elif over or self._clock() - self._drawn_at >= REDRAWN:
            self._live.update(self.panel(), refresh=True)
            self._drawn_at = self._clock()

    # ------------------------------------------------------------------------- text

    def line(self) -> str:
        """Present state of the deployment on one line.

        It shows the step, how often the guard intervened, the least robustness, and the number of agents that
        violate a requirement.
        """
        margins = self.monitor.margins
        name = min(margins, key=lambda name: _least(margins[name]).high)
        least = _least(margins[name])
        row = margins[name].index(least)
        violated = [
            any(margin.violated for margin in agents) for agents in zip(*margins.values(), strict=True)
        ]
        counts = self.monitor.counts
        parts = (
            self._counter(),
            f"guard acted in {int(counts[1:].sum()):,} of {int(counts.sum()):,}",
            f"least margin {name} {_signed(least.high)} ({self._agent(row)})",
            f"violated by {sum(violated)} of {len(violated)}",
        )
        return "  " + "   ".join(parts)

    def panel(self) -> Group:
        """The present state of the deployment as drawn on the terminal."""
        width, height = self.console.size
        counts = self.monitor.counts.tolist()
        total = max(sum(counts), 1)
        shares = (f"{name} {percent(n / total)}" for name, n in zip(SOURCES, counts, strict=True) if n)
        decisions = "   ".join(shares)
        lines = [Text(self.title, style="bold"), Text(f"{self._counter()}   {decisions}"), Text()]
        lines += self._bars(width)
        lines.append(Text())
        lines += self._agents(width, max(height - len(lines) - 2, 3))
        for line in lines:
            line.no_wrap, line.overflow = True, "ellipsis"
        return Group(*lines)

    def _counter(self) -> str:
        moment = self.monitor.moment
        assert moment is not None
        step = f"step {moment.step:,} / {moment.steps:,}   t = {self.monitor.time:.6g} s"
        return f"{step}   all decided in {1e3 * self._seconds:.1f} ms"

    def _agent(self, row: int) -> str:
        seed, agent = divmod(row, self.monitor.setting.agents)
        several = len(self.monitor.setting.seeds) > 1
        return f"agent {agent}" + (f", seed {self.monitor.setting.seeds[seed]}" if several else "")

    def _bars(self, width: int) -> list[Text]:
        """Return one line for each requirement: a bar and the least robustness over all agents.

        In a narrow terminal, the bars are shortened first; names are cut only after that.
        """
        margins = self.monitor.margins
        units = {rule.name: rule.typed.formula.margin_unit for rule in self.monitor.task.rules}
        texts = {}
        for name, each in margins.items():
            least, violated = _least(each), sum(margin.violated > 0 for margin in each)
            bound = "at most " if least.low < least.high else ""
            value = f"{bound}{_signed(least.high)} {units.get(name, '')}".rstrip()
            count = f"violated by {violated} of {len(each)}" if violated else ""
            texts[name] = value, self._agent(each.index(least)), count
        wide = [max(len(parts[k]) for parts in texts.values()) for k in range(3)]
        label = max(map(len, margins))
        room = width - label - sum(wide) - len("      │      ")
        half = min(max(room // 2, NARROW), HALF)
        found = []
        for name, (value, agent, count) in texts.items():
            high = _least(margins[name]).high
            text = Text(f"  {name:<{label}}  ")
            text.append(self._bar(name, high, half), style="red" if TOLERANCE.violated(high) else "green")
            text.append(f"  {value:<{wide[0]}}  {agent:<{wide[1]}}")
            text.append(f"  {count}", style="red")
            text.rstrip()
            found.append(text)
        return found

    def _bar(self, name: str, value: float, half: int = HALF) -> str:
        """Bar for a robustness value: to the left of the middle if negative, else to the right.

        A full bar has `half` characters. It stands for the largest absolute value shown until now for the
        requirement `name`.
        """
        full, empty, middle = ("█", "·", "│") if self._unicode else ("#", ".", "|")
        finite = abs(value) if np.isfinite(value) else 0.0
        scale = self._scales[name] = max(self._scales.get(name, 1e-9), finite)
        length = half if not np.isfinite(value) else round(half * abs(value) / scale)
        length = max(length, 1) if value else 0
        filled = full * length, empty * (half - length)
        if value < 0:
            return filled[1] + filled[0] + middle + empty * half
        return empty * half + middle + filled[0] + filled[1]

    def _agents(self, width: int, most: int) -> list[Text]:
        """Lines with the state of each agent of the first seed, one line per agent.

        If there are more than `most` agents, those with the least robustness are shown.
        """
        monitor, moment = self.monitor, self.monitor.moment
        assert moment is not None
        agents = range(monitor.setting.agents)
        margins = monitor.margins
        least = [min(each.high for each in found) for found in zip(*margins.values(), strict=True)]
        rows = sorted(sorted(agents, key=least.__getitem__)[:most])
        states = moment.x[: len(agents)].tolist()
        names = monitor.task.system.signature.columns
        decision = moment.decision
        cells = []
        for row in rows:
            rho = "" if decision is None else _signed(float(decision.rho[row]))
            name = min(margins, key=lambda name: margins[name][row].high)
            first = (str(row), monitor.decided(row) or "", rho, f"{name} {_signed(least[row])}")
            cells.append([*first, *map(_shown, names, states[row])])
        units = (f"{column.name} {column.unit.text}".strip() for column in names)
        lines = [Text(line) for line in _fitting(cells, [*FIRST, *units], width).splitlines()]
        for line, row in zip(lines[1:], rows, strict=True):
            line.stylize("red" if TOLERANCE.violated(least[row]) else "")
        return lines


def _least(margins: Sequence[Margin]) -> Margin:
    return min(margins, key=lambda margin: margin.high)


def _fitting(cells: list[list[str]], header: list[str], width: int) -> str:
    """Text table of `cells` and `header` with as many columns as fit into `width` characters.

    If columns are left out, `…` stands for them.
    """
    for count in range(len(header), len(FIRST), -1):
        more = ["…"] if count < len(header) else []
        text = table([[*row[:count], *more] for row in cells], header=[*header[:count], *more])
        if max(map(len, text.splitlines())) <= width:
            return text
    return table([row[: len(FIRST)] for row in cells], header=header[: len(FIRST)])


def _shown(column: Column, value: float) -> str:
    """Value of a state as text: the label of an enum, "yes" or "no", or a number."""
    for label, number in column.labels:
        if number == value:
            return label
    if column.kind == "bool":
        return "yes" if value > 0.5 else "no"
    return f"{value:.2f}"


def _signed(value: float) -> str:
    """Text of a robustness value with its sign; a value within rounding errors of zero is "0"."""
    return "0" if abs(value) <= TOLERANCE else signed(value)
