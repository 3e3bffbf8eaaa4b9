"""Which signals requirements read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from stlc.compile.horizon import columns
from stlc.compile.pipeline import Compiled, Rule
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span

_INDEX = re.compile(r"\[\d+\]$")


@dataclass(frozen=True, slots=True)
class Need:
    """A signal that requirements read.

    Attributes:
        column: as the specification declares it.
        by: names of the requirements.
        span: of its declaration.
    """

    column: Column
    by: tuple[str, ...]
    span: Span | None = None


def needs_of(compiled: Compiled, rules: Sequence[Rule]) -> tuple[Need, ...]:
    """The signals that `rules` read, in the order of the specification."""
    read = {rule.name: columns(rule.formula) for rule in rules}
    spans = {item.name: item.name_span for item in compiled.spec.items if isinstance(item, ast.Signal)}
    wanted: dict[str, tuple[str, ...]] = {}
    for rule in rules:
        for column in read[rule.name]:
            wanted[column] = (*wanted.get(column, ()), rule.name)
    return tuple(
        Need(column, wanted[column.name], spans.get(_INDEX.sub("", column.name)))
        for column in compiled.signature.columns
        if column.name in wanted
    )
