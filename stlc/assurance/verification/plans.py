"""Bounds and samples of the plans that a trained policy proposes, over boxes of initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stlc.assurance.verification.forms import FORMS, Bools, Floats, Forms, in_use, picked, spread, together
from stlc.assurance.verification.network import UNIT, PlanBounds
from stlc.assurance.verification.subject import History, Indices, VerificationSubject
from stlc.compile.ir import nodes as ir
from stlc.controller.policies.policy import BestOfKPolicy, Policy
from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.model.step import build_step

_GROUP = 256
"""Boxes whose network is bounded at once."""

_TOUCH = 1e-9
"""Overlap with the other side of a mirror symmetry up to which a box is taken to lie on one side."""


@dataclass(frozen=True, slots=True)
class PolicySource:
    """Policy of a run, for this process and others.

    Attributes:
        run: folder of the run.
    """

    run: Path

    def load(self) -> ProposedPlans:
        """Load the plans of the policy."""
        from stlc.controller.run.run import Run

        opened = Run.open(self.run)
        return ProposedPlans(opened.task, opened.policy)


class ProposedPlans(VerificationSubject):
    """Plans that the network of a policy proposes; the choices are the proposals.

    Raises:
        UsageError: U101, a policy, system or distribution of initial states that is not supported.
    """

    def __init__(self, task: Task, policy: Policy) -> None:
        if not isinstance(policy, BestOfKPolicy):
            raise usage("only policies that select a proposal of a network can be verified: guided, gradient")
        super().__init__(task)
        try:
            self._bounds = PlanBounds(policy.network, task)
        except ValueError as error:
            raise usage(f"this cannot be verified: {error}") from None
        self._policy = policy
        self._wrapped = {
            control.name: control.low
            for control in task.system.decl.controls
            if control.squash == "angle" and not _as_direction(control.name, task.system.decl)
        }

    # ---------------------------------------------------------------------------- samples

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

    def _followed(
        self,
        start: Mapping[str, Forms],
        index: Indices,
        count: int,  # noqa: ARG002
    ) -> tuple[History, Bools | bool]:
        plan, decided = self._plan(start, index)
        env, history = dict(start), {name: [form] for name, form in start.items()}
        symbols = in_use((*start.values(), *(control for step in plan for control in step)))
        for step in plan:
            env, symbols = self._step(env, step, symbols)
            for name, form in env.items():
                history[name].append(form)
        return history, decided

    def _plan(self, start: Mapping[str, Forms], index: Indices) -> tuple[list[list[Forms]], Bools | bool]:
        """Forms of the plan from states, and whether each box lies on one side of a mirror symmetry.

        A box that touches the plane of symmetry lies on the side of its centre; the plane itself belongs to
        the box on its other side, or to the boundary between two boxes.
        """
        mirror, batch = self._policy.network.mirror, len(next(iter(start.values())).centre)
        if mirror is None:
            return self._seen_plan(start, index), True
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
        """Controls of one step, mirrored where the states were.

        Angles are wrapped as by `Mirror.plans`. Those that are read as directions alone are not: the states
        are the same, and an angle near the end of the turn would be any.
        """
        mirror = self._policy.network.mirror
        assert mirror is not None
        given = dict(zip(self._controls, step, strict=True))
        image = given | mirror.image_of_controls(given, FORMS)
        for name, low in self._wrapped.items():
            form = image[name].widened(0.0, 16.0 * UNIT * (1.0 + np.abs(image[name].centre)))
            image[name] = FORMS.add(FORMS.mod(FORMS.sub(form, low), 2.0 * np.pi), low)
        return [
            picked(swapped, image[name], form).widened(0.0, 4.0 * UNIT * (1.0 + np.abs(form.centre)))
            for name, form in given.items()
        ]

    def _seen_plan(self, states: Mapping[str, Forms], index: Indices) -> list[list[Forms]]:
        """Forms of the plan from folded states; index: (boxes,)."""
        observed, symbols = self._seen(states, len(index)), in_use(states.values())
        order = [np.flatnonzero(index == number) for number in np.unique(index)]
        order = [rows[i : i + _GROUP] for rows in order for i in range(0, len(rows), _GROUP)]
        parts = [
            self._bounds.plan([form.at(rows) for form in observed], int(index[rows[0]]), symbols)
            for rows in order
        ]
        if len(parts) == 1:
            return parts[0]
        home = np.argsort(np.concatenate(order))
        return [
            [together(forms).at(home) for forms in zip(*steps, strict=True)]
            for steps in zip(*parts, strict=True)
        ]


def _as_direction(name: str, decl: SystemDecl) -> bool:
    """True if the motion reads a control as `sin(name)` and `cos(name)` alone."""
    step, read = build_step(decl, soft=False), ir.Signal(name)
    stack: list[Any] = [*(num for _, num in step.lets), *step.next.values()]
    while stack:
        part = stack.pop()
        if part == read:
            return False
        if part not in (read.apply("sin"), read.apply("cos")):
            stack.extend(part.children)
    return True
