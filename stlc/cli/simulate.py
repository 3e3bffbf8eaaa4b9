"""`stlc simulate`: a trained policy in closed loop, in the world of its system."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from stlc.cli.options import JsonOption, RunArgument, RunsOption, SetOption, describe, parse_overrides
from stlc.cli.ranges import parse_limit
from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from stlc.controller.deploy import Mode
    from stlc.controller.drive import Setting, Tick
    from stlc.controller.evaluate import Deployment
    from stlc.controller.run import Run

Record: TypeAlias = "dict[str, Any]"

ALL = "all"
SCENARIOS = "eval/scenarios.json"
GUARDS: dict[Mode, tuple[Mode, ...]] = {
    "none": ("none",),
    "paper": ("none", "paper"),
    "full": ("none", "full"),
}

GuardOption = Annotated[
    str | None,
    typer.Option(metavar="none|paper|full", help="What guards the policy; `full` polishes plans first."),
]
LimitOption = Annotated[
    str, typer.Option(metavar="TIME", help="Of a decision of the full guard, per agent; or `none`.")
]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        "simulate",
        help=describe(
            "Deploy a trained policy in the world of its system.",
            "stlc simulate --backup",
            "stlc simulate latest --backup --seeds 20 --record trace.npz",
            "stlc simulate specs/ship_track.stl --backup --scenario all",
            note="The newest run unless one is named. With --backup the paper's backup policy guards it, "
            "and the same seeds are driven without it too, to compare. Trace, scene and figures go "
            "into the run's folder. Means over seeds come with 95 % intervals (Student's t).",
        ),
    )(simulate)


def simulate(
    run: RunArgument = "latest",
    backup: Annotated[
        bool | None, typer.Option("--backup/--no-backup", help="The paper's backup policy.")
    ] = None,
    guard: GuardOption = None,
    time_limit: LimitOption = "100ms",
    seeds: Annotated[int, typer.Option(min=1, help="How many deployments.")] = 10,
    seed: Annotated[int, typer.Option(min=0, max=2**62, help="Seed of the first; the others follow.")] = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="Of each; by default the system's.")] = None,
    agents: Annotated[int | None, typer.Option(min=1, help="In each; by default the system's.")] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the trace there too (.npz or .csv).")
    ] = None,
    fail_under: Annotated[
        float | None, typer.Option(metavar="SHARE", help="Exit with 1 if the plan accuracy is less.")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(metavar="NAME", help="An overlay of the system file, or all of them.")
    ] = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
    pictures: Annotated[bool, typer.Option(help="Draw the animation and the report.")] = True,
    window: Annotated[bool, typer.Option("--window", help="Show robots in PyBullet's window, too.")] = False,
    json: JsonOption = False,
) -> None:
    """Deploy the policy of a run, record it, and say how it did."""
    chosen = _guard(backup, guard)
    from stlc.cli.output import emit_json
    from stlc.cli.simulate_pictures import draw, require_robots
    from stlc.cli.simulate_text import closing, screen
    from stlc.controller.drive import Setting
    from stlc.controller.run import Run
    from stlc.trace import check_writable

    if record is not None:
        check_writable(record)
    overrides = parse_overrides(set_)
    opened = Run.open(run, root=runs, overrides=overrides)
    if window:
        require_robots(opened)
    test, which = opened.task.system.decl.test, tuple(range(seed, seed + seeds))
    limit = parse_limit(time_limit)
    setting = Setting(which, agents or test.agents, steps or test.steps, test.replan, limit)

    def driven(name: str | None) -> Record:
        laid = opened if name is None else Run.open(opened.dir.path, overrides=overrides, scenario=name)
        found = {mode: _deploy(laid, setting, mode, record) for mode in GUARDS[chosen]}
        return _save(laid, setting, found, record)

    document = _all(opened, driven) if scenario == ALL else driven(scenario)
    code = 1 if fail_under is not None and _accuracy(document, chosen) < fail_under else 0
    if not json:
        _print(screen(document))  # before the pictures: what was measured must not depend on them
    drawn = draw(opened) if pictures else {}
    if json:
        emit_json("simulate/1", ok=code == 0, exit_code=code, result=document | drawn)
    else:
        _print(closing(document["trace"], drawn, record, _needed_system(opened)))
    _end(opened, window=window, code=code)


def _end(run: Run, *, window: bool, code: int) -> None:
    from stlc.cli.simulate_pictures import show

    if window:
        show(run)
    if code:
        raise typer.Exit(code)


def _needed_system(run: Run) -> str | None:
    """The system file that a trace cannot be judged without: functions are not in traces."""
    return f"{run.dir.shown}/system.yaml" if run.task.system.decl.functions else None


def _accuracy(document: Record, guard: Mode) -> float:
    """The plan accuracy, the least one over all scenarios that were driven."""
    each = [document, *document.get("scenarios", {}).values()]
    return min(float(one["guards"][guard]["metrics"]["plan_accuracy"]["mean"]) for one in each)


def _all(run: Run, driven: Callable[[str | None], Record]) -> Record:
    """The deployment as it is, and all scenarios beside it; the trace is that of the former."""
    scenarios = {}
    for scenario in run.task.system.decl.scenarios:
        found = driven(scenario.name)
        scenarios[scenario.name] = {
            "doc": scenario.doc,
            "expect": scenario.expect,
            "guards": found["guards"],
        }
    document = {**driven(None), "scenarios": scenarios}
    run.dir.write_json(SCENARIOS, document)
    return document


def _print(lines: Iterator[str]) -> None:
    from stlc.cli.output import emit

    for line in lines:
        emit(line)


def _guard(backup: bool | None, guard: str | None) -> Mode:
    if guard not in (None, *GUARDS):
        raise UsageError(
            Diagnostic("U101", f"there is no guard `{guard}`", help=("--guard none, paper or full",))
        )
    if backup is not None and guard is not None and backup != (guard == "paper"):
        option = "--backup" if backup else "--no-backup"
        raise UsageError(Diagnostic("U101", f"`{option}` and `--guard {guard}` contradict each other"))
    for mode in GUARDS:
        if mode == guard:
            return mode
    return "paper" if backup else "none"


def _deploy(run: Run, setting: Setting, mode: Mode, record: Path | None) -> Deployment:
    """One deployment with a progress bar; what was driven before a failure is saved."""
    from stlc.cli.output import say
    from stlc.cli.simulate_text import TITLES
    from stlc.controller.archive import save_trace_of
    from stlc.controller.evaluate import InterruptedDeploymentError, deploy

    try:
        with _bar(TITLES[mode]) as tick:
            return deploy(run.task, run.policy, setting, mode, tick=tick)
    except InterruptedDeploymentError as error:
        if error.recording is not None:
            paths = save_trace_of(run, error.recording, setting, record)
            say(f"the first {error.recording.steps} steps are in {paths[0]}")
        raise (error.__cause__ or error) from None


@contextmanager
def _bar(title: str) -> Iterator[Tick]:
    """A progress bar on the standard error, if that is a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from stlc.cli.output import console

    talk = console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=talk, transient=True, disable=not talk.is_terminal) as progress:
        bar = progress.add_task(title, total=None)
        yield lambda step, total: progress.update(bar, completed=step, total=total)


def _save(run: Run, setting: Setting, found: Mapping[Mode, Deployment], record: Path | None) -> Record:
    """Write trace, scene and figures into the run's folder; returns what was measured."""
    from stlc.controller.archive import RESULT, SCENE, save_scene, save_trace_of
    from stlc.controller.evaluate import as_json

    last = list(found.values())[-1]
    save_trace_of(run, last.recording, setting, record)
    save_scene(run.dir.path / SCENE, last.recording.scene)
    world = run.task.system.decl.test.world
    facts = {
        "spec": run.task.compiled.name,
        "system": run.task.system.name,
        "run": run.dir.name,
        "world": world.path.name if world is not None else None,
        "scenario": _laid_over(run),
        "trace": f"{run.dir.shown}/trace.npz",
    }
    document = as_json(found, setting, facts)
    run.dir.write_json(RESULT, document)
    return document


def _laid_over(run: Run) -> str | None:
    scenario = run.task.system.decl.scenario
    return None if scenario is None else scenario.name
