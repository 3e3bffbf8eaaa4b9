"""Signals that requirements read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns
from stlc.compile.ir.traverse import numbers, subexpressions
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span

_INDEX = re.compile(r"\[\d+\]$")


@dataclass(frozen=True, slots=True)
class Need:
    """Signal that requirements read.

    Attributes:
        column: as the specification declares it.
        by: names of the requirements.
        span: of its declaration.
        parameter: it is a `param`, for which a value may be given instead.
    """

    column: Column
    by: tuple[str, ...]
    span: Span | None = None
    parameter: bool = False


def needs_of(compiled: Compiled, rules: Sequence[CompiledRequirement]) -> tuple[Need, ...]:
    """The signals that `rules` read, in the order of the specification.

    Raises:
        UsageError: E107, they call functions that are not loaded.
    """
    _require_functions(compiled, rules)
    read = {rule.name: columns(rule.formula) for rule in rules}
    declared = [item for item in compiled.spec.items if isinstance(item, ast.Signal | ast.Param)]
    spans = {item.name: item.name_span for item in declared}
    parameters = {each.column.name for each in compiled.typed.parameters}
    wanted: dict[str, tuple[str, ...]] = {}
    for rule in rules:
        for column in read[rule.name]:
            wanted[column] = (*wanted.get(column, ()), rule.name)
    return tuple(
        Need(
            column,
            wanted[column.name],
            spans.get(_INDEX.sub("", column.name)),
            column.name in parameters,
        )
        for column in compiled.signature.columns
        if column.name in wanted
    )


def _require_functions(compiled: Compiled, rules: Sequence[CompiledRequirement]) -> None:
    parts = (part for rule in rules for num in numbers(rule.formula) for part in subexpressions(num))
    missing = dict.fromkeys(
        part.name for part in parts if isinstance(part, ir.Extern) and part.function is None
    )
    if not missing:
        return
    places = {item.name: item.name_span for item in compiled.spec.items if isinstance(item, ast.Extern)}
    help_ = ("--system FILE names the system that does; its functions are Python code, and loading runs it",)
    message = "`{}` is a function from outside, and nobody provides it here"
    raise UsageError(*(Diagnostic("E107", message.format(n), places.get(n), help=help_) for n in missing))
