"""Text form of a compiled specification: formulas in steps, added states, and intervals in samples."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fractions import Fraction
from itertools import zip_longest
from textwrap import wrap
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.text import show_formula, shown
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.escape import screen
from stlc.grammar.printer import show, show_name

WIDTH, LEFT = 110, 44
"""Width of the text, and maximum width of the source column, in characters."""
LONG, SHOWN = 24, 8
"""Length in lines from which a formula is truncated, and lines shown then."""

_TIED = re.compile(r" (?=[<>=!*/+-]+ )|(?<= [<>=!*/+-]) |(?<=[<>=!]=) ")
"""Pattern of the blanks around the signs of comparisons and sums."""

Part: TypeAlias = Literal["all", "steps", "states", "ir"]
"""Part of the text to show: everything, the intervals in samples, the states, or the formulas."""


def dump(compiled: Compiled, part: Part = "all") -> str:
    """Return the text of one part of a compiled specification.

    The same specification and time grid always give the same text.
    """
    blocks = ["\n".join(_head(compiled))]
    if part == "all":
        blocks += list(_beside(compiled))
    elif part != "states":
        blocks += ["\n".join(_rule(*each, compiled, part)) for each in _rules(compiled)]
    if part in ("all", "states"):
        blocks.append("\n".join(_states(compiled)))
    return screen("\n\n".join(blocks)) + "\n"


def _head(compiled: Compiled) -> Iterator[str]:
    grid = compiled.grid
    facts = [show_name(compiled.name)]
    if grid.dt is not None:
        facts.append(f"dt {grid.in_words(Fraction(1))}")
    if grid.horizon is not None:
        facts.append(f"horizon {grid.duration(grid.horizon)}")
    facts.append(f"formula horizon {grid.duration(compiled.reach)}")
    yield " · ".join(facts)


def _rules(compiled: Compiled) -> Iterator[tuple[CompiledRequirement, str]]:
    """Yield (requirement, "") for each requirement, then (assumption, "assume") for each assumption."""
    yield from ((rule, "") for rule in compiled.requirements)
    yield from ((rule, "assume") for rule in compiled.assumptions)


def _beside(compiled: Compiled) -> Iterator[str]:
    """Yield a header, then each requirement in two columns of text: as in the source, and as compiled."""
    written = [show(rule.typed.written) for rule, _ in _rules(compiled)]
    left = min(max(map(len, [*written, "written"])), LEFT)
    yield f"    {'written':<{left}}  compiled"
    for (rule, kind), text in zip(_rules(compiled), written, strict=True):
        formula, *added = [_wrapped(became, WIDTH - left - 6, "  ") for became in _became(rule, compiled)]
        if len(formula) > LONG:
            formula = [*formula[:SHOWN], f"  … {len(formula) - SHOWN} more lines: --show ir"]
        right = [*formula, *(line for lines in added for line in lines)]
        rows = zip_longest(_wrapped(text, left), right, fillvalue="")
        lines = [_name(rule, kind), *(f"    {one:<{left}}  {other}".rstrip() for one, other in rows)]
        yield "\n".join(lines)


def _became(rule: CompiledRequirement, compiled: Compiled) -> Iterator[str]:
    """Yield texts about a compiled requirement: its formula, its added states, its intervals."""
    yield show_formula(rule.formula)
    read = rule.formula.columns
    added = [timer for timer in compiled.timers if timer.name in read]
    if added:
        yield "+ " + ", ".join(
            shown(t.name) if t.name == t.kind else f"{t.kind} {shown(t.name)}" for t in added
        )
    yield from (f"time  {line}" for line in _instants(rule, compiled.grid))


def _wrapped(text: str, width: int, hanging: str = "") -> list[str]:
    """Return the lines of a formula, each of at most `width` characters where possible.

    Comparisons and sums are not broken. All lines but the first begin with `hanging`.
    """
    tied = _TIED.sub("\N{NO-BREAK SPACE}", text)
    lines = wrap(tied, width, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


def _name(rule: CompiledRequirement, kind: str) -> str:
    tags = [f"@{show_name(tag)}" for tag in sorted(rule.tags)]
    if rule.weight != 1:
        tags.append(f"@weight({rule.weight:g})")
    if rule.scale != 1:
        tags.append(f"@scale({rule.scale:g})")
    return "  ".join(["", *([kind] if kind else []), show_name(rule.name), *tags]).rstrip()


def _rule(rule: CompiledRequirement, kind: str, compiled: Compiled, part: Part) -> Iterator[str]:
    yield _name(rule, kind)
    if part == "ir":
        yield f"    compiled  {show_formula(rule.formula)}"
    else:
        lines = _instants(rule, compiled.grid)
        for label, line in zip(["time", *[""] * len(lines)], lines, strict=False):
            yield f"    {label:<8}  {line}"


def _instants(rule: CompiledRequirement, grid: Grid) -> list[str]:
    """Return a line for each distinct interval of a formula: operator, interval in seconds and in samples."""
    lines = dict.fromkeys(_interval(node, grid) for node in rule.formula.windows())
    return list(lines) or ["the first sample alone"]


def _interval(node: ir.Windowed, grid: Grid) -> str:
    op, window, back = node.op, node.window, node.back
    end = "start" if back else "end"
    last = end if window.hi is None else grid.in_words(Fraction(window.hi))
    samples = f"samples {window.lo}..{end if window.hi is None else window.hi}{' back' if back else ''}"
    if grid.dt is None:
        return f"{op}  {samples}"
    return f"{op}  [{grid.in_words(Fraction(window.lo))}, {last}] = {samples}"


def _states(compiled: Compiled) -> Iterator[str]:
    added = [each.column.name for each in compiled.parameters] + [timer.name for timer in compiled.timers]
    read = [name for name in compiled.signature.names if name not in added]
    yield "  columns   " + " ".join(map(shown, read)) + (f" | {' '.join(map(shown, added))}" if added else "")
    for each in compiled.parameters:
        yield f"  + param   {shown(each.column.name)}  {each.text}, drawn for every trajectory"
    for timer in compiled.timers:
        yield f"  + {timer.kind:<6}  {shown(timer.name)}  {timer.about}".rstrip()
    if compiled.mission is not None:
        yield f"  mission   {compiled.grid.duration(compiled.mission)}"
    safe = ", ".join(show_name(rule.name) for rule in compiled.safety)
    yield f"  phi_safe  {safe or '(no requirement is tagged @safety)'}"
