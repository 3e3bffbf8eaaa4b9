"""Compiler pipeline: the stages, in order. Read this module first.

    resolve   Spec          -> typed.Spec                 names, types, units; time in seconds
    place     typed.Formula -> typed.Formula              delays in samples of a time grid
    augment   typed.Formula -> typed.Formula, Timer…      mission time and the past become added states
    lower     typed.Formula -> ir.Formula                 negation normal form; time in steps
    simplify  ir.Formula    -> ir.Formula                 fewer nodes, no constants
    horizon   ir.Formula    -> int                        lookahead

A time grid is a time step and a horizon. `resolve_for` runs the first stage, which needs no time grid.
`compile_resolved` runs the others for one time grid. So a monitor that learns the time grid later, or uses
several grids, resolves the specification only once. `stlc.compile.backends.array.graph` evaluates the result.
No stage needs torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias, final

from stlc.compile.augment.augment import Augmented, augment
from stlc.compile.augment.guidance import guidance_cost
from stlc.compile.augment.mission import Goal, mission_steps, never_over
from stlc.compile.augment.timers import Timer, TimerTable
from stlc.compile.augment.whole import over_mission
from stlc.compile.backends.schedule import End
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import resolve
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.lower import as_written
from stlc.compile.ir.ranges import KnownRanges
from stlc.compile.ir.simplify import simplify
from stlc.compile.ir.warnings import jumps
from stlc.compile.semantics.semantics import Semantics
from stlc.diagnostics import Diagnostic, SpecError
from stlc.grammar.allow import not_allowed
from stlc.grammar.spec import Spec
from stlc.signature import Signature
from stlc.source import Span

Purpose: TypeAlias = Literal["train", "check"]
"""Purpose of a compilation.

`train`: plans over the horizon. Absolute operators (`always@[a, b]`, timed from the start of the mission) and
past operators become added states, and no window may extend beyond the plan (E306).
`check`: recorded traces. Absolute operators are timed from the first sample.
"""


@dataclass(frozen=True, slots=True)
class CompiledRequirement:
    """Requirement (or assumption) with its compiled formula.

    Attributes:
        name: name of the requirement.
        doc: text of the `##` comment before the requirement.
        tags: names of its tags without arguments (`safety`, `liveness`).
        weight: factor of its robustness in the overall minimum.
        scale: divisor of its robustness in the overall minimum.
        formula: formula in negation normal form, with time in steps.
        lowered: formula before simplification, which can be evaluated under every semantics (definition of
            minima and maxima).
        reach: lookahead in steps.
        windowed: whether the requirement mentions the horizon `T`, the length of a plan. If so, the formula
            must hold at each sample with at least T samples after it. But if `absolute` is True as well, the
            formula must hold at the first sample only.
        uses_end: whether the formula has a window to the end of the trace.
        absolute: whether the requirement has an operator such as `always@[a, b]`, whose interval counts from
            the start of the mission.
        alive: for training, state formula that holds while the requirement can still be satisfied after what
            happened earlier in the mission.
        span: place of the declaration in the source.
        typed: requirement before lowering.
    """

    name: str
    doc: str
    tags: frozenset[str]
    weight: float
    scale: float
    formula: ir.Formula
    lowered: ir.Formula = field(repr=False)
    reach: int
    windowed: bool
    uses_end: bool
    absolute: bool
    alive: ir.Formula
    span: Span = field(compare=False, repr=False)
    typed: typed.Requirement = field(compare=False, repr=False)

    @property
    def unit(self) -> str:
        """Unit of the robustness; "" if its predicates have different units."""
        return self.typed.formula.margin_unit

    @property
    def factor(self) -> float:
        """Factor of its robustness in the overall minimum: weight / scale."""
        return self.weight / self.scale

    def under(self, semantics: Semantics) -> ir.Formula:
        """Return the formula, simplified by the rules that are valid under `semantics`.

        `semantics` defines minima and maxima, for example as smooth ones. Some simplifications need exact
        minima and maxima.
        """
        return self.formula if semantics.exact else simplify(self.lowered, semantics)


@dataclass(frozen=True, slots=True)
class Compiled:
    """Compiled specification.

    Attributes:
        name: name of the specification.
        spec: syntax tree.
        signature: columns that requirements and assumptions read, then those of the added states.
        requirements: every `require`, in order.
        assumptions: every `assume`, in order; they are not part of the overall robustness.
        timers: states that the requirements add to those of the system (clock, statuses, latches, timers).
        parameters: for training, values drawn per trajectory that are not states of the system.
        guidance_cost: for training, cost at one sample that drives plans towards deadlines beyond the
            horizon; None without such deadlines.
        mission: last step of the mission to which a requirement refers; None if none does.
        recurring: for a mission without end, the greatest number of steps that a timer counts, about one
            period of a goal such as `always@[a, end] once[0, c] p`; it determines the length of simulated
            missions. None if the mission ends.
        grid: time step and horizon.
        warnings: findings that are not errors, without those that comments allow.
        typed: the specification after the first stage.
        end: treatment of windows that extend beyond the end of a plan.
    """

    name: str
    spec: Spec = field(repr=False)
    signature: Signature
    requirements: tuple[CompiledRequirement, ...]
    assumptions: tuple[CompiledRequirement, ...]
    timers: tuple[Timer, ...]
    parameters: tuple[typed.Parameter, ...]
    guidance_cost: ir.Num | None = field(repr=False)
    mission: int | None
    recurring: int | None
    grid: Grid
    warnings: tuple[Diagnostic, ...]
    typed: typed.Spec = field(repr=False)
    end: End = "strict"

    @property
    def safety(self) -> tuple[CompiledRequirement, ...]:
        """Requirements tagged `@safety` (phi_safe), which even an emergency plan must satisfy."""
        return tuple(rule for rule in self.requirements if "safety" in rule.tags)

    @property
    def reach(self) -> int:
        """Greatest lookahead of a requirement, in steps."""
        return max((rule.reach for rule in self.requirements), default=0)

    @property
    def recorded(self) -> tuple[CompiledRequirement, ...]:
        """Requirements in the form in which they are judged on a recorded trajectory.

        The first sample of such a trajectory is the start of the mission. An absolute operator
        (`always@[a, b]`) counts its interval from the start of the mission. In this form the interval counts
        from the first sample, and the requirement is judged only once per trajectory. A requirement without
        absolute operators is unchanged.
        """
        found = []
        for rule in self.requirements:
            if rule.absolute:
                lowered = self.grid.lower(rule.typed.formula.from_first_sample(), [])
                formula = simplify(lowered)
                reach = formula.reach.future
                rule = replace(rule, formula=formula, lowered=lowered, reach=reach, windowed=False)
            found.append(rule)
        return tuple(found)


def compile_spec(
    spec: Spec,
    *,
    grid: Grid,
    interface: Interface | None = None,
    overrides: Mapping[str, str] | None = None,
    purpose: Purpose = "train",
    end: End = "strict",
) -> Compiled:
    """Compile a specification: run all stages.

    Args:
        spec: syntax tree of the specification.
        grid: time step and horizon, as far as known.
        interface: interface of the system; None: signals are as declared in the specification.
        overrides: text of the new value of a constant or parameter, by its name.
        purpose: "train", or "check" for judging recorded traces.
        end: for training, "truncate" cuts windows that extend beyond the end of a plan; "strict" refuses
            them.

    Raises:
        SpecError: all errors of the first stage that fails.
    """
    return compile_resolved(resolve_for(spec, interface, overrides, purpose), grid, purpose, end)


def resolve_for(
    spec: Spec, interface: Interface | None, overrides: Mapping[str, str] | None, purpose: Purpose
) -> typed.Spec:
    """Run the first stage of the compiler, which does not depend on the time grid.

    The arguments are those of `compile_spec`.

    Raises:
        SpecError: all errors that the stage finds.
    """
    overrides = overrides or {}
    if interface is not None and purpose == "check":  # a state that is given becomes a parameter
        given = {item.name for item in spec.parameters} & overrides.keys()
        columns = interface.signature.columns
        kept = tuple(column for column in columns if column.name.partition("[")[0] not in given)
        interface = replace(interface, signature=Signature(kept))
    return resolve(spec, interface=interface, overrides=overrides)


def compile_resolved(
    spec: typed.Spec, grid: Grid, purpose: Purpose = "train", end: End = "strict"
) -> Compiled:
    """Run all stages of the compiler but the first, for one time grid.

    Raises:
        SpecError: all errors that the stages find.
    """
    sink = list(spec.warnings)
    if purpose == "check":
        spec = replace(
            spec,
            requirements=tuple(map(as_written, spec.requirements)),
            assumptions=tuple(map(as_written, spec.assumptions)),
        )
    stage = _Stage(grid, purpose, TimerTable(spec.taken), sink, spec.signature.nominal)
    requirements = tuple(map(stage.requirement, spec.requirements))
    goals = tuple(stage.goals)
    assumptions = tuple(map(stage.rule, spec.assumptions))
    errors = [finding for finding in sink if finding.severity == "error"]
    if not errors and purpose == "train":
        cut = end == "truncate"
        errors = [
            _too_far(rule, grid)
            for rule in requirements
            if _leaves_plan(rule, grid) and not (cut and not rule.formula.reach.past)
        ]
    if errors:
        raise SpecError(*errors)
    timers = stage.table.timers
    read = frozenset().union(*(rule.formula.columns for rule in (*requirements, *assumptions)))
    signature = Signature(tuple(column for column in spec.signature.columns if column.name in read))
    counted = (int(timer.high) for timer in timers if timer.kind == "timer")  # steps, at most
    return Compiled(
        name=spec.name,
        spec=spec.source_ast,
        signature=signature.extended(*(timer.column for timer in timers)),
        requirements=requirements,
        assumptions=assumptions,
        timers=timers,
        parameters=tuple(each for each in spec.parameters if not each.carried),
        guidance_cost=guidance_cost(goals),
        mission=max(map(mission_steps, goals), default=None),
        recurring=max(counted, default=0) if any(map(never_over, goals)) else None,
        grid=grid,
        warnings=tuple(not_allowed(sink)),
        typed=spec,
        end=end,
    )


@final
@dataclass(frozen=True, slots=True)
class _Stage:
    """Compiler of requirements; the input is the result of the first stage, with names and types resolved.

    The compiler collects the states that the requirements add (`table`), their goals (`goals`), and the
    findings (`sink`).
    """

    grid: Grid
    purpose: Purpose
    table: TimerTable
    sink: list[Diagnostic]
    ranges: KnownRanges
    goals: list[Goal] = field(default_factory=list)

    def requirement(self, requirement: typed.Requirement) -> CompiledRequirement:
        """Compile one requirement; if the mission has an end, it is one on the whole mission.

        A requirement that has no such form, since states cannot hold all that it needs of the past, is
        required of the window of each plan.
        """
        if self.grid.end is None:
            return self.rule(requirement)
        whole = replace(requirement, formula=over_mission(requirement.formula, self.grid))
        recurs = requirement.formula.mentions_horizon and whole != requirement
        trial = replace(self, table=TimerTable(frozenset()), sink=[], goals=[])
        trial.rule(whole, recurs=recurs)
        if any(finding.severity == "error" for finding in trial.sink):
            return self.rule(requirement)
        return self.rule(whole, recurs=recurs)

    def rule(self, requirement: typed.Requirement, *, recurs: bool = False) -> CompiledRequirement:
        """Compile one requirement or assumption; `recurs`: see `augment`."""
        written = self.grid.in_samples(requirement.formula, self.sink)
        requirement = replace(requirement, formula=written)
        if self.purpose == "train":
            self.sink.extend(jumps(written, self.ranges))
            rewritten = augment(requirement, self.grid, self.table, self.sink, recurs=recurs)
        else:  # a recorded trace begins with the mission: absolute intervals count from its first sample
            judged = written.from_first_sample() if written.absolute else written
            rewritten = Augmented(judged, typed.Truth(written.span, True), None)
        if rewritten.goal is not None:
            self.goals.append(rewritten.goal)
        lowered = self.grid.lower(rewritten.formula, self.sink)
        formula = simplify(lowered)
        return CompiledRequirement(
            name=requirement.name,
            doc=requirement.doc,
            tags=requirement.tags,
            weight=requirement.weight,
            scale=requirement.scale,
            formula=formula,
            lowered=lowered,
            reach=formula.reach.future,
            windowed=written.mentions_horizon and not recurs,
            uses_end=formula.uses_end,
            absolute=written.absolute,
            alive=simplify(self.grid.lower(rewritten.alive, self.sink)),
            span=requirement.span,
            typed=requirement,
        )


def _leaves_plan(rule: CompiledRequirement, grid: Grid) -> bool:
    """True if a requirement, at the first sample of a plan, reads samples outside of the plan."""
    if grid.steps is None:
        return False
    from stlc.compile.ir.defined import defined_at

    return not defined_at(rule.formula, grid.steps + 1, range(1))


def _too_far(rule: CompiledRequirement, grid: Grid) -> Diagnostic:
    horizon = Fraction(grid.steps or 0)
    need = Fraction(rule.reach)
    if rule.formula.reach.past:
        text = f"`{rule.name}` looks at samples before the start of every plan"
        label = "`prev`, `delta` or `shift` at the first sample"
    elif need <= horizon:
        text = f"`{rule.name}` looks beyond the end of every plan"
        label = "a window of fixed length inside of one that runs to the end"
    else:
        text = f"`{rule.name}` needs {grid.in_words(need)} of signal, a plan has {grid.in_words(horizon)}"
        label = f"looks {rule.reach} steps ahead"
    return Diagnostic(
        "E306",
        text,
        rule.typed.written.span,
        label=label,
        help=(
            "shorten its intervals, end them with `T` or `end`, or give the system a longer horizon",
            "times of the whole mission, over many plans, are written with `@`: `always@[0 s, 60 s] …`",
        ),
    )
