"""How much of a benchmark can be done at all: a long search for plans where every policy failed.

The ceiling is the share of the held-out states for which some satisfying plan is known, one of a policy or
one that was found here. It never falls, and what was searched is kept, so a search goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from stlc.bench.cells import BENCHMARKS, load, pack, read_json, union, unpack
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.problem.task import Task, satisfied
from stlc.controller.training.config import HELD_OUT_SEED
from stlc.controller.training.local_search import Searcher
from stlc.controller.training.run import Run
from stlc.diagnostics import StlcError
from stlc.files import write_atomic
from stlc.jsontext import dumps
from stlc.provenance import git_state, hardware, versions
from stlc.rundir import now

if TYPE_CHECKING:
    from stlc.rundir import RunDir

FORMAT = "bench-ceilings/1"
FILE = "ceilings.json"
PASSES = 10
"""Searches for every state that is still open."""
TRIES = 20_000
"""Plans of a search for one state, at most."""
BANK = 4096
"""Plans of other states that a search may try, at most."""


@dataclass(frozen=True, slots=True)
class Ceiling:
    """What is known of one benchmark.

    Attributes:
        benchmark: name.
        share: of the held-out states that a satisfying plan is known for.
        interval: its 95 % Wilson interval.
        open: states without one.
        by_search: states that only the search here has solved.
        passes: searches so far.
        tries: plans that were tried for each open state.
    """

    benchmark: str
    share: float
    interval: tuple[float, float]
    open: int
    by_search: int
    passes: int
    tries: int


def ceilings_of(folder: Path, documents: Iterable[Mapping[str, Any]]) -> dict[str, Ceiling]:
    """The ceilings that are known, with what the policies of `documents` solve; nothing is searched."""
    kept = read_json(folder / FILE).get("benchmarks") or {}
    cells = list(documents)
    found = {}
    for benchmark in {*kept, *(document["benchmark"] for document in cells)}:
        own = [document for document in cells if document["benchmark"] == benchmark]
        entry = kept.get(benchmark) or _blank(own[0])
        found[benchmark] = _ceiling(benchmark, entry, [each for each in own if _same(entry, each)])
    return {name: found[name] for name in (*BENCHMARKS, *sorted(found)) if name in found}


def search_on(
    own: Sequence[Mapping[str, Any]],
    folder: Path,
    *,
    passes: int = PASSES,
    run: RunDir | None = None,
    told: Callable[[int, int], None] = lambda _number, _open: None,
) -> None:
    """Search for plans of the states that no policy solves, and keep what is found after every pass.

    Args:
        own: results of the cells of one benchmark, at least one, all on the same held-out states.
        folder: of the results.
        passes: in all, those of earlier calls included.
        run: whose policy's plans are where the search begins; without one, from plans that do nothing.
        told: called with the number of each pass and how many states are still open.
    """
    benchmark = str(own[0]["benchmark"])
    entry = (read_json(folder / FILE).get("benchmarks") or {}).get(benchmark) or {}
    if not _same(own[0], entry):
        entry = _blank(own[0])
    count = int(entry["held_out"])
    flags = _known(entry, own)
    task = load(benchmark)
    states = task.sample(count, seed=HELD_OUT_SEED, dtype=torch.float64)
    hunt = _Hunt.begin(task, states, torch.tensor(flags), run)
    found = torch.tensor(unpack(entry["found"], count))
    for number in range(int(entry["passes"]) + 1, passes + 1):
        found[hunt.search(number)] = True
        tries = int(entry["tries"]) + TRIES
        entry = {**entry, "passes": number, "tries": tries, "found": pack(found.tolist())}
        _keep(folder, benchmark, entry, own)
        told(number, len(hunt.open))
    _keep(folder, benchmark, entry, own)


@dataclass(slots=True)
class _Hunt:
    """The states that are still open and the best plan of each.

    Attributes:
        task: of the benchmark.
        states: all of them, (n, dim) float64.
        open: indices of those without a satisfying plan, (k,).
        plans: the best so far of each open one, (k, T, m) float32.
        rho: of these, (k,).
        bank: plans of solved states, (b, T, m) float32.
    """

    task: Task
    states: Tensor
    open: Tensor
    plans: Tensor
    rho: Tensor
    bank: Tensor

    @classmethod
    def begin(cls, task: Task, states: Tensor, known: Tensor, run: RunDir | None) -> _Hunt:
        """Where nothing was searched yet."""
        still = (~known).nonzero()[:, 0]
        plans = _first_plans(task, states, run)
        bank = plans[known][:BANK].float()
        rho = task.judge(states[still], plans[still].double(), states=False).rho
        return cls(task, states, still, plans[still].float(), rho, bank)

    def search(self, number: int) -> Tensor:
        """One pass; returns the indices of the states that it solved.

        Every other pass starts at plans of other states instead of the best so far: a climb that is stuck
        stays stuck.
        """
        if not len(self.open):
            return self.open
        generator = torch.Generator().manual_seed(HELD_OUT_SEED + number)
        x0, start = self.states[self.open], self.plans
        if number % 2 == 0 and len(self.bank):
            start = self.bank[torch.randint(len(self.bank), (len(self.open),), generator=generator)]
        searcher = Searcher(self.task, generator, enough=1e-4)
        plans = searcher.repair(x0.float(), start, self.bank, tries=TRIES).plans
        rho = self.task.judge(x0, plans.double(), states=False).rho
        better = rho > self.rho
        self.plans = torch.where(better[:, None, None], plans, self.plans)
        self.rho = torch.where(better, rho, self.rho)
        done = satisfied(self.rho)
        solved, self.bank = self.open[done], torch.cat((self.plans[done], self.bank))[:BANK]
        self.open, self.plans, self.rho = self.open[~done], self.plans[~done], self.rho[~done]
        return solved


def _first_plans(task: Task, states: Tensor, run: RunDir | None) -> Tensor:
    """Plans to begin with, (n, T, m): a policy's, else the middle of every control."""
    if run is not None:
        try:
            return Run.open(run.path).policy.plan(states)
        except StlcError:
            pass  # the run was removed, or is damaged: the search only takes longer
    middle = 0.5 * (task.system.control_low + task.system.control_high)
    return middle.expand(len(states), task.horizon, -1)


# ----------------------------------------------------------------------- what is kept

_KEYS = ("spec_sha256", "system_sha256", "held_out", "held_out_seed")


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return all(one.get(key) == other.get(key) for key in _KEYS)


def _blank(facts: Mapping[str, Any]) -> dict[str, Any]:
    nothing = pack([False] * int(facts["held_out"]))
    return {**{key: facts[key] for key in _KEYS}, "passes": 0, "tries": 0, "found": nothing}


def _known(entry: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> list[bool]:
    count = int(entry["held_out"])
    return union((unpack(entry["found"], count), *(unpack(each["solved"], count) for each in own)), count)


def _ceiling(benchmark: str, entry: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> Ceiling:
    count = int(entry["held_out"])
    known = sum(_known(entry, own))
    policies = sum(union((unpack(each["solved"], count) for each in own), count))
    share = known / count
    return Ceiling(
        benchmark=benchmark,
        share=share,
        interval=wilson(share, count),
        open=count - known,
        by_search=known - policies,
        passes=int(entry["passes"]),
        tries=int(entry["tries"]),
    )


def _keep(folder: Path, benchmark: str, entry: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> None:
    document = read_json(folder / FILE)
    kept = document.get("benchmarks") or {}
    ceiling = _ceiling(benchmark, entry, [each for each in own if _same(entry, each)])
    facts = {"ceiling": ceiling.share, "interval": list(ceiling.interval), "open": ceiling.open}
    made = {"date": now(), "versions": versions(), "git": git_state(), "hardware": hardware()}
    kept[benchmark] = {**entry, **facts, "by_search": ceiling.by_search, **made}
    text = dumps({"format": FORMAT, "benchmarks": kept}, indent=1)
    write_atomic(folder / FILE, text + "\n")
