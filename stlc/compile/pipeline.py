"""The stages of the compiler, in order. Read first.

    resolve   ast.Spec      -> typed.Spec                 names, sorts, units; time in seconds
    timers    typed.Formula -> typed.Formula, Timer…      absolute intervals
    lower     typed.Formula -> ir.Formula                 negation normal form; time in steps
    simplify  ir.Formula    -> ir.Formula                 fewer nodes, no constants
    horizon   ir.Formula    -> int                        how far it looks

`stlc.compile.graph` evaluates what comes out. torch is not needed for any of this.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal, TypeAlias

from stlc.compile import ir, typed
from stlc.compile.bounds import in_words
from stlc.compile.defined import defined
from stlc.compile.horizon import columns, reach, uses_end
from stlc.compile.interface import Grid, Interface
from stlc.compile.lower import lower
from stlc.compile.resolve import resolve
from stlc.compile.safety import safe_part
from stlc.compile.simplify import simplify
from stlc.compile.timers import Timer, absolute, augment, mentions_horizon, merged, recorded
from stlc.diagnostics import Diagnostic, SpecError
from stlc.grammar import ast
from stlc.signature import Signature
from stlc.source import Span

Purpose: TypeAlias = Literal["train", "check"]
"""What a specification is compiled for.

`train`: for plans over the horizon; absolute intervals become timers, no window may leave the plan (E306).
`check`: for recorded traces; absolute intervals are judged on the mission clock.
"""


@dataclass(frozen=True, slots=True)
class Rule:
    """A compiled requirement.

    Attributes:
        name: of the requirement.
        doc: its `##` comment.
        tags: bare tag names.
        weight: factor of its robustness in the whole.
        scale: divisor of its robustness in the whole.
        formula: in negation normal form and steps.
        reach: how many steps of the future it needs.
        windowed: it mentions `T`, and so speaks about every planning window.
        uses_end: a window of it runs to the end of the trace.
        absolute: it has an interval on the mission clock.
        span: of the declaration.
        typed: what it was lowered from.
    """

    name: str
    doc: str
    tags: frozenset[str]
    weight: float
    scale: float
    formula: ir.Formula
    reach: int
    windowed: bool
    uses_end: bool
    absolute: bool
    span: Span = field(compare=False, repr=False)
    typed: typed.Requirement = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Compiled:
    """A compiled specification.

    Attributes:
        name: of the specification.
        spec: what was written.
        signature: the columns that requirements and assumptions read, then the timers.
        requirements: in order.
        assumptions: the `assume`s, in order; never part of the whole.
        timers: states that the requirements need beyond those of the system.
        grid: of time.
        warnings: what is worth saying although it compiles.
        typed: the resolved specification.
    """

    name: str
    spec: ast.Spec = field(repr=False)
    signature: Signature
    requirements: tuple[Rule, ...]
    assumptions: tuple[Rule, ...]
    timers: tuple[Timer, ...]
    grid: Grid
    warnings: tuple[Diagnostic, ...]
    typed: typed.Spec = field(repr=False)

    @property
    def safety(self) -> tuple[Rule, ...]:
        """phi_safe: the requirements tagged `@safety`."""
        return safe_part(self.requirements)

    @property
    def reach(self) -> int:
        """How many steps of the future the whole needs."""
        return max((rule.reach for rule in self.requirements), default=0)


def compile_spec(
    spec: ast.Spec,
    *,
    grid: Grid,
    interface: Interface | None = None,
    overrides: Mapping[str, str] | None = None,
    purpose: Purpose = "train",
) -> Compiled:
    """All stages.

    Args:
        spec: as parsed.
        grid: the step and the horizon, as far as they are known.
        interface: what a system offers; None leaves the signals of the file as they are declared.
        overrides: constant -> its value, as text.
        purpose: training or judging recorded traces.

    Raises:
        SpecError: with all errors of a stage.
    """
    sink: list[Diagnostic] = []
    resolved = resolve(spec, interface=interface, overrides=overrides or {}, sink=sink)
    timers: list[Timer] = []
    requirements = tuple(_rule(r, grid, purpose, sink, timers) for r in resolved.requirements)
    assumptions = tuple(_rule(r, grid, purpose, sink, timers) for r in resolved.assumptions)
    added = merged(timers)
    sink.extend(_taken(resolved, added))
    errors = [finding for finding in sink if finding.severity == "error"]
    if not errors and purpose == "train":
        errors = [_too_far(rule, grid) for rule in requirements if _leaves(rule, grid)]
    if errors:
        raise SpecError(*errors)
    return Compiled(
        name=resolved.name,
        spec=spec,
        signature=_signature(resolved, (*requirements, *assumptions), added),
        requirements=requirements,
        assumptions=assumptions,
        timers=added,
        grid=grid,
        warnings=tuple(sink),
        typed=resolved,
    )


def _rule(
    requirement: typed.Requirement, grid: Grid, purpose: Purpose, sink: list[Diagnostic], timers: list[Timer]
) -> Rule:
    written = requirement.formula
    if purpose == "train":
        rewritten, added = augment(written, grid, sink)
        timers.extend(added)
    else:
        rewritten = recorded(written, sink) if absolute(written) else written
    formula = simplify(lower(rewritten, grid, sink))
    return Rule(
        name=requirement.name,
        doc=requirement.doc,
        tags=requirement.tags,
        weight=requirement.weight,
        scale=requirement.scale,
        formula=formula,
        reach=reach(formula).future,
        windowed=mentions_horizon(written),
        uses_end=uses_end(formula),
        absolute=absolute(written),
        span=requirement.span,
        typed=requirement,
    )


def _signature(spec: typed.Spec, rules: Iterable[Rule], timers: Iterable[Timer]) -> Signature:
    read = frozenset().union(*(columns(rule.formula) for rule in rules))
    kept = Signature(tuple(column for column in spec.signature.columns if column.name in read))
    return kept.extended(*(timer.column for timer in timers))


def _taken(spec: typed.Spec, timers: Iterable[Timer]) -> Iterator[Diagnostic]:
    """A timer must not have the name of a signal."""
    for timer in timers:
        if timer.name in spec.signature:
            declared = next(item for item in spec.source_ast.items if item.name == timer.name)
            yield Diagnostic(
                "E102",
                f"`{timer.name}` is the name of a state that absolute intervals add",
                declared.name_span,
                help=("call the signal something else",),
            )


def _leaves(rule: Rule, grid: Grid) -> bool:
    return grid.horizon is not None and not defined(rule.formula, grid.horizon + 1)[0]


def _too_far(rule: Rule, grid: Grid) -> Diagnostic:
    horizon = Fraction(grid.horizon or 0)
    need = Fraction(rule.reach)
    if need <= horizon:
        text = f"`{rule.name}` looks beyond the end of every plan"
        label = "a window of fixed length inside of one that runs to the end"
    else:
        text = f"`{rule.name}` needs {in_words(need, grid)} of signal, a plan has {in_words(horizon, grid)}"
        label = f"looks {rule.reach} steps ahead"
    return Diagnostic(
        "E306",
        text,
        rule.typed.written.span,
        label=label,
        help=("shorten its intervals, end them with `T` or `end`, or give the system a longer horizon",),
    )
