"""Relaxed plans: the jumps and waits that pending conditions still need, ignoring what steps undo.

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
from itertools import islice, product
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.search.sequences.phases import levels
from stlc.controller.search.sequences.residuals import YES, looks_ahead

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.dynamics.declaration.motion import JumpDecl
    from stlc.dynamics.system import System

    Numbers = NDArray[np.float64]

MOTION = 0.2
"""Cost of a motion in steps: less than that of a jump, so that jumps decide."""
LONGEST = 16
"""Largest number of samples for which a motion is asked to keep a timer running."""
MOST_LEVELS = 64
"""Largest number of combinations of extreme controls under which the direction of a state is looked up."""
PROBE = 1e-4
"""Difference of a state for the direction in which a condition wants it to move."""
Sort: TypeAlias = Literal["mode", "timed", "driven", "unknown"]


@dataclass(frozen=True, slots=True)
class RelaxedStep:
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


@dataclass(frozen=True, slots=True)
class Choice:
    """All of some parts, or one of them.

    Attributes:
        op: "and" or "or".
        parts: each the index of a literal, a number of steps, or a choice.
    """

    op: Literal["and", "or"]
    parts: list[Tree]


Tree: TypeAlias = "int | float | Choice"


def _sum(tree: Tree, costs: Sequence[float]) -> float:
    """Number of steps that a tree needs, given those of the literals."""
    if isinstance(tree, Choice):
        each = [_sum(part, costs) for part in tree.parts]
        return sum(each) if tree.op == "and" else min(each)
    return costs[tree] if isinstance(tree, int) else tree


class Relaxation:
    """Relaxed plans of one system.

    Args:
        system: the system.
        safe: formulas that must hold at every sample.
        orders: `until`s, whose left sides must hold at every sample before the right ones have held.
        conditions: the conditions that a mission may ask for.
        state: a typical state, (n,), at which the direction of timers is looked up.

    Attributes:
        modes: names of the states that only jumps change.
        steps: the jumps of the system, and the waits for conditions on timers.
        driven: names of the controls and of the states that they drive.
    """

    def __init__(
        self,
        system: System,
        safe: Sequence[ir.Formula],
        orders: Sequence[ir.Until],
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
        self.driven = {*self._controls} | {assign.name for assign in decl.updates}
        while more := {
            name
            for name, value in self._flow.items()
            if name not in self.driven and _settled(value, None).columns & self.driven
        }:
            self.driven |= more
        clauses = [clause for formula in safe for clause in clauses_of(formula)]
        jumps = [self._step(jump, clauses, orders) for jump in decl.jumps]
        bounds = [clause[0] for clause in clauses if len(clause) == 1 and self._sort(clause[0]) == "timed"]
        wanted = [*conditions, *(step.condition for step in jumps), *bounds]
        self._stops: dict[ir.Formula, ir.Formula] = {}
        self._falls: dict[ir.Formula, float] = {}
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
        groups = dict.fromkeys(
            group
            for literal, way in self._ways.items()
            for each in _conjunctions(way)
            for group in self._group(each, self._duration(literal, state) / system.dt)
        )
        for stop in self._stops.values():
            literals |= dict.fromkeys(self._literals_of(stop))
        self._bounds = [bound for bound in dict.fromkeys(bounds) if bound in self._stops]
        self._literals = tuple(literals)
        self._number = {literal: i for i, literal in enumerate(self._literals)}
        self._known: dict[int, tuple[ir.Formula, int | None]] = {}
        self._trees: dict[int, tuple[ir.Formula, Tree]] = {}
        self._sorts = [self._sort(literal) for literal in self._literals]
        self._jumps = len(jumps)
        waits = (RelaxedStep(each, each) for each in self._ways)
        self.steps = (*jumps, *groups, *waits)
        self._first_wait = len(jumps) + len(groups)
        self._wait = {step.condition: i for i, step in enumerate(self.steps) if i >= self._first_wait}
        self._motions: dict[int, list[int]] = {}
        for i, group in enumerate(groups):
            for literal in self._literals_of(group.target):
                if self._sort(literal) == "driven" and literal not in self._ways:
                    self._motions.setdefault(self._number[literal], []).append(len(jumps) + i)
        reads = [literal.columns for literal in self._literals]
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
                elif assign.value.columns <= env.keys():
                    growing[i] = True
                    known = {name: column[:, :1] for name, column in env.items()}
                    env[assign.name][0, i + 1] = _values([ir.Predicate(assign.value)], known)[0, 0]
        values = _values(self._literals, env)
        met = TOLERANCE.satisfied(values).astype(np.bool_)
        better = met[:, 1:] | (growing & (values[:, 1:] > values[:, :1]))
        return RelaxedState(self, values[:, 0], met[:, 0], better)

    def tree(self, formula: ir.Formula) -> Tree:
        """Return the tree of a formula; results are cached by object identity."""
        found = self._trees.get(id(formula))
        if found is None:
            found = self._trees[id(formula)] = formula, self._as_tree(formula)
        return found[1]

    def _as_tree(self, formula: ir.Formula) -> Tree:
        match formula:
            case ir.Truth(value):
                return 0.0 if value else math.inf
            case ir.Predicate():
                number = self.number(formula)
                return 0.0 if number is None else number
            case ir.BoolOp(op, items):
                return Choice(op, [self._as_tree(item) for item in items])
            case ir.Temporal(_, _, body) | ir.Until(_, _, _, body):
                return self._as_tree(body)
            case _:
                return 0.0

    def number(self, literal: ir.Formula) -> int | None:
        """Index of a literal; results are cached by object identity."""
        found = self._known.get(id(literal))
        if found is None:
            found = self._known[id(literal)] = literal, self._number.get(literal)
        return found[1]

    def runs_by_itself(self, step: int) -> bool:
        """True if the timer of a waiting step depends on modes alone."""
        return all(
            self._sort(part) == "mode" for part in self._literals_of(self._ways[self.steps[step].condition])
        )

    # ------------------------------------------------------------------------ preparation

    def _duration(self, literal: ir.Formula, state: Numbers) -> float:
        """Seconds that a timer must run from `state`, (n,), until a literal holds."""
        env = {name: np.full((1, 1), value) for name, value in zip(self._names, state, strict=True)}
        lack = -float(_values([literal], env)[0, 0])
        return max(lack, 0.0) / max(self._rates.get(literal, 0.0), PROBE)

    def _group(self, formula: ir.Formula, samples: float) -> Iterator[RelaxedStep]:
        """Yield the motion that satisfies the conjunction under which a timer runs; none if modes suffice.

        It stays true for the number of samples that the timer needs, unless these are many.
        """
        parts = list(self._literals_of(formula))
        modes = [part for part in parts if self._sort(part) != "driven" or part in self._ways]
        if len(modes) < len(parts):
            last = math.ceil(samples - PROBE)
            target = ir.Temporal("always", ir.Window(0, last), formula) if last <= LONGEST else formula
            yield RelaxedStep(ir.BoolOp.joined("and", modes), target, last if last <= LONGEST else 0)

    def _step(
        self, jump: JumpDecl, clauses: Sequence[Sequence[ir.Formula]], orders: Sequence[ir.Until]
    ) -> RelaxedStep:
        """Return a jump as a step, with the conditions that safety and orders add to its guard."""
        fixed = {each.name: each.value for each in jump.resets if isinstance(each.value, ir.Const)}
        extra = [self._left(clause, fixed) for clause in clauses]
        for order in orders:
            asked = (self._left(clause, fixed) for clause in clauses_of(order.left))
            extra.append(ir.BoolOp.joined("or", (ir.BoolOp.joined("and", asked), present(order.right))))
        condition = ir.BoolOp.joined("and", (jump.guard, *extra))
        controls = frozenset(self._controls)
        if not jump.guard.columns & controls:
            return RelaxedStep(condition, condition, 1, jump)
        free = jump.guard.map_terms(lambda part: YES if part.columns & controls else part)
        effects = (
            ir.Predicate(0.5 - (ir.Signal(name) - value).apply("abs")) for name, value in fixed.items()
        )
        return RelaxedStep(ir.BoolOp.joined("and", (free, *extra)), ir.BoolOp.joined("and", effects), 0, jump)

    def _left(self, clause: Sequence[ir.Formula], fixed: Mapping[str, ir.Num]) -> ir.Formula:
        """Return the condition of a clause, a disjunction, before a jump that sets the states `fixed`."""
        if not any(item.columns & fixed.keys() for item in clause):
            return YES
        if any(isinstance(node, (ir.PastTemporal, ir.Since)) for item in clause for node in item.walk()):
            return YES
        here = [item for item in clause if not any(isinstance(node, ir.Shift) for node in item.walk())]
        return ir.BoolOp.joined("or", (item.substitute(fixed).map_terms(_folded) for item in here))

    def _literals_of(self, formula: ir.Formula) -> Iterator[ir.Formula]:
        """Yield the predicates of a formula that one state decides."""
        known = {*self._names, ir.ELAPSED}
        for node in formula.walk():
            if isinstance(node, ir.Predicate) and all(
                isinstance(leaf, ir.Const) or (isinstance(leaf, ir.Signal) and leaf.name in known)
                for leaf in node.leaves()
            ):
                yield node

    def _sort(self, literal: ir.Formula) -> Sort:
        read = literal.columns
        if not read <= self._own:
            return "unknown"
        if read & self.driven:
            return "driven"
        return "timed" if read & self._flow.keys() else "mode"

    def _way(self, literal: ir.Formula, state: Numbers) -> ir.Formula | None:
        """Return the condition on modes under which a literal comes nearer with time.

        The result is None for a literal that only jumps change, or that the controls drive in every mode.
        """
        sort = self._sort(literal)
        if sort not in ("timed", "driven"):
            return None
        flowing = [name for name in literal.columns if name in self._flow]
        modes = dict.fromkeys(
            part.cond
            for name in flowing
            for part in self._flow[name].subexpressions()
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

        if not all(self._flow[name].columns <= now.keys() for name in flowing):
            return YES  # the flow depends on time
        if not modes:
            return ir.Truth(rate(None, holds=True) > 0.0)
        gains = [(mode, rate(mode, holds=True), rate(mode, holds=False)) for mode in modes]
        if sort == "driven" and not any((yes > 0.0) != (no > 0.0) for _, yes, no in gains):
            return None
        if (least := min(min(yes, no) for _, yes, no in gains)) < 0.0:
            stops = [mode.negated for mode, yes, no in gains if yes < 0.0 <= no]
            stops += [mode for mode, yes, no in gains if no < 0.0 <= yes]
            self._stops[literal], self._falls[literal] = ir.BoolOp.joined("or", stops), -least
        ways = [mode for mode, yes, _ in gains if yes > 0.0]
        ways += [mode.negated for mode, _, no in gains if no > 0.0]
        return ir.BoolOp.joined("or", ways)


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
        waited = {*relaxation._motions, *(relaxation._number[way] for way in relaxation._ways)}
        for i, sort in enumerate(relaxation._sorts):
            if sort == "unknown":
                self._costs[i] = 0.0
            elif sort == "driven" and not met[i] and i not in waited:
                self._costs[i] = MOTION
        wanted = [i for i, cost in enumerate(self._costs) if cost == math.inf]
        jumps = [relaxation.tree(step.condition) for step in relaxation.steps[: relaxation._jumps]]
        waits = {
            i: relaxation.tree(way)
            for i in wanted
            if (way := relaxation._ways.get(relaxation._literals[i])) is not None
        }
        motions = {
            i: [relaxation.tree(relaxation.steps[j].condition) for j in relaxation._motions.get(i, ())]
            for i in wanted
        }
        changed = True
        while changed:
            changed = False
            steps = [1.0 + _sum(jump, self._costs) for jump in jumps]
            for i in wanted:
                least = min((steps[j] for j in self._ways[i]), default=math.inf)
                for motion in motions[i]:
                    least = min(least, 1.0 + _sum(motion, self._costs))
                if i in waits:
                    least = min(least, 1.0 + _sum(waits[i], self._costs))
                if least < self._costs[i]:
                    self._costs[i], changed = least, True

    def cost(self, formula: ir.Formula) -> float:
        """Number of steps that a formula needs at least; the nested formulas of the future are added."""
        return _sum(self._of.tree(formula), self._costs)

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
                    ways += [(self.cost(of.steps[j].condition), j) for j in of._motions.get(number, ())]
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
        if step < self._of._first_wait or self._of._sorts[self._of._number[literal]] != "timed":
            return None
        return float(-self._values[self._of._number[literal]]) / max(self._of._rates[literal], PROBE)

    def due(self) -> Iterator[tuple[ir.Formula, float]]:
        """Yield what must become true since a timer runs towards a bound of safety, and the seconds left."""
        for bound in self._of._bounds:
            number, stop = self._of._number[bound], self._of._stops[bound]
            if self.met[number] and self.cost(stop) > 0.0:
                yield stop, float(self._values[number]) / self._of._falls[bound]

    def possible(self, step: int) -> bool:
        """True if a motion alone may lead to a jump, or if a timer runs that is waited for."""
        before = self._before(step)
        return self.ready(before) if step < self._of._first_wait else not self.cost(before)

    def _before(self, step: int) -> ir.Formula:
        """Return what must hold for a step: the condition of a jump, or the modes in which a timer runs."""
        condition = self._of.steps[step].condition
        return condition if step < self._of._first_wait else self._of._ways[condition]


# ------------------------------------------------------------------------------- formulas


def _values(formulas: Sequence[ir.Formula], env: Mapping[str, Numbers]) -> Numbers:
    """Robustness of formulas over one sample of several states, (formulas, states)."""
    width = next(iter(env.values())).shape[1]
    found = evaluate(formulas, env, end="lower")
    return np.stack([np.broadcast_to(each[0], width) for each in found]) if found else np.empty((0, width))


def clauses_of(formula: ir.Formula) -> Iterator[tuple[ir.Formula, ...]]:
    """Yield the disjunctions of a conjunction, each as the tuple of its items."""
    for clause in formula.terms("and"):
        yield tuple(clause.terms("or"))


def present(formula: ir.Formula) -> ir.Formula:
    """Return a formula without its operators of the future, which become true."""
    return formula.map_terms(lambda part: YES if looks_ahead(part) else part)


def _conjunctions(formula: ir.Formula) -> Iterator[ir.Formula]:
    """Yield conjunctions of which one holds where a formula without operators of the future does."""
    match formula:
        case ir.BoolOp("or", items):
            for item in items:
                yield from _conjunctions(item)
        case ir.BoolOp("and", items):
            for parts in islice(product(*map(_conjunctions, items)), MOST_LEVELS):
                yield ir.BoolOp.joined("and", parts)
        case _:
            yield formula


def _folded(formula: ir.Formula) -> ir.Formula:
    """Replace a literal that reads no signal by its truth."""
    if isinstance(formula, ir.Predicate) and not formula.columns:
        return ir.Truth(bool(TOLERANCE.satisfied(_values([formula], {"": np.zeros((1, 1))}))[0, 0]))
    return formula


def _settled(num: ir.Num, mode: ir.Formula | None, *, holds: bool = True) -> ir.Num:
    """Replace the choices of a number by one branch: those on `mode`, or all if `mode` is None.

    Without `mode`, both branches are kept as a sum, for the names that they read.
    """
    deeper = partial(_settled, mode=mode, holds=holds)
    match num:
        case ir.Indicator(cond) if mode is None or cond == mode:
            return ir.Const(float(holds))
        case ir.Where(_, yes, no) if mode is None:
            return deeper(yes) + deeper(no)
        case ir.Where(cond, yes, no) if cond == mode:
            return deeper(yes if holds else no)
        case _:
            return num.map_children(numbers=deeper)
