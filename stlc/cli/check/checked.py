"""One trace that was judged, and the exit code that several of them stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from stlc.diagnostics import Diagnostic
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement, Verdict
from stlc.source import Source
from stlc.trace import Trace

SATISFIED, VIOLATED, INCONCLUSIVE = 0, 1, 4


@dataclass(frozen=True, slots=True)
class Checked:
    """A trace, by what it was judged, and the result.

    Attributes:
        trace: as read, signals renamed.
        source: text of the specification.
        verdict: per requirement.
        causes: violated requirement -> why.
        asked: the words of the command line that say how it was read and judged.
    """

    trace: Trace
    source: Source
    verdict: Verdict
    causes: Mapping[str, Cause]
    asked: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """Of the compiler."""
        return self.verdict.subject.compiled.warnings

    def needs(self, judged: Judgement) -> tuple[float, float]:
        """Seconds of signal that the judged instants of a requirement need, and seconds that there are."""
        last = judged.start + judged.instants - 1 + judged.rule.reach
        return last * self.trace.dt, (self.trace.samples - 1) * self.trace.dt


def exit_code(results: Sequence[Checked], fail_under: float | None) -> int:
    """0 satisfied, 1 violated, 4 inconclusive; with `fail_under` the share of satisfied starts decides."""
    if fail_under is not None:
        return _by_share(results, fail_under)
    found = {result.verdict.overall for result in results}
    if "violated" in found:
        return VIOLATED
    return INCONCLUSIVE if "inconclusive" in found else SATISFIED


def _by_share(results: Sequence[Checked], least: float) -> int:
    traces = sum(result.verdict.traces for result in results)
    holds = sum(result.verdict.share * result.verdict.traces for result in results) / traces
    fails = sum(result.verdict.failed_share * result.verdict.traces for result in results) / traces
    if holds >= least:
        return SATISFIED
    return VIOLATED if 1.0 - fails < least else INCONCLUSIVE
