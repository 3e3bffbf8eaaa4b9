"""Verdicts from robustness: tolerance, status, and weighed robustness that has the same verdicts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias, TypeVar, overload

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from stlc.compile.namespace import Array, Ops
    from stlc.compile.semantics.protocol import Semantics

A = TypeVar("A")
End: TypeAlias = Literal["open", "strict", "truncate"]
"""Verdict on a trace that is too short: bounds over all continuations, an error, or that of cut windows."""
StatusInScope: TypeAlias = Literal["satisfied", "violated", "inconclusive"]
Status: TypeAlias = Literal[StatusInScope, "out of scope"]
"""Outcome of a requirement; out of scope if an assumption does not hold."""


class Tolerance(float):
    """Tolerance of verdicts: a requirement is satisfied if its robustness is >= -tolerance, in float64.

    Times and start states lie on grids, so that exact ties occur.
    """

    __slots__ = ()
    FLOAT32: ClassVar = 1e-5
    """The same in float32, whose rounding is coarser in a margin that is 0 by construction."""

    def of(self, rho: Array) -> float:
        """Tolerance of verdicts for robustness with the number type of the array `rho`."""
        return self.FLOAT32 if str(getattr(rho, "dtype", "")).endswith("float32") else self

    @overload
    def satisfied(self, rho: float, tolerance: float | None = None) -> bool: ...
    @overload
    def satisfied(self, rho: NDArray[Any], tolerance: float | None = None) -> NDArray[np.bool_]: ...
    @overload
    def satisfied(self, rho: A, tolerance: float | None = None) -> A: ...
    def satisfied(self, rho: Any, tolerance: float | None = None) -> Any:
        """Return whether rho >= 0 up to rounding: rho >= -1e-6 in float64, rho >= -1e-5 in float32.

        Args:
            rho: robustness, a number or an array of any shape; NaN is not satisfied.
            tolerance: another tolerance.

        Returns:
            A boolean, or a boolean array of the same shape.
        """
        return rho >= -(self.of(rho) if tolerance is None else tolerance)

    @overload
    def violated(self, rho: float, tolerance: float | None = None) -> bool: ...
    @overload
    def violated(self, rho: NDArray[Any], tolerance: float | None = None) -> NDArray[np.bool_]: ...
    @overload
    def violated(self, rho: A, tolerance: float | None = None) -> A: ...
    def violated(self, rho: Any, tolerance: float | None = None) -> Any:
        """Return whether rho < 0 beyond rounding, as in `satisfied`; NaN is not violated either."""
        return rho < -(self.of(rho) if tolerance is None else tolerance)

    @staticmethod
    def status(violated: bool, satisfied: bool) -> StatusInScope:
        """Return the status of what is violated, satisfied, or neither."""
        return "violated" if violated else "satisfied" if satisfied else "inconclusive"

    def weighed(self, rho: Array, factor: float, ops: Ops) -> Array:
        """Robustness of a requirement, multiplied by its weight and divided by its scale.

        A large scale would bring a violation within the tolerance, and a large weight would bring a rounding
        error out of it. So a violation is multiplied from the tolerance on, and what is satisfied stays so:
        the result is at least -TOLERANCE where `rho` is, and nowhere else.

        Args:
            rho: robustness of a requirement, any shape.
            factor: weight / scale, positive.
            ops: library of the array.
        """
        if factor == 1.0:
            return rho
        tolerance = self.of(rho)
        least = ops.clamp(rho * factor, -tolerance, None)
        return ops.where(self.satisfied(rho), least, (rho + tolerance) * factor - tolerance)

    def overall(
        self, each: Sequence[Array], factors: Iterable[float], ops: Ops, semantics: Semantics
    ) -> Array:
        """Overall robustness: the least weighed robustness of requirements.

        Args:
            each: robustness of each requirement, one or more arrays of a shape.
            factors: weight / scale of each requirement.
            ops: library of the arrays.
            semantics: definition of the minimum.
        """
        rows = [self.weighed(row, factor, ops) for row, factor in zip(each, factors, strict=True)]
        return semantics.join(rows, "min", ops) if len(rows) > 1 else rows[0]


TOLERANCE = Tolerance(1e-6)
