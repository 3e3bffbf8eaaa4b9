"""`stlc plan`: a satisfying plan for given initial states, without training."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.activity import PULSE
from stlc.cli.framework.options import (
    FailUnderOption,
    require_separate,
)
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command, noting_signals
from stlc.diagnostics import usage
from stlc.options import Option, Options, parse_count, parse_seconds
from stlc.registry import PLANNERS

if TYPE_CHECKING:
    from stlc.assurance.verification.planned import Plans, PlanTubes
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanResult
    from stlc.controller.search.planner_policy import PlannerChoice


@command(
    "stlc plan specs/traffic.stl",
    'stlc plan specs/reach_n_avoid.stl --from "x=1, v=0" --budget 50ms',
    "stlc plan specs/ship_safe.stl --starts 1000 --option tries=500",
    "stlc plan specs/ship_safe.stl --target max --tube mismatch-10",
    drives=True,
)
def plan(
    spec: Annotated[Path, typer.Argument(metavar="SPEC", help="The specification, a .stl file.")],
    system: Options.System = None,
    from_: Annotated[
        str,
        typer.Option("--from", metavar="random|STATE|TRACE", help="Initial states, such as `x=1, v=2 m/s`."),
    ] = "random",
    starts: Annotated[
        int | None, typer.Option(min=1, help="Number of initial states.", show_default="1")
    ] = None,
    method: Annotated[
        str,
        Option(
            f"The planner; by default {PLANNERS.default}.",
            "|".join((*PLANNERS.installed, "FILE.py")),
            ("--method", "-m"),
        ),
        PLANNERS.chosen,
    ] = PLANNERS.default,
    option: Options.OfMethod = Options.NONE,
    budget: Annotated[
        float, Option("Processor time per initial state at most; by default 1s.", "TIME"), parse_seconds
    ] = 1.0,
    evaluations: Annotated[
        str | None, typer.Option(metavar="N", help="Judged plans per initial state at most.")
    ] = None,
    target: Annotated[
        str, typer.Option(metavar="RHO|max", help="Robustness at which the search ends.")
    ] = "0",
    seed: Options.Seed = 0,
    tube: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO", help="Bound the robustness of the plans for all errors of this scenario."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Trace of the plans (.npz, .csv, .mcap).")
    ] = Path("plan.npz"),
    fail_under: FailUnderOption = None,
    set_: Options.Overrides = Options.NONE,
) -> Answer[Plans]:
    """Plan from initial states, without training.

    The best plan from each initial state is written to a trace, which `stlc check` and `stlc plot` can read.
    Every plan is judged exactly in float64. If the search finds no satisfying plan, there may still be one.
    Only the planner milp can prove that there is none. Ctrl-C and SIGTERM end the search; the plans found are
    kept, and initial states without any left out. With --tube, the states and the robustness that the errors
    of a scenario can lead to are bounded: wrong parameters, actuators and measurements, and disturbances. A
    plan then counts as satisfying only if the lower bound does. Without --fail-under, the exit code is 1 if a
    plan does not satisfy the specification.
    """
    from stlc.assurance.verification.planned import PlanTubes
    from stlc.assurance.verification.tubes import TubeModel
    from stlc.controller.problem.task import Task
    from stlc.controller.search.plan_traces import following, starts_of, trace_of
    from stlc.controller.search.planner import PlanBudget, PlanSearch, planner_named, prepared
    from stlc.controller.search.planner_policy import PlannerChoice
    from stlc.stopping import leaving
    from stlc.trace import Trace

    Trace.check_writable(output)
    require_separate([("--out", output)], (spec, system, from_))
    choice = PlannerChoice(method, option, budget)
    judged = None if evaluations is None else parse_count(evaluations, "--evaluations")
    planner = planner_named(method, **option)
    task = Task.load(spec, system, set_, scenario=tube, whole=True)
    show_diagnostics(task.compiled.warnings)
    model = None if tube is None else TubeModel(task)
    states = starts_of(task, from_, starts, seed)
    limits = PlanBudget(budget, judged, _target(target))

    def save(found: PlanResult) -> None:
        if len(found.rho):
            trace_of(task, found, seed).save(output)

    def interrupted(found: PlanResult) -> None:
        say(f"interrupted: {len(found.rho):,} of {len(states):,} initial states were planned for")

    def forced(_code: int) -> None:
        save(search.result.tried)
        interrupted(search.result.tried)

    with PULSE.doing(f"planning, {method}"):
        solver = prepared(planner, task)
        with noting_signals() as signals:
            search = PlanSearch(task, states, replace(limits, stop=lambda: bool(signals)), seed=seed)
            with leaving(forced):
                solver(search)
                result = search.result.tried if signals else search.result
                save(result)
    if signals:
        interrupted(result)
        if not len(result.rho):
            raise SystemExit(signals[0])
    with PULSE.doing("trying other planners"):
        bounds = None
        if model is not None:
            bounds = PlanTubes.of(model, result, tube or "", following(task, from_))
        document = _record(task, result, choice, output, bounds, stopped=bool(signals))
    good = document.satisfied if bounds is None else bounds.guaranteed
    short = good / document.starts < (1.0 if fail_under is None else fail_under)

    def show() -> None:
        lines = (*_found_lines(document), *_missed_lines(document), *_tube_lines(document))
        emit("\n".join((*lines, f"trace {document.trace}")))

    return Answer(document, show, signals[0] if signals else int(short))


def _target(text: str) -> float:
    """Parse the robustness at which a search ends; `max` is infinity. Raises UsageError (U101)."""
    try:
        found = float("inf") if text.strip() == "max" else float(text)
    except ValueError:
        found = math.nan
    if math.isnan(found) or found == -math.inf:
        raise usage(f"`--target {text}` is no robustness", "--target 0.1 or max")
    return found


def _record(
    task: Task,
    result: PlanResult,
    choice: PlannerChoice,
    output: Path,
    tube: PlanTubes | None,
    *,
    stopped: bool,
) -> Plans:
    """Record of the result. If the search was not `stopped`, other planners are tried where it failed."""
    from stlc.assurance.verification.planned import PlanRobustness, Plans, PlanSeconds
    from stlc.controller.search.missed import better_planner, missed

    rho, spent = result.rho, result.seconds
    bad = ~result.satisfied & ~result.infeasible
    states = result.states[bad]
    return Plans(
        *(task.compiled.name, task.system.decl.name, choice.name, choice.seconds, len(rho)),
        *(int(result.satisfied.sum()), int(result.infeasible.sum())),
        PlanRobustness(float(rho.min()), float(rho.median()), float(rho.max())),
        PlanSeconds(float(spent.mean()), float(spent.median()), float(spent.max())),
        float(result.evaluations.double().mean()),
        missed(task, states, result.plans[bad]),
        None if stopped else better_planner(task, states, choice.name, float(spent[bad].sum())),
        str(output),
        tube,
    )


def _missed_lines(plans: Plans) -> list[str]:
    """Lines that name the requirements that the best plans violate, and a planner that does better."""
    from stlc.view.words import number
    from stlc.view.words import seconds as duration

    lines = []
    for each in plans.missed:
        most = each.robustness
        by = "no plan can satisfy it any more" if most == -math.inf else f"by {number(-most)} or more"
        many = f", in {each.starts:,} of {plans.starts:,} best plans" if plans.starts > 1 else ""
        lines.append(f"  `{each.requirement}` is violated{many}: {by}")
    if better := plans.better:
        found = f"{better.satisfied:,} of {better.starts:,} tried starts" if plans.starts > 1 else "it"
        lines.append(f"  `--method {better.method}` solves {found} in {duration(better.seconds)}")
    return lines


def _tube_lines(plans: Plans) -> list[str]:
    """Lines with the bounds of `--tube`; none without it."""
    from stlc.view.words import listing, number

    found = plans.tube
    if found is None:
        return []
    within = f", noise within {found.deviations:g} standard deviations" if found.deviations else ""
    many, good = plans.starts, found.guaranteed
    said = f"{good:,} of {many:,} plans are guaranteed to satisfy it"
    if many == 1:
        said = "the plan is guaranteed to satisfy it" if good else "no guarantee that the plan satisfies it"
    lines = [f"{found.scenario}: {said}{within}"]
    if numbers := listing(found.numbers):
        lines.append(f"  numbers that may be wrong: {numbers}")
    if exact := listing(found.exact):
        lines.append(f"  taken as exact, as conditions or limits read them: {exact}")
    width = max(map(len, found.requirements))
    for name, each in found.requirements.items():
        low, high = (number(bound) if math.isfinite(bound) else "no bound" for bound in (each.low, each.high))
        count = f"   {each.guaranteed:,} guaranteed" if many > 1 else ""
        lines.append(f"  {name:<{width}}  {low} to {high}{count}")
    return lines


def _found_lines(plans: Plans) -> list[str]:
    from stlc.controller.evaluation.held_out import wilson
    from stlc.view.words import interval, number
    from stlc.view.words import seconds as duration
    from stlc.view.words import share as percent

    count, good, spent = plans.starts, plans.satisfied, plans.seconds
    least, middle, greatest = (
        "none" if math.isinf(value) else number(value)
        for value in (plans.robustness.least, plans.robustness.median, plans.robustness.greatest)
    )
    judged = f"{plans.evaluations:,.0f} plans judged"
    if count == 1:
        verdict = f"the plan {'satisfies' if good else 'violates'} it, robustness {least}"
        if plans.infeasible:
            verdict = "there is no satisfying plan, proved"
        cost = f"{plans.method}: {duration(spent.mean)}, {judged}"
        return [f"{plans.spec}: {verdict}", cost]
    proved = f", {plans.infeasible:,} proved infeasible" if plans.infeasible else ""
    within = f"{percent(good / count)}, 95 % interval {interval(wilson(good / count, count))}"
    return [
        f"{plans.spec}: {good:,} of {count:,} plans satisfy it ({within}){proved}",
        f"robustness {least} to {greatest}, median {middle}",
        f"{plans.method}: {duration(spent.mean)} of processor time a plan (median "
        f"{duration(spent.median)}, most {duration(spent.most)}), {judged} for each",
    ]
