"""Known feasible share of a benchmark: the share of initial states from which a satisfying plan is known.

It is measured on held-out states, which are never used in training. A plan is known if a policy or a long
search has found it. The share is a lower bound of the true feasible share, and never decreases, because
results are stored and searches are continued. For benchmarks that the planner `milp` can encode, this planner
proves for most of the other states that no satisfying plan exists.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.store import Key, Result, ResultStore, load
from benchmarks.training import benchmark_order, judged_states, pack, unpack
from stlc.cli.framework.output import say
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.problem.task import Task
from stlc.controller.run.config import HELD_OUT_SEED
from stlc.controller.run.run import Run
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.diagnostics import StlcError, UsageError

if TYPE_CHECKING:
    from stlc.rundir import RunDir

PASSES = 10
"""Default number of search passes over the open states."""
TRIES = 20_000
"""Maximum number of plans that one search evaluates for one state."""
LIBRARY = 4096
"""Maximum number of plans in the library."""
PROOF_SECONDS = 5.0
"""Processor time in seconds for one proof."""
PROVED_AT_ONCE = 20
"""Number of states after whose proofs the results are stored."""

_INPUTS = ("spec_sha256", "system_sha256", "held_out", "held_out_seed")


@dataclass(frozen=True, slots=True)
class KnownFeasible:
    """Known feasible share of one benchmark, on its held-out initial states.

    Attributes:
        benchmark: name of the specification.
        share: share of the states from which a satisfying plan is known.
        interval: 95 % Wilson interval of the share.
        open: number of states from which no satisfying plan is known.
        proved: number of states from which provably no plan exists; None if no proof was attempted.
        by_search: number of states from which only the search found a plan, and no policy.
        passes: number of searches so far.
        tries: number of plans that were evaluated for each open state.
        partial: n -> share among the first n states, for each n below the number of states that some policy
            was judged on.
    """

    benchmark: str
    share: float
    interval: tuple[float, float]
    open: int
    proved: int | None
    by_search: int
    passes: int
    tries: int
    partial: Mapping[int, float] = field(default_factory=dict)

    def share_among(self, judged: int) -> float:
        """Share among the first `judged` states."""
        return self.partial.get(judged, self.share)


def key_of(result: Result) -> Key:
    """Return the key of the held-out initial states of a result: all inputs from which they are made."""
    return Key(result["key"]["benchmark"], {name: result["key"][name] for name in _INPUTS})


def known_feasible(store: ResultStore, results: Iterable[Result]) -> dict[str, KnownFeasible]:
    """Return the known feasible share of each benchmark from stored results, without a new search.

    The share belongs to the held-out states of the first result of each benchmark. Results with other
    held-out states are ignored.
    """
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result["key"]["benchmark"], []).append(result)
    return {
        name: _known(name, store.find(key_of(own[0])) or _blank(own[0]), own)
        for name, own in sorted(groups.items(), key=lambda item: benchmark_order(item[0]))
    }


def search_on(
    own: Sequence[Result], store: ResultStore, *, passes: int = PASSES, run: RunDir | None = None
) -> None:
    """Search for plans from the states that no policy solves; store what is found after every pass.

    Args:
        own: results of one benchmark, at least one, all on the same held-out states.
        store: file of the search results.
        passes: total number of passes, including those of earlier calls.
        run: run whose policy gives the initial plans. With None, initial plans hold every control at the
            middle of its range.
    """
    key = key_of(own[0])
    entry: Mapping[str, Any] = store.find(key) or _blank(own[0])
    count = int(own[0]["key"]["held_out"])
    task = load(key.name)
    states = task.sample(count, seed=HELD_OUT_SEED, dtype=torch.float64)
    proved = _mask(entry.get("infeasible", pack([False] * count)), count)
    search = _Search.begin(task, states, torch.tensor(_solved(entry, own)), run, proved)
    found = torch.tensor(unpack(entry["found"], count))
    for number in range(int(entry["passes"]) + 1, passes + 1):
        found[search.go_on(number)] = True
        tries = int(entry["tries"]) + TRIES
        entry = store.put(
            key, {**_facts(entry), "passes": number, "tries": tries, "found": pack(found.tolist())}
        )
        say(f"{key.name}: search {number}, {len(search.open)} states without a plan")


def prove_on(own: Sequence[Result], store: ResultStore, *, seconds: float = PROOF_SECONDS) -> None:
    """Plan with `milp` from the states without a known plan; store the plans and proofs that it finds.

    A proof shows that no satisfying plan exists. Nothing is done for a benchmark that `milp` cannot encode as
    a mixed-integer linear program. States that were already tried with at least this much time are skipped.

    Args:
        own: results of one benchmark, at least one, all on the same held-out states.
        store: file of the search results.
        seconds: processor time per state.

    Raises:
        MissingError: R301, the solver HiGHS is not installed.
    """
    key = key_of(own[0])
    entry: Mapping[str, Any] = store.find(key) or _blank(own[0])
    count = int(own[0]["key"]["held_out"])
    none = pack([False] * count)
    asked = _mask(entry["asked"] if float(entry.get("proof_seconds", 0.0)) >= seconds else none, count)
    found, infeasible = _mask(entry["found"], count), _mask(entry.get("infeasible", none), count)
    left = (~(torch.tensor(_solved(entry, own)) | asked | infeasible)).nonzero()[:, 0]
    if not len(left) and "infeasible" in entry:
        return
    task = load(key.name)
    try:
        planner_named("milp").prepare(task)
    except UsageError:
        return
    states = task.sample(count, seed=HELD_OUT_SEED, dtype=torch.float64)
    for part in [*torch.split(left, PROVED_AT_ONCE)] or [left]:
        if len(part):
            result = plan(task, states[part], "milp", budget=PlanBudget(seconds))
            found[part], infeasible[part], asked[part] = result.satisfied, result.infeasible, True
        masks = {"found": found, "infeasible": infeasible, "asked": asked}
        packed = {name: pack(mask.tolist()) for name, mask in masks.items()}
        entry = store.put(key, {**_facts(entry), **packed, "proof_seconds": seconds})
        say(f"{key.name}: no plan exists for {int(infeasible.sum())} states, {int(asked.sum())} tried")


@dataclass(slots=True)
class _Search:
    """State of a search for satisfying plans.

    An open state is an initial state for which no satisfying plan has been found.

    Attributes:
        task: task of the benchmark.
        states: all initial states, (n, dim) float64.
        open: indices of the open states, (k,).
        plans: best plan so far for each open state, (k, T, m) float32.
        rho: robustness of these plans, (k,).
        library: satisfying plans of other states, (b, T, m) float32.
    """

    task: Task
    states: Tensor
    open: Tensor
    plans: Tensor
    rho: Tensor
    library: Tensor

    @classmethod
    def begin(cls, task: Task, states: Tensor, known: Tensor, run: RunDir | None, proved: Tensor) -> _Search:
        """Begin a search from the initial states `states`.

        Args:
            task: task of the benchmark.
            states: initial states, (n, dim).
            known: whether a satisfying plan from each state is known, (n,).
            run: run whose policy gives the initial plans, or None.
            proved: whether it is proved that no plan exists from each state, (n,).
        """
        still = (~known & ~proved).nonzero()[:, 0]
        plans = _first_plans(task, states, run)
        rho = task.judge(states[still], plans[still].double(), states=False).rho
        return cls(task, states, still, plans[still].float(), rho, plans[known][:LIBRARY].float())

    def go_on(self, number: int) -> Tensor:
        """Carry out pass number `number`; return the indices of the states that it solved.

        Passes with an even number begin with plans of other states instead of the best plans so far. This
        helps to leave local optima.
        """
        if not len(self.open):
            return self.open
        generator = torch.Generator().manual_seed(HELD_OUT_SEED + number)
        x0, start = self.states[self.open], self.plans
        if number % 2 == 0 and len(self.library):
            start = self.library[torch.randint(len(self.library), (len(self.open),), generator=generator)]
        searcher = Searcher(self.task, generator, target=1e-4)
        plans = searcher.repair(x0.float(), start, self.library, tries=TRIES).plans
        rho = self.task.judge(x0, plans.double(), states=False).rho
        better = rho > self.rho
        self.plans = torch.where(better[:, None, None], plans, self.plans)
        self.rho = torch.where(better, rho, self.rho)
        done = TOLERANCE.satisfied(self.rho)
        solved, self.library = self.open[done], torch.cat((self.plans[done], self.library))[:LIBRARY]
        self.open, self.plans, self.rho = self.open[~done], self.plans[~done], self.rho[~done]
        return solved


def _first_plans(task: Task, states: Tensor, run: RunDir | None) -> Tensor:
    """Return initial plans, (n, T, m), for the initial states `states`, (n, dim).

    They are the plans of the policy of `run`. If there is no such policy, every control is constant at the
    middle of its range.
    """
    if run is not None:
        try:
            return Run.open(run.path).policy.plan(states)
        except StlcError:
            pass  # the run was removed or is damaged: the search only takes longer
    middle = 0.5 * (task.system.control_low + task.system.control_high)
    return middle.expand(len(states), task.horizon, -1)


def _blank(result: Result) -> Result:
    return {"passes": 0, "tries": 0, "found": pack([False] * int(result["key"]["held_out"]))}


def _facts(entry: Mapping[str, Any]) -> Result:
    """Return the entries of a stored result that concern the search and the proofs."""
    names = ("passes", "tries", "found", "infeasible", "asked", "proof_seconds")
    return {name: entry[name] for name in names if name in entry}


def _mask(digits: str, count: int) -> Tensor:
    return torch.tensor(unpack(digits, count), dtype=torch.bool)


def _union(digits: Iterable[str], count: int) -> list[bool]:
    """Unpack several texts, each with `count` truth values, and combine them by an element-wise or."""
    return [any(flags) for flags in zip(*(unpack(each, count) for each in digits), strict=True)]


def _solved(entry: Mapping[str, Any], own: Sequence[Result]) -> list[bool]:
    """Return for each held-out state whether the search or any policy has found a satisfying plan."""
    count = int(own[0]["key"]["held_out"])
    return _union((entry["found"], *(_solved_by_policy(each, count) for each in own)), count)


def _solved_by_policy(result: Result, count: int) -> str:
    """Return the packed flags of the `count` held-out states that the policy of a training result solves.

    States on which it was not judged count as not solved.
    """
    judged = judged_states(result)
    return pack([*unpack(result["solved"], judged), *(False,) * (count - judged)])


def _known(benchmark: str, entry: Mapping[str, Any], own: Sequence[Result]) -> KnownFeasible:
    same = [each for each in own if key_of(each) == key_of(own[0])]
    count = int(own[0]["key"]["held_out"])
    solved = _solved(entry, same)
    known = sum(solved)
    return KnownFeasible(
        benchmark=benchmark,
        share=known / count,
        interval=wilson(known / count, count),
        open=count - known,
        proved=sum(unpack(entry["infeasible"], count)) if "infeasible" in entry else None,
        by_search=known - sum(_union((_solved_by_policy(each, count) for each in same), count)),
        passes=int(entry["passes"]),
        tries=int(entry["tries"]),
        partial={
            judged: sum(solved[:judged]) / judged
            for judged in sorted({*map(judged_states, same)})
            if judged < count
        },
    )
