"""Tolerance of verdicts, and the robustness of requirements weighed without a change of their verdicts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

if TYPE_CHECKING:
    from stlc.compile.namespace import Array, Ops

A = TypeVar("A")
End: TypeAlias = Literal["open", "strict", "truncate"]
"""Verdict on a trace that is too short: bounds over all continuations, an error, or that of cut windows."""
TOLERANCE = 1e-6
"""A requirement counts as satisfied if its robustness is >= -TOLERANCE, in float64.

Times and start states lie on grids, so that exact ties occur.
"""
FLOAT32_TOLERANCE = 1e-5
"""The same in float32, whose rounding is coarser in a margin that is 0 by construction."""


def tolerance_of(rho: Array) -> float:
    """Tolerance of verdicts for robustness with the number type of the array `rho`."""
    return FLOAT32_TOLERANCE if str(getattr(rho, "dtype", "")).endswith("float32") else TOLERANCE


def satisfied(rho: A) -> A:
    """Return whether rho >= 0 up to rounding: rho >= -1e-6 in float64, rho >= -1e-5 in float32.

    Args:
        rho: robustness, an array of any shape.

    Returns:
        A boolean array of the same shape.
    """
    values: Any = rho
    verdict: A = values >= -tolerance_of(values)
    return verdict


def weighed(rho: Array, factor: float, ops: Ops) -> Array:
    """Robustness of a requirement, multiplied by its weight and divided by its scale.

    A large scale would bring a violation within the tolerance, and a large weight would bring a rounding
    error out of it. So a violation is multiplied from the tolerance on, and what is satisfied stays so: the
    result is at least -TOLERANCE where `rho` is, and nowhere else.

    Args:
        rho: robustness of a requirement, any shape.
        factor: weight / scale, positive.
        ops: library of the array.
    """
    if factor == 1.0:
        return rho
    tolerance = tolerance_of(rho)
    least = ops.clamp(rho * factor, -tolerance, None)
    return ops.where(ops.ge(rho, -tolerance), least, (rho + tolerance) * factor - tolerance)
