"""Scaled robustness that guides a search: predicates of different units count alike.

In `idle -> always speed < 35`, the margin of the engine speed is in thousands and that of the speed in tens:
the larger one hides the smaller one in a disjunction, and the smaller one hides the larger one in a
conjunction. For guidance, each predicate is divided by the size that its margin had in the first simulations.
The sign of the robustness does not change, and verdicts always use the exact robustness.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns_of, reach_of
from stlc.compile.ir.traverse import map_children, nodes
from stlc.signature import Signature

Columns = Mapping[str, NDArray[np.float64]]
"""Signals of simulations: name -> (time, batch)."""
SAMPLES = 9
"""Simulations from which the sizes of margins are measured."""
ALIKE = 3.0
"""Ratio of sizes up to which predicates are not scaled."""


class ScaledRobustness:
    """Robustness of one formula, with predicates divided by their sizes.

    Attributes:
        predicates: numbers whose sizes are measured; empty if there is nothing to compare.
    """

    def __init__(self, formula: ir.Formula) -> None:
        self._formula = formula
        found = () if _freezes(formula) else nodes(formula)
        every = [node for node in found if isinstance(node, ir.Predicate) and not node.guard]
        sized = {node.num: node for node in every}
        self.predicates: tuple[ir.Predicate, ...] = tuple(sized.values()) if len(sized) > 1 else ()

    def sizes(self, columns: Columns) -> NDArray[np.float64]:
        """Sizes of the margins of the predicates in simulations, (batch, predicates): 90 % quantiles."""
        first = next(iter(columns.values()))
        found = np.zeros((first.shape[1], len(self.predicates)))
        for index, predicate in enumerate(self.predicates):
            reach = reach_of(predicate.num)
            before, after = max(reach.past, 0), max(reach.future, 0)  # samples at which it has no value alone
            count = max(len(first) - before - after, 1)
            values = evaluate([predicate], columns, ops=NUMPY, start=before, count=count)[0]
            found[:, index] = np.quantile(np.abs(values), 0.9, axis=0) if np.ndim(values) else 0.0
        return found

    def scaled(self, scales: tuple[float, ...] | None) -> ir.Formula:
        """The formula, each predicate multiplied by its factor; None: all 1."""
        return _scaled(self._formula, self.predicates, scales)

    def __call__(self, columns: Columns, scales: tuple[float, ...] | None) -> NDArray[np.float64]:
        """Guidance values of simulations, (batch,): negative exactly where the formula is violated.

        Args:
            columns: signals of the simulations.
            scales: factor of each predicate; None: all 1.
        """
        count = next(iter(columns.values())).shape[1]
        found: NDArray[np.float64] = evaluate([self.scaled(scales)], columns, ops=NUMPY)[0][0]
        return np.broadcast_to(found, (count,))


def scales_of(sizes: NDArray[np.float64]) -> tuple[float, ...] | None:
    """Factors that make predicates alike, from their sizes in simulations (count, predicates).

    None if they are alike already.
    """
    if not sizes.size:
        return None
    typical = np.median(sizes, axis=0)
    usable = np.isfinite(typical) & (typical > 0.0)
    if not usable.any() or typical[usable].max() <= ALIKE * typical[usable].min():
        return None
    typical = np.where(usable, typical, typical[usable].max())
    return tuple((1.0 / typical).tolist())


def graded(formula: ir.Formula, signature: Signature) -> bool:
    """True if some predicate of a formula reads a real number, so that its margin varies continuously."""
    whole = {column.name for column in signature.columns if column.kind != "real"}
    predicates = [node for node in nodes(formula) if isinstance(node, ir.Predicate) and not node.guard]
    return not predicates or any(columns_of(each.num) - whole for each in predicates)


@lru_cache(maxsize=64)
def _scaled(
    formula: ir.Formula, predicates: tuple[ir.Predicate, ...], scales: tuple[float, ...] | None
) -> ir.Formula:
    if scales is None:
        return formula
    return _multiplied(formula, {each.num: scale for each, scale in zip(predicates, scales, strict=True)})


def _multiplied(formula: ir.Formula, factors: Mapping[ir.Num, float]) -> ir.Formula:
    if isinstance(formula, ir.Predicate):
        factor = factors.get(formula.num)
        if factor is None or formula.guard:
            return formula
        return map_children(formula, numbers=lambda num: ir.Op("mul", (ir.Const(factor), num)))
    return map_children(formula, formulas=lambda part: _multiplied(part, factors))


def _freezes(formula: ir.Formula) -> bool:
    """True if a predicate may read a frozen value, which has no size outside of its formula."""
    return any(isinstance(node, ir.Freeze) for node in nodes(formula))
