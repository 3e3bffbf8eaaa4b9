"""The live view of a deployment: margins as bars, agents, who decides for them; elsewhere ten lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from stlc.cli.check_text import signed
from stlc.cli.output import table
from stlc.compile.semantics import TOLERANCE
from stlc.controller.deploy import SOURCES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.oversight import Oversight
    from stlc.monitor.margins import Margin

REDRAWN = 0.5
"""Seconds between pictures on a terminal."""
LINES = 10
"""How many lines there are elsewhere."""
HALF = 10
"""Half the width of a bar: what stands right of its middle is to spare."""


class LiveView:
    """Shows a deployment: in place on a terminal, ten lines elsewhere.

    Args:
        oversight: of the deployment.
        title: what is deployed.
        console: where; that of the talk.
        clock: in seconds.
    """

    def __init__(
        self,
        oversight: Oversight,
        title: str,
        console: Console,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.oversight, self.title, self.console = oversight, title, console
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
        """Close the view; what it showed last stays."""
        if self._live is not None:
            self._live.stop()

    def tell(self) -> None:
        """The overseen deployment has gone on by a step."""
        moment = self.oversight.moment
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
        """The present moment on a line."""
        worst = min(self.oversight.margins.items(), key=lambda each: float(each[1].high.min()))
        name, agent = worst[0], int(worst[1].high.argmin())
        violated = np.any([margin.violated > 0 for margin in self.oversight.margins.values()], axis=0)
        parts = (
            self._counter(),
            f"guard acted in {self._acted()}",
            f"least margin {name} {signed(float(worst[1].high[agent]))} ({self._agent(agent)})",
            f"violated by {int(violated.sum())} of {len(violated)}",
        )
        return "  " + "   ".join(parts)

    def panel(self) -> Group:
        """What the terminal shows at this moment."""
        width, height = self.console.size
        lines = [Text(self.title, style="bold"), Text(f"{self._counter()}   {self._decisions()}"), Text()]
        lines += self._bars()
        lines.append(Text())
        lines += self._agents(width, max(height - len(lines) - 2, 3))
        for line in lines:
            line.no_wrap, line.overflow = True, "ellipsis"
        return Group(*lines)

    def _counter(self) -> str:
        moment = self.oversight.moment
        assert moment is not None
        step = f"step {moment.step:,} / {moment.steps:,}   t = {self.oversight.time:.6g} s"
        return f"{step}   decision {1e3 * self._seconds:.1f} ms"

    def _decisions(self) -> str:
        total = max(int(self.oversight.counts.sum()), 1)
        shares = zip(SOURCES, self.oversight.counts.tolist(), strict=True)
        return "   ".join(f"{name} {count / total:.1%}" for name, count in shares if count)

    def _acted(self) -> str:
        acted, total = int(self.oversight.counts[1:].sum()), int(self.oversight.counts.sum())
        return f"{acted:,} of {total:,}"

    def _agent(self, row: int) -> str:
        seed, agent = divmod(row, self.oversight.setting.agents)
        several = len(self.oversight.setting.seeds) > 1
        return f"agent {agent}" + (f", seed {self.oversight.setting.seeds[seed]}" if several else "")

    def _bars(self) -> list[Text]:
        """A line for each requirement: what the worst agent can still have of it."""
        margins = self.oversight.margins
        label = max(map(len, margins))
        found = []
        for name, margin in margins.items():
            row = int(margin.high.argmin())
            high, count = float(margin.high[row]), int((margin.violated > 0).sum())
            open_ = margin.low[row] < margin.high[row]
            value = f"{'at most ' if open_ else ''}{signed(high)}"
            text = Text(f"  {name:<{label}}  ")
            text.append(self._bar(name, high), style="red" if high < -TOLERANCE else "green")
            told = f"  {value:<16}  {self._agent(row)}"
            text.append(told)
            if count:
                text.append(f"   violated by {count} of {len(margin.high)}", style="red")
            found.append(text)
        return found

    def _bar(self, name: str, value: float) -> str:
        """A margin left or right of the middle, by the largest one so far."""
        full, empty, middle = ("█", "·", "│") if self._unicode else ("#", ".", "|")
        finite = abs(value) if np.isfinite(value) else 0.0
        scale = self._scales[name] = max(self._scales.get(name, 1e-9), finite)
        length = HALF if not np.isfinite(value) else round(HALF * abs(value) / scale)
        length = max(length, 1) if value else 0
        filled = full * length, empty * (HALF - length)
        if value < 0:
            return filled[1] + filled[0] + middle + empty * HALF
        return empty * HALF + middle + filled[0] + filled[1]

    def _agents(self, width: int, most: int) -> list[Text]:
        """A line for each agent of the first seed, the worst of them where there are more than fit."""
        oversight, moment = self.oversight, self.oversight.moment
        assert moment is not None
        agents = range(oversight.setting.agents)
        least = _least(oversight.margins)
        rows = sorted(sorted(agents, key=lambda row: float(least[row]))[:most])
        states = moment.x[: len(agents)].tolist()
        names = oversight.task.system.signature.columns
        decision = moment.decision
        cells = []
        for row in rows:
            rho = "" if decision is None else signed(float(decision.rho[row]))
            name, margin = _worst(oversight.margins, row)
            first = (str(row), oversight.decided(row) or "", rho, f"{name} {signed(margin)}")
            cells.append([*first, *(f"{value:.2f}" for value in states[row])])
        units = (f"{column.name} {column.unit.text}".strip() for column in names)
        text = table(cells, header=("agent", "decided by", "plan", "least margin", *units))
        lines = [Text(line[:width]) for line in text.splitlines()]
        for line, row in zip(lines[1:], rows, strict=True):
            line.stylize("red" if least[row] < -TOLERANCE else "")
        return lines


def _least(margins: Mapping[str, Margin]) -> NDArray[np.float64]:
    """The least margin of each agent over all requirements."""
    least: NDArray[np.float64] = np.min([margin.high for margin in margins.values()], axis=0)
    return least


def _worst(margins: Mapping[str, Margin], row: int) -> tuple[str, float]:
    name = min(margins, key=lambda each: float(margins[each].high[row]))
    return name, float(margins[name].high[row])
