"""What "max" means: exactly, or smoothly enough for a gradient to see more than one operand.

A semantics says how a maximum and a minimum of robustness values are taken; everything else about formulas
is the same for all of them (`stlc.compile.graph`). Verdicts do not depend on it: whether a formula holds is
decided by the truth of its predicates, and the exact robustness has that sign.

| name     | class                     | is a positive value satisfied, a negative one violated?       |
|----------|---------------------------|---------------------------------------------------------------|
| `exact`  | `Exact`                   | yes                                                           |
| `smooth` | `LogSumExp`               | not near 0: every operator may be off by log(n) / k           |
| `agm`    | `ArithmeticGeometricMean` | yes                                                           |
| `dgmsr`  | `GeneralizedMean`         | yes                                                           |
"""

from __future__ import annotations

from stlc.compile.extremum import Pick
from stlc.compile.semantics_extrema import Exact, LogSumExp
from stlc.compile.semantics_means import ArithmeticGeometricMean, GeneralizedMean
from stlc.compile.semantics_protocol import Parts, Semantics
from stlc.registry import Registry

__all__ = [
    "SEMANTICS",
    "TOLERANCE",
    "ArithmeticGeometricMean",
    "Exact",
    "GeneralizedMean",
    "LogSumExp",
    "Parts",
    "Pick",
    "Semantics",
    "semantics_of",
]

TOLERANCE = 1e-6
"""A robustness of at least minus this, in float64, is satisfied (time and start states lie on grids)."""

SEMANTICS: Registry[type[Semantics]] = Registry("semantics")
SEMANTICS.register("exact")(Exact)
SEMANTICS.register("smooth")(LogSumExp)
SEMANTICS.register("agm")(ArithmeticGeometricMean)
SEMANTICS.register("dgmsr")(GeneralizedMean)


def semantics_of(smoothing: float | str | Semantics | None) -> Semantics:
    """The semantics that somebody asks for.

    Args:
        smoothing: None is exact; a number is the scale k of log-sum-exp; a name is one of `SEMANTICS`.

    Raises:
        UsageError: U101, there is no semantics of this name.
    """
    match smoothing:
        case None:
            return Exact()
        case str():
            return SEMANTICS.get(smoothing)()
        case int() | float():
            return LogSumExp(float(smoothing))
        case _:
            return smoothing
