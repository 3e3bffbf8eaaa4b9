"""Region of the initial states from which a trained policy fails: how it is found, described and drawn.

The region is determined on held-out starts: initial states that were not used in training. It is a
conjunction of simple conditions. It contains many failing starts and few others: a beam search maximises its
F-score (subgroup discovery).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import StlcError
from stlc.records import from_json
from stlc.rundir import RunDir
from stlc.signature import Signature
from stlc.trace.formats.npz import read_arrays
from stlc.view.style import BLUE, INK, MUTED, RED, Picture, new_figure, picture, picture_style
from stlc.view.words import labelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MAX_CONDITIONS = 4
BEAM = 12
ENOUGH = 10  # minimum number of failing starts for a region
LEAST_GAIN = 1.04  # factor by which an added condition must improve the F-score
FEW_VALUES = 8  # columns with at most so many distinct values are compared by `=` only
COMMON = 0.05  # minimum share of the starts for a single value of a continuous column

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The held-out starts (initial states) of a run and the robustness of the policy's plans from them.

    Attributes:
        names: name of the state in each column of `x0`.
        requirements: names, in the order of the columns of `each`.
        x0: initial states, (starts, columns).
        rho: robustness over all requirements, (starts,).
        each: robustness per requirement, (starts, requirements).
        known: whether a satisfying plan is known from a start, (starts,); None if this was not recorded.
        searched: False for a start from which the policy's plan fails, and no other plan was searched for;
            else True. (starts,), or None if all are True.
    """

    names: tuple[str, ...]
    requirements: tuple[str, ...]
    x0: Array
    rho: Array
    each: Array
    known: Mask | None = None
    searched: Mask | None = None

    @property
    def unsearched(self) -> int:
        """Number of starts from which the policy's plan fails and no other plan was searched for."""
        return 0 if self.searched is None else int((~self.searched).sum())

    @property
    def worst(self) -> int:
        """Index of the requirement that is violated from the most starts."""
        return int(np.argmax(TOLERANCE.violated(self.each).mean(axis=0)))

    @property
    def unsolved(self) -> tuple[int, int]:
        """Number of unsolved starts, and for how many of them a satisfying plan is known.

        A start is unsolved if the policy's plan from it fails.
        """
        failing = ~TOLERANCE.satisfied(self.rho)
        return int(failing.sum()), 0 if self.known is None else int((failing & self.known).sum())

    def weakness(self, requirement: int | None = None) -> Weakness | None:
        """Return the region in which a requirement fails; None if it never fails.

        `requirement` is the index of the requirement. By default, the requirement that is violated from the
        most starts is chosen.
        """
        index = self.worst if requirement is None else requirement
        failing = TOLERANCE.violated(self.each[:, index])
        if not failing.any():
            return None
        conditions = _grow(self.x0, failing) if failing.sum() >= ENOUGH else ()
        region = _region(self.x0, conditions)
        # drawn are states of an inequality, then those that best separate failing from satisfied starts
        used, every = [each.column for each in conditions if each.op != "="], range(self.x0.shape[1])
        focus = _region(self.x0, [each for each in conditions if each.op == "="])
        many = [c for c in every if len(np.unique(self.x0[focus, c])) > FEW_VALUES] or every
        ranked = sorted(many, key=lambda c: -_separation(self.x0[focus, c], failing[focus]))
        first, second, *_ = [*dict.fromkeys([*used, *ranked]), *every, 0, 0]
        return Weakness(
            requirement=index,
            failing=float(failing.mean()),
            conditions=conditions,
            inside=float(failing[region].mean()),
            covered=float(region[failing].mean()),
            axes=(first, second),
        )

    @property
    def unsolved_text(self) -> str:
        """Sentence on the starts from which the policy's plan fails.

        It gives their number, and for how many of them a satisfying plan is known.
        """
        failing, known = self.unsolved
        text = f"{failing:,} of {len(self.x0):,} starts"
        if self.known is None or not failing:
            return text
        if self.unsearched:
            tried = failing - self.unsearched
            return f"{text}; a satisfying plan is known for {known:,} of the {tried:,} that were searched"
        if not known:
            return f"{text}; no satisfying plan is known for any of them"
        if known == failing:
            return f"{text}; a satisfying plan is known for each of them"
        none = failing - known
        return f"{text}; a satisfying plan is known for {known:,} of them, for {none:,} none was found"


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition on an initial state: the value in column number `column` is compared with `value`."""

    column: int
    op: Literal["<=", ">=", "="]
    value: float

    def holds(self, x0: Array) -> Mask:
        """Evaluate the condition for initial states (starts, columns); returns booleans, (starts,)."""
        return np.asarray(_COMPARE[self.op](x0[:, self.column], self.value))


_COMPARE = {"<=": np.less_equal, ">=": np.greater_equal, "=": np.equal}


@dataclass(frozen=True, slots=True)
class Weakness:
    """Region of the initial states in which one requirement fails.

    Attributes:
        requirement: index of the requirement.
        failing: share of all starts from which the requirement fails.
        conditions: conditions on the initial state; in the region, all of them hold.
        inside: share of failing starts among those in the region.
        covered: share of the failing starts that lie in the region.
        axes: indices of the two states that best separate failing starts from satisfied ones.
    """

    requirement: int
    failing: float
    conditions: tuple[Condition, ...]
    inside: float
    covered: float
    axes: tuple[int, int]

    def text(self, held: HeldOut, signature: Signature | None = None) -> str:
        """Clause on a failure region: `fails in 80 % of the starts with x <= -1 m (70 % of its failures)`.

        The first number is the share of starts in the region that fail. The second is the share of all
        failing starts that lie in the region.
        """
        if not self.conditions:
            failing = round(self.failing * len(held.x0))
            return f"fails in {failing:,} of {len(held.x0):,} starts, in no region of their own"
        region = region_text(self.conditions, held.names, signature)
        return (
            f"fails in {100 * self.inside:.0f} % of the starts with {region}"
            f" ({100 * self.covered:.0f} % of its failures)"
        )


@dataclass(frozen=True, slots=True)
class HeldOutNames:
    """Names of the states and of the requirements of a held-out set."""

    names: tuple[str, ...]
    requirements: tuple[str, ...]


def load_held_out(run: RunDir) -> HeldOut | None:
    """Load the held-out set that training wrote; None if the file is missing or damaged.

    Raises RunError (R110) if it is no file of the run.
    """
    path = run.file(RunDir.HELD_OUT, RunDir.MOST_ARRAYS)
    try:
        file = read_arrays(path)
        meta = from_json(HeldOutNames, str(file["meta"]), path)
        x0, rho, each = (np.asarray(file[key], dtype=float) for key in ("x0", "rho", "requirements"))
        known, searched = (
            np.asarray(file[key], dtype=bool) if key in file else None for key in ("known", "searched")
        )
    except (StlcError, KeyError, ValueError, RecursionError):
        return None
    names, requirements = meta.names, meta.requirements
    shapes_fit = x0.ndim == 2 and each.shape == (len(x0), len(requirements)) and rho.shape == (len(x0),)
    if not shapes_fit or x0.shape[1] != len(names) or not len(x0) or not requirements:
        return None
    if any(mask is not None and mask.shape != rho.shape for mask in (known, searched)):
        return None
    return HeldOut(names, requirements, x0, rho, each, known, searched)


def _grow(x0: Array, failing: Mask) -> tuple[Condition, ...]:
    """Find conditions that together describe the failing starts best.

    They are found by a beam search that maximises the F-score of the region in which all conditions hold.
    More conditions are used only if the score grows by at least the factor `LEAST_GAIN`. `failing`,
    (starts,), is True for failing starts.
    """
    best: tuple[Condition, ...] = ()
    best_score = _f_score(np.ones(len(x0), dtype=bool), failing)
    values = [_Values.of(column) for column in x0.T]
    beam = [best]
    for _ in range(MAX_CONDITIONS):
        grown: dict[frozenset[Condition], tuple[float, tuple[Condition, ...]]] = {}
        for shorter in beam:
            region = _region(x0, shorter)
            for condition in _candidates(x0, region, failing, values):
                score = _f_score(region & condition.holds(x0), failing)
                grown.setdefault(frozenset((*shorter, condition)), (score, (*shorter, condition)))
        ranked = sorted(grown.values(), key=lambda found: -found[0])[:BEAM]
        beam = [conditions for _, conditions in ranked]
        if ranked and ranked[0][0] > LEAST_GAIN * best_score:
            best_score, best = ranked[0]
    return best


def _region(x0: Array, conditions: Sequence[Condition]) -> Mask:
    """Return for each start whether all conditions hold: (starts, columns) -> booleans, (starts,)."""
    return np.asarray(np.all([np.ones(len(x0), dtype=bool), *(c.holds(x0) for c in conditions)], axis=0))


def _f_score(region: Mask, failing: Mask) -> float:
    hits = int((region & failing).sum())
    return 2 * hits / (int(region.sum()) + int(failing.sum()))


@dataclass(frozen=True, slots=True)
class _Values:
    """Values that occur frequently in one column of the initial states.

    A continuous state may also have frequent values. Examples are the 0 at which a timer starts, and a value
    that means "nothing there".

    Attributes:
        common: the frequent values; if the column is not continuous, all values.
        continuous: whether the column has many distinct values.
        span: difference between the largest and the smallest value of the column.
    """

    common: tuple[float, ...]
    continuous: bool
    span: float

    @classmethod
    def of(cls, column: Array) -> _Values:
        values, counts = np.unique(column, return_counts=True)
        continuous = len(values) > FEW_VALUES
        common = values[counts >= COMMON * len(column)] if continuous else values
        return cls(tuple(common.tolist()), continuous, float(np.ptp(column)))


def _candidates(x0: Array, region: Mask, failing: Mask, values: list[_Values]) -> list[Condition]:
    """Return conditions that may be added to the conditions found so far.

    `region`, (starts,), is True for the starts that satisfy the conditions so far. `values` describes each
    column of `x0`.
    """
    found: list[Condition] = []
    bad = x0[region & failing]
    for column, kinds in enumerate(values):
        found.extend(Condition(column, "=", value) for value in kinds.common)
        if kinds.continuous and len(bad):
            digits = max(2 - int(np.floor(np.log10(kinds.span))), 0)  # about a hundredth of the span
            cuts = np.quantile(bad[:, column], np.linspace(0, 1, 11)).round(digits).tolist()
            found.extend(Condition(column, ">=", cut) for cut in cuts[:-1] if cut not in kinds.common)
            found.extend(Condition(column, "<=", cut) for cut in cuts[1:] if cut not in kinds.common)
    return found


def _separation(values: Array, failing: Mask) -> float:
    """Return how well the values of one state separate failing from satisfied starts.

    This is the Kolmogorov-Smirnov distance of the two sets of values, between 0 and 1.
    """
    if failing.all() or not failing.any():
        return 0.0
    order = np.sort(values)
    bad = np.searchsorted(np.sort(values[failing]), order, side="right") / failing.sum()
    good = np.searchsorted(np.sort(values[~failing]), order, side="right") / (~failing).sum()
    return float(np.abs(bad - good).max())


# ----------------------------------------------------------------------- in words


def region_text(
    conditions: tuple[Condition, ...], names: tuple[str, ...], signature: Signature | None = None
) -> str:
    """Text of the conditions of a region, as in a specification: `sign = stop, -2.1 <= x <= -1 [m]`."""
    return ", ".join(
        _column_text([c for c in conditions if c.column == column], names[column], signature)
        for column in dict.fromkeys(condition.column for condition in conditions)
    )


def _column_text(conditions: list[Condition], name: str, signature: Signature | None) -> str:
    column = signature[name] if signature is not None and name in signature else None
    equal = [c.value for c in conditions if c.op == "="]
    if equal:
        labels = {value: label for label, value in column.labels} if column else {}
        if column and column.kind == "bool":
            labels = {0.0: "false", 1.0: "true"}
        return f"{name} = {labels.get(equal[-1], f'{equal[-1]:g}')}"
    unit = f" {column.unit.text}" if column and column.unit.text not in ("", "1") else ""
    low = max((c.value for c in conditions if c.op == ">="), default=None)
    high = min((c.value for c in conditions if c.op == "<="), default=None)
    if low is not None and high is not None:
        return f"{low:g} <= {name} <= {high:g}{unit}"
    return f"{name} >= {low:g}{unit}" if low is not None else f"{name} <= {high:g}{unit}"


# ---------------------------------------------------------------------- failures


def draw_failures(
    held: HeldOut, signature: Signature | None = None, units: Mapping[str, str] | None = None
) -> Picture | None:
    """Draw the robustness of the requirement that fails most, over two states.

    These are the states that best separate failing starts from satisfied ones. Returns None if nothing fails.

    Args:
        held: starts and robustness of their plans.
        signature: names, units and labels of the system's states.
        units: requirement -> unit of its robustness; it contains only requirements that have a unit.
    """
    weakness = held.weakness()
    if weakness is None:
        return None
    with picture_style():
        figure = new_figure(9, 3.4)
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
        _draw_starts(left, held, weakness, signature)
        _draw_margins(right, held, weakness, units or {})
    name = held.requirements[weakness.requirement]
    return Picture(figure, f"{name} {weakness.text(held, signature)}.")


def _draw_starts(axes: Axes, held: HeldOut, weakness: Weakness, signature: Signature | None) -> None:
    labels = tuple(condition for condition in weakness.conditions if condition.op == "=")
    shown = _region(held.x0, labels)
    failing = TOLERANCE.violated(held.each[:, weakness.requirement])
    name = held.requirements[weakness.requirement]
    where = region_text(labels, held.names, signature)
    axes.set_title(f"starts with {where}" if where else "all held-out starts")
    a, b = weakness.axes
    known = np.ones(len(held.x0), dtype=bool) if held.known is None else held.known
    kinds = [
        (shown & ~failing, BLUE, 5, "satisfied"),
        (shown & failing & ~known, MUTED, 7, "no plan is known"),
        (shown & failing & known, RED, 9, f"{name} fails"),
    ]
    kinds = [kind for kind in kinds if kind[0].any()]
    for mask, color, size, label in kinds:
        axes.scatter(
            held.x0[mask, a],
            held.x0[mask, b],
            s=size,
            color=color,
            alpha=0.28 if color == BLUE else 0.8,
            lw=0,
            label=picture(f"{label} ({int(mask.sum()):,})"),
            rasterized=True,
        )
    _draw_region(axes, weakness, held.x0[shown])
    for name, write in ((held.names[a], axes.set_xlabel), (held.names[b], axes.set_ylabel)):
        declared = signature is not None and name in signature
        write(labelled(name, signature[name].unit.text) if signature is not None and declared else name)
    axes.margins(0.02)
    legend = axes.legend(
        loc="upper left", bbox_to_anchor=(-0.02, -0.14), ncols=len(kinds), handletextpad=0.1, markerscale=1.6
    )
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)


def _draw_region(axes: Axes, weakness: Weakness, x0: NDArray[np.float64]) -> None:
    from matplotlib.patches import Rectangle

    if len(x0) == 0 or not any(c.column in weakness.axes and c.op != "=" for c in weakness.conditions):
        return
    low, high = x0.min(0), x0.max(0)
    for each in weakness.conditions:
        if each.op == ">=":
            low[each.column] = max(low[each.column], each.value)
        if each.op == "<=":
            high[each.column] = min(high[each.column], each.value)
    corner, size = low[[*weakness.axes]], (high - low)[[*weakness.axes]]
    axes.add_patch(Rectangle(tuple(corner), *size, fill=False, ec=INK, lw=1, ls=(0, (4, 2))))


def _draw_margins(axes: Axes, held: HeldOut, weakness: Weakness, units: Mapping[str, str]) -> None:
    from matplotlib.ticker import StrMethodFormatter

    name = held.requirements[weakness.requirement]
    rho = held.each[:, weakness.requirement]
    rho = rho[np.isfinite(rho)]
    low, high = np.quantile(rho, [0.002, 0.998])
    edges = np.sort(np.append(np.linspace(min(low, -1e-3), max(high, 1e-3), 46), -TOLERANCE))
    clipped, fails = np.clip(rho, edges[0], edges[-1]), TOLERANCE.violated(rho)
    axes.hist(clipped[~fails], bins=edges.tolist(), color=BLUE, alpha=0.85)
    axes.hist(clipped[fails], bins=edges.tolist(), color=RED, alpha=0.85)
    axes.axvline(0, color=INK, lw=0.8)
    axes.set_yscale("symlog", linthresh=10)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_title(picture(f"robustness of {name}"))
    axes.set_xlabel(labelled("robustness of the plan", units.get(name, "")))
    axes.set_ylabel("starts", color=MUTED)
    axes.grid(visible=False, axis="x")
