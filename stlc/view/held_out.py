"""Where in the initial set a policy fails, as one sentence: numbers only, nothing is drawn here.

The sentence is a conjunction of simple conditions that is grown greedily, one condition at a time, so that it
covers many failing starts and few others (subgroup discovery with the F-score as its measure).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics import TOLERANCE
from stlc.signature import Signature

MAX_CONDITIONS = 4
LEAST_GAIN = 1.04  # an added condition has to better the F-score by this factor
FEW_VALUES = 8  # columns with at most so many distinct values are compared by `=`

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The held-out starts of a run and how the policy's plans fared.

    Attributes:
        names: of the columns of `x0`.
        requirements: names, in the order of the columns of `each`.
        x0: (starts, columns).
        rho: (starts,) over all requirements.
        each: (starts, requirements).
    """

    names: tuple[str, ...]
    requirements: tuple[str, ...]
    x0: Array
    rho: Array
    each: Array

    @property
    def worst(self) -> int:
        """Index of the requirement that fails most often."""
        return int(np.argmax((self.each < -TOLERANCE).mean(axis=0)))


@dataclass(frozen=True, slots=True)
class Condition:
    """`column op value` on a start."""

    column: int
    op: Literal["<=", ">=", "="]
    value: float

    def holds(self, x0: Array) -> Mask:
        """Which starts (starts, columns) meet it."""
        compare = {"<=": np.less_equal, ">=": np.greater_equal, "=": np.equal}[self.op]
        meets: Mask = compare(x0[:, self.column], self.value)
        return meets


@dataclass(frozen=True, slots=True)
class Weakness:
    """Where one requirement fails.

    Attributes:
        requirement: index of the requirement.
        failing: share of all starts that fail it.
        conditions: whose conjunction is the region.
        inside: share of the region's starts that fail.
        covered: share of the failing starts that lie in the region.
        axes: the two columns that tell most about failing.
    """

    requirement: int
    failing: float
    conditions: tuple[Condition, ...]
    inside: float
    covered: float
    axes: tuple[int, int]


def load_held_out(path: Path) -> HeldOut | None:
    """The held-out set that training wrote to `path`; None where there is none or it is not one."""
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file["meta"]))
            x0, rho, each = (np.asarray(file[key], dtype=float) for key in ("x0", "rho", "requirements"))
    except (OSError, KeyError, ValueError, BadZipFile):
        return None
    names, requirements = tuple(meta.get("names", ())), tuple(meta.get("requirements", ()))
    shapes_fit = x0.ndim == 2 and each.shape == (len(x0), len(requirements)) and rho.shape == (len(x0),)
    if not shapes_fit or x0.shape[1] != len(names) or not len(x0) or not requirements:
        return None
    return HeldOut(names, requirements, x0, rho, each)


def find_weakness(held: HeldOut, requirement: int | None = None) -> Weakness | None:
    """Where in the initial set `requirement` (by default the worst) fails; None if it never does."""
    index = held.worst if requirement is None else requirement
    failing = held.each[:, index] < -TOLERANCE
    if not failing.any():
        return None
    conditions: list[Condition] = []
    region = np.ones(len(failing), dtype=bool)
    score = _f_score(region, failing)
    while len(conditions) < MAX_CONDITIONS:
        best = max(
            _candidates(held.x0, region, failing),
            key=lambda condition: _f_score(region & condition.holds(held.x0), failing),
            default=None,
        )
        if best is None or _f_score(region & best.holds(held.x0), failing) < LEAST_GAIN * score:
            break
        conditions.append(best)
        region &= best.holds(held.x0)
        score = _f_score(region, failing)
    return Weakness(
        requirement=index,
        failing=float(failing.mean()),
        conditions=tuple(conditions),
        inside=float(failing[region].mean()),
        covered=float(region[failing].mean()),
        axes=_telling(held.x0, failing, conditions),
    )


def _f_score(region: Mask, failing: Mask) -> float:
    hits = int((region & failing).sum())
    return 2 * hits / (int(region.sum()) + int(failing.sum()))


def _candidates(x0: Array, region: Mask, failing: Mask) -> list[Condition]:
    found: list[Condition] = []
    for column in range(x0.shape[1]):
        values = np.unique(x0[region, column])
        if len(values) <= 1:
            continue
        if len(values) <= FEW_VALUES:
            found.extend(Condition(column, "=", float(value)) for value in values)
            continue
        cuts = _rounded(
            np.quantile(x0[region & failing, column], np.linspace(0, 1, 11)), np.ptp(x0[:, column])
        )
        found.extend(Condition(column, ">=", cut) for cut in cuts[:-1])
        found.extend(Condition(column, "<=", cut) for cut in cuts[1:])
    return found


def _rounded(cuts: Array, span: float) -> list[float]:
    """Cuts to about a hundredth of the column's span."""
    digits = 2 - int(np.floor(np.log10(span)))
    return [round(float(cut), max(digits, 0)) for cut in cuts]


def _telling(x0: Array, failing: Mask, conditions: list[Condition]) -> tuple[int, int]:
    """The two columns for a picture: those of the region's inequalities first, then by separation."""
    used = [condition.column for condition in conditions if condition.op != "="]
    focus = np.ones(len(x0), dtype=bool)
    for condition in conditions:
        if condition.op == "=":
            focus &= condition.holds(x0)
    many = [c for c in range(x0.shape[1]) if len(np.unique(x0[focus, c])) > FEW_VALUES] or list(
        range(x0.shape[1])
    )
    ranked = sorted(many, key=lambda c: -_separation(x0[focus, c], failing[focus]))
    first, second, *_ = [*dict.fromkeys([*used, *ranked]), *range(x0.shape[1]), 0, 0]
    return first, second


def _separation(values: Array, failing: Mask) -> float:
    """The Kolmogorov-Smirnov distance between the failing and the satisfied starts along one column."""
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
    """The region in the notation of specifications: `sign = stop, -2.1 <= x <= -1 [m]`."""
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


def weakness_text(weakness: Weakness, held: HeldOut, signature: Signature | None = None) -> str:
    """One sentence: where the requirement fails, how often there, and how much of its failing that is."""
    if not weakness.conditions:
        return f"fails in {100 * weakness.failing:.1f} % of the starts, in no region of its own"
    region = region_text(weakness.conditions, held.names, signature)
    return (
        f"fails in {100 * weakness.inside:.0f} % of the starts with {region}"
        f" ({100 * weakness.covered:.0f} % of its failures)"
    )
