"""Subject of a verification: initial states, and the motion of a system over boxes of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.assurance.verification.boxes import Box, Mode, Unsupported, corners, modes_of
from stlc.assurance.verification.forms import FORMS, Bools, Floats, Forms, spread
from stlc.assurance.verification.judged import BoxVerdicts, Judge
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.diagnostics import usage
from stlc.dynamics.model.rollout import Stepper
from stlc.dynamics.model.step import build_step

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

Indices: TypeAlias = NDArray[np.int64]
History: TypeAlias = dict[str, list[Forms]]
"""Name of a state -> one form (batch,) per sample."""

_DRAWN, _SEED = 200_000, 7
"""Number and seed of the states from which the share that meets `where` is bounded."""

_STATES = 0.1
"""Weight of the effects on the states, beside those on the undecided predicates, in the choice of a split."""

_LARGE = 1e-3
"""Remainder of a state, as a share of its range, from which it becomes a symbol of later steps."""


class VerificationSubject(ABC):
    """A controller of a system, whose behaviour is bounded over boxes of initial states.

    It has one or more choices in each state; the controller satisfies the specification wherever one of them
    does.

    Attributes:
        modes: ways to draw an initial state.
        names: names of the states.
        batch: number of boxes that are bounded at once.
        renumbers: whether symbols other than those of the coordinates may change their meaning over time.

    Raises:
        UsageError: U101, a system or distribution of initial states that is not supported.
    """

    batch = 512
    renumbers = False

    def __init__(self, task: Task) -> None:
        decl = task.system.decl
        if task.compiled.timers or task.compiled.parameters or decl.feedback is not None:
            raise usage("the states that a specification or inner feedback adds cannot be verified yet")
        try:
            self.modes = modes_of(decl.init)
            step = build_step(decl, soft=False)
            self._stepper = Stepper(step)
        except (ValueError, Unsupported) as error:
            raise usage(f"this cannot be verified: {error}") from None
        self._task = task
        self.names = tuple(task.system.names)
        self._moved = self._stepper.moving
        self._observe = ArrayProgram({str(i): num for i, num in enumerate(task.system.observed)})
        self._controls = [control.name for control in decl.controls]
        formulas = [rule.formula for rule in task.compiled.requirements]
        self._judge = Judge(formulas, end=task.graph.end, apart=self.renumbers)
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
        """True if the states at coordinates (B, coordinates) meet the conditions of `where`, (B,)."""
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

    @abstractmethod
    def robustness(self, x0: torch.Tensor) -> Floats:
        """Robustness of the controller's behaviour from states (B, n), (B,)."""

    @abstractmethod
    def choices(self, x0: torch.Tensor) -> Floats:
        """Robustness of every choice from states (B, n), (B, choices)."""

    # ----------------------------------------------------------------------------- bounds

    def bound(self, mode: Mode, boxes: Sequence[Box], index: int | Indices) -> BoxVerdicts:
        """Bounds on the robustness of one choice in each box of a mode.

        `index` is the number of the choice, or one number for each box, (boxes,).
        """
        count = len(mode.coordinates)
        drawn = mode.states(corners(boxes, mode.coordinates), self.names, FORMS)
        start = {name: spread(form, len(boxes)) for name, form in zip(self.names, drawn, strict=True)}
        with FORMS.quiet():
            history, decided = self._followed(start, np.broadcast_to(index, len(boxes)), count)
            found = self._judge(history, count)
            states = self._effects(history, count)
            effects = _shares(found.effects) + _STATES * _shares(states)
        low, high = np.where(decided, found.low, -np.inf), np.where(decided, found.high, np.inf)
        return BoxVerdicts(low, high, effects)

    @abstractmethod
    def _followed(
        self, start: Mapping[str, Forms], index: Indices, count: int
    ) -> tuple[History, Bools | bool]:
        """Forms of the states of a choice, and whether they hold for each box; `count` coordinates."""

    def _seen(self, states: Mapping[str, Forms], batch: int) -> list[Forms]:
        """Inputs of the network, (batch,) each."""
        seen = self._observe(states, FORMS)
        return [spread(seen[str(i)], batch) for i in range(len(seen))]

    def _step(
        self, env: Mapping[str, Forms], controls: Sequence[Forms], symbols: int
    ) -> tuple[dict[str, Forms], int]:
        """Forms of the states one step later, and the number of symbols; large remainders become symbols."""
        batch = len(next(iter(env.values())).centre)
        now, later = {**env, **dict(zip(self._controls, controls, strict=True))}, dict(env)
        for name, moved in self._stepper.step(now, FORMS).items():
            form = spread(moved, batch)
            symbols = max(symbols, len(form.generators))
            if (form.rest > _LARGE * self._sizes[name]).any():
                form, symbols = form.with_symbol(symbols), symbols + 1
            later[name] = form
        return later, symbols

    def _effects(self, history: History, count: int) -> Floats:
        """Sum of the effects of each coordinate on the states that move, as shares of their ranges."""
        batch = len(next(iter(history.values()))[0].centre)
        total = np.full((count, batch), 1e-12)
        for name in self._moved:
            for form in history[name]:
                share = np.nan_to_num(np.abs(form.generators[:count])) / self._sizes[name]
                total[: len(share)] += share
        return total.T


def _shares(effects: Floats) -> Floats:
    """Effects as shares of those of all coordinates of a box, (boxes, coordinates)."""
    found: Floats = effects / effects.sum(1, keepdims=True)
    return found
