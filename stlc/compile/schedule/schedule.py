"""Which values a formula needs at which instants: a formula and a trace length -> steps in order.

Nothing is computed where nobody asks: a state predicate at the root is read at one instant, the body of
`always[0, T]` at T + 1. Equal sub-formulas at equal instants are one step; predicates that are needed at the
same instants are one program.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, assert_never

from stlc.compile.backends.array.arith import Program
from stlc.compile.backends.array.namespace import Array
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, farthest, reach_of, tail

End: TypeAlias = Literal["strict", "truncate", "lower", "upper", "both"]
"""What stands beyond the last sample.

`strict`: nothing, and whoever asks is told. `truncate`: nothing, windows are cut. `lower` and `upper`: the
trace may go on, and unknown predicates are -inf or +inf there; windows to the end of the trace end at the
last known sample all the same. `both` (NumPy, without `freeze`): two traces, of which the first is taken at
its least and the second at its greatest.
"""

_FAR = 256
"""Instants beyond the last sample that are computed without asking whether they are all alike."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How long a trace is, and whether it may go on.

    Attributes:
        samples: how many are known.
        end: what stands beyond them.
        stop: how many the trace will have where it goes on: windows to its end end there, and not with the
            last known sample.
        counted: every instant counts, unknown ones as well: the semantics is a mean.
    """

    samples: int
    end: End = "strict"
    stop: int | None = None
    counted: bool = False

    @property
    def open(self) -> bool:
        """Whether instants beyond the last sample exist, with unknown predicates."""
        return self.end in ("lower", "upper", "both")

    @property
    def length(self) -> int:
        """Where windows to the end of the trace end."""
        return self.samples if self.stop is None else self.stop

    def last(self, window: ir.Window, latest: int, parts: Sequence[ir.Formula]) -> int:
        """The last instant of `parts` that a window of the future needs when asked at `latest` at the latest.

        Of the instants beyond the trace at which all parts stay as they are it takes one.
        """
        if window.hi is None:
            return self.length - 1
        if not self.open:
            return min(latest + window.hi, self.samples - 1)
        last = latest + window.hi
        if last < self.samples + _FAR or self.counted:
            return last
        tails = [tail(part, self.samples, self.length) for part in parts]
        known = [found for found in tails if found is not None]
        return min(last, max(*known, latest + window.lo)) if len(known) == len(tails) else last


@dataclass(frozen=True, slots=True)
class Run:
    """Consecutive instants: `count` of them from `start` on; none if `count` <= 0."""

    start: int
    count: int

    @property
    def last(self) -> int:
        """The last instant."""
        return self.start + self.count - 1


def upto(start: int, last: int) -> Run:
    """The instants from `start` to `last`, both included."""
    return Run(start, last - start + 1)


def operands(node: ir.Formula, run: Run, extent: Extent) -> tuple[tuple[ir.Formula, Run], ...]:
    """What `node` at the instants `run` needs of its parts; runs may be empty."""
    match node:
        case ir.Truth() | ir.Predicate() | ir.Freeze():
            return ()
        case ir.BoolOp(_, items):
            return tuple((item, run) for item in items)
        case ir.Temporal(_, window, body):
            return ((body, upto(run.start + window.lo, extent.last(window, run.last, (body,)))),)
        case ir.PastTemporal(_, window, body):
            return ((body, upto(_first(window, run), run.last - window.lo)),)
        case ir.Until() | ir.Since():
            return _both(node, run, extent)
        case ir.Shift(steps, body):
            last = run.last + steps if extent.open else min(run.last + steps, extent.samples - 1)
            return ((body, upto(max(run.start + steps, 0), last)),)
        case ir.AtStart(body):
            return ((body, Run(0, 1)),)
        case _:
            assert_never(node)


def _both(
    node: ir.Until | ir.Since, run: Run, extent: Extent
) -> tuple[tuple[ir.Formula, Run], tuple[ir.Formula, Run]]:
    """What `until` and `since` need: the right side in the window, the left one from now up to there."""
    window, left, right = node.window, node.left, node.right
    if isinstance(node, ir.Until):
        last = extent.last(window, run.last, (left, right))
        if last >= run.start + window.lo:
            return (left, upto(run.start, last)), (right, upto(run.start + window.lo, last))
    elif run.last >= window.lo:
        first = _first(window, run)
        return (left, upto(first, run.last)), (right, upto(first, run.last - window.lo))
    return (left, Run(0, 0)), (right, Run(0, 0))


def _first(window: ir.Window, run: Run) -> int:
    """The first instant that a window of the past reads."""
    return 0 if window.hi is None else max(run.start - window.hi, 0)


@dataclass(frozen=True, slots=True)
class Step:
    """One value to compute.

    Attributes:
        node: the formula.
        run: at which instants.
        parts: steps with the values of its parts; None where a part is not needed at any instant.
    """

    node: ir.Formula
    run: Run
    parts: tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class Batch:
    """Predicates that are computed together at the same instants, all of them within the trace."""

    run: Run
    program: Program


Runner: TypeAlias = Callable[..., Array]
"""What computes a step."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """What to compute, in order.

    Attributes:
        extent: of the trace.
        batches: programs of the predicates.
        steps: values, parts first.
        atoms: step of a predicate -> (batch, name of the output, at which instants it has a value); without
            a batch the name is that of a column; absent where it has no value.
        roots: steps of the formulas that were asked for.
        beyond: how many values beyond the last sample there are in all.
        runners: what computes the steps, by semantics and array library; made when it is first needed.
    """

    extent: Extent
    batches: tuple[Batch, ...]
    steps: tuple[Step, ...]
    atoms: dict[int, tuple[int | None, str, Run]]
    roots: tuple[int, ...]
    beyond: int = 0
    runners: dict[Hashable, tuple[Runner, ...]] = field(default_factory=dict, compare=False, repr=False)


def schedule(formulas: Sequence[ir.Formula], run: Run, extent: Extent) -> Schedule:
    """All steps that `formulas` at the instants `run` take."""
    steps: list[Step] = []
    known: dict[tuple[ir.Formula, Run], int] = {}

    def place(node: ir.Formula, instants: Run) -> int | None:
        if instants.count <= 0:
            return None
        key = (node, instants)
        if key not in known:
            parts = tuple(place(part, its_run) for part, its_run in operands(node, instants, extent))
            known[key] = len(steps)
            steps.append(Step(node, instants, parts))
        return known[key]

    roots = tuple(index for formula in formulas if (index := place(formula, run)) is not None)
    batches, atoms = _batches(steps, extent)
    beyond = sum(max(min(step.run.last - extent.samples + 1, step.run.count), 0) for step in steps)
    return Schedule(extent, batches, tuple(steps), atoms, roots, beyond)


def _batches(
    steps: Sequence[Step], extent: Extent
) -> tuple[tuple[Batch, ...], dict[int, tuple[int | None, str, Run]]]:
    """One program for all predicates over the same stretch of the trace; bare columns need none."""
    wanted: dict[ir.Num, list[tuple[Run, int]]] = {}
    atoms: dict[int, tuple[int | None, str, Run]] = {}
    for index, step in enumerate(steps):
        if isinstance(step.node, ir.Predicate):
            inside = within(reads(step.node.num, extent), step.run, extent)
            if inside.count > 0 and isinstance(step.node.num, ir.Signal) and step.node.sign > 0:
                atoms[index] = (None, step.node.num.name, inside)
            elif inside.count > 0:
                wanted.setdefault(_signed(step.node), []).append((inside, index))
    grouped: dict[Run, dict[ir.Num, list[tuple[Run, int]]]] = {}
    for num, asked in wanted.items():
        for stretch, indices in _stretches(asked):
            grouped.setdefault(stretch, {})[num] = indices
    batches = []
    for number, (stretch, nums) in enumerate(grouped.items()):
        outputs = {str(i): num for i, num in enumerate(nums)}
        batches.append(Batch(stretch, Program(outputs)))
        for i, indices in enumerate(nums.values()):
            atoms.update({index: (number, str(i), inside) for inside, index in indices})
    return tuple(batches), atoms


def _signed(atom: ir.Predicate) -> ir.Num:
    return atom.num if atom.sign > 0 else ir.Op("neg", (atom.num,))


def reads(num: ir.Num, extent: Extent) -> Reach:
    """Samples that have to exist for a number to have a value.

    What reads the last sample instead of one beyond the trace has to wait for it while the trace goes on.
    """
    past, future = reach_of(num)
    return Reach(past, future if extent.stop is None else max(future, farthest(num).future))


def within(reach: Reach, run: Run, extent: Extent) -> Run:
    """The instants of `run` at which all samples exist that a number of this reach reads."""
    first = max(run.start, reach.past)
    return upto(first, max(min(run.last, extent.samples - 1 - reach.future), first - 1))


def _stretches(asked: list[tuple[Run, int]]) -> list[tuple[Run, list[tuple[Run, int]]]]:
    """Runs that touch are put together."""
    out: list[tuple[Run, list[tuple[Run, int]]]] = []
    for run, index in sorted(asked, key=lambda item: (item[0].start, item[0].count)):
        if out and run.start <= out[-1][0].last + 1:
            whole, indices = out[-1]
            out[-1] = (upto(whole.start, max(whole.last, run.last)), [*indices, (run, index)])
        else:
            out.append((run, [(run, index)]))
    return out
