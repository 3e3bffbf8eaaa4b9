"""Bounds and samples of the plans that a trained policy proposes, over boxes of initial states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.controller.policies.policy import BestOfKPolicy
from stlc.controller.verification.boxes import Box, Mode, Unsupported, corners, modes_of
from stlc.controller.verification.forms import FORMS, Bools, Floats, Forms, picked, spread, together
from stlc.controller.verification.judged import BoxVerdicts, Judge
from stlc.controller.verification.network import UNIT, PlanBounds
from stlc.diagnostics import usage
from stlc.dynamics.model.schedule import blocks
from stlc.dynamics.model.step import build_step

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

Indices: TypeAlias = NDArray[np.int64]

_DRAWN, _SEED = 200_000, 7
"""Number and seed of the states from which the share that meets `where` is bounded."""

_GROUP = 256
"""Boxes whose network is bounded at once."""

_TOUCH = 1e-9
"""Overlap with the other side of a mirror symmetry up to which a box is taken to lie on one side."""

_LARGE = 1e-3
"""Remainder of a state, as a share of its range, from which it becomes a symbol of later steps."""


class Plans:
    """Plans that the network of a policy proposes, as the subject of a verification.

    Attributes:
        modes: ways to draw an initial state.
        names: names of the states.

    Raises:
        UsageError: U101, a policy, system or distribution of initial states that is not supported.
    """

    def __init__(self, task: Task, policy: Policy) -> None:
        if not isinstance(policy, BestOfKPolicy):
            raise usage("only policies that select a proposal of a network can be verified: guided, gradient")
        decl = task.system.decl
        if task.compiled.timers or task.compiled.parameters or decl.feedback is not None:
            raise usage("the states that a specification or inner feedback adds cannot be verified yet")
        step = build_step(decl, soft=False)
        numbers = dict(step.lets) | {f"{name}'": num for name, num in step.next.items()}
        try:
            self._bounds = PlanBounds(policy.network, task)
            self.modes = modes_of(decl.init)
            self._blocks = [ArrayProgram(block) for block in blocks(numbers)]
        except (ValueError, Unsupported) as error:
            raise usage(f"this run cannot be verified: {error}") from None
        self._task, self._policy = task, policy
        self.names = tuple(task.system.names)
        self._moved = tuple(step.next)
        self._observe = ArrayProgram({str(i): num for i, num in enumerate(task.system.observed)})
        self._controls = [control.name for control in decl.controls]
        self._judge = Judge([rule.formula for rule in task.compiled.requirements], end=task.graph.end)
        columns = {column.name: column for column in task.system.signature.columns}
        self._sizes = {
            name: max((columns[name].high or 1.0) - (columns[name].low or 0.0), 1e-9) for name in self._moved
        }

    # ---------------------------------------------------------------------------- samples

    def states(self, mode: Mode, at: Floats) -> torch.Tensor:
        """Initial states at coordinates (B, coordinates) from 0 to 1: (B, n) float64."""
        table = {name: at[:, i] for i, name in enumerate(mode.coordinates)} | {"": np.zeros(len(at))}
        columns = mode.states(table, self.names, NUMPY)
        return torch.from_numpy(np.stack([np.broadcast_to(each, len(at)) for each in columns], 1).copy())

    def admits(self, mode: Mode, at: Floats) -> Bools:
        """Whether the states at coordinates (B, coordinates) meet the conditions of `where`, (B,)."""
        if mode.conditions is None:
            return np.ones(len(at), dtype=bool)
        columns = dict(zip(self.names, self.states(mode, at).numpy().T, strict=True))
        found: Bools = np.broadcast_to(mode.conditions.holds(columns), len(at))
        return found

    def acceptance(self, mode: Mode) -> float:
        """Upper bound on the share of drawn states that meet `where`, with confidence 1 - 1e-9.

        It is the share among `_DRAWN` states, and `sqrt(log(1e9) / (2 _DRAWN))` (Hoeffding 1963).
        """
        if mode.conditions is None:
            return 1.0
        rng = np.random.default_rng(_SEED)
        parts = [self.admits(mode, rng.random((_DRAWN // 8, len(mode.coordinates)))).mean() for _ in range(8)]
        return min(1.0, float(np.mean(parts)) + math.sqrt(9.0 * math.log(10.0) / (2.0 * _DRAWN)))

    def within(self, mode: Mode, box: Box) -> Box | Floats:
        """The box, if all states in it meet `where`; else the effects of coordinates on the conditions."""
        truth = mode.truths([box], self.names)
        effects: Floats = truth.effects[0]
        return replace(box, inside=True) if truth.sure[0] else effects

    def robustness(self, x0: torch.Tensor) -> Floats:
        """Robustness of the plans that the policy selects from states (B, n), (B,)."""
        found: Floats = self._policy.plan_judged(x0)[1].rho.numpy()
        return found

    def choices(self, x0: torch.Tensor) -> Floats:
        """Robustness of every proposal from states (B, n), (B, proposals)."""
        with torch.no_grad():
            plans = self._policy.candidates(x0).to(torch.float64)
        count = plans.shape[1]
        judged = self._task.judge(x0.repeat_interleave(count, 0), plans.flatten(0, 1), states=False)
        found: Floats = judged.rho.view(-1, count).numpy()
        return found

    # ----------------------------------------------------------------------------- bounds

    def bound(self, mode: Mode, boxes: Sequence[Box], index: int | Indices) -> BoxVerdicts:
        """Bounds on the robustness of one proposal in each box of a mode.

        `index` is the number of the proposal, or one number for each box, (boxes,).
        """
        count = len(mode.coordinates)
        try:
            drawn = mode.states(corners(boxes, mode.coordinates), self.names, FORMS)
        except ValueError:  # a root of a number that may be negative, over a large box
            unknown = np.full(len(boxes), np.inf)
            return BoxVerdicts(-unknown, unknown, np.stack([box.half for box in boxes]))
        start = {name: spread(form, len(boxes)) for name, form in zip(self.names, drawn, strict=True)}
        with FORMS.quiet():
            plan, decided = self._plan(start, np.broadcast_to(index, len(boxes)))
            history = self._predicted(start, plan)
            found = self._judge(history, count)
            effects = found.effects + self._effects(history, count)
        if decided is None:
            return found.weighed(effects)
        low, high = np.where(decided, found.low, -np.inf), np.where(decided, found.high, np.inf)
        return BoxVerdicts(low, high, effects)

    def _plan(self, start: Mapping[str, Forms], index: Indices) -> tuple[list[list[Forms]], Bools | None]:
        """Forms of the plan from states, and whether each box lies on one side of a mirror symmetry.

        A box that touches the plane of symmetry lies on the side of its centre; the plane itself belongs to
        the box on its other side, or to the boundary between two boxes.
        """
        mirror, batch = self._policy.network.mirror, len(next(iter(start.values())).centre)
        if mirror is None:
            return self._seen_plan(start, index), None
        image = dict(start) | {
            name: spread(form, batch) for name, form in mirror.image_of_states(start, FORMS).items()
        }
        side = self.names[mirror.side]
        ahead = FORMS.sub(start[side], image[side]).range
        swapped = ahead.low + ahead.high < 0.0
        decided = np.where(swapped, ahead.high <= _TOUCH, ahead.low >= -_TOUCH)
        folded = {name: picked(swapped, image[name], form) for name, form in start.items()}
        plan = self._seen_plan(folded, index)
        return [self._unfolded(step, swapped) for step in plan], decided

    def _unfolded(self, step: Sequence[Forms], swapped: Bools) -> list[Forms]:
        """Controls of one step, mirrored where the states were."""
        mirror = self._policy.network.mirror
        assert mirror is not None
        given = dict(zip(self._controls, step, strict=True))
        image = given | mirror.image_of_controls(given, FORMS)
        return [
            picked(swapped, image[name], form).widened(0.0, 4.0 * UNIT * (1.0 + np.abs(form.centre)))
            for name, form in given.items()
        ]

    def _seen_plan(self, states: Mapping[str, Forms], index: Indices) -> list[list[Forms]]:
        """Forms of the plan from folded states; index: (boxes,)."""
        seen = self._observe(states, FORMS)
        observed = [spread(seen[str(i)], len(index)) for i in range(len(seen))]
        order = [np.flatnonzero(index == number) for number in np.unique(index)]
        order = [rows[i : i + _GROUP] for rows in order for i in range(0, len(rows), _GROUP)]
        parts = [
            self._bounds.plan([form.at(rows) for form in observed], int(index[rows[0]])) for rows in order
        ]
        if len(parts) == 1:
            return parts[0]
        home = np.argsort(np.concatenate(order))
        return [
            [together(forms).at(home) for forms in zip(*steps, strict=True)]
            for steps in zip(*parts, strict=True)
        ]

    def _predicted(
        self, start: Mapping[str, Forms], plan: Sequence[Sequence[Forms]]
    ) -> dict[str, list[Forms]]:
        """Forms of the states under a plan: name -> one form (batch,) per sample of the plan."""
        env = dict(start)
        batch = len(next(iter(env.values())).centre)
        history = {name: [form] for name, form in env.items()}
        symbols = max(len(control.generators) for step in plan for control in step)
        for step in plan:
            moving = {**env, **dict(zip(self._controls, step, strict=True))}
            for block in self._blocks:
                moving.update(block(moving, FORMS))
            for name in self._moved:
                form = spread(moving[f"{name}'"], batch)
                symbols = max(symbols, len(form.generators))
                if (form.rest > _LARGE * self._sizes[name]).any():
                    form, symbols = form.with_symbol(symbols), symbols + 1
                env[name] = form
            for name, form in env.items():
                history[name].append(form)
        return history

    def _effects(self, history: Mapping[str, Sequence[Forms]], count: int) -> Floats:
        """Sum of the effects of each coordinate on the states that move, as shares of their ranges."""
        batch = len(next(iter(history.values()))[0].centre)
        total = np.full((count, batch), 1e-12)
        for name in self._moved:
            for form in history[name]:
                share = np.abs(form.generators[:count]) / self._sizes[name]
                total[: len(share)] += share
        return total.T
