"""Mixed-integer linear models: variables with bounds, affine forms, linear constraints, conditions.

A tree of conditions joins affine conditions by `and` and `or`. A condition is implied by a binary variable:
if the variable is 1, the condition holds; if it is 0, the condition may hold or fail. The implication is a
linear constraint with a large constant (big-M), so that the constraint has no effect if the variable is 0.
The constant is the least one that the bounds of the variables in the constraint allow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray


class UnencodableError(Exception):
    """Error: an expression has no mixed-integer linear form, or none with bounded variables."""


@dataclass(frozen=True, slots=True)
class Affine:
    """A sum of variables with coefficients, and a constant.

    Attributes:
        terms: index of a variable -> coefficient, never 0.
        const: the constant.
    """

    terms: Mapping[int, float]
    const: float

    def plus(self, other: Affine, factor: float = 1.0) -> Affine:
        """This affine form plus `factor` times another."""
        if not other.terms:
            return Affine(self.terms, self.const + factor * other.const)
        terms = dict(self.terms)
        for index, value in other.terms.items():
            total = terms.get(index, 0.0) + factor * value
            if total:
                terms[index] = total
            else:
                terms.pop(index, None)
        return Affine(terms, self.const + factor * other.const)

    def times(self, factor: float) -> Affine:
        """This affine form times a constant."""
        if factor == 1.0:
            return self
        if not factor:
            return ZERO
        return Affine({i: factor * value for i, value in self.terms.items()}, factor * self.const)


ZERO = Affine({}, 0.0)


def constant(value: float) -> Affine:
    """A constant as an affine form."""
    return Affine({}, float(value))


@dataclass(eq=False, slots=True)
class Leaf:
    """The condition `form >= margin`.

    Attributes:
        form: affine form.
        margin: affine form that `form` must reach. If the robustness is maximised, the margin contains the
            variable of the robustness. For predicates on time, the margin is 0.
        literal: index of the binary variable that implies the condition; None until one is needed.
    """

    form: Affine
    margin: Affine = ZERO
    literal: int | None = None


@dataclass(eq=False, slots=True)
class Junction:
    """A conjunction or disjunction of conditions."""

    op: Literal["and", "or"]
    items: Sequence[Tree]
    literal: int | None = None


Tree: TypeAlias = "Leaf | Junction | bool"


def junction(op: Literal["and", "or"], items: Iterable[Tree]) -> Tree:
    """Conjunction or disjunction of conditions, simplified where conditions are constants."""
    found: list[Tree] = []
    for item in items:
        if isinstance(item, bool):
            if item == (op == "or"):
                return item
        elif isinstance(item, Junction) and item.op == op and item.literal is None:
            found.extend(item.items)
        else:
            found.append(item)
    if not found:
        return op == "and"
    return found[0] if len(found) == 1 else Junction(op, found)


@dataclass(frozen=True, slots=True)
class Arrays:
    """A model as arrays for a solver; the matrix of its linear constraints is in compressed row format.

    A row is one constraint; n is the number of variables.

    Attributes:
        lower, upper: bounds of the variables, (n,).
        integer: whether each variable is an integer, (n,).
        starts: index of the first entry of each row, (rows + 1,).
        indices: for each entry, the index of its variable.
        values: for each entry, its coefficient.
        row_lower, row_upper: bounds of the rows, (rows,).
        cost: coefficients of the cost that is minimised, (n,).
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    integer: NDArray[np.bool_]
    starts: NDArray[np.int32]
    indices: NDArray[np.int32]
    values: NDArray[np.float64]
    row_lower: NDArray[np.float64]
    row_upper: NDArray[np.float64]
    cost: NDArray[np.float64]


@dataclass(slots=True)
class Model:
    """A mixed-integer linear model under construction.

    Attributes:
        feasible: False if a constraint without variables is violated, or the bounds of a variable are
            contradictory.
    """

    feasible: bool = True
    _lower: list[float] = field(default_factory=list)
    _upper: list[float] = field(default_factory=list)
    _integer: list[bool] = field(default_factory=list)
    _rows: list[tuple[Mapping[int, float], float, float]] = field(default_factory=list)

    def variable(self, lower: float, upper: float, *, integer: bool = False) -> Affine:
        """Add a variable with the bounds `lower` and `upper`; return it as an affine form."""
        self._lower.append(lower)
        self._upper.append(upper)
        self._integer.append(integer)
        return Affine({len(self._lower) - 1: 1.0}, 0.0)

    def binary(self) -> Affine:
        """Add a binary variable; return it as an affine form."""
        return self.variable(0.0, 1.0, integer=True)

    def bounds(self, form: Affine) -> tuple[float, float]:
        """Least and greatest value of an affine form within the bounds of the variables."""
        low = high = form.const
        for index, value in form.terms.items():
            ends = value * self._lower[index], value * self._upper[index]
            low, high = low + min(ends), high + max(ends)
        return low, high

    def most(self, tree: Tree) -> float:
        """Upper bound on the robustness of the condition `tree`, from the bounds of the variables.

        It is inf if `tree` is the constant True, and -inf if `tree` is the constant False.
        """
        if isinstance(tree, bool):
            return math.inf if tree else -math.inf
        if isinstance(tree, Leaf):
            return self.bounds(tree.form)[1]
        return (min if tree.op == "and" else max)(map(self.most, tree.items))

    def tighten(self, form: Affine, lower: float) -> None:
        """Require `form >= lower` by tightening the bound of the single variable in `form`.

        If `form` has more than one variable, or none, nothing is done.
        """
        if len(form.terms) != 1:
            return
        ((index, factor),) = form.terms.items()
        end = (lower - form.const) / factor
        if factor > 0.0:
            self._lower[index] = max(self._lower[index], end)
        else:
            self._upper[index] = min(self._upper[index], end)
        self.feasible &= self._lower[index] <= self._upper[index]

    def limit(self, variable: Affine, upper: float) -> None:
        """Lower the upper bound of a variable to `upper`."""
        (index,) = variable.terms
        self._upper[index] = max(self._lower[index], min(self._upper[index], upper))

    def require(self, form: Affine, lower: float = 0.0, upper: float = math.inf) -> None:
        """Add the constraint `lower <= form <= upper`."""
        if not form.terms:
            self.feasible &= lower <= form.const <= upper
            return
        self._rows.append((form.terms, lower - form.const, upper - form.const))

    def named(self, form: Affine) -> Affine:
        """New variable that equals an affine form; a form with at most one term is returned unchanged."""
        if len(form.terms) <= 1:
            return form
        low, high = self.bounds(form)
        found = self.variable(low, high)
        self.require(form.plus(found, -1.0), 0.0, 0.0)
        return found

    def selected(self, binary: Affine, yes: Affine, no: Affine) -> Affine:
        """New variable that equals `yes` if the binary variable `binary` is 1, and `no` if it is 0."""
        (low, high), (least, most) = self.bounds(yes), self.bounds(no)
        found = self.variable(min(low, least), max(high, most))
        below, above = self.bounds(yes.plus(no, -1.0))
        over, under = found.plus(no, -1.0), yes.plus(found, -1.0)  # 0 and the gap, or the gap and 0
        for rest, rise in ((over, binary), (under, constant(1.0).plus(binary, -1.0))):
            self.require(rest.plus(rise, -below))
            self.require(rise.times(above).plus(rest, -1.0))
        return found

    def imply(self, off: Affine, tree: Tree) -> None:
        """Add constraints that force the condition `tree` to hold if `off` is 0.

        `off` is an affine form with nonnegative integer values. If its value is 1 or more, nothing is
        required.
        """
        if isinstance(tree, bool):
            if not tree:
                self.require(off, 1.0)
        elif isinstance(tree, Leaf):
            needed = tree.form.plus(tree.margin, -1.0)
            low, _ = self.bounds(needed)
            if low < 0.0:
                self.require(needed.plus(off, -low) if off.terms else needed.plus(off, 0.0))
        elif tree.op == "and":
            for item in tree.items:
                self.imply(off, item)
        else:
            total = off
            for item in tree.items:
                total = total.plus(self.literal(item))
            self.require(total, 1.0)

    def literal(self, tree: Leaf | Junction | bool) -> Affine:
        """Binary variable that implies the condition `tree`: if the variable is 1, the condition holds.

        The variable is created on the first call for the condition. For a constant condition, the result is
        the constant 0 or 1.
        """
        if isinstance(tree, bool):
            return constant(float(tree))
        if tree.literal is None:
            binary = self.binary()
            (tree.literal,) = binary.terms
            self.imply(Affine({tree.literal: -1.0}, 1.0), tree)
        return Affine({tree.literal: 1.0}, 0.0)

    def arrays(self, cost: Affine = ZERO) -> Arrays:
        """The model as arrays for a solver; the affine form `cost` is to be minimised."""
        lengths = [len(terms) for terms, _, _ in self._rows]
        costs = np.zeros(len(self._lower))
        for index, value in cost.terms.items():
            costs[index] = value
        return Arrays(
            np.array(self._lower),
            np.array(self._upper),
            np.array(self._integer, dtype=bool),
            np.concatenate(([0], np.cumsum(lengths))).astype(np.int32),
            np.array([i for terms, _, _ in self._rows for i in terms], dtype=np.int32),
            np.array([v for terms, _, _ in self._rows for v in terms.values()]),
            np.array([low for _, low, _ in self._rows]),
            np.array([high for _, _, high in self._rows]),
            costs,
        )
