"""Which requirements no plan was found for, and whether that is proved: R404.

A search proves nothing. Bounds do: interval arithmetic over all that a plan may do says how far the states
can come within the horizon, and so how robust a requirement can be at most.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from stlc.compile.analysis.ranges import bounds
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import numbers, subexpressions
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.feasibility import ENOUGH, solve
from stlc.controller.problem.task import Task
from stlc.controller.training.exploration import EFFORTS, Exploration
from stlc.diagnostics import Diagnostic, Label
from stlc.native import never

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from stlc.compile.ir.functions import Bounds
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.controller.training.local_search import SearchResult
    from stlc.native import Stop

STARTS = 64
TRIES = 4000


def conflict(task: Task, enough: Stop = never) -> Diagnostic:
    """What to say of a task that no plan was found for: R404, with the requirements that are to blame.

    Those that are proved to have no plan, else what is left where requirements are left out one after the
    other as long as no plan is found for the rest; that ends where `enough` says so.
    """
    proved = [rule for rule in task.rules if _impossible(task, rule)]
    if proved:
        return _told(task, proved[:1], _climbed(task, proved[:1], enough), proved=True)
    core = list(task.rules)
    nearest = _climbed(task, core, enough)
    for rule in task.rules:
        rest = [other for other in core if other is not rule]
        if not rest or enough():
            continue
        found = _climbed(task, rest, enough)
        if not (bool(found.solved.any()) or _explored(task, rest, enough) or enough()):
            core, nearest = rest, found
    return _told(task, core, nearest, proved=False)


def refuted(task: Task) -> bool:
    """Whether it is proved of some requirement that no plan satisfies it, from any of `STARTS` starts."""
    return any(_impossible(task, rule) for rule in task.rules)


def _alone(task: Task, rules: Sequence[CompiledRequirement]) -> Task:
    return Task(replace(task.compiled, requirements=tuple(rules)), task.plain)


def _starts(task: Task) -> torch.Tensor:
    """Starts that are always the same, (STARTS, n)."""
    return task.sample(STARTS, generator=torch.Generator().manual_seed(0))


def _climbed(task: Task, rules: Sequence[CompiledRequirement], enough: Stop) -> SearchResult:
    """The best plans for these requirements alone."""
    alone, x0 = _alone(task, rules), _starts(task)
    nothing = x0.new_zeros(0, task.horizon, len(task.system.control_names))
    return solve(alone, x0, library=nothing, passes=1, tries=TRIES, stop=enough)


def _explored(task: Task, rules: Sequence[CompiledRequirement], enough: Stop) -> bool:
    """Whether exploration finds a plan for these requirements alone."""
    generator = torch.Generator().manual_seed(0)
    found = Exploration(_alone(task, rules)).solved(_starts(task)[:2], EFFORTS[0], generator, ENOUGH, enough)
    return len(found.rho) > 0


def _told(
    task: Task, core: Sequence[CompiledRequirement], nearest: SearchResult, *, proved: bool
) -> Diagnostic:
    names = [f"`{rule.name}`" for rule in core]
    row = int(nearest.rho.argmax())
    columns = zip(task.system.signature.columns, nearest.states[row].tolist(), strict=True)
    start = ", ".join(f"{column.name} = {value:.4g}" for column, value in columns)
    if proved:
        message, label = f"no plan satisfies {names[0]}", "out of reach whatever a plan does"
    elif len(core) == 1:
        message, label = (
            f"no plan was found that satisfies {names[0]}",
            "nothing that was tried satisfies this",
        )
    else:
        message = f"no plan was found that satisfies {_listed(names)} together"
        label = "not together with the others, as far as was tried"
    return Diagnostic(
        "R404",
        message,
        core[0].span,
        label=label,
        labels=tuple(Label(rule.span, "with this") for rule in core[1:] if rule.span is not None),
        help=(
            "ask for less, give it more time (`horizon`) or wider ranges of control, or other initial states",
            "`stlc compile` shows what is asked for in steps",
        ),
        note=(
            _proof() if proved else _tried(core),
            f"the nearest misses by {-float(nearest.rho[row]):.4g}, from {start}",
        ),
    )


def _proof() -> str:
    return (
        f"proved from each of {STARTS} starts, by bounds of the states over everything that the controls "
        "can do within the horizon"
    )


def _tried(core: Sequence[CompiledRequirement]) -> str:
    """How hard it was searched, and that this is no proof."""
    rest = "" if len(core) == 1 else "; without one of these requirements some were found"
    return (
        f"{TRIES:,} plans were tried for each of {STARTS} starts, and plans were put together step by step "
        f"from some of them{rest}; that is no proof that there is none"
    )


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


# --------------------------------------------------------------------------------- proofs


def _impossible(task: Task, rule: CompiledRequirement) -> bool:
    """Whether bounds prove that no plan from any of the starts satisfies a requirement."""
    return all(_most(rule.formula, _reached(task, x.tolist())) < -TOLERANCE for x in _starts(task).double())


def _reached(task: Task, x: Sequence[float]) -> list[Mapping[str, Bounds]]:
    """Between which values every state lies after each number of steps, whatever the controls do."""
    step, system = task.system.exact_step, task.system
    low, high = system.control_low.tolist(), system.control_high.tolist()
    controls = dict(zip(system.control_names, zip(low, high, strict=True), strict=True))
    here = {name: (value, value) for name, value in zip(task.names, x, strict=True)}
    reached: list[Mapping[str, Bounds]] = [here]
    for _ in range(task.horizon):
        facts = {**here, **controls}
        for name, num in step.lets:
            facts |= _known(name, bounds(num, facts))
        moved = {name: bounds(num, facts) for name, num in step.next.items()}
        steady = {name: known for name, known in here.items() if name not in moved}
        here = steady | {name: known for name, known in moved.items() if known is not None}
        reached.append(here)
    return reached


def _known(name: str, reach: Bounds | None) -> dict[str, Bounds]:
    return {} if reach is None else {name: reach}


def _most(formula: ir.Formula, reached: Sequence[Mapping[str, Bounds]]) -> float:
    """The greatest robustness that a formula can have at first; inf where the bounds do not say."""
    return _Most(reached).at(formula, 0)


class _Most:
    """Greatest robustness at every instant of what is reached."""

    def __init__(self, reached: Sequence[Mapping[str, Bounds]]) -> None:
        self._reached = reached
        self._known: dict[tuple[ir.Formula, int], float] = {}

    def at(self, formula: ir.Formula, now: int) -> float:
        """At one instant; beyond the last one anything can be."""
        if now < 0 or now >= len(self._reached):
            return math.inf
        key = formula, now
        if key not in self._known:
            self._known[key] = self._of(formula, now)
        return self._known[key]

    def _of(self, formula: ir.Formula, now: int) -> float:
        match formula:
            case ir.Truth(value):
                return math.inf if value else -math.inf
            case ir.Predicate():
                return self._atom(formula, now)
            case ir.BoolOp(op, items):
                return (min if op == "and" else max)(self.at(item, now) for item in items)
            case ir.Temporal(op, window, body):
                values = [self.at(body, k) for k in self._instants(window, now)]
                return (min if op == "always" else max)(values, default=math.inf)
            case ir.Until("until", window, _, right):
                return max((self.at(right, k) for k in self._instants(window, now)), default=math.inf)
            case ir.Shift(steps, body):
                return self.at(body, now + steps)
            case ir.Freeze(_, body):
                return self.at(body, now)
            case _:
                return math.inf

    def _atom(self, atom: ir.Predicate, now: int) -> float:
        facts = self._reached[now]
        if any(isinstance(part, ir.ShiftedSignal) for num in numbers(atom) for part in subexpressions(num)):
            return math.inf
        reach = bounds(atom.num, facts)
        if reach is None or any(map(math.isnan, reach)):
            return math.inf
        most = reach[1] if atom.sign > 0 else -reach[0]
        return math.copysign(math.inf, most + TOLERANCE) if atom.guard else most

    def _instants(self, window: ir.Window, now: int) -> range:
        last = len(self._reached) - 1 if window.hi is None else now + window.hi
        return range(now + window.lo, last + 1)
