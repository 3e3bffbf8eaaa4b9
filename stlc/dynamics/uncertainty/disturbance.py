"""Exogenous effects of a deployment: the system's events and its scenario's disturbance, noise and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.dynamics.declaration.deployment import ErrorsDecl, EventDecl
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.declaration.perturbable import perturbable
from stlc.dynamics.model.samplers import Drawing, Rows, seeded
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.perturbed import PerturbedSystem
from stlc.units import Unit

SECOND = Unit.parse("s")
_GAINS, _PUSHES, _BLURS, _NUMBERS = range(4)
"""Random streams of a seed, one per use, so that a world draws the same numbers whatever is disturbed."""


@dataclass(frozen=True, slots=True)
class ErrorSizes:
    """Sizes of the errors in a scenario, in the units of controls and states, float64.

    Attributes:
        gain: constant relative error of each actuator, (m,); 0 for directions (`squash: angle`).
        offset: constant error of each actuator, (m,); 0 for all but directions.
        push: standard deviation of the noise on each actuator, (m,).
        blur: standard deviation of the noise on each measured state, (n,).
        parameters: constant relative error of the numbers in the dynamics.
    """

    gain: Tensor
    offset: Tensor
    push: Tensor
    blur: Tensor
    parameters: float

    @classmethod
    def of(cls, system: System) -> ErrorSizes:
        """Return the sizes of the errors in the scenario of a system; all are 0 without a scenario."""
        scenario = system.decl.scenario
        errors = scenario.errors if scenario else ErrorsDecl()
        controls = system.decl.controls
        angle = torch.tensor([control.squash == "angle" for control in controls], dtype=torch.float64)
        half = 0.5 * torch.tensor([high - low for low, high in system.actuators]).double()
        return cls(
            errors.actuator_gain * (1.0 - angle),
            errors.actuator_gain * angle,
            errors.actuator_noise * torch.where(angle > 0.0, 1.0, half),
            errors.sensor_noise * _ranges(system),
            errors.parameters,
        )


class Disturbance:
    """Disturbance, measurement noise and model errors that the scenario of a system declares.

    Without a scenario, nothing is disturbed.

    The scenario's expressions `disturb` and `noise` read the present state and the time `t` since the start
    of the deployment, and may draw random numbers.
    """

    def __init__(self, system: System, generators: Sequence[torch.Generator], agents: int) -> None:
        scenario = system.decl.scenario
        self._names, self._dt = system.decl.signature.names, system.dt
        self._scale = 1.0 if system.decl.discrete else system.dt
        self._clamps = system.decl.clamps
        self._generators, self._agents = generators, agents
        self._pushes = _drawings(scenario.disturb if scenario else ())
        self._noises = _drawings(scenario.noise if scenario else ())
        self._sizes = ErrorSizes.of(system)
        own = [[seeded(each.initial_seed(), key) for key in range(4)] for each in generators]
        self.streams = tuple(zip(*own, strict=True))
        signs = self._signs(_GAINS, len(self._sizes.gain))
        self._factor, self._offset = 1.0 + self._sizes.gain * signs, self._sizes.offset * signs

    def acted(self, action: Tensor) -> Tensor:
        """Outputs of the actuators, (rows, m), for the commands `action`, including actuator errors."""
        given = action
        if bool(self._sizes.gain.any() | self._sizes.offset.any()):
            given = given * self._factor.to(given) + self._offset.to(given)
        if bool(self._sizes.push.any()):
            drawn = self._normal(_PUSHES, action.shape[1])
            given = given + (self._sizes.push * drawn).to(given)
        return given

    def truths(self, truth: System) -> list[System]:
        """True dynamics of each seed: `truth` with its constants changed by random parameter errors."""
        off = self._sizes.parameters
        loose = perturbable(truth.decl) if off else None
        if loose is None or not loose.numbers:
            return [truth] * len(self._generators)
        factors = 1.0 + off * self._signs(_NUMBERS, len(loose.numbers))
        return [PerturbedSystem(loose, each) for each in torch.split(factors, self._agents)]

    def _signs(self, stream: int, count: int) -> Tensor:
        """Draw random signs, 1 or -1, (rows, count).

        Every seed has several generators of random numbers; `stream` tells which of them draws.
        """
        shape = (self._agents, count)
        drawn = [torch.randint(2, shape, generator=each) for each in self.streams[stream]]
        return 2.0 * torch.cat(drawn).double() - 1.0

    def _normal(self, stream: int, count: int) -> Tensor:
        """Draw standard normal numbers, (rows, count).

        Every seed has several generators of random numbers; `stream` tells which of them draws.
        """
        shape = (self._agents, count)
        streams = self.streams[stream]
        return torch.cat([torch.randn(shape, generator=each, dtype=torch.float64) for each in streams])

    def pushed(self, x: Tensor, before: Tensor, step: int) -> Tensor:
        """Add the scenario's disturbance to the states `x`, (rows, n), after step number `step`.

        The disturbance depends on the states `before` the step, and on the time `(step - 1) dt` at which the
        step began. Returns the sum, clipped to the states' bounds (`clamp` in the system file).
        """
        if not self._pushes:
            return x
        added = self._drawn(self._pushes, before, step - 1)
        return self._changed(x, {name: self._scale * value for name, value in added.items()}, clamped=True)

    def seen(self, x: Tensor, step: int) -> Tensor:
        """Measured states, (rows, n): `x` with the scenario's noise.

        Timers and parameters that the specification adds to the state have no noise.
        """
        seen = x
        if self._noises:
            seen = self._changed(x, self._drawn(self._noises, x, step), clamped=False)
        blur = self._sizes.blur
        if bool(blur.any()):
            drawn = blur * self._normal(_BLURS, len(blur))
            later = torch.zeros((len(x), x.shape[1] - len(blur)), dtype=drawn.dtype)
            seen = seen + torch.cat((drawn, later), 1).to(x)
        return seen

    def _drawn(self, drawings: Sequence[Drawing], x: Tensor, step: int) -> dict[str, Tensor]:
        """Evaluate the random expressions `drawings` of the scenario: name -> values, (rows,).

        The expressions read the states `x`, (rows, n), and the time at step number `step`. Each seed draws
        from its own generator.
        """
        parts = []
        for rows, generator in zip(torch.split(x, self._agents), self._generators, strict=True):
            table = dict(zip(self._names, rows.double().unbind(1), strict=False))
            table["t"] = torch.full_like(table[self._names[0]], step * self._dt)
            found: dict[str, Tensor] = {}
            for drawing in drawings:
                found[drawing.name] = drawing({**found, **table}, Rows(len(rows), generator))
            parts.append(found)
        return {drawing.name: torch.cat([part[drawing.name] for part in parts]) for drawing in drawings}

    def _changed(self, x: Tensor, added: dict[str, Tensor], *, clamped: bool) -> Tensor:
        columns = list(x.unbind(1))
        for index, name in enumerate(self._names):
            if name in added:
                columns[index] = columns[index] + added[name].to(x)
                if clamped and name in self._clamps:
                    columns[index] = columns[index].clamp(*self._clamps[name])
        return torch.stack(columns, 1)


def errors_of(truth: System) -> dict[str, Any]:
    """Nonzero errors (of model, actuators and sensors) in the system's scenario: name -> relative size.

    The entry `parameters` is the error of the numbers in the dynamics. If it is present, there are further
    entries: `numbers`, the list of these numbers, and `exact`, the constants that the dynamics read and that
    count as exact, if there are any.
    """
    scenario = truth.decl.scenario
    shares = {} if scenario is None else asdict(scenario.errors)
    found: dict[str, Any] = {name: share for name, share in shares.items() if share}
    if "parameters" in found:
        loose = perturbable(truth.decl)
        found["numbers"] = list(map(str, loose.numbers))
        if loose.exact:
            found["exact"] = list(loose.exact)
    return found


def _drawings(assigns: Sequence[Assign]) -> tuple[Drawing, ...]:
    return tuple(Drawing(assign) for assign in assigns)


def _ranges(system: System) -> Tensor:
    """Width of each state's nominal range, (n,).

    It is 0 for a state in units of time, a discrete state, and a state without a range.
    """
    widths = [
        column.high - column.low
        if column.kind == "real"
        and column.unit.dims != SECOND.dims
        and column.low is not None
        and column.high is not None
        else 0.0
        for column in system.decl.signature.columns
    ]
    return torch.tensor(widths, dtype=torch.float64)


_CONDITION = "holds"


class _Event:
    """Compiled exogenous event of a system file; stores whether its condition held at the previous step."""

    def __init__(self, decl: EventDecl) -> None:
        self.decl = decl
        self.draws = [Drawing(assign) for assign in decl.sets]
        self.when = ArrayProgram({_CONDITION: decl.when.indicator()}) if decl.when is not None else None
        self.held: Tensor | None = None

    def fires(self, columns: dict[str, Tensor], step: int) -> Tensor:
        """Mask of the agents for which the event occurs at step number `step`, (agents,).

        The method also stores, for each agent, whether the event's condition holds now. The next call needs
        this for an event that occurs when its condition becomes true or becomes false.

        `columns`: name -> values, (agents,); the names are those of the states, and `t` for the time in
        seconds.
        """
        like = next(iter(columns.values()))
        due = self.decl.at == step if self.decl.at is not None else True
        if self.decl.every is not None:
            due = due and step > 0 and step % self.decl.every == 0
        now = torch.full_like(like, due, dtype=torch.bool)
        if self.when is None:
            return now
        holds = torch.as_tensor(self.when(columns, TORCH)[_CONDITION] > 0.5).expand(len(like))
        before, self.held = self.held, holds
        match self.decl.edge:
            case "rise":
                return now & holds & ~before if before is not None else torch.zeros_like(now)
            case "fall":
                return now & ~holds & before if before is not None else torch.zeros_like(now)
            case _:
                return now & holds


class Events:
    """The exogenous events of a deployment.

    Each event stores whether its condition held at the previous step.

    Args:
        declared: events in file order; later ones see the effects of earlier ones.
        names: names of the states.
        dt: time step in seconds.
    """

    def __init__(self, declared: Sequence[EventDecl], names: Sequence[str], dt: float) -> None:
        self._events = [_Event(decl) for decl in declared]
        self._names, self._dt = tuple(names), dt

    def apply(self, x: Tensor, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, int]]:
        """Apply the events of step number `step` to the states `x`, (agents, n).

        `generator`: source of the random numbers in the events.

        Returns:
            The states after the events, (agents, n); and for each event with a condition, the event's name ->
            number of agents for which it occurred.
        """
        columns = dict(zip(self._names, x.unbind(1), strict=True))
        counts: dict[str, int] = {}
        for event in self._events:
            columns["t"] = torch.full_like(x[:, 0], step * self._dt)
            mask = event.fires(columns, step)
            if event.when is not None:
                counts[event.decl.name] = int(mask.sum())
            if bool(mask.any()):
                drawn = dict(columns)
                for draw in event.draws:
                    drawn[draw.name] = draw(drawn, Rows(len(x), generator)).to(x)
                columns |= {name: torch.where(mask, drawn[name], columns[name]) for name in self._names}
        return torch.stack([columns[name] for name in self._names], 1), counts
