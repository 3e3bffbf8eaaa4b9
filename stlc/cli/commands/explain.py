"""`stlc explain`: an error code, the precedence of operators, a specification, or a trace's violations."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.check import options as given
from stlc.cli.framework.options import SPEC_SUFFIXES, STDIN, JsonOption, parse_overrides
from stlc.cli.framework.output import Answer, emit, table
from stlc.cli.framework.program import command
from stlc.diagnostics import CODES, usage
from stlc.registry import did_you_mean

if TYPE_CHECKING:
    from stlc.cli.framework.manual import CodeList, Page, RequirementInWords, SpecInWords
    from stlc.controller.guard.coverage import Chance, Guarantee
    from stlc.monitor.explain.tree import Explanation

_CODE = re.compile(r"[A-Za-z]\d{3}")


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
    if guarantee:
        return _guarantee(what or "latest", reading.runs, parse_overrides(reading.set_))
    from stlc.cli.framework.manual import CodeList, read_page

    if what is None:
        return Answer(CodeList(dict(CODES)), lambda: emit(table(list(CODES.items()), indent="")))
    if _CODE.fullmatch(what):
        what = what.upper()
        if what not in CODES:
            advice = did_you_mean(what, CODES, "stlc explain  lists the codes")
            raise usage(f"there is no code `{what}`", *advice)
    page = read_page(what) if what in CODES or what == "precedence" else None
    if page is not None:
        shown = "\n".join([page.title, "", *_plain_lines(page.text)]).rstrip()
        return Answer(page, lambda: emit(shown))
    if what == STDIN or Path(what).suffix in SPEC_SUFFIXES:
        return _spec(what, reading.require or [])
    from stlc.cli.check.causes import explain_trace
    from stlc.files import has_wildcard
    from stlc.rundir import recorded_trace

    trace = what if has_wildcard(what) else str(recorded_trace(what, reading.runs))
    return explain_trace(trace, reading.question(at=at), reading.runs, talk=not json)


def _spec(name: str, wanted: list[str]) -> Answer[SpecInWords]:
    """Translate requirements of a specification into English: those in `wanted`, or all if it is empty."""
    from stlc.cli.framework.manual import in_words
    from stlc.files import find_spec, read_source
    from stlc.grammar.parser import parse

    found = in_words(parse(read_source(find_spec(name))), name, wanted)
    text = "\n\n".join("\n".join(_in_words(each)) for each in found.requirements)
    return Answer(found, lambda: emit(text or f"{name} requires nothing"))


def _in_words(requirement: RequirementInWords) -> Iterator[str]:
    tags = f"  [{', '.join(requirement.tags)}]" if requirement.tags else ""
    yield requirement.name + (" (assumed)" if requirement.kind == "assume" else "") + tags
    yield from (f"  # {line}" for line in requirement.doc.splitlines())
    yield fill(requirement.sentence, 96, initial_indent="  ", subsequent_indent="  ")
    for name, meaning in requirement.where.items():
        yield fill(f"{name}: {meaning}", 96, initial_indent="    where ", subsequent_indent="          ")


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


def _guarantee(run: str, runs: Path, overrides: Mapping[str, str]) -> Answer[Guarantee]:
    """Compute lower bounds on the probability that the backup policy of a run finds a satisfying plan.

    The backup policy tries many candidates for the first steps of a plan (its prefix); the candidates form a
    grid. The main assumption is that some unknown prefix leads to a satisfying plan, and so do all prefixes
    within a given radius of it. There is one bound for each length of the prefix and each radius. The
    returned record lists all assumptions. `runs` is the folder of all runs, and `overrides` gives new values
    of constants.
    """
    from stlc.controller.guard.coverage import guarantee
    from stlc.controller.run.run import task_of_run
    from stlc.rundir import RunDir

    folder = RunDir.open(run, runs)
    found = guarantee(folder.name, task_of_run(folder, overrides))
    return Answer(found, lambda: emit("\n".join(_guarantee_lines(found))))


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
