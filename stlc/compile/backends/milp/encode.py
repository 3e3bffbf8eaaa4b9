"""Encoding of dynamics and formulas of the IR as a mixed-integer linear model, for one initial state.

Signals that no control affects are constants, and an expression of constants is replaced by its value. The
encoding is tight or relaxed. In a tight encoding the conditions in the dynamics hold or fail with a margin of
at least `MARGIN`, so that every solution is a plan. In a relaxed encoding every plan that satisfies the
specification is a solution. If a relaxed encoding has no solution, no plan satisfies the specification.

Without norms, both encodings are exact up to `MARGIN`. For norms, circles are replaced by polygons with
`SIDES` sides. This makes a condition stronger in the tight encoding and weaker in the relaxed one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from stlc.compile.backends.milp.model import (
    ZERO,
    Affine,
    Junction,
    Leaf,
    Model,
    Tree,
    UnencodableError,
    constant,
    junction,
)
from stlc.compile.backends.schedule import PICKS, End, TraceDomain, earliest, latest, operands, spanning
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.ir.text import show_number

MARGIN = 1e-5
"""Margin of the dynamics' conditions in a tight encoding; tolerance of all conditions in a relaxed one."""
SIDES = 16
"""Sides of the polygon that stands for a circle."""


@dataclass(frozen=True, slots=True)
class Greatest:
    """Maximum of several values. A minimum is expressed as minus the maximum of the negated values."""

    items: tuple[Expression, ...]


@dataclass(frozen=True, slots=True)
class Conditional:
    """Conditional value: one value if a condition holds, else another.

    Attributes:
        yes, no: the value if the condition holds, and the value if it fails.
        holds: the condition, as a tree of affine conditions.
        fails: the negation of the condition, in the same form.
    """

    yes: Expression
    no: Expression
    holds: Tree
    fails: Tree


@dataclass(frozen=True, slots=True)
class Norm:
    """The Euclidean norm of affine forms."""

    parts: tuple[Affine, ...]


@dataclass(frozen=True, slots=True)
class Square:
    """The square of a variable."""

    variable: int


Atom: TypeAlias = "Greatest | Conditional | Norm | Square"


@dataclass(frozen=True, slots=True)
class Expression:
    """Affine form plus a linear combination of atoms (maxima, conditional values, norms, squares).

    An atom stays symbolic as long as possible. Only where necessary, variables of the model replace it.

    Attributes:
        form: the affine part.
        atoms: (coefficient, atom) pairs.
    """

    form: Affine
    atoms: tuple[tuple[float, Atom], ...] = ()

    def plus(self, other: Expression, factor: float = 1.0) -> Expression:
        """This value plus `factor` times another."""
        added = tuple((factor * each, atom) for each, atom in other.atoms)
        return Expression(self.form.plus(other.form, factor), self.atoms + added)

    def times(self, factor: float) -> Expression:
        """This value times a constant."""
        if not factor:
            return Expression(ZERO)
        return Expression(self.form.times(factor), tuple((factor * each, atom) for each, atom in self.atoms))

    @property
    def known(self) -> float | None:
        """The number if the value is a constant; None otherwise."""
        return None if self.atoms or self.form.terms else self.form.const


def number(value: float) -> Expression:
    """A constant as an expression."""
    return Expression(constant(value))


@dataclass(frozen=True, slots=True)
class Demand:
    """Formula that must hold at the first sample.

    Attributes:
        formula: formula of the IR.
        margin: least robustness of each predicate in the formula, as an affine form. It does not apply to
            predicates on time alone, which only need to be true.
    """

    formula: ir.Formula
    margin: Affine


Row: TypeAlias = dict[str, Expression]
"""Columns at one sample: name -> value."""


class Encoding:
    """Mixed-integer linear model of the plans from one initial state.

    If `tight`, every solution of the model is a plan of the system. Otherwise the encoding is relaxed: every
    plan that satisfies the requirements is a solution, but a solution need not be a plan of the system.

    Attributes:
        model: variables and constraints of the program.
        rows: for each of the T + 1 samples a mapping from the name of a signal to its value.
        controls: variables of the plan, (T, m).
    """

    def __init__(self, *, tight: bool, end: End = "strict") -> None:
        self.model = Model()
        self._end = end
        self.rows: list[Row] = []
        self.controls: list[list[Affine]] = []
        self._tight = tight
        self._slack = constant(MARGIN if tight else -MARGIN)
        self._required = constant(0.0 if tight else -MARGIN)  # a margin of exactly 0 satisfies
        self._numbers: dict[tuple[int, int], Expression] = {}
        self._trees: dict[tuple[int, int, int], Tree] = {}
        self._free: set[int] = set()
        self._plain: dict[int, bool] = {}

    # ------------------------------------------------------------------ dynamics

    def rollout(
        self,
        x0: Mapping[str, float],
        bounds: Mapping[str, tuple[float, float]],
        lets: Sequence[tuple[str, ir.Num]],
        step: Mapping[str, ir.Num],
        horizon: int,
        requirements: Sequence[Demand] = (),
    ) -> list[Tree]:
        """Encode the dynamics over a horizon, and requirements at the first sample.

        A requirement such as `always p` must hold at every sample. At each sample it bounds the state
        variables before the next step is encoded. These bounds decide many of the conditions in that step.

        Args:
            x0: initial state, name -> value.
            bounds: control -> its range.
            lets: intermediate results of a step as (name, expression), in order.
            step: name of a state that changes -> expression of its value one step later.
            horizon: number of steps.
            requirements: formulas that must hold at the first sample, with the robustness that their
                predicates must reach.

        Returns:
            For each requirement the condition under which it holds. The caller must add these conditions to
            the model as constraints.

        Raises:
            UnencodableError: an expression has no mixed-integer linear form.
        """
        row: Row = {name: number(value) for name, value in x0.items()}
        once = _read_once(set(bounds), lets, step.values())
        for k in range(horizon):
            row[ir.ELAPSED] = number(float(k))
            self._invariants(requirements, row, k)
            inputs = [self.model.variable(*ends) for ends in bounds.values()]
            self.controls.append(inputs)
            self._free = {
                index
                for (name, (low, high)), form in zip(bounds.items(), inputs, strict=True)
                for index in form.terms
                if name in once and low <= 0.0 <= high
            }
            env = row | {name: Expression(form) for name, form in zip(bounds, inputs, strict=True)}
            self.rows.append(env)
            for name, num in lets:
                env[name] = Expression(self._linear(self._number(num, k), num))
            moved = {name: Expression(self._linear(self._number(num, k), num)) for name, num in step.items()}
            row = {name: moved.get(name, value) for name, value in row.items()}
        row[ir.ELAPSED] = number(float(horizon))
        self._invariants(requirements, row, horizon)
        self.rows.append(row)
        return [self._tree(each.formula, 0, each) for each in requirements]

    def _invariants(self, requirements: Sequence[Demand], row: Row, k: int) -> None:
        """Tighten the bounds of the states at sample `k`, using conditions that the requirements imply there.

        `row` maps the name of a signal to its value at sample `k`. If one of the conditions cannot hold, the
        model is marked as infeasible.
        """
        self.rows.append(row)
        for each in requirements:
            for body in self._demanded(each.formula, k, each):
                for part in _conjuncts(self._tree(body, k, each)):
                    if part is False:
                        self.model.feasible = False
                    elif isinstance(part, Leaf):
                        self.model.tighten(part.form, part.margin.const)
        self.rows.pop()

    def _demanded(self, formula: ir.Formula, k: int, what: Demand) -> Iterator[ir.Formula]:
        """Yield state formulas that must hold at sample `k` if `formula` holds at the first sample.

        A state formula has no temporal operators. For `always[0, 5] p` and k = 3, this is p. `what` is the
        requirement that `formula` belongs to.
        """
        match formula:
            case ir.Predicate() if k == 0:
                yield formula
            case ir.BoolOp("and", items):
                for item in items:
                    yield from self._demanded(item, k, what)
            case ir.BoolOp("or", items):
                left = [
                    item
                    for item in items
                    if not self._of_state(item) or self._tree(item, 0, what) is not False
                ]
                if len(left) == 1:
                    yield from self._demanded(left[0], k, what)
            case ir.Temporal("always", window, body) if self._of_state(body):
                if window.lo <= k and (window.hi is None or k <= window.hi):
                    yield body

    def _of_state(self, formula: ir.Formula) -> bool:
        """True if the formula is about the signals at a single sample, without temporal operators."""
        key = id(formula)
        if key not in self._plain:
            self._plain[key] = _of_state(formula)
        return self._plain[key]

    # ------------------------------------------------------------------- formulas

    def _tree(self, formula: ir.Formula, k: int, what: Demand) -> Tree:
        """Condition under which `formula`, a part of the requirement `what`, holds at sample `k`."""
        key = id(what), id(formula), k
        if key not in self._trees:
            self._trees[key] = self._formula(formula, k, what)
        return self._trees[key]

    def _formula(self, node: ir.Formula, k: int, margin: Demand) -> Tree:
        match node:
            case ir.Truth(value):
                return value
            case ir.Predicate():
                return self._predicate(node, k, margin.margin.plus(self._required))
            case ir.BoolOp(op, items):
                return junction(op, (self._tree(item, k, margin) for item in items))
            case ir.AtStart(body):
                return self._tree(body, 0, margin)
            case ir.Temporal() | ir.PastTemporal() | ir.Until() | ir.Since():
                return self._windowed(node, k, margin)
            case ir.Shift(steps, body, outside):
                inside = 0 <= k + steps < len(self.rows)
                if not inside and outside is None:
                    raise UnencodableError("a sample outside the horizon")
                return self._tree(body, k + steps, margin) if inside else bool(outside)
        raise UnencodableError(f"`{type(node).__name__.lower()}`")

    def _windowed(
        self, node: ir.Temporal | ir.PastTemporal | ir.Until | ir.Since, k: int, margin: Demand
    ) -> Tree:
        """Condition under which a temporal operator holds at sample `k`.

        The left operand of `until` (and of its dual and counterparts of the past) is read at all samples
        between `k` and the one of the window, both included.
        """
        end, samples = node.window_offsets.last, len(self.rows)
        if end is not None and k + end >= samples and self._end == "strict":
            raise UnencodableError("a window beyond the horizon")
        *lefts, (right, window) = operands(node, spanning(k, 1), TraceDomain(samples, self._end))
        least = PICKS[node.op] == "min"
        found = []
        for j in range(earliest(window.start), latest(window.last) + 1):
            held = range(min(j, k), max(j, k) + 1)
            kept = [self._tree(left, i, margin) for left, _ in lefts for i in held]
            found.append(junction("or" if least else "and", [*kept, self._tree(right, j, margin)]))
        return junction("and" if least else "or", found)

    def _predicate(self, node: ir.Predicate, k: int, margin: Affine) -> Tree:
        value = self._number(node.num, k).times(float(node.sign))
        if value.known is not None and (node.guard or not margin.terms):
            least = 0.0 if node.guard else margin.const - self._required.const
            slack = 0.0 if self._tight or node.guard else MARGIN
            return value.known > least if node.strict and node.guard else value.known >= least - slack
        return self._condition(value, ZERO if node.guard else margin, node.num)

    def _decided(self, cond: ir.Formula, k: int, *, holds: bool) -> Tree:
        """Condition under which the state formula `cond` is true at sample `k`.

        If `holds` is False, the result is the condition under which `cond` is false.
        """
        match cond:
            case ir.Truth(truth):
                return truth == holds
            case ir.Predicate(num, sign, strict):
                value = self._number(num, k).times(float(sign))
                if value.known is not None:
                    return (value.known > 0.0 if strict else value.known >= 0.0) == holds
                return self._condition(value if holds else value.times(-1.0), self._slack, num)
            case ir.BoolOp(op, items):
                turned = op if holds else ("or" if op == "and" else "and")
                return junction(turned, (self._decided(item, k, holds=holds) for item in items))
        raise UnencodableError("a condition over time")

    def _condition(self, value: Expression, margin: Affine, num: ir.Num) -> Tree:
        """Condition `value >= margin` as a tree of affine conditions.

        Each operand of a maximum, and each branch of a conditional value, becomes a condition of its own.
        `num` is the source expression of `value`; error messages show it.

        Raises:
            UnencodableError: the condition has no mixed-integer linear form.
        """
        for index, (factor, atom) in enumerate(value.atoms):
            rest = Expression(value.form, value.atoms[:index] + value.atoms[index + 1 :])
            match atom:
                case Greatest(items):
                    parts = [self._condition(rest.plus(item, factor), margin, num) for item in items]
                    return junction("or" if factor > 0.0 else "and", parts)
                case Conditional(yes, no, holds, fails):
                    first = self._condition(rest.plus(yes, factor), margin, num)
                    second = self._condition(rest.plus(no, factor), margin, num)
                    return junction("and", (junction("or", (fails, first)), junction("or", (holds, second))))
                case Norm(lengths) if len(value.atoms) == 1:
                    return self._circle(value.form, factor, lengths, margin)
        return self._polynomial(value, margin, num)

    def _polynomial(self, value: Expression, margin: Affine, num: ir.Num) -> Tree:
        """Condition `value >= margin` as a tree, if `value` is affine or quadratic without other atoms.

        `num` is the source expression of `value`; error messages show it.
        """
        squares: dict[int, float] = {}
        for factor, atom in value.atoms:
            if not isinstance(atom, Square):
                raise UnencodableError(show_number(num))
            squares[atom.variable] = squares.get(atom.variable, 0.0) + factor
        squares = {variable: factor for variable, factor in squares.items() if factor}
        if not squares:
            return self._leaf(value.form, margin)
        if margin.terms:
            raise UnencodableError(f"the robustness of {show_number(num)}")
        form = value.form.plus(margin, -1.0)
        if not set(form.terms) <= set(squares) or len({factor > 0.0 for factor in squares.values()}) > 1:
            raise UnencodableError(show_number(num))
        if len(squares) == 1:
            ((variable, factor),) = squares.items()
            return self._quadratic(variable, factor, form)
        return self._ellipse(squares, form)

    def _leaf(self, form: Affine, margin: Affine) -> Tree:
        needed = form.plus(margin, -1.0)
        low, high = self.model.bounds(needed)
        if low >= 0.0:
            return True
        return False if high < 0.0 else Leaf(form, margin)

    def _quadratic(self, variable: int, a: float, form: Affine) -> Tree:
        """Condition `a x^2 + form >= 0` as affine conditions on x, by the roots of the polynomial.

        `variable` is the index of the variable x, and `form` is affine in x.
        """
        b, c = form.terms.get(variable, 0.0), form.const
        inside = b * b - 4.0 * a * c
        if inside <= 0.0:
            return a > 0.0
        root = math.sqrt(inside)
        low, high = sorted(((-b - root) / (2.0 * a), (-b + root) / (2.0 * a)))
        x = Affine({variable: 1.0}, 0.0)
        below = self._leaf(constant(low).plus(x, -1.0), ZERO), self._leaf(x.plus(constant(-high)), ZERO)
        between = self._leaf(x.plus(constant(-low)), ZERO), self._leaf(constant(high).plus(x, -1.0), ZERO)
        return junction("or", below) if a > 0.0 else junction("and", between)

    def _ellipse(self, squares: Mapping[int, float], form: Affine) -> Tree:
        """Condition `sum(a_i x_i^2 + b_i x_i) + c >= 0`, rewritten as a bound on a norm.

        All `a_i` must have the same sign. `squares` maps the index of the variable `x_i` to `a_i`. `form` is
        the affine part: the sum of all `b_i x_i`, plus c.
        """
        sign = 1.0 if next(iter(squares.values())) > 0.0 else -1.0
        parts, rest = [], sign * form.const
        for variable, factor in squares.items():
            a, b = abs(factor), sign * form.terms.get(variable, 0.0)
            parts.append(Affine({variable: math.sqrt(a)}, b / (2.0 * math.sqrt(a))))
            rest -= b * b / (4.0 * a)
        if rest >= 0.0:
            return sign > 0.0  # an empty or a single-point circle
        return self._circle(constant(-sign * math.sqrt(-rest)), sign, tuple(parts), ZERO)

    def _circle(self, form: Affine, factor: float, parts: Sequence[Affine], margin: Affine) -> Tree:
        """Condition `form + factor * norm(parts) >= margin`, with a polygon in place of the circle.

        By this replacement the condition becomes stronger in a tight encoding and weaker in a relaxed one.
        """
        if len(parts) == 1:
            both = (form.plus(parts[0], factor), form.plus(parts[0], -factor))
            return junction("or" if factor > 0.0 else "and", [self._leaf(each, margin) for each in both])
        if len(parts) != 2:
            raise UnencodableError(f"a norm of {len(parts)} numbers")
        shrink = math.cos(math.pi / SIDES)
        # inside: directions d with d.p <= r are circumscribed; r cos(pi / n) makes the polygon inscribed
        scale = (
            (1.0 if self._tight else 1.0 / shrink) if factor > 0.0 else (1.0 / shrink if self._tight else 1.0)
        )
        leaves = []
        for side in range(SIDES):
            angle = 2.0 * math.pi * side / SIDES
            along = parts[0].times(math.cos(angle)).plus(parts[1].times(math.sin(angle)))
            leaves.append(self._leaf(form.plus(along, factor * scale), margin))
        return junction("or" if factor > 0.0 else "and", leaves)

    # -------------------------------------------------------------------- numbers

    def _number(self, num: ir.Num, k: int) -> Expression:
        """Value of the expression `num` at sample `k`."""
        key = id(num), k
        if key not in self._numbers:
            self._numbers[key] = self._value(num, k)
        return self._numbers[key]

    def _value(self, num: ir.Num, k: int) -> Expression:
        match num:
            case ir.Const(value):
                return number(value)
            case ir.Signal(name):
                return self.rows[k][name]
            case ir.ShiftedSignal(name, steps, clamped):
                at = min(max(k + steps, 0), len(self.rows) - 1) if clamped else k + steps
                if not 0 <= at < len(self.rows):
                    raise UnencodableError("a sample outside the horizon")
                return self.rows[at][name]
            case ir.Op(name, args):
                return self._op(num, name, [self._number(arg, k) for arg in args])
            case ir.Where(cond, yes, no):
                return self._choice(cond, k, lambda: self._number(yes, k), lambda: self._number(no, k))
            case ir.Indicator(cond):
                return self._choice(cond, k, lambda: number(1.0), lambda: number(0.0))
        raise UnencodableError(show_number(num))

    def _choice(
        self, cond: ir.Formula, k: int, yes: Callable[[], Expression], no: Callable[[], Expression]
    ) -> Expression:
        """Value of a choice; one branch alone where the bounds exclude the other.

        In a relaxed encoding, a condition at its boundary holds and fails, and both branches remain.
        """
        holds, fails = (self._decided(cond, k, holds=each) for each in (True, False))
        if fails is False or (self._tight and holds is True):
            return yes()
        if holds is False or (self._tight and fails is True):
            return no()
        return Expression(ZERO, ((1.0, Conditional(yes(), no(), holds, fails)),))

    def _op(self, num: ir.Num, name: str, args: list[Expression]) -> Expression:
        known = [arg.known for arg in args]
        fold = FUNCTIONS[name].fold
        if fold is not None and None not in known:
            return number(float(fold(*known)))
        if name in _FORMS:
            return _FORMS[name](self, args)
        if name == "norm":
            return Expression(ZERO, ((1.0, Norm(tuple(self._linear(arg, num) for arg in args))),))
        if name == "mul" or name == "square" or (name == "pow" and known[1] == 2.0):
            return self._product(num, args[0], args[1] if name == "mul" else args[0])
        divisor = known[-1]
        if name == "div" and divisor:
            return args[0].times(1.0 / divisor)
        if name == "mod" and divisor:
            return self._remainder(self._linear(args[0], num), divisor)
        raise UnencodableError(show_number(num))

    def _clipped(self, args: Sequence[Expression]) -> Expression:
        held = self._held(args)
        if held is not None:
            return held
        above = self._greatest(args[:2])
        return self._greatest([above.times(-1.0), args[2].times(-1.0)]).times(-1.0)

    def _greatest(self, items: Sequence[Expression]) -> Expression:
        """Maximum of values. A value that is never the greatest, as the bounds show, is left out."""
        ends = [(-math.inf, math.inf) if v.atoms else self.model.bounds(v.form) for v in items]
        least = max(low for low, _ in ends)
        left = [i for i, (_, high) in enumerate(ends) if high > least]
        if not any(ends[i][0] >= least for i in left):
            left.append(next(i for i, (low, _) in enumerate(ends) if low >= least))
        if len(left) == 1:
            return items[left[0]]
        return Expression(ZERO, ((1.0, Greatest(tuple(items[i] for i in left))),))

    def _held(self, args: Sequence[Expression]) -> Expression | None:
        """Encode `clip(v + c u, low, high)` without clipping, as a variable that equals `v + c u`.

        Here u is a control that no other expression reads, not even through a result, and v lies within
        [low, high]. If the sum `v + c u` exceeds a bound, a u closer to 0 gives exactly this bound. So no
        behaviour is lost if the sum is constrained to [low, high]. `args` contains the three arguments of
        `clip`.

        The result is None if v may leave the bounds, or if the arguments have another form.
        """
        form, low, high = args[0].form, args[1].known, args[2].known
        free = self._free & form.terms.keys()
        if args[0].atoms or low is None or high is None or not free:
            return None
        least, most = self.model.bounds(
            Affine({i: c for i, c in form.terms.items() if i not in free}, form.const)
        )
        if least < low or most > high:
            return None
        ends = self.model.bounds(form)
        found = self.model.variable(max(low, ends[0]), min(high, ends[1]))
        self.model.require(form.plus(found, -1.0), 0.0, 0.0)
        return Expression(found)

    def _product(self, num: ir.Num, left: Expression, right: Expression) -> Expression:
        for one, other in ((left, right), (right, left)):
            if one.known is not None:
                return other.times(one.known)
        for one, other in ((left, right), (right, left)):
            scaled = _scaled(one, other)
            if scaled is not None:
                return scaled
        first, second = self._linear(left, num), self._linear(right, num)
        if len(first.terms) == 1 and first.terms.keys() == second.terms.keys():
            ((variable, a),), ((_, b),) = first.terms.items(), second.terms.items()
            cross = a * second.const + b * first.const
            form = Affine({variable: cross} if cross else {}, first.const * second.const)
            return Expression(form, ((a * b, Square(variable)),))
        raise UnencodableError(show_number(num))

    def _remainder(self, form: Affine, divisor: float) -> Expression:
        """`form` modulo the constant `divisor`, encoded with an integer variable for the quotient."""
        low, high = self.model.bounds(form.times(1.0 / divisor))
        if math.floor(low) == math.floor(high):
            return Expression(form.plus(constant(-divisor * math.floor(low))))
        whole = self.model.variable(math.floor(low), math.floor(high), integer=True)
        rest = form.plus(whole, -divisor)
        self.model.require(rest, min(0.0, divisor), max(0.0, divisor))
        return Expression(rest)

    def _linear(self, value: Expression, num: ir.Num) -> Affine:
        """Affine form that equals `value`; maxima and conditional values become variables of the model.

        `num` is the source expression of `value`; error messages show it.

        Raises:
            UnencodableError: the value contains a norm or a square.
        """
        form = value.form
        for factor, atom in value.atoms:
            match atom:
                case Greatest(items):
                    form = form.plus(self._extremum([self._linear(item, num) for item in items]), factor)
                case Conditional(yes, no, holds, fails):
                    ends = self._linear(yes, num), self._linear(no, num)
                    form = form.plus(self._switched(*ends, holds, fails), factor)
                case _:
                    raise UnencodableError(show_number(num))
        return self.model.named(form)

    def _extremum(self, forms: Sequence[Affine]) -> Affine:
        """New variable that equals the maximum of affine forms."""
        model = self.model
        ends = [model.bounds(form) for form in forms]
        found = model.variable(max(low for low, _ in ends), max(high for _, high in ends))
        total = constant(-1.0)
        for form, (low, _) in zip(forms, ends, strict=True):
            binary = model.binary()
            total = total.plus(binary)
            model.require(found.plus(form, -1.0))
            most = model.bounds(found)[1] - low
            model.require(form.plus(found, -1.0).plus(binary, -most).plus(constant(most)))
        model.require(total, 0.0, 0.0)
        return found

    def _switched(self, yes: Affine, no: Affine, holds: Tree, fails: Tree) -> Affine:
        """Affine form that equals `yes` if a condition holds and `no` if it fails.

        `holds` is the condition as a tree, `fails` its negation.
        """
        model, binary = self.model, self.model.binary()
        model.imply(constant(1.0).plus(binary, -1.0), holds)
        model.imply(binary, fails)
        gap = yes.plus(no, -1.0)
        if not gap.terms:
            return no.plus(binary, gap.const)
        return model.selected(binary, yes, no)


_FORMS: dict[str, Callable[[Encoding, list[Expression]], Expression]] = {
    "add": lambda _, args: args[0].plus(args[1]),
    "sub": lambda _, args: args[0].plus(args[1], -1.0),
    "neg": lambda _, args: args[0].times(-1.0),
    "max": lambda to, args: to._greatest(args),
    "min": lambda to, args: to._greatest([arg.times(-1.0) for arg in args]).times(-1.0),
    "abs": lambda to, args: to._greatest([args[0], args[0].times(-1.0)]),
    "relu": lambda to, args: to._greatest([args[0], number(0.0)]),
    "clip": lambda to, args: to._clipped(args),
}
"""Built-in functions that are piecewise linear in all arguments."""


def _read_once(names: set[str], lets: Sequence[tuple[str, ir.Num]], nums: Iterable[ir.Num]) -> set[str]:
    """Those signals in `names` that `nums` read exactly once, directly or through the results `lets`.

    A result may be encoded as a multiple of a signal, so each of its readers counts as one of that signal.
    """
    reads = Counter[str]()

    def read(num: ir.Num, times: int) -> None:
        for leaf in num.leaves():
            if isinstance(leaf, ir.Signal):
                reads[leaf.name] += times

    for num in nums:
        read(num, 1)
    for name, num in reversed(lets):
        read(num, max(1, reads[name]))
    return {name for name in names if reads[name] == 1}


def _of_state(formula: ir.Formula) -> bool:
    """True if the formula is about the signals at a single sample, without temporal operators."""
    return all(isinstance(node, ir.Truth | ir.Predicate | ir.BoolOp) for node in formula.walk()) and not any(
        isinstance(leaf, ir.ShiftedSignal) for num in formula.numbers() for leaf in num.leaves()
    )


def _conjuncts(tree: Tree) -> Iterator[Tree]:
    """Yield conditions whose conjunction equals the condition `tree`."""
    if isinstance(tree, Junction) and tree.op == "and":
        for item in tree.items:
            yield from _conjuncts(item)
    else:
        yield tree


def _scaled(one: Expression, other: Expression) -> Expression | None:
    """Product of `one` and `other`, if `one` is a choice between two constants; None otherwise.

    The product is then a choice between two multiples of `other`.
    """
    match one.atoms:
        case ((factor, Conditional(yes, no, holds, fails)),) if not one.form.terms:
            if yes.known is None or no.known is None:
                return None
            chosen = Conditional(
                other.times(factor * yes.known), other.times(factor * no.known), holds, fails
            )
            return other.times(one.form.const).plus(Expression(ZERO, ((1.0, chosen),)))
    return None
