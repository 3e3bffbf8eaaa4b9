"""Rollouts: time series of each state, (time, batch), computed with few array operations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir.support import columns_in
from stlc.compile.semantics.switch import Switch
from stlc.dynamics.model.schedule import RolloutStage, blocks, schedule
from stlc.dynamics.model.step import ModelStep

Columns = dict[str, Tensor]


@dataclass
class _Columns:
    """Values of a rollout of T steps while it is computed, for a batch of size B.

    Attributes:
        states: name of a state -> its samples, (T+1, B); before these are computed, its initial value, (B,).
        now: name of a state, control or intermediate result -> its values at the T steps, (T, B), or (B,) if
            they are constant.
    """

    states: Columns
    now: Columns
    steps: int
    batch: int
    switch: Switch

    def run(self, program: ArrayProgram) -> Columns:
        """Evaluate a program for all T steps in one call; return name of an output -> tensor."""
        like = next(iter(self.states.values()))
        outputs = program(self.now, TORCH, self.switch)
        return {
            name: torch.as_tensor(out, dtype=like.dtype, device=like.device) for name, out in outputs.items()
        }

    def enter(self, name: str, column: Tensor) -> None:
        """Store the samples (T+1, B) of the state `name`."""
        self.states[name] = column
        self.now[name] = column[:-1]

    def full(self, values: Tensor) -> Tensor:
        """Expand values to every step: (T, B) or, if constant over time, (B,) -> (T, B)."""
        return values.expand(self.steps, self.batch)

    def sliced(self, names: Iterable[str]) -> tuple[dict[str, Tensor], list[tuple[str, Sequence[Tensor]]]]:
        """Split the values called `names` into constant ones and those that change over time.

        Returns a mapping name -> tensor of the constant values, and pairs (name, one tensor per step) of the
        others.
        """
        fixed: dict[str, Tensor] = {}
        timed: list[tuple[str, Sequence[Tensor]]] = []
        for name in names:
            values = self.now[name]
            if values.dim() == 2 and values.shape[0] == self.steps and self.steps != 1:
                timed.append((name, values.unbind(0)))
            else:
                fixed[name] = values[0] if values.dim() == 2 else values
        return fixed, timed


class _Accumulated(torch.autograd.Function):
    """Running sum: start (B,) and increments (T, B) -> (T+1, B), with its gradient. Faster than `cumsum`."""

    @staticmethod
    def forward(ctx: Any, start: Tensor, increments: Tensor) -> Tensor:  # noqa: ARG004
        out = increments.new_empty(len(increments) + 1, increments.shape[1])
        rows = out.unbind(0)
        rows[0].copy_(start)
        for before, after, increment in zip(rows, rows[1:], increments.unbind(0), strict=False):
            torch.add(before, increment, out=after)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG004
        if torch.is_grad_enabled():  # the gradient is to be differentiated in turn
            later = grad.flip(0).cumsum(0).flip(0)
            return later[0], later[1:]
        below = grad.clone(memory_format=torch.contiguous_format)
        rows = below.unbind(0)
        for step in range(len(rows) - 2, -1, -1):
            rows[step].add_(rows[step + 1])
        return rows[0], below[1:]


def _accumulated(start: Tensor, increments: Tensor) -> Tensor:
    """Running sum: start (B,) and increments (T, B) -> (T+1, B).

    Uses `_Accumulated`, or the single operation `cumsum` while torch exports a program.
    """
    if torch.compiler.is_exporting():
        return torch.cat((start[None], increments)).cumsum(0)
    column: Tensor = _Accumulated.apply(start, increments)  # type: ignore[no-untyped-call]
    return column


class _StageRunner:
    """Compiled stage of a rollout (`RolloutStage`): states and expressions that are computed together.

    A call computes them for all steps and stores them in the given `_Columns`.
    """

    def __init__(self, stage: RolloutStage) -> None:
        self.stage = stage
        self.early = ArrayProgram(stage.early) if stage.early else None
        self.blocks = tuple(ArrayProgram(block) for block in stage.blocks)
        inside = stage.stepped.keys() | {name for block in stage.blocks for name in block}
        read = {name for block in stage.blocks for num in block.values() for name in columns_in(num)}
        self.outside = tuple(sorted(read - inside))

    def __call__(self, columns: _Columns) -> None:
        if self.early is not None:
            columns.now.update(columns.run(self.early))
        for state, source in self.stage.follows.items():
            start = columns.states[state]
            columns.enter(state, torch.cat((start[None], columns.full(columns.now[source]))))
        for state, source in self.stage.sums.items():
            increments = columns.full(columns.now[source])
            columns.enter(state, _accumulated(columns.states[state], increments))
        if self.blocks:
            self._loop(columns)

    def _loop(self, columns: _Columns) -> None:
        """Compute the states that depend on their own past, one time step after another."""
        stage = self.stage
        env, timed = columns.sliced(self.outside)
        kept = (*stage.stepped.values(), *stage.lets)
        history: dict[str, list[Tensor]] = {name: [] for name in kept}
        env.update((state, columns.states[state]) for state in stage.stepped)
        for step in range(columns.steps):
            env.update((name, values[step]) for name, values in timed)
            for block in self.blocks:
                env.update(block(env, TORCH, columns.switch))
            for name in kept:
                history[name].append(env[name])
            env.update((state, env[source]) for state, source in stage.stepped.items())
        for state, source in stage.stepped.items():
            start = columns.states[state]
            columns.enter(
                state, torch.stack([start, *(value.expand(columns.batch) for value in history[source])])
            )
        columns.now.update((name, torch.stack(history[name])) for name in stage.lets)


class Stepper:
    """A compiled step of a system: run once on a batch of states, or repeatedly over time."""

    def __init__(self, step: ModelStep) -> None:
        self.next = dict(step.next)
        numbers = dict(step.lets) | {f"{name}'": num for name, num in step.next.items()}
        self.once = tuple(ArrayProgram(block) for block in blocks(numbers))
        self.stages = tuple(_StageRunner(stage) for stage in schedule(step))

    def step(self, state: Mapping[str, Tensor], controls: Mapping[str, Tensor], switch: Switch) -> Columns:
        """Return the states (B,) one step later, by name; a state that does not move keeps its tensor.

        `switch` selects exact jumps or their smooth blends.
        """
        env = {**state, **controls}
        for block in self.once:
            env.update(block(env, TORCH, switch))
        like = next(iter(state.values()))
        moved = {
            name: torch.as_tensor(env[f"{name}'"], dtype=like.dtype, device=like.device) for name in self.next
        }
        return {**state, **{name: value.expand_as(like) for name, value in moved.items()}}

    def rollout(self, start: Columns, controls: Columns, steps: int, switch: Switch) -> Columns:
        """Roll out from states (B,) under controls (T, B), where T is `steps`; return state -> (T+1, B).

        If a state does not move, its tensor is an expanded view of the initial value. `switch` selects exact
        jumps or their smooth blends.
        """
        batch = next(iter(start.values())).shape[0]
        steady = {name: column for name, column in start.items() if name not in self.next}
        known = {**steady, **controls} or {
            "": next(iter(start.values()))
        }  # programs need an array to be like
        columns = _Columns(dict(start), known, steps, batch, switch)
        for stage in self.stages:
            stage(columns)
        columns.states.update((name, column.expand(steps + 1, batch)) for name, column in steady.items())
        return columns.states
