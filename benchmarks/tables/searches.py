"""Contribution of each part of the falsification search: simulations until a violation without it.

The problems in `benchmarks/problems/` played no part in the choice of the search: linear, switched and neural
plants and loops with PID controllers, from easy to hard. Rows of the ARCH-COMP category stand beside them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist, fmean, stdev
from typing import Annotated, Any

import typer

from benchmarks.options import OnlyOption, Output, ResultsOption, chosen
from benchmarks.store import RESULTS, Key, Result, ResultStore, inputs_of
from benchmarks.table import Columns, Table, listed, provenance, publish
from benchmarks.tables.falsify import CASES, side_by_side
from benchmarks.timing import one_thread
from stlc.assurance.falsify import FALSIFIER_VERSION, ViolationSearch
from stlc.assurance.model_simulator import ModelSimulator
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.files import File
from stlc.options import parse_seeds

PROBLEMS = Path(__file__).parent.parent / "problems"
SIMULATIONS = 300
WHOLE = "nothing"
TEXT = """\
Written by `python -m benchmarks searches` from `benchmarks/results/searches.json`: simulations until a
violation that remains at half the time step (300 if there is none), without a part of the search. `ratio`:
geometric mean, over all problems and seeds, of this number divided by that of the whole search; above 1 the
part is missed. Intervals of 95 % take problems as independent. `nothing found`: searches without a violation.
"""
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class Problem:
    """Requirement to violate.

    Attributes:
        spec: file of the specification.
        requirement: its requirement.
        changes: keys of the system file that are set, name -> text.
        competition: instance of the ARCH-COMP category; None for a problem of our own.
    """

    spec: Path
    requirement: str
    changes: tuple[tuple[str, str], ...] = ()
    competition: int | None = None

    @property
    def name(self) -> str:
        """Requirement, and instance of the competition."""
        return self.requirement + ("" if self.competition is None else f", instance {self.competition}")


REMOVALS = (
    *(WHOLE, "alternating vertices", "constant vertices", "perturbation"),
    *("coarse", "surrogate", "periodic", "gradient"),
)
"""Strategies of the search, each left out alone; the first one is the whole search."""
ROWS = (
    *("AT6a, instance 2", "AT6b, instance 2", "AT6c, instance 2", "AT51, instance 2", "CC5, instance 2"),
    *("CCx, instance 1", "NN, instance 1", "NNx, instance 1", "SC, instance 1", "AFC27, instance 2"),
)
"""Rows of the competition, neither trivial nor long."""


def problems() -> tuple[Problem, ...]:
    """All problems: those in `benchmarks/problems/`, then `ROWS`."""
    files = sorted(PROBLEMS.glob("*.stl"))
    own = [
        Problem(file, rule.name)
        for file in files
        for rule in ModelSimulator.load(str(file), None, {}).task.rules
    ]
    cases = {case.name: case for case in CASES}
    return (
        *own,
        *(
            Problem(File.SPECS / "arch" / f"{case.spec}.stl", case.requirement, case.changes, case.instance)
            for case in map(cases.__getitem__, ROWS)
        ),
    )


@dataclass(frozen=True)
class Comparison:
    """Searches without a part, beside whole ones with the same seeds.

    Attributes:
        removal: name of the part.
        own: logarithms of the ratios of simulations, the mean of each of our problems.
        competition: the same for rows of the competition.
        missed: searches that found nothing.
        seeds: number of searches of each problem.
    """

    removal: str
    own: tuple[float, ...]
    competition: tuple[float, ...]
    missed: int
    seeds: int

    @property
    def ratios(self) -> str:
        """Ratio of geometric means on our problems."""
        return _ratio(self.own)

    @property
    def competition_ratios(self) -> str:
        """The same on rows of the competition."""
        return _ratio(self.competition)

    @property
    def all_ratios(self) -> str:
        """The same on all problems."""
        return _ratio(self.own + self.competition)


COLUMNS: Columns[Comparison] = {
    "without": "{removal}",
    "ratio": "{all_ratios}",
    "own problems": "{ratios}",
    "competition": "{competition_ratios}",
    "nothing found": "{missed}",
    "seeds": "{seeds}",
}


def _ratio(logarithms: Sequence[float]) -> str:
    """Ratio of geometric means, with its interval of 95 %."""
    if len(logarithms) < 2:
        return ""
    mean, error = fmean(logarithms), stdev(logarithms) / math.sqrt(len(logarithms))
    low, high = (math.exp(mean + sign * NormalDist().inv_cdf(0.975) * error) for sign in (-1.0, 1.0))
    return f"{math.exp(mean):.2f} [{low:.2f}, {high:.2f}]"


@command("python -m benchmarks searches", "python -m benchmarks searches --only periodic,coarse --seeds 0..2")
def searches(
    only: OnlyOption = None,
    seeds: Annotated[str, typer.Option(metavar="SEEDS", help="Seeds of the searches.")] = "0..9",
    out: ResultsOption = RESULTS,
    output: Output = _OUTPUT,
) -> None:
    """Search for violations without one part of the search at a time, and write the table.

    Results are kept.
    """
    names = chosen(only, REMOVALS[1:], "part of the search")
    store, drawn, every = ResultStore("searches", out), parse_seeds(seeds), problems()
    with one_thread():
        for problem in every:
            simulator = ModelSimulator.load(str(problem.spec), None, dict(problem.changes))
            whole = _searched(problem, simulator, WHOLE, drawn, store, {})
            known = {each["seed"]: each for each in whole["searches"]}
            for removal in names:
                _searched(problem, simulator, removal, drawn, store, known)

    def section() -> list[str]:
        stored = store.all()
        made = provenance([*stored.values()], "results")
        return [TEXT, *_table(stored, every).markdown(), "", *made]

    publish("searches", output, section, {"rows": _table(store.all(), every)})


def _searched(
    problem: Problem,
    simulator: ModelSimulator,
    removal: str,
    seeds: Sequence[int],
    store: ResultStore,
    whole: Mapping[int, Mapping[str, Any]],
) -> Result:
    """Searches of a problem without a part, stored or carried out now and stored.

    `whole`: seed -> whole search. One in which the part had no turn is the same without it; only the turns of
    the gradient count even where there is none.
    """
    name = _name(problem, removal)
    values = {
        **inputs_of(simulator.task),
        "changes": dict(problem.changes),
        "seeds": list(seeds),
        "simulations": SIMULATIONS,
        "version": FALSIFIER_VERSION,
    }

    def compute() -> Result:
        unused = {} if removal == "gradient" else whole
        found = {seed: each for seed, each in unused.items() if removal not in each["strategies"]}
        requirement = simulator.requirements.index(problem.requirement)
        going = {
            seed: ViolationSearch(simulator, requirement, seed, without=(removal,))
            for seed in seeds
            if seed not in found
        }
        side_by_side(simulator, [*going.values()], SIMULATIONS)
        for seed, search in going.items():
            result, best = search.result(shrinks=False), search.found
            found[seed] = {
                "seed": seed,
                "simulations": min(result.simulations, SIMULATIONS),
                "strategy": None if best is None else best.strategy,
                "strategies": result.strategies,
            }
        say(f"{name}: {len(going)} searches, {fmean(each['simulations'] for each in found.values()):.1f}")
        return {"searches": [found[seed] for seed in seeds]}

    return store.get(Key(name, values), compute)


def _table(stored: Mapping[str, Result], every: Sequence[Problem]) -> Table[Any, Comparison]:
    """Table of the stored searches, a row for each part."""
    rows = [_compared(removal, stored, every) for removal in REMOVALS]
    return listed("searches", [row for row in rows if row.seeds], COLUMNS)


def _compared(removal: str, stored: Mapping[str, Result], every: Sequence[Problem]) -> Comparison:
    """Stored searches without a part beside the whole ones."""
    ratios: dict[bool, list[float]] = {False: [], True: []}
    missed, seeds = 0, 0
    for problem in every:
        if (without := stored.get(_name(problem, removal))) is None:
            continue
        whole = {each["seed"]: each["simulations"] for each in stored[_name(problem, WHOLE)]["searches"]}
        common = [each for each in without["searches"] if each["seed"] in whole]
        missed, seeds = missed + sum(each["strategy"] is None for each in common), len(common)
        logarithms = [math.log(each["simulations"] / whole[each["seed"]]) for each in common]
        ratios[problem.competition is not None].append(fmean(logarithms))
    return Comparison(removal, tuple(ratios[False]), tuple(ratios[True]), missed, seeds)


def _name(problem: Problem, removal: str) -> str:
    return f"{problem.name}, without {removal}"
