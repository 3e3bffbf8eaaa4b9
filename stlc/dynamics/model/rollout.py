"""Rollouts: time series of each state, (time, batch), computed with few operations of any array library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.switch import Switch
from stlc.dynamics.model.schedule import RolloutStage, blocks, schedule
from stlc.dynamics.model.step import ModelStep

Columns = dict[str, Array]
"""Name of a state, control or intermediate result -> its values."""


@dataclass
class _Rollout:
    """A rollout of T steps while it is computed, for a batch of size B.

    Attributes:
        start: name of a state -> initial values, (1, B).
        now: name of a state, control or intermediate result -> its values at the T steps, (T, B), or (1, B)
            if they are constant.
        states: name of a state -> its samples, (T+1, B).
    """

    start: Mapping[str, Array]
    now: Columns
    steps: int
    ops: Ops
    switch: Switch | None
    states: Columns = field(default_factory=dict)

    def enter(self, name: str, column: Array) -> None:
        """Store the samples (T+1, B) of the state `name`."""
        self.states[name] = column
        self.now[name] = column[:-1]


class _Stage:
    """Compiled stage of a rollout (`RolloutStage`): states and expressions that are computed together.

    A call computes them for all steps.
    """

    def __init__(self, stage: RolloutStage) -> None:
        self.stage = stage
        self.early = ArrayProgram(stage.early) if stage.early else None
        self.blocks = tuple(map(ArrayProgram, stage.blocks))
        inside = stage.stepped.keys() | {name for block in stage.blocks for name in block}
        read = {name for block in stage.blocks for num in block.values() for name in num.columns}
        self.outside = sorted(read - inside)

    def __call__(self, rollout: _Rollout) -> None:
        ops, start, now, steps = rollout.ops, rollout.start, rollout.now, rollout.steps
        if self.early is not None:
            now.update(self.early(now, ops, rollout.switch))
        for state, source in self.stage.follows.items():
            rollout.enter(state, ops.cat([start[state], ops.repeat(now[source], steps)]))
        for state, source in self.stage.sums.items():
            rollout.enter(state, ops.accumulate(start[state], ops.repeat(now[source], steps)))
        if self.blocks:
            self._loop(rollout)

    def _loop(self, rollout: _Rollout) -> None:
        """Compute the states that depend on their own past, one time step after another."""
        moving, ops = self.stage.stepped, rollout.ops
        kept = list(dict.fromkeys((*moving.values(), *self.stage.lets)))  # the next states come first
        read = (*self.outside, *moving)

        def step(now: Sequence[Array], rows: Sequence[Array]) -> tuple[list[Array], list[Array]]:
            env = dict(zip(read, (*rows, *now), strict=True))
            for block in self.blocks:
                env.update(block(env, ops, rollout.switch))
            found = [env[name] for name in kept]
            return found[: len(moving)], found

        carry, rows = [rollout.start[name] for name in moving], [rollout.now[name] for name in self.outside]
        found = dict(zip(kept, ops.scan(step, carry, rows, rollout.steps), strict=True))
        for state, source in moving.items():
            rollout.enter(state, ops.cat([rollout.start[state], *found[source]]))
        rollout.now.update((name, ops.cat(found[name])) for name in self.stage.lets)


class Stepper:
    """A compiled step of a system over any array library: made once, or repeatedly over time.

    Attributes:
        moving: names of the states that move.
    """

    def __init__(self, step: ModelStep) -> None:
        self.moving = tuple(step.next)
        self._once = tuple(map(ArrayProgram, blocks(step.numbers)))
        self._stages = tuple(map(_Stage, schedule(step)))

    def step(self, now: Mapping[str, Array], ops: Ops, switch: Switch | None = None) -> Columns:
        """Return the states that move, one step later.

        Args:
            now: name of a state or control -> its values; their shapes must broadcast.
            ops: the array library.
            switch: exact jumps or their smooth blends; None: exact ones.
        """
        env = dict(now)
        for block in self._once:
            env.update(block(env, ops, switch))
        return {name: env[f"{name}'"] for name in self.moving}

    def rollout(
        self,
        start: Mapping[str, Array],
        controls: Mapping[str, Array],
        steps: int,
        ops: Ops,
        switch: Switch | None = None,
    ) -> Columns:
        """Roll out from states (1, B) under controls (T, B), where T is `steps`; return state -> (T+1, B).

        If a state does not move, its array is an expanded view of the initial value. `ops` is the array
        library. `switch` selects exact jumps (also None) or their smooth blends.
        """
        if not steps:
            return dict(start)
        still = {name: value for name, value in start.items() if name not in self.moving}
        # programs need an array to be like
        known = {**still, **controls} or {"": next(iter(start.values()))}
        rollout = _Rollout(start, known, steps, ops, switch)
        for stage in self._stages:
            stage(rollout)
        return {
            name: rollout.states[name] if name in rollout.states else ops.repeat(value, steps + 1)
            for name, value in start.items()
        }
