"""Scaled robustness that guides a search: predicates of different units count alike.

In `idle -> always speed < 35`, the margin of the engine speed is in thousands and that of the speed in tens:
the larger one hides the smaller one in a disjunction, and the smaller one hides the larger one in a
conjunction. For guidance, each predicate is divided by the size that its margin had in the first simulations.
The sign of the robustness does not change, and verdicts always use the exact robustness.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import reach_of
from stlc.compile.ir.traverse import map_children, nodes

Columns = Mapping[str, NDArray[np.float64]]
"""Signals of simulations: name -> (time, batch)."""
SAMPLES = 10
"""Simulations from which the sizes of margins are measured."""
ALIKE = 3.0
"""Ratio of sizes up to which predicates are not scaled."""


class ScaledRobustness:
    """Robustness of one formula, with predicates scaled by their sizes in the first simulations."""

    def __init__(self, formula: ir.Formula) -> None:
        self._formula = formula
        self._predicates = [
            node for node in nodes(formula) if isinstance(node, ir.Predicate) and not node.guard
        ]
        self._sizes: dict[ir.Num, list[float]] = {each.num: [] for each in self._predicates}
        self._scaled: ir.Formula | None = formula if len(self._sizes) < 2 or _freezes(formula) else None

    @property
    def settled(self) -> bool:
        """Whether the scales are final."""
        return self._scaled is not None

    def measure(self, columns: Columns) -> None:
        """Measure the sizes of predicates in more simulations; after `SAMPLES` of them scales are final."""
        if self.settled:
            return
        length = len(next(iter(columns.values())))
        for predicate in self._predicates:
            reach = _offsets(predicate)
            values = evaluate(
                [predicate], columns, ops=NUMPY, start=reach[0], count=max(length - reach[0] - reach[1], 1)
            )[0]
            size = np.quantile(np.abs(values), 0.9, axis=0) if np.ndim(values) else np.zeros(1)
            self._sizes[predicate.num].extend(np.atleast_1d(size).tolist())
        if min(map(len, self._sizes.values())) >= SAMPLES:
            self._scaled = self._with_scales()

    def __call__(self, columns: Columns) -> NDArray[np.float64]:
        """Guidance values of simulations, (batch,): negative exactly where the formula is violated."""
        formula = self._formula if self._scaled is None else self._scaled
        count = next(iter(columns.values())).shape[1]
        found: NDArray[np.float64] = evaluate([formula], columns, ops=NUMPY)[0][0]
        return np.broadcast_to(found, (count,))

    def _with_scales(self) -> ir.Formula:
        sizes = {num: float(np.median(each)) for num, each in self._sizes.items()}
        used = [size for size in sizes.values() if np.isfinite(size) and size > 0.0]
        if not used or max(used) <= ALIKE * min(used):
            return self._formula
        factors = {
            num: 1.0 / size if np.isfinite(size) and size > 0.0 else 1.0 / max(used)
            for num, size in sizes.items()
        }
        return _multiplied(self._formula, factors)


def _multiplied(formula: ir.Formula, factors: Mapping[ir.Num, float]) -> ir.Formula:
    if isinstance(formula, ir.Predicate):
        factor = factors.get(formula.num)
        if factor is None or formula.guard:
            return formula
        return map_children(formula, numbers=lambda num: ir.Op("mul", (ir.Const(factor), num)))
    return map_children(formula, formulas=lambda part: _multiplied(part, factors))


def _freezes(formula: ir.Formula) -> bool:
    """Whether a predicate may read a frozen value, which has no size outside of its formula."""
    return any(isinstance(node, ir.Freeze) for node in nodes(formula))


def _offsets(predicate: ir.Predicate) -> tuple[int, int]:
    """Samples before the first and after the last at which a predicate can be evaluated alone."""
    found = reach_of(predicate.num)
    return max(found.past, 0), max(found.future, 0)
