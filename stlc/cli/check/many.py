"""Several traces: judged in parallel, summarised in a table."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stlc.cli.check.judge import Work, found, judge
from stlc.cli.check.outcome import WORDS, Outcome, VerdictRow, overall
from stlc.cli.framework.documents import InvalidTrace
from stlc.cli.framework.output import COLOR, table
from stlc.diagnostics import CODES, Diagnostic, MissingError, StlcError, usage
from stlc.escape import operand, visible
from stlc.files import require_folder

if TYPE_CHECKING:
    from stlc.assurance.certificate import Sample
    from stlc.cli.check.judge import Question
    from stlc.cli.check.outcome import Checked
    from stlc.controller.parallel.workers import LostCall

SMALL = 1_000_000
"""File size in bytes below which the unpacked content always fits into memory."""


@dataclass(frozen=True, slots=True)
class Places:
    """Workers that judge files.

    Attributes:
        jobs: number of processes of this machine; 0: one per core.
        cluster: address of a Ray cluster, instead of this machine; None without one.
    """

    jobs: int = 1
    cluster: str | None = None

    def processes(self, files: int) -> int:
        """Number of processes of this machine for a number of files."""
        return min(self.jobs or os.cpu_count() or 1, files)


def all_outcomes(
    works: Sequence[Work], places: Places, progress: Callable[[str], object] = lambda _: None
) -> list[Outcome]:
    """Judge all files, and return their outcomes in order.

    If there is only one file and it cannot be judged, its error is raised. If there are several files, errors
    are stored in the outcome of the file. A file whose worker is lost is judged again, `ATTEMPTS` times in
    all; after that its outcome is an error too.

    Args:
        works: the files.
        places: workers that judge them.
        progress: function that receives the progress as text.

    Raises:
        MissingError: R301, R302, R406: the cluster cannot be used.
    """
    if places.cluster is None and len(works) == 1:
        return outcomes_of(works[0])
    outcomes: list[list[Outcome]] = [[]] * len(works)
    known: dict[Diagnostic, Diagnostic] = {}
    for done, (index, found_) in enumerate(_judged(works, places), start=1):
        outcomes[index] = []
        for outcome in found_:
            warnings = tuple(known.setdefault(each, each) for each in outcome.warnings)
            shown = outcome.text if outcome.status != "satisfied" or len(works) == 1 else ""
            outcomes[index].append(replace(outcome, warnings=warnings, text=shown))
        progress(f"{done:,} of {len(works):,} files judged")
    return [outcome for each in outcomes for outcome in each]


def _judged(works: Sequence[Work], places: Places) -> Iterator[tuple[int, list[Outcome]]]:
    """Yield the position of each file and the outcomes of its objects when it is judged."""
    if places.cluster is None and places.processes(len(works)) == 1:
        yield from enumerate(map(safe_outcomes, works))
        return
    from stlc.controller.parallel import workers_of
    from stlc.controller.parallel.workers import CallFiles, LostCall, results

    sent: Sequence[Work] = works
    texts: Sequence[Path] = ()
    if places.cluster is not None:
        sent = [replace(work, name=_seen(work)) for work in works]
        texts = _texts(works[0].question)

    def read(work: Work) -> CallFiles:
        return CallFiles((*texts, Path(work.name)), () if work.out is None else (work.out,))

    with workers_of(places.processes(len(works)), places.cluster, files=texts) as workers:
        for ended in results(workers, safe_outcomes, sent, files=read):
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
    entry: InvalidTrace = {"trace": work.name, "verdict": "not judged"}
    return Outcome(work.name, entry, errors=(finding,), exit_code=MissingError.exit_code)


def _seen(work: Work) -> str:
    """Path of a file, which may lie in the newest run; the name as given if there is no such file."""
    with suppress(StlcError):
        return str(found(work.name, work.runs))
    return work.name


def _texts(question: Question) -> Sequence[Path]:
    """Files of the specification and of what it names."""
    from stlc.controller.parallel.inputs import input_files

    spec = question.spec
    return () if spec is None else input_files(spec, question.system, question.overrides)


def safe_outcomes(work: Work) -> list[Outcome]:
    """Judge one file and return its outcomes; errors are not raised, but stored in an outcome."""
    try:
        return outcomes_of(work)
    except StlcError as error:
        entry: InvalidTrace = {"trace": work.name, "verdict": "invalid"}
        return [Outcome(work.name, entry, errors=error.diagnostics, exit_code=error.exit_code)]


def outcomes_of(work: Work) -> list[Outcome]:
    """Judge one file and return the outcomes of its objects, usually one. Raises StlcError if that fails."""
    COLOR.set(work.mode)
    path = found(work.name, work.runs)
    outcomes = _outcomes(path, work)
    if not work.evidence:
        return outcomes
    from stlc.cli.check.evidence import evidence_of

    made: Any = {"evidence": evidence_of(path, work.question)}
    return [replace(each, entry=each.entry | made) for each in outcomes]


def _outcomes(path: Path, work: Work) -> list[Outcome]:
    begun = time.perf_counter()
    if work.chunk or _too_large(path):
        if work.question.uncertain:
            raise usage(f"`--uncertain` needs the whole trace, and {path} does not fit into memory")
        from stlc.cli.check.online import outcome_in_chunks

        outcome = outcome_in_chunks(path, work)
        return [with_sample(outcome) if work.certify else outcome]
    results = judge(work.name, work.question, work.runs)
    if work.out is not None:
        from stlc.cli.check.document import write_robustness

        if len(results) > 1:
            raise usage(f"`--out` writes one trace, and `{path}` holds {len(results)} of different times")
        write_robustness(work.out, results[0], work.question)
    each = (time.perf_counter() - begun) / len(results)
    return [_outcome(result, work, each) for result in results]


def _outcome(result: Checked, work: Work, seconds: float) -> Outcome:
    from stlc.cli.check.document import result_record
    from stlc.cli.check.text import lint_text, result_text, rows_of

    rows = rows_of(result, violated_at=_violated_at(result, work.question) if work.table else {})
    return Outcome(
        name=result.trace.name,
        track=result.trace.track,
        entry=result_record(result, work.question.end),
        status=result.verdict.overall if result.verdict.in_scope else "out of scope",
        rows=rows,
        text=result_text(result, rows, color=work.color),
        traces=result.verdict.in_scope,
        holds=result.verdict.share,
        fails=result.verdict.failed_share,
        seconds=seconds,
        warnings=result.warnings,
        remarks=result.remarks,
        sample=_sample(result) if work.certify else None,
        facts=result.facts_on(""),
        lint=lint_text(result),
    )


def _violated_at(result: Checked, question: Question) -> dict[str, float]:
    """Times in seconds from which violated requirements are certainly violated, by name."""
    from stlc.monitor.verdict import first_violation

    verdict = result.verdict
    samples = {
        judged.name: first_violation(judged, verdict.subject, question.tolerance)
        for judged in verdict
        if judged.overall == "violated"
    }
    return {name: verdict.subject.time(sample) for name, sample in samples.items()}


def _sample(result: Checked) -> Sample | None:
    from stlc.cli.certify.traces import sample_of_verdict

    return sample_of_verdict(result)


def with_sample(outcome: Outcome) -> Outcome:
    """Return the outcome of a trace that was judged in chunks with its observation for bounds."""
    from stlc.cli.certify.traces import sample_of_rows

    return replace(outcome, sample=sample_of_rows(outcome.rows))


def _too_large(path: Path) -> bool:
    """True if the unpacked content of a file is too large for memory; the file is then read in chunks.

    A file of less than `SMALL` bytes is never too large, however well it is compressed.
    """
    if path.stat().st_size < SMALL:
        return False
    from stlc.trace.chunks import LARGE, size_of

    return size_of(path) > LARGE


# -------------------------------------------------------------------------- summary


def summary(outcomes: Sequence[Outcome]) -> str:
    """Text that summarises several files: a line for each file, a line for each requirement, and a total."""
    names = list(dict.fromkeys(row.name for outcome in outcomes for row in outcome.rows))
    head = ("trace", "verdict", "least robustness", "requirement", "where")
    lines = [_line(outcome) for outcome in outcomes]
    satisfied = sum(outcome.status == "satisfied" for outcome in outcomes)
    each = "files" if len({outcome.file for outcome in outcomes}) == len(outcomes) else "objects"
    parts = [f"{satisfied} of {len(outcomes)} {each} satisfy every requirement"]
    lost = sum(outcome.entry["verdict"] == "not judged" for outcome in outcomes)
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
        word = "NOT JUDGED" if outcome.entry["verdict"] == "not judged" else "INVALID"
        return (outcome.name, word, "", "", f"{first.code}: {first.message}")
    if not outcome.rows:
        return (outcome.name, WORDS[outcome.status])
    worst = _worst(outcome.rows)
    return (outcome.name, WORDS[outcome.status], worst.robustness, worst.name, worst.where)


def _worst(rows: Sequence[VerdictRow]) -> VerdictRow:
    """Return the row of a file's worst requirement; the summary shows this row for the file.

    Violated requirements are worse than inconclusive ones, and inconclusive ones are worse than satisfied
    ones. Among requirements with the same verdict, the one with the least robustness is the worst.
    """
    order = {"violated": 0, "inconclusive": 1, "satisfied": 2, "out of scope": 3}
    return min(rows, key=lambda row: (order[row.status], row.least))


_COUNTED = {"W711": "read in part in", "W712": "never triggered in", "": "other facts in"}
"""Code of a fact -> heading of the column that counts the files; "" for all other codes."""


def _per_requirement(names: Sequence[str], outcomes: Sequence[Outcome]) -> str:
    """Table of the number of files in which each requirement is violated, inconclusive, or has facts."""
    columns: list[list[int]] = []
    for name in names:
        rows = [row for outcome in outcomes for row in outcome.rows if row.name == name]
        told = [{f.code if f.code in _COUNTED else "" for f in row.facts} for row in rows]
        counts = [sum(row.status == status for row in rows) for status in ("violated", "inconclusive")]
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
    counts = Counter((fact.code, fact.signal) for outcome in outcomes for fact in outcome.facts)
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
    require_folder(out)
    stems = [Path(name).stem for name in names]
    if len(set(stems)) < len(stems):
        stems = [f"{i:04d}-{stem}" for i, stem in enumerate(stems)]
    return [out / f"{stem}.npz" for stem in stems]
