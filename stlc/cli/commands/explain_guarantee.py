"""`stlc explain RUN --guarantee`: the probability that the backup policy meets a plan that works."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

from stlc.cli.framework.output import emit, emit_json, table

if TYPE_CHECKING:
    from stlc.controller.guard.coverage import Axis, Chance

ASSUMED = (
    "there is a prefix of T0 actions such that every prefix within the radius of it, in every control at "
    "every step, leads to a plan that satisfies the specification when the policy finishes it",
    "that prefix lies anywhere in the ranges of the controls with equal probability, independently of the "
    "grid",
)


def explain_guarantee(run: str, runs: Path, overrides: Mapping[str, str], *, as_json: bool) -> None:
    """Print the probabilities for the grid of a run's system, and what they assume."""
    from stlc.controller.guard.coverage import axes_of, chances
    from stlc.controller.guard.shooting import grid_of
    from stlc.controller.training.run import load_task
    from stlc.rundir import RunDir

    folder = RunDir.open(run, runs)
    task = load_task(folder, overrides)
    grid = grid_of(task)
    axes, found = axes_of(task, grid), chances(task, grid)
    if as_json:
        result = {
            "run": folder.name,
            "assumptions": list(ASSUMED),
            "controls": [asdict(axis) for axis in axes],
            "chances": [asdict(each) for each in found],
        }
        emit_json("explain/1", ok=True, exit_code=0, result=result)
    else:
        emit("\n".join(_lines(folder.name, axes, found)))


def _lines(run: str, axes: Sequence[Axis], found: Sequence[Chance]) -> list[str]:
    tried = ", ".join(f"{len(axis.values)} of {axis.name} in [{axis.low:g}, {axis.high:g}]" for axis in axes)
    lines = [f"run {run}: the backup policy tries {tried} at every step of a prefix", "", "Suppose that"]
    lines += [fill(each, 96, initial_indent="  - ", subsequent_indent="    ") for each in ASSUMED]
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
    lines += ["", *_notes(found)]
    return lines


def _notes(found: Sequence[Chance]) -> list[str]:
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
