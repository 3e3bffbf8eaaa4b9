"""Comparison of an exported controller with the run that it was exported from, in random states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeAlias

import torch
from torch import Tensor

from stlc import toolchain
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.safe_prefix import prefix_robustness
from stlc.controller.guard.search import StagedSearch
from stlc.controller.problem.task import Task
from stlc.diagnostics import Diagnostic, RunError
from stlc.export.programs import without_deprecations
from stlc.registry import GUARDS
from stlc.runtime.backup import search
from stlc.runtime.graphs import Graphs, JudgedPlans, joined

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy


@dataclass(frozen=True, slots=True)
class Closeness:
    """Greatest differences of an export from its run.

    Attributes:
        plan: difference of a control, as a share of its range.
        rho: difference of a robustness from the exact monitor's on the same plan, as a share of 1 or of its
            magnitude, whichever is greater.
    """

    plan: float
    rho: float


EXACT = Closeness(1e-4, 1e-6)
"""Differences of an export in float64, whose network is float32."""
SINGLE = Closeness(1e-3, 1e-2)
"""Differences of an export in float32."""
BUILT = ("-std=c99", "-O1", "-fno-math-errno")


@dataclass(frozen=True, slots=True)
class Answer:
    """Decisions of an export.

    Attributes:
        plan: plans, (B, T, m).
        rho: robustness of the specification, (B,).
        safe: robustness of the safety requirements, (B,).
        each: robustness of each requirement, (B, R).
        source: rule that chose each plan (`stlc.runtime.backup`), (B,); None if the policy did.
        t0: length of the prefix that the backup policy took from its list, (B,); None if the policy chose.
    """

    plan: Tensor
    rho: Tensor
    safe: Tensor
    each: Tensor
    source: Tensor | None = None
    t0: Tensor | None = None


Decide: TypeAlias = Callable[[Tensor], Answer]
"""Decisions of an export, a function of states (B, n) float64."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of an export with its run.

    Attributes:
        states: number of random states.
        guarded: number of those in which the backup policy was compared too.
        plan: greatest difference of a control, as a share of its range, over the states in which export and
            run chose the same plan.
        rho: greatest difference of a robustness from that of the exact monitor, as a share of 1 or of its
            magnitude, whichever is greater.
        ties: number of states in which the export chose another plan than the run, of the same rank.
    """

    JSON: ClassVar = "states guarded plan rho"

    states: int
    plan: float
    rho: float
    ties: int
    guarded: int = 0

    def worst(self, other: Agreement, *distances: float) -> Agreement:
        """Combine two agreements: take the greater differences, and add the ties.

        `distances` are further differences of robustness.
        """
        rho = max(self.rho, other.rho, *distances)
        ties, guarded = self.ties + other.ties, self.guarded + other.guarded
        return Agreement(self.states, max(self.plan, other.plan), rho, ties, guarded)


def agreement(
    policy: Policy, decide: Decide, *, states: int, seed: int = 7, within: Closeness = EXACT
) -> Agreement:
    """Compare an export with its policy in random states.

    Args:
        policy: the policy that was exported.
        decide: decisions of the export.
        states: number of random states.
        seed: seed of the random states.
        within: greatest differences.

    Raises:
        RunError: R105, policy and export disagree.
    """
    x = _visited(policy, states, seed)
    with torch.no_grad():
        return _compared(policy.task, x, policy.plan(x), decide(x), within)


def _visited(policy: Policy, count: int, seed: int) -> Tensor:
    """Random initial states, (count, n); every other one is followed by a plan of the policy for some steps.

    So the timers of a specification, such as the clock of a mission, have other values than at the start.
    """
    task = policy.task
    x = task.sample(count, seed=seed, dtype=torch.float64)
    moved = x[1::2]
    path = task.rollout(moved, policy.plan(moved))
    at = torch.randint(task.horizon + 1, (len(moved),), generator=torch.Generator().manual_seed(seed))
    reached = path[torch.arange(len(moved)), at]
    x[1::2] = torch.where(torch.isfinite(reached).all(1, keepdim=True), reached, moved)
    return x


def _compared(task: Task, x: Tensor, plan: Tensor, answer: Answer, within: Closeness = EXACT) -> Agreement:
    """Compare the export's `answer` with the policy's `plan` (B, T, m) in states (B, n).

    Raises:
        RunError: R105, they disagree.
    """
    exported, judged = answer.plan, task.judge(x, plan)
    width = (task.system.control_high - task.system.control_low).double()
    far = ((exported - plan).abs() / width).amax((1, 2))
    again = task.judge(x, exported)
    score = [task.rank(one) for one in (judged, again)]
    same = far <= within.plan
    ties = ~same & ((score[0] - score[1]).abs() <= within.plan)
    pairs = ((answer.rho, again.rho), (answer.safe, again.safe), (answer.each, again.requirements))
    off = max(_distance(told, known) for told, known in pairs)
    found = Agreement(len(x), float(far[same].amax()) if bool(same.any()) else 0.0, off, int(ties.sum()))
    if not bool((same | ties).all()) or not off <= within.rho:
        worst = float(far.nan_to_num(torch.inf).amax())
        message = f"plans differ by up to {worst:.2g} of a range, robustness by up to {off:.2g}"
        raise RunError(_disagreement(message))
    return found


def _disagreement(how: str) -> Diagnostic:
    return Diagnostic(
        "R105",
        "the exported controller does not do what the run does",
        note=(how,),
        help=("nothing was written; please report this with the specification and the system",),
    )


def _distance(a: Tensor, b: Tensor) -> float:
    """Greatest difference of two tensors, as a share of 1 or of the magnitude, whichever is greater.

    That of equal infinities, and of NaN and NaN, is 0.
    """
    same = (a == b) | (torch.isnan(a) & torch.isnan(b))
    off = (a - b).abs() / b.abs().clamp_min(1.0)
    return float(torch.where(same, torch.zeros_like(a), off).nan_to_num(torch.inf).amax())


def by_torch(path: Path) -> Decide:
    """Load an exported torch program; returns its decisions."""
    with without_deprecations():
        module = torch.export.load(path).module()
    return lambda x: Answer(*module(x))


def backup_agreement(
    policy: Policy, decide: Decide, *, states: int, seed: int = 11, within: Closeness = EXACT
) -> Agreement:
    """Compare the backup policy with that of an export in random states.

    It is called in every state, even if the policy's plan is satisfying and no guard is needed.

    Args:
        policy: the policy that was exported.
        decide: decisions of the exported backup policy.
        states: number of random states.
        seed: seed of the random states.
        within: greatest differences.

    Raises:
        RunError: R105, they disagree.
    """
    task = policy.task
    x = _visited(policy, states, seed)
    with torch.no_grad():
        wanted, told = StagedSearch(task, policy, PAPER).search(x, policy.plan(x)), decide(x)
    assert told.source is not None
    assert told.t0 is not None
    alike = torch.equal(told.source, wanted.source) and torch.equal(told.t0, wanted.prefix_length)
    if within is EXACT and not alike:  # in float32, plans at the edge of a requirement may be either
        raise RunError(_disagreement("the backup policy decides by another rule"))
    return replace(_compared(task, x, wanted.plans, told, within), guarded=states)


def backup_by_torch(path: Path, policy: Policy) -> Decide:
    """Load the exported torch program of the backup policy; returns its decisions on plans of the policy."""
    with without_deprecations():
        module = torch.export.load(path).module()

    def decide(x: Tensor) -> Answer:
        rows = [module(one[None], policy.plan(one[None])) for one in x]
        return Answer(*(torch.cat(column) for column in zip(*rows, strict=True)))

    return decide


def by_onnx(graphs: Graphs) -> Decide:
    """Return the decisions of ONNX graphs, evaluated by the Python runtime `stlc.runtime`."""
    return lambda x: _answer(graphs.decided(x.numpy())[0])


def backup_by_onnx(graphs: Graphs) -> Decide:
    """Return the decisions of the Python runtime's backup policy on the plans of ONNX graphs."""

    def decide(x: Tensor) -> Answer:
        states = x.numpy()
        judged, outputs = graphs.decided(states)
        plans = outputs.get("policy_plan", judged.plan)
        found = [search(graphs, state, plan) for state, plan in zip(states, plans, strict=True)]
        taken = _answer(joined([each.judged for each in found]))
        source, t0 = (torch.tensor(column) for column in zip(*((f.source, f.t0) for f in found), strict=True))
        return replace(taken, source=source, t0=t0)

    return decide


def _answer(judged: JudgedPlans) -> Answer:
    return Answer(*map(torch.from_numpy, (judged.plan, judged.rho, judged.safe, judged.each)))


def previous_plan_agreement(
    policy: Policy, graphs: Graphs, *, states: int, seed: int = 9, within: Closeness = EXACT
) -> Agreement:
    """Compare the decisions of the ONNX graphs with those of the guard, given a previous plan.

    The previous plan is made as follows: in random states, the guard decides and one step is taken. In the
    states reached, both the guard and the graphs get the rest of the guard's plan, and decide again.

    Raises:
        RunError: R105, they disagree.
    """
    guard, task = Guard(policy.task, policy, GUARDS.default), policy.task
    x = task.sample(states, seed=seed, dtype=torch.float64)
    first = guard.decide(x)
    x, left = task.system.step(x, first.action), first.later()
    wanted = guard.decide(x, left)
    judged, _ = graphs.followed(x.numpy(), left.plan.numpy())
    return _compared(task, x, wanted.plan, _answer(judged), within)


def same_verdicts(
    task: Task, graphs: Graphs, *, states: int, seed: int = 7, within: Closeness = EXACT
) -> float:
    """Return the greatest difference between verdicts of the graphs and of the task on random plans.

    A verdict consists of the robustness, the cost, the states under the plan, and the robustness of the
    safety requirements on each first part of the plan.

    Raises:
        RunError: R105, the difference is too large.
    """
    x = task.sample(states, seed=seed, dtype=torch.float64)
    low, high = task.system.control_low.double(), task.system.control_high.double()
    shape = (states, task.horizon, len(low))
    drawn = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    plans = low + (high - low) * drawn
    wanted = task.judge(x, plans)
    exported, outputs = graphs.judged(x.numpy(), plans.numpy())
    columns = torch.stack([wanted.columns[name].t() for name in task.system.names], 2)
    formulas = [rule.formula for rule in task.compiled.safety]
    falls = prefix_robustness(formulas, wanted.columns).t()
    pairs = [
        (exported.rho, wanted.rho),
        (exported.safe, wanted.safe),
        (exported.each, wanted.requirements),
        (exported.cost, task.cost(wanted)),
        (outputs["states"], columns),
        (graphs.falls(x.numpy(), plans.numpy()), falls),
    ]
    off = max(_distance(torch.from_numpy(a), b) for a, b in pairs)
    if not off <= within.rho:
        raise RunError(_disagreement(f"verdicts on given plans differ by up to {off:.2g}"))
    return off


class Unchecked(Exception):  # noqa: N818 - a result, caught by the caller
    """Exception: the export could not be verified; `why` completes the message "not checked: "."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why


def by_c(folder: Path, task: Task, built: Path) -> Callable[[str], Decide]:
    """Compile the example program of `folder` to `built`; returns mode of the program -> its decisions.

    Raises:
        Unchecked: there is no working compiler.
        RunError: R105, the program cannot be compiled.
    """
    using = toolchain.compiler()
    if using is None:
        raise Unchecked("there is no C compiler")
    try:
        done = toolchain.compiled(using, [*BUILT, "-o", str(built), str(folder / "main.c"), "-lm"])
    except toolchain.CompilerError as error:
        raise Unchecked(f"the C compiler `{using}` {error.why}") from error
    if done.code:
        broken = toolchain.works(using)
        if broken:
            raise Unchecked(f"the C compiler `{using}` {broken}")
        raise RunError.of("R105", "the exported C does not compile", note=tuple(done.errors.splitlines()[:5]))
    rules, shape = len(task.rules), (task.horizon, len(task.system.decl.controls))

    def decide(mode: str, x: Tensor) -> Answer:
        table = torch.tensor(answers([str(built), mode], x.tolist()), dtype=torch.float64)
        plan, (source, t0) = table[:, 4 + rules :].view(-1, *shape), table[:, :2].long().T
        return Answer(plan, table[:, 2], table[:, 3], table[:, 4 : 4 + rules], source, t0)

    return lambda mode: partial(decide, mode)


def answers(command: Sequence[str], states: Sequence[Sequence[float]]) -> list[list[float]]:
    """Run the example program; return its decisions, one list of numbers per state.

    The numbers are source, t0, rho, safe, requirements, plan, in this order.

    Raises:
        RunError: R105, the program fails or does not end.
    """
    asked = "\n".join(" ".join(map(repr, state)) for state in states)
    try:
        done = toolchain.run(command, given=asked)
    except toolchain.HangsError as hangs:
        raise RunError(_disagreement(f"the example program {hangs.why}")) from hangs
    if done.code:
        raise RunError(_disagreement(f"the example program {done.failure}"))
    return [[float(word) for word in line.split()] for line in done.out.splitlines()]
