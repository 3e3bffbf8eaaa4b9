"""Tubes: bounds on the states that a plan leads to, for all errors within the bounds of a scenario.

The errors are those of the scenario of the task: factors of the numbers in the dynamics, actuators with a
wrong gain or with noise, measurement errors of the present state, and additive disturbances. Each error is a
symbol of an affine form (`stlc.assurance.verification.forms`): a constant error keeps one symbol over all
steps, noise has a new one at every step. The forms are propagated through the dynamics that a deployment
simulates, and the robustness of each requirement is bounded by affine forms and by intervals, whichever is
tighter.

Normal noise has no bound. It is bounded at `DEVIATIONS` standard deviations, so bounds hold for draws within
them. The tube is about the dynamics in the system file. Exogenous events, and a world in Python that moves
agents in another way, are outside of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from stlc.assurance.verification.forms import FORMS, Floats, Forms, ranges, spread
from stlc.assurance.verification.judged import Judge
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.diagnostics import usage
from stlc.dynamics.declaration.perturbable import perturbable
from stlc.dynamics.model.rollout import Stepper
from stlc.dynamics.model.samplers import Drawing
from stlc.dynamics.model.step import build_step
from stlc.dynamics.uncertainty.disturbance import ErrorSizes

if TYPE_CHECKING:
    from stlc.compile.augment.timers import Timer
    from stlc.controller.problem.task import Task
    from stlc.dynamics.declaration.decl import SystemDecl

_Env: TypeAlias = dict[str, Forms]
"""Name of a state, control or intermediate result -> its form, (B,)."""

DEVIATIONS = 3.0
"""Standard deviations at which normal noise is bounded; 99.73 % of the draws are within them."""

AT_ONCE = 256
"""Plans whose tubes are computed at once."""

TIME = "t"
"""Name of the time since the start of the deployment in the expressions of a scenario."""


@dataclass(frozen=True, slots=True, eq=False)
class Tube:
    """Bounds for a batch of plans, for all errors within the bounds of the scenario.

    Attributes:
        states: name of a state -> intervals that contain it, (T+1, B).
        low: greatest known lower bound on the robustness of each requirement, (B, R) float64.
        high: least known upper bound, (B, R) float64.
    """

    states: Mapping[str, Intervals]
    low: Tensor
    high: Tensor


class TubeModel:
    """Model of a task and of the errors in its scenario, from which tubes are computed.

    Without a scenario, or if the scenario has no errors, tubes are as wide as rounding errors.

    Args:
        task: specification and system, with a scenario.
        deviations: standard deviations at which normal noise is bounded.

    Raises:
        UsageError: U101, the dynamics or a requirement calls a Python function, or the measurement noise of
            the scenario depends on the state.
        SystemFileError: S212, S213, the errors of a parameter cannot be carried, or have no effect.
    """

    def __init__(self, task: Task, *, deviations: float = DEVIATIONS) -> None:
        self.task, self._deviations = task, deviations
        system = task.plain
        decl, scenario = system.decl, system.decl.scenario
        self._sizes = ErrorSizes.of(system)
        loose = perturbable(system.truth.decl) if self._sizes.parameters else None
        self.uncertain = loose
        self._factors = () if loose is None else tuple(each.factor for each in loose.numbers)
        wrong = system.truth.decl.init.computed if system.truth is not system else ()
        self._first = tuple(map(Drawing, (() if loose is None else loose.started) or wrong))
        timers = task.compiled.timers
        self._model = _Motion(decl, timers)
        self._truth = _Motion(system.truth.decl if loose is None else loose.decl, timers)
        self._pushes = tuple(map(Drawing, scenario.disturb if scenario else ()))
        self._noises = tuple(map(Drawing, scenario.noise if scenario else ()))
        for noise in self._noises:
            if names := noise.reads - {TIME}:
                listed = ", ".join(f"`{name}`" for name in sorted(names))
                message = f"the measurement noise on `{noise.name}` depends on {listed}"
                raise usage(f"{message}, which is not known exactly", "a tube needs noise with known bounds")
        for each in (*self._truth.numbers.values(), *(rule.formula for rule in task.rules)):
            for call in each.calls():
                if call.opaque:
                    unbounded = f"`{call.name}` is a Python function, whose values have no bounds"
                    raise usage(f"{unbounded}: there is no tube")
        self._scale = 1.0 if decl.discrete else system.dt
        self._clock = 0.0, (decl.test.steps + decl.horizon) * system.dt
        self._judge = Judge([rule.formula for rule in task.rules], end=task.graph.end, shifts=False)
        self._safe = [task.rules.index(rule) for rule in task.compiled.safety]

    @property
    def started(self) -> tuple[str, ...]:
        """Names of the columns that follow from the others at the start, and depend on the errors there."""
        return tuple(each.name for each in self._first)

    @property
    def exact(self) -> bool:
        """True if the scenario has no errors: every tube is a single trajectory, up to rounding."""
        sizes = self._sizes
        errors = bool(sizes.gain.any() | sizes.offset.any() | sizes.push.any() | sizes.blur.any())
        return not (
            errors
            or self._factors
            or self._pushes
            or self._noises
            or self.task.plain.truth is not self.task.plain
        )

    @property
    def truncated(self) -> bool:
        """True if the scenario has normal noise, which is bounded at a number of standard deviations."""
        drawn = any("normal" in each.samplers for each in (*self._pushes, *self._noises))
        return drawn or bool(self._sizes.push.any() | self._sizes.blur.any())

    def tube(
        self, x: Tensor, plans: Tensor, *, steps: int | None = None, start: Collection[str] = ()
    ) -> Tube:
        """Bounds on states and robustness under plans.

        Args:
            x: measured states, (B, n).
            plans: plans in physical units, (B, T, m).
            steps: number of steps with errors. From then on, the states follow the model without errors, from
                every state that the errors may have led to. None: errors in all steps.
            start: names of the columns that follow from the others at the start of a deployment, such as held
                values: they are not as in `x`, but as errors of parameters may have made them.

        Returns:
            The bounds. A plan that is not finite has the bounds -inf and +inf.
        """
        steps = self.task.horizon if steps is None else steps
        states, given = (torch.split(each.double(), AT_ONCE) for each in (x, plans))
        parts = [self._tube(*each, steps, start) for each in zip(states, given, strict=True)]
        if len(parts) == 1:
            return parts[0]
        names = self.task.system.names
        whole = {
            name: Intervals(
                np.concatenate([part.states[name].low for part in parts], 1),
                np.concatenate([part.states[name].high for part in parts], 1),
            )
            for name in names
        }
        return Tube(whole, torch.cat([part.low for part in parts]), torch.cat([part.high for part in parts]))

    def safe(self, x: Tensor, plans: Tensor, *, steps: int | None = None) -> Tensor:
        """Lower bound on the robustness of phi_safe (the requirements tagged `@safety`), (B,).

        The arguments are those of `tube`.
        """
        found: Tensor = self.task.safety.overall(self.tube(x, plans, steps=steps).low[:, self._safe])
        return found

    def _tube(self, x: Tensor, plans: Tensor, steps: int, start: Collection[str]) -> Tube:
        broken = ~torch.isfinite(plans).flatten(1).all(1)
        u = torch.where(torch.isfinite(plans), plans, 0.0).numpy()
        with FORMS.quiet():
            history = self._history(x.numpy(), u, min(steps, u.shape[1]), start)
            found = self._judge.bounds(history)
        low, high = (torch.from_numpy(end.T.copy()) for end in (found.low, found.high))
        low[broken], high[broken] = -torch.inf, torch.inf
        return Tube({name: INTERVALS.margin(ranges(forms)) for name, forms in history.items()}, low, high)

    def _history(self, x: Floats, u: Floats, steps: int, start: Collection[str]) -> dict[str, list[Forms]]:
        """Forms of the states under plans `u`, (B, T, m): name -> one form (B,) per sample.

        The first `steps` steps have errors.
        """
        symbols = _Symbols(len(x), self._deviations)
        errors = _ErrorForms(self._sizes, self._factors, symbols)
        env = self._start(x, symbols, measured=steps > 0)
        for column in self._first if steps else ():
            if column.name in start:
                found = column.value({**env, **errors.factors}, FORMS, symbols.drawn)
                env[column.name] = spread(found, symbols.batch)
        history = {name: [form] for name, form in env.items()}
        for step in range(u.shape[1]):
            plan = u[:, step].T
            if step < steps:
                moved = self._truth.step(env, plan, errors, symbols)
                env = self._pushed(moved, env, symbols)
            else:
                env = self._model.step(env, plan, None, symbols)
            for name, form in env.items():
                history[name].append(form)
        return history

    def _start(self, x: Floats, symbols: _Symbols, *, measured: bool) -> _Env:
        """Forms of the true states, for measured states `x`, (B, n)."""
        env = {name: Forms.point(x[:, i]) for i, name in enumerate(self.task.system.names)}
        if not measured:
            return env
        for name, blur in zip(self.task.plain.names, self._sizes.blur.tolist(), strict=True):
            if blur:
                env[name] = FORMS.add(env[name], symbols.normal(blur))
        clock = self._time(len(x))
        for noise in self._noises:
            off = noise.value({TIME: clock}, FORMS, symbols.drawn)
            env[noise.name] = FORMS.sub(env[noise.name], off)
        return env

    def _pushed(self, moved: _Env, before: _Env, symbols: _Symbols) -> _Env:
        """Add the scenario's disturbance, which reads the states `before` the step."""
        if not self._pushes:
            return moved
        clamps, table = self.task.plain.decl.clamps, {**before, TIME: self._time(symbols.batch)}
        for push in self._pushes:
            added = push.value(table, FORMS, symbols.drawn)
            form = FORMS.add(moved[push.name], added.times(self._scale))
            moved[push.name] = FORMS.clamp(form, *clamps[push.name]) if push.name in clamps else form
        return moved

    def _time(self, batch: int) -> Forms:
        first, last = self._clock
        return Forms.between(np.full(batch, first), np.full(batch, last))


class _Symbols:
    """Source of new symbols of affine forms, for `batch` plans."""

    def __init__(self, batch: int, deviations: float) -> None:
        self.batch, self._deviations, self._count = batch, deviations, 0

    def new(self, radius: float = 1.0) -> Forms:
        """Form of a number from -radius to radius, with a symbol of its own."""
        generators = np.zeros((self._count + 1, self.batch))
        generators[-1] = radius
        self._count += 1
        return Forms(np.zeros(self.batch), generators, np.zeros(self.batch))

    def normal(self, deviation: float) -> Forms:
        """Form of a normal number with mean 0, within the bounded number of standard deviations."""
        return self.new(self._deviations * deviation)

    def drawn(self, sampler: str, args: list[Forms]) -> Any:
        """Form of a number drawn from the sampler called `sampler`."""
        match sampler, args:
            case ("uniform" | "randint", [low, high]) | ("truncnorm", [_, _, low, high]):
                middle = FORMS.add(low, high).times(0.5)
                half = FORMS.mul(FORMS.sub(high, low).times(0.5), self.new())
                return FORMS.add(middle, half)
            case "normal", [mean, deviation]:
                return FORMS.add(mean, FORMS.mul(deviation, self.normal(1.0)))
            case "bernoulli", _:
                return FORMS.add(self.new(0.5), 0.5)
            case _:  # choice
                found = [each.range for each in args]
                low = np.min([each.low for each in found], axis=0)
                return Forms.between(low, np.max([each.high for each in found], axis=0))


class _ErrorForms:
    """Errors of one batch of tubes: constant ones, which keep their symbols over all steps, and noise.

    Attributes:
        factors: name of a factor of the dynamics -> its form.
    """

    def __init__(self, sizes: ErrorSizes, factors: Iterable[str], symbols: _Symbols) -> None:
        self._symbols = symbols
        self._gains, self._offsets = _forms(sizes.gain, symbols), _forms(sizes.offset, symbols)
        self._pushes = sizes.push.tolist()
        self.factors = {name: FORMS.add(symbols.new(sizes.parameters), 1.0) for name in factors}

    def acted(self, given: Sequence[Forms]) -> list[Forms]:
        """Outputs of the actuators for commands, one form (B,) per control."""
        found = []
        rows = zip(given, self._gains, self._offsets, self._pushes, strict=True)
        for command, gain, offset, push in rows:
            out = command if gain is None else FORMS.add(command, FORMS.mul(command, gain))
            out = out if offset is None else FORMS.add(out, offset)
            found.append(FORMS.add(out, self._symbols.normal(push)) if push else out)
        return found


def _forms(radii: Tensor, symbols: _Symbols) -> list[Forms | None]:
    return [symbols.new(radius) if radius else None for radius in radii.tolist()]


class _Motion:
    """One step of a system and of the timers of a specification over affine forms."""

    def __init__(self, decl: SystemDecl, timers: Sequence[Timer]) -> None:
        step = build_step(replace(decl, feedback=None), soft=False)
        step = replace(step, next={**step.next, **{timer.name: timer.update for timer in timers}})
        self.numbers, self._stepper = step.numbers, Stepper(step)
        self._controls = [control.name for control in decl.controls]
        self._feedback = decl.feedback
        self._commands = ArrayProgram(decl.commands) if decl.feedback is not None else None

    def step(self, env: _Env, plan: Floats, errors: _ErrorForms | None, symbols: _Symbols) -> _Env:
        """States one step later.

        Args:
            env: name of a state -> form (B,).
            plan: planned controls, (m, B).
            errors: errors of actuators and parameters; None for none.
            symbols: source of new symbols.
        """
        given = [Forms.point(each) for each in plan]
        if self._commands is not None:
            found = self._commands({**env, **dict(zip(self._controls, given, strict=True))}, FORMS)
            given = [found[name] for name in self._controls]
        acted = given if errors is None else errors.acted(given)
        if self._feedback is not None:
            ends = zip(acted, self._feedback.low, self._feedback.high, strict=True)
            acted = [FORMS.clamp(*each) for each in ends]
        factors = {} if errors is None else errors.factors
        now = {**env, **dict(zip(self._controls, acted, strict=True)), **factors}
        later = self._stepper.step(now, FORMS).items()
        return {**env, **{name: spread(form, symbols.batch) for name, form in later}}


def tube(task: Task, x: Any, plans: Any, *, deviations: float = DEVIATIONS) -> Tube:
    """Bounds on the states and on the robustness of plans, for all errors of the task's scenario.

    The states may be those at the start of a deployment, or later ones: columns that follow from the others
    at the start, such as held values, are as given, or as the errors of parameters may have made them.

    Args:
        task: specification and system; the system is loaded with a scenario.
        x: measured states, (B, n) or (n,), in the order of `task.system.names`.
        plans: plans in physical units, (B, T, m) or (T, m).
        deviations: standard deviations at which normal noise is bounded.

    Raises:
        UsageError: U101, there are no bounds; see `TubeModel`.
        SystemFileError: S212, S213; see `TubeModel`.
    """
    states, given = torch.as_tensor(x, dtype=torch.float64), torch.as_tensor(plans, dtype=torch.float64)
    states = states if states.dim() == 2 else states[None]
    given = given if given.dim() == 3 else given[None]
    wanted = (len(states), task.horizon, len(task.system.control_names))
    if states.shape[1:] != (len(task.system.names),) or given.shape != wanted:
        shape = f"(B, {len(task.system.names)}) and (B, {wanted[1]}, {wanted[2]})"
        raise usage(f"states {tuple(states.shape)} and plans {tuple(given.shape)} are not {shape}")
    model = TubeModel(task, deviations=deviations)
    one = model.tube(states, given)
    if not model.started:
        return one
    other = model.tube(states, given, start=model.started)
    hulls = {
        name: Intervals(np.minimum(box.low, also.low), np.maximum(box.high, also.high))
        for (name, box), also in zip(one.states.items(), other.states.values(), strict=True)
    }
    return Tube(hulls, torch.minimum(one.low, other.low), torch.maximum(one.high, other.high))
