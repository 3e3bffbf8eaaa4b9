"""Groups of options that several tables share: one dataclass per group, whose fields are the options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.options import JsonOption
from stlc.diagnostics import usage
from stlc.options import parse_clock, parse_seconds, parse_seeds
from stlc.similar import closest

if TYPE_CHECKING:
    from benchmarks.training import Length, Place
    from stlc.rundir import RunDir

OnlyOption = Annotated[
    str | None, typer.Option("--only", metavar="NAMES", help="Some of them; all if not given.")
]
RunsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the newest one if none.")
]
SeedsOption = Annotated[str, typer.Option("--seeds", metavar="SEEDS", help="Such as 0..9 or 0,3.")]
ResultsOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")]
TrainedOption = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Folder of the runs behind them.")]
PageOption = Annotated[
    Path | None, typer.Option("--page", metavar="FILE", help="The page that takes the table.")
]


@dataclass(frozen=True, slots=True)
class Output:
    """Options for the output of a table."""

    page: PageOption = None
    as_json: JsonOption = False


@dataclass(frozen=True, slots=True)
class Training:
    """Options for the training runs of a table."""

    budget: Annotated[
        list[str] | None,
        typer.Option("--budget", metavar="TIME", help="Time of a training, such as 60s or 5min; repeatable."),
    ] = None
    clock: Annotated[
        str,
        typer.Option(
            "--budget-clock",
            metavar="wall|processor",
            help="What budgets count; processor time as on an idle machine, for busy ones.",
        ),
    ] = "wall"
    steps: Annotated[
        int | None,
        typer.Option("--steps", metavar="N", min=1, help="Steps of the optimiser instead of budgets."),
    ] = None
    seeds: SeedsOption = "0..2"
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", "-j", metavar="N", min=1, help="Trainings side by side, a share of the cores each."
        ),
    ] = 1
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            metavar="auto|local|HOST:PORT",
            help="Train on a Ray cluster instead, as many at a time as it has cores for.",
        ),
    ] = None
    threads: Annotated[
        int, typer.Option("--threads", metavar="N", min=1, help="Threads of torch in each training.")
    ] = 1
    held_out: Annotated[
        int,
        typer.Option("--held-out", metavar="N", min=1, help="Held-out states that policies are judged on."),
    ] = 5000
    out: ResultsOption = Path("benchmarks/results")
    runs: TrainedOption = Path("runs/benchmarks")

    def seeds_and_lengths(self, usual: Sequence[float]) -> list[tuple[int, Length]]:
        """Return (seed, length) for each training run, ordered by length, then by seed.

        `usual` are the training times in seconds if neither budgets nor steps are given.

        Raises:
            UsageError: U101, budgets and steps are both given.
        """
        from benchmarks.training import Length

        if self.budget and self.steps is not None:
            raise usage("`--budget` and `--steps` contradict each other")
        clock = parse_clock(self.clock)
        seconds = [parse_seconds(text) for text in dict.fromkeys(self.budget or ())] or usual
        lengths = [Length(each, clock=clock) for each in seconds]
        if self.steps is not None:
            lengths = [Length(steps=self.steps)]
        return [(seed, length) for length in lengths for seed in parse_seeds(self.seeds)]

    def place(self, table: str) -> Place:
        """Return the place of a table's training runs: result file, run folder and number of processes."""
        from benchmarks.store import ResultStore
        from benchmarks.training import Place

        store = ResultStore(table, self.out)
        return Place(store, self.runs, self.jobs, self.threads, self.cluster)


PARTS = ("learners", "plans", "drives")
"""Parts of the paper's comparison."""


@dataclass(frozen=True, slots=True)
class Comparing:
    """Options for the paper's comparison."""

    methods: Annotated[
        str | None,
        typer.Option(
            "--methods", metavar="NAMES", help="Such as guided,sac:task,plan:search; all if not given."
        ),
    ] = None
    parts: Annotated[
        str | None,
        typer.Option("--parts", metavar="NAMES", help="Of learners,plans,drives; all if not given."),
    ] = None
    show: Annotated[
        bool, typer.Option("--show", help="Measure nothing; write the page from what is stored.")
    ] = False
    hour: Annotated[bool, typer.Option("--hour", help="Also train sac for an hour.")] = False
    plan_time: Annotated[
        list[str] | None,
        typer.Option(
            "--plan-time", metavar="TIME", help="Processor time a plan; repeatable. 1ms, 10ms, 100ms and 1s."
        ),
    ] = None
    starts: Annotated[
        int, typer.Option("--starts", metavar="N", min=1, help="Starts that planners plan from.")
    ] = 1000
    decision: Annotated[
        str, typer.Option("--decision", metavar="TIME", help="Processor time of a planner in closed loop.")
    ] = "10ms"
    drives: Annotated[
        str, typer.Option("--drives", metavar="SEEDS", help="Worlds in closed loop, such as 0..2.")
    ] = "0..2"
    agents: Annotated[
        int | None, typer.Option("--agents", metavar="N", min=1, help="In each world, at most.")
    ] = None
    drive_steps: Annotated[
        int | None, typer.Option("--drive-steps", metavar="N", min=1, help="Of each drive, at most.")
    ] = None
    passes: Annotated[
        int,
        typer.Option(
            "--passes", metavar="N", min=0, help="Searches for feasible states, 20,000 plans a state each."
        ),
    ] = 10
    proof: Annotated[
        float,
        typer.Option(
            "--proof",
            metavar="SECONDS",
            min=0.0,
            help="Processor time a state for a proof that no plan exists (extra `plan`); 0 for none.",
        ),
    ] = 5.0

    @property
    def seconds(self) -> tuple[float, ...]:
        """Time budgets of planners: processor time per plan in seconds."""
        from benchmarks.plannings import SECONDS

        return tuple(parse_seconds(text) for text in dict.fromkeys(self.plan_time or ())) or SECONDS

    @property
    def seconds_of_decision(self) -> float:
        """Processor time in seconds that a planner has for each decision in closed loop."""
        return parse_seconds(self.decision)

    @property
    def worlds(self) -> tuple[int, ...]:
        """Seeds of the closed-loop simulations."""
        return parse_seeds(self.drives)

    def check(self) -> None:
        """Parse all options, so that an error is found before any measurement. Raises UsageError (U101)."""
        self.asks(PARTS[0])
        self.seconds, self.seconds_of_decision, self.worlds  # noqa: B018

    def asks(self, part: str) -> bool:
        """True if the part `part` (`learners`, `plans` or `drives`) is to be measured.

        Raises:
            UsageError: U101, the option `--parts` contains an unknown name.
        """
        return part in chosen(self.parts, PARTS, "part") and not self.show


def chosen(text: str | None, known: Sequence[str], what: str) -> tuple[str, ...]:
    """Return the names in the comma-separated list `text`; if it is None, return all of `known`.

    `what` is the noun for a name in error messages.

    Raises:
        UsageError: U101, a name is not in `known`, or the list is empty.
    """
    if text is None:
        return tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names:
        if name not in known:
            near = closest(name, known)
            help_ = (f"did you mean `{near}`?",) if near else (", ".join(known),)
            raise usage(f"there is no {what} `{name}`", *help_)
    if not names:
        raise usage(f"no {what} is named", ", ".join(known))
    return names


def opened(names: Sequence[str] | None) -> list[RunDir]:
    """Open the runs called `names`; without names, open the newest run."""
    from stlc.rundir import RunDir

    return [RunDir.open(name) for name in names or ["latest"]]
