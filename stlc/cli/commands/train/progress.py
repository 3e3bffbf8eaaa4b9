"""The live panel of a training run, and the lines printed at its end."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from stlc.cli.framework.output import console as open_console
from stlc.jsontext import plain
from stlc.units import time_text
from stlc.view.learning import driven_lines

if TYPE_CHECKING:
    from stlc.cli.commands.train.trained import TrainedRun

LINE_EVERY = 25.0  # seconds between lines without a terminal
BLOCKS = "▁▂▃▄▅▆▇█"
ASCII_BLOCKS = "_.-:=+*#"
SPARK_WIDTH = 16


def sparkline(values: list[float], *, width: int = SPARK_WIDTH, blocks: str = BLOCKS) -> str:
    """Return a small bar chart of `values` in one line of at most `width` block characters.

    The values are scaled between their minimum and maximum.
    """
    if not values:
        return ""
    count = min(width, len(values))
    edges = [round(i * len(values) / count) for i in range(count + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(edges)]
    low, high = min(means), max(means)
    top = len(blocks) - 1
    if high - low < 1e-9:
        return blocks[top] * count
    return "".join(blocks[round((value - low) / (high - low) * top)] for value in means)


def clock_text(seconds: float) -> str:
    """Text of a duration: `mm:ss`, or `h:mm:ss` for an hour or more."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    minutes, secs = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{secs:02d}" if hours else f"{minutes:02d}:{secs:02d}"


def percent(value: float) -> str:
    """A share as a percentage with one digit."""
    return f"{100 * value:.1f} %"


class TrainingDisplay:
    """Display of a training run: a panel redrawn in place on a terminal, elsewhere one line every 25 s.

    Call `start`, then `update` for every row of `train.jsonl`, then `finish`; after an interruption, `stop`
    restores the terminal. A row may contain only some of the keys, such as `step` alone; the other values
    stay as they are.
    """

    def __init__(
        self,
        console: Console | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console or open_console(stderr=True)
        self._clock = clock
        self._unicode = "utf" in (self.console.encoding or "").lower()
        self._title, self._spec = "", ""
        self._row: dict[str, Any] = {}
        self._accuracies: list[float] = []
        self._row_at = 0.0
        self._line_at = 0.0
        self._live: Live | None = None

    def start(self, record: Mapping[str, Any], run: str) -> None:
        """Open the panel; without a terminal, print the first line instead.

        Args:
            record: content of `run.json`.
            run: name of the run's folder.
        """
        threads, device = int(record.get("threads", 1)), record.get("device", "cpu")
        path = str(record.get("system_path"))
        self._spec = str(record.get("spec"))
        parts = (
            self._spec,
            f"{Path(path).name} ({path})",
            f"run {run}",
            f"seed {record.get('seed', 0)}",
            f"{threads} thread{'' if threads == 1 else 's'}" if device == "cpu" else str(device),
        )
        self._title = " · ".join(parts)
        self._row["steps"] = record.get("steps")
        self._row_at = self._line_at = self._clock()
        if self.console.file.isatty() and not self.console.is_dumb_terminal:
            self._live = Live(
                get_renderable=self.panel, console=self.console, refresh_per_second=2, transient=True
            )
            self._live.start()
        else:
            self._print(self._title)

    def chosen(self, engine: Mapping[str, Any]) -> None:
        """Print the options that the training selected, such as the batch size, and the back ends it uses."""
        self._print(f"  method          {engine_text(engine)}")
        if "by_torch" in engine:
            self._print(f"  engine          {native_text(engine['by_torch'])}")

    def update(self, row: Mapping[str, Any]) -> None:
        """Update the display with a row of `train.jsonl`, which may contain only some of the keys."""
        self._row.update({key: value for key, value in row.items() if value is not None})
        if row.get("accuracy") is not None:
            self._accuracies.append(float(row["accuracy"]))
        self._row_at = self._clock()
        if self._live is None and self._title and self._row_at - self._line_at >= LINE_EVERY:
            self._line_at = self._row_at
            parts = [self._counter(), self._time_left(), f"plan accuracy {'  '.join(self._accuracy_parts())}"]
            requirements: Mapping[str, float] = self._row.get("requirements") or {}
            if requirements:
                worst = min(requirements, key=requirements.__getitem__)
                parts.append(f"worst {worst} {requirements[worst]:.3f}")
            self._print("  " + "   ".join(part for part in parts if part))

    def stop(self) -> None:
        """Close the panel and restore the terminal; a second call has no effect."""
        if self._live is not None:
            live, self._live = self._live, None
            live.stop()

    def finish(self, lines: Iterable[str], *, to: Console | None = None) -> None:
        """Close the panel and print the final lines.

        They are printed on the console `to`. If `to` is None, they are printed on the console of the panel.
        """
        self.stop()
        console = to or self.console
        for line in lines:
            text = Text(folded := _folded(self._plain(line), console, 16))
            if folded.startswith(("closed loop", "Next:")):
                text.stylize("bold", 0, len(folded))
            elif folded.startswith("plan accuracy"):
                text.stylize("bold", 0, 25)
            console.print(text, soft_wrap=True)

    @property
    def spark(self) -> str:
        """Bar chart in one line of the accuracy at all validations until now."""
        return sparkline(self._accuracies, blocks=self._blocks)

    # ------------------------------------------------------------------ text

    @property
    def _blocks(self) -> str:
        return BLOCKS if self._unicode else ASCII_BLOCKS

    def _plain(self, text: str) -> str:
        return text if self._unicode else text.replace("·", "|")

    def _print(self, text: str) -> None:
        self.console.print(Text(_folded(self._plain(text), self.console, 18)), soft_wrap=True)

    def _steps(self) -> int | None:
        steps = self._row.get("steps")
        return int(steps) if steps else None

    def _counter(self) -> str:
        steps = self._steps()
        if steps is None:
            return "measuring the speed of a step"
        return f"step {int(self._row.get('step', 0)):,} / {steps:,}"

    def _time_left(self) -> str:
        steps, pace = self._steps(), self._row.get("s_per_step")
        if steps is None or not pace:
            return ""
        rest = (steps - int(self._row.get("step", 0))) * float(pace) - (self._clock() - self._row_at)
        return f"{clock_text(rest)} left"

    def _accuracy_parts(self) -> list[str]:
        accuracy, feasible = self._row.get("accuracy"), self._row.get("feasible")
        parts = ["-" if accuracy is None else f"{accuracy:.3f}"]
        if feasible:
            parts.append(f"known feasible {feasible:.3f}")
            if accuracy is not None:
                parts.append(f"share {percent(accuracy / feasible)}")
        return parts

    def panel(self) -> Group:
        """The panel as it is drawn at present."""
        width = self.console.width
        left, right = self._title, f"{self._counter()}   {self._time_left()}".rstrip()
        gap = width - len(left) - len(right)
        lines = [left + " " * gap + right] if gap >= 3 else [left, "  " + right]
        figures = "     ".join(self._accuracy_parts())
        room = min(SPARK_WIDTH, width - len(figures) - 22)
        spark = sparkline(self._accuracies, width=room, blocks=self._blocks) if room >= 4 else ""
        lines.append(f"  plan accuracy   {spark}  {figures}" if spark else f"  plan accuracy   {figures}")
        cells = [f"{name}  {share:.3f}" for name, share in (self._row.get("requirements") or {}).items()]
        lines.extend(_packed(cells, width))
        if self._row.get("failing") is not None:
            lines.append(
                f"  search repaired {self._row.get('repaired', 0)} of {self._row['failing']}"
                " failing starts in the last round"
            )
        texts = [Text(self._plain(line), no_wrap=True, overflow="ellipsis") for line in lines]
        texts[0].stylize("bold", 0, len(self._spec))
        return Group(*texts)


def _folded(text: str, console: Console, indent: int) -> str:
    """Break a line between words where a terminal would break it within one; further lines are indented."""
    if not console.file.isatty() or len(text) <= console.width:
        return text
    beneath = " " * indent
    return textwrap.fill(
        text, console.width, subsequent_indent=beneath, break_long_words=False, break_on_hyphens=False
    )


def _packed(cells: list[str], width: int) -> list[str]:
    """Put the texts `cells` side by side on as few lines as possible, of at most `width` characters.

    The order is kept. Returns the lines.
    """
    lines: list[str] = []
    for cell in cells:
        if lines and len(lines[-1]) + 3 + len(cell) <= width:
            lines[-1] += "   " + cell
        else:
            lines.append("  " + cell)
    return lines


def engine_text(engine: Mapping[str, Any]) -> str:
    """Text of the options that the training selected: method, network, batch, learning rate and others."""
    network = "x".join(map(str, engine["hidden"]))
    if "environments" in engine:  # one control a step, learned from rewards
        parts = (
            str(engine["method"]),
            f"one control a step of a network {network}",
            f"{engine['environments']} episodes side by side",
            f"rate {engine['lr']:g}",
            f"reward {engine['reward']}",
        )
        return " · ".join(parts)
    count, samples = int(engine["plans"]), int(engine.get("samples") or 0)
    states = f"{engine['batch']} states a step"
    if engine["hard"]:
        states = f"{engine['batch']} fresh + {engine['hard']} hard states a step"
    return " · ".join(
        [
            str(engine["method"]),
            f"{count} plan{'' if count == 1 else 's'} of a network {network}",
            states + (f" of {samples:,}" if samples else ""),
            f"rate {engine['lr']:g}",
            f"margin {engine['margin']:.3g}",
        ]
    )


def native_text(by_torch: Mapping[str, str]) -> str:
    """Text that says which parts of the training run as generated C, and why torch computes the others.

    `by_torch` maps the name of a part to the reason for torch; "" means C.
    """
    native = [part for part, reason in by_torch.items() if not reason]
    reasons = dict.fromkeys(reason for reason in by_torch.values() if reason)
    lines = [f"compiled C ({', '.join(native)})"] if native else []
    for why in reasons:
        parts = ", ".join(part for part, reason in by_torch.items() if reason == why)
        lines.append(f"torch ({parts}: {why})")
    return " · ".join(lines)


def final_screen(
    result: TrainedRun,
    spark: str = "",
    *,
    region: str = "",
    unsolved: str = "",
    picture: str = "",
) -> list[str]:
    """Lines printed at the end of a training run.

    If `result` contains an assessment of the run, the last line is the command to run next.

    Args:
        result: record of the finished training.
        spark: bar chart of the accuracy in one line.
        region: description of the initial states from which the requirement with most violations fails.
        unsolved: description of the initial states from which no satisfying plan is known.
        picture: path of a picture of the failures.
    """
    found = result.judged
    assert found is not None
    low, high = found.interval
    rows = [("closed loop", line) for line in driven_lines({"closed_loop": plain(found.closed_loop)})]
    if (rounds := found.falsification) is not None:
        last = f"{percent(rounds.last_share)} of the last round's failed"
        count = f"{rounds.rounds} round{'' if rounds.rounds == 1 else 's'}"
        rows.append(
            ("falsification", f"{count}, {rounds.drives:,} drives, {last}; {rounds.states:,} states kept")
        )
    accuracy = f"{found.accuracy:.3f}   95 % interval [{low:.3f}, {high:.3f}]"
    starts = f" on {found.held_out:,} held-out starts" + (f"   {spark}" if spark else "")
    rows.append(("plan accuracy", accuracy + starts))
    if feasible := found.feasible:
        estimate = f" (an estimate: {found.searched:,} starts were searched or solved)"
        partly = 0 < found.searched < found.held_out
        share = f"{percent(found.accuracy / feasible)} are satisfied{estimate * partly}"
        rows.append(("known feasible", f"{feasible:.3f}   of which {share}"))
    if judged := found.judged_seconds:
        rows.append(("judged", f"on missions of {time_text(judged)}; what is required has no end"))
    verdict, requirements = found.verdict, found.requirements
    if verdict is not None:
        rows.append(("verdict", f"{verdict.level}: {verdict.sentence}"))
    if requirements and min(requirements.values()) < 1.0:
        worst = min(requirements, key=requirements.__getitem__)
        rows += [("worst", f"{worst} {requirements[worst]:.3f}"), ("worst", region)]
    rows += [("unsolved", unsolved), ("picture", picture)]
    rows += [("what helps", advice) for advice in ([] if verdict is None else verdict.advice)]
    steps = f", {found.steps:,} steps" if found.steps else ""
    took = f"{result.seconds:.0f} s of training and verdict{steps}   {result.run}"
    rows.append(("finished", took))
    rows = [(label, text) for label, text in rows if text]
    labels = ["", *(label for label, _ in rows)]
    lines = [
        f"{'' if label == above else label:<15} {text}"
        for above, (label, text) in zip(labels, rows, strict=False)
    ]
    return lines if verdict is None else [*lines, "", f"Next:  {verdict.command}"]
