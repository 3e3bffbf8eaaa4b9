"""Rules about a requirement on a recording: what was read of it, and what was never put to the test."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import Diagnostic
from stlc.monitor.facts.evidence import Evidence
from stlc.monitor.facts.fact import Fact
from stlc.monitor.facts.triggers import Bools, Trigger
from stlc.monitor.judgement import RequirementVerdict

AWAY = 3.0
"""Spans of the recorded values beyond which a predicate is out of their reach."""
_SHOWN = 3
"""Parts of a recording that a text lists."""


def part_read(evidence: Evidence) -> Iterator[Fact]:
    """Yield W711 for requirements that could not read the whole recording."""
    for judged in evidence.verdict:
        yield from part_facts(judged)


def part_facts(judged: RequirementVerdict) -> Iterator[Fact]:
    """Yield W711 if a requirement could not read the whole recording."""
    rule, parts, whole = judged.rule, judged.parts_read, judged.timeline.duration
    if not parts:
        return
    ends = [(f"{p.first - whole.first:.6g} s", f"{p.last - whole.first:.6g} s") for p in parts]
    shown = [first if first == last else f"{first} to {last}" for first, last in ends[:_SHOWN]]
    text = " and ".join([*shown, *([f"{len(parts) - _SHOWN} more parts"] if len(parts) > _SHOWN else [])])
    length = f"{whole.last - whole.first:.6g} s"
    help_: tuple[str, ...] = ()
    if len(parts) == 1 and ends[0][0] == ends[0][1]:
        text = f"judged at {text} only, of {length}"
        help_ = ("always (…)  judges every sample; always[0 s, 0 s] …  the first on purpose",)
    else:
        text = f"read {text} of {length}"
    finding = Diagnostic("W711", text, rule.span, help=help_)
    yield Fact(finding, rule.name, time=parts[0].first, unjudged=True)


def never_triggered(evidence: Evidence) -> Iterator[Fact]:
    """Yield W712 for implications whose left side never held, and `until`s decided by their first sample."""
    for judged in evidence.satisfied:
        found = [e for rule, e in evidence.triggers if rule is judged and e.kind == "triggered"]
        silent = [(each, idle) for each in found if (idle := _idle(judged, each)).any()]
        if not silent:
            continue
        beside = len(silent) == len(found) and all(idle.all() for _, idle in silent)
        for each, idle in silent[:1] if beside else silent:
            subject = "" if beside else f"`{_text(each)}` "
            count, of = (0, int(each.at.sum())) if len(idle) == 1 else (int(idle.sum()), len(idle))
            counted = f"(0 of {of:,})" if len(idle) == 1 else f"in {count:,} of {of:,} traces"
            text = f"{subject}never triggered {counted}"
            yield _fact("W712", judged, text, at=each, count=count, of=of, unjudged=True, beside=beside)


def at_once(evidence: Evidence) -> Iterator[Fact]:
    """Yield W713 for `eventually`s that hold at once, wherever they are judged."""
    for judged, each in evidence.triggers:
        if each.kind == "at once" and _idle(judged, each).all():
            yield _fact("W713", judged, f"`{_text(each)}` true at once, everywhere", at=each)


def _idle(judged: RequirementVerdict, each: Trigger) -> Bools:
    """Traces in scope that never trigger a part of a requirement, (traces,)."""
    return np.asarray(~judged.counted(np.asarray(each.hits.any(axis=0))))


def _text(each: Trigger) -> str:
    return " ".join(each.span.text.split())


def out_of_reach(evidence: Evidence) -> Iterator[Fact]:
    """Yield W714 for predicates that are far from all recorded values."""
    for judged in evidence.satisfied:
        atoms = {
            " ".join(node.span.text.split()): node
            for node in judged.rule.formula.predicates()
            if node.span is not None and node.columns and not node.frozen
        }
        for written, atom in atoms.items():
            least, most = evidence.margins(atom)
            span, near = most - least, max(least, -most)
            if 0.0 < span < math.inf and near >= AWAY * span:
                away = near / span
                amount = f"{away:,.0f}" if away >= 10.0 else f"{away:.1f}"
                text = f"nearest value of `{written}` is {amount} spans away"
                label = "a span is the greatest recorded value less the least"
                yield _fact("W714", judged, text, at=atom, label=label)


def on_boundary(evidence: Evidence) -> Iterator[Fact]:
    """Yield W723 for requirements whose robustness is zero up to the tolerance: there `<` and `<=` differ."""
    for judged in evidence.satisfied:
        if (abs(judged.counted(judged.least)) <= TOLERANCE).any():
            finding = Diagnostic("W723", "on the boundary, where `<` is not `<=`", judged.rule.span)
            yield Fact(finding, judged.name)


def _fact(
    code: str,
    judged: RequirementVerdict,
    text: str,
    *,
    at: Trigger | ir.Predicate,
    label: str = "",
    **more: Any,
) -> Fact:
    return Fact(Diagnostic(code, text, at.span or judged.rule.span, label=label), judged.name, **more)
