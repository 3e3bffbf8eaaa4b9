"""The live panel of a training run, and its final screen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from stlc.cli.framework.output import console as open_console

if TYPE_CHECKING:
    from stlc.view.learning import Learning

LINE_EVERY = 25.0  # seconds between lines without a terminal
BLOCKS = "▁▂▃▄▅▆▇█"
ASCII_BLOCKS = "_.-:=+*#"
SPARK_WIDTH = 16


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Facts known before the first step.

    Attributes:
        spec: name of the specification.
        system: file name of the system, e.g. `car.yaml`.
        system_path: where that file was found.
        run: name of the run's folder, e.g. `0001-quiet-heron`.
        seed: of the run.
        threads: of torch.
        device: on which training runs.
        steps: planned steps; None while a time budget is not yet converted into steps.
    """

    spec: str
    system: str
    system_path: str
    run: str
    seed: int
    threads: int
    device: str = "cpu"
    steps: int | None = None


@dataclass(frozen=True, slots=True)
class Summary:
    """Content of the final screen.

    Attributes:
        accuracy: share of held-out starts whose plan satisfies the specification.
        interval: 95 % interval of `accuracy`.
        held_out: number of held-out starts.
        requirements: share per requirement.
        feasible: share of the held-out starts with a known satisfying plan, or None.
        seconds: of training.
        folder: of the run.
        learning: the verdict on the training, with the next step.
        driven: closed-loop results, a line each.
        steps: of the optimiser.
        searched: held-out starts that the policy solves or that were searched; 0 if unknown.
        where: failure region of the worst requirement, in words, or "".
        unsolved: remaining starts, in words, or "".
        picture: path of a picture of the region, or "".
        judged: seconds of an unbounded mission on which the policy was validated; None for a bounded one.
        status: how the run ended: `finished`, `interrupted`, …
    """

    accuracy: float
    interval: tuple[float, float]
    held_out: int
    requirements: Mapping[str, float] = field(default_factory=dict)
    feasible: float | None = None
    seconds: float = 0.0
    folder: str = ""
    learning: Learning | None = None
    driven: Sequence[str] = ()
    steps: int = 0
    searched: int = 0
    where: str = ""
    unsolved: str = ""
    picture: str = ""
    judged: float | None = None
    status: str = "finished"


def sparkline(values: list[float], *, width: int = SPARK_WIDTH, blocks: str = BLOCKS) -> str:
    """A sparkline of `values` in at most `width` blocks, scaled between minimum and maximum."""
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
    """A duration as `mm:ss`, or `h:mm:ss` from an hour on."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    minutes, secs = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{secs:02d}" if hours else f"{minutes:02d}:{secs:02d}"


def percent(value: float) -> str:
    """A share as a percentage with one digit."""
    return f"{100 * value:.1f} %"


class Progress:
    """Shows a training run: in place on a terminal, one line every 25 s elsewhere.

    Rows are those of `train.jsonl`; a row may carry only some of its keys (a bare `step` moves the counter),
    missing keys keep their last value. In use: `start`, `update`…, `finish`; `stop` alone restores the
    terminal after an interruption.
    """

    def __init__(
        self,
        console: Console | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        every: float = LINE_EVERY,
    ) -> None:
        self.console = console or open_console(stderr=True)
        self._clock = clock
        self._every = every
        self._unicode = "utf" in (self.console.encoding or "").lower()
        self._info: RunInfo | None = None
        self._row: dict[str, Any] = {}
        self._accuracies: list[float] = []
        self._row_at = 0.0
        self._line_at = 0.0
        self._live: Live | None = None

    def start(self, info: RunInfo) -> None:
        """Open the panel (or print the opening line)."""
        self._info = info
        self._row_at = self._line_at = self._clock()
        if self.console.file.isatty() and not self.console.is_dumb_terminal:
            self._live = Live(
                get_renderable=self.panel, console=self.console, refresh_per_second=2, transient=True
            )
            self._live.start()
        else:
            self._print(self._title())

    def chosen(self, engine: Mapping[str, Any]) -> None:
        """Show the configuration that the engine resolved."""
        self._print(f"  engine          {engine_text(engine)}")
        if "by_torch" in engine:
            self._print(f"  computed by     {native_text(engine['by_torch'])}")

    def update(self, row: Mapping[str, Any]) -> None:
        """Update from a row of `train.jsonl`, or a part of one."""
        self._row.update({key: value for key, value in row.items() if value is not None})
        if row.get("accuracy") is not None:
            self._accuracies.append(float(row["accuracy"]))
        self._row_at = self._clock()
        if self._live is None and self._info and self._row_at - self._line_at >= self._every:
            self._line_at = self._row_at
            self._print(self._line())

    def stop(self) -> None:
        """Close the panel; safe to call twice."""
        if self._live is not None:
            live, self._live = self._live, None
            live.stop()

    def finish(self, summary: Summary, *, to: Console | None = None) -> None:
        """Close the panel and print the final screen, to `to` if given."""
        self.stop()
        console = to or self.console
        lines = final_screen(summary, sparkline(self._accuracies, blocks=self._blocks))
        for line in lines:
            console.print(_emphasised(self._plain(line)), soft_wrap=True)

    # ------------------------------------------------------------------ text

    @property
    def _blocks(self) -> str:
        return BLOCKS if self._unicode else ASCII_BLOCKS

    def _plain(self, text: str) -> str:
        return text if self._unicode else text.replace("·", "|")

    def _print(self, text: str) -> None:
        self.console.print(Text(self._plain(text)), soft_wrap=True)

    def _title(self) -> str:
        info = self._info
        assert info is not None
        where = f"{info.threads} thread{'' if info.threads == 1 else 's'}"
        if info.device != "cpu":
            where = info.device
        parts = (
            info.spec,
            f"{info.system} ({info.system_path})",
            f"run {info.run}",
            f"seed {info.seed}",
            where,
        )
        return " · ".join(parts)

    def _steps(self) -> int | None:
        steps = self._row.get("steps") or (self._info.steps if self._info else None)
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

    def _line(self) -> str:
        parts = [self._counter(), self._time_left(), f"plan accuracy {'  '.join(self._accuracy_parts())}"]
        requirements: Mapping[str, float] = self._row.get("requirements") or {}
        if requirements:
            worst = min(requirements, key=requirements.__getitem__)
            parts.append(f"worst {worst} {requirements[worst]:.3f}")
        return "  " + "   ".join(part for part in parts if part)

    def _accuracy_line(self, width: int) -> str:
        """The accuracy and its sparkline, which shrinks in a narrow terminal."""
        figures = "     ".join(self._accuracy_parts())
        room = min(SPARK_WIDTH, width - len(figures) - 22)
        spark = sparkline(self._accuracies, width=room, blocks=self._blocks) if room >= 4 else ""
        return f"  plan accuracy   {spark}  {figures}" if spark else f"  plan accuracy   {figures}"

    def panel(self) -> Group:
        """The present panel."""
        width = self.console.width
        lines = [*_spread(self._title(), f"{self._counter()}   {self._time_left()}".rstrip(), width)]
        lines.append(self._accuracy_line(width))
        cells = [f"{name}  {share:.3f}" for name, share in (self._row.get("requirements") or {}).items()]
        lines.extend(_packed(cells, width))
        if self._row.get("failing") is not None:
            lines.append(
                f"  search repaired {self._row.get('repaired', 0)} of {self._row['failing']}"
                " failing starts in the last round"
            )
        texts = [Text(self._plain(line), no_wrap=True, overflow="ellipsis") for line in lines]
        texts[0].stylize("bold", 0, len(self._info.spec) if self._info else 0)
        return Group(*texts)


def _spread(left: str, right: str, width: int) -> tuple[str, ...]:
    """`left` and `right` at the two ends of a line, or on two lines where one is too short."""
    gap = width - len(left) - len(right)
    return (left + " " * gap + right,) if gap >= 3 else (left, "  " + right)


def _packed(cells: list[str], width: int) -> list[str]:
    """`cells` side by side on as few lines of `width` as hold them."""
    lines: list[str] = []
    for cell in cells:
        if lines and len(lines[-1]) + 3 + len(cell) <= width:
            lines[-1] += "   " + cell
        else:
            lines.append("  " + cell)
    return lines


def engine_text(engine: Mapping[str, Any]) -> str:
    """The resolved configuration on a line: method, network, batch, learning rate and margin."""
    network = "x".join(map(str, engine["hidden"]))
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
    """The parts of training that run as generated C, and why others do not."""
    native = [part for part, reason in by_torch.items() if not reason]
    reasons = dict.fromkeys(reason for reason in by_torch.values() if reason)
    lines = [f"{', '.join(native)}: C"] if native else []
    for why in reasons:
        parts = ", ".join(part for part, reason in by_torch.items() if reason == why)
        lines.append(f"{parts}: torch ({why})")
    return " · ".join(lines)


def _judged(summary: Summary) -> list[str]:
    """The length of validation of an unbounded mission."""
    if summary.judged is None:
        return []
    return [f"judged          on missions of {summary.judged:g} s; what is required has no end"]


def final_screen(summary: Summary, spark: str = "") -> list[str]:
    """The final lines of a training run; with a verdict the last one is the next command."""
    low, high = summary.interval
    lines = [f"{'' if i else 'closed loop':<15} {line}" for i, line in enumerate(summary.driven)]
    lines += [
        f"plan accuracy   {summary.accuracy:.3f}   95 % interval [{low:.3f}, {high:.3f}]"
        f" on {summary.held_out:,} held-out starts" + (f"   {spark}" if spark else "")
    ]
    if summary.feasible:
        share = percent(summary.accuracy / summary.feasible)
        estimate = ""
        if 0 < summary.searched < summary.held_out:
            estimate = f" (an estimate: {summary.searched:,} starts were searched or solved)"
        lines.append(f"known feasible  {summary.feasible:.3f}   of which {share} are satisfied{estimate}")
    lines += _judged(summary)
    learning = summary.learning
    if learning is not None:
        lines.append(f"verdict         {learning.level}: {learning.sentence}")
    if summary.requirements and min(summary.requirements.values()) < 1.0:
        worst = min(summary.requirements, key=summary.requirements.__getitem__)
        lines.append(f"worst           {worst} {summary.requirements[worst]:.3f}")
        if summary.where:
            lines.append(f"                {summary.where}")
    if summary.unsolved:
        lines.append(f"unsolved        {summary.unsolved}")
    if summary.picture:
        lines.append(f"picture         {summary.picture}")
    for i, advice in enumerate(() if learning is None else learning.advice):
        lines.append(f"{'' if i else 'what helps':<15} {advice}")
    took = f"{summary.seconds:.0f} s of training and verdict" + (
        f", {summary.steps:,} steps" if summary.steps else ""
    )
    lines.append(f"{summary.status:<15} {took}" + (f"   {summary.folder}" if summary.folder else ""))
    if learning is not None:
        lines += ["", f"Next:  {learning.command}"]
    return lines


def _emphasised(line: str) -> Text:
    text = Text(line)
    if line.startswith(("closed loop", "Next:")):
        text.stylize("bold", 0, len(line))
    elif line.startswith("plan accuracy"):
        text.stylize("bold", 0, 25)
    return text
