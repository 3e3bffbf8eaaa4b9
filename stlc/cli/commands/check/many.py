"""Several traces: judged in parallel, summarised in a table."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from stlc.cli.commands.check.text import WORDS, robustness_of
from stlc.cli.framework.output import table
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import CODES, Diagnostic, MissingError, StlcError, usage
from stlc.escape import operand, visible
from stlc.files import File

if TYPE_CHECKING:
    from stlc.compile.semantics.tolerance import Status
    from stlc.controller.parallel.workers import LostCall
    from stlc.monitor.check import Question
    from stlc.monitor.judgement import RequirementVerdict, Verdict

SATISFIED, VIOLATED, INVALID, INCONCLUSIVE = 0, 1, 3, 4
EXIT_CODES: dict[Status, int] = {
    "satisfied": SATISFIED,
    "violated": VIOLATED,
    "inconclusive": INCONCLUSIVE,
}


@dataclass(frozen=True, slots=True)
class Work:
    """Request to judge one trace file, as sent to a worker process.

    Attributes:
        name: name of the file as given.
        question: options of reading and judging.
        runs: folder of all runs.
        out: file to which the robustness signals are written.
        chunk: samples per chunk; 0: the file is read as a whole if it fits into memory.
        table: whether the times of first violations are looked for.
        words: the options as they were given, if the result says what it was made from; else None.
    """

    name: str
    question: Question
    runs: Path
    out: Path | None = None
    chunk: int = 0
    table: bool = False
    words: Mapping[str, Sequence[str]] | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Verdict on one trace file, or on one object in it, or the reasons for which there is none.

    Attributes:
        name: name of the file, and of the object in it.
        verdict: the verdict, told; None if the file could not be judged.
        seconds: time it took to judge the file.
        errors: reasons for which the file could not be judged.
        exit_code: exit code of the command for these errors; 0 without errors.
        lost: whether the process that judged the file was lost.
    """

    name: str
    verdict: Verdict | None = None
    seconds: float = 0.0
    errors: tuple[Diagnostic, ...] = ()
    exit_code: int = 0
    lost: bool = False

    @property
    def status(self) -> Status:
        """Verdict over all traces and requirements."""
        return "inconclusive" if self.verdict is None else self.verdict.scoped

    @property
    def rows(self) -> tuple[RequirementVerdict, ...]:
        """Verdicts on the requirements."""
        return () if self.verdict is None else self.verdict.requirements

    @property
    def word(self) -> Literal["invalid", "not judged"]:
        """Reason that there is no verdict."""
        return "not judged" if self.lost else "invalid"

    @property
    def file(self) -> str:
        """Name of the file."""
        track = "" if self.verdict is None else self.verdict.about.track
        return self.name.removesuffix(f" ({track})")

    def sharing(self, known: dict[Any, Any]) -> Outcome:
        """Return the outcome with the parts that are equal to those of others, which `known` holds."""
        if (verdict := self.verdict) is None:
            return self
        about, digest = verdict.about, verdict.spec_sha256
        warnings = tuple(known.setdefault(each, each) for each in about.warnings)
        rows = tuple(
            replace(each, rule=known.setdefault((digest, each.rule), each.rule)).knowing(each.cause)
            for each in verdict
        )
        about = replace(about, warnings=warnings, source=known.setdefault(digest, about.source))
        return replace(self, verdict=verdict.but(requirements=rows, about=about))


def exit_code(outcomes: Sequence[Outcome], fail_under: float | None = None, *, strict: bool = False) -> int:
    """Return the exit code: 0 satisfied, 1 violated, 4 inconclusive; other codes if a file cannot be judged.

    With `fail_under`, the code depends on the share of the judged instants at which all requirements hold.
    The code is 0 if this share is at least `fail_under`. It is 1 if the share stays below `fail_under`
    whatever samples follow. It is 4 if this is undecided. With `strict`, it is 4 instead of 0 if a satisfied
    requirement was not fully judged. If a file cannot be judged, its exit code is
    returned, whatever the verdicts of the other files. Traces to which the specification does not apply (out
    of scope) do not count.
    """
    broken = [outcome.exit_code for outcome in outcomes if outcome.errors]
    if broken:
        return max(broken)
    code = _verdict_code(outcomes, fail_under)
    unjudged = any(row.unjudged for outcome in outcomes for row in outcome.rows)
    return INCONCLUSIVE if strict and unjudged and code == SATISFIED else code


def _verdict_code(outcomes: Sequence[Outcome], fail_under: float | None) -> int:
    verdicts = [outcome.verdict for outcome in outcomes if outcome.verdict is not None]
    traces = sum(each.in_scope for each in verdicts)
    if fail_under is not None and traces:
        holds = sum(each.share * each.in_scope for each in verdicts) / traces
        fails = sum(each.failed_share * each.in_scope for each in verdicts) / traces
        return SATISFIED if holds >= fail_under else VIOLATED if 1.0 - fails < fail_under else INCONCLUSIVE
    if fail_under is not None:
        return INCONCLUSIVE
    return EXIT_CODES.get(overall(outcomes), INCONCLUSIVE)


def overall(outcomes: Sequence[Outcome]) -> Status:
    """Return the verdict over all judged files.

    Files to which the specification does not apply do not count.
    """
    found = {outcome.status for outcome in outcomes if not outcome.errors}
    return TOLERANCE.status("violated" in found, found - {"out of scope"} == {"satisfied"})


def all_outcomes(
    works: Sequence[Work],
    jobs: int,
    cluster: str | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> list[Outcome]:
    """Judge all files, and return their outcomes in order.

    If there is only one file and it cannot be judged, its error is raised. If there are several files, errors
    are stored in the outcome of the file. A file whose worker is lost is judged again, `ATTEMPTS` times in
    all; after that its outcome is an error too.

    Args:
        works: the files.
        jobs: number of processes of this machine that judge them; 0: one per core.
        cluster: address of a Ray cluster, instead of this machine; None without one.
        progress: function that receives the progress as text.

    Raises:
        MissingError: R301, R302, R406: the cluster cannot be used.
    """
    if cluster is None and len(works) == 1:
        return outcomes_of(works[0])
    outcomes: list[list[Outcome]] = [[]] * len(works)
    known: dict[Any, Any] = {}
    for done, (index, found_) in enumerate(_judged(works, jobs, cluster), start=1):
        outcomes[index] = [outcome.sharing(known) for outcome in found_]
        progress(f"{done:,} of {len(works):,} files judged")
    return [outcome for each in outcomes for outcome in each]


def _judged(works: Sequence[Work], jobs: int, cluster: str | None) -> Iterator[tuple[int, list[Outcome]]]:
    """Yield the position of each file and the outcomes of its objects when it is judged."""
    processes = min(jobs or os.cpu_count() or 1, len(works))
    if cluster is None and processes == 1:
        yield from enumerate(map(safe_outcomes, works))
        return
    from stlc.controller.parallel import workers_of
    from stlc.controller.parallel.workers import CallFiles, LostCall

    sent = [*works]
    texts: Sequence[Path] = ()
    if cluster is not None:
        from stlc.controller.problem.inputs import input_files

        for index, work in enumerate(works):
            with suppress(StlcError):  # as named if there is no such file
                sent[index] = replace(work, name=str(File(work.name).seen(work.runs)))
        question = works[0].question
        if question.spec is not None:
            texts = input_files(question.spec, question.system, question.overrides)

    def read(work: Work) -> CallFiles:
        return CallFiles((*texts, Path(work.name)), () if work.out is None else (work.out,))

    with workers_of(processes, cluster, files=texts) as workers:
        for ended in workers.results(safe_outcomes, sent, files=read):
            value = ended.value
            yield ended.index, [_lost(works[ended.index], value)] if isinstance(value, LostCall) else value


def _lost(work: Work, lost: LostCall) -> Outcome:
    """Outcome of a file whose worker was lost each time."""
    finding = Diagnostic(
        "R406",
        f"`{work.name}` is not judged: its worker was lost {lost.attempts} times",
        note=(lost.reason,),
        help=("--chunk reads a large file in pieces", f"stlc check … {operand(work.name)} judges it alone"),
    )
    return Outcome(work.name, errors=(finding,), exit_code=MissingError.exit_code, lost=True)


def safe_outcomes(work: Work) -> list[Outcome]:
    """Judge one file and return its outcomes; errors are not raised, but stored in an outcome."""
    try:
        return outcomes_of(work)
    except StlcError as error:
        return [Outcome(work.name, errors=error.diagnostics, exit_code=error.exit_code)]


def outcomes_of(work: Work) -> list[Outcome]:
    """Judge one file and return the outcomes of its objects, usually one. Raises StlcError if that fails."""
    from stlc.monitor.check import judge, too_large, write_robustness

    begun = time.perf_counter()
    path = File(work.name).seen(work.runs)
    notes = () if path == Path(work.name) else (f"taking {path}, of the newest run",)
    if work.out is not None and (work.chunk or too_large(path)):
        advice = "leave out --chunk" if work.chunk else "cut out what is of interest"
        raise usage(f"`--out` needs the whole trace, and `{path}` is read in pieces", advice)
    verdicts = judge(path, work.question, chunk=work.chunk)
    if work.out is not None:
        if len(verdicts) > 1:
            raise usage(f"`--out` writes one trace, and `{path}` holds {len(verdicts)} of different times")
        write_robustness(work.out, verdicts[0], work.question)
    if work.table:
        from stlc.monitor.verdict import timed

        verdicts = [each if each.streamed else timed(each) for each in verdicts]
    told = [each.told() for each in verdicts]
    if work.words is not None:
        from stlc.cli.commands.check.evidence import evidence_of

        evidence = evidence_of(path, work.question, work.words)
        told = [each.but(evidence=evidence) for each in told]
    seconds = (time.perf_counter() - begun) / len(told)
    notes = () if told[0].streamed else notes
    return [
        Outcome(each.about.trace, each.but(notes=(*notes, *each.notes)), seconds=seconds) for each in told
    ]


# -------------------------------------------------------------------------- summary


def summary(outcomes: Sequence[Outcome]) -> str:
    """Text that summarises several files: a line for each file, a line for each requirement, and a total."""
    names = list(dict.fromkeys(row.name for outcome in outcomes for row in outcome.rows))
    head = ("trace", "verdict", "least robustness", "requirement", "where")
    lines = [_line(outcome) for outcome in outcomes]
    satisfied = sum(outcome.status == "satisfied" for outcome in outcomes)
    each = "files" if len({outcome.file for outcome in outcomes}) == len(outcomes) else "objects"
    parts = [f"{satisfied} of {len(outcomes)} {each} satisfy every requirement"]
    lost = sum(outcome.lost for outcome in outcomes)
    broken = sum(bool(outcome.errors) for outcome in outcomes) - lost
    outside = sum(outcome.status == "out of scope" for outcome in outcomes)
    parts += [f"{broken} cannot be judged"] if broken else []
    parts += [f"{lost} not judged"] if lost else []
    parts += [f"{outside} out of scope"] if outside else []
    tables = [table(lines, header=head), _per_requirement(names, outcomes), *_about_recordings(outcomes)]
    return "\n\n".join([*tables, f"{overall(outcomes)}; {', '.join(parts)}"])


def _line(outcome: Outcome) -> tuple[str, ...]:
    if outcome.errors:
        first = outcome.errors[0]
        word = "NOT JUDGED" if outcome.lost else "INVALID"
        return (outcome.name, word, "", "", f"{first.code}: {first.message}")
    worst = _worst(outcome.rows)
    robustness = robustness_of(worst, outcome.verdict)
    return (outcome.name, WORDS[outcome.status], robustness, worst.name, worst.where)


def _worst(rows: Sequence[RequirementVerdict]) -> RequirementVerdict:
    """Return the row of a file's worst requirement; the summary shows this row for the file.

    Violated requirements are worse than inconclusive ones, and inconclusive ones are worse than satisfied
    ones. Among requirements with the same verdict, the one with the least robustness is the worst.
    """
    order = {"violated": 0, "inconclusive": 1, "satisfied": 2, "out of scope": 3}

    def rank(row: RequirementVerdict) -> tuple[int, float]:
        figures = row.figures
        least = figures.low if row.overall == "inconclusive" else figures.min
        return order[row.overall], 0.0 if least is None else least

    return min(rows, key=rank)


_COUNTED = {"W711": "read in part in", "W712": "never triggered in", "": "other facts in"}
"""Code of a fact -> heading of the column that counts the files; "" for all other codes."""


def _per_requirement(names: Sequence[str], outcomes: Sequence[Outcome]) -> str:
    """Table of the number of files in which each requirement is violated, inconclusive, or has facts."""
    columns: list[list[int]] = []
    for name in names:
        rows = [row for outcome in outcomes for row in outcome.rows if row.name == name]
        told = [{f.code if f.code in _COUNTED else "" for f in row.facts} for row in rows]
        counts = [sum(row.overall == status for row in rows) for status in ("violated", "inconclusive")]
        columns.append([*counts, *(sum(code in codes for codes in told) for code in _COUNTED)])
    heads = ["violated in", "inconclusive in", *_COUNTED.values()]
    kept = [i for i in range(len(heads)) if i < 2 or any(counts[i] for counts in columns)]
    lines = [
        (name, *(str(counts[i]) if counts[i] else "" for i in kept))
        for name, counts in zip(names, columns, strict=True)
    ]
    return table(lines, header=("requirement", *(heads[i] for i in kept)))


def _about_recordings(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield a paragraph with the number of files in which each fact about a recording is true, if any is."""
    verdicts = (outcome.verdict for outcome in outcomes if outcome.verdict is not None)
    counts = Counter((fact.code, fact.signal) for verdict in verdicts for fact in verdict.remarks)
    total = f"of {len(outcomes):,} files"
    lines = [
        f"  {f'`{visible(signal)}`: ' if signal else ''}{CODES[code]}, in {count:,} {total}"
        for (code, signal), count in counts.items()
    ]
    if lines:
        yield "\n".join(lines)


def out_paths(out: Path | None, names: Sequence[str]) -> list[Path | None]:
    """Output path of the robustness signals of each trace; None for each if `--out` was not given.

    With several traces, `out` is a folder.

    Raises:
        UsageError: U101, `out` is a file although several traces are judged.
    """
    if out is None:
        return [None] * len(names)
    if len(names) == 1 and not out.is_dir():
        return [out]
    if out.suffix:
        message = f"`--out {out}` is one file, and {len(names)} traces are judged"
        raise usage(message, "name a folder: --out robustness/")
    File(out).require_folder()
    stems = [Path(name).stem for name in names]
    if len(set(stems)) < len(stems):
        stems = [f"{i:04d}-{stem}" for i, stem in enumerate(stems)]
    return [out / f"{stem}.npz" for stem in stems]
