"""Branch and bound over the initial states of a trained policy: proofs, counterexamples, and undecided boxes.

A box of initial states is *proved* if one fixed proposal of the network satisfies the specification from
every state in it, by bounds on plan, motion and robustness. The policy selects a plan that satisfies the
specification wherever one of its proposals does (`stlc.controller.problem.task.rank`; performance terms must
be numbers), so its plan satisfies it too. A box is *refuted* if the policy's plan from a sampled state in it
violates the specification. Refuted and other boxes are split in two (Bunel et al. 2018).

The proofs concern the first plan, in the model of the system, from states in float64, with the tolerance of
the monitor.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.policies.policy import BestOfKPolicy
from stlc.controller.verification.boxes import Mode, Unsupported, modes_of
from stlc.controller.verification.forms import FORMS, Floats, Forms, ranges
from stlc.controller.verification.network import PlanBounds
from stlc.diagnostics import usage
from stlc.dynamics.model.schedule import blocks
from stlc.dynamics.model.step import build_step

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

BATCH = 64
"""Boxes that are bounded at once."""

POINTS = 4
"""States that are sampled in each box: its centre and three at random."""


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Box of coordinates of a mode.

    Attributes:
        centre: (coordinates,).
        half: half of its width in each coordinate, (coordinates,).
        refuted: whether the policy violates the specification from a known state in it.
    """

    centre: Floats
    half: Floats
    refuted: bool = False

    @property
    def volume(self) -> float:
        """Share of the mode's probability."""
        return float(np.prod(2.0 * self.half))

    def split(self, axis: int) -> tuple[Box, Box]:
        """Return the two halves along a coordinate."""
        half = self.half.copy()
        half[axis] *= 0.5
        step = np.zeros_like(half)
        step[axis] = half[axis]
        return Box(self.centre - step, half, self.refuted), Box(self.centre + step, half, self.refuted)


@dataclass(frozen=True, slots=True)
class Witness:
    """Initial state from which the policy's plan violates the specification.

    Attributes:
        state: name of a state -> value.
        robustness: robustness of the selected plan, below 0.
    """

    state: dict[str, float]
    robustness: float


@dataclass(slots=True)
class ModeResult:
    """Result for one mode; shares are probabilities within the mode and add up to 1.

    Attributes:
        mode: the mode.
        proved: share of proved boxes.
        refuted: share of the boxes that contain a known counterexample.
        open: share of all other boxes.
        boxes: the proved boxes.
        examined: number of boxes that were bounded or refuted.
        witness: the counterexample with the least robustness; None if none was found.
    """

    mode: Mode
    proved: float = 0.0
    refuted: float = 0.0
    open: float = 1.0
    boxes: list[Box] = field(default_factory=list)
    examined: int = 0
    witness: Witness | None = None


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification: one entry per mode, and totals by the probabilities of the modes."""

    modes: tuple[ModeResult, ...]
    seconds: float

    @property
    def proved(self) -> float:
        """Probability of an initial state in a proved box."""
        return sum(each.mode.weight * each.proved for each in self.modes)

    @property
    def refuted(self) -> float:
        """Probability of an initial state in a box with a known counterexample."""
        return sum(each.mode.weight * each.refuted for each in self.modes)

    @property
    def open(self) -> float:
        """Probability of all other initial states."""
        return sum(each.mode.weight * each.open for each in self.modes)


class Verifier:
    """Branch and bound for one policy.

    Raises:
        UsageError: U101, a policy, system or distribution of initial states that is not supported.
    """

    def __init__(self, task: Task, policy: Policy, *, seed: int = 0) -> None:
        if not isinstance(policy, BestOfKPolicy):
            raise usage("only policies that select a proposal of a network can be verified: guided, gradient")
        decl = task.system.decl
        if task.compiled.timers or task.compiled.parameters or decl.feedback is not None:
            raise usage("the states that a specification or inner feedback adds cannot be verified yet")
        try:
            self._plans = PlanBounds(policy.network, task)
            self.modes = modes_of(decl.init)
        except (ValueError, Unsupported) as error:
            raise usage(f"this run cannot be verified: {error}") from None
        self._task, self._policy = task, policy
        step = build_step(decl, soft=False)
        numbers = dict(step.lets) | {f"{name}'": num for name, num in step.next.items()}
        self._blocks = [ArrayProgram(block) for block in blocks(numbers)]
        self._moved = tuple(step.next)
        self._observe = ArrayProgram({str(i): num for i, num in enumerate(task.system.observed)})
        self._controls = [control.name for control in decl.controls]
        self._rng = np.random.default_rng(seed)

    def run(self, seconds: float, *, boxes: int | None = None) -> Verification:
        """Return the result after at most about `seconds` of wall time.

        The mode with the largest box is next, so that all modes are divided into boxes of about one size.
        `boxes` is the maximum number of boxes that are examined per mode.
        """
        begun = time.monotonic()
        most = math.inf if boxes is None else boxes
        results = [ModeResult(mode) for mode in self.modes]
        queues = [deque([_whole(mode)]) for mode in self.modes]
        while time.monotonic() - begun < seconds:
            ready = [i for i, each in enumerate(results) if queues[i] and each.examined < most]
            if not ready:
                break
            largest = max(ready, key=lambda i: queues[i][0].volume)
            self._advance(results[largest], queues[largest])
        for result, queue in zip(results, queues, strict=True):
            result.refuted = sum(box.volume for box in queue if box.refuted)
            result.open = sum(box.volume for box in queue if not box.refuted)
        return Verification(tuple(results), time.monotonic() - begun)

    def _advance(self, result: ModeResult, queue: deque[Box]) -> None:
        """Examine one batch of boxes of a mode, the oldest and so the largest first."""
        boxes = [queue.popleft() for _ in range(min(BATCH, len(queue)))]
        result.examined += len(boxes)
        bad, index = self._sampled(result, boxes)
        good = [i for i in range(len(boxes)) if not bad[i]]
        for wrong in (box for box, refuted in zip(boxes, bad, strict=True) if refuted):
            queue.extend(replace(wrong, refuted=True).split(int(np.argmax(wrong.half))))
        for number in sorted({int(index[i]) for i in good}):
            rows = [i for i in good if index[i] == number]
            low, weight = self.bound(result.mode, [boxes[i] for i in rows], number)
            for i, least, effect in zip(rows, low, weight, strict=True):
                box = boxes[i]
                if least >= 0.0:
                    result.proved += box.volume
                    result.boxes.append(box)
                else:
                    queue.extend(Box(box.centre, box.half).split(int(np.argmax(effect))))

    # ---------------------------------------------------------------------------- samples

    def states(self, mode: Mode, at: Floats) -> torch.Tensor:
        """Initial states at coordinates (B, coordinates) from 0 to 1: (B, n) float64."""
        table = {name: at[:, i] for i, name in enumerate(mode.coordinates)} | {"": np.zeros(len(at))}
        columns = mode.states(table, self._task.system.names, NUMPY)
        return torch.from_numpy(np.stack([np.broadcast_to(each, len(at)) for each in columns], 1).copy())

    def robustness(self, x0: torch.Tensor) -> Floats:
        """Robustness of the plans that the policy selects from states (B, n), (B,)."""
        found: Floats = self._policy.plan_judged(x0)[1].rho.numpy()
        return found

    def _sampled(self, result: ModeResult, boxes: Sequence[Box]) -> tuple[Any, Any]:
        """Sample states in boxes.

        Returns:
            Whether a state in the box violates the specification, and the number of the proposal that is the
            most robust from its centre; (boxes,) each.
        """
        centre, half = np.stack([b.centre for b in boxes]), np.stack([b.half for b in boxes])
        moves = self._rng.uniform(-1.0, 1.0, (POINTS, *centre.shape))
        moves[0] = 0.0
        at = np.clip(centre + moves * half, 0.0, 1.0).reshape(-1, centre.shape[1])
        x0 = self.states(result.mode, at)
        rho = self.robustness(x0)
        worst = int(np.argmin(rho))
        if rho[worst] < -TOLERANCE and (result.witness is None or rho[worst] < result.witness.robustness):
            state = dict(zip(self._task.system.names, x0[worst].tolist(), strict=True))
            result.witness = Witness(state, float(rho[worst]))
        bad = (rho.reshape(POINTS, -1) < -TOLERANCE).any(0)
        middle = x0[: len(boxes)]
        with torch.no_grad():
            plans = self._policy.candidates(middle).to(torch.float64)
        count = plans.shape[1]
        judged = self._task.judge(middle.repeat_interleave(count, 0), plans.flatten(0, 1), states=False)
        return bad, judged.rho.view(-1, count).argmax(1).numpy()

    # ----------------------------------------------------------------------------- bounds

    def bound(self, mode: Mode, boxes: Sequence[Box], index: int) -> tuple[Floats, Floats]:
        """Bounds for one proposal over boxes.

        Args:
            mode: mode of the boxes.
            boxes: the boxes.
            index: number of the proposal.

        Returns:
            Lower bounds on the robustness of the proposal, (boxes,); and the effect of each coordinate on the
            predicted states, (boxes, coordinates).
        """
        table = {"": Forms.point(np.zeros(len(boxes)))}
        for i, name in enumerate(mode.coordinates):
            generators = np.zeros((i + 1, len(boxes)))
            generators[i] = [box.half[i] for box in boxes]
            centre = np.array([box.centre[i] for box in boxes])
            table[name] = Forms(centre, generators, np.zeros(len(boxes)))
        names = self._task.system.names
        try:
            drawn = mode.states(table, names, FORMS)
        except ValueError:
            return np.full(len(boxes), -np.inf), np.stack([box.half for box in boxes])
        with FORMS.quiet():
            history = self._predicted(dict(zip(names, drawn, strict=True)), len(boxes), index)
            return self._judged(history), self._effects(history, len(mode.coordinates))

    def _predicted(self, start: dict[str, Forms], batch: int, index: int) -> dict[str, list[Forms]]:
        """Forms of the states under one proposal: name -> one form (batch,) per sample of the plan."""
        env = {name: _full(form, batch) for name, form in start.items()}
        seen = self._observe(env, FORMS)
        plan = self._plans.plan([_full(seen[str(i)], batch) for i in range(len(seen))], index)
        history = {name: [form] for name, form in env.items()}
        for step in plan:
            moving = {**env, **dict(zip(self._controls, step, strict=True))}
            for block in self._blocks:
                moving.update(block(moving, FORMS))
            env = {**env, **{name: _full(moving[f"{name}'"], batch) for name in self._moved}}
            for name, form in env.items():
                history[name].append(form)
        return history

    def _judged(self, history: dict[str, list[Forms]]) -> Floats:
        """Lower bounds on the robustness of predicted states, (batch,)."""
        end = self._task.graph.end
        env: dict[str, Intervals] = {name: ranges(forms) for name, forms in history.items()}
        formulas = [rule.formula for rule in self._task.compiled.requirements]
        found = evaluate(formulas, env, ops=INTERVALS, end=end)
        least: Floats = np.min([each.low[0] for each in found], axis=0)
        return least

    def _effects(self, history: dict[str, list[Forms]], count: int) -> Floats:
        """Sum of the effects of each coordinate on the states that move, as shares of their ranges."""
        batch = len(next(iter(history.values()))[0].centre)
        total = np.full((count, batch), 1e-12)
        columns = {column.name: column for column in self._task.system.signature.columns}
        for name in self._moved:
            forms, column = history[name], columns[name]
            width = (column.high or 1.0) - (column.low or 0.0)
            for form in forms:
                share = np.abs(form.generators[:count]) / max(width, 1e-9)
                total[: len(share)] += share
        return total.T


def _full(form: Forms, batch: int) -> Forms:
    """The form with one element per box."""
    if form.shape == (batch,):
        return form
    generators = np.broadcast_to(
        form.generators.reshape(len(form.generators), -1), (len(form.generators), batch)
    )
    return Forms(np.broadcast_to(form.centre, batch), generators, np.broadcast_to(form.rest, batch))


def _whole(mode: Mode) -> Box:
    count = len(mode.coordinates)
    return Box(np.full(count, 0.5), np.full(count, 0.5))
