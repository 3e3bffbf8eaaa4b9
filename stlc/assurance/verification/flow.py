"""Solutions of differential equations over affine forms, with a bound on the error of every step.

A step has a first enclosure of the solution from interval arithmetic (Picard iteration; Moore, Kearfott and
Cloud 2009, chapter 10). In it the solution is, at a time s of the step, `x + s F`, where F contains the mean
of the derivative up to that time: first the range of the derivative over the enclosure, then the derivative
over the form itself. The last derivative is linear in s up to a remainder. Its integral over the step is
exact for the linear part, and the remainder times the length of the step contains the rest.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stlc.assurance.verification.forms import FORMS, SLACK, Bools, Floats, Forms, spread
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.dynamics.declaration.decl import SystemDecl

_ROUNDS = 2
"""Number of evaluations of the derivative over the solution."""

_TRIES = 8
"""Number of times that a first enclosure is enlarged."""


class Flow:
    """Steps of the solutions of a system's differential equations.

    Raises:
        ValueError: the system moves by jumps, limits, updates or in discrete time.
    """

    def __init__(self, decl: SystemDecl) -> None:
        if decl.discrete or decl.jumps or decl.clamps or decl.updates:
            raise ValueError("only systems of differential equations, without jumps, `clamp` and `held`")
        self._rate = ArrayProgram({assign.name: assign.value for assign in decl.flow})
        self._moved = tuple(assign.name for assign in decl.flow)
        self._length = float(decl.dt) / decl.substeps

    def step(self, env: Mapping[str, Forms], symbols: int) -> dict[str, Forms]:
        """States with a differential equation, as affine forms, at the end of one substep.

        Args:
            env: states at the start of the substep, and controls, (batch,) each. Controls, and states without
                an equation, are constant during the substep.
            symbols: number of symbols of the forms in `env`. One more stands for the time within the substep.

        Returns:
            State -> forms, (batch,). The remainder of an element is NaN if no enclosure of its solution was
            found: there may be none.
        """
        batch, length = len(next(iter(env.values())).centre), self._length
        start = {name: form.range for name, form in env.items()}
        enclosure, contained = self._enclosed(start)
        rate = self._rate(enclosure, INTERVALS)
        time = Forms(np.full(batch, 0.5 * length), np.zeros((0, batch)), np.full(batch, 0.5 * length))
        time = time.with_symbol(symbols)
        slopes = {name: Forms.between(*_ends(rate[name], batch)) for name in self._moved}
        for _ in range(_ROUNDS):
            tube = dict(env)
            for name in self._moved:
                moved = FORMS.add(env[name], FORMS.mul(slopes[name], time))
                tube[name] = Forms(moved.centre, moved.generators, moved.rest, *_ends(enclosure[name], batch))
            found = self._rate(tube, FORMS)
            slopes = {name: _lumped(spread(found[name], batch), symbols) for name in self._moved}
        later = {}
        for name in self._moved:
            mean = _lumped(spread(found[name], batch), symbols, linear=True).times(length)
            moved = FORMS.add(env[name], mean).widened(0.0, SLACK)
            later[name] = Forms(moved.centre, moved.generators, np.where(contained, moved.rest, np.nan))
        return later

    def _enclosed(self, start: Mapping[str, Intervals]) -> tuple[dict[str, Intervals], Bools]:
        """Intervals that contain the solution during a step, and whether they are known to."""
        batch = len(next(iter(start.values())).low)
        current, contained = dict(start), np.zeros(batch, dtype=bool)
        for attempt in range(_TRIES):
            image = self._image(start, current)
            inside = np.ones(batch, dtype=bool)
            for name in self._moved:
                inside &= (current[name].low <= image[name].low) & (image[name].high <= current[name].high)
            contained = inside
            if contained.all():
                break
            for name in self._moved:
                now, next_ = current[name], image[name]
                margin = (0.02 * 2.0**attempt) * (next_.high - next_.low) + 1e-9
                low = np.where(inside, now.low, np.minimum(now.low, next_.low - margin))
                high = np.where(inside, now.high, np.maximum(now.high, next_.high + margin))
                current[name] = Intervals(low, high)
        return current, contained

    def _image(
        self, start: Mapping[str, Intervals], current: Mapping[str, Intervals]
    ) -> dict[str, Intervals]:
        """`start + [0, length] rate(current)`."""
        rate = self._rate(current, INTERVALS)
        found = dict(start)
        for name in self._moved:
            low, high = start[name].low, start[name].high
            move = _whole(rate[name], len(low))
            found[name] = Intervals(
                low + np.minimum(self._length * move.low, 0.0) - SLACK,
                high + np.maximum(self._length * move.high, 0.0) + SLACK,
            )
        return found


def _whole(x: Intervals, batch: int) -> Intervals:
    """The intervals with one element per box."""
    return Intervals(np.broadcast_to(x.low, batch), np.broadcast_to(x.high, batch))


def _ends(x: Intervals, batch: int) -> tuple[Floats, Floats]:
    whole = _whole(x, batch)
    return whole.low, whole.high


def _lumped(form: Forms, symbol: int, *, linear: bool = False) -> Forms:
    """The form without the symbol of time, whose effect is added to the remainder.

    If `linear`, it is the mean over the whole step, in which the effect of the symbol is 0.
    """
    if len(form.generators) <= symbol:
        return Forms(form.centre, form.generators, form.rest)
    generators = form.generators.copy()
    generators[symbol] = 0.0
    rest = form.rest if linear else form.rest + np.abs(form.generators[symbol])
    return Forms(form.centre, generators, rest)
