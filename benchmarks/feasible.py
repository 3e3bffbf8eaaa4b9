"""Known feasible share of a benchmark: a long plan search for the states where every policy failed.

It is the share of the held-out states with a known satisfying plan, of a policy or of this search: a lower
bound of the feasible share. It never decreases; results are stored, so that a search can be continued. Where
the planner `milp` encodes the benchmark, it proves of most of the other states that no plan exists.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from benchmarks.store import Key, Result, ResultStore, load
from benchmarks.training import benchmark_order, pack, unpack
from stlc.cli.framework.output import say
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.planning.planner import PlanBudget, plan, planner_named
from stlc.controller.problem.task import Task, satisfied
from stlc.controller.training.config import HELD_OUT_SEED
from stlc.controller.training.local_search import Searcher
from stlc.controller.training.run import Run
from stlc.diagnostics import StlcError, UsageError

if TYPE_CHECKING:
    from stlc.rundir import RunDir

PASSES = 10
"""Default number of search passes over the open states."""
TRIES = 20_000
"""Maximum evaluations of a search for one state."""
LIBRARY = 4096
"""Maximum size of the plan library."""
PROOF_SECONDS = 5.0
"""Processor time of a proof."""
PROVED_AT_ONCE = 20
"""States between two stored results of proofs."""

_INPUTS = ("spec_sha256", "system_sha256", "held_out", "held_out_seed")


@dataclass(frozen=True, slots=True)
class KnownFeasible:
    """The known feasible share of one benchmark.

    Attributes:
        benchmark: name.
        share: of the held-out states with a known satisfying plan.
        interval: its 95 % Wilson interval.
        open: states without one.
        proved: of these, states from which no plan exists, by proof; None where none was sought.
        by_search: states solved only by this search.
        passes: searches so far.
        tries: evaluated plans for each open state.
    """

    benchmark: str
    share: float
    interval: tuple[float, float]
    open: int
    proved: int | None
    by_search: int
    passes: int
    tries: int


def key_of(result: Result) -> Key:
    """The key of a result's held-out states: all their inputs."""
    return Key(result["key"]["benchmark"], {name: result["key"][name] for name in _INPUTS})


def known_feasible(store: ResultStore, results: Iterable[Result]) -> dict[str, KnownFeasible]:
    """The stored known feasible share of each benchmark, without a search.

    It belongs to the held-out states of the first of the `results` of the benchmark; others are ignored.
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
    """Search for plans of the states that no policy solves; store the results after every pass.

    Args:
        own: results of one benchmark, at least one, all on the same held-out states.
        store: of search results.
        passes: total number, earlier calls included.
        run: its policy gives the initial plans; without one they are constant mid-range controls.
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
    """Plan by `milp` from the states without a known plan; store proofs that none exists, and plans found.

    A benchmark without a mixed-integer linear form is left as it is. States that were tried before with as
    much time are not tried again.

    Args:
        own: results of one benchmark, at least one, all on the same held-out states.
        store: of search results.
        seconds: processor time of a state.

    Raises:
        MissingError: R301, HiGHS is not installed.
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
    """State of a search: the open states and the best plan of each.

    Attributes:
        task: of the benchmark.
        states: all of them, (n, dim) float64.
        open: indices of those without a satisfying plan, (k,).
        plans: the best so far of each open one, (k, T, m) float32.
        rho: robustness of these, (k,).
        library: plans of solved states, (b, T, m) float32.
    """

    task: Task
    states: Tensor
    open: Tensor
    plans: Tensor
    rho: Tensor
    library: Tensor

    @classmethod
    def begin(cls, task: Task, states: Tensor, known: Tensor, run: RunDir | None, proved: Tensor) -> _Search:
        """Initialise a search; the states that were `proved` infeasible are not open."""
        still = (~known & ~proved).nonzero()[:, 0]
        plans = _first_plans(task, states, run)
        rho = task.judge(states[still], plans[still].double(), states=False).rho
        return cls(task, states, still, plans[still].float(), rho, plans[known][:LIBRARY].float())

    def go_on(self, number: int) -> Tensor:
        """Run one pass; return the indices of the newly solved states.

        Every other pass starts at plans of other states instead of the best so far, to leave local optima.
        """
        if not len(self.open):
            return self.open
        generator = torch.Generator().manual_seed(HELD_OUT_SEED + number)
        x0, start = self.states[self.open], self.plans
        if number % 2 == 0 and len(self.library):
            start = self.library[torch.randint(len(self.library), (len(self.open),), generator=generator)]
        searcher = Searcher(self.task, generator, enough=1e-4)
        plans = searcher.repair(x0.float(), start, self.library, tries=TRIES).plans
        rho = self.task.judge(x0, plans.double(), states=False).rho
        better = rho > self.rho
        self.plans = torch.where(better[:, None, None], plans, self.plans)
        self.rho = torch.where(better, rho, self.rho)
        done = satisfied(self.rho)
        solved, self.library = self.open[done], torch.cat((self.plans[done], self.library))[:LIBRARY]
        self.open, self.plans, self.rho = self.open[~done], self.plans[~done], self.rho[~done]
        return solved


def _first_plans(task: Task, states: Tensor, run: RunDir | None) -> Tensor:
    """Initial plans, (n, T, m): a policy's, else the middle of every control."""
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
    """The entries of a stored result on search and proof."""
    names = ("passes", "tries", "found", "infeasible", "asked", "proof_seconds")
    return {name: entry[name] for name in names if name in entry}


def _mask(digits: str, count: int) -> Tensor:
    return torch.tensor(unpack(digits, count), dtype=torch.bool)


def _union(digits: Iterable[str], count: int) -> list[bool]:
    """Element-wise or of packed sets of `count` truth values."""
    return [any(flags) for flags in zip(*(unpack(each, count) for each in digits), strict=True)]


def _solved(entry: Mapping[str, Any], own: Sequence[Result]) -> list[bool]:
    """Mask of the states with a plan of the search or of any policy."""
    return _union((entry["found"], *(each["solved"] for each in own)), int(own[0]["key"]["held_out"]))


def _known(benchmark: str, entry: Mapping[str, Any], own: Sequence[Result]) -> KnownFeasible:
    same = [each for each in own if key_of(each) == key_of(own[0])]
    count = int(own[0]["key"]["held_out"])
    known = sum(_solved(entry, same))
    return KnownFeasible(
        benchmark=benchmark,
        share=known / count,
        interval=wilson(known / count, count),
        open=count - known,
        proved=sum(unpack(entry["infeasible"], count)) if "infeasible" in entry else None,
        by_search=known - sum(_union((each["solved"] for each in same), count)),
        passes=int(entry["passes"]),
        tries=int(entry["tries"]),
    )
