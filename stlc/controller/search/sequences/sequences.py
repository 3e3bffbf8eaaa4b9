"""Search for whole plans as sequences of phases, for missions whose goals need many steps in order.

A node is a prefix of a plan. The residual of the requirements gives its pending goals. A relaxed
plan for them (`relaxation`) gives the jumps, waits and goals to try next, and the time that they take. Each
is tried by a short search for a phase that reaches it and stays safe until then (`phases`). A phase that is
found, appended to the prefix, is a further node. The node of least estimated total time is extended first.
Nothing here knows a task: the order of the phases follows from the requirements and the guards of the jumps.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, product
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.compile.ir import nodes as ir
from stlc.controller.search.newton import values_of
from stlc.controller.search.sequences.landmarks import Landmarks
from stlc.controller.search.sequences.obligations import Obligations
from stlc.controller.search.sequences.phases import TAIL, UNSURE, Phase, PhaseRequest, Phases
from stlc.controller.search.sequences.relaxation import Relaxation, RelaxedState, clauses_of, present
from stlc.controller.search.sequences.residuals import NO, YES, Progression, looks_ahead
from stlc.controller.search.starts import extremes

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray
    from torch import Tensor

    from stlc.controller.problem.task import Task

    Numbers = NDArray[np.float64]

LENGTHS = 16, 64
"""Least and greatest number of steps of a phase."""
SHARE = 4
"""A phase may take this part of the mission, within `LENGTHS`."""
ALTERNATIVES = 8
"""Largest number of alternatives into which the `or`s of one goal are written out."""
PROBES = 32
"""Number of plans that show the typical sizes of margins."""
NEARER = 0.05
"""Share of its distance by which a phase that fails must come nearer to its target, to be kept as a node."""
GREED = 2.0
"""Weight of the time that the missing steps take, beside the length of the prefix."""
VARIED = 0.8, 1.2
"""Range of random factors of this weight: another search takes other ways."""
LATE = 3.0
"""Weight of the time by which a goal would miss its deadline."""
URGENT = 1.0
"""Share of the time of steps that safety asks for soon; what is missing of it is added to the cost."""
DRIFT = 0.02
"""Share of its range by which a state may drift in the time of a phase where it nearly stands still."""
EARLY = 1e-6
"""Share of a step by which a wait may end early, for rounding."""
TRIES = 8
"""Number of phases that are tried for each step of the relaxed plan at the start, and as for some more."""
FEWEST = 4.0
"""Number of these."""
OPEN = 64
"""Number of nodes that are kept for the next search from a later state."""
SOON = 9
"""Number of samples of a prefix among which that state is looked for."""
TWINS = 2
"""Number of nodes that are kept with the same modes and pending goals."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A condition that must hold at one of some later samples, counted from the present one.

    Attributes:
        target: index of the condition among the targets of phases.
        condition: the condition.
        first: first sample that counts.
        last: last sample that counts.
    """

    target: int
    condition: ir.Formula
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Node:
    """A prefix of a plan.

    Attributes:
        states: states along the prefix, (k + 1, n).
        plan: controls, (k, m).
        left: residual of the obligations.
        goals: goals that are pending.
        steps: jumps and waits of a relaxed plan for the residual.
        missing: number of these steps, and of the remaining goals.
        time: time that these steps take, in steps of the plan.
        relaxed: relaxed plans from the last state.
        tries: targets of the last phases, if these came nearer to them without reaching one.
        since: number of steps since the last goal or step was reached, which have led to landmarks.
        tail: controls after the prefix, (j, m), with which the last phase goes on.
        requests: remaining requests for phases from here; empty before the first of them.
    """

    states: Numbers
    plan: Numbers
    left: tuple[ir.Formula, ...]
    goals: tuple[Goal, ...]
    steps: frozenset[int]
    missing: float
    time: float
    relaxed: RelaxedState
    tries: tuple[int, ...] = ()
    since: int = 0
    tail: Numbers | None = None
    requests: tuple[PhaseRequest, ...] = ()


class Sequences:
    """Search for plans of one task as sequences of phases.

    Args:
        task: specification and system.
        state: a state at the start of a mission, (n,).
    """

    def __init__(self, task: Task, state: Tensor) -> None:
        self.task = task
        self._spent, self._made = 8.0, 1
        self._open: list[Node] = []
        self._last: tuple[tuple[float, ...], Progression] = (), Progression((), 0)
        self._obligations = Obligations(task)
        self._state = state
        self.steps = min(max(task.horizon // SHARE, LENGTHS[0]), LENGTHS[1], task.horizon)
        obligations = self._obligations.first
        self._untils = tuple(
            node for node in obligations if isinstance(node, ir.Until) and not looks_ahead(node.left)
        )
        self._kept = tuple(each.left | present(each.right) for each in self._untils)
        self._safe = tuple(
            self._obligations.within(piece.body)
            for rule in task.rules
            for piece in rule.formula.pieces
            if isinstance(piece, ir.Temporal) and piece.op == "always" and not looks_ahead(piece.body)
        )
        conditions = dict.fromkeys(each for formula in obligations for each in self._conditions(formula))
        self._relaxation = Relaxation(
            task.system, self._safe, self._untils, [*obligations, *conditions], state.numpy()
        )
        steps = self._relaxation.steps
        wanted = (*conditions, *(step.target for step in steps))
        own = set(task.system.decl.signature.names)
        clauses = [
            clause
            for formula in (*self._safe, *self._kept)
            for clause in clauses_of(formula)
            if all(each.columns <= own and not each.history for each in clause)
        ]
        moved = self._relaxation.driven - {*self._relaxation.modes}
        ranges = {each.name: each for each in task.system.decl.signature.columns if each.name in moved}
        landmarks = Landmarks(clauses, ranges)
        way = [landmarks.of(target) for target in wanted]
        extra = list(dict.fromkeys(each for marks in way for each in marks))
        self._targets = (*wanted, *extra, self._rest(), YES)
        self._marks = [tuple(len(wanted) + extra.index(each) for each in marks) for marks in way]
        self._merit = [0] * len(self._targets)
        self._target = {condition: i for i, condition in enumerate(conditions)}
        self._first_step, self._idle = len(conditions), len(self._targets) - 1
        self._modes = [task.system.names.index(name) for name in self._relaxation.modes]

    def _rest(self) -> ir.Formula:
        """Return a target in which the states that the controls accelerate nearly stand still."""
        system, slow = self.task.system, list[ir.Formula]()
        controls = frozenset(system.control_names)
        for assign in system.decl.flow:
            low, high = system.decl.signature[assign.name].low, system.decl.signature[assign.name].high
            driven = assign.name in self._relaxation.driven and not assign.value.columns & controls
            if driven and low is not None and high is not None:
                speed = DRIFT * (high - low) / (self.steps * system.dt)
                margin = ir.Const(speed) - assign.value.apply("abs")
                slow.append(ir.Predicate(margin))
        return ir.BoolOp.joined("and", slow)

    @cached_property
    def _phases(self) -> Phases | None:
        safe, scale = ir.BoolOp.joined("and", self._safe), self._scales(self._targets, self._state)
        known = frozenset(self.task.system.names)
        clauses = [
            [part for part in clause if isinstance(part, ir.Predicate)]
            for formula in self._safe
            for clause in clauses_of(formula)
            if all(isinstance(part, ir.Predicate) and part.columns <= known for part in clause)
        ]
        return Phases.of(self.task.system, safe, self._targets, self._kept, self.steps, scale, clauses)

    def root(self, state: Tensor) -> Node | None:
        """Return the empty prefix at `state`, (n,), None if nothing leads from there to all goals."""
        progression = self._progression(state)
        return self._node(progression, state.numpy()[None], self._nothing)

    def several(self, node: Node) -> bool:
        """True if several steps lead from a node to all goals, landmarks included."""
        return node.missing > 1 or self.marked(node)

    def marked(self, node: Node) -> bool:
        """True if landmarks lead to a goal of a node."""
        return any(self._marks[goal.target] for goal in node.goals)

    def _progression(self, state: Tensor) -> Progression:
        """Return the progression of the obligations from `state`, (n,), that phases do not keep anyway."""
        key = tuple(state.tolist())
        if self._last[0] != key:
            open_ = [each for each in self._obligations.at(state) if not _is_kept(each)]
            self._last = key, Progression(open_, self.task.horizon)
        return self._last[1]

    @cached_property
    def _nothing(self) -> Numbers:
        return np.empty((0, len(self.task.system.control_names)))

    @property
    def tried(self) -> int:
        """Number of plans judged, in plans of the whole horizon."""
        return 0 if self._phases is None else self._phases.tried * self.steps // self.task.horizon

    def _scales(self, targets: Sequence[ir.Formula], state: Tensor) -> Callable[[ir.Formula], float]:
        """Return a function from a predicate of the targets to the typical size of its margin."""
        literals = list[ir.Formula](
            dict.fromkeys(part for each in targets for part in each.walk() if isinstance(part, ir.Predicate))
        )
        plans = extremes(self.task, torch.Generator().manual_seed(0)).double()[:PROBES]
        states = self.task.rollout(state.expand(len(plans), -1), plans)
        sizes = values_of(self.task, literals, states).flatten(1).std(1).tolist()
        return {literal: size or 1.0 for literal, size in zip(literals, sizes, strict=True)}.__getitem__

    def _conditions(self, formula: ir.Formula) -> Iterator[ir.Formula]:
        """Yield the conditions that phases may have to reach for a formula."""
        match formula:
            case ir.Temporal("eventually", _, body) | ir.Until("until", _, _, body):
                yield from self._alternatives(body)
                yield from self._conditions(body)
            case ir.Temporal("always", window, body):
                if looks_ahead(body):
                    yield from self._conditions(body)
                elif window.lo:
                    yield body
            case ir.BoolOp(_, items):
                for item in items:
                    yield from self._conditions(item)

    def _alternatives(self, formula: ir.Formula) -> list[ir.Formula]:
        """Return conditions of which one must hold where `formula` holds, without its later goals."""
        if not looks_ahead(formula):
            return [] if isinstance(formula, ir.Truth) else [formula]
        match formula:
            case ir.Temporal("always", _, body) if not looks_ahead(body):
                return [formula] if formula.reach.future <= self.steps // 2 else [body]
            case ir.BoolOp("or", items):
                return [each for item in items for each in self._alternatives(item)]
            case ir.BoolOp("and", items):
                parts = [found for item in items if (found := self._alternatives(item))]
                whole = [ir.BoolOp.joined("and", combined) for combined in product(*parts)] if parts else []
                return whole[:ALTERNATIVES]
            case _:
                return []

    # ------------------------------------------------------------------------------- search

    def plans(self, state: Tensor, random: Generator, effort: int = 1) -> Iterator[Tensor | None]:
        """Search for plans from `state`, (n,): yield each that is complete, (T, m), and None after each try.

        The plans satisfy the safety requirements and goals in the form that phases use; whether they satisfy
        the specification has to be judged. `effort` is a factor of the tries for each phase.
        """
        if self._phases is None:
            return
        order, seen = count(), dict[object, list[int]]()
        progression = self._progression(state)
        heap: list[tuple[float, int, Node]] = []
        least = math.inf, math.inf

        def add(node: Node | None) -> Tensor | None:
            """Keep a node; return its plan if it is nearer to the end than those before."""
            nonlocal least
            if node is None:
                return None
            modes = tuple(node.states[-1, self._modes])
            goals = tuple(sorted({goal.target for goal in node.goals}))
            times = seen.setdefault((modes, goals, node.steps, node.tries), [])
            if node.missing and sum(time <= len(node.plan) for time in times) >= TWINS:
                return None
            times.append(len(node.plan))
            greed = GREED * random.uniform(*VARIED)
            cost = len(node.plan) + greed * node.time if node.missing else -float(len(node.plan))
            heapq.heappush(heap, (cost, next(order), node))
            if (node.missing, node.time) >= least or not len(node.plan):
                return None
            least = node.missing, node.time
            return self._ended(node)

        add(self._node(progression, state.numpy()[None], self._nothing))
        for earlier in self._reopened(state):
            yield add(earlier)
        tries = TRIES * effort * (FEWEST + heap[0][2].missing) if heap else 0.0
        node: Node | None = None
        try:
            while heap and tries > 0:
                node = heapq.heappop(heap)[2]
                if not node.missing:
                    yield self._ended(node)
                requests = deque(node.requests or self._requests(node))
                while requests:
                    tries -= 1
                    grown = self._try(progression, node, requests, random, effort)
                    node = replace(node, requests=tuple(requests))
                    yield None if grown is None else add(grown)
                node = None
        finally:
            left = [] if node is None or not node.requests else [node]
            self._open = [*self._open, *(each for _, _, each in sorted(heap)[:OPEN]), *left][-OPEN:]

    def _reopened(self, state: Tensor) -> list[Node]:
        """Return the nodes that earlier searches have not extended, continued from `state`, (n,)."""
        found, others = list[Node](), list[Node]()
        for node in self._open:
            same = np.isclose(node.states[1:SOON], state.numpy()).all(1).nonzero()[0]
            first = 1 + int(same[0]) if len(same) else len(node.plan)
            if first < len(node.plan):
                found.append(replace(node, states=node.states[first:], plan=node.plan[first:]))
            else:
                others.append(node)
        self._open = others
        return found

    def _try(
        self,
        progression: Progression,
        node: Node,
        requests: deque[PhaseRequest],
        random: Generator,
        effort: int,
    ) -> Node | None:
        """Search for the first requested phase, and return the node that it leads to, if any.

        If requests for a target with landmarks have failed, the next landmark is requested instead.
        """
        assert self._phases is not None
        request, state = requests.popleft(), node.states[-1]
        marks = self._marks[request.target] if request.target < len(self._marks) else ()
        missing = [
            mark for mark in marks if self._phases.margin(state, replace(request, target=mark)) < -UNSURE
        ]
        mark = None
        if missing and missing[-1] == marks[-1]:
            last = min(self.steps, self.task.horizon - len(node.plan))
            mark = replace(request, target=missing[0], first=0, last=last, after=0)
        if mark is None or self._merit[request.target] >= 0:
            phase = self._phases.reach(state, request, random, effort)
            found = self._grown(progression, node, request, phase)
            if found is None and request.target == self._idle:
                requests.append(replace(request, target=self._idle - 1, first=0))
            if mark is None:
                return found
            self._merit[request.target] += 1 if found else -1
            if found is not None:
                return found
        requests.appendleft(mark)
        return self._try(progression, node, requests, random, effort)

    def _node(
        self,
        progression: Progression,
        states: Numbers,
        plan: Numbers,
        tries: tuple[int, ...] = (),
        since: int = 0,
    ) -> Node | None:
        """Return the node of a prefix; None if it has lost a requirement, or a goal that no jump can meet."""
        env = {name: states[:, i : i + 1] for i, name in enumerate(self.task.system.names)}
        left = _needed(progression.after(env))
        if NO in left:
            return None
        relaxed = self._relaxation.at(states[-1])
        goals = tuple(goal for formula in left for goal in self._goals(formula))
        moves = sum(_moves(formula, relaxed) for formula in left)
        if not math.isfinite(moves):
            return None
        steps = relaxed.plan(left)
        each = self._spent / self._made
        time = self._time(relaxed, steps) + moves * each - min(since, each)
        for goal in goals:
            late = self._time(relaxed, relaxed.plan([goal.condition])) + each - goal.last
            time += LATE * max(0.0, late)
        for stop, seconds in relaxed.due():
            time += max(0.0, URGENT * each * relaxed.cost(stop) - seconds / self.task.system.dt)
        return Node(states, plan, left, goals, steps, moves + len(steps), time, relaxed, tries, since)

    def _time(self, relaxed: RelaxedState, steps: frozenset[int]) -> float:
        """Number of samples that the steps of a relaxed plan take one after another."""
        waits = [wait / self.task.system.dt for step in steps if (wait := relaxed.wait(step)) is not None]
        return (len(steps) - len(waits)) * self._spent / self._made + sum(waits)

    def _goals(self, formula: ir.Formula) -> Iterator[Goal]:
        match formula:
            case ir.BoolOp(_, items):
                for item in items:
                    yield from self._goals(item)
            case ir.Temporal("eventually", window, body) | ir.Until("until", window, _, body):
                for condition in self._alternatives(body):
                    if (target := self._target.get(condition)) is not None:
                        last = self.task.horizon if window.hi is None else window.hi
                        yield Goal(target, condition, window.lo, last)
            case ir.Temporal("always", window, body) if window.lo > 1 and not looks_ahead(body):
                if (target := self._target.get(body)) is not None:
                    yield Goal(target, body, window.lo, window.lo)

    def _requests(self, node: Node) -> list[PhaseRequest]:
        """Return the requests to try from a node."""
        rest = self.task.horizon - len(node.plan)
        if not rest:
            return []
        most = min(self.steps, rest)
        opened = frozenset(
            i
            for i, until in enumerate(self._untils)
            if any(isinstance(part, ir.Until) and part.left is until.left for part in node.left)
        )
        idle = PhaseRequest(self._idle, most, most, opened)
        if not node.missing:
            return [idle]
        found: list[PhaseRequest] = []
        due = min((goal.last for goal in node.goals if node.relaxed.cost(goal.condition)), default=rest)
        for goal in sorted(node.goals, key=lambda goal: goal.last):
            if goal.first <= due and node.relaxed.ready(goal.condition):
                after = goal.condition.reach.future
                last = min(goal.last, most - after)
                first = goal.first if goal.first <= last else 0
                found.append(PhaseRequest(goal.target, first, last, opened, after))
                if goal.first > 1 and not node.relaxed.cost(goal.condition):
                    pause = min(most, goal.first - 1)
                    found.append(replace(idle, first=pause, last=pause))
        soon = node.relaxed.plan([stop for stop, _ in node.relaxed.due()])
        possible = filter(node.relaxed.possible, node.steps | soon)
        for step in sorted(possible, key=lambda step: (step not in soon, step)):
            delay, wait = self._relaxation.steps[step].delay, node.relaxed.wait(step)
            first = 0 if wait is None else math.ceil(wait / self.task.system.dt - EARLY)
            if first > most and self._relaxation.runs_by_itself(step):
                found.append(idle)
            else:
                first = first if first <= most - delay else 0
                found.append(PhaseRequest(self._first_step + step, first, most - delay, opened, delay))
        return [each for each in dict.fromkeys(found) if each.last >= each.first]

    def _grown(
        self, progression: Progression, node: Node, request: PhaseRequest, phase: Phase
    ) -> Node | None:
        """Return the node of a phase; None if it comes no nearer to its target."""
        assert self._phases is not None
        wanted = request.target < len(self._marks)
        length, tries, since = phase.sample + request.after, (*node.tries, request.target), 0
        if phase.margin < -UNSURE:
            now = self._phases.margin(node.states[-1], request)
            if (wanted and self._marks[request.target]) or phase.margin < (1.0 - NEARER) * now:
                return None
            length = phase.sample
        elif wanted:
            if not request.first:
                self._spent, self._made = self._spent + node.since + length, self._made + 1
            tries = ()
        elif request.target == self._idle:
            tries = ()
        else:
            since = node.since + length
        if not length:
            return None
        states = np.concatenate((node.states, phase.states[1 : length + 1]))
        plan = np.concatenate((node.plan, phase.plan[:length]))
        found = self._node(progression, states, plan, tries, since)
        late = self.steps // TAIL if phase.margin < 0.0 else 0
        return found and replace(found, tail=phase.plan[length:], time=found.time + late)

    def _ended(self, node: Node) -> Tensor:
        """Return the plan of a node, continued to the end of the mission, at last by the middle controls."""
        system, plan = self.task.system, node.plan
        if node.tail is not None:
            plan = np.concatenate((plan, node.tail))[: self.task.horizon]
        middle = 0.5 * (system.control_low + system.control_high).double()
        return torch.cat((torch.from_numpy(plan), middle.expand(self.task.horizon - len(plan), -1)))


def _is_kept(formula: ir.Formula) -> bool:
    """True for a requirement on every sample from the first one on, that no later one decides."""
    return (
        isinstance(formula, ir.Temporal)
        and formula.op == "always"
        and formula.window.lo <= 1
        and not looks_ahead(formula.body)
    )


def _needed(formulas: Sequence[ir.Formula]) -> tuple[ir.Formula, ...]:
    """Return the parts of a conjunction without goals that are met whenever another one is."""
    parts = list(dict.fromkeys(part for formula in formulas for part in formula.terms("and")))

    def later(one: ir.Formula, other: ir.Formula) -> bool:
        match one, other:
            case ir.Temporal("eventually", ir.Window(a, b), p), ir.Temporal("eventually", ir.Window(c, d), q):
                wider = b is None or (d is not None and d <= b)
                return p == q and a <= c and wider and (a, b) != (c, d)
            case _:
                return False

    return tuple(one for one in parts if not any(later(one, other) for other in parts))


def _moves(formula: ir.Formula, relaxed: RelaxedState) -> float:
    """Number of goals in the residual of a formula; inf if one of them is out of reach."""
    match formula:
        case ir.BoolOp("and", items):
            return sum(_moves(item, relaxed) for item in items)
        case ir.BoolOp("or", items):
            return min(_moves(item, relaxed) for item in items)
        case ir.Temporal("eventually", _, body) | ir.Until("until", _, _, body):
            return 1.0 + _moves(body, relaxed) if math.isfinite(relaxed.cost(body)) else math.inf
        case ir.Temporal("always", window, body) if window.lo > 1 and not looks_ahead(body):
            cost = relaxed.cost(body)
            return float(cost > 0.0) if math.isfinite(cost) else cost
        case _:
            return 0.0
