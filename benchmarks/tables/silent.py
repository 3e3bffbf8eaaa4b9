"""Mistakes that pass in silence: seeded mistakes of 35 kinds, and warnings about correct files.

In each case a requirement is violated as meant, and satisfied when the files with the mistake are read
literally. The mistake is noticed if the verdict is another one, or if a remark names its place that the
files without it do not get.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.answers import ask, noticed, rtamt_notices
from benchmarks.correct import hard, ordinary
from benchmarks.mistakes import KINDS, Files, Kind, Mistaken
from benchmarks.options import Output
from benchmarks.requirements import robustness
from benchmarks.scenes import situations
from benchmarks.table import Columns, Table, measured_here, publish
from stlc.cli.framework.program import command

CASES, ORDINARY, HARD = 30, 500, 200
_TRIES = 400
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class SilentRow:
    """Cases of one kind of mistake.

    Attributes:
        kind: the kind.
        at: where the mistake lies.
        cases: number of cases.
        silent: cases that stlc does not notice.
        rtamt: cases that RTAMT does not notice; None if the mistake cannot be made with it.
        seeds: numbers of the cases that stlc does not notice.
    """

    kind: str
    at: str
    cases: int
    silent: int
    rtamt: int | None
    seeds: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """Correct files about which stlc warns.

    Attributes:
        files: "ordinary" or "hard".
        cases: number of pairs of a specification and a recording.
        alarms: pairs about which there is a warning or an error.
        codes: the codes of these.
    """

    files: str
    cases: int
    alarms: int
    codes: tuple[str, ...]


COLUMNS: Columns[SilentRow] = {
    **{"kind of mistake": "{kind}", "in the": "{at}", "cases": "{cases}", "silent": "{silent}"},
    "RTAMT": lambda row: "-" if row.rtamt is None else str(row.rtamt),
}
ALARMS: Columns[AlarmRow] = {
    **{"correct files": "{files}", "cases": "{cases}", "warnings on": "{alarms}"},
    "codes": lambda row: ", ".join(row.codes),
}


@command("python -m benchmarks silent", "python -m benchmarks silent --cases 2 --correct 20 --json")
def silent(
    cases: Annotated[int, typer.Option("--cases", metavar="N", min=1, help="Cases of each kind.")] = CASES,
    correct: Annotated[
        int, typer.Option("--correct", metavar="N", min=0, help="Ordinary correct files; hard ones: 2 of 5.")
    ] = ORDINARY,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of all cases.")] = 0,
    output: Output = _OUTPUT,
) -> None:
    """Count the seeded mistakes that stlc and RTAMT do not notice, and the warnings about correct files."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        found = Table(
            "silent", KINDS, lambda kind: measure(kind, cases, seed, folder), COLUMNS, "{kind}: {silent}"
        )
        alarms = Table(
            "alarms",
            (("ordinary", correct), ("hard", correct * HARD // ORDINARY)),
            lambda cell: alarm(*cell, seed, folder),
            ALARMS,
        )
        tables: dict[str, Table[Any, Any]] = {"mistakes": found, "correct": alarms}
        publish("silent", output, lambda: _section(found, alarms, cases, seed), tables, seed=seed)


def measure(kind: Kind, count: int, seed: int, folder: Path) -> SilentRow:
    """Return how many of `count` mistakes of a kind pass in silence; files are written into `folder`."""
    passed: list[int] = []
    peer = 0
    cases = 0
    for number, case in enumerate(mistaken(kind, count, seed)):
        cases += 1
        if not noticed(ask(case.files, folder), ask(case.right, folder), case.place):
            passed.append(number)
        peer += case.rtamt and not rtamt_notices(case.read)
        can = case.rtamt
    return SilentRow(kind.name, kind.at, cases, len(passed), peer if cases and can else None, tuple(passed))


def mistaken(kind: Kind, count: int, seed: int) -> Iterator[Mistaken]:
    """Yield up to `count` mistakes of a kind after which the requirement is satisfied when read literally."""
    rng = np.random.default_rng([seed, *kind.name.encode()])
    found = 0
    for _, situation in zip(range(_TRIES * count), situations(rng, *kind.shapes), strict=False):
        case = kind.make(rng, situation)
        if case is None:
            continue
        read = case.read
        if len(next(iter(read.data.values()))) > 1 and robustness(read.formula, read.data, read.dt)[0] >= 0:
            yield case
            found += 1
        if found == count:
            return


def alarm(name: str, count: int, seed: int, folder: Path) -> AlarmRow:
    """Return how many of `count` correct pairs get a warning."""
    rng = np.random.default_rng([seed, *name.encode()])
    pairs: Iterator[Files] = ordinary(rng, count) if name == "ordinary" else hard(rng, count)
    told = [sorted({remark.code for remark in ask(pair, folder).warnings}) for pair in pairs]
    return AlarmRow(
        name, count, sum(map(bool, told)), tuple(sorted({code for codes in told for code in codes}))
    )


def _section(
    found: Table[Kind, SilentRow], alarms: Table[Any, AlarmRow], cases: int, seed: int
) -> Iterator[str]:
    rows = found.rows
    made, silent_ = sum(row.cases for row in rows), sum(row.silent for row in rows)
    with_peer = [row for row in rows if row.rtamt is not None]
    peer, of = sum(row.rtamt or 0 for row in with_peer), sum(row.cases for row in with_peer)
    both = sum(row.silent for row in with_peer)
    yield (
        f"**{silent_:,} of {made:,} mistakes ({silent_ / made:.0%}) pass stlc in silence.** "
        f"RTAMT can be given {of:,} of them: {both:,} ({both / of:.0%}) pass stlc, "
        f"{peer:,} ({peer / of:.0%}) pass RTAMT."
    )
    yield ""
    yield from found.markdown()
    yield ""
    yield from alarms.markdown()
    yield ""
    yield f"- `python -m benchmarks silent --cases {cases} --seed {seed}`"
    yield measured_here()
