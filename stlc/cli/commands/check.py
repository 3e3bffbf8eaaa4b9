"""`stlc check`: verdicts on recorded traces, per requirement and with reasons."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stlc.cli.check import options as given
from stlc.cli.check.judge import Question, Work, usage
from stlc.cli.framework.options import FailUnderOption, JsonOption
from stlc.cli.framework.output import COLOR, PULSE, QUIET, emit, emit_json, say, show_diagnostics, wants_color
from stlc.cli.framework.program import command

if TYPE_CHECKING:
    from stlc.cli.check.outcome import Outcome

_SPECS = (".stl", ".stlc")
_STREAM = "-"


@command(
    "stlc check trace.npz",
    "stlc check specs/traffic.stl drive.csv --require give_way",
    "stlc check specs/traffic.stl drives/*.parquet --jobs 0 --junit checks.xml",
    "stlc check specs/traffic.stl bag.mcap --resample 0.1s --map dx=lead.gap",
)
def check(
    files: given.Files,
    at: given.When = None,
    end: given.Ending = "open",
    semantics: given.Robustness = "exact",
    tolerance: given.Tolerance = 1e-6,
    fail_under: FailUnderOption = None,
    out: given.Out = None,
    junit: given.Junit = None,
    jobs: given.Jobs = 1,
    chunk: given.Chunk = 0,
    reading: given.Traces = given.TRACES,
    json: JsonOption = False,
) -> None:
    """Judge recorded traces: verdicts, and the reasons of violations.

    A trace is searched as given, then in the newest run. It is judged by the specification stored in it, with
    its constants, unless a specification precedes it or --spec is given. With - the samples come from the
    standard input, as CSV with a header or as one JSON object per line. A file larger than memory is judged
    in chunks. Exit code: 0 all satisfied, 1 violated, 4 inconclusive (trace too short); with -q nothing is
    printed.
    """
    from stlc.cli.check.many import all_outcomes, out_paths
    from stlc.cli.check.outcome import exit_code

    spec, traces = _split_files(files, reading.spec)
    question = reading.question(
        spec=spec, at=at, end=end, tolerance=_tolerance(tolerance), semantics=semantics
    )
    talk = not (QUIET.get() or json)
    if _STREAM in traces:
        if out is not None:
            raise usage("`--out` needs the whole trace, and the standard input is judged line by line")
        outcomes = [_stream(traces, question, talk=talk)]
    else:
        color, paths = wants_color(sys.stdout), out_paths(out, traces)
        works = [
            Work(name, question, reading.runs, path, chunk, color, COLOR.get())
            for name, path in zip(traces, paths, strict=True)
        ]
        outcomes = list(all_outcomes(works, jobs))
    code = exit_code(outcomes, fail_under)
    if junit is not None:
        _write_junit(junit, outcomes)
    if json:
        _print_document(outcomes, code)
    elif talk:
        _print(outcomes)
    raise typer.Exit(code)


def _stream(traces: Sequence[str], question: Question, *, talk: bool) -> Outcome:
    from stlc.cli.check.online import outcome_of_stream

    if len(traces) > 1:
        raise usage("the standard input is judged alone", "stlc check SPEC -")
    with PULSE.doing(""):  # waits for samples
        return outcome_of_stream(question, talk=talk)


# -------------------------------------------------------------------------- results


def _print(outcomes: Sequence[Outcome]) -> None:
    """Print remarks, unsatisfied results in full, and a table if there are several files."""
    from stlc.cli.check.many import summary

    told = set()
    for outcome in outcomes:
        for line in outcome.said:
            say(line)
        show_diagnostics(outcome.errors)
        fresh = [warning for warning in outcome.warnings if warning not in told]
        show_diagnostics(fresh)
        told.update(fresh)
    if len(outcomes) == 1:
        emit(outcomes[0].text, styled=True)
        return
    parts = [outcome.text for outcome in outcomes if outcome.text and outcome.status != "satisfied"]
    emit("\n\n".join([*parts, summary(outcomes)]), styled=True)


def _print_document(outcomes: Sequence[Outcome], code: int) -> None:
    from stlc.cli.check.document import document

    findings = [f for outcome in outcomes for f in (*outcome.errors, *outcome.warnings)]
    emit_json(
        "check/1",
        ok=code == 0,
        exit_code=code,
        diagnostics=dict.fromkeys(findings),
        result=document(outcomes),
    )


def _write_junit(path: Path, outcomes: Sequence[Outcome]) -> None:
    from stlc.cli.check.document import junit
    from stlc.files import write_atomic

    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, junit(outcomes))


# ------------------------------------------------------------------------ arguments


def _split_files(files: Sequence[str], spec: Path | None) -> tuple[Path | None, list[str]]:
    """The specification, if the first file is one, and the traces."""
    specs = [name for name in files if Path(name).suffix in _SPECS]
    traces = [name for name in files if name not in specs]
    if len(specs) > 1 or (specs and spec is not None):
        raise usage(f"more than one specification: {', '.join([*specs, *([str(spec)] if spec else [])])}")
    if not traces:
        raise usage("which trace?", "stlc check SPEC TRACE")
    return (Path(specs[0]) if specs else spec), traces


def _tolerance(value: float) -> float:
    if not 0 <= value < math.inf:
        raise usage(f"`--tolerance {value}` is not a number from 0 on")
    return value
