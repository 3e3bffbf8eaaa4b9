"""Closed loops of a system with a feed-forward network that acts once per control period.

The network reads what the system file lists under `policy: observe`, and its outputs, limited to the ranges
of the controls, are held for a period. The motion is that of the system file, with its integrator and
substeps, or the solution of its differential equations, with a bound on the error of every substep
(`stlc.assurance.verification.flow`). Proofs concern the samples. Counterexamples are simulated in the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import numpy as np
import torch

from stlc.assurance.verification.flow import Flow
from stlc.assurance.verification.forms import FORMS, Floats, Forms, in_use
from stlc.assurance.verification.network import (
    NetworkBounds,
    NetworkLayer,
    columns,
    joined,
    own_symbols,
    reduced,
)
from stlc.assurance.verification.subject import History, Indices, VerificationSubject
from stlc.controller.problem.task import Task
from stlc.diagnostics import usage

_KEPT = 40
"""Symbols besides those of the coordinates that states keep over a control period."""

_LARGE = 1e-7
"""Remainder of a state from which it becomes a symbol of later substeps."""

_ACTIVE: Mapping[str, Callable[[Any], Any]] = {
    "linear": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-x)),
}


@final
class NetworkLoop(VerificationSubject):
    """A system whose controls are the outputs of a network; there is one choice in each state.

    Args:
        task: specification and system.
        layers: layers of the network.
        period: control period in steps of the system.
        continuous: whether to bound the solutions of the differential equations, not the integrator's steps.

    Raises:
        UsageError: U101, a system that is not supported, or a network of other sizes.
    """

    batch = 64
    renumbers = True

    def __init__(
        self, task: Task, layers: Sequence[NetworkLayer], period: int = 1, *, continuous: bool = False
    ) -> None:
        super().__init__(task)
        try:
            self._flow = Flow(task.system.decl) if continuous else None
        except ValueError as error:
            raise usage(f"the solutions of `{task.system.decl.name}` cannot be bounded: {error}") from None
        self._layers, self._period = tuple(layers), period
        self._bounds = NetworkBounds(layers)
        self._low, self._high = (
            each.cpu().to(torch.float64).numpy()
            for each in (task.system.control_low, task.system.control_high)
        )
        inputs, outputs = layers[0].weight.shape[1], layers[-1].weight.shape[0]
        wanted = task.system.observed_count, len(self._controls)
        if (inputs, outputs) != wanted:
            raise usage(
                f"the network takes {inputs} numbers and gives {outputs}; the system observes {wanted[0]} "
                f"and has {wanted[1]} controls",
                "`policy: observe` in the system file lists the inputs of the network",
            )

    def robustness(self, x0: torch.Tensor) -> Floats:
        """Robustness of the simulations from states (B, n), (B,)."""
        with torch.no_grad():
            found: Floats = self._task.robustness(self.simulated(x0)).numpy()
        return found

    def choices(self, x0: torch.Tensor) -> Floats:
        """Robustness of the simulations from states (B, n), (B, 1)."""
        return self.robustness(x0)[:, None]

    def simulated(self, x0: torch.Tensor) -> torch.Tensor:
        """States of the closed loop from states (B, n): (B, T+1, n)."""
        x, states = x0, [x0]
        controls = torch.zeros(len(x0), len(self._controls), dtype=x0.dtype)
        with torch.no_grad():
            for step in range(self._task.horizon):
                if step % self._period == 0:
                    seen = self._task.system.observe(x).numpy()
                    controls = torch.from_numpy(np.clip(self._outputs(seen), self._low, self._high))
                x = self._task.system.step(x, controls)
                states.append(x)
        return torch.stack(states, 1)

    def _outputs(self, seen: Floats) -> Floats:
        """Outputs of the network, (B, outputs), computed in float32."""
        x = seen.astype(np.float32)
        with np.errstate(over="ignore"):
            for layer in self._layers:
                x = x @ layer.weight.T.astype(np.float32) + layer.bias.astype(np.float32)
                x = _ACTIVE[layer.activation](x).astype(np.float32)
        return x.astype(np.float64)

    def _followed(self, start: Mapping[str, Forms], index: Indices, count: int) -> tuple[History, bool]:
        env, history = dict(start), {name: [form] for name, form in start.items()}
        controls: list[Forms] = []
        symbols = count
        for step in range(self._task.horizon):
            if step % self._period == 0:
                moved = [env[name] for name in self._moved]
                if (used := in_use(moved)) > count + _KEPT:
                    # What is left out becomes one symbol for each state that moves.
                    states = own_symbols(reduced(joined(moved, used), count, _KEPT), 0.0)
                    env = {**env, **dict(zip(self._moved, columns(states), strict=True))}
                inputs = own_symbols(joined(self._seen(env, len(index)), in_use(env.values())))
                first = len(inputs.generators)
                outputs = own_symbols(reduced(self._bounds.outputs(inputs), first, 0), 0.0)
                controls = [
                    FORMS.clamp(each, float(low), float(high))
                    for each, low, high in zip(columns(outputs), self._low, self._high, strict=True)
                ]
                symbols = len(outputs.generators)
            if self._flow is None:
                env, symbols = self._step(env, controls, symbols)
            else:
                env, symbols = self._solved(self._flow, env, controls, symbols)
            for name, form in env.items():
                history[name].append(form)
        return history, True

    def _solved(
        self, flow: Flow, env: Mapping[str, Forms], controls: Sequence[Forms], symbols: int
    ) -> tuple[dict[str, Forms], int]:
        """Forms of the solution one step later, and the number of symbols."""
        held = dict(zip(self._controls, controls, strict=True))
        later = dict(env)
        for _ in range(self._task.system.decl.substeps):
            symbols = max(symbols, in_use(later.values()))
            for name, form in flow.step({**later, **held}, symbols).items():
                later[name] = form.with_symbol(symbols) if (form.rest > _LARGE).any() else form
                symbols = max(symbols, len(later[name].generators))
        return later, symbols
