"""`stlc train`: train a policy for a specification and a system, in a new run folder."""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import (
    MOST_SEED,
    ClusterOption,
    JobsOption,
    MethodOptionsOption,
    PicturesOption,
    RunsOption,
    SetOption,
    SystemOption,
    parse_clock,
    parse_count,
    parse_overrides,
    parse_pairs,
    parse_seconds,
    parse_seeds,
)
from stlc.cli.framework.output import Answer, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.cli.train.many import Many, train_many
from stlc.diagnostics import Diagnostic, MissingError, StlcError, UsageError, usage
from stlc.registry import METHODS
from stlc.rundir import RUNS, RunDir

if TYPE_CHECKING:
    from stlc.cli.framework.documents import TrainedRun, TrainedRuns
    from stlc.cli.train.session import Session
    from stlc.controller.problem.task import Task
    from stlc.controller.training.budget import StepSchedule
    from stlc.controller.training.config import TrainConfig
    from stlc.controller.training.launch import Launch
    from stlc.controller.training.tensorboard import Opener


@command(
    "stlc train specs/traffic.stl --system car.yaml --budget 60s",
    "stlc train --resume latest --budget 5min",
    "stlc train specs/traffic.stl --seeds 0..2 --jobs 2",
    "stlc train specs/traffic.stl specs/ship_safe.stl --seeds 0..2 --cluster auto",
    drives=True,
)
def train(
    spec: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SPEC", help="The specification, a .stl file; several are trained for one by one."
        ),
    ] = None,
    system: SystemOption = None,
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Training time, such as 5min; the steps are adapted.",
            show_default="60s",
        ),
    ] = None,
    clock: Annotated[
        str | None,
        typer.Option(
            metavar="wall|processor",
            help="Clock of the budget; processor time is that of an idle machine.",
            show_default="wall",
        ),
    ] = None,
    steps: Annotated[
        str | None,
        typer.Option(metavar="N", help="Steps of the optimiser instead of a budget, or a recorded schedule."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=MOST_SEED, help="Seed of everything random.", show_default="the system's"),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(metavar="SEEDS", help="Several runs, such as 0..2 or 0,3, in processes of their own."),
    ] = None,
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="|".join((*METHODS.installed, "FILE.py")),
            help="How to train, see docs/methods.md.",
            show_default="the system's, or guided",
        ),
    ] = None,
    option: MethodOptionsOption = None,
    resume: Annotated[
        str | None,
        typer.Option(metavar="RUN", help="Go on with an interrupted run.", autocompletion=run_names),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the run.", show_default="random words")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of torch.")] = None,
    plans: Annotated[int | None, typer.Option(min=1, help="Plans that the network proposes.")] = None,
    lr: Annotated[float | None, typer.Option(help="Peak learning rate.")] = None,
    batch: Annotated[int | None, typer.Option(min=1, help="New states per step.")] = None,
    held_out: Annotated[
        int | None, typer.Option(min=1, help="Held-out starts of the verdict.", show_default="5000")
    ] = None,
    drives: Annotated[
        int | None,
        typer.Option(min=0, help="Drives after the training per guard, at most.", show_default="400"),
    ] = None,
    falsify: Annotated[
        bool,
        typer.Option("--falsify", help="Also train on the states of drives that falsification makes fail."),
    ] = False,
    log: Annotated[
        str | None, typer.Option(metavar="tensorboard", help="Also write the curves for TensorBoard.")
    ] = None,
    runs: RunsOption = RUNS,
    pictures: PicturesOption = True,
    set_: SetOption = None,
) -> Answer[TrainedRun | TrainedRuns]:
    """Train a policy that satisfies a specification.

    The run's folder contains everything to reproduce it. Ctrl-C saves a checkpoint and stops.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads of torch must not busy-wait
    specs = tuple(dict.fromkeys(spec or ()))
    given = {
        **{"--system": system, "--seed": seed, "--seeds": seeds, "--method": method, "--name": name},
        **{"--threads": threads, "--plans": plans, "--lr": lr, "--batch": batch, "--set": set_},
        **{"--held-out": held_out, "--drives": drives, "--cluster": cluster, "--clock": clock},
        **{"--option": option, "--falsify": falsify or None},
    }
    _check_together(specs, jobs, {**given, "--budget": budget, "--steps": steps})
    logger = _logger(log)
    if resume is not None:
        _refuse_on_resume({"SPEC": spec or None, **given})
        total = None if steps is None else parse_count(steps, "--steps")
        more = None if budget is None else parse_seconds(budget)
        with one_voice():
            session = _resume(RunDir.open(resume, runs), total, more, device, logger)
            return session.conclude(pictures=pictures)
    from stlc.controller.run.config import DRIVES, HELD_OUT
    from stlc.controller.training.config import TrainConfig
    from stlc.controller.training.launch import Launch

    config = TrainConfig(
        method=_method(method) if method is not None else None,
        budget=parse_seconds(budget) if budget is not None else None,
        steps=_steps(steps) if steps is not None else None,
        seed=seed,
        device=device,
        threads=threads,
        plans=plans,
        lr=_rate(lr) if lr is not None else None,
        batch=batch,
        held_out=held_out or HELD_OUT,
        clock=parse_clock(clock or "wall"),
        drives=DRIVES if drives is None else drives,
        options=parse_pairs(option, "--option", "NAME=VALUE", "environments=256"),
        falsify=falsify,
    )
    launch = Launch(root=runs, name=name, overrides=parse_overrides(set_), command=sys.argv[1:])
    drawn = parse_seeds(seeds) if seeds is not None else (seed,)
    if len(specs) < 2:  # errors of a single specification are reported once, before the first of several runs
        with one_voice():
            task = _task(specs, system, launch.overrides, config.method)
            if seeds is None and cluster is None:
                return _train(task, config, launch, logger).conclude(pictures=pictures)
    return train_many(Many(specs, system, config, launch, drawn, jobs, cluster, log, pictures))


def _check_together(specs: Sequence[Path], jobs: int, given: Mapping[str, object]) -> None:
    """Raise UsageError (U101) if options of `stlc train` exclude each other or do not apply.

    Some options do not apply to a single run, some not to several specifications, and some not to a cluster.
    `given` maps the name of an option to its value, or to None if it is not given.
    """
    for one, other in (("--budget", "--steps"), ("--seed", "--seeds")):
        if given[one] is not None and given[other] is not None:
            raise usage(f"`{one}` and `{other}` contradict each other")
    if len(specs) > 1 and given["--system"] is not None:
        raise usage("`--system` is for one specification", 'a line `system "FILE"` in every specification')
    if given["--cluster"] is not None and jobs > 1:
        advice = "a cluster runs as many as it has cores for; --threads says how many a run has"
        raise usage("`--jobs` and `--cluster` contradict each other", advice)
    if len(specs) < 2 and given["--seeds"] is None and jobs > 1:
        raise usage("`--jobs` needs several runs", "stlc train SPEC --seeds 0..2 --jobs 2")


def _logger(name: str | None) -> Opener | None:
    """Function that opens the logger of `--log`; None without that option.

    Raises:
        MissingError: R301, the logger is not installed.
    """
    if name is None:
        return None
    if name != "tensorboard":
        raise usage(f"there is no log `{name}`", "--log tensorboard")
    from stlc.controller.training.tensorboard import find_writer

    return find_writer()


def _method(name: str) -> str:
    """Return the name of the training method that `--method` names, or whose file it names.

    Raises UsageError (U101) if there is none.
    """
    name = METHODS.chosen(name)
    if name not in METHODS:
        raise usage(f"there is no method `{name}`", METHODS.suggest(name))
    return name


def _steps(text: str) -> int | StepSchedule:
    """Parse the value of `--steps`: a number of steps, or a schedule that was recorded by another run.

    A run with a time budget adjusts its total number of steps as it proceeds, and records these totals as a
    schedule. In `10000,1240@10` the total is 10000 at first, and 1240 after step 10; `simulations=6@400` is a
    round of falsification after step 400.
    """
    from stlc.controller.training.budget import StepSchedule

    if text.strip().isdecimal():
        return parse_count(text, "--steps")
    try:
        return StepSchedule.parse(text)
    except ValueError as error:
        help_ = ("--steps 1200", "the schedule of a run is in its report and in its run.json")
        message = f"`--steps {text}` is no number of steps"
        raise UsageError(Diagnostic("U101", message, help=help_, note=(str(error),))) from None


def _rate(value: float) -> float:
    """Check that a learning rate is positive and finite, and return it. Raises UsageError (U101) if not."""
    if not 0.0 < value < math.inf:
        raise usage(f"`--lr {value:g}` is not a learning rate", "--lr 1e-3")
    return value


def _task(
    specs: Sequence[Path], system: str | None, overrides: Mapping[str, str], method: str | None
) -> Task:
    """Read and compile the specification for its system, and print which system file is used.

    `overrides` gives new values of constants and of fields of the system file. If the training `method` can
    do so, plans reach to the end of missions.
    """
    from stlc.compile.deadlines import beyond_plans
    from stlc.controller.problem.load import load_task, require_controls
    from stlc.controller.training.config import method_name
    from stlc.dynamics.model.feedback import unstable
    from stlc.grammar.allow import not_allowed

    if not specs:
        example = "stlc train specs/traffic.stl --system car.yaml"
        raise usage("missing: a specification", example)
    task = load_task(
        specs[0],
        system or None,
        overrides,
        hint="stlc train SPEC --system FILE",
        found=lambda path: say(f"system {path}"),
        whole=True,
    )
    if task.compiled.grid.end is not None and not METHODS.get(method_name(task, method)).whole:
        task = load_task(specs[0], system or None, overrides)
    require_controls(task)
    late = not_allowed(beyond_plans(task.compiled))
    show_diagnostics([*task.compiled.warnings, *late, *unstable(task.plain.decl)])
    return task


def _train(task: Task, config: TrainConfig, launch: Launch, logger: Opener | None) -> Session:
    """Train the policy for `task` with the options `config`, in a new run folder.

    `launch` gives the place and the name of the run folder; `logger` opens an additional logger, if any.
    """
    from stlc.assurance.drive_search import round_of
    from stlc.cli.train.session import Session
    from stlc.controller.parallel.ddp import joined
    from stlc.controller.training.launch import open_folder
    from stlc.controller.training.loop import prepare, run
    from stlc.stopping import age

    with joined(config.device) as ranks:
        before = age()
        prepared = prepare(task, config, ranks=ranks, failures=round_of)
        made = str(open_folder(task, config, launch).path) if ranks.first else ""
        folder = RunDir(Path(ranks.agree_text(made)))
        with Session(folder, logger=logger, writes=ranks.first, before=before, new=True) as session:
            session.outcome = run(prepared, folder, session.watch)
    return session


def _resume(
    folder: RunDir, steps: int | None, more: float | None, device: str, logger: Opener | None
) -> Session:
    """Resume a run from its last checkpoint.

    `steps` is the total number of steps after which the training ends. `more` is the remaining training time
    in seconds. If both are None, the training ends where it was planned to end.
    """
    from stlc.assurance.drive_search import round_of
    from stlc.cli.train.session import Session
    from stlc.controller.parallel.ddp import joined
    from stlc.controller.training.loop import resume

    with joined(device) as ranks, Session(folder, logger=logger, writes=ranks.first) as session:
        session.outcome = resume(
            folder,
            steps=steps,
            budget=more,
            device=device,
            watch=session.watch,
            ranks=ranks,
            failures=round_of,
        )
    return session


def _refuse_on_resume(given: Mapping[str, object]) -> None:
    """Raise UsageError (R104) for an option that a resumed run cannot change.

    Only the length of the training and `--device` can be changed.
    """
    named = [option for option, value in given.items() if value is not None]
    if named:
        message = f"{', '.join(named)} cannot change when a run is resumed"
        advice = ("stlc train --resume RUN [--steps N | --budget TIME]", "a new run takes any option")
        raise UsageError(Diagnostic("R104", message, help=advice))


# ------------------------------------------------------------------- several ranks

LOST = "R403"


@contextmanager
def one_voice() -> Iterator[None]:
    """Context for one of several training processes that `torchrun` started; only the first process prints.

    The output of all other processes is dropped, except for two kinds of message: errors in the first process
    of each machine, and missing packages in any process.
    """
    rank, local = (int(os.environ.get(name, "0")) for name in ("RANK", "LOCAL_RANK"))
    if rank == 0:
        yield
        return
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    except StlcError as error:
        lost = any(finding.code == LOST for finding in error.diagnostics)
        if not lost and (local == 0 or isinstance(error, MissingError)):
            show_diagnostics([finding.with_note(f"on rank {rank}") for finding in error.diagnostics])
        raise typer.Exit(error.exit_code) from error
