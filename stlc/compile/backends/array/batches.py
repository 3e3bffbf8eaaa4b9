"""Programs of the predicates of an evaluation schedule, one for all at the same instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.schedule import IndexRange, ScheduleStep, TraceDomain, reads, within
from stlc.compile.ir import nodes as ir


@dataclass(frozen=True, slots=True)
class Batch:
    """Program that computes several predicates at the same instants, which lie within the trace.

    Attributes:
        run: the instants.
        program: the program; each of its outputs is the margin of a predicate.
    """

    run: IndexRange
    program: ArrayProgram


@dataclass(frozen=True, slots=True)
class StepSource:
    """Source of a predicate's values: an output of a program, or a signal.

    Attributes:
        batch: index of the program in `ArrayPlan.batches`; None for a signal.
        name: name of the output, or of the signal.
        inside: instants of the step at which the predicate is defined: all samples that it reads exist.
    """

    batch: int | None
    name: str
    inside: IndexRange


def batches_of(
    steps: Sequence[ScheduleStep], domain: TraceDomain
) -> tuple[tuple[Batch, ...], dict[int, StepSource]]:
    """Group the predicates that are evaluated at the same instants into programs.

    Returns the programs, and a mapping from the step number of a predicate to the source of its values. A
    predicate whose margin is just a signal, such as `x > 0`, needs no program.
    """
    wanted: dict[ir.Num, list[tuple[IndexRange, int]]] = {}
    predicates: dict[int, StepSource] = {}
    for index, step in enumerate(steps):
        if isinstance(step.node, ir.Predicate):
            inside = within(reads(step.node.num, domain), step.run, domain)
            if inside.count > 0 and isinstance(step.node.num, ir.Signal) and step.node.sign > 0:
                predicates[index] = StepSource(None, step.node.num.name, inside)
            elif inside.count > 0:
                margin = step.node.num if step.node.sign > 0 else -step.node.num
                wanted.setdefault(margin, []).append((inside, index))
    grouped: dict[IndexRange, dict[ir.Num, list[tuple[IndexRange, int]]]] = {}
    for num, ranges in wanted.items():
        for merged, indices in _merged(ranges):
            grouped.setdefault(merged, {})[num] = indices
    batches = []
    for number, (merged, nums) in enumerate(grouped.items()):
        outputs = {str(i): num for i, num in enumerate(nums)}
        batches.append(Batch(merged, ArrayProgram(outputs)))
        for i, indices in enumerate(nums.values()):
            predicates.update({index: StepSource(number, str(i), inside) for inside, index in indices})
    return tuple(batches), predicates


def _merged(ranges: list[tuple[IndexRange, int]]) -> list[tuple[IndexRange, list[tuple[IndexRange, int]]]]:
    """Merge overlapping and adjacent ranges of instants, such as 0 to 3 and 4 to 6.

    Args:
        ranges: pairs of a range and the number of the step that is evaluated there.

    Returns:
        Pairs of a merged range and the list of the given pairs that it covers.
    """
    out: list[tuple[IndexRange, list[tuple[IndexRange, int]]]] = []
    for run, index in sorted(ranges, key=lambda item: (item[0].start, item[0].count)):
        if out and run.start <= out[-1][0].last + 1:
            whole, indices = out[-1]
            out[-1] = (IndexRange(whole.start, max(whole.last, run.last)), [*indices, (run, index)])
        else:
            out.append((run, [(run, index)]))
    return out
