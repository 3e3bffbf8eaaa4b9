"""A trace that is larger than memory: judged in pieces, in memory that the horizon bounds."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.check.judge import instant_of, laid_reading, monitor_of, specification, usage
from stlc.cli.check.outcome import Outcome
from stlc.cli.check.tallies import Told, outcome_of_tallies
from stlc.files import find_spec, read_source

if TYPE_CHECKING:
    from stlc.cli.check.many import Work

CHUNK = 250_000
"""Samples that are read at a time."""


def outcome_in_chunks(path: Path, work: Work) -> Outcome:
    """Judge a file in pieces.

    Raises:
        UsageError: U101, an option that needs the whole trace.
        TraceError: as `stlc.trace.chunks.pieces`.
    """
    from stlc.monitor.online.online import How
    from stlc.trace.chunks import pieces

    question = work.question
    _require_pieces(path, work)
    begun = time.perf_counter()
    given = None if question.spec is None else monitor_of(read_source(find_spec(question.spec)), question)
    read = pieces(path, work.chunk or CHUNK, laid_reading(given, question))
    first = next(read)
    source, note = specification(str(path), question.spec, first.meta.carried)
    monitor = given or monitor_of(source, question, first.meta.carried)
    at = instant_of(question.at, str(path), first.dt, first.t0, None)
    how = How(at, question.end, question.tolerance, first.t0, reasons=True)
    online = monitor.online(how, require=question.require, like=first)
    online.feed(first)
    for piece in read:
        online.feed(piece)
    told = Told(str(path), source, first.dt, online.samples, work.color)
    return outcome_of_tallies(online, told, (note,) if note else (), time.perf_counter() - begun)


def _require_pieces(path: Path, work: Work) -> None:
    """Refuse what needs all samples at once."""
    question = work.question
    whole = {
        "--resample": question.resample is not None,
        "--max-gap": question.max_gap is not None,
        "--out": work.out is not None,
        "--semantics": question.semantics != "exact",
    }
    advice = "leave out --chunk" if work.chunk else "cut out what is of interest"
    for option, asked in whole.items():
        if asked:
            raise usage(f"`{option}` needs the whole trace, and `{path}` is read in pieces", advice)
