"""`stlc explain TRACE`: violations traced back to the sub-formula, the instant, the signal and its value."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.check.text import in_unit
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics, wants_color
from stlc.cli.framework.render import render_place
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.monitor.check import Question
    from stlc.monitor.explain.tree import ExplainedViolation, Explanation
    from stlc.monitor.judgement import Verdict


def explain_trace(name: str, question: Question, runs: Path, *, talk: bool) -> Answer[Explanation]:
    """Judge the trace `name` with the options in `question`, and explain every violation.

    The exit code of the answer states the verdict: 0 satisfied, 1 violated, 4 inconclusive. With `talk`,
    remarks and warnings are printed to the standard error. `runs` is the folder of all runs.
    """
    from stlc.cli.check.many import EXIT_CODES, SATISFIED, seen_at
    from stlc.monitor.check import judge
    from stlc.monitor.explain.tree import explanation

    path = seen_at(name, runs)
    verdicts = judge(path, question)
    verdict = next((each for each in verdicts if each.causes), verdicts[0])  # the first object that violates
    if talk:
        for line in (*(() if path == Path(name) else (f"taking {path}, of the newest run",)), *verdict.notes):
            say(line)
        show_diagnostics(verdict.warnings)
    found = explanation(verdict)
    text = "\n\n".join("\n".join(_lines(each, verdict)) for each in found.causes)
    nothing = f"{visible(found.trace)}: nothing is violated ({found.overall})"
    code = EXIT_CODES.get(found.overall, SATISFIED)
    return Answer(found, lambda: emit(text or nothing, styled=True), code, verdict.warnings)


def _lines(found: ExplainedViolation, verdict: Verdict) -> Iterator[str]:
    """Lines of output about one violation: the formula in the source, and the tree of causes.

    The tree leads from the requirement to the sub-formulas, instants and signal values that decide its value.
    """
    cause = found.cause
    of = f" in trace {cause.trace}" if verdict.traces > 1 else ""
    margin = in_unit(f"{found.tree[0].robustness:+.6g}", cause.rule.unit or cause.unit)
    yield f"{visible(cause.name)} is violated{of}, judged from {cause.started}: robustness {margin}"
    advice = [("because", cause.because)]
    yield render_place(cause.place, cause.labels, advice, color=wants_color(sys.stdout)).rstrip("\n")
    yield ""
    for step in found.tree:
        shown = f", {', '.join(step.readings)}" if step.readings else ""
        margin = in_unit(f"{step.robustness:+.6g}", step.unit)
        line = f"{step.short}    is {str(step.holds).lower()} {step.when}{shown}, robustness {margin}"
        yield f"  {'  ' * step.depth}{visible(line)}"
