"""Phases: short plans that reach a target while all safety requirements hold.

A phase is found by its switches: plans that keep one level of the controls after another. From the best of
them, Gauss-Newton steps meet the target at each of several samples, and safety where it is missed most up to
there; the earliest that succeeds is taken. If all fail, the local search of the native kernel follows. The
kernel computes the robustness of `safe until[0, L] (target and safe for a while)`. It serves all targets of a
task. Further states, constant along a phase, select the target and the samples at which it counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, islice, product
from typing import TYPE_CHECKING

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.c.emit import LANES, emit
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.simplify import simplify
from stlc.controller.problem.kernel import Kernel, SearchOptions, Sizes
from stlc.controller.problem.native import motion_of
from stlc.native import load

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from stlc.dynamics.system import System

    Numbers = NDArray[np.float64]

TARGET, FIRST, LAST = "#target", "#first", "#last"
OPEN, WEIGHT = "#open{}", "#weight{}"
WEIGHTS = 4
"""Number of groups of predicates whose shortfalls are weighed differently in different plans."""
GENERATIONS = 8
"""Generations of a local search in a round of the search for a phase."""
IMPROVED = 5
"""Number of plans that it improves."""
STEERED = 5
"""Number of plans that Gauss-Newton steps improve."""
NEWTON = 6
"""Largest number of these steps."""
SAMPLES = 12
"""Largest number of samples at which each of them tries to meet the target."""
BLOCKS = 24
"""Largest number of parts of a phase in each of which a step changes a control by one amount."""
PASSES = 4
"""Number of times that each step is computed, to keep within bounds and what has been met."""
SHARES = 1.0, 0.5
"""Parts of a step that are tried."""
PROBE = 1e-5
"""Difference of a control for derivatives, as a share of its range."""
DAMPING = 1e-6
"""Damping of the least-squares problem, relative to the mean of its diagonal."""
SWITCHES = 20
"""Largest number of samples at which a plan may switch to another level."""
SHORT = 3
"""Number of samples of a phase that is not made shorter."""
GROWTH = 1.5
"""Exponent by which the parts of a phase in which its plan may change grow with the time."""
KEPT = 3
"""Number of plans that are kept from a round to the next, and of those remembered for each target."""
MOST_HELD = 81
"""Largest number of constant plans that the search for a phase may switch to."""
ROUNDS = 2, 4
"""Least and greatest number of rounds of the search for a phase: all plans with one more switch, Gauss-Newton
steps, and a local search."""
TAIL = 6
"""The part of a phase's length for which it stays safe after the target: one of so many."""
SPREAD = 1.5
"""Standard deviation of the logarithm of the weights of shortfalls."""
LEAST_MARGIN = 1e-6
"""Robustness margin that a strict predicate must have."""
UNSURE = 1e-3
"""Shortfall of a target that is reached in a state in which safety is not known to last."""
TINY = 1e-9
OPTIONS = 4
"""Largest number of alternatives of a target for which Gauss-Newton steps are made."""
SHORTER = 0.7, 0.85
"""Shares of its length in which a phase that was found is tried again, until it fails in each."""


@dataclass(frozen=True, slots=True)
class PhaseRequest:
    """A request for a phase.

    Attributes:
        target: index of the target.
        first: first sample at which the target counts.
        last: last sample at which the target counts.
        open: indices of the `until`s whose left side must hold.
        after: number of samples after the target that belong to the phase.
    """

    target: int
    first: int
    last: int
    open: frozenset[int] = frozenset()
    after: int = 0


@dataclass(frozen=True, slots=True)
class Phase:
    """A phase.

    Attributes:
        plan: controls, (L, m).
        states: states of the system along them, (L + 1, n).
        sample: sample at which the target is reached or, if it is not, at which it is nearest.
        margin: robustness of the target there, with the safety up to there; negative if it is not reached.
    """

    plan: Numbers
    states: Numbers
    sample: int
    margin: float


class Phases:
    """Search for phases of one task, in compiled code.

    Args:
        kernel: the compiled code.
        task: specification and system.
        steps: number of steps of a phase, L.
        untils: number of `until`s of which a request names the open ones.
        targets: the targets.
        clauses: disjunctions of predicates that hold at every sample of a phase.
    """

    def __init__(
        self,
        kernel: Kernel,
        system: System,
        steps: int,
        untils: int,
        targets: Sequence[ir.Formula],
        clauses: Sequence[Sequence[ir.Predicate]],
    ) -> None:
        self._kernel, self.steps, self._untils = kernel, steps, untils
        self._names = system.names
        low, high = (end.double().numpy() for end in (system.control_low, system.control_high))
        turns = np.array([float(control.squash == "angle") for control in system.decl.controls])
        self._bounds = np.stack((low, high, turns))
        self._middle = 0.5 * (low + high)
        held = levels(low, self._middle, high, most=MOST_HELD)
        self._constant = np.repeat(held[:, None], steps, 1)
        self._switches = _begins(steps, SWITCHES)
        self._known = [deque["Numbers"](maxlen=KEPT) for _ in targets]
        names = frozenset(system.names)
        self._clauses = clauses
        self._demands = [[each for each in _demands(target, names) if each] for target in targets]
        number = np.searchsorted(_begins(steps, BLOCKS), np.arange(steps), side="right")
        blocks = number == np.unique(number)[:, None]
        self._moves = (blocks[:, None, :, None] * np.eye(len(low))[:, None]).reshape(-1, steps, len(low))
        self.tried = 0

    @classmethod
    def of(
        cls,
        system: System,
        safe: ir.Formula,
        targets: Sequence[ir.Formula],
        untils: Sequence[ir.Formula],
        steps: int,
        scale: Callable[[ir.Formula], float],
        clauses: Sequence[Sequence[ir.Predicate]],
    ) -> Phases | None:
        """Build the search; None without a compiler or a C form of the formulas.

        Args:
            system: system of the task.
            safe: formula that holds at every sample of a phase.
            targets: formulas, of which a request selects one; their lookahead is less than `steps` samples.
            untils: formulas that hold at every sample of a phase while they are open.
            steps: number of steps of a phase.
            scale: function that returns the typical size of the margin of a predicate.
            clauses: what of `safe` is a disjunction of predicates on the states.
        """
        motion = motion_of(system)
        weights = (WEIGHT.format(i) for i in range(WEIGHTS))
        added = (TARGET, FIRST, LAST, *weights, *(OPEN.format(i) for i in range(len(untils))))
        motion = replace(motion, states=(*motion.states, *added), steps=steps)
        kept = (_equal(ir.Signal(OPEN.format(i)), 0.0) | each for i, each in enumerate(untils))
        shortfall = _Shortfall(scale)
        held = _decisive(ir.BoolOp.joined("and", (safe, *kept)))
        chosen = (
            _equal(ir.Signal(TARGET), float(i)) & shortfall.of(target) for i, target in enumerate(targets)
        )
        now = ir.Signal(ir.ELAPSED)
        times = _at_least(now, ir.Signal(FIRST)), _at_least(ir.Signal(LAST), now)
        tail = (
            ir.Temporal("always", ir.Window(1, 1), held),
            ir.Temporal("always", ir.Window(1, max(1, steps // TAIL)), held)
            | ir.Predicate(ir.Const(-UNSURE)),
        )
        reached = ir.BoolOp("and", (*times, ir.BoolOp.joined("or", chosen), *tail))
        formula = simplify(ir.Until("until", ir.Window(0, steps), held, reached))
        try:
            library = load(emit(motion, [formula], "truncate"))
        except Untranslatable:
            return None
        if library is None:
            return None
        sizes = Sizes(len(motion.states), len(motion.controls), steps, 1)
        return cls(Kernel(library, sizes), system, steps, len(untils), targets, clauses)

    def reach(self, state: Numbers, request: PhaseRequest, random: Generator, effort: int = 1) -> Phase:
        """Search for a phase from `state`, (n,), and make it shorter if it is found.

        `effort` is a factor of the generations of local searches.
        """
        row, middle = self._row(state, request), np.broadcast_to(self._middle, self._constant[0].shape)
        # Initial plans: the middle of the ranges, what reached the target before, the best for other targets.
        own = self._known[request.target]
        plans, first = np.stack((middle, *own, *chain(*self._known))), 1 + len(own)
        rho = self._judged(np.repeat(row, len(plans), 0), plans)
        kept = [*range(first), *(first + (-rho[first:]).argsort(kind="stable")[:KEPT])]
        plans, rho = plans[kept], rho[kept]
        for _ in range(min(ROUNDS[0] + effort - 1, ROUNDS[1])):
            if rho.max() < 0.0:
                plans, rho = self._improved(row, request, plans, random, effort)
            found = (
                max((self._phase(row, plan) for plan in plans), key=lambda phase: phase.margin)
                if rho.max() < 0
                else self._phase(row, plans[int(rho.argmax())])
            )
            if found.margin >= -UNSURE:
                break
            plans = plans[(-rho).argsort(kind="stable")[:KEPT]]
        if found.margin < -UNSURE:
            plans, rho = self._steered(row, request, middle[None], NEWTON)
            found = max(found, self._phase(row, plans[0]), key=lambda phase: phase.margin)
        shares = deque(SHORTER)
        while shares and found.margin >= 0.0 and found.sample > request.first + SHORT:
            shorter = replace(request, last=max(request.first, int(shares[0] * found.sample)))
            row = self._row(state, shorter)
            plans, rho = self._twice(row, shorter, np.stack((found.plan, middle)), random)
            if rho.max() < 0.0:
                plans, rho = self._steered(row, shorter, plans[(-rho).argsort(kind="stable")[:STEERED]], 2)
            if rho.max() < 0.0:
                shares.popleft()
            else:
                found = self._phase(row, plans[int(rho.argmax())])
        if found.margin >= -UNSURE:
            row, plan = self._row(state, replace(request, last=found.sample)), found.plan
            for control, level in enumerate(self._middle):  # a control that is not needed is held there
                calmer = np.where(np.arange(len(self._middle)) == control, level, plan)
                if self._judged(row, calmer[None])[0] >= found.margin:
                    plan = calmer
            found = found if plan is found.plan else self._phase(row, plan)
            self._known[request.target].append(found.plan)
        return found

    def _improved(
        self, row: Numbers, request: PhaseRequest, plans: Numbers, random: Generator, effort: int
    ) -> tuple[Numbers, Numbers]:
        """Improve plans, (k, L, m), and return those that result, with their robustness."""
        best, rho = self._twice(row, request, plans, random)
        if rho.max() >= 0.0:
            return best, rho
        kept = (-rho).argsort(kind="stable")[:IMPROVED]
        steered, found = self._steered(row, request, best[kept[:STEERED]], NEWTON)
        if found.max() >= 0.0:
            return steered, found
        best[kept[:STEERED]] = steered
        rows = np.repeat(row, len(kept), 0)
        own = len(self._names) + 3
        rows[1:, own : own + WEIGHTS] = np.exp(SPREAD * random.standard_normal((len(kept) - 1, WEIGHTS)))
        options = SearchOptions(
            self._bounds, np.ones(1), self._constant, effort * GENERATIONS, 0.0, int(random.integers(2**62))
        )
        self.tried += len(kept) * effort * GENERATIONS * LANES
        best, rho = self._kernel.local_search(rows, best[kept], options)
        return best, np.nan_to_num(rho, nan=-np.inf)

    def _twice(
        self, row: Numbers, request: PhaseRequest, plans: Numbers, random: Generator
    ) -> tuple[Numbers, Numbers]:
        """Return plans with one or two more switches than `plans`, (k, L, m), or the first on target."""
        best, rho = self._switched(row, request, plans, random)
        if rho.max() >= 0.0:
            return best, rho
        again, found = self._switched(row, request, best[(-rho).argsort(kind="stable")[:KEPT]], random)
        if found.max() >= 0.0:
            return again, found
        return np.concatenate((best, again)), np.concatenate((rho, found))

    def _switched(
        self, row: Numbers, request: PhaseRequest, plans: Numbers, random: Generator
    ) -> tuple[Numbers, Numbers]:
        """Return plans that follow one of `plans`, (k, L, m), up to some sample and keep a level from there.

        Those are the best for each level or, if some reach the target, one of those that do so first.
        """
        steps, levels = self.steps, len(self._constant)
        before = np.arange(steps) < self._switches[:, None]
        switched = np.where(before[None, None, :, :, None], plans[:, None, None], self._constant[:, None])
        whole = switched.swapaxes(0, 1).reshape(levels, -1, *plans.shape[1:])
        rows, own = np.repeat(row, levels, 0), len(self._names) + 3
        rows[1:, own : own + WEIGHTS] = np.exp(SPREAD * random.standard_normal((levels - 1, WEIGHTS)))
        rho = self._judged(np.repeat(rows, whole.shape[1], 0), whole.reshape(-1, *plans.shape[1:]))
        if rho.max() >= 0.0:
            return self._first(row, request, whole.reshape(-1, *plans.shape[1:])[rho >= 0.0]), np.zeros(1)
        rho = rho.reshape(levels, -1)
        return whole[np.arange(levels), rho.argmax(1)], rho.max(1)

    def _first(self, row: Numbers, request: PhaseRequest, plans: Numbers) -> Numbers:
        """Return one of `plans`, (k, L, m), that reaches the target first, (1, L, m); all reach it."""
        low, high = request.first - 1, request.last
        while high - low > 1 and len(plans) > 1:
            last = (low + high) // 2
            shorter = np.repeat(
                self._row(row[0, : len(self._names)], replace(request, last=last)), len(plans), 0
            )
            if (good := self._judged(shorter, plans) >= 0.0).any():
                plans, high = plans[good], last
            else:
                low = last
        return plans[:1]

    def _judged(self, rows: Numbers, plans: Numbers) -> Numbers:
        self.tried += len(plans)
        rho, _ = self._kernel.judge(rows, plans)
        return np.nan_to_num(rho[:, 0], nan=-np.inf)

    def _steered(
        self, row: Numbers, request: PhaseRequest, plans: Numbers, most: int
    ) -> tuple[Numbers, Numbers]:
        """Change plans, (k, L, m), by Gauss-Newton steps that meet the target at one of several samples.

        Derivatives are differences. Of each plan and those that result from it, the best is kept.
        """
        rho = self._judged(np.repeat(row, len(plans), 0), plans)
        for _ in range(most):
            tried = self._steps(row, request, plans)
            if not tried.shape[1]:
                break
            found = self._judged(
                np.repeat(row, tried.shape[0] * tried.shape[1], 0), tried.reshape(-1, *plans.shape[1:])
            )
            if found.max() >= 0.0:
                return self._first(row, request, tried.reshape(-1, *plans.shape[1:])[found >= 0.0]), np.zeros(
                    1
                )
            found = found.reshape(tried.shape[:2])
            best = found.argmax(1)
            value = found[np.arange(len(plans)), best]
            better = value > rho
            plans = np.where(better[:, None, None], tried[np.arange(len(plans)), best], plans)
            rho = np.maximum(value, rho)
            if rho.max() >= 0.0 or not better.any():
                break
        return plans, rho

    def _steps(self, row: Numbers, request: PhaseRequest, plans: Numbers) -> Numbers:
        """Return changed copies of plans, (k, L, m), as (k, tries, L, m); none without demands."""
        count, moves = len(plans), len(self._moves)
        span = self._bounds[1] - self._bounds[0]
        inward = np.where(plans > self._middle, -1.0, 1.0)
        moved = np.concatenate(
            (plans[:, None], plans[:, None] + (PROBE * span) * inward[:, None] * self._moves), 1
        )
        self.tried += count * (moves + 1)
        _, columns = self._kernel.judge(
            np.repeat(row, count * (moves + 1), 0), moved.reshape(-1, *plans.shape[1:]), columns=True
        )
        assert columns is not None
        env = dict(zip(self._names, columns, strict=False)) | {
            ir.ELAPSED: np.broadcast_to(np.arange(self.steps + 1.0)[:, None], columns.shape[1:])
        }
        options = self._demands[request.target]
        literals = tuple(
            dict.fromkeys((*(each.literal for option in options for each in option), *chain(*self._clauses)))
        )
        if not any(options):
            return np.empty((count, 0, *plans.shape[1:]))
        flat = {name: column.reshape(1, -1) for name, column in env.items()}
        values = np.stack(
            [
                np.broadcast_to(each[0], (self.steps + 1) * count * (moves + 1))
                for each in evaluate(literals, flat)
            ]
        )
        values = values.reshape(len(literals), self.steps + 1, count, moves + 1)
        index = {literal: i for i, literal in enumerate(literals)}
        whens = np.unique(np.linspace(request.first, request.last, SAMPLES).round().astype(np.int64))
        now = values[..., 0]
        with np.errstate(invalid="ignore"):  # of infinities; not a number is no slope
            slopes = (values[..., 1:] - now[..., None]) / PROBE  # per share of the range, inward
        tried: list[Numbers] = []
        lacks, falls = self._unsafe(now, slopes, index, whens)
        for option in options:
            numbers = [index[each.literal] for each in option]
            at = np.minimum(whens[:, None] + [each.later for each in option], self.steps)
            margins = np.array([each.margin for each in option])
            missing = np.concatenate((margins[:, None] - now[numbers, at], lacks), 1)
            grow = np.concatenate((slopes[numbers, at], falls), 1)
            tried.append(self._solved(plans, inward, missing.transpose(2, 0, 1), grow.transpose(2, 0, 1, 3)))
        return np.concatenate(tried, 1)

    def _unsafe(
        self, now: Numbers, slopes: Numbers, index: dict[ir.Predicate, int], whens: NDArray[np.int64]
    ) -> tuple[Numbers, Numbers]:
        """Return the largest shortfalls of the safety clauses, (whens, clauses, k), and their derivatives.

        Each is that of the greatest literal of a clause, at the sample up to each `when` of its minimum.

        Args:
            now: values of the literals, (literals, L + 1, k).
            slopes: their derivatives, (literals, L + 1, k, moves).
            index: literal -> its row.
            whens: samples up to which safety counts.
        """
        each = np.arange(now.shape[-1])
        literals = np.empty((len(whens), len(self._clauses), len(each)), dtype=np.int64)
        samples = np.empty_like(literals)
        for i, clause in enumerate(self._clauses):
            numbers = np.array([index[literal] for literal in clause])
            margins = now[numbers].max(0)
            worst = np.stack([margins[: when + 1].argmin(0) for when in whens])
            samples[:, i], literals[:, i] = worst, numbers[now[numbers].argmax(0)[worst, each]]
        return LEAST_MARGIN - now[literals, samples, each], slopes[literals, samples, each]

    def _solved(self, plans: Numbers, inward: Numbers, missing: Numbers, slopes: Numbers) -> Numbers:
        """Return plans after the smallest changes that increase the linearised values by `missing`.

        Args:
            plans: plans, (k, L, m).
            inward: signs of the changes of the controls, (k, L, m).
            missing: shortfalls of the values, (k, samples, demands).
            slopes: derivatives by the changes, (k, samples, demands, moves).
        """
        slopes = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
        missing = np.nan_to_num(missing, nan=0.0, posinf=0.0, neginf=0.0)
        size = np.sqrt((slopes**2).sum(-1)).max((0, 1)) + TINY
        slopes, missing = slopes / size[:, None], missing / size
        active = missing > 0.0
        one = np.eye(missing.shape[-1])
        low, high, span = self._bounds[0], self._bounds[1], self._bounds[1] - self._bounds[0]
        touched = self._moves != 0.0
        signed = self._moves * inward[:, None]
        room_up = np.where(signed > 0, (high - plans[:, None]) / span, (plans[:, None] - low) / span)
        room_down = np.where(signed > 0, (plans[:, None] - low) / span, (high - plans[:, None]) / span)
        up = np.where(touched, room_up, np.inf).min((2, 3))[:, None]
        down = -np.where(touched, room_down, np.inf).min((2, 3))[:, None]
        free = np.ones(slopes.shape[:2] + slopes.shape[3:])
        fixed = np.zeros_like(free)
        for _ in range(PASSES):
            own = slopes * active[..., None] * free[..., None, :]
            normal = own @ own.swapaxes(-1, -2)
            level = DAMPING * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] + TINY
            rest = (missing - (slopes @ fixed[..., None])[..., 0]) * active
            weights = np.linalg.solve(normal + level * one, rest[..., None])
            change = (own.swapaxes(-1, -2) @ weights)[..., 0] + fixed
            inside = np.clip(change, down, up)
            free = free * (inside == change)
            fixed = np.where(free > 0.0, 0.0, inside)
            active |= (slopes @ inside[..., None])[..., 0] < missing
        change = np.einsum("ksj,kjlm->kslm", inside, signed) * span
        tried = np.concatenate([plans[:, None] + share * change for share in SHARES], 1)
        bounded: Numbers = np.clip(tried, low, high)
        return bounded

    def margin(self, state: Numbers, request: PhaseRequest) -> float:
        """Robustness of the target of a request in `state`, (n,), itself."""
        middle = np.broadcast_to(self._middle, (1, self.steps, len(self._middle)))
        rho, _ = self._kernel.judge(self._row(state, replace(request, first=0, last=0)), middle)
        return float(rho[0, 0])

    def _row(self, state: Numbers, request: PhaseRequest) -> Numbers:
        opened = [float(i in request.open) for i in range(self._untils)]
        return np.array([[*state, request.target, request.first, request.last, *[1.0] * WEIGHTS, *opened]])

    def _phase(self, row: Numbers, plan: Numbers) -> Phase:
        """Return the phase of a plan, up to the first sample at which it reaches the target."""
        ends, own = np.repeat(row, self.steps + 1, 0), len(self._names)
        ends[:, own + 2] = np.minimum(np.arange(self.steps + 1), row[0, own + 2])
        rho, columns = self._kernel.judge(ends, np.repeat(plan[None], self.steps + 1, 0), columns=True)
        assert columns is not None
        margins = rho[:, 0]
        good = np.flatnonzero(margins >= 0.0)
        sample = int(good[0]) if len(good) else int(np.nan_to_num(margins, nan=-np.inf).argmax())
        margin = 0.0 if len(good) else float(margins[sample])
        return Phase(plan, columns[:own, :, 0].T, sample, margin)


@dataclass(frozen=True, slots=True)
class Demand:
    """Predicate that must hold some samples after a target is reached.

    Attributes:
        literal: the predicate.
        later: number of samples.
        margin: robustness margin to aim at.
    """

    literal: ir.Predicate
    later: int
    margin: float


def _demands(formula: ir.Formula, known: frozenset[str], later: int = 0) -> list[tuple[Demand, ...]]:
    """Return the alternatives of a target, each a conjunction of demands; other parts are left out.

    Of an `always`, the first, the middle and the last sample count.
    """
    match formula:
        case ir.Predicate() if formula.columns <= known:
            return [(Demand(formula, later, LEAST_MARGIN),)]
        case ir.BoolOp("or", items):
            return [each for item in items for each in _demands(item, known, later)][:OPTIONS]
        case ir.BoolOp("and", items):
            parts = [_demands(item, known, later) for item in items]
            return [tuple(chain(*each)) for each in islice(product(*parts), OPTIONS)]
        case ir.Temporal("always", ir.Window(lo, int(hi)), body):
            whens = dict.fromkeys((lo, (lo + hi) // 2, hi))
            each = zip(*(_demands(body, known, later + when) for when in whens), strict=True)
            return [tuple(chain(*part)) for part in each]
        case _:
            return [()]


def _begins(steps: int, most: int) -> NDArray[np.int64]:
    """First samples of at most `most` parts of a phase, the later the longer."""
    shares: NDArray[np.float64] = np.arange(most) / most
    return np.unique((steps * shares**GROWTH).astype(np.int64))


def levels(*ends: Numbers, most: int) -> Numbers:
    """Return combinations of levels of the controls, (k, m), the nearest to the middle of the range first.

    If there are more than `most` combinations, some of them are drawn at random.

    Args:
        ends: levels that each control may have, (m,) each.
        most: largest number of combinations.
    """
    table = np.stack(ends)
    count, controls = table.shape
    if count**controls <= most:
        pick = np.array(list(product(range(count), repeat=controls))).reshape(-1, controls)
    else:
        pick = np.random.default_rng(0).integers(count, size=(most, controls))
    found: Numbers = table[pick, np.arange(controls)]
    order = np.abs(found - table.mean(0)).sum(1).argsort(kind="stable")
    return np.ascontiguousarray(found[order])


class _Shortfall:
    """Shortfall of a formula in a state, as a formula whose robustness is 0 where the state satisfies it.

    The shortfall of a conjunction is the sum over its items, each in units of its typical size: unlike a
    minimum, it decreases with every item that comes nearer. Predicates that read the same states form a
    group; each group has a weight, which is a state of the kernel.

    Args:
        scale: function that returns the typical size of the margin of a predicate.
    """

    def __init__(self, scale: Callable[[ir.Formula], float]) -> None:
        self._scale = scale
        self._groups: dict[frozenset[str], int] = {}

    def of(self, formula: ir.Formula) -> ir.Formula:
        """Return a formula whose robustness is the negative shortfall of `formula`."""
        if isinstance(formula, ir.Truth):
            return formula
        if not all(isinstance(node, (ir.Truth, ir.Predicate, ir.BoolOp)) for node in formula.walk()):
            return formula.map_children(formulas=self.of)
        return ir.Predicate(-self._shortfall(formula))

    def _shortfall(self, formula: ir.Formula) -> ir.Num:
        match formula:
            case ir.Predicate(num, sign, strict):
                margin = num if sign > 0 else -num
                tightened = margin - LEAST_MARGIN if strict else margin
                share = ir.Const(1.0 / self._scale(formula))
                group = self._groups.setdefault(formula.columns, len(self._groups)) % WEIGHTS
                weight = ir.Signal(WEIGHT.format(group)) * share
                return (-tightened).apply("relu") * weight
            case ir.BoolOp(op, items):
                name = "add" if op == "and" else "min"
                return reduce(lambda a, b: a.apply(name, b), map(self._shortfall, items))
            case ir.Truth(value):
                return ir.Const(0.0 if value else 1.0)
            case _:
                raise TypeError(f"not a state formula: {formula!r}")


def _decisive(formula: ir.Formula) -> ir.Formula:
    """Return the formula with robustness +inf where it holds, and -inf elsewhere."""
    if isinstance(formula, ir.Predicate):
        return replace(formula, guard=True)
    return formula.map_children(formulas=_decisive)


def _at_least(left: ir.Num, right: ir.Num) -> ir.Predicate:
    return ir.Predicate(left - right, guard=True)


def _equal(left: ir.Num, value: float) -> ir.Predicate:
    apart = (left - value).apply("abs")
    return ir.Predicate(0.5 - apart, guard=True)
