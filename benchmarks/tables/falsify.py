"""Falsification of the ARCH-COMP models: simulations to a counterexample, beside published counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Annotated, Any

import typer

from benchmarks.options import OnlyOption, ResultsOption
from benchmarks.store import RESULTS, Key, ResultStore, inputs_of
from benchmarks.table import Columns, Table, show
from benchmarks.timing import one_thread
from stlc.assurance.falsify import FALSIFIER_VERSION, SearchBudget
from stlc.assurance.falsify import falsify as search
from stlc.assurance.model_simulator import ModelSimulator
from stlc.cli.framework.options import JsonOption, parse_seeds
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.files import SPECS

SIMULATIONS = 300


@dataclass(frozen=True, slots=True)
class Case:
    """Requirement of a model, with the inputs of one instance of the competition.

    Attributes:
        spec: name of the specification in `specs/arch`.
        requirement: its requirement.
        published: counts of other tools, with their source.
        changes: keys of the system file that make the instance, name -> text; the file is instance 2.
    """

    spec: str
    requirement: str
    published: str = ""
    changes: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """Requirement and instance."""
        return f"{self.requirement}, instance {1 if self.changes or self.spec in POINTS else 2}"


FALCAUN = "FalCAuN 2024"
FINER = {
    "transmission": (("inputs.throttle.pieces", "12"), ("inputs.brake.pieces", "12")),
    "chasing_cars": (
        *(("inputs.throttle.pieces", "10"), ("inputs.throttle.interpolate", "linear")),
        *(("inputs.brake.pieces", "10"), ("inputs.brake.interpolate", "linear")),
    ),
    "neural_maglev": (("inputs.ref.pieces", "13"),),
    "neural_maglev_narrow": (("inputs.ref.duration", "3 s"),),
    "steam_condenser": (("inputs.steam.pieces", "18"), ("inputs.steam.times", "free")),
}
"""Inputs of instance 1, which the tool chooses."""
POINTS = ("f16",)
"""Models without input signals: an initial state is searched, which is instance 1."""
PUBLISHED = {
    "AT1": f"{FALCAUN}: 896",
    "AT2": f"{FALCAUN}: 256",
    "AT6a": f"{FALCAUN}: 1002",
    "AT6c": f"{FALCAUN}: 898",
    "CC1": f"{FALCAUN}: 396",
    "CC2": f"{FALCAUN}: 76",
    "CC3": f"{FALCAUN}: 122",
    "CC4": f"{FALCAUN}: 1256, 4 of 10",
    "NN": "MoonLight 2024: 26.8 (1), 48.0 (2)",
    "NNx": "MoonLight 2024: 142.7, 9 of 10 (1), 0 of 10 (2)",
    "SC": f"{FALCAUN}: 0 of 10",
    "F16": "MoonLight 2024: 21.0",
}
REQUIREMENTS = {
    "transmission": ("AT1", "AT2", "AT51", "AT52", "AT53", "AT54", "AT6a", "AT6b", "AT6c", "AT6abc"),
    "chasing_cars": ("CC1", "CC2", "CC3", "CC4", "CC5", "CCx"),
    "neural_maglev": ("NN",),
    "neural_maglev_narrow": ("NNx",),
    "steam_condenser": ("SC",),
    "fuel_control": ("AFC27", "AFC29"),
    "fuel_control_power": ("AFC33",),
    "f16": ("F16",),
}
CASES = tuple(
    Case(spec, name, PUBLISHED.get(name, ""), changes)
    for changes_of in ({}, FINER)
    for spec, names in REQUIREMENTS.items()
    if not changes_of or spec in changes_of
    for name in names
    for changes in [changes_of.get(spec, ())]
)


@dataclass(frozen=True, slots=True)
class Row:
    """Searches for a violation of one requirement, one for each seed.

    Attributes:
        case: requirement and instance.
        seeds: number of searches.
        falsified: number of searches that found a violation which remains at half the time step.
        mean: mean number of simulations of these; None if there are none.
        median: median number of simulations.
        most: greatest number of simulations.
        least: least robustness of the searches that found nothing; None if all found something.
        margin: median robustness of the counterexamples; None if there are none.
        half_step: the same at half the time step.
        spurious: violations in all searches that vanish at half the time step.
        published: counts of other tools.
    """

    case: str
    seeds: int
    falsified: int
    mean: float | None
    median: float | None
    most: int | None
    least: float | None
    margin: float | None
    half_step: float | None
    spurious: int
    published: str


COLUMNS: Columns[Row] = {
    "requirement": "{case}",
    "falsified": "{falsified} of {seeds}",
    "mean": "{mean:.1f}",
    "median": "{median:g}",
    "most": "{most}",
    "margin": "{margin:.3g}",
    "at half the step": "{half_step:.3g}",
    "least robustness otherwise": "{least:.3g}",
    "spurious": "{spurious}",
    "published": "{published}",
}


@command("python -m benchmarks falsify", "python -m benchmarks falsify --only AT1,AT2 --seeds 1..10")
def falsify(
    only: OnlyOption = None,
    seeds: Annotated[str, typer.Option(metavar="SEEDS", help="Seeds of the searches.")] = "1..10",
    out: ResultsOption = RESULTS,
    as_json: JsonOption = False,
) -> None:
    """Search for violations of the ARCH-COMP requirements, at most 300 simulations each; results are kept."""
    wanted = None if only is None else {each.strip() for each in only.split(",")}
    cases = [case for case in CASES if wanted is None or case.requirement in wanted]
    store, drawn = ResultStore("falsify", out), parse_seeds(seeds)
    with one_thread():
        table = Table("falsify", cases, lambda case: row_of(case, drawn, store), COLUMNS, "{case}")
        show("falsify", {"rows": table}, as_json=as_json)


def row_of(case: Case, seeds: Sequence[int], store: ResultStore) -> Row:
    """Return the row of a case: its searches, each stored or carried out now and stored."""
    simulator = ModelSimulator.load(str(SPECS / "arch" / f"{case.spec}.stl"), None, dict(case.changes))
    inputs = inputs_of(simulator.task)
    results = []
    for seed in seeds:
        values = {**inputs, "seed": seed, "simulations": SIMULATIONS, "version": FALSIFIER_VERSION}
        key = Key(f"{case.name}, seed {seed}", {**values, "changes": dict(case.changes)})
        results.append(store.get(key, lambda seed=seed: _search(case, simulator, seed)))  # type: ignore[misc]
    return _row(case, results)


def _search(case: Case, simulator: ModelSimulator, seed: int) -> Mapping[str, Any]:
    say(f"falsifying {case.name}, seed {seed}")
    found = search(
        simulator,
        simulator.requirements.index(case.requirement),
        budget=SearchBudget(SIMULATIONS),
        seed=seed,
        shrinks=False,
    )
    best = found.found
    return {
        "simulations": found.simulations,
        "margin": None if best is None else best.margin,
        "half_step": None if best is None else best.half_step,
        "strategy": None if best is None else best.strategy,
        "least": found.least,
        "spurious": len(found.spurious),
    }


def _row(case: Case, results: Sequence[Mapping[str, Any]]) -> Row:
    good = [each for each in results if each["margin"] is not None]
    counts = [int(each["simulations"]) for each in good]
    missed = [float(each["least"]) for each in results if each["margin"] is None]
    halves = [float(each["half_step"]) for each in good if each["half_step"] is not None]
    return Row(
        case.name,
        len(results),
        len(good),
        mean=fmean(counts) if counts else None,
        median=median(counts) if counts else None,
        most=max(counts, default=None),
        least=min(missed, default=None),
        margin=median(float(each["margin"]) for each in good) if good else None,
        half_step=median(halves) if halves else None,
        spurious=sum(int(each["spurious"]) for each in results),
        published=case.published,
    )
