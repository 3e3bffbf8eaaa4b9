"""Linter of a specification: findings of the compiler and of the lint rules, and their repairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import resolve
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Purpose, compile_resolved
from stlc.diagnostics import CODES, Diagnostic, Fix, SpecError, UsageError
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.lint.rules import RULES
from stlc.registry import closest
from stlc.source import Source

ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Fixed:
    """Repaired text.

    Attributes:
        source: text after the repairs.
        findings: remaining findings.
        count: number of repaired findings.
    """

    source: Source
    findings: tuple[Diagnostic, ...]
    count: int


def fix(source: Source, look: Callable[[Source], Sequence[Diagnostic]]) -> Fixed:
    """Apply repairs until no repairable finding remains.

    A round that would introduce new errors is discarded. Overlapping repairs wait for the next round.

    Args:
        source: the text.
        look: text -> its findings.
    """
    findings, count = tuple(look(source)), 0
    for _ in range(ROUNDS):
        chosen = _apart([finding.fix for finding in findings if _fits(finding.fix, source)])
        if not chosen:
            break
        repaired = Source(source.name, _edited(source.text, chosen))
        after = tuple(look(repaired))
        if repaired.text == source.text or _errors(after) > _errors(findings):
            break
        source, findings, count = repaired, after, count + len(chosen)
    return Fixed(source, findings, count)


def _fits(repair: Fix | None, source: Source) -> bool:
    return repair is not None and all(span.source is source for span, _ in repair.edits)


def _errors(findings: Iterable[Diagnostic]) -> int:
    return sum(finding.severity == "error" for finding in findings)


def _apart(repairs: Iterable[Fix | None]) -> list[Fix]:
    """Return non-overlapping repairs; of two overlapping ones the first."""
    chosen: list[Fix] = []
    taken: set[tuple[int, int]] = set()
    for repair in repairs:
        if repair is None or not repair.edits:
            continue
        places = {(span.start, span.end) for span, _ in repair.edits}
        if not any(_touch(place, other) for place in places for other in taken):
            chosen.append(repair)
            taken |= places
    return chosen


def _touch(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _edited(text: str, repairs: Iterable[Fix]) -> str:
    edits = [(span.start, span.end, new) for repair in repairs for span, new in repair.edits]
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of warnings; errors are always reported.

    Attributes:
        select: prefixes of codes; empty for the default ones, "ALL" for every one.
        ignore: prefixes of codes to omit.
    """

    select: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for prefix in (*self.select, *self.ignore):
            if prefix != "ALL" and not any(code.startswith(prefix) for code in CODES):
                near = closest(prefix, CODES)
                advice = f"did you mean `{near}`?" if near else "stlc explain  lists the codes"
                raise UsageError(Diagnostic("U101", f"there is no code `{prefix}`", help=(advice,)))

    def wants(self, code: str) -> bool:
        """True if findings with this code are reported."""
        if not code.startswith("W"):
            return True
        if self.ignore and code.startswith(self.ignore):
            return False
        if not self.select:
            return code not in RULES or RULES[code].usual
        return "ALL" in self.select or code.startswith(self.select)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """System and purpose for which a specification is linted."""

    interface: Interface
    grid: Grid
    purpose: Purpose = "train"


EVERYTHING_USUAL = Selection()


def lint(
    source: Source, *, within: Surroundings | None = None, selection: Selection = EVERYTHING_USUAL
) -> tuple[Diagnostic, ...]:
    """Return all findings in a text, in source order.

    Args:
        source: the text.
        within: system and purpose; without a system, checks that need one are skipped.
        selection: of warnings.
    """
    try:
        spec = parse(source)
    except SpecError as error:
        return error.diagnostics
    found = [*_compiled(spec, within), *_written(spec, selection)]
    kept = [finding for finding in found if selection.wants(finding.code)]
    return tuple(sorted(kept, key=lambda finding: _place(finding, source)))


def _compiled(spec: ast.Spec, within: Surroundings | None) -> Sequence[Diagnostic]:
    """Findings of the compiler."""
    warnings: list[Diagnostic] = []
    try:
        resolved = resolve(spec, interface=None if within is None else within.interface, sink=warnings)
        if within is None:
            return warnings
        return compile_resolved(resolved, within.grid, within.purpose).warnings
    except SpecError as error:
        return [*warnings, *error.diagnostics]


def _written(spec: ast.Spec, selection: Selection) -> Iterator[Diagnostic]:
    for code, rule in RULES.items():
        if selection.wants(code):
            yield from rule.check(spec)


def _place(finding: Diagnostic, source: Source) -> tuple[bool, int]:
    """Sort key: findings in the text itself by position, then all others."""
    own = finding.span is not None and finding.span.source is source
    return not own, finding.span.start if own and finding.span else 0
