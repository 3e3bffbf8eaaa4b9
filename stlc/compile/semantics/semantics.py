"""Robustness semantics: exact or smooth definitions of maximum and minimum.

The rest of the evaluation (`stlc.compile.backends.array.graph`) does not depend on the semantics. Neither do
verdicts: they follow from the truth of the predicates, in agreement with the sign of the exact robustness.

| name     | class                     | does > 0 mean satisfied, and < 0 violated?                    |
|----------|---------------------------|---------------------------------------------------------------|
| `exact`  | `Exact`                   | yes                                                           |
| `smooth` | `LogSumExp`               | not near 0: every operator may be off by log(n) / k           |
| `agm`    | `ArithmeticGeometricMean` | yes                                                           |
| `dgmsr`  | `GeneralizedMean`         | yes                                                           |

Each semantics is one file in `stlc.compile.semantics.kinds`; its name is that of the file.
"""

from __future__ import annotations

from stlc.compile.namespace import Pick
from stlc.compile.semantics.kinds.agm import ArithmeticGeometricMean
from stlc.compile.semantics.kinds.dgmsr import GeneralizedMean
from stlc.compile.semantics.kinds.exact import Exact
from stlc.compile.semantics.kinds.smooth import LogSumExp
from stlc.compile.semantics.protocol import Parts, Semantics
from stlc.diagnostics import usage
from stlc.registry import SEMANTICS

__all__ = [
    "SEMANTICS",
    "ArithmeticGeometricMean",
    "Exact",
    "GeneralizedMean",
    "LogSumExp",
    "Parts",
    "Pick",
    "Semantics",
    "semantics_of",
]


def semantics_of(asked: str | Semantics = "exact", smoothing: float | None = None) -> Semantics:
    """Return the requested semantics.

    Args:
        asked: a semantics, or the name of one in `SEMANTICS`.
        smoothing: scale k; if given, the result is log-sum-exp with this scale, in place of `exact` or
            `smooth`.

    Raises:
        UsageError: the semantics is unknown, or `smoothing` is given for a semantics without a scale (U101).
    """
    chosen: Semantics = SEMANTICS.get(asked)() if isinstance(asked, str) else asked
    if smoothing is None:
        return chosen
    if not isinstance(chosen, Exact | LogSumExp):
        message = f"`{type(chosen).__name__}` has no `smoothing`"
        raise usage(message, "`smoothing` is the scale of log-sum-exp")
    return LogSumExp(float(smoothing))
