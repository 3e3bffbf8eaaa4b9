"""Falsification of the ARCH-COMP models: simulations to a counterexample, beside published counts.

The searches of a requirement, one per seed, are simulated side by side; each has the result of
`stlc falsify` with its seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any

import typer

from benchmarks.options import OnlyOption, Output, ResultsOption
from benchmarks.store import RESULTS, Key, Result, ResultStore, inputs_of
from benchmarks.table import Columns, Table, listed, provenance, publish
from benchmarks.timing import one_thread
from stlc.assurance.falsify import FALSIFIER_VERSION, ViolationSearch
from stlc.assurance.model_simulator import ModelSimulator
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.files import File
from stlc.options import parse_seeds

SIMULATIONS = 300
_OUTPUT = Output(Path("docs/falsification.md"))
TEXT = """\
Written by `python -m benchmarks falsify` from `benchmarks/results/falsify.json`. A search has succeeded when
a violation remains at half the time step; `mean`, `median` and `most` are simulations until then, of the
searches that succeeded (simulations at half the step are not counted). `first violation`: mean number of
simulations until the first violation at the declared step, whether it remains or not, which is what other
tools count. `margin`: median robustness of the counterexamples. `spurious`: violations in all searches that
vanish at half the step.
"""


@dataclass(frozen=True, slots=True)
class Case:
    """Requirement of a model, with the inputs of one instance of the competition.

    Attributes:
        spec: name of the specification in `specs/arch`.
        requirement: its requirement.
        instance: instance of the competition, 1 or 2; a system file has the inputs of instance 2.
        changes: keys of the system file that make the instance, name -> text.
        most: greatest number of simulations of a search.
    """

    spec: str
    requirement: str
    instance: int
    changes: tuple[tuple[str, str], ...] = ()
    most: int = SIMULATIONS

    @property
    def name(self) -> str:
        """Requirement and instance."""
        return f"{self.requirement}, instance {self.instance}"

    @property
    def remark(self) -> str:
        """Published counts of other tools, or the reason why there is nothing to find."""
        reason = IMPOSSIBLE.get((self.requirement, self.instance))
        return "; ".join(filter(None, (reason, PUBLISHED.get((self.requirement, self.instance)))))


FINER = {
    "transmission": (("inputs.throttle.pieces", "12"), ("inputs.brake.pieces", "12")),
    "chasing_cars": (
        *(("inputs.throttle.pieces", "10"), ("inputs.throttle.interpolate", "linear")),
        *(("inputs.brake.pieces", "10"), ("inputs.brake.interpolate", "linear")),
    ),
    "neural_maglev": (("inputs.ref.pieces", "13"),),
    "neural_maglev_narrow": (("inputs.ref.duration", "3 s"),),
    "steam_condenser": (("inputs.steam.pieces", "140"),),
    "f16": (),
}
"""Inputs of instance 1, which the tool chooses."""
OWN: dict[str, tuple[tuple[str, str], ...]] = {
    **dict.fromkeys(("AT6a", "AT6b", "AT6c", "AT6abc"), ()),
    "CC5": (("inputs.throttle.pieces", "13"), ("inputs.brake.pieces", "3")),
    "CCx": (("inputs.throttle.pieces", "13"), ("inputs.brake.pieces", "13")),
}
"""Inputs of instance 1 for single requirements: as in the file for AT6; constant pieces for CC5 and CCx."""
PRESCRIBED = {"fuel_control_power": (("inputs.throttle.range", "[61.201, 81.2]"),)}
"""Inputs of instance 2 where they are not those of the file.

At a throttle of exactly 61.2 the model reaches power mode in the limit only, and rounding decides.
"""
POINTS = ("f16",)
"""Models without input signals: an initial state is searched, which is instance 1."""
PUBLISHED = {
    ("AT1", 1): "FalCAuN 448",
    ("AT2", 1): "FalCAuN 128",
    ("AT6a", 1): "FalCAuN 501",
    ("AT6b", 1): "FalCAuN 0 of 10",
    ("AT6c", 1): "FalCAuN 449",
    ("AT6abc", 1): "FalCAuN 616",
    ("AT1", 2): "FalCAuN 2023: 130.1",
    ("AT2", 2): "FalCAuN 2023: 727.9, 8 of 10",
    ("AT6c", 2): "FalCAuN 2023: 186.6",
    ("CC1", 1): "FalCAuN 198",
    ("CC2", 1): "FalCAuN 38",
    ("CC3", 1): "FalCAuN 61",
    ("CC4", 1): "FalCAuN 474",
    ("CCx", 1): "FalCAuN 0 of 10",
    ("NN", 1): "MoonLight 26.8",
    ("NN", 2): "MoonLight 48.0",
    ("NNx", 1): "MoonLight 142.7, 9 of 10",
    ("NNx", 2): "MoonLight 0 of 10",
    ("SC", 1): "FalCAuN 0 of 10",
    ("F16", 1): "MoonLight 21.0",
}
"""Counts of FalCAuN 2026 (unless said) and MoonLight 2024, by requirement and instance."""
IMPOSSIBLE = {
    ("NNx", 2): "one number is seen before 3 s, and over its range the robustness is positive",
    ("SC", 2): "the best signs of 20 pieces move the pressure to 87.48 kPa only, by the pulse response",
    ("AFC33", 2): "no counterexample is known; abs(mu) reaches .0057",
}
"""Reason why a requirement cannot be falsified, by requirement and instance."""
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
LONGER = {"CC4": 1500}
"""Requirements whose searches have more simulations, as in the competition."""
CASES = tuple(
    Case(
        *(spec, name, instance, own.get(name, changes.get(spec, ()))),
        LONGER.get(name, SIMULATIONS),
    )
    for instance, changes, own in ((2, PRESCRIBED, {}), (1, FINER, OWN))
    for spec, names in REQUIREMENTS.items()
    if (spec in changes or instance == 2) and (spec in POINTS) <= (instance == 1)
    for name in names
)


@dataclass(frozen=True, slots=True)
class FalsifyRow:
    """Searches for a violation of one requirement, one for each seed.

    Attributes:
        case: requirement and instance.
        seeds: number of searches.
        simulations: greatest number of simulations of a search.
        falsified: number of searches that found a violation which remains at half the time step.
        mean: mean number of simulations of these; None if there are none.
        median: median number of simulations.
        most: greatest number of simulations.
        violated: number of searches that found a violation at the declared time step.
        first: mean number of simulations until the first of these; None if there are none.
        margin: median robustness of the counterexamples; None if there are none.
        half_step: the same at half the time step.
        least: least robustness of the searches without a counterexample; None if all have one.
        spurious: violations in all searches that vanish at half the time step.
        remark: counts of other tools, or the reason why there is nothing to find.
    """

    case: str
    seeds: int
    simulations: int
    falsified: int
    mean: float | None
    median: float | None
    most: int | None
    violated: int
    first: float | None
    margin: float | None
    half_step: float | None
    least: float | None
    spurious: int
    remark: str


COLUMNS: Columns[FalsifyRow] = {
    "requirement": "{case}",
    "falsified": "{falsified} of {seeds}",
    "mean": "{mean:.1f}",
    "median": "{median:g}",
    "most": "{most}",
    "of": "{simulations}",
    "first violation": lambda row: (
        "" if row.first is None else f"{row.first:.1f}, {row.violated} of {row.seeds}"
    ),
    "margin": "{margin:.3g}",
    "at half the step": "{half_step:.3g}",
    "least otherwise": "{least:.3g}",
    "spurious": "{spurious}",
    "others": "{remark}",
}


@command("python -m benchmarks falsify", "python -m benchmarks falsify --only AT1,AT2 --seeds 1..10")
def falsify(
    only: OnlyOption = None,
    seeds: Annotated[str, typer.Option(metavar="SEEDS", help="Seeds of the searches.")] = "1..10",
    out: ResultsOption = RESULTS,
    output: Output = _OUTPUT,
) -> None:
    """Search for violations of the ARCH-COMP requirements, and write the table; results are kept."""
    wanted = None if only is None else {each.strip() for each in only.split(",")}
    cases = [case for case in CASES if wanted is None or case.requirement in wanted]
    store, drawn = ResultStore("falsify", out), parse_seeds(seeds)
    with one_thread():
        results = {case.name: _searches(case, drawn, store) for case in cases}

    def section() -> list[str]:
        stored = store.all()
        known = [case for case in CASES if case.name in stored]
        rows = [_row(case, stored[case.name]) for case in known]
        made = provenance([stored[case.name] for case in known], "rows")
        return [TEXT, *listed("falsify", rows, COLUMNS).markdown(), "", *made]

    table = Table("falsify", cases, lambda case: _row(case, results[case.name]), COLUMNS, "{case}")
    publish("falsify", output, section, {"rows": table})


def _searches(case: Case, seeds: Sequence[int], store: ResultStore) -> Result:
    """The searches of a case, stored or carried out now and stored."""
    simulator = ModelSimulator.load(str(File.SPECS / "arch" / f"{case.spec}.stl"), None, dict(case.changes))
    values = {
        **inputs_of(simulator.task),
        "changes": dict(case.changes),
        "seeds": list(seeds),
        "simulations": case.most,
        "version": FALSIFIER_VERSION,
    }

    def compute() -> Result:
        say(f"falsifying {case.name}")
        requirement = simulator.requirements.index(case.requirement)
        searches = [ViolationSearch(simulator, requirement, seed) for seed in seeds]
        side_by_side(simulator, searches, case.most)
        return {"searches": [_record(search, seed) for search, seed in zip(searches, seeds, strict=True)]}

    return store.get(Key(case.name, values), compute)


def side_by_side(simulator: ModelSimulator, searches: Sequence[ViolationSearch], most: int) -> None:
    """Carry out searches, one simulation of each at a time and at most `most` of each."""
    going = searches
    while going:
        points = [search.ask(1) for search in going]
        outcomes = simulator.simulate_apart(points, [search.requirement for search in going])
        for search, point, outcome in zip(going, points, outcomes, strict=True):
            search.tell(point, outcome)
        going = [each for each in going if each.found is None and each.tried < most]


def _record(search: ViolationSearch, seed: int) -> Mapping[str, Any]:
    result, best = search.result(shrinks=False), search.found
    violations = [each.simulation for each in (*result.spurious, *([] if best is None else [best]))]
    return {
        "seed": seed,
        "simulations": result.simulations,
        "first": min(violations, default=None),
        "margin": None if best is None else best.margin,
        "half_step": None if best is None else best.half_step,
        "strategy": None if best is None else best.strategy,
        "least": result.least,
        "spurious": len(result.spurious),
    }


def _row(case: Case, result: Result) -> FalsifyRow:
    every: Sequence[Mapping[str, Any]] = result["searches"]
    good = [each for each in every if each["margin"] is not None]
    counts = [int(each["simulations"]) for each in good]
    firsts = [int(each["first"]) for each in every if each["first"] is not None]
    missed = [float(each["least"]) for each in every if each["margin"] is None]
    halves = [float(each["half_step"]) for each in good if each["half_step"] is not None]
    return FalsifyRow(
        case.name,
        len(every),
        case.most,
        len(good),
        mean=fmean(counts) if counts else None,
        median=median(counts) if counts else None,
        most=max(counts, default=None),
        violated=len(firsts),
        first=fmean(firsts) if firsts else None,
        margin=median(float(each["margin"]) for each in good) if good else None,
        half_step=median(halves) if halves else None,
        least=min(missed, default=None),
        spurious=sum(int(each["spurious"]) for each in every),
        remark=case.remark,
    )
