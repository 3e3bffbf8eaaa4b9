"""`stlc explain`: an error code, the precedence of operators, a specification, or a trace's violations."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.commands.check import options as given
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics, table, wants_color
from stlc.cli.framework.program import command
from stlc.cli.framework.render import render_place
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.controller.guard.coverage import Chance, Guarantee
    from stlc.grammar.manual import CodeList, Page, RequirementInWords, SpecInWords
    from stlc.monitor.explain.tree import ExplainedViolation, Explanation
    from stlc.monitor.judgement import Verdict


@command(
    "stlc explain E203",
    "stlc explain precedence",
    "stlc explain specs/traffic.stl",
    "stlc explain trace.npz --require give_way",
    "stlc explain latest --guarantee",
)
def explain(
    what: Annotated[
        str | None,
        typer.Argument(metavar="CODE|SPEC|TRACE|RUN", help="A code, precedence, .stl file, trace or run."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="K|TIME", help="For a trace: judge at this sample or time.")
    ] = None,
    guarantee: Annotated[
        bool,
        typer.Option("--guarantee", help="For a run: probability that its backup finds a plan that works."),
    ] = False,
    reading: given.Traces = given.TRACES,
    json: JsonOption = False,
) -> Answer[CodeList | Page | SpecInWords | Explanation | Guarantee]:
    """Explain a code, a specification, or the violations of a trace.

    A code's page has a wrong and a right example; without an argument all codes are listed. `precedence`
    shows how operators bind. A specification is translated into English, requirement by requirement. For a
    trace, each violation is traced back to the sub-formula, the instant, the signal and its value.
    """
    from stlc.controller.explain import explain as explained
    from stlc.grammar.manual import CodeList, Page, SpecInWords

    question = reading.question(at=at)
    options = {each.name: getattr(question, each.name) for each in fields(question)}
    found: Any = explained(what, guarantee=guarantee, runs=reading.runs, **options)
    match found:
        case CodeList():
            return Answer(found, lambda: emit(table(list(found.codes.items()), indent="")))
        case Page():
            return Answer(
                found, lambda: emit("\n".join([found.title, "", *_plain_lines(found.text)]).rstrip())
            )
        case SpecInWords():
            text = "\n\n".join("\n".join(_in_words(each)) for each in found.requirements)
            return Answer(found, lambda: emit(text or f"{found.spec} requires nothing"))
    if guarantee:
        return Answer(found, lambda: emit("\n".join(_guarantee_lines(found))))
    from stlc.cli.commands.check.many import EXIT_CODES, SATISFIED

    verdict: Verdict = found.verdict
    if not json:
        for line in verdict.notes:
            say(line)
        show_diagnostics(verdict.warnings)
    text = "\n\n".join("\n".join(_violation_lines(each, verdict)) for each in found.causes)
    nothing = f"{visible(verdict.about.trace)}: {visible(found.closest)}"
    code = EXIT_CODES.get(verdict.overall, SATISFIED)
    return Answer(found, lambda: emit(text or nothing, styled=True), code, verdict.warnings)


def _in_words(requirement: RequirementInWords) -> Iterator[str]:
    tags = f"  [{', '.join(requirement.tags)}]" if requirement.tags else ""
    yield requirement.name + (" (assumed)" if requirement.kind == "assume" else "") + tags
    yield from (f"  # {line}" for line in requirement.doc.splitlines())
    yield fill(requirement.sentence, 96, initial_indent="  ", subsequent_indent="  ")
    for name, meaning in requirement.where.items():
        yield fill(f"{name}: {meaning}", 96, initial_indent="    where ", subsequent_indent="          ")


def _violation_lines(found: ExplainedViolation, verdict: Verdict) -> Iterator[str]:
    """Lines of output about one violation: the formula in the source, and the tree of causes.

    The tree leads from the requirement to the sub-formulas, instants and signal values that decide its value.
    """
    from stlc.cli.commands.check.text import in_unit

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


def _plain_lines(text: str) -> Iterator[str]:
    """Lines of a manual page as plain text: blocks are indented, and mark-up is removed."""
    inside = False
    for line in text.splitlines():
        if line.startswith("```"):
            inside = not inside
            notes = line.strip("`").split()
            if inside and notes[1:2] in (["wrong"], ["right"]):
                yield f"{notes[1]}:"
                yield ""
        elif inside:
            yield f"    {line}".rstrip()
        else:
            yield line.replace("**", "").removeprefix("## ")


# -------------------------------------------------------------------------- guarantees


def _guarantee_lines(told: Guarantee) -> list[str]:
    run, axes, found = told.run, told.controls, told.chances
    tried = ", ".join(f"{len(axis.values)} of {axis.name} in [{axis.low:g}, {axis.high:g}]" for axis in axes)
    lines = [f"run {run}: the backup policy tries {tried} at every step of a prefix", "", "Suppose that"]
    lines += [fill(each, 96, initial_indent="  - ", subsequent_indent="    ") for each in told.assumptions]
    lines += ["", "Then a prefix of the grid leads to satisfaction with a probability of at least", ""]
    radii = list(dict.fromkeys(each.radius for each in found))
    rows = []
    for length in dict.fromkeys(each.length for each in found):
        group = [each for each in found if each.length == length]
        head = (f"T0={length}", f"{group[0].candidates:,}")
        rows.append((*head, "Theorem 1", *(f"{each.bound:.3g}" for each in group)))
        rows.append(
            ("", "", "at least" if group[0].sampled else "exact", *(f"{each.exact:.3g}" for each in group))
        )
    header = ("", "prefixes", "radius, share of each range", *(f"{radius:.0%}" for radius in radii))
    lines += [table(rows, header=header)]
    lines += ["", *_guarantee_notes(found)]
    return lines


def _guarantee_notes(found: Sequence[Chance]) -> list[str]:
    notes = [
        "Theorem 1 (Meng & Fan 2023) leaves out the cells at the ends of each range, so it is 0 where a "
        "control has two values; `exact` is the share of prefixes that have a grid point within the radius."
    ]
    if any(each.sampled for each in found):
        notes.append(
            "Of a grid that has more prefixes than `samples` as many are tried. `at least` counts one "
            "neighbour of a prefix that works, and that it is tried with the probability of a random sample."
        )
    if any(each.theorem > each.exact + 1e-12 and not each.sampled for each in found):
        notes.append(
            "The paper takes the minimum with 1 over the product of all controls, which promises more than "
            "the truth where one control is covered more than once; here it is taken control by control."
        )
    return [fill(each, 100) for each in notes]
