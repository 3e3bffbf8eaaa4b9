"""Closed-loop runs of a policy in its world, without and with a guard and in scenarios, with verdicts."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

from stlc.activity import PULSE
from stlc.assurance.certificate import Assessment, Claim
from stlc.assurance.drives import sample_of
from stlc.assurance.options import SimulateOptions
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import Watch
from stlc.controller.evaluation.archive import save_scene, save_trace_of, save_unguarded
from stlc.controller.evaluation.deployment import (
    Deployment,
    InterruptedDeploymentError,
    deploy,
)
from stlc.controller.evaluation.rules import JudgedRuns, Rules
from stlc.controller.guard.kind import named_guard
from stlc.controller.guard.margins import MarginRequest, parse_margins
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.search.planner_policy import PlannerChoice, planner_policy
from stlc.controller.training.launch import Launch, open_planner
from stlc.diagnostics import Diagnostic, RunError, notice, usage
from stlc.dynamics.scenario import DISTURBED, find_scenario
from stlc.dynamics.uncertainty.disturbance import errors_of
from stlc.jsontext import Count
from stlc.options import Options
from stlc.registry import GUARDS, PLANNERS
from stlc.rundir import RunDir
from stlc.trace import Trace
from stlc.units import time_text

ALL, USUAL = "all", "disturbed"
SCENARIOS = "eval/scenarios.json"
PLANNING = 0.02
"""Processor time of a planner for each plan, in seconds, unless it is given."""
Watching: TypeAlias = Callable[[Task, Setting, str, bool], AbstractContextManager[Watch | None]]
"""View of a deployment while it runs, from task, setting, title, and whether it was asked for."""


# ---------------------------------------------------------------------- records


@dataclass(frozen=True, slots=True)
class UnsafeStart:
    """Agent that was not driven safely; `savable`: whether a safe plan from its start is known."""

    seed: int
    agent: int
    savable: bool


@dataclass(frozen=True, slots=True)
class GuardedRuns:
    """Results of one guard or planner over all seeds, with bounds if they were asked for."""

    JSON: ClassVar = (
        "metrics=found.metrics drives units=found.recording.units decisions=found.decisions unsafe "
        "latency=found.latency search?=found.search assurance?"
    )

    found: Deployment
    drives: JudgedRuns
    unsafe: Sequence[UnsafeStart]
    assurance: Assessment | None = None


@dataclass(frozen=True, slots=True)
class JudgeSpec:
    """Specification that judges drives: its name and path, and what its rules say."""

    spec: str
    path: str
    rules: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ScenarioResult:
    """Results in one scenario."""

    doc: str
    expect: Literal["nominal", "ood"]
    judge: JudgeSpec | None
    guards: Mapping[str, GuardedRuns]


@dataclass(frozen=True, slots=True)
class Simulation:
    """Results of closed-loop runs without and with a guard, and in scenarios; what `simulate.json` holds."""

    JSON: ClassVar = (
        "spec system run world scenario starts redrawn errors judge safety trace overrides "
        "seeds=setting.seeds agents=setting.agents steps=setting.steps replan=setting.replan "
        "time_limit=setting.limit paper_time_limit=setting.paper_limit ceiling=setting.known_feasible "
        "margin=setting.margin interval guards planners? scenarios? animation? report?"
    )

    spec: str
    system: str
    run: str
    world: str | None
    scenario: str | None
    starts: Literal["any", "savable", "feasible"]
    redrawn: Count
    errors: Mapping[str, float | list[str]]
    judge: JudgeSpec | None
    safety: Sequence[str]
    trace: str
    overrides: Mapping[str, str]
    setting: Setting
    guards: Mapping[str, GuardedRuns]
    planners: Mapping[str, GuardedRuns] = field(default_factory=dict)
    scenarios: Mapping[str, ScenarioResult] = field(default_factory=dict)
    animation: str | None = None
    report: str | None = None
    interval: str = "95 %, Student's t over the deployment seeds"

    def __repr__(self) -> str:
        drives = ((name, found.drives) for name, found in self.guards.items())
        each = (f"{name} {found.obeyed} of {found.count}" for name, found in drives)
        return f"Simulation({self.spec}: {', '.join(each)} drives satisfy everything)"

    def under(self, guard: str) -> list[GuardedRuns]:
        """Results with a guard, without a scenario and in each."""
        return [guards[guard] for guards in (self.guards, *(each.guards for each in self.scenarios.values()))]

    def satisfied(self, guard: str) -> float:
        """Least share, over all scenarios, of the drives with a guard that satisfy every requirement."""
        drives = [each.drives for each in self.under(guard)]
        return min(each.obeyed / each.count for each in drives)

    def answer(self, guard: str) -> str:
        """Answer to the claim: certified in all scenarios, refuted in one, else undecided."""
        answers = {each.assurance and each.assurance.answer for each in self.under(guard)}
        if "refuted" in answers:
            return "refuted"
        return "certified" if answers == {"certified"} else "undecided"


# ---------------------------------------------------------------------- simulations


def simulation(
    subject: Run | Path | str, options: SimulateOptions, watching: Watching
) -> tuple[Run, Simulation]:
    """Deploy a policy in the world of its system, and write trace, scene and results into the run's folder.

    Args:
        subject: the run, or its folder, number or words; or with a planner a specification.
        options: options of the simulation.
        watching: shows a deployment while it runs.

    Raises:
        UsageError: U101, an option does not fit.
        RunError, SystemFileError: the run is damaged, or its world fails.
    """
    for name, value in {"--from": options.start, "--stream": options.stream or None}.items():
        if value is not None:
            raise usage(f"`{name}` is for plants", "stlc simulate SPEC --plant FILE")
    guard = options.guarded
    if options.record is not None:
        Trace.check_writable(options.record)
    if options.certify is not None:
        Options.checked_share("--certify", options.certify)
    planner = _planner(options)
    beside = None
    if isinstance(subject, str | Path):
        spec = Path(subject)
        if planner is not None and (spec.suffix == ".stl" or spec.is_file()):
            task = Task.load(str(subject), options.system, options.overrides, whole=True)
            launch = Launch(root=options.runs, overrides=options.overrides, command=sys.argv[1:])
            subject = open_planner(task, planner, seed=0, launch=launch).path
        else:
            beside = planner
        run = Run.open(subject, root=options.runs, overrides=options.overrides)
    else:
        run, beside = subject, planner
    if beside is not None and options.system is not None:
        raise usage("`--system` is for a specification, and a run has its own")
    if GUARDS.get(guard).intervenes:
        run.task.require_controls("a guard")
    test = run.task.system.decl.test
    size = options.agents or test.agents, options.steps or test.steps
    if (finding := _longer(run, size[1])) is not None:
        notice(finding)
    setting = Setting(tuple(options.seeds), *size, test.replan, known_feasible=options.known_feasible)
    setting = setting.limited(options.time_limit)
    order = _Order(run, guard, setting, parse_margins(options.margin), options, watching, beside)
    scenarios = _several(run, options.scenario)
    if not scenarios:
        return run, order.deployed(options.scenario)
    found = {}
    for name, scenario in scenarios.items():
        each = order.deployed(name, asked=False)
        found[name] = ScenarioResult(scenario.doc, scenario.expect, each.judge, each.guards)
    result = replace(order.deployed(None), scenarios=found)
    run.dir.write_json(SCENARIOS, result)
    return run, result


def _planner(options: SimulateOptions) -> PlannerChoice | None:
    """Planner that `method` selects; None without it. Raises UsageError (U101) for options without it."""
    if options.method is not None:
        seconds = PLANNING if options.budget is None else options.budget
        return PlannerChoice(PLANNERS.chosen(options.method), options.options, seconds)
    given = {"--option": options.options or None, "--budget": options.budget, "--system": options.system}
    for name, value in given.items():
        if value is not None:
            raise usage(f"`{name}` is for a planner", "stlc simulate SPEC --method search")
    return None


def _longer(run: Run, steps: int) -> Diagnostic | None:
    """Return the warning W604 if `steps` steps exceed the time for which the policy was validated.

    The requirements may have no end in time. Nothing is then known about the policy beyond the validated
    time.
    """
    result = run.dir.record().get("result")
    judged = result.get("judged_seconds") if isinstance(result, dict) else None
    seconds = steps * run.task.system.dt
    if not isinstance(judged, int | float) or seconds <= judged:
        return None
    lasts, known = time_text(seconds), time_text(judged)
    message = f"the simulation lasts {lasts}, and training validated the policy on missions of {known}"
    note = "the requirements have no end: beyond that time nothing is known but this simulation"
    return Diagnostic("W604", message, note=(note,))


def _several(run: Run, scenario: str | None) -> dict[str, Any]:
    """Return the scenarios that are simulated in addition to the system without a scenario: name -> scenario.

    The mapping is empty if `scenario`, the value of `--scenario`, is None or the name of a single scenario.
    Raises UsageError (U101) if the system declares none although all are asked for.
    """
    decl = run.task.system.decl
    declared = {each.name: each for each in decl.scenarios}
    if scenario in declared:
        return {}
    if scenario == ALL and not declared:
        raise usage(f"`{decl.name}` declares no scenarios", f"--scenario {USUAL}: those of every system")
    if scenario == ALL:
        return declared
    return {name: find_scenario(decl, name) for name in DISTURBED} if scenario == USUAL else {}


@dataclass(frozen=True, slots=True)
class _Order:
    """A simulation as it was asked for; `beside` is a planner beside the policy."""

    run: Run
    guard: str
    setting: Setting
    margins: MarginRequest
    options: SimulateOptions
    watching: Watching
    beside: PlannerChoice | None

    def deployed(self, scenario: str | None, *, asked: bool = True) -> Simulation:
        """Simulate the policy without and with its guard, and return one record of both simulations.

        Args:
            scenario: scenario that is simulated; None for the system without a scenario.
            asked: whether the guarded simulation is what was asked for, and not one of several scenarios.
        """
        run = self.run
        if scenario is not None:
            run = Run.open(run.dir.path, overrides=self.options.overrides, scenario=scenario)
        rules, name = Rules.of(run), run.task.compiled.name
        margin = self.margins.of(run.task, run.policy, self.guard, self.setting.replan)
        each = replace(self, run=run, setting=replace(self.setting, margin=margin))
        found, planners = {}, {}
        for mode in dict.fromkeys((GUARDS.default, self.guard)):
            title = " · ".join((name, named_guard(mode).title, *([scenario] if scenario else [])))
            guarded = mode == self.guard
            try:
                found[mode] = each.deploy(run.policy, mode, title, rules, asked=asked and guarded)
            except RunError as error:
                if guarded:
                    raise
                for finding in error.diagnostics:  # only the comparison fails: the guarded run continues
                    notice(finding)
        if self.beside is not None:
            policy, title = planner_policy(run.task, self.beside), f"{name} · planner {self.beside.name}"
            planners[self.beside.name] = each.deploy(policy, self.guard, title, rules, asked=False)
        return each.saved(found, rules, planners)

    def deploy(
        self, policy: Policy, mode: str, title: str, rules: Rules | None, *, asked: bool
    ) -> Deployment:
        """Simulate a policy with the guard `mode`; the closed-loop runs are judged by `rules`.

        If the simulation fails or is interrupted, the steps simulated until then are saved as a trace.
        """
        task, setting = self.run.task, self.setting
        try:
            with PULSE.doing(f"simulating, {mode}"), self.watching(task, setting, title, asked) as watch:
                return deploy(task, policy, setting, mode, watch=watch, rules=rules)
        except InterruptedDeploymentError as error:
            if error.recording is not None:
                paths = save_trace_of(self.run, error.recording, setting, self.options.record, rules=rules)
                PULSE.tell(f"the first {error.recording.steps} steps are in {paths[0]}")
            raise (error.__cause__ or error) from None

    def saved(
        self, found: Mapping[str, Deployment], rules: Rules | None, planners: Mapping[str, Deployment]
    ) -> Simulation:
        """Write the traces, the scene (data of the animation) and the record of a simulation.

        Args:
            found: guard -> its results; the trace of the last one is the main trace.
            rules: specification that judges drives.
            planners: planner beside the policy -> its results, of which no trace is saved.
        """
        run, setting, options = self.run, self.setting, self.options
        last = list(found.values())[-1].recording
        save_trace_of(run, last, setting, options.record, rules=rules)
        save_scene(run.dir.place(RunDir.SCENE), last.scene)
        alone = found.get(GUARDS.default)
        beside = alone.recording if alone is not None and len(found) > 1 else None
        save_unguarded(run, beside, setting, rules)
        decl = run.task.system.decl
        world, scenario = decl.test.world, decl.scenario
        result = Simulation(
            *(run.task.compiled.name, decl.name, run.dir.name),
            world=None if world is None else world.path.name,
            scenario=None if scenario is None else scenario.name,
            starts=decl.test.starts,
            redrawn=last.redrawn,
            errors=errors_of(run.task.plain.truth),
            judge=None if rules is None else JudgeSpec(rules.name, str(rules.path), rules.docs),
            safety=[rule.name for rule in run.task.compiled.safety],
            trace=f"{run.dir.shown}/trace.npz",
            overrides=options.overrides,
            setting=setting,
            guards={name: self.record(each, self.assured(name, each, rules)) for name, each in found.items()},
            planners={name: self.record(each) for name, each in planners.items()},
        )
        run.dir.write_json(RunDir.SIMULATION, result)
        return result

    def record(self, found: Deployment, assurance: Assessment | None = None) -> GuardedRuns:
        """Results of one guard or planner."""
        seeds = self.setting.seeds
        unsafe = [UnsafeStart(seeds[each.seed], each.agent, each.viable) for each in found.unsafe]
        return GuardedRuns(found, JudgedRuns.of(found.runs, seeds, self.setting.agents), unsafe, assurance)

    def assured(self, name: str, found: Deployment, rules: Rules | None) -> Assessment | None:
        """Bounds on the share of drives that satisfy everything; the number of drives was fixed in advance.

        None if none are asked for, or if every drive violates an assumption of the specification.
        """
        if self.options.certify is None:
            return None
        sample = sample_of(self.run.task, found.recording, rules)
        if not sample.drives:
            why = "every drive violates an assumption of the specification"
            PULSE.tell(f"guard `{name}`: no bounds, as {why}")
            return None
        return sample.assess(Claim(self.options.certify, online=True))
