"""The rules that look at what is written; sorts, units and time are the compiler's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.lint.parentheses import missing_parentheses, unclear_implications
from stlc.lint.spelling import foreign_spellings
from stlc.lint.unused import nothing_required, unused_names

Check: TypeAlias = Callable[[ast.Spec], Iterator[Diagnostic]]


@dataclass(frozen=True, slots=True)
class Rule:
    """One thing to look for.

    Attributes:
        check: a well-formed specification -> its findings.
        usual: looked for unless something else is selected.
    """

    check: Check
    usual: bool = True


RULES: Mapping[str, Rule] = MappingProxyType(
    {
        "W105": Rule(unused_names),
        "W106": Rule(foreign_spellings),
        "W301": Rule(missing_parentheses),
        "W302": Rule(unclear_implications, usual=False),
        "W504": Rule(nothing_required),
    }
)
"""Code -> rule; the code's page says why (`stlc explain CODE`)."""
