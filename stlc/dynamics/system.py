"""System built from its declaration: steps, rollouts, initial states and objective as tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from stlc.compile.augment.timers import Timer
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.frontend.interface import Interface
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.typed import Parameter
from stlc.compile.semantics.switch import Switch
from stlc.diagnostics import Diagnostic, SystemFileError, usage
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.functions import load_functions
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.model.cost import PlanCost
from stlc.dynamics.model.feedback import unstable
from stlc.dynamics.model.mirror import Mirror
from stlc.dynamics.model.rollout import Columns, Stepper
from stlc.dynamics.model.samplers import Drawing, InitialStates, Rows
from stlc.dynamics.model.step import ModelStep, build_step
from stlc.dynamics.scenario import truth, under
from stlc.files import File
from stlc.source import Source
from stlc.tabular import html_table

PROBED = 1000
"""Maximum number of steps of a probe: divergence shows early, and a horizon may be long."""


class System:
    """A controlled hybrid system in discrete time (Meng and Fan 2023, Eq. 1 and 6).

    Tensors are float32 or float64 on any device; dtype and device follow the input. `B` is the batch, `T` the
    number of steps, `n` the number of states, `m` the number of controls.

    Attributes:
        decl: declaration from the system file.
        horizon: steps of a plan; those of the system file unless plans reach to the end of a mission.
        timers: states, such as clocks, that a specification adds; they are the last columns.
        parameters: random constants of a trajectory that a specification adds; their columns precede the
            timers.
        added: columns of `parameters` and `timers`.
        signature: all state columns, in order.
        initial: distribution of the initial states that the system file declares, without `added`.
    """

    def __init__(
        self,
        decl: SystemDecl,
        timers: Sequence[Timer] = (),
        parameters: Sequence[Parameter] = (),
        *,
        plan: int | None = None,
    ) -> None:
        self.decl = decl
        self.horizon = decl.horizon if plan is None else plan
        self.timers = tuple(timers)
        self.parameters = tuple(parameters)
        self.added = (*(each.column for each in parameters), *(timer.column for timer in timers))
        self.signature = decl.signature.extended(*self.added)
        self.initial = InitialStates(decl.init, decl.signature.names)
        self._steppers: dict[bool, Stepper] = {}

    @property
    def facts(self) -> str:
        """Name and size in words, such as "car: 7 states, 1 control, 25 steps of 0.1 s"."""
        sizes = {"state": len(self.names), "control": len(self.control_names)}
        counts = ", ".join(f"{count} {noun}{'s'[: count != 1]}" for noun, count in sizes.items())
        return f"{self.decl.name}: {counts}, {self.horizon} steps of {self.dt:g} s"

    def __repr__(self) -> str:
        return f"System({self.facts})"

    def _repr_html_(self) -> str:
        states = [
            (each.name, each.role, each.unit.text, each.low, each.high) for each in self.signature.columns
        ]
        controls = [
            (each.name, "control", each.unit.text, each.low, each.high) for each in self.decl.controls
        ]
        rows = [tuple("" if cell is None else f"{cell}" for cell in row) for row in (*states, *controls)]
        return html_table(self.facts, ("signal", "role", "unit", "least", "greatest"), rows)

    def __deepcopy__(self, memo: object) -> Self:
        """Return the system itself, which is immutable."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(System, plan=self.horizon), (self.decl, self.timers, self.parameters)

    @classmethod
    def load(
        cls,
        path: Path | str | Source,
        overrides: Mapping[str, str] | None = None,
        *,
        scenario: str | None = None,
    ) -> System:
        """Load a system file, by path, by name (`stlc.files.File.system`) or as a text; apply a scenario.

        Raises UsageError if it does not exist, SystemFileError if it is invalid.
        """
        found = path if isinstance(path, Source) else File(path).system()
        decl = load_system_decl(found, overrides or {})
        return cls(decl if scenario is None else under(decl, scenario))

    @cached_property
    def truth(self) -> System:
        """The true system: this model with the model mismatch of the scenario applied.

        If the scenario has no mismatch, it is this system itself. Otherwise the result lacks the parameters
        and timers that a specification adds.
        """
        real = truth(self.decl)
        return self if real is self.decl else System(real, plan=self.horizon)

    def of_agents(self, rows: Tensor) -> System:  # noqa: ARG002
        """The true system of some of the agents that are stepped in one batch, `rows`, (k,) int64.

        It is this system, unless each agent has its own.
        """
        return self

    def augmented(self, timers: Sequence[Timer], parameters: Sequence[Parameter] = ()) -> System:
        """Return the same system with the parameters and timers of a specification as its last state columns.

        Each parameter is drawn once per trajectory. The next value of a timer is computed from the present
        states; no gradient flows through it. Initial states include the initial values of the timers.
        """
        timers, parameters = (*self.timers, *timers), (*self.parameters, *parameters)
        return System(self.decl, timers, parameters, plan=self.horizon)

    def planned_for(self, steps: int) -> System:
        """Return the same system with plans of `steps` steps."""
        return System(self.decl, self.timers, self.parameters, plan=steps)

    def assuming(self, conditions: Mapping[str, ir.Formula]) -> System:
        """Return the same system with further conditions on the initial states that it draws.

        `conditions`: text for messages -> condition on the columns of the system file.
        """
        init = self.decl.init
        where = (*init.where, *conditions.values())
        init = replace(init, where=where, where_text=(*init.where_text, *conditions))
        return System(replace(self.decl, init=init), self.timers, self.parameters, plan=self.horizon)

    def interface(self) -> Interface:
        """The interface that specifications are compiled against, with external functions loaded.

        Raises SystemFileError (S208) if a function cannot be loaded.
        """
        return replace(self.decl.interface(), functions=load_functions(self.decl))

    # ---------------------------------------------------------------- description

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the state columns."""
        return self.signature.names

    @cached_property
    def dt(self) -> float:
        """Time step in seconds."""
        return float(self.decl.dt)

    @cached_property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(control.name for control in self.decl.controls)

    @cached_property
    def control_low(self) -> Tensor:
        """Lower ends of the control ranges, (m,)."""
        return torch.tensor([control.low for control in self.decl.controls], dtype=torch.float32)

    @cached_property
    def control_high(self) -> Tensor:
        """Upper ends of the control ranges, (m,)."""
        return torch.tensor([control.high for control in self.decl.controls], dtype=torch.float32)

    @property
    def actuators(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of each actuator; with inner feedback the ranges of planned controls are wider."""
        if self.decl.feedback is None:
            return tuple((control.low, control.high) for control in self.decl.controls)
        return tuple(zip(self.decl.feedback.low, self.decl.feedback.high, strict=True))

    @property
    def observed_count(self) -> int:
        """Number of inputs of the policy network."""
        return len(self.observed)

    # -------------------------------------------------------------------- motion

    def step(self, x: Tensor, u: Tensor, switch: Switch | None = None) -> Tensor:
        """Make one step from states `x` (B, n) under planned controls `u` (B, m).

        Returns the next states (B, n). `switch` selects smooth blends of jumps, which are exact by default.
        """
        before = self._named(x)
        moved = self._stepper(switch).step(before | self._inputs(u), TORCH, switch)
        later = before | moved | self._later(before)
        return torch.stack([later[name] for name in self.names], 1)

    def with_added(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """Append the parameters and timers of a specification to states: (B, n - added) -> (B, n).

        The parameters are drawn with `generator`; the timers get their initial values.
        """
        return self.with_drawn(states, Rows(len(states), generator))

    def with_drawn(self, states: Tensor, rows: Rows) -> Tensor:
        """Append parameters, drawn with the random numbers `rows`, and timers: (B, n - added) -> (B, n)."""
        if not self.added:
            return states
        table = dict(zip(self.decl.signature.names, states.double().unbind(1), strict=True))
        for drawing in self._drawings:
            table[drawing.name] = drawing(table, rows)
        drawn = [table[each.column.name].to(states) for each in self.parameters]
        clocks = [torch.full_like(states[:, 0], timer.initial) for timer in self.timers]
        return torch.cat((states, torch.stack([*drawn, *clocks], 1)), 1)

    @cached_property
    def _drawings(self) -> tuple[Drawing, ...]:
        return tuple(Drawing(Assign(each.column.name, each.draw)) for each in self.parameters)

    def added_later(self, x: Tensor) -> Tensor:
        """Return the parameters and timers of the specification one step later: (B, n) -> (B, added).

        No controls are given, because the parameters and timers do not depend on them.
        """
        before = self._named(x)
        later = before | self._later(before)
        return torch.stack([later[column.name] for column in self.added], 1) if self.added else x[:, :0]

    def commanded(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the actuator commands (B, m) in states `x` (B, n) for planned controls `u` (B, m).

        Without inner feedback they equal `u`.
        """
        if self._commands is None:
            return u
        found = self._commands({**self._named(x), **self._inputs(u)}, TORCH)
        return torch.stack([found[name] for name in self.control_names], 1)

    def planned(self, x: Tensor, command: Tensor) -> Tensor:
        """Planned controls (B, m) for which the actuators receive `command` (B, m) in states (B, n).

        This is the inverse of `commanded`, except where the limits of the actuators take effect.
        """
        if self._commands is None:
            return command
        feedback = self.decl.feedback
        assert feedback is not None
        gain, at = x.new_tensor(feedback.gain), x.new_tensor(feedback.state)
        most = x.new_tensor(feedback.authority)
        back = ((at - x[:, : len(at)]) @ gain.T).clamp(-most, most)
        return command - x.new_tensor(feedback.control) - back

    @cached_property
    def _commands(self) -> ArrayProgram | None:
        found = self.decl.commands
        return ArrayProgram(found) if found else None

    def rollout(self, x0: Tensor, u: Tensor, switch: Switch | None = None) -> Tensor:
        """Roll out from states `x0` (B, n) under plans `u` (B, T, m); return the states (B, T+1, n).

        The initial state comes first. `switch` selects smooth blends of jumps, which are exact by default.
        """
        columns = self.rollout_columns(x0, u, switch)
        return torch.stack([columns[name].t() for name in self.names], 2)

    def rollout_columns(self, x0: Tensor, u: Tensor, switch: Switch | None = None) -> Columns:
        """Roll out from states `x0` (B, n) under plans `u` (B, T, m); return state -> values (T+1, B).

        The tensor of a constant state is an expanded view. `switch` selects smooth blends of
        jumps, which are exact by default.
        """
        sizes = {"states": len(self.names), "controls": len(self.control_names)}
        check_plans(self.decl.name, tuple(x0.shape), tuple(u.shape), **sizes)
        start = dict(zip(self.names, TORCH.split(x0.t().contiguous()), strict=True))
        inputs = dict(zip(self.control_names, u.permute(2, 1, 0).contiguous().unbind(0), strict=True))
        moving = {name: column for name, column in start.items() if name not in self._timer_step.moving}
        columns = self._stepper(switch).rollout(moving, inputs, u.shape[1], TORCH, switch)
        if not self.timers:
            return columns
        with torch.no_grad():
            seen = {name: column[:-1].detach() for name, column in columns.items()}
            first = {timer.name: start[timer.name] for timer in self.timers}
            return columns | self._timer_step.rollout(first, seen, u.shape[1], TORCH)

    def _later(self, before: Columns) -> Columns:
        with torch.no_grad():
            return self._timer_step.step(before, TORCH)

    @cached_property
    def _timer_step(self) -> Stepper:
        """Compiled step of the timers: their next values as functions of the states."""
        return Stepper(ModelStep((), {timer.name: timer.update for timer in self.timers}))

    @cached_property
    def exact_step(self) -> ModelStep:
        """One step as symbolic assignments, for code generators.

        Jumps are exact choices, and timers are included.
        """
        step = build_step(self.decl, soft=False)
        return ModelStep(step.lets, {**step.next, **{timer.name: timer.update for timer in self.timers}})

    def _stepper(self, switch: Switch | None) -> Stepper:
        soft = switch is not None and not switch.exact
        if soft not in self._steppers:
            self._steppers[soft] = Stepper(build_step(self.decl, soft=soft))
        return self._steppers[soft]

    def _named(self, x: Tensor) -> Columns:
        return dict(zip(self.names, x.unbind(-1), strict=True))

    def _inputs(self, u: Tensor) -> Columns:
        return dict(zip(self.control_names, u.unbind(-1), strict=True))

    # ------------------------------------------------------------------- sampling

    def sample(
        self,
        n: int,
        *,
        seed: int | None = None,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw n initial states, (n, dim), including the parameters and timers that a specification adds.

        Timers have their initial values. The same seed gives the same states, whatever the dtype.

        Raises SystemFileError (S301) if `where` rejects (nearly) every state.
        """
        if generator is None:
            generator = torch.Generator()
            if seed is None:
                generator.seed()
            else:
                generator.manual_seed(seed)
        states = self.initial.sample(n, generator)
        return self._completed(self.with_added(states, generator).to(device=device, dtype=dtype))

    def _completed(self, states: Tensor) -> Tensor:
        """Initial states, (n, dim), with what this system alone knows of them."""
        return states

    # -------------------------------------------------------------- policy, objective

    def observe(self, x: Tensor) -> Tensor:
        """Compute the inputs of the policy network from states: (…, n) -> (…, k).

        The parameters and timers of the specification come last.
        """
        if self._observation is None:
            return x
        seen = self._observation(self._named(x), TORCH)
        return torch.stack([seen[str(i)].expand(x.shape[:-1]) for i in range(self.observed_count)], -1)

    @cached_property
    def observed(self) -> tuple[ir.Num, ...]:
        """Inputs of the policy network as expressions over the states.

        The parameters and timers of the specification come last.
        """
        states = (ir.Signal(name) for name in self.decl.signature.names)
        added = (ir.Signal(column.name) for column in self.added)
        return (*(self.decl.policy.observe or states), *added)

    @cached_property
    def _observation(self) -> ArrayProgram | None:
        """Compiled inputs of the policy network; None if the inputs are the states themselves."""
        seen = {str(i): num for i, num in enumerate(self.observed)}
        return ArrayProgram(seen) if self.decl.policy.observe else None

    def reward(self, after: Tensor, u: Tensor) -> Tensor:
        """Return the declared reward (B,) of a step into states `after` (B, n) under the commands `u` (B, m).

        `u` are the commands that the actuators receive. Raises UsageError (U101) if the file declares no
        reward.
        """
        found: Tensor = self._reward({**self._named(after), **self._inputs(u)}, TORCH)["reward"]
        return found.expand(len(after))

    @cached_property
    def _reward(self) -> ArrayProgram:
        return ArrayProgram({"reward": self.require_reward()})

    def require_reward(self) -> ir.Num:
        """The declared reward of a step as a numeric expression.

        Raises UsageError (U101) if the file declares no reward.
        """
        if self.decl.train.reward is not None:
            return self.decl.train.reward
        message = f"the system `{self.decl.name}` declares no reward of a step"
        declare = f"declare one in {self.decl.path.name}: train: {{reward: EXPRESSION}}"
        raise usage(message, declare, "or choose the reward `robustness` or `accuracy`")

    @cached_property
    def mirror(self) -> Mirror | None:
        """The declared mirror symmetry, or None."""
        images = self.decl.policy.mirror
        return Mirror(images, self.names, self.decl.controls) if images else None

    def performance(
        self,
        columns: Mapping[str, Tensor],
        sat: Tensor,
        rho: Tensor | None = None,
        u: Tensor | None = None,
        switch: Switch | None = None,
    ) -> Tensor:
        """The weighted performance terms of the objective, averaged over time: (B,), differentiable.

        Args:
            columns: states over time, (T+1, B) each.
            sat: 1 if the trajectory satisfies the specification, else 0, (B,); without gradient.
            rho: robustness, (B,), for terms that read it; 0 by default.
            u: controls, (B, T, m), for terms that read a control; such terms are averaged over the T steps.
            switch: form of smooth indicators `ind(…)` in the terms; None: exact ones.
        """
        if self.cost.controlled and u is None:
            raise ValueError(f"the objective of {self.decl.name} needs the controls")
        sat = sat.detach().to(next(iter(columns.values())).dtype)[None]
        rho = torch.zeros_like(sat) if rho is None else rho[None]
        inputs = {} if u is None else dict(zip(self.control_names, u.permute(2, 1, 0), strict=True))
        cost: Tensor = self.cost(columns, inputs, sat, rho, TORCH, switch)[0]
        return cost

    @cached_property
    def cost(self) -> PlanCost:
        """The cost of plans by the performance terms, the sums of `objective`."""
        states, controlled = self.objective
        return PlanCost((), self.dt).with_mean(states).with_mean(controlled, controlled=True)

    @cached_property
    def objective(self) -> tuple[ir.Num | None, ir.Num | None]:
        """Two weighted sums of the performance terms, as expressions.

        The first sum has the terms that read no control, the second sum has the terms that read a control. A
        sum without terms is None.
        """
        sums: list[ir.Num | None] = [None, None]
        given = self.decl.commands
        for term in self.decl.objective.terms:
            if term.weight:
                kind = bool(term.value.columns & set(self.control_names))
                value = term.weight * (term.value.substitute(given) if kind else term.value)
                before = sums[kind]
                sums[kind] = value if before is None else before + value
        return sums[0], sums[1]

    # -------------------------------------------------------------------- health

    def require_finite(self, x: Tensor) -> None:
        """Raise SystemFileError (S302) if states (…, n) contain NaN or infinity."""
        bad = ~torch.isfinite(x.detach())
        if not bool(bad.any()):
            return
        hit = [name for name, column in zip(self.names, bad.unbind(-1), strict=True) if bool(column.any())]
        place = self.decl.places.get(hit[0])
        listed = ", ".join(f"`{name}`" for name in hit)
        raise SystemFileError.of(
            "S302",
            f"the dynamics of {self.decl.name} give NaN or infinity in {listed}",
            place,
            label="declared here",
            help=("clamp the state, shorten the step, or keep divisors away from 0",),
        )

    def probe(self, n: int = 256, *, seed: int = 0) -> tuple[Diagnostic, ...]:
        """Simulate n initial states under random plans of at most `PROBED` steps; return all warnings.

        The warnings are those of the file, W601 (few states accepted) and W602 (unstable). Raises
        SystemFileError if states cannot be drawn (S301) or become NaN or infinite (S302).
        """
        x0 = self.sample(n, seed=seed, dtype=torch.float64)
        self.require_finite(x0)
        generator = torch.Generator().manual_seed(seed)
        shape = (n, min(self.horizon, PROBED), len(self.decl.controls))
        low, high = self.control_low.double(), self.control_high.double()
        u = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
        self.require_finite(self.rollout(x0, u))
        return (*self.decl.warnings, *self.initial.warnings(), *unstable(self.decl))


def check_plans(
    who: str, x0: tuple[int, ...], u: tuple[int, ...], *, states: int, controls: int, steps: int | None = None
) -> None:
    """Check the shapes of initial states `x0`, (B, n), and plans `u`, (B, T, m).

    Args:
        who: what takes the arrays, for the message.
        x0: shape of the initial states.
        u: shape of the plans.
        states: number n of states.
        controls: number m of controls.
        steps: number T of steps; None if any number is accepted.

    Raises:
        ValueError: the shapes are others.
    """
    if x0 == (*u[:1], states) and len(u) == 3 and u[2] == controls and steps in (None, u[1]):
        return
    length = "T" if steps is None else steps
    raise ValueError(
        f"{who} takes x0 (B, {states}) and u (B, {length}, {controls}), not {tuple(x0)} and {tuple(u)}"
    )
