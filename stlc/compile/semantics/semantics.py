"""Robustness semantics: exact or smooth definitions of maximum and minimum.

Otherwise evaluation (`stlc.compile.backends.array.graph`) is independent of the semantics, and so are
verdicts: satisfaction follows from the truth of the predicates, and the exact robustness has that sign.

| name     | class                     | is a positive value satisfied, a negative one violated?       |
|----------|---------------------------|---------------------------------------------------------------|
| `exact`  | `Exact`                   | yes                                                           |
| `smooth` | `LogSumExp`               | not near 0: every operator may be off by log(n) / k           |
| `agm`    | `ArithmeticGeometricMean` | yes                                                           |
| `dgmsr`  | `GeneralizedMean`         | yes                                                           |

A semantics is one file of `stlc.compile.semantics.kinds`, called by its name.
"""

from __future__ import annotations

from stlc.compile.schedule.schedule import Pick
from stlc.compile.semantics.kinds.agm import ArithmeticGeometricMean
from stlc.compile.semantics.kinds.dgmsr import GeneralizedMean
from stlc.compile.semantics.kinds.exact import Exact
from stlc.compile.semantics.kinds.smooth import LogSumExp
from stlc.compile.semantics.protocol import Parts, Semantics
from stlc.diagnostics import Diagnostic, UsageError
from stlc.registry import SEMANTICS

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
"""Tolerance of satisfaction, robustness >= -TOLERANCE in float64 (times and start states lie on grids)."""


def semantics_of(asked: str | Semantics = "exact", smoothing: float | None = None) -> Semantics:
    """Return the requested semantics.

    Args:
        asked: a semantics, or a name in `SEMANTICS`.
        smoothing: scale k; selects log-sum-exp in place of `exact` or `smooth`.

    Raises:
        UsageError: U101, an unknown semantics, or `smoothing` for one without a scale.
    """
    chosen: Semantics = SEMANTICS.get(asked)() if isinstance(asked, str) else asked
    if smoothing is None:
        return chosen
    if not isinstance(chosen, Exact | LogSumExp):
        message = f"`{type(chosen).__name__}` has no `smoothing`"
        raise UsageError(Diagnostic("U101", message, help=("`smoothing` is the scale of log-sum-exp",)))
    return LogSumExp(float(smoothing))
