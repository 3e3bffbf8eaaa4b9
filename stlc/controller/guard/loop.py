"""A guarded policy for loops of one's own: one call a step, NumPy in and NumPy out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from stlc.controller.guard.guard import Guard, GuardDecision
from stlc.diagnostics import RunError


class GuardedLoop:
    """Guarded policy of a run: `u = guard(x)` at each step of a control loop.

    The states that the specification adds, such as timers, are carried from call to call. `reset` begins a
    new mission. An exported controller (`stlc.runtime.Controller`) is called in the same way.

    Args:
        guard: the guard, with its policy.
        seed: seed of the parameters of the specification, which are drawn at the start of a mission.
    """

    def __init__(self, guard: Guard, seed: int = 0) -> None:
        self.guard, self.seed = guard, seed
        self.decision: GuardDecision | None = None
        """The last decision, for all agents."""
        self._added = torch.zeros(0)

    def reset(self) -> None:
        """Prepare for a new mission: earlier plans are dropped, and timers return to their first values."""
        self.decision = None

    def __call__(self, state: ArrayLike | Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """Return the command to apply until the next call.

        Args:
            state: (n,), or (agents, n) for several agents, or values by state name, in the units of the
                system; without the states that the specification adds.

        Returns:
            (m,) or (agents, m): commands in the units of the system, float64.

        Raises:
            RunError: R107, the state has another shape, or is not finite.
        """
        system, names = self.guard.task.system, self.guard.task.plain.names
        before = None if self.decision is None else self.decision.later()
        rows = np.stack([state[name] for name in names], -1) if isinstance(state, Mapping) else state
        given = np.asarray(rows, dtype=np.float64)
        x = torch.from_numpy(np.atleast_2d(given))
        if x.shape[1:] != (len(names),) or not x.isfinite().all():
            help_ = (f"the columns are {', '.join(names)}",)
            message = f"no decision: a state of shape {given.shape}, or one that is not finite"
            raise RunError.of("R107", message, help=help_)
        generator = torch.Generator().manual_seed(self.seed)
        states = system.with_added(x, generator) if before is None else torch.cat((x, self._added), 1)
        self.decision, self._added = self.guard.decide(states, before), system.added_later(states)
        found: NDArray[np.float64] = system.commanded(states, self.decision.action).numpy()
        return found[0] if given.ndim == 1 else found
