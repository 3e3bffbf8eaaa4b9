"""Failing drives of trained policies: random search beside falsification, and `train --falsify`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from time import process_time
from typing import Annotated, Any

import typer

from benchmarks.deployments import NOMINAL, key_of
from benchmarks.drives import WITH_BACKUP
from benchmarks.measured import measured
from benchmarks.options import OnlyOption, Output, Training, chosen
from benchmarks.store import Key, Result, ResultStore
from benchmarks.table import Columns, Table, listed, provenance, publish
from benchmarks.timing import one_thread
from benchmarks.training import Cell, Length, Place, filled
from stlc.assurance.drive_search import DRIVE_SEARCH_VERSION, search_drives
from stlc.assurance.drive_simulator import DriveSimulator
from stlc.cli.framework.program import command
from stlc.controller.deployment.batched import Setting
from stlc.controller.run.run import Run
from stlc.controller.training.failures import FAILURES_VERSION
from stlc.registry import GUARDS
from stlc.rundir import RunDir

ORDER = ("traffic", "ship_safe", "manipulation", "navigation", "reach_n_avoid", "ship_track")
"""Benchmarks in the order in which they are measured."""
COUPLED = ("traffic",)
"""Benchmarks whose agents influence each other: their searches keep all agents of a world."""
BATCH = 16
SEARCHED, FRESH = 0, 4_000_000
"""Seeds of the searches, and of the fresh drives, on which nothing is tuned."""
FALSIFYING = {"falsify": f"falsify{FAILURES_VERSION}"}
AFTER = f"guided:falsify{FAILURES_VERSION}"
"""Name of the second training in results."""
_TRAINING, _OUTPUT = Training(clock="processor", seeds="0"), Output(Path("docs/falsification.md"))
TEXT = """\
Written by `python -m benchmarks failures` from `benchmarks/results/failures.json`. `random` and `falsify`:
least robustness over all requirements, and failing drives, of the same number of simulations of the policy
that was trained without falsification. A simulation is a drive of one agent, in traffic a world of 20 cars.
`fresh`: share of failing drives among fresh ones, with all agents of a world, for that policy and for one
that was trained with `--falsify` in the same time; intervals of 95 % (Wilson) take drives as independent.
Benchmarks and entries that are missing were not measured yet.
"""
SEEDS_TEXT = """\
Failing fresh drives of policies that were trained with several seeds, without guard: mean over the seeds, and
each of them. Seeds differ by more than the intervals above, which are those of one policy.
"""


@dataclass(frozen=True, slots=True)
class Drives:
    """Simulations of one policy in its world, chosen by a search or drawn.

    Attributes:
        folder: folder of the run.
        benchmark: name of the specification.
        guard: kind of guard.
        random: whether the simulations are drawn rather than searched.
        simulations: number of simulations.
        agents: agents of each simulation.
        steps: steps of each drive at most; None: as the system file says.
        seed: seed of the search.
        trained: `guided`, or `AFTER`.
        training_seed: seed of the training.
    """

    folder: RunDir
    benchmark: str
    guard: str
    random: bool
    simulations: int
    agents: int
    steps: int | None
    seed: int
    trained: str
    training_seed: int = 0

    @property
    def name(self) -> str:
        """Name under which the result is stored, such as `traffic-none-falsify-100`."""
        what = "fresh" if self.seed == FRESH else "random" if self.random else "falsify"
        own = self.trained.replace(":", "-")
        other = [f"seed{self.training_seed}"] if self.training_seed else []
        return "-".join([self.benchmark, own, self.guard, what, str(self.simulations), *other])

    @property
    def setting(self) -> Setting:
        """Agents, steps and replanning period."""
        test = Run.open(self.folder.path).task.system.decl.test
        return Setting((0,), self.agents, min(self.steps or test.steps, test.steps), test.replan)

    @property
    def key(self) -> Key:
        """Key under which the result is stored."""
        run = Run.open(self.folder.path)
        values = dict(key_of(run, NOMINAL, self.guard, replace(self.setting, seeds=())).values)
        own = {"benchmark": self.benchmark, "trained": self.trained, "random": self.random, "seed": self.seed}
        own |= {"training_seed": self.training_seed} if self.training_seed else {}
        version = None if self.random else DRIVE_SEARCH_VERSION
        sizes = {"simulations": self.simulations, "search_version": version}
        return Key(self.name, {**values, **own, **sizes})

    def measure(self) -> Result:
        """Simulate, and return counts, the least robustness, and the processor time in seconds."""
        simulator = DriveSimulator(Run.open(self.folder.path), self.guard, self.setting, BATCH)
        began = process_time()
        found = search_drives(simulator, self.simulations, seed=self.seed, random=self.random)
        least = found.margins.min((0, 1))
        return {
            "drives": found.failing.size,
            "failing": int(found.failing.sum()),
            "least": found.least,
            "requirements": dict(zip(simulator.requirements, least.tolist(), strict=True)),
            "seconds": process_time() - began,
        }


@dataclass(frozen=True, slots=True)
class FailuresRow:
    """Failing drives of a benchmark under one guard.

    Attributes:
        benchmark: name of the specification.
        guard: kind of guard.
        simulations: number of simulations of each search.
        agents: agents of each of them.
        steps: steps of each drive.
        least_random: least robustness of the drawn simulations.
        least_falsify: least robustness of the searched ones.
        failing_random: failing drives among the drawn simulations.
        failing_falsify: failing drives among the searched ones.
        searched: number of drives of each search.
        fresh: number of fresh drives.
        before: failing ones among them without falsification in the training.
        after: failing ones with it; None: not trained yet.
    """

    benchmark: str
    guard: str
    simulations: int
    agents: int
    steps: int
    least_random: float
    least_falsify: float
    failing_random: int
    failing_falsify: int
    searched: int
    fresh: int
    before: int
    after: int | None


def _share(failing: int | None, drives: int) -> str:
    from stlc.controller.evaluation.held_out import wilson

    if failing is None:
        return ""
    low, high = wilson(failing / drives, drives)
    return f"{100 * failing / drives:.2f} % [{100 * low:.2f}, {100 * high:.2f}]"


COLUMNS: Columns[FailuresRow] = {
    "benchmark": "{benchmark}",
    "guard": "{guard}",
    "simulations x agents x steps": "{simulations} x {agents} x {steps}",
    "least: random": "{least_random:.4g}",
    "least: falsify": "{least_falsify:.4g}",
    "failing: random": "{failing_random} of {searched}",
    "failing: falsify": "{failing_falsify} of {searched}",
    "fresh drives": "{fresh}",
    "fresh: without": lambda row: _share(row.before, row.fresh),
    "fresh: `--falsify`": lambda row: _share(row.after, row.fresh),
}


@dataclass(frozen=True, slots=True)
class SeedRow:
    """Share of failing drives of policies that differ by the seed of the training, without guard.

    Attributes:
        benchmark: name of the specification.
        seeds: seeds of the trainings.
        before: share of failing fresh drives for each seed, without falsification in the training.
        after: the same with it.
    """

    benchmark: str
    seeds: tuple[int, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


def _mean(shares: Sequence[float]) -> str:
    each = ", ".join(f"{100 * share:.2f}" for share in shares)
    return f"{100 * fmean(shares):.2f} % ({each})"


SEED_COLUMNS: Columns[SeedRow] = {
    "benchmark": "{benchmark}",
    "seeds": lambda row: ", ".join(map(str, row.seeds)),
    "without": lambda row: _mean(row.before),
    "`--falsify`": lambda row: _mean(row.after),
}


@command(
    "python -m benchmarks failures",
    "python -m benchmarks failures --seeds 0..2 --others 5000",
    "python -m benchmarks failures --only traffic --simulations 200 --fresh 2000",
)
def failures(
    only: OnlyOption = None,
    simulations: Annotated[
        int, typer.Option("--simulations", metavar="N", min=1, help="Of each search.")
    ] = 2000,
    fresh: Annotated[int, typer.Option("--fresh", metavar="N", min=1, help="Fresh drives, about.")] = 20_000,
    others: Annotated[
        int, typer.Option("--others", metavar="N", min=1, help="Fresh drives with further seeds, about.")
    ] = 5000,
    drive_steps: Annotated[
        int | None, typer.Option("--drive-steps", metavar="N", min=1, help="Of each drive, at most.")
    ] = None,
    retrain: Annotated[
        bool, typer.Option("--retrain/--no-retrain", help="Also train with --falsify, and drive.")
    ] = True,
    training: Training = _TRAINING,
    output: Output = _OUTPUT,
) -> None:
    """Search for failing drives of the benchmarks' policies, at random and by falsification.

    The policies are trained for 60 s of processor time, without and with `--falsify`. With further seeds
    (`--seeds`) they are trained again, and drive without guard, to tell the effect of `--falsify` from that
    of the seed. Trainings and drives are stored when they end, and not repeated while specification, system
    and method are the same.
    """
    store, place = ResultStore("failures", training.out), training.place("failure_trainings")
    (seed, length), *more = training.seeds_and_lengths((60.0,))
    failed: list[dict[str, str]] = []
    new = 0
    with one_thread():
        for benchmark in sorted(chosen(only, ORDER, "benchmark"), key=ORDER.index):
            made = _cells(benchmark, seed, length, retrain=retrain, held_out=training.held_out)
            further = [
                cell
                for each, time in more
                for cell in _cells(benchmark, each, time, retrain=retrain, held_out=training.held_out)
            ]
            done = filled([*made, *further], place)
            drives = [
                *_drives(made, place, simulations, fresh, drive_steps),
                *_drives_of_others(further, place, others, drive_steps),
            ]
            found = measured(drives, store, lambda each: each.measure(), doing="driving", told=_told)
            failed += [*done.failed, *found.failed]
            new += found.new

    def section() -> list[str]:
        results = [*store.all().values()]
        of_seeds = listed("failures of seeds", seed_rows_of(results), SEED_COLUMNS).markdown()
        return [TEXT, *table().markdown(), "", SEEDS_TEXT, *of_seeds, "", *provenance(results, "searches")]

    def table() -> Table[Any, FailuresRow]:
        return listed("failures", rows_of([*store.all().values()]), COLUMNS)

    publish("failures", output, section, {"rows": table()}, driven=new, failed=failed)


def _cells(benchmark: str, seed: int, length: Length, *, retrain: bool, held_out: int) -> list[Cell]:
    """The trainings of a benchmark: without falsification, then with it."""
    before = Cell(benchmark, "guided", seed, length, held_out)
    return [before, replace(before, options=FALSIFYING)] if retrain else [before]


def _drives(
    cells: Sequence[Cell], place: Place, simulations: int, fresh: int, steps: int | None
) -> Iterator[Drives]:
    """The simulations of a benchmark whose trainings are finished."""
    for guard in WITH_BACKUP:
        for cell in cells:
            own = _fresh(cell, place, guard, fresh, steps)
            if own is None:
                continue
            if not cell.options:
                alone = own.agents if cell.benchmark in COUPLED else 1
                search = replace(own, simulations=simulations, agents=alone, seed=SEARCHED)
                yield from (search, replace(search, random=False))
            yield own


def _drives_of_others(cells: Sequence[Cell], place: Place, fresh: int, steps: int | None) -> Iterator[Drives]:
    """The fresh drives of trainings with further seeds, without guard."""
    for cell in cells:
        own = _fresh(cell, place, GUARDS.default, fresh, steps)
        if own is not None:
            yield own


def _fresh(cell: Cell, place: Place, guard: str, fresh: int, steps: int | None) -> Drives | None:
    """About `fresh` drives of the policy of a training; None if it is not finished."""
    folder = place.newest_run(cell.key)
    if folder is None or folder.status != "finished":
        return None
    agents = Run.open(folder.path).task.system.decl.test.agents
    return Drives(
        *(folder, cell.benchmark, guard, True, -(-fresh // agents), agents, steps, FRESH),
        trained=cell.contender,
        training_seed=cell.seed,
    )


def _told(result: Result) -> str:
    return f"{result['failing']} of {result['drives']} drives fail, {result['seconds']:.0f} s"


def rows_of(results: Sequence[Result]) -> list[FailuresRow]:
    """Rows of the stored results, in the order of the benchmarks; incomplete ones are left out.

    A row compares the largest two searches of equal size, and equal numbers of fresh drives of both
    trainings. Of several versions of `train --falsify` the newest counts.
    """
    rows = []
    for benchmark in ORDER:
        for guard in WITH_BACKUP:
            own = [each for each in results if _is_of(each, benchmark, guard) and not _seed_of(each)]
            searches = {_size(each): each for each in own if each["key"]["seed"] != FRESH}
            sizes = [count for count, random in searches if random and (count, False) in searches]
            fresh = [each for each in own if each["key"]["seed"] == FRESH]
            before = max(
                (each for each in fresh if each["key"]["trained"] == "guided"), key=_drives_of, default=None
            )
            if not sizes or before is None:
                continue
            random, searched = searches[max(sizes), True], searches[max(sizes), False]
            after = [each for each in fresh if _falsified(each) and each["drives"] == before["drives"]]
            newest = max(after, key=lambda each: str(each["key"]["trained"]), default=None)
            key = searched["key"]
            rows.append(
                FailuresRow(
                    *(benchmark, guard, key["simulations"], key["agents"], key["steps"]),
                    *(random["least"], searched["least"], random["failing"], searched["failing"]),
                    *(searched["drives"], before["drives"], before["failing"]),
                    after=None if newest is None else newest["failing"],
                )
            )
    return rows


def seed_rows_of(results: Sequence[Result]) -> list[SeedRow]:
    """Rows of the benchmarks that were trained with several seeds, both without and with `--falsify`.

    Of several results of a seed the one with most drives counts, of several versions of `train --falsify` the
    newest.
    """
    rows = []
    for benchmark in ORDER:
        fresh = [
            each
            for each in results
            if _is_of(each, benchmark, GUARDS.default) and each["key"]["seed"] == FRESH
        ]
        fresh.sort(key=_drives_of)
        newest = max((str(each["key"]["trained"]) for each in fresh if _falsified(each)), default="")
        shares = [
            {
                _seed_of(each): each["failing"] / each["drives"]
                for each in fresh
                if each["key"]["trained"] == one
            }
            for one in ("guided", newest)
        ]
        seeds = tuple(sorted({*shares[0]} & {*shares[1]}))
        if len(seeds) > 1:
            rows.append(SeedRow(benchmark, seeds, *(tuple(own[seed] for seed in seeds) for own in shares)))
    return rows


def _falsified(result: Result) -> bool:
    return bool(result["key"]["trained"] != "guided")


def _seed_of(result: Result) -> int:
    """Seed of the training."""
    return int(result["key"].get("training_seed", 0))


def _is_of(result: Result, benchmark: str, guard: str) -> bool:
    key = result["key"]
    return bool(key["benchmark"] == benchmark and key["guard"] == guard)


def _size(result: Result) -> tuple[int, bool]:
    """Number of simulations of a search, and whether they were drawn."""
    return int(result["key"]["simulations"]), bool(result["key"]["random"])


def _drives_of(result: Result) -> int:
    return int(result["drives"])
