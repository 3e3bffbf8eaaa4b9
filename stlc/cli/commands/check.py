"""`stlc check`: verdicts on recorded traces, per requirement and with reasons."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.certify.text import CertifyOption, bounds_lines, bounds_record, require_claim
from stlc.cli.check import options as given
from stlc.cli.check.judge import End, Work, uncertainties
from stlc.cli.framework.assured import Assurance
from stlc.cli.framework.documents import CheckResult
from stlc.cli.framework.options import (
    SPEC_SUFFIXES,
    STDIN,
    ClusterOption,
    FailUnderOption,
    JsonOption,
    parse_pairs,
    require_no_jobs,
    require_separate,
)
from stlc.cli.framework.output import COLOR, PULSE, QUIET, Answer, emit, say, show_diagnostics, wants_color
from stlc.cli.framework.program import command
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import Diagnostic, UsageError, usage
from stlc.escape import visible
from stlc.files import has_wildcard, matching_traces, real, write_atomic
from stlc.registry import SEMANTICS

if TYPE_CHECKING:
    from stlc.cli.check.evidence import Repetition
    from stlc.cli.check.outcome import Outcome

MOST_SAMPLES = 2**31 - 1
"""Samples of a chunk at most, as readers count them."""


@command(
    "stlc check trace.npz",
    "stlc check specs/traffic.stl drive.csv --require give_way",
    "stlc check specs/traffic.stl drives/*.parquet --jobs 0 --junit checks.xml",
    "stlc check specs/traffic.stl 'logs/**/*.parquet' --cluster auto --table verdicts.parquet",
    "stlc check specs/traffic.stl logs/*.csv --certify .95",
    "stlc check specs/traffic.stl drive.csv --uncertain dx=0.1m --uncertain x=2%",
    "stlc check specs/traffic.stl bag.mcap --resample 0.1s --map dx=lead.gap",
)
def check(
    files: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SPEC] TRACE…",
            help="Traces (.npz, .csv, .parquet, .mat, .mcap, bags of ROS, or -), or patterns of their "
            "names such as 'logs/**/*.csv', after a spec.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="0|all|K|TIME", help="Judge at this sample or time, or at all starts."),
    ] = None,
    end: Annotated[
        End, typer.Option(help="If the trace is too short: bounds, an error, or cut windows.")
    ] = "open",
    semantics: Annotated[
        str,
        typer.Option(
            metavar="NAME", help=f"Reported robustness: {', '.join(SEMANTICS.names)}. Verdicts are exact."
        ),
    ] = "exact",
    tolerance: Annotated[
        float, typer.Option(help="A robustness of at least minus this is satisfied; 0: `>` is not `>=`.")
    ] = TOLERANCE,
    uncertain: Annotated[
        list[str] | None,
        typer.Option(metavar="SIGNAL=ERROR", help="Greatest error of each sample, as x=0.1m or v=2%."),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Times at which signals were not seen are unknown; 4 if a requirement was not fully judged.",
        ),
    ] = False,
    fail_under: FailUnderOption = None,
    certify: CertifyOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the robustness signals there (.npz, .csv, .mcap); a folder for several traces.",
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the verdicts there, as JUnit XML.")
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a row per file and requirement there (.parquet, .csv)."),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=0, help="Number of processes; 0: one per core.")
    ] = 1,
    cluster: ClusterOption = None,
    chunk: Annotated[
        int,
        typer.Option(
            min=0, metavar="SAMPLES", help="Read in chunks of this size; 0: only if the file is large."
        ),
    ] = 0,
    again: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT.json", help="Judge the files of a stored --json result again, and compare."
        ),
    ] = None,
    reading: given.Traces = given.TRACES,
    json: JsonOption = False,
) -> Answer[CheckResult]:
    """Judge recorded traces: verdicts, and the reasons of violations.

    A trace is looked for at the given path, then in the newest run. It is judged by SPEC or --spec, if given.
    Otherwise it is judged by the specification and the constants that it stores. If the trace is -, samples
    come from the standard input, as CSV with a header or as one JSON object per line. A file larger than
    memory is judged in chunks. A file whose process is lost is judged up to three times. A row says which
    part of the recording the requirement could read, unless it is all, and whether anything triggered it.
    Exit code: 0 all satisfied, 1 violated, 4 inconclusive (trace too short), or satisfied without being fully
    judged and --strict, 5 a file is not judged, as its process was lost
    each time; with --certify 0 certified, 1 refuted, 4 undecided; with --again 0 the same result, 1 another;
    with -q nothing is printed.
    """
    from stlc.cli.check.document import document
    from stlc.cli.check.document import junit as junit_xml
    from stlc.cli.check.many import Places, all_outcomes, out_paths
    from stlc.cli.check.outcome import exit_code
    from stlc.cli.check.table import require_table, write_table

    repetition = None if again is None else _repetition(again, files)
    if repetition is None:
        spec, names = _split_files(files or [], reading.spec)
        traces = _expanded(names, [path for path in (table, out) if path is not None])
    else:
        spec, traces = None, repetition.traces
    require_table(table)
    require_no_jobs(cluster, jobs)
    if not 0 <= tolerance < math.inf:
        raise usage(f"`--tolerance {tolerance}` is not a number from 0 on")
    require_claim(certify, fail_under)
    if certify is not None:
        _require_distinct(traces)
    if STDIN in traces:
        _require_alone(traces, certify, out, cluster)
    errors = uncertainties(parse_pairs(uncertain, "--uncertain", "SIGNAL=ERROR", "x=0.1m"))
    if errors and (STDIN in traces or chunk):
        raise usage("`--uncertain` needs the whole trace, and this one is judged in pieces")
    if errors and out is not None:
        raise usage("`--out` writes the robustness of the samples as they are: leave `--uncertain` out")
    question = reading.question(
        spec=spec, at=at, end=end, tolerance=tolerance, semantics=semantics, uncertain=errors, strict=strict
    )
    if repetition is not None:
        question = repetition.question
    paths = out_paths(out, traces)
    written = [("--table", table), ("--junit", junit), *(("--out", path) for path in paths)]
    require_separate(written, (spec, reading.system, *traces))
    talk = not (QUIET.get() or json)
    if STDIN in traces:
        from stlc.cli.check.online import outcome_of_stream

        with PULSE.doing(""):  # waits for samples
            outcomes = [outcome_of_stream(question, talk=talk)]
    else:
        color = wants_color(sys.stdout)
        works = [
            Work(
                *(name, question, reading.runs, path, min(chunk, MOST_SAMPLES), color, COLOR.get()),
                certify=certify is not None,
                table=table is not None,
                evidence=json or again is not None,
            )
            for name, path in zip(traces, paths, strict=True)
        ]
        outcomes = all_outcomes(works, Places(jobs, cluster), PULSE.now)
    if table is not None:
        write_table(table, outcomes)
    if junit is not None:
        write_atomic(junit, junit_xml(outcomes, strict=strict))
    findings = dict.fromkeys(f for outcome in outcomes for f in (*outcome.errors, *outcome.warnings))
    code, record = exit_code(outcomes, fail_under, strict=strict), document(outcomes)
    if certify is not None:
        code = _bounded(record, outcomes, certify, code)
    open_ = dict.fromkeys(row.name for outcome in outcomes for row in outcome.rows if strict and row.unjudged)
    compared: list[str] = []
    if repetition is not None:
        compared = repetition.differences([outcome.entry for outcome in outcomes])
        code, compared = int(bool(compared)), compared or [f"the same result as {visible(str(again))}"]
    show = partial(_print, outcomes, record.get("assurance"), [*open_], compared) if talk else lambda: None
    return Answer(record, show, code, findings)


def _repetition(result: Path, files: Sequence[str] | None) -> Repetition:
    """The stored result that `--again` names. Raises UsageError (U101) if files are named beside it."""
    from stlc.cli.check.evidence import Repetition

    if files:
        raise usage("`--again` judges the files of the stored result", f"stlc check --again {result}")
    return Repetition(result)


def _require_alone(
    traces: Sequence[str], certify: float | None, out: Path | None, cluster: str | None
) -> None:
    """Raise UsageError (U101) if the standard input is not the only trace, or an option does not suit it."""
    if certify is not None:
        raise usage("`--certify` needs several traces, and the standard input is one")
    if out is not None:
        raise usage("`--out` needs the whole trace, and the standard input is judged line by line")
    if len(traces) > 1:
        raise usage("the standard input is judged alone", "stlc check SPEC -")
    if cluster is not None:
        raise usage("`--cluster` is for files, and the standard input is judged here")


def _bounded(record: CheckResult, outcomes: Sequence[Outcome], share: float, code: int) -> int:
    """Add bounds on the share of satisfied traces to the record, and return the exit code.

    The code is that of the answer, or `code` if a file cannot be judged; 4 if no trace is in scope.
    """
    from stlc.cli.certify.traces import assess_outcomes
    from stlc.cli.check.outcome import INCONCLUSIVE, INVALID

    found = assess_outcomes(outcomes, share)
    if found is None:
        return code if code >= INVALID else INCONCLUSIVE
    record["assurance"] = bounds_record(found)
    return code if any(outcome.errors for outcome in outcomes) else found.exit_code


def _print(
    outcomes: Sequence[Outcome],
    assurance: Assurance | None,
    unjudged: Sequence[str],
    compared: Sequence[str],
) -> None:
    """Print remarks, errors and warnings, then the results of the judged files, then bounds, if any.

    `unjudged` are the requirements that `--strict` counts as not fully judged, and `compared` the lines of a
    comparison with a stored result.

    A single result is printed in full. Of several results, those that are not satisfied are printed in full,
    and a summary table follows.
    """
    from stlc.cli.check.many import summary

    shown = set()
    for outcome in outcomes:
        for line in outcome.remarks:
            say(line)
        show_diagnostics(outcome.errors)
        fresh = [warning for warning in outcome.warnings if warning not in shown]
        show_diagnostics(fresh)
        shown.update(fresh)
    if len(outcomes) == 1:
        emit(outcomes[0].text, styled=True)
    else:
        parts = [outcome.text for outcome in outcomes if outcome.text and outcome.status != "satisfied"]
        emit("\n\n".join([*parts, summary(outcomes)]), styled=True)
    if unjudged:
        emit(f"not fully judged (--strict): {', '.join(map(visible, unjudged))}")
    for line in dict.fromkeys(outcome.lint for outcome in outcomes if outcome.lint):
        emit(line)
    if assurance is not None:
        emit("\n".join(["", *bounds_lines(assurance)]))
    for line in compared:
        emit(line)


def _expanded(names: Sequence[str], written: Sequence[Path]) -> list[str]:
    """Replace patterns such as `logs/**/*.csv` by the files that match them, each of which is named once.

    Specifications, and the files and folders in `written`, which the command itself writes, do not match.

    Raises:
        UsageError: U102, no file matches.
    """
    found: list[str] = []
    own = set(map(real, written))
    for name in names:
        if not has_wildcard(name):
            found.append(name)
            continue
        known = set(found)
        for match in matching_traces(name):
            place = real(Path(match))
            places = {place, *place.parents}
            if match not in known and Path(match).suffix not in SPEC_SUFFIXES and own.isdisjoint(places):
                found.append(match)
    if not found:
        raise UsageError(Diagnostic("U102", f"no trace matches `{names[0]}`"))
    return found


def _require_distinct(traces: Sequence[str]) -> None:
    """Check that no recording is named twice, since `--certify` takes recordings as independent.

    Raises:
        UsageError: U101, two names lead to the same file.
    """
    known: dict[Path, str] = {}
    for name in traces:
        place = real(Path(name))
        other = known.get(place)
        if other is not None:
            same = f"`{other}` and `{name}` are the same file"
            message = f"`{name}` is named twice" if other == name else same
            raise usage(f"{message}, and `--certify` counts independent traces", "name each trace once")
        known[place] = name


def _split_files(files: Sequence[str], spec: Path | None) -> tuple[Path | None, list[str]]:
    """Split the arguments `files` into a specification and traces; return (specification or None, traces).

    The specification is the argument that ends with a suffix of specification files, such as `.stl`. If there
    is no such argument, it is `spec`, the value of `--spec`.

    Raises:
        UsageError: U101, there are several specifications, or no trace.
    """
    specs = [name for name in files if Path(name).suffix in SPEC_SUFFIXES]
    traces = [name for name in files if name not in specs]
    if len(specs) > 1 or (specs and spec is not None):
        raise usage(f"more than one specification: {', '.join([*specs, *([str(spec)] if spec else [])])}")
    if not traces:
        raise usage("missing: a trace file", "stlc check SPEC TRACE")
    return (Path(specs[0]) if specs else spec), traces
