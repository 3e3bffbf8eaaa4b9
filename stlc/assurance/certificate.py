"""Statistical certificates: bounds on future drives from judged ones, with the assumptions in words.

A drive is one agent in one simulated world, one recorded trace, or one simulation of a plant or system. The
drives of a world may influence each other, so the observations that bounds count are independent *units*:
worlds, or drives if nothing couples them. The observed value of a unit is the share of its drives that
satisfy a requirement.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.bounds import (
    Bounds,
    Tally,
    betting_lower,
    betting_upper,
    clopper_pearson,
    clopper_pearson_lower,
    clopper_pearson_upper,
    drives_needed,
)
from stlc.assurance.conformal import (
    OnlineBound,
    calibrate_online,
    drives_for_bound,
    lower_bound,
    tolerance_bound,
)
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.semantics.kinds.exact import Exact
from stlc.compile.semantics.tolerance import TOLERANCE, Status
from stlc.jsontext import Count, Num
from stlc.monitor.judgement import RequirementVerdict, Verdict

FORMAT: Literal["stlc-certificate/1"] = "stlc-certificate/1"
ALL = "all requirements"
Noun: TypeAlias = Literal["world", "drive", "trace", "simulation"]
Answer: TypeAlias = Literal["certified", "refuted", "undecided", "measured"]
_AGREE = 1e-9
"""Largest difference of a recomputed bound that counts as rounding."""
MOST_UNITS, MOST_VALUES = 10_000_000, 10_000
"""Largest number of units, and of distinct values, in a certificate that is verified."""


# ---------------------------------------------------------------------- what was observed


@dataclass(frozen=True, slots=True)
class Judged:
    """Verdicts on drives under one requirement, or under all of them.

    Attributes:
        name: name of the requirement.
        unit: unit of the robustness; "" if there is none.
        satisfied: whether the drive certainly satisfies it, (drives,).
        violated: whether the drive certainly violates it, (drives,).
        robustness: least robustness over all continuations of the drive, (drives,); -inf if unknown.
    """

    name: str
    unit: str
    satisfied: NDArray[np.bool_]
    violated: NDArray[np.bool_]
    robustness: NDArray[np.float64]

    @classmethod
    def by(cls, verdict: RequirementVerdict) -> Judged:
        """Verdicts on the traces of a recording."""
        statuses, least = np.array(verdict.statuses), verdict.low.min(axis=0)
        robustness = np.nan_to_num(least, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
        return cls(verdict.name, verdict.unit, statuses == "satisfied", statuses == "violated", robustness)

    def of(self, kept: NDArray[np.bool_]) -> Judged:
        """Verdicts on the drives that are kept, (drives,)."""
        return Judged(self.name, self.unit, self.satisfied[kept], self.violated[kept], self.robustness[kept])


@dataclass(frozen=True, slots=True)
class Sample:
    """Judged drives and the independent units that they belong to.

    Attributes:
        overall: verdicts under all requirements together.
        requirements: verdicts under each requirement.
        units: unit of each drive, (drives,): numbers from 0 without gaps.
        noun: what a unit is.
        predicted: robustness of the plan followed at each step, (drives, steps); None if not recorded.
        left_out: number of further drives, in which an assumption of the specification does not hold.
    """

    overall: Judged
    requirements: tuple[Judged, ...]
    units: NDArray[np.int64]
    noun: Noun
    predicted: NDArray[np.float64] | None = None
    left_out: int = 0

    @property
    def drives(self) -> int:
        """Number of drives."""
        return len(self.units)

    @property
    def count(self) -> int:
        """Number of units."""
        return int(self.units.max(initial=-1)) + 1

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Number of drives of each unit, (units,)."""
        return np.bincount(self.units, minlength=self.count)

    def in_scope(self, kept: NDArray[np.bool_]) -> Sample:
        """The drives that are kept, (drives,), as those in which the assumptions of a specification hold."""
        if kept.all():
            return self
        _, units = np.unique(self.units[kept], return_inverse=True)
        return Sample(
            self.overall.of(kept),
            tuple(each.of(kept) for each in self.requirements),
            units.astype(np.int64),
            self.noun,
            None if self.predicted is None else self.predicted[kept],
            self.left_out + int((~kept).sum()),
        )

    def shares(self, marked: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share of the marked drives of each unit, (units,)."""
        return np.bincount(self.units, weights=marked, minlength=self.count) / self.sizes

    def least(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Least value over the drives of each unit, (units,)."""
        found = np.full(self.count, np.inf)
        np.minimum.at(found, self.units, values)
        return found

    def assess(self, claim: Claim) -> Assessment:
        """Compute the bounds on future drives from at least one drive."""
        sizes = self.sizes
        return Assessment(
            claim,
            statement(self.overall, self, claim),
            tuple(statement(each, self, claim) for each in self.requirements),
            self.noun,
            (int(sizes.min()), int(sizes.max())),
            _online(self, claim) if claim.online else None,
            min(self.count, claim.calibration or self.count),
            self.left_out,
        )


def sample_of_traces(verdict: Verdict) -> Sample | None:
    """Sample of the traces to which a specification applies; None if there are none.

    Traces of one deployment that were recorded with the same seed belong to one world; else each trace is
    independent of the others.
    """
    seeds, units = verdict.about.seeds, np.arange(verdict.traces)
    noun: Noun = "trace"
    if seeds is not None and seeds.shape == (verdict.traces,):
        found, units = np.unique(seeds, return_inverse=True)
        noun = "world" if len(found) < len(units) else "trace"
    judged = tuple(map(Judged.by, verdict))
    whole = Sample(together(judged, verdict.factors), judged, units.astype(np.int64), noun)
    return whole.in_scope(verdict.scope) if verdict.in_scope else None


def joined(samples: Sequence[Sample]) -> Sample:
    """Join samples of the same requirements, in order; their units stay apart.

    Raises:
        ValueError: the samples are about different requirements.
    """
    names = {tuple(each.name for each in sample.requirements) for sample in samples}
    if len(names) != 1:
        raise ValueError("the samples are about different requirements")
    offsets = np.cumsum([0, *(sample.count for sample in samples)])
    units = [sample.units + offset for sample, offset in zip(samples, offsets, strict=False)]
    predicted = [sample.predicted for sample in samples if sample.predicted is not None]
    same = len(predicted) == len(samples) and len({each.shape[1] for each in predicted}) == 1
    return Sample(
        _joined([sample.overall for sample in samples]),
        tuple(_joined(each) for each in zip(*(sample.requirements for sample in samples), strict=True)),
        np.concatenate(units),
        max((sample.noun for sample in samples), key=lambda noun: noun == "world"),
        np.concatenate(predicted) if same else None,
        sum(sample.left_out for sample in samples),
    )


def _joined(parts: Sequence[Judged]) -> Judged:
    return Judged(
        parts[0].name,
        parts[0].unit,
        np.concatenate([part.satisfied for part in parts]),
        np.concatenate([part.violated for part in parts]),
        np.concatenate([part.robustness for part in parts]),
    )


def together(judged: Sequence[Judged], weights: Mapping[str, float] | None = None) -> Judged:
    """Verdicts under all requirements together: the least weighted robustness, without a unit.

    `weights`: requirement -> factor of its robustness, weight / scale; 1 for requirements left out.
    """
    factors = weights or {}
    if len(judged) == 1:
        return replace(judged[0], name=ALL)
    with np.errstate(invalid="ignore"):
        known = (factors.get(each.name, 1.0) for each in judged)
        least = TOLERANCE.overall([each.robustness for each in judged], known, NUMPY, Exact())
    return Judged(
        ALL,
        "",
        np.logical_and.reduce([each.satisfied for each in judged]),
        np.logical_or.reduce([each.violated for each in judged]),
        np.nan_to_num(least, nan=-np.inf, posinf=np.inf, neginf=-np.inf),
    )


# ---------------------------------------------------------------------- what is claimed


@dataclass(frozen=True, slots=True)
class Claim:
    """Request: the share of drives to certify, and the bounds to compute.

    Attributes:
        share: share of future drives to certify; None if the share is only measured.
        confidence: confidence of each bound.
        shift: total variation between the distributions of future drives and of the observed ones.
        any_time: whether the drives were stopped by their results; only betting bounds are then valid.
        calibration: number of first units that calibrate the conformal bounds, fixed in advance; None: all.
        online: whether the bound while driving is calibrated.
        further: conditions in words under which the bounds hold, beside those that are always stated.
    """

    share: float | None = 0.99
    confidence: float = 0.95
    shift: float = 0.0
    any_time: bool = False
    calibration: int | None = None
    online: bool = False
    further: tuple[str, ...] = ()

    @property
    def target(self) -> float:
        """Share whose robustness is bounded: the share to certify, else the confidence."""
        return self.confidence if self.share is None else self.share


@dataclass(frozen=True, slots=True)
class Shares:
    """Bounds on the mean of observed values of units in [0, 1].

    Attributes:
        lower: one-sided lower bound.
        upper: one-sided upper bound.
        interval: two-sided interval.
        exact: whether these are Clopper-Pearson bounds; else betting bounds.
        any_time: one-sided lower betting bound, valid at any stopping time.
        fixed: one-sided lower Clopper-Pearson bound, valid for a number of units fixed in advance; None if a
            unit's value is neither 0 nor 1.
    """

    lower: float
    upper: float
    interval: Bounds
    exact: bool
    any_time: float
    fixed: float | None


def shares_of(low: Tally, high: Tally, confidence: float, *, any_time: bool) -> Shares:
    """Bounds on the mean of units of which a part is undecided.

    Clopper-Pearson bounds are used if they are valid: if the number of units was fixed in advance and each
    value is 0 or 1. Otherwise betting bounds are used.

    Args:
        low: the values if nothing undecided is satisfied; they bound the mean from below.
        high: the values if everything undecided is satisfied; they bound the mean from above.
        confidence: confidence of each bound.
        any_time: whether the units were stopped by their results.
    """
    sided = 0.5 + confidence / 2
    counts = (_counted(low), _counted(high))
    bet = betting_lower(low, confidence)
    if counts[0] is None or counts[1] is None:
        fixed = None
    else:
        fixed = clopper_pearson_lower(*counts[0], confidence)
        if not any_time:
            least, most = (clopper_pearson(*each, confidence) for each in (counts[0], counts[1]))
            upper = clopper_pearson_upper(*counts[1], confidence)
            return Shares(fixed, upper, Bounds(least.low, most.high), exact=True, any_time=bet, fixed=fixed)
    upper = betting_upper(high, confidence)
    ends = Bounds(betting_lower(low, sided), betting_upper(high, sided))
    return Shares(bet, upper, ends, exact=False, any_time=bet, fixed=fixed)


def _counted(tally: Tally) -> tuple[int, int] | None:
    """Successes and trials; None if a value is neither 0 nor 1."""
    if not set(tally.values.tolist()) <= {0.0, 1.0}:
        return None
    return int(tally.values @ tally.counts), int(tally.counts.sum())


@dataclass(frozen=True, slots=True)
class Statement:
    """Bounds on one requirement, from a sample of drives.

    Attributes:
        name: name of the requirement.
        unit: unit of the robustness.
        drives: number of drives.
        satisfied: number of drives that satisfy the requirement.
        undecided: number of drives without verdict; they count as not satisfied in lower bounds.
        shares: bounds on the share of drives that satisfy it.
        deployed: lower bound on that share among future drives, after the shift.
        most: upper bound on that share among future drives, if they shift as far as allowed.
        whole: number of units in which every drive satisfies it.
        whole_lower: lower bound on the share of such units.
        next_robustness: conformal lower bound on the robustness of the next unit's worst drive.
        reached: robustness that at least the requested share of units reaches, with confidence.
        low: observed values of the units.
        high: the same if everything undecided were satisfied.
    """

    JSON: ClassVar = (
        "name drives satisfied undecided units share lower=shares.lower upper=shares.upper interval method "
        "lower_any_time=shares.any_time lower_fixed=shares.fixed lower_deployed=deployed upper_deployed=most "
        "whole_units=whole whole_units_lower=whole_lower next_robustness reached_robustness=reached "
        "robustness_unit=unit observed observed_high"
    )

    name: str
    unit: str
    drives: Count
    satisfied: Count
    undecided: Count
    shares: Shares
    deployed: float
    most: float
    whole: Count
    whole_lower: float
    next_robustness: Num
    reached: Num
    low: Tally
    high: Tally

    @property
    def share(self) -> float:
        """Observed mean share: that of satisfying drives, if all units have equally many."""
        return float(self.low.values @ self.low.counts / self.low.counts.sum())

    @property
    def units(self) -> Count:
        """Number of units."""
        return int(self.low.counts.sum())

    def answer(self, claim: Claim) -> Answer:
        """Answer to the claim: certified or refuted, each with the confidence of the claim."""
        if claim.share is None:
            return "measured"
        if self.deployed >= claim.share:
            return "certified"
        return "refuted" if self.most < claim.share else "undecided"

    @property
    def interval(self) -> tuple[float, float]:
        """Two-sided interval of the share."""
        return self.shares.interval.low, self.shares.interval.high

    @property
    def method(self) -> Literal["Clopper-Pearson", "betting"]:
        """Name of the bounds."""
        return "Clopper-Pearson" if self.shares.exact else "betting"

    @property
    def observed(self) -> list[list[float]]:
        """Observed values of the units, and how often."""
        return self.low.pairs

    @property
    def observed_high(self) -> list[list[float]]:
        """The same if everything undecided were satisfied."""
        return self.high.pairs


def statement(judged: Judged, sample: Sample, claim: Claim) -> Statement:
    """Compute all bounds on one requirement from a sample of at least one drive."""
    values = sample.shares(judged.satisfied)
    low, high = Tally.of(values), Tally.of(sample.shares(~judged.violated))
    found = shares_of(low, high, claim.confidence, any_time=claim.any_time)
    whole = Tally.of(values == 1.0)
    least = sample.least(judged.robustness)
    reached, share = -math.inf, claim.target + claim.shift
    if share < 1.0:
        reached = tolerance_bound(least, share, claim.confidence, any_time=claim.any_time)
    return Statement(
        name=judged.name,
        unit=judged.unit,
        drives=sample.drives,
        satisfied=int(judged.satisfied.sum()),
        undecided=int((~judged.satisfied & ~judged.violated).sum()),
        shares=found,
        deployed=max(0.0, found.lower - claim.shift),
        most=max(0.0, found.upper - claim.shift),
        whole=int((values == 1.0).sum()),
        whole_lower=shares_of(whole, whole, claim.confidence, any_time=claim.any_time).lower,
        next_robustness=lower_bound(least[: claim.calibration], claim.confidence, claim.shift),
        reached=reached,
        low=low,
        high=high,
    )


# ---------------------------------------------------------------------- the whole answer


@dataclass(frozen=True, slots=True)
class NeededUnits:
    """Numbers of units without a failure that certify the share, and that bound the next robustness."""

    units: Count
    robustness: int | None


@dataclass(frozen=True, slots=True)
class Assessment:
    """Bounds on future drives: a statement on each requirement, and the answer to the claim.

    Attributes:
        claim: the request.
        overall: statement on all requirements together.
        requirements: statement on each requirement.
        noun: what an independent unit is.
        sizes: smallest and greatest number of drives in a unit.
        online: bound while driving, on the plans' robustness; None if it was not asked for or not recorded.
        calibration: number of units that calibrated the conformal bounds.
        left_out: number of further drives, in which an assumption of the specification does not hold.
    """

    JSON: ClassVar = (
        "answer share=claim.share confidence=claim.confidence shift sequential=claim.any_time unit=noun "
        "calibration left_out needed overall requirements online assumptions"
    )

    claim: Claim
    overall: Statement
    requirements: tuple[Statement, ...]
    noun: Noun
    sizes: tuple[int, int]
    online: OnlineBound | None
    calibration: Count
    left_out: Count = 0

    @property
    def answer(self) -> Answer:
        """Answer to the claim, for all requirements together."""
        return self.overall.answer(self.claim)

    @property
    def width(self) -> float:
        """Width of the two-sided interval of the share of drives that satisfy everything."""
        return self.overall.shares.interval.width

    @property
    def exit_code(self) -> int:
        """0 if the share is certified or only measured, 1 if it is refuted, 4 if it is undecided."""
        return {"certified": 0, "measured": 0, "refuted": 1, "undecided": 4}[self.answer]

    @property
    def assumptions(self) -> list[str]:
        """Conditions under which the bounds hold, a sentence each; the most specific comes first."""
        return list(_assumptions(self))

    @property
    def shift(self) -> str | None:
        """Shift of future drives in words; None if there is none."""
        return f"tv={self.claim.shift}" if self.claim.shift else None

    @property
    def needed(self) -> NeededUnits:
        """Numbers of units without a failure that certify the share, and that bound the next robustness."""
        claim = self.claim
        units = drives_needed(claim.target, claim.confidence, any_time=claim.any_time)
        return NeededUnits(units, drives_for_bound(claim.confidence, claim.shift))


@dataclass(frozen=True)
class BoundedVerdict(Verdict):
    """Verdict on several traces, with bounds on the share of satisfied ones."""

    JSON: ClassVar = f"{Verdict.JSON} assurance?"

    assurance: Assessment | None = None

    @classmethod
    def of(cls, verdict: Verdict, assurance: Assessment) -> BoundedVerdict:
        """Add bounds to a verdict that was told."""
        given = {each.name: getattr(verdict, each.name) for each in fields(verdict)}
        return cls(**given, assurance=assurance).knowing(**vars(verdict))  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class Unjudged:
    """A file without a verdict."""

    trace: str
    verdict: Literal["invalid", "not judged"]


@dataclass(frozen=True, slots=True)
class JudgedFiles:
    """Verdicts on several files, with the verdict over all of them, and bounds if they were asked for."""

    JSON: ClassVar = "verdict files assurance?"

    verdict: Status
    files: tuple[Verdict | Unjudged, ...]
    assurance: Assessment | None = None


def _online(sample: Sample, claim: Claim) -> OnlineBound | None:
    sizes = sample.sizes
    if sample.predicted is None or len(set(sizes.tolist())) != 1:
        return None
    first = slice(None, claim.calibration)
    steps = sample.predicted.shape[1]
    predicted = sample.predicted.reshape(sample.count, -1, steps)[first]
    final = sample.overall.robustness.reshape(sample.count, -1)[first]
    return calibrate_online(predicted, final, claim.confidence, claim.shift)


_SAME: Mapping[Noun, str] = {
    "world": "future drives come from the same world, scenario, starts and length as these",
    "drive": "future drives come from the same world, scenario, starts and length as these",
    "trace": "future drives come from the same source and conditions as these",
    "simulation": "future simulations are drawn as these: each value independent, as the file declares it",
}
"""Condition that there is no shift."""


def _assumptions(found: Assessment) -> Iterator[str]:
    claim, noun = found.claim, found.noun
    plural = "simulations" if noun == "simulation" else "drives"
    yield from _units(noun, found.sizes[1])
    if claim.shift:
        distance = f"total variation {claim.shift:g}"
        yield f"the distribution of future {plural} is within {distance} of that of these"
    else:
        yield _SAME[noun]
    if claim.any_time:
        yield f"the {plural} were stopped by their results; bounds on shares hold at any stopping time"
        yield (
            f"bounds on the next robustness use the first {found.calibration} {noun}s, a number fixed before"
        )
    else:
        yield f"the number of {noun}s was fixed before their results were known"
    percent = f"{100 * claim.confidence:g} %"
    yield f"each bound holds by itself with {percent} confidence, not all of them together"
    yield f"a bound on the next robustness holds on average over such samples, not given these {plural}"
    if found.overall.undecided:
        yield f"{found.overall.undecided} {plural} without a verdict count as not satisfied in lower bounds"
    if found.left_out:
        yield f"{found.left_out} {plural} that violate an assumption of the specification are left out"
    yield from claim.further
    if noun in ("world", "drive"):
        yield "nothing is said about what the simulated world leaves out"


def _units(noun: Noun, most: int) -> Iterator[str]:
    match noun:
        case "trace":
            yield "the traces are independent of each other, and none was chosen or left out by its result"
            return
        case "simulation":
            yield "each simulation has its own seed, and is one observation"
            yield "simulations of different seeds are independent, as the numbers of a generator are"
            return
        case "drive":
            yield "the agents of a world do not influence each other, so each drive is one observation"
        case "world" if most == 1:
            yield "each world has its own seed, and is one observation"
        case "world":
            yield f"the {most} agents of a world may influence each other, so a world is one observation"
            yield "the robustness of a world is that of its worst drive"
    yield "worlds of different seeds are independent, as the numbers of a pseudo-random generator are"


# ---------------------------------------------------------------------- certificate files


@dataclass(frozen=True, slots=True)
class StoredStatement:
    """Bounds on one requirement in a certificate, as far as they are compared."""

    name: str
    drives: Count
    units: Count
    satisfied: Count
    undecided: Count
    whole_units: Count
    share: Num
    lower: Num
    upper: Num
    interval: tuple[Num, Num]
    lower_any_time: Num
    lower_deployed: Num
    upper_deployed: Num
    whole_units_lower: Num
    observed: list[tuple[float, Count]]
    observed_high: list[tuple[float, Count]]
    lower_fixed: Num | None = None


def wrong_numbers(
    overall: StoredStatement, requirements: Sequence[StoredStatement], claim: Claim, answer: str
) -> list[str]:
    """Bounds in a certificate that do not follow from its counts, such as `overall.lower`.

    Raises:
        ValueError: its numbers are no counts of drives.
    """
    wrong = []
    for place, each in [("overall", overall), *((each.name, each) for each in requirements)]:
        expected = _expected(_tally(each.observed), _tally(each.observed_high), overall.drives, claim)
        wrong += [
            f"{place}.{name}" for name, value in expected.items() if not _agree(getattr(each, name), value)
        ]
    expected_answer = "measured"
    if claim.share is not None:
        certified, refuted = overall.lower_deployed >= claim.share, overall.upper_deployed < claim.share
        expected_answer = "certified" if certified else "refuted" if refuted else "undecided"
    return wrong if answer == expected_answer else [*wrong, "answer"]


def _expected(low: Tally, high: Tally, drives: int, claim: Claim) -> dict[str, float | Bounds | None]:
    """Entries of a statement that follow from the observations of `drives` drives, by their names."""
    found = shares_of(low, high, claim.confidence, any_time=claim.any_time)
    units, whole = int(low.counts.sum()), int(low.counts[low.values == 1.0].sum())
    tally = Tally.counted(whole, units)
    least, most = (float(each.values @ each.counts / each.counts.sum()) for each in (low, high))
    expected: dict[str, float | Bounds | None] = {
        "drives": drives,
        "units": units,
        "share": least,
        "lower": found.lower,
        "upper": found.upper,
        "interval": found.interval,
        "lower_any_time": found.any_time,
        "lower_fixed": found.fixed,
        "lower_deployed": max(0.0, found.lower - claim.shift),
        "upper_deployed": max(0.0, found.upper - claim.shift),
        "whole_units": whole,
        "whole_units_lower": shares_of(tally, tally, claim.confidence, any_time=claim.any_time).lower,
    }
    if drives % units == 0:  # each unit has equally many drives
        expected |= {"satisfied": least * drives, "undecided": (most - least) * drives}
    return expected


def _agree(given: Any, expected: float | Bounds | None) -> bool:
    """True if an entry of a certificate is the expected number, or interval, but for rounding."""
    if expected is None or given is None:
        return expected is given
    if isinstance(expected, Bounds):
        low, high = given
        return _agree(low, expected.low) and _agree(high, expected.high)
    return abs(float(given) - expected) <= _AGREE * max(1.0, abs(expected))


def _tally(pairs: Sequence[tuple[float, int]]) -> Tally:
    values, counts = zip(*pairs, strict=True)
    if len(counts) > MOST_VALUES or not 0 < sum(counts) <= MOST_UNITS:
        raise ValueError("these are no counts of drives")
    given = np.array([float(value) for value in values])
    if not bool(((given >= 0.0) & (given <= 1.0)).all()):
        raise ValueError("an observation is outside of [0, 1]")
    return Tally(given, np.array(counts, dtype=np.int64))
