"""Search for whole plans as sequences of phases, for missions whose goals need many steps in order.

A node is a prefix of a plan. What is left of the requirements after it gives the pending goals. A relaxed
plan for them (`relaxation`) gives the jumps, waits and goals to try next, and the time that they take. Each
is tried by a short search for a phase that reaches it and stays safe until then (`phases`). A phase that is
found, appended to the prefix, is a further node. The node of least estimated total time is extended first.
Nothing here knows a task: the order of the phases follows from the requirements and the guards of the jumps.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count, product
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined, pieces
from stlc.compile.ir.support import reach
from stlc.compile.ir.traverse import nodes
from stlc.controller.search.newton import values_of
from stlc.controller.search.sequences.obligations import Obligations
from stlc.controller.search.sequences.phases import Ask, Phase, Phases
from stlc.controller.search.sequences.relaxation import Relaxation, RelaxedState
from stlc.controller.search.sequences.residuals import NO, YES, Progression, looks_ahead
from stlc.controller.search.starts import extremes

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray
    from torch import Tensor

    from stlc.controller.problem.task import Task

    Numbers = NDArray[np.float64]

LENGTHS = 16, 48
"""Least and greatest number of steps of a phase."""
SHARE = 6
"""A phase may take this part of the mission, within `LENGTHS`."""
ALTERNATIVES = 8
"""Largest number of alternatives into which the `or`s of one goal are written out."""
PROBES = 32
"""Number of plans that show the typical sizes of margins."""
NEARER = 0.05
"""Share of its distance by which a phase that fails must come nearer to its target, to be kept as a node."""
GREED = 2.0
"""Weight of the time that the missing steps take, beside the length of the prefix."""
EARLY = 1e-6
"""Share of a step by which a wait may end early, for rounding."""
TRIES = 8
"""Number of phases that are tried for each step of the relaxed plan at the start."""
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
        left: what is left of the obligations.
        goals: goals that are pending.
        steps: jumps and waits of a relaxed plan for what is left.
        missing: number of these steps, and of the goals that are left.
        time: time that these steps take, in steps of the plan.
        relaxed: relaxed plans from the last state.
        tries: targets of the last phases, if these came nearer to them without reaching one.
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


class Sequences:
    """Search for plans of one task as sequences of phases.

    Args:
        task: specification and system.
        state: a state at the start of a mission, (n,).
    """

    def __init__(self, task: Task, state: Tensor) -> None:
        self.task = task
        self._spent, self._made = 8.0, 1
        self._obligations = Obligations(task)
        self._state = state
        self.steps = min(max(task.horizon // SHARE, LENGTHS[0]), LENGTHS[1], task.horizon)
        obligations = self._obligations.first
        self._untils = tuple(
            node for node in obligations if isinstance(node, ir.Until) and not looks_ahead(node.left)
        )
        self._kept = tuple(ir.BoolOp("or", (each.left, _present(each.right))) for each in self._untils)
        self._safe = tuple(
            self._obligations.within(piece.body)
            for rule in task.rules
            for piece in pieces(rule.formula)
            if isinstance(piece, ir.Temporal) and piece.op == "always" and not looks_ahead(piece.body)
        )
        conditions = dict.fromkeys(each for formula in obligations for each in self._conditions(formula))
        self._relaxation = Relaxation(
            task.system, (*self._safe, *self._kept), [*obligations, *conditions], state.numpy()
        )
        steps = self._relaxation.steps
        self._targets = (*conditions, *(step.target for step in steps), YES)
        self._target = {condition: i for i, condition in enumerate(conditions)}
        self._first_step, self._idle = len(conditions), len(self._targets) - 1
        self._modes = [task.system.names.index(name) for name in self._relaxation.modes]

    @cached_property
    def _phases(self) -> Phases | None:
        late = {self._first_step + i for i, step in enumerate(self._relaxation.steps) if step.delay}
        safe, scale = joined("and", self._safe, YES), self._scales(self._targets, self._state)
        return Phases.of(self.task.system, safe, self._targets, late, self._kept, self.steps, scale)

    def root(self, state: Tensor) -> Node | None:
        """Return the empty prefix at `state`, (n,), None if nothing leads from there to all goals."""
        progression = Progression(self._obligations.at(state), self.task.horizon)
        return self._node(progression, state.numpy()[None], self._nothing)

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
            dict.fromkeys(part for each in targets for part in nodes(each) if isinstance(part, ir.Predicate))
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
                return [formula] if reach(formula).future <= self.steps // 2 else [body]
            case ir.BoolOp("or", items):
                return [each for item in items for each in self._alternatives(item)]
            case ir.BoolOp("and", items):
                parts = [found for item in items if (found := self._alternatives(item))]
                whole = [joined("and", combined, YES) for combined in product(*parts)] if parts else []
                return whole[:ALTERNATIVES]
            case _:
                return []

    # ------------------------------------------------------------------------------- search

    def plans(self, state: Tensor, random: Generator, effort: int = 1) -> Iterator[Tensor | None]:
        """Search for plans from `state`, (n,): yield each that is complete, (T, m), and None after each try.

        The plans keep the safety requirements and meet the goals as far as phases see them; whether they
        satisfy the specification is to be judged. `effort` is a factor of the tries for each phase.
        """
        if self._phases is None:
            return
        order, seen = count(), dict[object, list[int]]()
        progression = Progression(self._obligations.at(state), self.task.horizon)
        heap: list[tuple[float, int, Node]] = []

        def add(states: Numbers, plan: Numbers, tries: tuple[int, ...] = ()) -> None:
            node = self._node(progression, states, plan, tries)
            if node is None:
                return
            times = seen.setdefault(self._key(node), [])
            if sum(time <= len(plan) for time in times) < TWINS:
                times.append(len(plan))
                heapq.heappush(heap, (len(plan) + GREED * node.time, next(order), node))

        add(state.numpy()[None], self._nothing)
        tries = TRIES * effort * (1.0 + heap[0][2].missing) if heap else 0.0
        while heap and tries > 0:
            node = heapq.heappop(heap)[2]
            if not node.missing:
                yield self._ended(node)
            for ask, delay in self._asks(node):
                phase = self._phases.reach(node.states[-1], ask, random, effort)
                if found := self._grown(node, ask, delay, phase):
                    add(*found)
                tries -= 1
                yield None

    def _node(
        self, progression: Progression, states: Numbers, plan: Numbers, tries: tuple[int, ...] = ()
    ) -> Node | None:
        """Return the node of a prefix; None if it has lost a requirement, or a goal that no jump can meet."""
        env = {name: states[:, i : i + 1] for i, name in enumerate(self.task.system.names)}
        left = progression.after(env)
        if NO in left:
            return None
        relaxed = self._relaxation.at(states[-1])
        goals = tuple(goal for formula in left for goal in self._goals(formula))
        moves = sum(_moves(formula, relaxed) for formula in left)
        if not math.isfinite(moves):
            return None
        steps = relaxed.plan(left)
        waits = [wait / self.task.system.dt for step in steps if (wait := relaxed.wait(step)) is not None]
        time = (moves + len(steps) - len(waits)) * self._spent / self._made + sum(waits)
        return Node(states, plan, left, goals, steps, moves + len(steps), time, relaxed, tries)

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

    def _asks(self, node: Node) -> list[tuple[Ask, int]]:
        """Return what to try from a node, each with the samples that follow after the target is reached."""
        rest = self.task.horizon - len(node.plan)
        if not rest:
            return []
        most = min(self.steps, rest)
        opened = frozenset(
            i
            for i, until in enumerate(self._untils)
            if any(isinstance(part, ir.Until) and part.left is until.left for part in node.left)
        )
        if not node.missing:
            return [(Ask(self._idle, most, most, opened), 0)]
        found: list[tuple[Ask, int]] = []
        for goal in sorted(node.goals, key=lambda goal: goal.last):
            if node.relaxed.ready(goal.condition):
                last = min(goal.last, most - reach(goal.condition).future)
                first = goal.first if goal.first <= last else 0
                found.append((Ask(goal.target, first, last, opened), reach(goal.condition).future))
                if goal.first > 1 and not node.relaxed.cost(goal.condition):
                    pause = min(most, goal.first - 1)
                    found.append((Ask(self._idle, pause, pause, opened), 0))
        for step in sorted(filter(node.relaxed.possible, node.steps)):
            delay, wait = self._relaxation.steps[step].delay, node.relaxed.wait(step)
            first = 0 if wait is None else math.ceil(wait / self.task.system.dt - EARLY)
            if first > most and self._relaxation.runs_by_itself(step):
                found.append((Ask(self._idle, most, most, opened), 0))
            else:
                first = first if first <= most - delay else 0
                found.append((Ask(self._first_step + step, first, most - delay, opened), delay))
        return [each for each in dict.fromkeys(found) if each[0].last >= each[0].first]

    def _grown(
        self, node: Node, ask: Ask, delay: int, phase: Phase
    ) -> tuple[Numbers, Numbers, tuple[int, ...]] | None:
        assert self._phases is not None
        tries: tuple[int, ...] = ()
        if phase.margin < 0.0:
            now = self._phases.margin(node.states[-1], ask)
            if not phase.sample or phase.margin < (1.0 - NEARER) * now:
                return None
            tries, delay = (*node.tries, ask.target), 0
        length = phase.sample + delay
        if ask.target != self._idle and not tries:
            self._spent, self._made = self._spent + length, self._made + 1
        states = np.concatenate((node.states, phase.states[1 : length + 1]))
        return states, np.concatenate((node.plan, phase.plan[:length])), tries

    def _key(self, node: Node) -> object:
        modes = tuple(node.states[-1, self._modes])
        goals = tuple(sorted({goal.target for goal in node.goals}))
        return modes, goals, node.steps, node.tries

    def _ended(self, node: Node) -> Tensor:
        """Return the plan of a node, continued to the end of the mission with its middle controls."""
        system, rest = self.task.system, self.task.horizon - len(node.plan)
        middle = 0.5 * (system.control_low + system.control_high).double()
        return torch.cat((torch.from_numpy(node.plan), middle.expand(rest, -1)))


def _present(formula: ir.Formula) -> ir.Formula:
    """Return a formula without its operators of the future, which become true."""
    match formula:
        case ir.BoolOp(op, items):
            return joined(op, map(_present, items), ir.Truth(op == "and"))
        case _:
            return YES if looks_ahead(formula) else formula


def _moves(formula: ir.Formula, relaxed: RelaxedState) -> float:
    """Number of goals in what is left of a formula; inf if one of them is out of reach."""
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
