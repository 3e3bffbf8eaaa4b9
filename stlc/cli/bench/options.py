"""What `stlc bench paper` and `stlc bench ablation` have in common: their options, and how tables fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.framework.output import say
from stlc.cli.framework.ranges import parse_clock, parse_seconds
from stlc.diagnostics import Diagnostic, UsageError
from stlc.registry import closest

if TYPE_CHECKING:
    from stlc.bench.cells import Cell, Length
    from stlc.bench.study import Place

BudgetOption = Annotated[
    list[str] | None,
    typer.Option("--budget", metavar="TIME", help="Time of a training, such as 60s or 5min; repeatable."),
]
ClockOption = Annotated[
    str,
    typer.Option(
        "--clock",
        metavar="wall|processor",
        help="What budgets count; processor time as on an idle machine, for busy ones.",
    ),
]
StepsOption = Annotated[
    int | None, typer.Option("--steps", min=1, help="Steps of the optimiser instead of budgets.")
]
SeedsOption = Annotated[str, typer.Option("--seeds", metavar="SEEDS", help="Such as 0..2 or 0,3.")]
JobsOption = Annotated[
    int, typer.Option("--jobs", "-j", min=1, help="Trainings side by side, a share of the cores each.")
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="auto|local|HOST:PORT",
        help="Train on a Ray cluster instead, as many at a time as it has cores for.",
    ),
]
ThreadsOption = Annotated[int, typer.Option("--threads", min=1, help="Threads of torch in each training.")]
HeldOutOption = Annotated[int, typer.Option("--held-out", min=1, help="Held-out states of the verdicts.")]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")]
RunsOption = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Folder of the runs behind them.")]
SomeRunsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the newest one if none.")
]
MaybePageOption = Annotated[
    Path | None, typer.Option("--page", metavar="FILE", help="A page that takes the table.")
]
PageOption = Annotated[Path, typer.Option("--page", metavar="FILE", help="The page that shows them.")]


def lengths_of(
    budget: Sequence[str] | None, steps: int | None, usual: Sequence[Length], clock: str = "wall"
) -> tuple[Length, ...]:
    """How long is trained. Raises UsageError (U101) for budgets and steps at once."""
    from stlc.bench.cells import Length

    if budget and steps is not None:
        raise UsageError(Diagnostic("U101", "`--budget` and `--steps` contradict each other"))
    if steps is not None:
        return (Length(steps=steps),)
    counted = parse_clock(clock)
    lengths = tuple(Length(parse_seconds(text)) for text in dict.fromkeys(budget or ())) or usual
    return tuple(replace(length, clock=counted) for length in lengths)


def chosen(text: str | None, known: Sequence[str], what: str) -> tuple[str, ...]:
    """Names in a comma-separated list, all of them without one. Raises UsageError (U101) for others."""
    if text is None:
        return tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names:
        if name not in known:
            near = closest(name, known)
            help_ = (f"did you mean `{near}`?",) if near else (", ".join(known),)
            raise UsageError(Diagnostic("U101", f"there is no {what} `{name}`", help=help_))
    if not names:
        raise UsageError(Diagnostic("U101", f"no {what} is named", help=(", ".join(known),)))
    return names


@dataclass(frozen=True, slots=True)
class Filling:
    """What became of the cells of a table.

    Attributes:
        documents: results, in the order of the cells.
        trained: how many were trained now.
        kept: how many were there.
        failed: (name, why) of those that broke off.
    """

    documents: tuple[dict[str, Any], ...]
    trained: int
    kept: int
    failed: tuple[tuple[str, str], ...]

    @property
    def exit_code(self) -> int:
        """1 if a training broke off."""
        return 1 if self.failed else 0

    def told(self) -> dict[str, Any]:
        """For the JSON document."""
        failed = [{"name": name, "why": why} for name, why in self.failed]
        return {"trained": self.trained, "kept": self.kept, "failed": failed}


def filled(cells: Sequence[Cell], place: Place) -> Filling:
    """Fill a table, and say how it goes."""
    from stlc.bench.study import fill

    found: dict[str, dict[str, Any]] = {}
    failed, kept = [], 0
    for number, each in enumerate(fill(cells, place, lambda name: say(f"training {name}")), start=1):
        counted = f"[{number}/{len(cells)}] {each.cell.name}"
        if each.why:
            failed.append((each.cell.name, each.why))
            say(f"{counted}  broke off: {each.why}")
            continue
        found[each.cell.name] = dict(each.document)
        kept += each.kept
        accuracy, seconds = float(each.document["accuracy"]), float(each.document["seconds"])
        done = (*found, *(name for name, _ in failed))
        left = "" if place.cluster is not None else _left(cells, done, place.jobs)
        told = "  kept" if each.kept else left
        say(f"{counted}  accuracy {accuracy:.4f}  {seconds:.0f} s{told}")
    documents = tuple(found[cell.name] for cell in cells if cell.name in found)
    return Filling(documents, len(documents) - kept, kept, tuple(failed))


def _left(cells: Sequence[Cell], done: Sequence[str], jobs: int) -> str:
    """About how long the other trainings take, by their budgets."""
    lengths = [cell.length.seconds for cell in cells if cell.name not in done]
    if not lengths or None in lengths:
        return ""
    minutes = sum(length or 0.0 for length in lengths) / jobs / 60.0
    return f"  {len(lengths)} left, about {minutes:.0f} min"
