"""Evidence of the rules: a specification, the recording that it judged, and the result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import Bounds
from stlc.compile.ir.holes import holes_in, without_holes
from stlc.compile.ir.ranges import bounds
from stlc.monitor.facts.triggers import Trigger, triggers
from stlc.monitor.judgement import RequirementVerdict, Verdict
from stlc.monitor.prepared import Prepared
from stlc.signature import Column
from stlc.source import Span
from stlc.trace import Trace

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Evidence:
    """A verdict with what it rests on.

    Attributes:
        verdict: the result.
    """

    verdict: Verdict

    @property
    def subject(self) -> Prepared:
        """The evaluated signals and the compiled requirements."""
        return self.verdict.subject

    @property
    def trace(self) -> Trace | None:
        """The recording; None for signals that a Python program gave."""
        return self.subject.signals.trace

    @cached_property
    def satisfied(self) -> tuple[RequirementVerdict, ...]:
        """Requirements that are satisfied."""
        return tuple(judged for judged in self.verdict if judged.overall == "satisfied")

    @cached_property
    def triggers(self) -> tuple[tuple[RequirementVerdict, Trigger], ...]:
        """Obligations of the satisfied requirements that depend on what the recording holds."""
        return tuple((judged, each) for judged in self.satisfied for each in triggers(judged, self.subject))

    @cached_property
    def read(self) -> tuple[Column, ...]:
        """Signals that the judged requirements read, without parameters, which are constant by nature."""
        compiled, rules = self.subject.compiled, self.subject.rules
        names = frozenset[str]().union(*(rule.formula.columns for rule in rules)) & self.values.keys()
        names -= {each.column.name for each in compiled.typed.parameters}
        return tuple(column for column in compiled.signature.columns if column.name in names)

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """Recorded values of each signal of traces in scope, (moments, traces); NaN is unknown."""
        signals = self.subject.signals
        env = signals.env if signals.cells is None else signals.cells.before
        scope = self.verdict.requirements[0].scope
        return env if scope is None else {name: values[:, scope] for name, values in env.items()}

    @cached_property
    def times(self) -> Floats:
        """Time in seconds of each row of `values`."""
        signals = self.subject.signals
        if signals.cells is not None:
            return signals.cells.times
        step = signals.dt or self.subject.dt or 1.0
        return signals.t0 + step * np.arange(signals.samples, dtype=np.float64)

    @cached_property
    def ranges(self) -> Mapping[str, Bounds]:
        """Least and greatest recorded value of each signal; NaN where nothing is known."""
        reduced = ((np.fmin.reduce(x, axis=None), np.fmax.reduce(x, axis=None)) for x in self.values.values())
        return {name: (float(a), float(b)) for name, (a, b) in zip(self.values, reduced, strict=True)}

    def margins(self, predicate: ir.Predicate) -> Bounds:
        """Least and greatest margin of a predicate over all recorded values."""
        if predicate.num.is_linear:
            return bounds(predicate.num, self.ranges) or (math.nan, math.nan)
        env = {name: self.values[name] for name in predicate.num.columns}
        holes, samples = holes_in(env), len(next(iter(env.values())))
        filled = without_holes(env, holes) if holes else env
        (found,) = evaluate([predicate], filled, count=samples, end="truncate")
        for name in holes:
            found = np.where(np.isnan(env[name]), np.nan, found)
        return float(np.fmin.reduce(found, axis=None)), float(np.fmax.reduce(found, axis=None))

    def declared(self, signal: str) -> Span:
        """Place of the declaration of a signal; the start of the text if there is none."""
        spec = self.subject.compiled.spec
        base = signal.partition("[")[0]
        places = (item.name_span for item in spec.read if item.name == base)
        return next(places, spec.source.span(0, 0))
