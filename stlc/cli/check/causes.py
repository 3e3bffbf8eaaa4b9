"""`stlc explain TRACE`: violations traced back to the sub-formula, the instant, the signal and its value."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.check.text import in_unit
from stlc.cli.framework.documents import CauseNodeRecord, Explanation, ViolationCause
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics, wants_color
from stlc.compile.ir.traverse import margin_unit
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.cli.check.judge import Question
    from stlc.cli.check.outcome import Checked
    from stlc.monitor.explain.causes import CauseNode
    from stlc.monitor.explain.report import Cause

_WIDTH = 72


def explain_trace(name: str, question: Question, runs: Path, *, talk: bool) -> Answer[Explanation]:
    """Judge the trace `name` with the options in `question`, and explain every violation.

    The exit code of the answer states the verdict: 0 satisfied, 1 violated, 4 inconclusive. With `talk`,
    remarks and warnings are printed to the standard error. `runs` is the folder of all runs.
    """
    from stlc.cli.check.judge import judge
    from stlc.cli.check.outcome import EXIT_CODES, SATISFIED

    results = judge(name, question, runs)
    result = next((each for each in results if each.causes), results[0])  # the first object that violates
    if talk:
        for line in result.remarks:
            say(line)
        show_diagnostics(result.warnings)
    causes = result.causes.values()
    text = "\n\n".join("\n".join(_lines(cause, result)) for cause in causes)
    nothing = f"{visible(result.trace.name)}: nothing is violated ({result.verdict.overall})"
    return Answer(
        {
            "trace": result.trace.name,
            "verdict": result.verdict.overall,
            "causes": [_record(cause) for cause in causes],
        },
        lambda: emit(text or nothing, styled=True),
        EXIT_CODES.get(result.verdict.overall, SATISFIED),
        result.warnings,
    )


def _lines(cause: Cause, result: Checked) -> Iterator[str]:
    """Lines of output about one violation (`cause`): the formula in the source, and the tree of causes.

    The tree leads from the requirement to the sub-formulas, instants and signal values that decide its value.
    """
    from stlc.cli.framework.render import render_place

    judged = cause.judgement
    of = f" in trace {cause.trace}" if result.verdict.traces > 1 else ""
    started = cause.started
    margin = in_unit(f"{cause.tree.rho:+.6g}", judged.unit or cause.unit)
    yield f"{visible(judged.name)} is violated{of}, judged from {started}: robustness {margin}"
    advice = [("because", cause.because)]
    yield render_place(cause.place, cause.labels, advice, color=wants_color(sys.stdout)).rstrip("\n")
    yield ""
    for depth, node in _walk(cause.tree):
        yield f"  {'  ' * depth}{visible(_line(node, cause))}"


def _walk(tree: CauseNode) -> Iterator[tuple[int, CauseNode]]:
    """Yield (depth, node) for every node of a tree of causes, parents before their children.

    Of several children, the one that decides the value of the parent comes first. The function does not
    recurse. So a deeply nested formula cannot overflow the stack.
    """
    stack = [(0, tree)]
    while stack:
        depth, node = stack.pop()
        yield depth, node
        main = node.parts[node.main : node.main + 1]
        others = [part for i, part in enumerate(node.parts) if i != node.main]
        stack.extend((depth + 1, part) for part in reversed([*main, *others]))


def _line(node: CauseNode, cause: Cause) -> str:
    """Line of output about one sub-formula, `node`, in the tree of causes of a violation.

    It shows the text of the sub-formula, its truth value and instant, the values that it reads, and its
    robustness. Of a sub-formula with the wrong truth value in a whole window, it shows this window too.
    """
    from stlc.monitor.explain.report import readings_of

    text = " ".join(node.span.text.split())
    short = text if len(text) <= _WIDTH else f"{text[: _WIDTH - 1]}…"
    subject = cause.subject
    moment = subject.moment(node.sample)
    when = f"at {moment}"
    if node.during is not None:
        first, last = (subject.moment(k) for k in (node.during[0], node.during[-1]))
        when = f"from {first} to {last.removeprefix('t = ')}, closest {when}"
    values = [reading.text for reading in readings_of(node, subject, subject.record.samples)]
    shown = f", {', '.join(values)}" if values else ""
    margin = in_unit(f"{node.rho:+.6g}", margin_unit(node.formula))
    return f"{short}    is {str(node.holds).lower()} {when}{shown}, robustness {margin}"


def _record(cause: Cause) -> ViolationCause:
    """JSON record of the cause of a violation.

    The tree of causes becomes a list of nodes, parents before their children, each with its depth in the
    tree.
    """
    from stlc.monitor.explain.report import readings_of

    subject = cause.subject
    samples = subject.record.samples
    nodes: list[CauseNodeRecord] = [
        {
            "depth": depth,
            "text": " ".join(node.span.text.split()),
            "line": node.span.line,
            "column": node.span.column,
            "holds": node.holds,
            "time": subject.time(node.sample),
            "robustness": node.rho,
            "unit": margin_unit(node.formula),
            "readings": [reading.text for reading in readings_of(node, subject, samples)],
        }
        for depth, node in _walk(cause.tree)
    ]
    return {
        "requirement": cause.judgement.name,
        "trace": cause.trace,
        "start": subject.time(cause.start - cause.first),
        "violated": subject.time(cause.violated - cause.first),
        "because": cause.because,
        "tree": nodes,
    }
