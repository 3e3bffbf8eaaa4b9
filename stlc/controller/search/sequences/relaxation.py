"""Relaxed plans: the jumps and waits that pending conditions still need, as if nothing were ever undone.

The state of a hybrid system has parts that only jumps change (modes, counters), parts that flow by themselves
depending on the modes (timers), and parts that the controls drive. A condition on the first needs jumps that
set it; the guard of a jump is a condition in turn. A condition on the second needs a mode and a wait. One on
the third needs a motion. Ignoring what these steps undo, their number is a sum over the conditions, and the
first steps of such a relaxed plan are worth trying (Bonet & Geffner 2001, "Planning as heuristic search";
Hoffmann & Nebel 2001, "The FF planning system").

A jump must also satisfy the safety requirements: `rise(w == out) -> cooled >= 10 s` is one more guard of the
jumps that set `w` to `out`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined, negate
from stlc.compile.ir.support import columns
from stlc.compile.ir.traverse import leaves, map_children, nodes, subexpressions
from stlc.compile.semantics.tolerance import satisfied
from stlc.controller.search.sequences.phases import levels
from stlc.dynamics.model.algebra import names_in, substitute

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.dynamics.declaration.motion import JumpDecl
    from stlc.dynamics.model.system import System

    Numbers = NDArray[np.float64]

MOTION = 0.2
"""Cost of a motion in steps: less than that of a jump, so that jumps decide."""
MOST_LEVELS = 64
"""Largest number of combinations of extreme controls under which the direction of a state is looked up."""
PROBE = 1e-4
"""Difference of a state for the direction in which a condition wants it to move."""
YES, NO = ir.Truth(True), ir.Truth(False)
Sort: TypeAlias = Literal["mode", "timed", "driven", "unknown"]


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a relaxed plan: a jump, or a wait.

    Attributes:
        condition: what must hold when the jump happens: its guard, and what safety requires. Of a wait, what
            is waited for.
        target: formula that a phase reaches in order to make the step.
        delay: number of samples after the target at which the step is made: 1 for most jumps.
        jump: the jump; None for a wait.
    """

    condition: ir.Formula
    target: ir.Formula
    delay: int = 0
    jump: JumpDecl | None = None


class Relaxation:
    """Relaxed plans of one system.

    Args:
        system: the system.
        safe: formulas that must hold at every sample.
        conditions: the conditions that a mission may ask for.
        state: a typical state, (n,), at which the direction of timers is looked up.

    Attributes:
        modes: names of the states that only jumps change.
        steps: the jumps of the system, and the waits for conditions on timers.
    """

    def __init__(
        self,
        system: System,
        safe: Sequence[ir.Formula],
        conditions: Sequence[ir.Formula],
        state: Numbers,
    ) -> None:
        decl = system.decl
        self._names, self._own = system.names, frozenset(decl.signature.names)
        self._flow = {assign.name: assign.value for assign in decl.flow}
        moved = self._flow.keys() | {assign.name for assign in decl.updates}
        resets = {assign.name for jump in decl.jumps for assign in jump.resets}
        self.modes = tuple(name for name in decl.signature.names if name in resets - moved)
        self._controls = system.control_names
        low, high = (end.double().numpy() for end in (system.control_low, system.control_high))
        self._levels = np.concatenate((levels(low, high, most=MOST_LEVELS), 0.5 * (low + high)[None]))
        self._driven = {*self._controls} | {assign.name for assign in decl.updates}
        while more := {
            name
            for name, value in self._flow.items()
            if name not in self._driven and names_in(_settled(value, None)) & self._driven
        }:
            self._driven |= more
        clauses = [clause for formula in safe for clause in _clauses(formula)]
        jumps = [self._step(jump, clauses) for jump in decl.jumps]
        wanted = [*conditions, *(step.condition for step in jumps)]
        self._ways: dict[ir.Formula, ir.Formula] = {}
        self._rates: dict[ir.Formula, float] = {}
        literals: dict[ir.Formula, None] = {}
        while wanted:
            for literal in self._literals_of(wanted.pop()):
                if literal not in literals:
                    literals[literal] = None
                    if (way := self._way(literal, state)) is not None:
                        self._ways[literal] = way
                        wanted.append(way)
        for way in tuple(self._ways.values()):  # what a timer runs on is a step of its own
            for literal in self._literals_of(way):
                if self._sort(literal) == "driven":
                    self._ways.setdefault(literal, YES)
        self._literals = tuple(literals)
        self._number = {literal: i for i, literal in enumerate(self._literals)}
        self._known: dict[int, tuple[ir.Formula, int | None]] = {}
        self._sorts = [self._sort(literal) for literal in self._literals]
        self._jumps = len(jumps)
        waits = (Step(each, each) for each in self._ways)
        self.steps = (*jumps, *waits)
        self._wait = {step.condition: self._jumps + i for i, step in enumerate(self.steps[self._jumps :])}
        reads = [columns(literal) for literal in self._literals]
        self._setters = [
            [
                i
                for i, step in enumerate(jumps)
                if step.jump and any(assign.name in read for assign in step.jump.resets)
            ]
            for read in reads
        ]

    def at(self, state: Numbers) -> RelaxedState:
        """Return the relaxed plans from `state`, (n,)."""
        env = {
            name: np.full((1, self._jumps + 1), value) for name, value in zip(self._names, state, strict=True)
        }
        growing = np.zeros(self._jumps, np.bool_)
        for i, step in enumerate(self.steps[: self._jumps]):
            assert step.jump is not None
            for assign in step.jump.resets:
                if isinstance(assign.value, ir.Const):
                    env[assign.name][0, i + 1] = assign.value.value
                elif names_in(assign.value) <= env.keys():
                    growing[i] = True
                    known = {name: column[:, :1] for name, column in env.items()}
                    env[assign.name][0, i + 1] = _values([ir.Predicate(assign.value)], known)[0, 0]
        values = _values(self._literals, env)
        met = satisfied(values).astype(np.bool_)
        better = met[:, 1:] | (growing & (values[:, 1:] > values[:, :1]))
        return RelaxedState(self, values[:, 0], met[:, 0], better)

    def number(self, literal: ir.Formula) -> int | None:
        """Index of a literal, by identity where the same object was asked for before."""
        found = self._known.get(id(literal))
        if found is None:
            found = self._known[id(literal)] = literal, self._number.get(literal)
        return found[1]

    def runs_by_itself(self, step: int) -> bool:
        """True if nothing but modes decides whether the timer runs for which a step waits."""
        return all(
            self._sort(part) == "mode" for part in self._literals_of(self._ways[self.steps[step].condition])
        )

    # ------------------------------------------------------------------------ preparation

    def _step(self, jump: JumpDecl, clauses: Sequence[Sequence[ir.Formula]]) -> Step:
        """Return a jump as a step, with what the clauses of the safety requirements ask when it happens."""
        fixed = {each.name: each.value for each in jump.resets if isinstance(each.value, ir.Const)}
        extra = [self._left(clause, fixed) for clause in clauses]
        condition = joined("and", (jump.guard, *extra), YES)
        controls = frozenset(self._controls)
        if not columns(jump.guard) & controls:
            return Step(condition, condition, 1, jump)
        free = _without(jump.guard, controls)
        effects = (_equal(name, value) for name, value in fixed.items())
        return Step(joined("and", (free, *extra), YES), joined("and", effects, YES), 0, jump)

    def _left(self, clause: Sequence[ir.Formula], fixed: Mapping[str, ir.Num]) -> ir.Formula:
        """Return what a clause, a disjunction, asks before a jump that sets the states `fixed`."""
        if not any(columns(item) & fixed.keys() for item in clause):
            return YES
        if any(isinstance(node, (ir.PastTemporal, ir.Since)) for item in clause for node in nodes(item)):
            return YES
        here = [item for item in clause if not any(isinstance(node, ir.Shift) for node in nodes(item))]
        return joined("or", (_folded(substitute(item, fixed)) for item in here), NO)

    def _literals_of(self, formula: ir.Formula) -> Iterator[ir.Formula]:
        """Yield the predicates of a formula that one state decides."""
        known = {*self._names, ir.ELAPSED}
        for node in nodes(formula):
            if isinstance(node, ir.Predicate) and all(
                isinstance(leaf, ir.Const) or (isinstance(leaf, ir.Signal) and leaf.name in known)
                for leaf in leaves(node)
            ):
                yield node

    def _sort(self, literal: ir.Formula) -> Sort:
        read = columns(literal)
        if not read <= self._own:
            return "unknown"
        if read & self._driven:
            return "driven"
        return "timed" if read & self._flow.keys() else "mode"

    def _way(self, literal: ir.Formula, state: Numbers) -> ir.Formula | None:
        """Return the condition on modes under which a literal comes nearer with time.

        The result is None for a literal that only jumps change, or that the controls drive in every mode.
        """
        sort = self._sort(literal)
        if sort not in ("timed", "driven"):
            return None
        flowing = [name for name in columns(literal) if name in self._flow]
        modes = dict.fromkeys(
            part.cond
            for name in flowing
            for part in subexpressions(self._flow[name])
            if isinstance(part, (ir.Indicator, ir.Where))
        )
        if sort == "driven" and not modes:
            return None
        env = {name: np.full((1, 1 + len(flowing)), x) for name, x in zip(self._names, state, strict=True)}
        for i, name in enumerate(flowing):
            env[name][0, i + 1] += PROBE
        values = _values([literal], env)[0]
        slopes = (values[1:] - values[:1]) / PROBE
        now = {name: np.repeat(column[:, :1], len(self._levels), 1) for name, column in env.items()}
        now |= {name: levels[None] for name, levels in zip(self._controls, self._levels.T, strict=True)}

        def rate(mode: ir.Formula | None, *, holds: bool) -> float:
            rates = [_settled(self._flow[name], mode, holds=holds) for name in flowing]
            found = float((slopes @ _values([ir.Predicate(rate) for rate in rates], now)).max())
            self._rates[literal] = max(self._rates.get(literal, 0.0), found)
            return found

        if not all(names_in(self._flow[name]) <= now.keys() for name in flowing):
            return YES  # the flow depends on time
        if not modes:
            return ir.Truth(rate(None, holds=True) > 0.0)
        gains = [(mode, rate(mode, holds=True), rate(mode, holds=False)) for mode in modes]
        if sort == "driven" and not any((yes > 0.0) != (no > 0.0) for _, yes, no in gains):
            return None
        ways = [mode for mode, yes, _ in gains if yes > 0.0]
        ways += [negate(mode) for mode, _, no in gains if no > 0.0]
        return joined("or", ways, NO)


class RelaxedState:
    """Relaxed plans from one state.

    Attributes:
        met: True for the literals that hold in the state, (literals,).
    """

    def __init__(
        self, relaxation: Relaxation, values: Numbers, met: NDArray[np.bool_], better: NDArray[np.bool_]
    ) -> None:
        self._of, self._values, self.met = relaxation, values, met
        setters = relaxation._setters
        self._ways = [[j for j in setters[i] if better[i, j]] for i in range(len(met))]
        self._costs = [0.0 if known else math.inf for known in met]
        for i, sort in enumerate(relaxation._sorts):
            if sort == "unknown":
                self._costs[i] = 0.0
            elif sort == "driven" and not met[i] and relaxation._literals[i] not in relaxation._ways:
                self._costs[i] = MOTION
        wanted = [i for i, cost in enumerate(self._costs) if cost == math.inf]
        changed = True
        while changed:
            changed = False
            steps = [1.0 + self.cost(step.condition) for step in relaxation.steps[: relaxation._jumps]]
            for i in wanted:
                least = min((steps[j] for j in self._ways[i]), default=math.inf)
                way = relaxation._ways.get(relaxation._literals[i])
                if way is not None:
                    least = min(least, 1.0 + self.cost(way))
                if least < self._costs[i]:
                    self._costs[i], changed = least, True

    def cost(self, formula: ir.Formula) -> float:
        """Number of steps that a formula needs at least; the nested formulas of the future are added."""
        match formula:
            case ir.Truth(value):
                return 0.0 if value else math.inf
            case ir.Predicate():
                number = self._of.number(formula)
                return 0.0 if number is None else self._costs[number]
            case ir.BoolOp("and", items):
                return sum(map(self.cost, items))
            case ir.BoolOp("or", items):
                return min(map(self.cost, items))
            case ir.Temporal(_, _, body):
                return self.cost(body)
            case ir.Until(_, _, _, right):
                return self.cost(right)
            case _:
                return 0.0

    def ready(self, formula: ir.Formula) -> bool:
        """True if a motion alone may make a formula true: its conditions on modes and timers hold."""
        match formula:
            case ir.Truth(value):
                return value
            case ir.Predicate():
                number = self._of.number(formula)
                if number is None or bool(self.met[number]):
                    return True
                sort, way = self._of._sorts[number], self._of._ways.get(formula)
                return sort == "unknown" or (sort == "driven" and (way is None or not self.cost(way)))
            case ir.BoolOp(op, items):
                return (all if op == "and" else any)(map(self.ready, items))
            case ir.Temporal(_, _, body):
                return self.ready(body)
            case _:
                return True

    def plan(self, formulas: Iterable[ir.Formula]) -> frozenset[int]:
        """Return the steps of a relaxed plan for some formulas, indices of `Relaxation.steps`."""
        of, found, left = self._of, set[int](), list(formulas)
        while left:
            match left.pop():
                case ir.Predicate() as literal:
                    number = of.number(literal)
                    if number is None or not MOTION < self._costs[number] < math.inf:
                        continue
                    ways = [(self.cost(of.steps[j].condition), j) for j in self._ways[number]]
                    if (wait := of._wait.get(literal)) is not None:
                        ways.append((self.cost(of._ways[literal]), wait))
                    step = min(ways)[1]
                    if step not in found:
                        found.add(step)
                        left.append(self._before(step))
                case ir.BoolOp("and", items):
                    left.extend(items)
                case ir.BoolOp("or", items):
                    left.append(min(items, key=self.cost))
                case ir.Temporal(_, _, body) | ir.Until(_, _, _, body):
                    left.append(body)
        return frozenset(found)

    def wait(self, step: int) -> float | None:
        """Seconds that a wait takes while its timers run; None for a jump."""
        literal = self._of.steps[step].condition
        if step < self._of._jumps or self._of._sorts[self._of._number[literal]] != "timed":
            return None
        return float(-self._values[self._of._number[literal]]) / max(self._of._rates[literal], PROBE)

    def possible(self, step: int) -> bool:
        """True if a motion alone may lead to a jump, or if a timer runs that is waited for."""
        before = self._before(step)
        return self.ready(before) if step < self._of._jumps else not self.cost(before)

    def _before(self, step: int) -> ir.Formula:
        """Return what must hold for a step: the condition of a jump, or the modes in which a timer runs."""
        condition = self._of.steps[step].condition
        return condition if step < self._of._jumps else self._of._ways[condition]


# ------------------------------------------------------------------------------- formulas


def _values(formulas: Sequence[ir.Formula], env: Mapping[str, Numbers]) -> Numbers:
    """Robustness of formulas over one sample of several states, (formulas, states)."""
    width = next(iter(env.values())).shape[1]
    found = evaluate(formulas, env, ops=NUMPY, end="lower")
    return np.stack([np.broadcast_to(each[0], width) for each in found]) if found else np.empty((0, width))


def _clauses(formula: ir.Formula) -> Iterator[tuple[ir.Formula, ...]]:
    """Yield the disjunctions of a conjunction, each as the tuple of its items."""
    match formula:
        case ir.BoolOp("and", items):
            for item in items:
                yield from _clauses(item)
        case ir.BoolOp("or", items):
            yield tuple(part for item in items for part in _disjuncts(item))
        case _:
            yield (formula,)


def _disjuncts(formula: ir.Formula) -> Iterator[ir.Formula]:
    if isinstance(formula, ir.BoolOp) and formula.op == "or":
        for item in formula.items:
            yield from _disjuncts(item)
    else:
        yield formula


def _folded(formula: ir.Formula) -> ir.Formula:
    """Replace the literals that read no signal by their truth."""
    if isinstance(formula, ir.Predicate) and not columns(formula):
        blank = {"": np.zeros((1, 1))}
        return ir.Truth(bool(satisfied(_values([formula], blank))[0, 0]))
    if isinstance(formula, ir.BoolOp):
        return joined(formula.op, map(_folded, formula.items), ir.Truth(formula.op == "and"))
    return formula


def _without(formula: ir.Formula, names: frozenset[str]) -> ir.Formula:
    """Replace the literals that read one of the signals `names` by true."""
    if isinstance(formula, ir.Predicate):
        return YES if columns(formula) & names else formula
    items = (_without(item, names) for item in formula.items) if isinstance(formula, ir.BoolOp) else ()
    return (
        joined(formula.op, items, ir.Truth(formula.op == "and"))
        if isinstance(formula, ir.BoolOp)
        else formula
    )


def _settled(num: ir.Num, mode: ir.Formula | None, *, holds: bool = True) -> ir.Num:
    """Replace the choices of a number by one branch: those on `mode`, or all if `mode` is None.

    Without `mode`, both branches are kept as a sum, for the names that they read.
    """
    deeper = partial(_settled, mode=mode, holds=holds)
    match num:
        case ir.Indicator(cond) if mode is None or cond == mode:
            return ir.Const(float(holds))
        case ir.Where(_, yes, no) if mode is None:
            return ir.Op("add", (deeper(yes), deeper(no)))
        case ir.Where(cond, yes, no) if cond == mode:
            return deeper(yes if holds else no)
        case _:
            return map_children(num, numbers=deeper)


def _equal(name: str, value: ir.Num) -> ir.Formula:
    apart = ir.Op("abs", (ir.Op("sub", (ir.Signal(name), value)),))
    return ir.Predicate(ir.Op("sub", (ir.Const(0.5), apart)))
