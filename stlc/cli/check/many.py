"""Several traces: judged in parallel, summarised in a table."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.check.judge import Work, found, judge
from stlc.cli.check.outcome import WORDS, Outcome, VerdictRow, overall
from stlc.cli.framework.documents import InvalidTrace
from stlc.cli.framework.output import COLOR, table
from stlc.diagnostics import StlcError, usage
from stlc.stopping import leaving

if TYPE_CHECKING:
    from stlc.assurance.certificate import Sample
    from stlc.cli.check.outcome import Checked

SMALL = 1_000_000
"""File size in bytes below which the unpacked content always fits into memory."""


def all_outcomes(works: Sequence[Work], jobs: int) -> Iterator[Outcome]:
    """Yield the outcomes of all files in order, computed by `jobs` processes (0: one per core).

    If there is only one file and it cannot be judged, its error is raised. If there are several files, errors
    are stored in the outcome of the file.
    """
    if len(works) == 1:
        yield outcome_of(works[0])
    elif jobs == 1:
        yield from map(safe_outcome, works)
    else:
        from concurrent.futures import ProcessPoolExecutor

        with ProcessPoolExecutor(min(jobs or os.cpu_count() or 1, len(works))) as pool, leaving(_end_all):
            try:
                yield from pool.map(safe_outcome, works, chunksize=max(len(works) // 64, 1))
            except (KeyboardInterrupt, SystemExit):
                _end_all()
                raise


def _end_all(_code: int = 0) -> None:
    """Kill all worker processes after an interruption."""
    for process in multiprocessing.active_children():
        process.kill()


def safe_outcome(work: Work) -> Outcome:
    """Judge one file and return its outcome; errors are not raised, but stored in the outcome."""
    try:
        return outcome_of(work)
    except StlcError as error:
        entry: InvalidTrace = {"trace": work.name, "verdict": "invalid"}
        return Outcome(work.name, entry, errors=error.diagnostics, exit_code=error.exit_code)


def outcome_of(work: Work) -> Outcome:
    """Judge one file and return its outcome. Raises StlcError if that fails."""
    from stlc.cli.check.document import result_record
    from stlc.cli.check.text import result_text, rows_of

    COLOR.set(work.mode)
    begun = time.perf_counter()
    path = found(work.name, work.runs)
    if work.chunk or _too_large(path):
        if work.question.uncertain:
            raise usage(f"`--uncertain` needs the whole trace, and {path} does not fit into memory")
        from stlc.cli.check.online import outcome_in_chunks

        return with_sample(outcome_in_chunks(path, work)) if work.certify else outcome_in_chunks(path, work)
    result = judge(work.name, work.question, work.runs)
    if work.out is not None:
        from stlc.cli.check.document import write_robustness

        write_robustness(work.out, result, work.question)
    rows = rows_of(result)
    return Outcome(
        name=str(path),
        entry=result_record(result, work.question.end),
        status=result.verdict.overall if result.verdict.in_scope else "out of scope",
        rows=rows,
        text=result_text(result, rows, color=work.color),
        traces=result.verdict.in_scope,
        holds=result.verdict.share,
        fails=result.verdict.failed_share,
        seconds=time.perf_counter() - begun,
        warnings=result.warnings,
        remarks=result.remarks,
        sample=_sample(result) if work.certify else None,
    )


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
    parts = [f"{satisfied} of {len(outcomes)} files satisfy every requirement"]
    broken = sum(bool(outcome.errors) for outcome in outcomes)
    outside = sum(outcome.status == "out of scope" for outcome in outcomes)
    parts += [f"{broken} cannot be judged"] if broken else []
    parts += [f"{outside} out of scope"] if outside else []
    each = [_per_requirement(name, outcomes) for name in names]
    tables = [
        table(lines, header=head),
        table(each, header=("requirement", "violated in", "inconclusive in")),
    ]
    return "\n\n".join([*tables, f"{overall(outcomes)}; {', '.join(parts)}"])


def _line(outcome: Outcome) -> tuple[str, ...]:
    if outcome.errors:
        first = outcome.errors[0]
        return (outcome.name, "INVALID", "", "", f"{first.code}: {first.message}")
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


def _per_requirement(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    rows = [row for outcome in outcomes for row in outcome.rows if row.name == name]
    counts = [sum(row.status == status for row in rows) for status in ("violated", "inconclusive")]
    return (name, *(str(count) if count else "" for count in counts))


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
    stems = [Path(name).stem for name in names]
    if len(set(stems)) < len(stems):
        stems = [f"{i:04d}-{stem}" for i, stem in enumerate(stems)]
    return [out / f"{stem}.npz" for stem in stems]
