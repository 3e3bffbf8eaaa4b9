"""The table of rules over a specification, a recording and the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

from stlc.grammar.allow import not_allowed
from stlc.monitor.facts import recordings, requirements
from stlc.monitor.facts.evidence import Evidence
from stlc.monitor.facts.fact import Fact
from stlc.monitor.judgement import Verdict

Rule: TypeAlias = Callable[[Evidence], Iterator[Fact]]

RULES: Mapping[str, Rule] = MappingProxyType(
    {
        "W711": requirements.part_read,
        "W712": requirements.never_triggered,
        "W713": requirements.at_once,
        "W714": requirements.out_of_reach,
        "W715": recordings.unchanging,
        "W716": recordings.odd_values,
        "W717": recordings.object_columns,
        "W718": recordings.few_samples,
        "W719": recordings.known_in_part,
        "W720": recordings.hidden_columns,
        "W721": recordings.units_in_names,
        "W722": recordings.degrees,
        "W723": requirements.on_boundary,
    }
)
"""Code -> rule, in the order in which facts are told; `stlc.diagnostics.FACTS` says which are no warnings."""


def facts_of(verdict: Verdict) -> tuple[Fact, ...]:
    """Return the facts about a verdict that no comment of the specification allows (`# stlc: allow W711`)."""
    if not verdict.in_scope:
        return ()
    evidence = Evidence(verdict)
    return unsilenced([fact for rule in RULES.values() for fact in rule(evidence)])


def unsilenced(found: Sequence[Fact]) -> tuple[Fact, ...]:
    """Return the facts that no comment of the specification allows."""
    kept = {id(finding) for finding in not_allowed(fact.finding for fact in found)}
    return tuple(fact for fact in found if id(fact.finding) in kept)
