"""`stlc simulate`: closed-loop runs of a trained policy in its world (simulated environment)."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.activity import PULSE
from stlc.cli.certify.text import CertifyOption, bounds_lines, require_claim
from stlc.cli.framework.options import (
    AgentsOption,
    DriveStepsOption,
    FailUnderOption,
    JobsOption,
    JsonOption,
    MarginOption,
    MethodOptionsOption,
    PicturesOption,
    PlantOption,
    RunArgument,
    RunsOption,
    SeedsOption,
    SetOption,
    SystemOption,
    TimeLimitOption,
    parse_limit,
    parse_overrides,
    parse_seeds,
    planner_choice,
    require_separate,
)
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.diagnostics import Diagnostic, RunError, usage
from stlc.jsontext import plain
from stlc.registry import GUARDS, PLANNERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from stlc.assurance.certificate import Assessment
    from stlc.cli.framework.documents import ScenarioResult, Simulation
    from stlc.cli.simulate.watch import Watching
    from stlc.controller.deployment.simulator import Setting
    from stlc.controller.evaluation.deployment import Deployment
    from stlc.controller.evaluation.rules import Rules
    from stlc.controller.guard.margins import MarginRequest
    from stlc.controller.policies.policy import Policy
    from stlc.controller.run.run import Run
    from stlc.controller.search.planner_policy import PlannerChoice
    from stlc.dynamics.declaration.deployment import ScenarioDecl
    from stlc.plants.judge import PlantSimulation

ALL, USUAL = "all", "disturbed"
SCENARIOS = "eval/scenarios.json"
EACH = ", ".join(f"`{name}` {guard.help}" for name, guard in GUARDS.loaded().items() if guard.help)
"""Help of the guards that have one, such as "`full` also repairs plans"."""


@command(
    "stlc simulate --backup",
    "stlc simulate latest --backup --seeds 0..19 --record trace.npz",
    "stlc simulate specs/ship_track.stl --backup --scenario all",
    "stlc simulate --backup --seeds 0 --live --robustness robustness.jsonl",
    "stlc simulate fall.stl --plant ball.yaml --seeds 0..19",
    drives=True,
)
def simulate(
    run: RunArgument = "latest",
    backup: Annotated[
        bool | None,
        typer.Option(
            "--backup/--no-backup", help="Guard by the paper's backup policy, as --guard paper does."
        ),
    ] = None,
    guard: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(GUARDS.installed),
            help=f"Guard; {EACH}.",
            show_default=GUARDS.default,
        ),
    ] = None,
    time_limit: TimeLimitOption = None,
    known_feasible: Annotated[
        int, typer.Option(min=0, help="Number of visited states to check for a feasible plan.")
    ] = 0,
    margin: MarginOption = None,
    seeds: SeedsOption = "0..9",
    steps: DriveStepsOption = None,
    agents: AgentsOption = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the trace to this file (.npz, .csv, .mcap)."),
    ] = None,
    fail_under: FailUnderOption = None,
    certify: CertifyOption = None,
    scenario: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="A scenario, `all` scenarios of the system file, or `disturbed`."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show margins and decisions during the simulation.")
    ] = False,
    margins: Annotated[
        str | None,
        typer.Option(
            "--robustness",
            metavar="FILE",
            help="Write robustness margins to FILE, a JSON object per agent and step; `-` prints them.",
        ),
    ] = None,
    windows: Annotated[
        bool,
        typer.Option(
            "--windows", help="Also show results on plans and planning windows, such as plan accuracy."
        ),
    ] = False,
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            "-m",
            metavar="PLANNER",
            help="A planner, for a specification, or beside the policy of a run: "
            f"{', '.join(PLANNERS.installed)}, or FILE.py.",
        ),
    ] = None,
    option: MethodOptionsOption = None,
    budget: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="With --method: processor time per plan.", show_default="20ms"),
    ] = None,
    plant: PlantOption = None,
    from_: Annotated[
        str | None,
        typer.Option("--from", metavar="POINT", help="With --plant: values, such as `h=1 m, e=0.7`."),
    ] = None,
    jobs: JobsOption = 1,
    stream: Annotated[
        bool, typer.Option("--stream", help="With --plant: judge while it runs, in constant memory.")
    ] = False,
    system: SystemOption = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
    pictures: PicturesOption = False,
    window: Annotated[bool, typer.Option("--window", help="Show robots in PyBullet's window, too.")] = False,
    json: JsonOption = False,
) -> Answer[Simulation | PlantSimulation]:
    """Deploy a trained policy in the world of its system.

    RUN is by default the newest run. With --method, a planner controls the system: without training, if RUN
    is a specification, else beside the policy of the run, in the same table. With --backup, the backup policy
    of Meng and Fan (2023) guards the policy. For comparison, the same seeds are simulated without it, too.
    Trace, scene and figures are written to the run's folder. A drive is the closed-loop run of one agent with
    one seed. Drives are judged by the specification that the system file names (key `judge` of its section
    `test`). Means over seeds have 95 % intervals (Student's t). Every system has the scenarios mismatch,
    disturb and noise. A number sets their strength in percent, as in mismatch-20. --scenario disturbed runs
    all of them. With --plant, RUN is a specification and FILE a plant file (docs/plants.md): a black box is
    simulated in processes of its own, at --from or at a random point for each seed, and each trace is judged.
    The command measures: its exit code is 0 whatever the drives satisfy, or with --fail-under 1 if fewer do;
    and 1 if a plant gives no trace. With --pictures an animation and the report are drawn, which
    can take longer than the simulation; `stlc report` draws the report later.
    """
    require_separate([("--record", record), ("--robustness", margins)], (run, plant, system))
    if plant is not None:
        from stlc.cli.simulate.plant import PlantOrder, simulate_plant

        overrides = parse_overrides(set_)
        given = PlantOrder(run, plant, from_, seeds, record, jobs, stream, overrides, fail_under)
        own = {"--backup": backup, "--guard": guard, "--scenario": scenario, "--method": method}
        why = "is for trained policies and planners, and `--plant` has neither"
        _refuse_given({**own, "--certify": certify}, why)
        return simulate_plant(given)
    advice = "stlc simulate SPEC --plant FILE"
    _refuse_given({"--from": from_, "--stream": stream or None}, "is for plants", advice)
    from stlc.cli.simulate.text import closing, screen
    from stlc.controller.deployment.simulator import Setting
    from stlc.controller.guard.margins import parse_margins
    from stlc.controller.problem.load import require_controls
    from stlc.controller.run.run import Run

    chosen = _guard(backup, guard)
    printed = _printed(json=json, margins=margins)
    _require_writable(record, margins)
    require_claim(certify, fail_under)
    overrides = parse_overrides(set_)
    planner = _planner(method, option, budget, system)
    beside = planner is not None and Path(run).suffix != ".stl" and not Path(run).is_file()
    if beside:
        _refuse_given({"--system": system}, "is for a specification, and a run has its own")
    if planner is not None and not beside:
        run = _planner_run(run, planner, system, overrides, runs)
    opened = Run.open(run, root=runs, overrides=overrides)
    if GUARDS.get(chosen).intervenes:
        require_controls(opened.task, "a guard")
    decl = opened.task.system.decl
    test = decl.test
    show_diagnostics(_longer(opened, steps or test.steps))
    if window:
        _require_robots(opened)
    size = agents or test.agents, steps or test.steps
    setting = Setting(parse_seeds(seeds), *size, test.replan, ceiling=known_feasible)
    if time_limit is not None:  # by default the paper's guard has none
        limit = parse_limit(time_limit)
        setting = replace(setting, limit=limit, paper_limit=limit)
    requested = parse_margins(margin or ())
    shown = planner if beside else None
    order = _Order(opened, chosen, setting, record, live, margins, overrides, requested, certify, shown)
    several = _several(opened, scenario)
    document = _all(order, several) if several else _deployed(order, scenario)
    if not json:  # before the pictures, so that they do not affect the measurements
        for line in chain(screen(document, windows=windows), _bounds_shown(document, chosen)):
            printed(line)
    drawn = _pictures(opened) if pictures else {}

    def show() -> None:
        # external functions are not stored in traces: judging needs the system file
        needed = f"{opened.dir.shown}/system.yaml" if decl.functions else None
        for line in closing(document["trace"], drawn, record, needed):
            printed(line)
        if window:
            _show_robots(opened)

    made: Any = {**document, **drawn}
    result: Simulation = made
    missed = fail_under is not None and _satisfied(document, chosen) < fail_under
    return Answer(result, show, int(missed) if certify is None else _certified(document, chosen))


def _require_writable(record: Path | None, margins: str | None) -> None:
    """Raise MissingError (R201) if the file of `--record` or of `--robustness` cannot be written."""
    from stlc.cli.simulate.watch import require_writable
    from stlc.trace import check_writable

    if record is not None:
        check_writable(record)
    require_writable(margins)


def _refuse_given(options: Mapping[str, object], why: str, *advice: str) -> None:
    """Raise UsageError (U101) with the reason `why` if one of the options has a value other than None."""
    for name, value in options.items():
        if value is not None:
            raise usage(f"`{name}` {why}", *advice)


def _planner(
    method: str | None, option: list[str] | None, budget: str | None, system: str | None
) -> PlannerChoice | None:
    """Planner that `--method` selects, with the values of `--option` and `--budget`; None without `--method`.

    Raises:
        UsageError: U101, an option of planners is given without `--method`, or its value is invalid.
    """
    if method is not None:
        return planner_choice(method, option, budget or "20ms")
    for name, value in {"--option": option, "--budget": budget, "--system": system}.items():
        if value is not None:
            raise usage(f"`{name}` is for a planner", "stlc simulate SPEC --method search")
    return None


def _planner_run(
    spec: str, choice: PlannerChoice, system: str | None, overrides: Mapping[str, str], runs: Path
) -> str:
    """Create the folder of a run whose policy is a planner, below `runs`, and return its path."""
    from stlc.controller.problem.load import load_task
    from stlc.controller.training.launch import Launch, open_planner

    task = load_task(spec, system, overrides, whole=True)
    launch = Launch(root=runs, overrides=overrides, command=sys.argv[1:])
    return str(open_planner(task, choice, seed=0, launch=launch).path)


def _longer(run: Run, steps: int) -> tuple[Diagnostic, ...]:
    """Return the warning W604 if `steps` steps exceed the time for which the policy was validated, else ().

    The requirements may have no end in time. Nothing is then known about the policy beyond the validated
    time.
    """
    result = run.dir.record().get("result")
    judged = result.get("judged_seconds") if isinstance(result, dict) else None
    seconds = steps * run.task.system.dt
    if not isinstance(judged, int | float) or seconds <= judged:
        return ()
    from stlc.units import time_text

    lasts, known = time_text(seconds), time_text(judged)
    message = f"the simulation lasts {lasts}, and training validated the policy on missions of {known}"
    note = "the requirements have no end: beyond that time nothing is known but this simulation"
    return (Diagnostic("W604", message, note=(note,)),)


@dataclass(frozen=True, slots=True)
class _Order:
    """Options of a simulation, as parsed from the command line; `beside` is a planner beside the policy."""

    run: Run
    guard: str
    setting: Setting
    record: Path | None
    live: bool
    margins: str | None
    overrides: Mapping[str, str]
    requested: MarginRequest
    certify: float | None = None
    beside: PlannerChoice | None = None


def _deployed(order: _Order, name: str | None, *, writes: bool = True) -> Simulation:
    """Simulate the policy without and with its guard, and return one record of both simulations.

    Args:
        order: options of the simulation.
        name: scenario that is simulated; None for the system without a scenario.
        writes: whether the robustness at every step is written to the file of `--robustness`.
    """
    from stlc.cli.simulate.watch import Watching
    from stlc.controller.evaluation.rules import rules_of
    from stlc.controller.guard.kind import named_guard
    from stlc.controller.run.run import Run
    from stlc.controller.search.planner_policy import planner_policy

    run, found = order.run, {}
    if name is not None:
        run = Run.open(run.dir.path, overrides=order.overrides, scenario=name)
    rules = rules_of(run)
    margin = order.requested.of(run.task, run.policy, order.guard, order.setting.replan)
    order = replace(order, setting=replace(order.setting, margin=margin))
    for mode in dict.fromkeys((GUARDS.default, order.guard)):
        title = " · ".join((run.task.compiled.name, named_guard(mode).title, *([name] if name else [])))
        guarded = mode == order.guard
        watching = Watching(title, order.live, order.margins if writes and guarded else None)
        try:
            found[mode] = _deploy(run, run.policy, order, mode, watching, rules)
        except RunError as error:
            if guarded:
                raise
            show_diagnostics(error.diagnostics)  # only the comparison fails: the guarded run continues
    planners = {}
    if order.beside is not None:
        policy, title = planner_policy(run.task, order.beside), f"planner {order.beside.name}"
        watching = Watching(f"{run.task.compiled.name} · {title}", order.live, None)
        planners[order.beside.name] = _deploy(run, policy, order, order.guard, watching, rules)
    return _save(run, order, found, rules, planners)


def _printed(*, json: bool, margins: str | None) -> Callable[[str], None]:
    """Function that prints text to the standard output, or to stderr if `--robustness -` occupies it.

    Raises UsageError (U101) if `--json` and `--robustness -` are combined.
    """
    from stlc.cli.simulate.watch import STANDARD_OUTPUT

    if margins != STANDARD_OUTPUT:
        return emit
    if json:
        message = "`--json` and `--robustness -` both want the standard output"
        raise usage(message, "--robustness robustness.jsonl")
    return say


def _several(run: Run, scenario: str | None) -> dict[str, ScenarioDecl]:
    """Return the scenarios that are simulated in addition to the system without a scenario: name -> scenario.

    The mapping is empty if `scenario`, the value of `--scenario`, is None or the name of a single scenario.
    Raises UsageError (U101) if the system declares none although all are asked for.
    """
    from stlc.dynamics.scenario import DISTURBED, find_scenario

    decl = run.task.system.decl
    declared = {each.name: each for each in decl.scenarios}
    if scenario in declared:
        return {}
    if scenario == ALL and not declared:
        raise usage(f"`{decl.name}` declares no scenarios", f"--scenario {USUAL}: those of every system")
    if scenario == ALL:
        return declared
    return {name: find_scenario(decl, name) for name in DISTURBED} if scenario == USUAL else {}


def _satisfied(document: Simulation, guard: str) -> float:
    """Least share, over all scenarios, of the drives with the guard `guard` that obey every requirement."""
    guards = [document["guards"], *(each["guards"] for each in document.get("scenarios", {}).values())]
    runs = [each[guard]["drives"] for each in guards]
    return min(float(each["obeyed"] / each["count"]) for each in runs)


def _bounds(document: Simulation, guard: str) -> dict[str, Any]:
    """Bounds on the drives with a guard: scenario -> bounds; empty without `--certify`."""
    each = {"": document["guards"], **{k: v["guards"] for k, v in document.get("scenarios", {}).items()}}
    return {name: guards[guard]["assurance"] for name, guards in each.items() if "assurance" in guards[guard]}


def _bounds_shown(document: Simulation, guard: str) -> Iterator[str]:
    for name, record in _bounds(document, guard).items():
        yield f"\n  {name}" if name else ""
        yield from bounds_lines(record)


def _certified(document: Simulation, guard: str) -> int:
    """Exit code of `--certify`: 0 if the share is certified in all scenarios, 1 if refuted in one, else 4."""
    answers = [record["answer"] for record in _bounds(document, guard).values()]
    every = len(answers) == 1 + len(document.get("scenarios", {}))
    return 1 if "refuted" in answers else 0 if every and {*answers} == {"certified"} else 4


def _all(order: _Order, scenarios: Mapping[str, ScenarioDecl]) -> Simulation:
    """Simulate without a scenario and with each of `scenarios`, and return one record of all results.

    The record is also written to the run's folder. The folder keeps the trace of the simulation without a
    scenario. The traces of the scenarios are not kept.
    """
    found: dict[str, ScenarioResult] = {}
    for name, scenario in scenarios.items():
        each = _deployed(order, name, writes=False)
        expect: Any = scenario.expect
        found[name] = {
            "doc": scenario.doc,
            "expect": expect,
            "judge": each["judge"],
            "guards": each["guards"],
        }
    document: Simulation = {**_deployed(order, None), "scenarios": found}
    order.run.dir.write_json(SCENARIOS, document)
    return document


def _guard(backup: bool | None, guard: str | None) -> str:
    if guard is None:
        return PAPER.name if backup else GUARDS.default
    chosen = GUARDS.get(guard)
    if backup is not None and backup != (chosen is PAPER):
        option = "--backup" if backup else "--no-backup"
        raise usage(f"`{option}` and `--guard {guard}` contradict each other")
    return guard


def _deploy(
    run: Run, policy: Policy, order: _Order, mode: str, watching: Watching, rules: Rules | None
) -> Deployment:
    """Simulate a policy in the world of `run` with the guard `mode`, and return the results.

    `order` contains the options of the simulation, and `watching` those of the progress display. The
    closed-loop runs are judged by `rules`. If the simulation fails or Ctrl-C ends it, the steps simulated
    until then are saved as a trace.
    """
    from stlc.controller.evaluation.archive import save_trace_of
    from stlc.controller.evaluation.deployment import InterruptedDeploymentError, deploy

    try:
        with PULSE.doing(f"simulating, {mode}"), watching.of(run.task, order.setting) as watch:
            return deploy(run.task, policy, order.setting, mode, watch=watch, rules=rules)
    except InterruptedDeploymentError as error:
        if error.recording is not None:
            paths = save_trace_of(run, error.recording, order.setting, order.record, rules=rules)
            say(f"the first {error.recording.steps} steps are in {paths[0]}")
        raise (error.__cause__ or error) from None


def _save(
    run: Run,
    order: _Order,
    found: Mapping[str, Deployment],
    rules: Rules | None,
    planners: Mapping[str, Deployment],
) -> Simulation:
    """Write the traces, the scene (data of the animation) and the record of a simulation; return the record.

    `found` maps each kind of guard to its results. The trace of the last kind is saved as the main trace.
    `planners` maps a planner beside the policy to its results, of which no trace is saved.
    """
    from stlc.controller.evaluation.archive import save_scene, save_trace_of, save_unguarded
    from stlc.controller.evaluation.deployment import as_json
    from stlc.dynamics.uncertainty.disturbance import errors_of
    from stlc.rundir import SCENE, SIMULATION

    last = list(found.values())[-1]
    save_trace_of(run, last.recording, order.setting, order.record, rules=rules)
    save_scene(run.dir.place(SCENE), last.recording.scene)
    alone = found.get(GUARDS.default)
    beside = alone.recording if alone is not None and len(found) > 1 else None
    save_unguarded(run, beside, order.setting, rules)
    decl = run.task.system.decl
    world, scenario = decl.test.world, decl.scenario
    facts = {
        "spec": run.task.compiled.name,
        "system": run.task.system.decl.name,
        "run": run.dir.name,
        "world": world.path.name if world is not None else None,
        "scenario": None if scenario is None else scenario.name,
        "starts": decl.test.starts,
        "redrawn": last.recording.redrawn,
        "errors": errors_of(run.task.plain.truth),
        "judge": None if rules is None else {"spec": rules.name, "path": rules.path, "rules": rules.docs},
        "safety": [rule.name for rule in run.task.compiled.safety],
        "trace": f"{run.dir.shown}/trace.npz",
        "overrides": dict(order.overrides),
    }
    made: Any = as_json(found, order.setting, facts, planners)
    if order.certify is not None:
        for name, each in found.items():
            assurance = _assured(run, each, rules, order.certify)
            if assurance is None:
                say(f"guard `{name}`: no bounds, as every drive violates an assumption of the specification")
            else:
                made["guards"][name]["assurance"] = plain(assurance)
    document: Simulation = made
    run.dir.write_json(SIMULATION, document)
    return document


def _assured(run: Run, found: Deployment, rules: Rules | None, share: float) -> Assessment | None:
    """Bounds on the share of drives that satisfy everything; the number of drives was fixed in advance.

    None if every drive violates an assumption of the specification.
    """
    from stlc.assurance.certificate import Claim, assess
    from stlc.assurance.drives import sample_of

    sample = sample_of(run.task, found.recording, rules)
    return assess(sample, Claim(share, online=True)) if sample.drives else None


# ------------------------------------------------------------------------- pictures


def _pictures(run: Run) -> dict[str, str]:
    """Draw the animation and the report if matplotlib is installed; return kind of picture -> its path."""
    from stlc.view import available

    if not available():
        say("no pictures: they need the extra `plot` (see `stlc doctor`)")
        return {}
    from stlc.view.bullet import available as in_space
    from stlc.view.report import write_report
    from stlc.view.run_animation import animate, recorded_scene

    seen = recorded_scene(run.dir)
    if seen is not None and seen.stage is not None and not in_space():
        say("robots are drawn as lines: bodies need the extra `panda`")
    with PULSE.doing("drawing the animation"):
        gif = animate(run.dir)
    with PULSE.doing("drawing the report"):
        write_report(run.dir)
    drawn = {"report": f"{run.dir.shown}/report.html"}
    return drawn if gif is None else {"animation": f"{run.dir.shown}/{gif.name}", **drawn}


def _require_robots(run: Run) -> None:
    """Raise an error before the simulation if the world has no robots or no window can be opened.

    Raises:
        UsageError: U101, the run's world has no robots.
        MissingError: R301, PyBullet is not installed; R302, there is no display.
    """
    from stlc.controller.stage import Staged
    from stlc.controller.world import world_type
    from stlc.view.bullet import require_window

    if not isinstance(world_type(run.task.system.decl), Staged):
        message = f"`--window` shows robots, and `{run.task.system.decl.name}` has none"
        raise usage(message)
    require_window()


def _show_robots(run: Run) -> None:
    """Play the newest deployment in PyBullet's window."""
    from stlc.view import bullet
    from stlc.view.run_animation import recorded_scene

    seen = recorded_scene(run.dir)
    stage = None if seen is None else seen.stage
    if seen is not None and stage is not None:
        with PULSE.doing(""):
            bullet.show(stage, seen.scene, seen.dt)
