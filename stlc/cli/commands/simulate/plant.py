"""Text of simulations of a black box: the option `--plant` of `stlc simulate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from stlc.cli.commands.check.text import WORDS, in_unit, robustness_text
from stlc.cli.framework.output import emit, say, table
from stlc.escape import operand, shell, visible
from stlc.units import time_text

if TYPE_CHECKING:
    from stlc.assurance.plant_judge import JudgedRun, PlantSimulation

CARRYING = (".npz", ".mcap")
"""Suffixes of recorded traces that carry their specification."""
MOST_SHOWN = 5
"""Findings that are printed in full."""


def exit_code(found: PlantSimulation, fail_under: float | None) -> int:
    """Exit code: 1 if the share of satisfying simulations is too small, or if one has no trace; else 0."""
    few = fail_under is not None and found.satisfied / len(found.runs) < fail_under
    return int(few or (fail_under is None and found.findings > 0))


def show(found: PlantSimulation, spec: str, overrides: Mapping[str, str]) -> None:
    """Print the results; `spec` and `overrides` are for the command that judges the traces again."""
    runs = found.runs
    count = f"{len(runs)} simulation{'s' if len(runs) != 1 else ''}"
    emit(
        f"{visible(found.spec)} on {visible(found.plant)}    "
        f"{count} of {time_text(found.steps * found.dt)}, dt {found.dt:g} s"
    )
    emit("")
    emit(table(list(_rows(found)), header=("seed", "verdict", "requirement", "robustness", "point")))
    for run in [run for run in runs if run.finding is not None][:MOST_SHOWN]:
        for line in _finding_lines(run):
            emit(line)
    emit("")
    emit(_summary(found))
    if found.trace is not None:
        say(f"the traces are in {found.trace}")
        words: list[str] = []
        if not found.trace.endswith(CARRYING):  # else the file of the traces carries the specification
            for name, value in overrides.items():
                words += ["--set", f"{name}={value}"]
            words.append(operand(spec))
        emit(f"next: {shell(('stlc', 'check', *words, operand(found.trace)))}")


def _rows(found: PlantSimulation) -> Iterator[tuple[str, ...]]:
    """Rows of the table: per simulation its verdict, and the requirement with the least robustness."""
    variables = found.variables
    for run in found.runs:
        point = ", ".join(
            f"{each.name}={in_unit(f'{run.point[each.name]:.4g}', each.unit.text)}" for each in variables[:4]
        )
        point += ", …" if len(variables) > 4 else ""
        if run.verdict is None:
            yield str(run.seed), "FINDING", "", run.finding.reason if run.finding else "", point
            continue
        word, worst = run.verdict.scoped, run.verdict.worst
        low, high = (float(end.min()) for end in worst.margins)
        value = robustness_text(worst.statuses[0], low, high, float(worst.least[0]), worst.unit)
        yield str(run.seed), WORDS[word], worst.name, value, point


def _finding_lines(run: JudgedRun) -> Iterator[str]:
    finding = run.finding
    assert finding is not None
    at = "" if finding.time is None else f" at t = {finding.time:.10g} s"
    yield ""
    yield f"seed {run.seed}: {finding.reason}{at}: {visible(finding.message)}"
    values = ", ".join(f"{visible(name)}={value:.17g}" for name, value in run.point.items())
    if values:
        yield f"  point: {values}"
    for line in finding.stderr.splitlines()[-MOST_SHOWN:]:
        yield f"  | {visible(line)}"


def _summary(found: PlantSimulation) -> str:
    text = f"{found.satisfied} of {len(found.runs)} simulations satisfy every requirement"
    others = {
        "violated": found.violated,
        "inconclusive": found.inconclusive,
        "out of scope": found.out_of_scope,
        "without a trace": found.findings,
    }
    return text + "".join(f"; {number} {words}" for words, number in others.items() if number)
