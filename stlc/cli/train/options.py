"""The options of `stlc train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.completion import run_names
from stlc.registry import METHODS

SpecsArgument = Annotated[
    list[Path] | None,
    typer.Argument(metavar="SPEC", help="The specification, a .stl file; of several, each is trained for."),
]
BudgetOption = Annotated[
    str | None,
    typer.Option(
        metavar="TIME", help="Time to train, such as 60s or 5min; planned as steps again and again."
    ),
]
ClockOption = Annotated[
    str,
    typer.Option(
        metavar="wall|processor", help="What a budget counts; processor time as on an idle machine."
    ),
]
StepsOption = Annotated[
    str | None,
    typer.Option(metavar="N", help="Steps of the optimiser instead of a budget, or a recorded schedule."),
]
SeedOption = Annotated[
    int | None,
    typer.Option(min=0, max=2**63 - 1, help="Seed of everything random; the system file's if not given."),
]
SeedsOption = Annotated[
    str | None,
    typer.Option(metavar="SEEDS", help="Several runs, such as 0..2 or 0,3, in processes of their own."),
]
JobsOption = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Runs side by side.")]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="auto|local|HOST:PORT",
        help="Train on a Ray cluster, as many as it has cores for.",
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(METHODS),
        help="Search and distil, or the paper's plain gradient; guided unless the system says otherwise.",
    ),
]
ResumeOption = Annotated[
    str | None, typer.Option(metavar="RUN", help="Go on with an interrupted run.", autocompletion=run_names)
]
NameOption = Annotated[str | None, typer.Option(help="Name of the run; drawn if not given.")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")]
ThreadsOption = Annotated[int | None, typer.Option(min=1, help="Threads of torch.")]
PlansOption = Annotated[int | None, typer.Option(min=1, help="Plans that the network proposes.")]
RateOption = Annotated[float | None, typer.Option(help="Peak learning rate.")]
BatchOption = Annotated[int | None, typer.Option(min=1, help="Fresh states a step.")]
HeldOutOption = Annotated[int | None, typer.Option(min=1, help="Held-out starts of the verdict; 5000.")]
DrivesOption = Annotated[
    int | None, typer.Option(min=0, help="Drives after the training, under one guard at most; 400, 0: none.")
]
LogOption = Annotated[
    str | None, typer.Option(metavar="tensorboard", help="Keep the curves for TensorBoard too.")
]
RunsOption = Annotated[Path, typer.Option(help="Folder of all runs.")]
PicturesOption = Annotated[bool, typer.Option(help="Draw the curves and the report.")]
