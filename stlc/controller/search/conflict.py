"""Requirements that no plan was found for: which of them conflict, and which are proved to be out of reach.

If a search finds no plan, this does not prove that there is none. Bounds can prove it: interval arithmetic
over all plans encloses the states that are reachable within the horizon. These states give an upper bound on
the robustness of a requirement. If the bound is negative, no plan satisfies the requirement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import Bounds
from stlc.compile.ir.ranges import bounds
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import TARGET, solve
from stlc.controller.search.local_search import SearchResult
from stlc.controller.search.missed import better_planner, missed
from stlc.controller.search.planner import PlanBudget, plan
from stlc.diagnostics import Diagnostic
from stlc.native import Stop, never

STARTS = 64
PROOF = (
    f"proved from each of {STARTS} starts, by bounds of the states over everything that the controls can do "
    "within the horizon"
)
TRIES = 4000
JUDGED = 20_000
"""Plans that the planner `search` judges for each of two starts, where local search has found none."""
PLANNING = 2.0
"""Seconds of search beside which other planners are tried (see `better_planner`)."""


def conflict(task: Task, stop: Stop = never) -> Diagnostic:
    """Find requirements that seem to conflict; return the diagnostic R404, which names them.

    Requirements seem to conflict if no plan was found that satisfies all of them. If bounds prove that no
    plan satisfies some requirement, the first such requirement is named. Otherwise the requirements are
    tested one after the other. In a test, a search looks for a plan that satisfies the remaining requirements
    except the tested one. If the search finds none, the tested requirement is removed, because the others
    already conflict. The requirements that remain after all tests are named. The tests end early once
    `stop` returns True.
    """
    proved = [rule for rule in task.rules if _impossible(task, rule)]
    if proved:
        return _told(task, proved[:1], _searched(task, proved[:1], stop), proved=True)
    core = list(task.rules)
    nearest = first = _searched(task, core, stop)
    for rule in task.rules:
        rest = [other for other in core if other is not rule]
        if not rest or stop():
            continue
        found = _searched(task, rest, stop)
        if bool(found.solved.any()):
            continue
        budget = PlanBudget(torch.inf, JUDGED, TARGET, stop)
        if not (bool(plan(_alone(task, rest), _starts(task)[:2], budget=budget).satisfied.any()) or stop()):
            core, nearest = rest, found
    said = _told(task, core, nearest, proved=False)
    listed = [f"`{each.requirement}` from {each.starts}" for each in missed(task, first.states, first.plans)]
    said = said.with_note(f"the best plans from {STARTS} starts violate {', '.join(listed)}")
    better = None if stop() else better_planner(task, first.states, "search", PLANNING)
    if better is None:
        return said
    text = f"`--method {better.method}` finds plans: in `stlc plan`, and as controller in `stlc simulate`"
    return replace(said, help=(text, *said.help))


def refuted(task: Task) -> bool:
    """True if bounds prove that one of the requirements cannot be satisfied.

    That is: every plan violates this requirement, from every initial state that was tested. The tested states
    are `STARTS` random ones, the same in each diagnosis.
    """
    return any(_impossible(task, rule) for rule in task.rules)


def _alone(task: Task, rules: Sequence[CompiledRequirement]) -> Task:
    return Task(replace(task.compiled, requirements=tuple(rules)), task.plain)


def _starts(task: Task) -> torch.Tensor:
    """Initial states that the diagnosis tests, (STARTS, n): random ones, the same in each diagnosis."""
    return task.sample(STARTS, generator=torch.Generator().manual_seed(0))


def _searched(task: Task, rules: Sequence[CompiledRequirement], stop: Stop) -> SearchResult:
    """Search, from the tested initial states, for plans that satisfy the requirements `rules` alone."""
    alone, x0 = _alone(task, rules), _starts(task)
    nothing = x0.new_zeros(0, task.horizon, len(task.system.control_names))
    return solve(alone, x0, library=nothing, passes=1, tries=TRIES, stop=stop)


def _told(
    task: Task, core: Sequence[CompiledRequirement], nearest: SearchResult, *, proved: bool
) -> Diagnostic:
    names = [f"`{rule.name}`" for rule in core]
    row = int(nearest.rho.argmax())
    columns = zip(task.system.signature.columns, nearest.states[row].tolist(), strict=True)
    start = ", ".join(f"{column.name} = {value:.4g}" for column, value in columns)
    rho = float(nearest.rho[row])
    missing = f"{-rho:.4g}" if math.isfinite(rho) else "a deadline that was over before the plan"
    rest = "" if len(core) == 1 else "; without one of these requirements some were found"
    tried = (
        f"{TRIES:,} plans were tried for each of {STARTS} starts, and plans were put together step by step "
        f"from some of them{rest}; that is no proof that there is none"
    )
    if proved:
        message, label = f"no plan satisfies {names[0]}", "out of reach whatever a plan does"
    elif len(core) == 1:
        message, label = (
            f"no plan was found that satisfies {names[0]}",
            "nothing that was tried satisfies this",
        )
    else:
        message = f"no plan was found that satisfies {', '.join(names[:-1])} and {names[-1]} together"
        label = "not together with the others, as far as was tried"
    return Diagnostic(
        "R404",
        message,
        core[0].span,
        label=label,
        labels=tuple(rule.span.label("with this") for rule in core[1:] if rule.span is not None),
        help=(
            "ask for less, give it more time (`horizon`) or wider ranges of control, or other initial states",
            "`stlc compile` shows what is asked for in steps",
        ),
        note=(
            PROOF if proved else tried,
            f"the nearest misses by {missing}, from {start}",
        ),
    )


# --------------------------------------------------------------------------------- proofs


def _impossible(task: Task, rule: CompiledRequirement) -> bool:
    """True if bounds prove that every plan violates the requirement, from each of the tested initial states.

    See `_starts` for these states.
    """
    return all(
        TOLERANCE.violated(_most(rule.formula, _reached(task, x.tolist()))) for x in _starts(task).double()
    )


def _reached(task: Task, x: Sequence[float]) -> list[Mapping[str, Bounds]]:
    """Bounds on the states that any controls can reach from state `x`, (n,).

    Returns:
        For each instant from 0 to T, the known bounds: name of a state -> bounds.
    """
    step, system = task.system.exact_step, task.system
    low, high = system.control_low.tolist(), system.control_high.tolist()
    controls = dict(zip(system.control_names, zip(low, high, strict=True), strict=True))
    here = {name: (value, value) for name, value in zip(task.system.names, x, strict=True)}
    reached: list[Mapping[str, Bounds]] = [here]
    for _ in range(task.horizon):
        facts = {**here, **controls}
        for name, num in step.lets:
            known = bounds(num, facts)
            facts |= {} if known is None else {name: known}
        moved = {name: bounds(num, facts) for name, num in step.next.items()}
        steady = {name: known for name, known in here.items() if name not in moved}
        here = steady | {name: known for name, known in moved.items() if known is not None}
        reached.append(here)
    return reached


def _most(formula: ir.Formula, reached: Sequence[Mapping[str, Bounds]]) -> float:
    """Upper bound on the robustness of a formula at time 0; inf if the bounds on the states imply none.

    The formula is in negation normal form. So its robustness never decreases when the robustness of one of
    its predicates increases. Hence each predicate is replaced by its upper bound at every instant.

    Args:
        formula: the formula.
        reached: bounds on the states at instants 0 to T, from `_reached`.
    """
    columns = {"": np.zeros((len(reached), 1))}

    def bounded(node: ir.Formula) -> ir.Formula:
        match node:
            case ir.Predicate():
                name = str(len(columns))
                columns[name] = np.array([[_upper(node, facts)] for facts in reached])
                return ir.Predicate(ir.Signal(name))
            case ir.Freeze(_, body):
                return bounded(body)
        return node.map_children(formulas=bounded)

    (most,) = evaluate([bounded(formula)], columns, end="upper")
    return float(most.max())


def _upper(atom: ir.Predicate, facts: Mapping[str, Bounds]) -> float:
    """Upper bound on the robustness of a predicate at one instant; inf if unknown.

    `facts` are the bounds on the states at that instant, by name.
    """
    if atom.shifted:
        return math.inf
    reach = bounds(atom.num, facts)
    if reach is None or any(map(math.isnan, reach)):
        return math.inf
    most = reach[1] if atom.sign > 0 else -reach[0]
    return math.copysign(math.inf, most + TOLERANCE) if atom.guard else most
