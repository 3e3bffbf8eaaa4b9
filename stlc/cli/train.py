"""`stlc train`: a specification and a system in, a run folder with a trained policy out."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.completion import run_names
from stlc.cli.options import JsonOption, SetOption, SystemOption, describe, parse_overrides
from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.cli.sitting import Sitting
    from stlc.controller.config import Method, TrainConfig
    from stlc.controller.launch import Launch
    from stlc.controller.task import Task

METHODS: tuple[Method, ...] = ("guided", "gradient")

SeedOption = Annotated[
    int | None,
    typer.Option(min=0, max=2**63 - 1, help="Seed of everything random; the system file's if not given."),
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        metavar="guided|gradient",
        help="Search and distil, or the paper's plain gradient; guided unless the system says otherwise.",
    ),
]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        "train",
        help=describe(
            "Learn a policy that satisfies a specification.",
            "stlc train specs/traffic.stl --system car.yaml --budget 60s",
            "stlc train --resume latest",
            note="The run's folder holds everything that repeats it. Ctrl-C saves a checkpoint and stops.",
        ),
    )(train)


def train(
    spec: Annotated[
        Path | None, typer.Argument(metavar="SPEC", help="The specification, a .stl file.")
    ] = None,
    system: SystemOption = None,
    budget: Annotated[
        str | None, typer.Option(metavar="TIME", help="Time to train, such as 60s or 5min; becomes steps.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of the optimiser instead of a budget.")
    ] = None,
    seed: SeedOption = None,
    method: MethodOption = None,
    resume: Annotated[
        str | None,
        typer.Option(metavar="RUN", help="Go on with an interrupted run.", autocompletion=run_names),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the run; drawn if not given.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of torch.")] = None,
    plans: Annotated[int | None, typer.Option(min=1, help="Plans that the network proposes.")] = None,
    lr: Annotated[float | None, typer.Option(help="Peak learning rate.")] = None,
    batch: Annotated[int | None, typer.Option(min=1, help="Fresh states a step.")] = None,
    runs: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("runs"),
    pictures: Annotated[bool, typer.Option(help="Draw the curves and the report.")] = True,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Learn a policy, or go on with a run that was interrupted."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads of torch must not spin
    if resume is not None:
        _refuse_on_resume(
            {"SPEC": spec, "--system": system, "--budget": budget, "--seed": seed, "--method": method}
            | {"--name": name, "--threads": threads, "--plans": plans, "--lr": lr, "--batch": batch}
            | {"--set": set_}
        )
        sitting = _resume(resume, runs=runs, steps=steps, device=device)
    else:
        from stlc.controller.config import TrainConfig
        from stlc.controller.launch import Launch

        if budget is not None and steps is not None:
            raise UsageError(Diagnostic("U101", "`--budget` and `--steps` contradict each other"))
        config = TrainConfig(
            method=_method(method) if method is not None else None,
            budget=_seconds(budget) if budget is not None else None,
            steps=steps,
            seed=seed,
            device=device,
            threads=threads,
            plans=plans,
            lr=_rate(lr) if lr is not None else None,
            batch=batch,
        )
        launch = Launch(root=runs, name=name, overrides=parse_overrides(set_), command=sys.argv[1:])
        sitting = _train(_task(spec, system, launch.overrides), config, launch)
    sitting.conclude(pictures=pictures, json=json)


def _method(name: str) -> Method:
    for method in METHODS:
        if name == method:
            return method
    raise UsageError(Diagnostic("U101", f"there is no method `{name}`", help=(" or ".join(METHODS),)))


def _rate(value: float) -> float:
    """A learning rate: a positive number."""
    if not 0.0 < value < math.inf:
        raise UsageError(Diagnostic("U101", f"`--lr {value:g}` is not a learning rate", help=("--lr 1e-3",)))
    return value


def _seconds(text: str) -> float:
    """A duration such as `60s`, `5min`, `1.5 h`; a bare number is seconds."""
    from stlc.units import parse_unit

    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyz ").strip()
    unit = text.strip()[len(number) :].strip() or "s"
    try:
        value = float(number) * float(parse_unit(unit).scale)
        if parse_unit(unit).dims != parse_unit("s").dims or not 0.0 < value < 1e9:
            raise ValueError
    except ValueError as error:
        finding = Diagnostic(
            "U101", f"`{text}` is not a duration", help=("write it as --budget 60s or 5min",)
        )
        raise UsageError(finding) from error
    return value


def _task(path: Path | None, system: str | None, overrides: Mapping[str, str]) -> Task:
    """Read, compile, and say which system file was taken."""
    from stlc.cli.output import say, show_diagnostics
    from stlc.controller.task import Task
    from stlc.dynamics.system import System
    from stlc.files import find_system, read_source
    from stlc.grammar.parser import parse

    if path is None:
        example = "stlc train specs/traffic.stl --system car.yaml"
        raise UsageError(Diagnostic("U101", "which specification is to be trained for?", help=(example,)))
    spec = parse(read_source(path))
    wanted = system or spec.system
    if wanted is None:
        help_ = ("stlc train SPEC --system FILE", 'or a line `system "FILE"` in the specification')
        raise UsageError(Diagnostic("U101", f"`{path}` names no system", help=help_))
    found = find_system(wanted, path)
    say(f"system {found}")
    loaded = System.load(found, overrides)
    task = Task.of(spec, loaded, overrides=overrides)
    show_diagnostics(task.compiled.warnings)
    return task


def _train(task: Task, config: TrainConfig, launch: Launch) -> Sitting:
    """A new run, from its folder to its verdict."""
    from stlc.cli.sitting import Sitting
    from stlc.controller.launch import open_folder
    from stlc.controller.train import find_device, train

    find_device(config.device)
    folder = open_folder(task, config, launch)
    with Sitting(folder) as sitting:
        sitting.outcome = train(task, config, folder, sitting.watch)
    return sitting


def _resume(where: str, *, runs: Path, steps: int | None, device: str) -> Sitting:
    """An old run, from its last checkpoint to its verdict."""
    from stlc.cli.sitting import Sitting
    from stlc.controller.train import resume
    from stlc.rundir import RunDir

    folder = RunDir.open(where, runs)
    with Sitting(folder) as sitting:
        sitting.outcome = resume(folder, steps=steps, device=device, watch=sitting.watch)
    return sitting


def _refuse_on_resume(given: Mapping[str, object]) -> None:
    """A resumed run goes on with what it was started with; only `--steps` and `--device` may change."""
    named = [option for option, value in given.items() if value is not None]
    if named:
        raise UsageError(
            Diagnostic(
                "R104",
                f"{', '.join(named)} cannot change when a run is resumed",
                help=("stlc train --resume RUN [--steps N]", "a new run takes any option"),
            )
        )
