"""`stlc check`: verdicts on recorded traces, per requirement and with reasons."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from stlc.activity import PULSE
from stlc.cli.commands.check import options as given
from stlc.cli.framework.options import FailUnderOption, JsonOption, require_separate
from stlc.cli.framework.output import QUIET, Answer, emit, say, show_diagnostics, wants_color
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.escape import visible
from stlc.files import File
from stlc.jsontext import plain
from stlc.options import Options

if TYPE_CHECKING:
    from io import BufferedReader

    from stlc.assurance.certificate import Assessment, BoundedVerdict, JudgedFiles, Unjudged
    from stlc.cli.commands.check.many import Outcome
    from stlc.monitor.check import Question
    from stlc.monitor.judgement import Verdict
    from stlc.monitor.online.online import Decision, Online

NAME = "standard input"
MOST_SAMPLES = 2**31 - 1
"""Samples of a chunk at most, as readers count them."""
CertifyOption = Annotated[
    float | None,
    typer.Option(
        "--certify",
        metavar="SHARE",
        help="Bound the share that satisfies everything, with 95 % confidence; the exit code says whether it "
        "is at least SHARE.",
    ),
]


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
    cluster: Options.Cluster = None,
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
    judging: given.Judging = given.JUDGING,
    json: JsonOption = False,
) -> Answer[Verdict | BoundedVerdict | JudgedFiles]:
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
    from stlc.cli.commands.check.many import Work, all_outcomes, exit_code, out_paths

    if again is None:
        repetition = None
        spec, names = _split_files(files or [], judging.spec)
        traces = _expanded(names, [path for path in (table, out) if path is not None])
        judging = replace(judging, spec=spec)
    else:
        from stlc.cli.commands.check.evidence import Repetition

        if files:
            raise usage("`--again` judges the files of the stored result", f"stlc check --again {again}")
        repetition = Repetition(again)
        spec, traces, judging = None, repetition.traces, repetition.options
    if table is not None:
        from stlc.cli.commands.check.table import require_table, write_table

        require_table(table)
    Options.require_no_jobs(cluster, jobs)
    question = judging.question()
    if certify is not None:
        from stlc.cli.commands.certify.text import require_claim

        require_claim(certify, fail_under)
        _require_distinct(traces)
    if File.STDIN in traces:
        _require_alone(traces, certify, out, cluster)
    if question.uncertain and (File.STDIN in traces or chunk):
        raise usage("`--uncertain` needs the whole trace, and this one is judged in pieces")
    if question.uncertain and out is not None:
        raise usage("`--out` writes the robustness of the samples as they are: leave `--uncertain` out")
    paths = out_paths(out, traces)
    written = [("--table", table), ("--junit", junit), *(("--out", path) for path in paths)]
    require_separate(written, (spec, judging.system, *traces))
    talk = not (QUIET.get() or json)
    if File.STDIN in traces:
        with PULSE.doing(""):  # waits for samples
            outcomes = [_of_stream(question, talk=talk)]
    else:
        words = judging.words() if json or again is not None else None
        works = [
            Work(name, question, judging.runs, path, min(chunk, MOST_SAMPLES), table is not None, words)
            for name, path in zip(traces, paths, strict=True)
        ]
        outcomes = all_outcomes(works, jobs, cluster, PULSE.now)
    if table is not None:
        write_table(table, outcomes)
    if junit is not None:
        from stlc.cli.commands.check.junit import junit as junit_xml

        File(junit).write(junit_xml(outcomes, strict=question.strict))
    verdicts = [outcome.verdict for outcome in outcomes if outcome.verdict is not None]
    findings = [finding for outcome in outcomes for finding in outcome.errors]
    findings += [finding for verdict in verdicts for finding in verdict.warnings]
    code, assurance = exit_code(outcomes, fail_under, strict=question.strict), None
    if certify is not None:
        code, assurance = _bounded(outcomes, certify, code)
    record = _record(outcomes, assurance)
    open_ = dict.fromkeys(row.name for v in verdicts for row in v if question.strict and row.unjudged)
    compared: list[str] = []
    if repetition is not None:
        compared = repetition.differences([*map(plain, _entries(outcomes))])
        code, compared = int(bool(compared)), compared or [f"the same result as {visible(str(again))}"]
    show = partial(_print, outcomes, assurance, [*open_], compared, judging.replay) if talk else lambda: None
    return Answer(record, show, code, dict.fromkeys(findings))


def _record(
    outcomes: Sequence[Outcome], assurance: Assessment | None
) -> Verdict | BoundedVerdict | JudgedFiles:
    """Result of the command: for one file its verdict, else all verdicts; with bounds, if there are any."""
    only = outcomes[0].verdict if len(outcomes) == 1 else None
    if only is not None and assurance is None:
        return only
    from stlc.assurance.certificate import BoundedVerdict, JudgedFiles
    from stlc.cli.commands.check.many import overall

    if only is None or assurance is None:
        return JudgedFiles(overall(outcomes), tuple(_entries(outcomes)), assurance)
    return BoundedVerdict.of(only, assurance)


def _entries(outcomes: Sequence[Outcome]) -> list[Verdict | Unjudged]:
    from stlc.assurance.certificate import Unjudged

    return [each.verdict or Unjudged(each.name, each.word) for each in outcomes]


def _of_stream(question: Question, *, talk: bool) -> Outcome:
    """Judge the standard input; with `talk`, print each verdict as soon as it is decided.

    Raises:
        UsageError: U101, there is no specification, or an option needs the whole trace.
        TraceError: a line is not a sample, or signals are missing or not finite.
    """
    from stlc.cli.commands.check.many import Outcome
    from stlc.monitor.check import judge_lines
    from stlc.trace.live import PIECE

    begun = time.perf_counter()
    lines = cast("BufferedReader", sys.stdin.buffer)
    pieces = iter(lambda: lines.read1(PIECE), b"")  # what has come, at least a byte
    verdict = judge_lines(pieces, question, NAME, _tell if talk else None)
    return Outcome(NAME, verdict, time.perf_counter() - begun)


def _tell(decision: Decision, online: Online) -> None:
    """Print the verdict `decision`, which the monitor `online` has just reached.

    For a requirement that is judged at many instants, only violations are printed.
    """
    from stlc.cli.commands.check.text import WORDS, in_unit, signed

    asked = online.requirement(decision.requirement)
    if decision.status == "satisfied" and asked.everywhere:
        return
    low, high = online.bounds(decision.requirement, decision.start)
    bounds = signed(low) if low == high else f"[{signed(low)}, {signed(high)}]"
    value = in_unit(bounds, asked.rule.unit)
    judged = f", judged from t = {decision.time:.10g} s" if asked.everywhere else ""
    now = f"t = {online.time(decision.sample):.10g} s"
    emit(f"{now}  {visible(decision.requirement)}  {WORDS[decision.status]}  {value}{judged}")


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


def _bounded(outcomes: Sequence[Outcome], share: float, code: int) -> tuple[int, Assessment | None]:
    """Return the exit code, and bounds on the share of satisfied traces, if a trace is in scope.

    The code is that of the answer, or `code` if a file cannot be judged; 4 if no trace is in scope.
    """
    from stlc.assurance.certificate import Claim, joined, sample_of_traces
    from stlc.cli.commands.check.many import INCONCLUSIVE, INVALID

    samples = [sample for each in outcomes if each.verdict and (sample := sample_of_traces(each.verdict))]
    if not samples:
        return (code if code >= INVALID else INCONCLUSIVE), None
    try:
        found = joined(samples).assess(Claim(share))
    except ValueError as error:
        raise usage(f"`--certify`: {error}", "--spec SPEC judges all traces by one specification") from None
    return (code if any(outcome.errors for outcome in outcomes) else found.exit_code), found


def _print(
    outcomes: Sequence[Outcome],
    assurance: Assessment | None,
    unjudged: Sequence[str],
    compared: Sequence[str],
    replay: Sequence[str],
) -> None:
    """Print remarks, errors and warnings, then the results of the judged files, then bounds, if any.

    `unjudged` are the requirements that `--strict` counts as not fully judged, `compared` the lines of a
    comparison with a stored result, and `replay` the words of a command line that reads the same trace.

    A single result is printed in full. Of several results, those that are not satisfied are printed in full,
    and a summary table follows.
    """
    from stlc.cli.commands.check.many import summary
    from stlc.cli.commands.check.text import lint_text, verdict_text

    shown, color, parts = set(), wants_color(sys.stdout), []
    for outcome in outcomes:
        verdict = outcome.verdict
        for line in () if verdict is None else verdict.notes:
            say(line)
        show_diagnostics(outcome.errors)
        fresh = [] if verdict is None else [each for each in verdict.warnings if each not in shown]
        show_diagnostics(fresh)
        shown.update(fresh)
        if verdict is not None and (len(outcomes) == 1 or verdict.scoped != "satisfied"):
            parts.append(verdict_text(verdict, replay, color=color))
    emit("\n\n".join([*parts, *([summary(outcomes)] if len(outcomes) > 1 else [])]), styled=True)
    if unjudged:
        emit(f"not fully judged (--strict): {', '.join(map(visible, unjudged))}")
    for line in dict.fromkeys(lint_text(each.verdict) for each in outcomes if each.verdict is not None):
        if line:
            emit(line)
    if assurance is not None:
        from stlc.cli.commands.certify.text import bounds_lines

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
    own = {File(path).real for path in written}
    for name in names:
        if not File(name).is_pattern:
            found.append(name)
            continue
        known = set(found)
        for match in File(name).matches():
            place = File(match).real
            places = {place, *place.parents}
            if match not in known and not File(match).is_spec and own.isdisjoint(places):
                found.append(match)
    if not found:
        raise usage(f"no trace matches `{names[0]}`", code="U102")
    return found


def _require_distinct(traces: Sequence[str]) -> None:
    """Check that no recording is named twice, since `--certify` takes recordings as independent.

    Raises:
        UsageError: U101, two names lead to the same file.
    """
    known: dict[Path, str] = {}
    for name in traces:
        place = File(name).real
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
    specs = [name for name in files if File(name).is_spec]
    traces = [name for name in files if name not in specs]
    if len(specs) > 1 or (specs and spec is not None):
        raise usage(f"more than one specification: {', '.join([*specs, *([str(spec)] if spec else [])])}")
    if not traces:
        raise usage("missing: a trace file", "stlc check SPEC TRACE")
    return (Path(specs[0]) if specs else spec), traces
