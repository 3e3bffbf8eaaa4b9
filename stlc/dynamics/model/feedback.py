"""Inner feedback: controls are planned as deviations from a stabilising linear law.

An open-loop plan over a horizon cannot hold an unstable plant: for x' = 4 x + u a deviation of 1e-7 grows to
1e-7 exp(4 T). With `policy: {feedback: …}` the actuators receive at every step

    clip(u0 + v + clip(K (x0 - x), -a, a), low, high)

where `v` is planned, so that rollouts, searches and gradients see a stabilised plant. `a` is the authority of
the feedback, by default half the range of the actuator. The range of `v` is the range of the actuator,
widened by `a` on both sides, so that every control remains available in every state. The setting `lqr`
selects the gain K of the linear-quadratic regulator for the linearised step (R. E. Kalman, 1960). This gain
is computed by a Riccati recursion over a long horizon.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.diagnostics import Diagnostic
from stlc.dynamics.declaration.learning import Feedback, FeedbackDecl
from stlc.dynamics.model.step import build_step

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.dynamics.declaration.decl import SystemDecl

    Doubles: TypeAlias = NDArray[np.float64]

SLOPE = 1e-5
"""Step of the central differences, as a share of a column's range."""
RECURSIONS = 3000
"""Steps of the Riccati recursion; the gain converges within some time constants."""
STILL = 1e-12
GROWING = 10.0
"""Growth of the open loop over a horizon above which W602 is reported."""


class NoFeedbackError(ValueError):
    """Error with the reason why a feedback gain cannot be computed."""


@dataclass(frozen=True, slots=True)
class Linear:
    """The linearised step x+ - x0 = A (x - x0) + B (u - u0) + rest, for the n moving (time-varying) states.

    Attributes:
        a: A, (n, n).
        b: B, (n, m).
        rest: (n,), change of the state in one step from the state x0 under the control u0.
        scale: (n,), half the range of each moving state; 1 for a state without range.
        moving: names of the moving states.
    """

    a: Doubles
    b: Doubles
    rest: Doubles
    scale: Doubles
    moving: tuple[str, ...]

    @property
    def growth(self) -> float:
        """Growth factor per step of the fastest mode without feedback: the spectral radius of `a`."""
        return float(np.abs(np.linalg.eigvals(self.a)).max(initial=0.0))


def closed(decl: SystemDecl, request: FeedbackDecl) -> SystemDecl:
    """Return the declaration with the inner feedback that `request` describes.

    The controls of the result are deviations from the commands of the feedback. Raises NoFeedbackError if an
    unstable mode is uncontrollable, or if a control is an `angle`.
    """
    turning = [control.name for control in decl.controls if control.squash == "angle"]
    if turning:
        raise NoFeedbackError(f"the control `{turning[0]}` is a direction (`squash: angle`)")
    state, control = _rest(decl, request.around)
    if request.gain:
        rows = (request.gain.get(each.name, {}) for each in decl.controls)
        gain = np.array([[row.get(name, 0.0) for name in decl.signature.names] for row in rows])
    else:
        gain = _lqr(decl, request.weights, state, control)
    half = [0.5 * (each.high - each.low) for each in decl.controls]
    authority = tuple(request.authority * each for each in half)
    feedback = Feedback(
        tuple(map(tuple, gain.tolist())),
        tuple(state.tolist()),
        tuple(control.tolist()),
        tuple(each.low for each in decl.controls),
        tuple(each.high for each in decl.controls),
        authority,
    )
    deviations = tuple(
        replace(each, low=each.low - at - most, high=each.high - at + most)
        for each, at, most in zip(decl.controls, control.tolist(), authority, strict=True)
    )
    return replace(decl, controls=deviations, feedback=feedback)


# ------------------------------------------------------------------ linearisation


def _rest(decl: SystemDecl, around: Mapping[str, float]) -> tuple[Doubles, Doubles]:
    """Return the operating point: state (n,) and control (m,), in the units of the columns.

    `around` gives values of some states and controls. Any other state is 0, or the middle of its range if the
    range excludes 0. The other controls are chosen within their ranges so that the state stays as constant as
    possible.
    """
    state = np.array(
        [
            around.get(each.name, 0.0)
            if each.low is None or each.high is None or each.low <= 0.0 <= each.high
            else around.get(each.name, 0.5 * (each.low + each.high))
            for each in decl.signature.columns
        ]
    )
    low, high = (np.array([getattr(each, end) for each in decl.controls]) for end in ("low", "high"))
    control = np.clip(np.zeros(len(low)), low, high)
    free = [index for index, each in enumerate(decl.controls) if each.name not in around]
    control = np.array([around.get(each.name, at) for each, at in zip(decl.controls, control, strict=True)])
    for _ in range(5 if free else 0):  # Gauss-Newton
        linear = linearised(decl, state, control)
        held = _held(linear)
        slopes = (linear.b / linear.scale[:, None])[held][:, free]
        step = np.linalg.lstsq(slopes, -(linear.rest / linear.scale)[held], rcond=None)[0]
        control[free] = np.clip(control[free] + step, low[free], high[free])
    return state, control


def _held(linear: Linear) -> NDArray[np.bool_]:
    """Mask (n,): True for a moving state if the change of any state depends on it.

    The operating point is chosen so that these states stay constant. Any other state may drift, such as a
    position in an open field.
    """
    others = np.abs(linear.a - np.eye(len(linear.a)))
    return np.asarray(others.max(0, initial=0.0) > STILL)


def linearised(decl: SystemDecl, state: Doubles, control: Doubles, slope: float = SLOPE) -> Linear:
    """Linearise the step at `state` (n,) and `control` (m,) by central differences.

    The step follows the flow, without inner feedback, jumps and clamps. All values are in the units of the
    columns; `slope` is the size of a difference, as a share of half the range of its column.
    """
    columns, names = decl.signature.columns, decl.signature.names
    moved = {assign.name for assign in decl.flow}
    moving = [
        i
        for i, each in enumerate(columns)
        if each.kind == "real" and each.role == "state" and each.name in moved
    ]
    spans = [(each.low, each.high) for each in columns] + [(each.low, each.high) for each in decl.controls]
    half = np.array(
        [1.0 if low is None or high is None or high <= low else 0.5 * (high - low) for low, high in spans]
    )
    turned = [*moving, *range(len(names), len(spans))]
    at = np.concatenate((state, control))
    nudge = slope * half[turned]
    points = np.tile(at, (2 * len(turned) + 1, 1))
    for row, (index, size) in enumerate(zip(turned, nudge, strict=True)):
        points[1 + 2 * row, index] += size
        points[2 + 2 * row, index] -= size
    after = _stepped(decl, points)[:, moving]
    if not np.isfinite(after).all():
        raise NoFeedbackError("the dynamics give no number at the point of operation")
    slopes = (after[1::2] - after[2::2]) / (2.0 * nudge[:, None])
    count = len(moving)
    return Linear(
        slopes[:count].T,
        slopes[count:].T,
        after[0] - state[moving],
        half[moving],
        tuple(names[i] for i in moving),
    )


def _stepped(decl: SystemDecl, points: Doubles) -> Doubles:
    """Return the states (k, n) one step after `points` (k, n + m), each a state and a control.

    The step follows the flow, without inner feedback, jumps and clamps.
    """
    names = (*decl.signature.names, *(control.name for control in decl.controls))
    step = build_step(replace(decl, feedback=None, clamps={}, jumps=()), soft=False)
    env = dict(zip(names, points.T, strict=True))
    for name, value in step.lets:
        env[name] = ArrayProgram({name: value})(env)[name]
    moved = ArrayProgram(dict(step.next))(env) if step.next else {}
    return np.stack(
        [np.broadcast_to(moved.get(name, env[name]), len(points)) for name in decl.signature.names], 1
    )


# ---------------------------------------------------------------------------------- gains


def _lqr(decl: SystemDecl, weights: Mapping[str, float], state: Doubles, control: Doubles) -> Doubles:
    """Gain of the linear-quadratic regulator at the operating point (`state`, `control`), (m, n).

    The gain is in the units of the columns. The cost is the weighted sum of squares of deviations, each
    divided by half its range. A state that the dynamics do not depend on (a position in an open field) has no
    cost unless `weights` names it, so that plans can move it freely.
    """
    linear = linearised(decl, state, control)
    held, names = _held(linear), decl.signature.names
    default = dict(zip(linear.moving, held.astype(float).tolist(), strict=True))
    q = np.diag(
        [
            weights.get(name, default[name]) / size**2
            for name, size in zip(linear.moving, linear.scale, strict=True)
        ]
    )
    r = np.diag([weights.get(each.name, 1.0) / (0.5 * (each.high - each.low)) ** 2 for each in decl.controls])
    gain = riccati(linear.a, linear.b, q, r)
    left = np.abs(np.linalg.eigvals(linear.a - linear.b @ gain)).max(initial=0.0)
    if not np.isfinite(gain).all() or left > max(1.0 + 1e-6, 0.999 * linear.growth):
        raise NoFeedbackError(
            f"a mode that grows by {linear.growth:.3g} a step is out of reach of the controls"
        )
    whole = np.zeros((len(decl.controls), len(names)))
    whole[:, [names.index(name) for name in linear.moving]] = gain
    return whole


def riccati(a: Doubles, b: Doubles, q: Doubles, r: Doubles) -> Doubles:
    """Limit of the gain (m, n) in the Riccati recursion with costs `q` of states and `r` of controls.

    If an integrator is uncontrollable, the algebraic Riccati equation has no stabilising solution. The
    recursion gives a gain even then.
    """
    cost: Doubles = q.copy()
    gain: Doubles = np.zeros((b.shape[1], len(a)))
    with np.errstate(all="ignore"):
        for _ in range(RECURSIONS):
            before = gain
            gain = np.asarray(np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a), dtype=np.float64)
            cost = q + a.T @ cost @ (a - b @ gain)
            cost = 0.5 * (cost + cost.T)
            if not np.isfinite(cost).all() or np.abs(gain - before).max() <= STILL * np.abs(gain).max():
                break
    return gain


# ------------------------------------------------------------------------- instability warning


def unstable(decl: SystemDecl) -> tuple[Diagnostic, ...]:
    """Return W602 if small errors grow more than tenfold over a horizon, else an empty tuple."""
    growth = growth_of(decl)
    if not growth > GROWING:
        return ()
    message = (
        f"{decl.name} is unstable: a difference at the start of a plan is {growth:.2g} times it at the end"
    )
    advice = (
        "another gain or point of operation: these plans still grow"
        if decl.feedback is not None
        else "`policy: {feedback: lqr}` plans deviations from a stabilising feedback"
    )
    place = decl.policy.feedback_span
    note = "plans fix the controls of a whole horizon in advance; so do rollouts, searches and gradients"
    return (Diagnostic("W602", message, place, note=(note,), help=(advice,)),)


def growth_of(decl: SystemDecl) -> float:
    """Factor by which the fastest mode grows over a horizon, linearised at the operating point.

    If the declaration has an inner feedback, the factor is that of the closed loop. Returns 1 if the factor
    cannot be computed.
    """
    feedback = decl.feedback
    try:
        if feedback is None:
            rest = _rest(decl, {})
            factor, closer = (linearised(decl, *rest, slope).growth for slope in (SLOPE, SLOPE / 8))
            if not math.isclose(factor, closer, rel_tol=0.05):
                return 1.0  # there is no slope, as where a root meets 0
        else:
            ends = zip(decl.controls, feedback.low, feedback.high, strict=True)
            own = tuple(replace(each, low=low, high=high) for each, low, high in ends)
            plant = replace(decl, controls=own, feedback=None)
            linear = linearised(plant, np.array(feedback.state), np.array(feedback.control))
            gain = np.array(feedback.gain)[:, [decl.signature.names.index(name) for name in linear.moving]]
            factor = float(np.abs(np.linalg.eigvals(linear.a - linear.b @ gain)).max(initial=0.0))
    except (NoFeedbackError, ArithmeticError, TypeError, KeyError, np.linalg.LinAlgError):
        return 1.0
    return math.exp(min(decl.horizon * math.log(max(factor, 1e-300)), 700.0))
