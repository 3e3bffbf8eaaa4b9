"""`stlc train`: train a policy for a specification and a system, in a new run folder."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.commands.train.many import Many, train_many
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.output import Answer, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.controller.training.budget import StepSchedule
from stlc.controller.training.options import TrainOptions
from stlc.diagnostics import MissingError, StlcError, usage
from stlc.options import Option, Options, parse_seeds
from stlc.registry import METHODS
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from stlc.cli.commands.train.session import Session
    from stlc.cli.commands.train.trained import TrainedRun, TrainedRuns
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import TrainConfig
    from stlc.controller.training.launch import Launch
    from stlc.controller.training.tensorboard import Opener


OPTIONS = TrainOptions()


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
    system: Options.System = None,
    options: TrainOptions = OPTIONS,
    seeds: Annotated[
        Sequence[int],
        Option("Several runs, such as 0..2 or 0,3, in processes of their own.", "SEEDS"),
        parse_seeds,
    ]
    | None = None,
    jobs: Options.Jobs = 1,
    cluster: Options.Cluster = None,
    resume: Annotated[
        str | None,
        typer.Option(metavar="RUN", help="Go on with an interrupted run.", autocompletion=run_names),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the run.", show_default="random words")] = None,
    log: Annotated[
        str | None, typer.Option(metavar="tensorboard", help="Also write the curves for TensorBoard.")
    ] = None,
    runs: Options.Runs = RunDir.RUNS,
    pictures: Annotated[bool, typer.Option(help="Draw pictures and the report.")] = True,
    set_: Options.Overrides = Options.NONE,
) -> Answer[TrainedRun | TrainedRuns]:
    """Train a policy that satisfies a specification.

    The run's folder contains everything to reproduce it. Ctrl-C saves a checkpoint and stops.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads of torch must not busy-wait
    specs = tuple(dict.fromkeys(spec or ()))
    usual = TrainOptions()
    changed = {name: value for name, value in options.given().items() if value != getattr(usual, name)}
    if "budget" in changed and "steps" in changed:
        raise usage("`--budget` and `--steps` contradict each other")
    own = {"--system": system, "--seeds": seeds, "--name": name, "--set": set_ or None, "--cluster": cluster}
    logger = _logger(log)
    if resume is not None:
        if isinstance(options.steps, StepSchedule):
            raise usage("a resumed run follows no schedule", "--steps 1200")
        _refuse_on_resume({"SPEC": spec or None, **own}, changed)
        with one_voice():
            folder = RunDir.open(resume, runs)
            session = _resume(folder, options.steps, options.budget, options.device, logger)
            return session.conclude(pictures=pictures)
    _check_together(specs, jobs, {**own, "--seed": options.seed})
    from stlc.controller.training.config import TrainConfig
    from stlc.controller.training.launch import Launch

    config = TrainConfig(**options.given())
    launch = Launch(root=runs, name=name, overrides=set_, command=sys.argv[1:])
    if len(specs) < 2:  # errors of a single specification are reported once, before the first of several runs
        with one_voice():
            task = _task(specs, system, launch.overrides, config.method)
            if seeds is None and cluster is None:
                return _train(task, config, launch, logger).conclude(pictures=pictures)
    return train_many(
        Many(specs, system, options, launch, seeds or (options.seed,), jobs, cluster, log, pictures)
    )


def _check_together(specs: Sequence[Path], jobs: int, given: Mapping[str, object]) -> None:
    """Raise UsageError (U101) if options of `stlc train` exclude each other or do not apply.

    Some options do not apply to a single run, some not to several specifications, and some not to a cluster.
    `given` maps the name of an option to its value, or to None if it is not given.
    """
    if given["--seed"] is not None and given["--seeds"] is not None:
        raise usage("`--seed` and `--seeds` contradict each other")
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


def _task(
    specs: Sequence[Path], system: str | None, overrides: Mapping[str, str], method: str | None
) -> Task:
    """Read and compile the specification for its system, and print which system file is used.

    `overrides` gives new values of constants and of fields of the system file. If the training `method` can
    do so, plans reach to the end of missions.
    """
    from stlc.compile.deadlines import beyond_plans
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import method_name
    from stlc.dynamics.model.feedback import unstable
    from stlc.grammar.allow import not_allowed

    if not specs:
        example = "stlc train specs/traffic.stl --system car.yaml"
        raise usage("missing: a specification", example)
    task = Task.load(
        specs[0],
        system or None,
        overrides,
        hint="stlc train SPEC --system FILE",
        found=lambda path: say(f"system {path}"),
        whole=True,
    )
    if task.compiled.grid.end is not None and not METHODS.get(method_name(task, method)).whole:
        task = Task.load(specs[0], system or None, overrides)
    task.require_controls()
    late = not_allowed(beyond_plans(task.compiled))
    show_diagnostics([*task.compiled.warnings, *late, *unstable(task.plain.decl)])
    return task


def _train(task: Task, config: TrainConfig, launch: Launch, logger: Opener | None) -> Session:
    """Train the policy for `task` with the options `config`, in a new run folder.

    `launch` gives the place and the name of the run folder; `logger` opens an additional logger, if any.
    """
    from stlc.assurance.drive_search import round_of
    from stlc.cli.commands.train.session import Session
    from stlc.controller.parallel.ddp import joined
    from stlc.controller.training.launch import open_folder
    from stlc.controller.training.loop import prepare
    from stlc.stopping import age

    with joined(config.device) as ranks:
        before = age()
        prepared = prepare(task, config, ranks=ranks, failures=round_of)
        made = str(open_folder(task, config, launch).path) if ranks.first else ""
        folder = RunDir(Path(ranks.agree_text(made)))
        with Session(folder, logger=logger, writes=ranks.first, before=before, new=True) as session:
            session.outcome = prepared.run(folder, session.watch)
    return session


def _resume(
    folder: RunDir, steps: int | None, more: float | None, device: str, logger: Opener | None
) -> Session:
    """Resume a run from its last checkpoint.

    `steps` is the total number of steps after which the training ends. `more` is the remaining training time
    in seconds. If both are None, the training ends where it was planned to end.
    """
    from stlc.assurance.drive_search import round_of
    from stlc.cli.commands.train.session import Session
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


def _refuse_on_resume(own: Mapping[str, object], changed: Mapping[str, object]) -> None:
    """Raise UsageError (R104) for an option that a resumed run cannot change.

    Only the length of the training and `--device` can be changed. `changed` are options of the training.
    """
    named = [option for option, value in own.items() if value is not None]
    named += [flag for name, flag in TrainOptions.flags().items() if name in changed]
    named = [option for option in named if option not in ("--budget", "--steps", "--device")]
    if named:
        message = f"{', '.join(named)} cannot change when a run is resumed"
        advice = ("stlc train --resume RUN [--steps N | --budget TIME]", "a new run takes any option")
        raise usage(message, *advice, code="R104")


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
