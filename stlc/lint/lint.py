"""Linter of a specification: findings of the compiler and of the lint rules, and automatic repairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from stlc.compile.deadlines import beyond_plans
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import resolve
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Purpose, compile_resolved
from stlc.diagnostics import CODES, Diagnostic, Fix, SpecError, usage
from stlc.grammar.allow import not_allowed
from stlc.grammar.spec import Spec
from stlc.lint.meaning import TYPED_RULES
from stlc.lint.rules import RULES
from stlc.source import Source, Span

Edit: TypeAlias = tuple[Span, str]
"""A part of a text, and what replaces it."""
ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Fixed:
    """Text after automatic repairs, and the findings that remain.

    Attributes:
        source: the text after the repairs.
        findings: findings that remain.
        count: number of findings that were repaired.
    """

    source: Source
    findings: tuple[Diagnostic, ...]
    count: int


def fix(source: Source, check: Callable[[Source], Sequence[Diagnostic]]) -> Fixed:
    """Repair a text in rounds until no finding with an automatic repair remains; return the repaired text.

    In each round, all repairs that do not overlap are applied, except those that change what is required. Of
    two overlapping repairs, the second waits for the next round. A round that increases the number of errors
    is undone, and no further round follows.

    Args:
        source: the text.
        check: function that returns the findings in a text.
    """
    findings, count = tuple(check(source)), 0
    for _ in range(ROUNDS):
        fixes = [found.fix for found in findings if found.fix is not None and found.fix.same]
        chosen = _apart(one for one in fixes if all(span.source is source for span, _ in one.edits))
        if not chosen:
            break
        text = edited(source.text, [edit for one in chosen for edit in one.edits])
        repaired = Source(source.name, text)
        after = tuple(check(repaired))
        if text == source.text or _errors(after) > _errors(findings):
            break
        source, findings, count = repaired, after, count + len(chosen)
    return Fixed(source, findings, count)


def _errors(findings: Iterable[Diagnostic]) -> int:
    return sum(finding.severity == "error" for finding in findings)


def _apart(repairs: Iterable[Fix]) -> list[Fix]:
    """Return repairs that do not overlap; of two overlapping ones, the first is kept."""
    chosen: list[Fix] = []
    taken: set[tuple[int, int]] = set()
    for repair in repairs:
        places = {(span.start, span.end) for span, _ in repair.edits}
        overlaps = any(start <= last and first <= end for start, end in places for first, last in taken)
        if places and not overlaps:
            chosen.append(repair)
            taken |= places
    return chosen


def edited(text: str, edits: Iterable[Edit]) -> str:
    """Return the text with edits applied; an edit is (source location, replacement).

    The edits must not overlap.
    """
    for start, end, new in sorted(((span.start, span.end, new) for span, new in edits), reverse=True):
        text = text[:start] + new + text[end:]
    return text


@dataclass(frozen=True, slots=True)
class Selection:
    """Choice of the warnings to report; errors are always reported.

    Attributes:
        select: codes to report, or their beginnings, such as "W1"; "ALL" for every code. If it is empty, the
            warnings active by default are reported.
        ignore: codes not to report, or their beginnings; it takes precedence over `select`.
    """

    select: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for prefix in (*self.select, *self.ignore):
            if prefix != "ALL" and not any(code.startswith(prefix) for code in CODES):
                missing = usage(f"there is no code `{prefix}`")
                raise missing.near(prefix, CODES, "stlc explain  lists the codes")

    def wants(self, code: str) -> bool:
        """True if findings with this code are to be reported."""
        if not code.startswith("W"):
            return True
        if self.ignore and code.startswith(self.ignore):
            return False
        if not self.select:
            return code not in RULES or RULES[code].usual
        return "ALL" in self.select or code.startswith(self.select)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The system for which a specification is linted: its signals and functions, and its time grid.

    `purpose` is what the specification is compiled for, such as "train".
    """

    interface: Interface
    grid: Grid
    purpose: Purpose = "train"


EVERYTHING_USUAL = Selection()


def lint(
    source: Source, *, within: Surroundings | None = None, selection: Selection = EVERYTHING_USUAL
) -> tuple[Diagnostic, ...]:
    """Return the findings in a text that its comments do not allow, in source order.

    Args:
        source: the text.
        within: system and purpose; with None, only names, types and units are checked, without a time grid.
        selection: choice of the warnings to report.
    """
    try:
        spec = Spec.parse(source)
    except SpecError as error:
        return error.diagnostics
    plans = within is not None and within.purpose == "train"
    warnings: list[Diagnostic] = []
    resolved: typed.Spec | None = None
    try:
        resolved = resolve(spec, interface=None if within is None else within.interface, sink=warnings)
        if within is not None:
            compiled = compile_resolved(resolved, within.grid, within.purpose)
            warnings = [*compiled.warnings, *(beyond_plans(compiled) if plans else ())]
    except SpecError as error:
        warnings += error.diagnostics
    found = not_allowed(finding for finding in warnings if selection.wants(finding.code))
    found += rule_findings(spec, selection, resolved=resolved, plans=plans)
    return tuple(sorted(found, key=lambda finding: _place(finding, source)))


def rule_findings(
    spec: Spec,
    selection: Selection = EVERYTHING_USUAL,
    *,
    resolved: typed.Spec | None = None,
    plans: bool = False,
) -> list[Diagnostic]:
    """Return the findings of the lint rules in a specification that its comments do not allow.

    Args:
        spec: the specification.
        selection: choice of the warnings to report.
        resolved: the resolved specification; with None, rules on its meaning are skipped.
        plans: whether the specification is one of plans, and not of recordings.
    """
    found = [each for code, rule in RULES.items() if selection.wants(code) for each in rule.check(spec)]
    if resolved is not None:
        for code, typed_rule in TYPED_RULES.items():
            if selection.wants(code) and (typed_rule.plans or not plans):
                found += typed_rule.check(resolved)
    return not_allowed(found)


def _place(finding: Diagnostic, source: Source) -> tuple[bool, int]:
    """Return a key that sorts findings: first those in the text `source`, by position, then all others."""
    own = finding.span is not None and finding.span.source is source
    return not own, finding.span.start if own and finding.span else 0
