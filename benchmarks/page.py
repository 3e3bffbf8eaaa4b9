"""Section of the documentation page on the paper's comparison, written from all stored results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from benchmarks.bars import BARS, TIMES, Bar, Facet, Point, draw
from benchmarks.cells import BUDGETS
from benchmarks.claims import Claim, claims
from benchmarks.comparison import (
    Learned,
    accuracies,
    deployments,
    latencies,
    markdown,
    refusals,
    standings,
    upsets,
)
from benchmarks.drives import DriveRow
from benchmarks.feasible import known_feasible
from benchmarks.learned import detailed, learned
from benchmarks.plannings import ALONE, SEED, STARTS, FeasibleBounds, PlanRow, feasible_bounds
from benchmarks.roster import roster
from benchmarks.store import BENCHMARKS, ResultStore
from benchmarks.table import Columns, listed, provenance
from benchmarks.training import Cell, Place

Row = TypeVar("Row", PlanRow, DriveRow)
CLAIMS: Columns[Claim] = {"claim": "{claim}", "here": "{here}", "verdict": "{verdict}", "why": "{why}"}
FEASIBLE_BOUNDS: Columns[FeasibleBounds] = {
    **{"benchmark": "{benchmark}", "starts": "{starts:,}"},
    **{"a plan is known": "{known:.3f}", "proved: no plan exists": "{proved:.3f}"},
    "neither": lambda row: f"{1.0 - row.known - row.proved:.3f}",
    "contradictions": "{contradictions}",
}
COMPARED = f"""\
Plan accuracy. Learners, on held-out states: mean over the seeds 0, 1 and 2 with its 95 % interval over seeds
and states (after an hour: seed 0 alone, and the interval of the states); an entry that lacks some lists its
seeds. Planners (`plan:`), on {STARTS:,} other starts, the same for all (seed {SEED:,}): share with a
satisfying plan within a processor time a plan, all starts in one batch. Rows `own settings` end as the
authors' scripts do: CEM with 10,000 samples (manipulation 1,000), 100 elites, a standard deviation of 1 in
physical units and at most 10 rounds (navigation: over the weights of a small network); STL_G with one start,
the paper's objective and 50 Adam steps (ship_safe and manipulation 200). An empty cell is not measured;
`no gain`: not measured, as ten times the time found no more plans before.
"""
DECIDED = f"""\
Processor time of a decision in milliseconds, median / 99 %, one start at a time on one thread, over {ALONE}
starts. For a policy: its plan and the verdict on it.
"""
DEPLOYED = """\
Closed loop, by the protocol of the paper: size and replanning of the system, plan accuracy (share of the
followed plans that satisfy the specification) / safety (share of agents whose whole drive was safe), means
over 3 worlds with half of their 95 % intervals (Student's t, which is wide for three and may leave 0 to 1).
Of the policies of a training method, the most accurate one that was measured is shown; its training time and
seed stand behind it (and the size, where a slow policy drove fewer agents). Policies of `mbpo` and `pets`
whose folders were gone were trained again for this table, with the same options and seed, and differ somewhat
from those of the tables above. In traffic, drives contain events that no plan foresees, such as a car that
turns into another road, so that few are safe throughout;
docs/worlds.md judges them by rules for drives.
"""


@dataclass(frozen=True, slots=True)
class Stored:
    """Files with all stored results of the comparison.

    Attributes:
        place: results and runs of training.
        feasible: results of the search for plans from held-out initial states.
        plans: results of planners.
        drives: results of closed-loop simulations.
    """

    place: Place
    feasible: ResultStore
    plans: ResultStore
    drives: ResultStore

    @classmethod
    def of(cls, place: Place) -> Stored:
        """Return the result files that lie in the same folder as those of training."""
        folder = place.store.folder
        return cls(place, *(ResultStore(name, folder) for name in ("feasible", "plans", "drives")))

    def plan_rows(self) -> list[PlanRow]:
        """Return the table rows of all stored results of planners."""
        return _ordered(PlanRow.of(each) for each in self.plans.all().values())

    def drive_rows(self) -> list[DriveRow]:
        """Return the table rows of all stored closed-loop results."""
        return _ordered(DriveRow.of(each) for each in self.drives.all().values())

    def claims(self) -> list[Claim]:
        """Return the paper's claims, each with a verdict based on the stored results."""
        return claims(standings(learned(self.place.all()), self.plan_rows(), self.drive_rows()))


def _ordered(rows: Iterable[Row]) -> list[Row]:
    """Sort rows: trained policies first, then planners in the order of `roster`, by time budget."""
    names = [*roster()]
    place = {name: index for index, name in enumerate(names)}
    return sorted(
        rows,
        key=lambda row: (
            not row.label,
            place.get(row.method, len(names)),
            row.label,
            row.seconds or 0.0,
            row.benchmark,
        ),
    )


def section(stored: Stored, page: Path) -> list[str]:
    """Return the lines of the section, and write its figures beside `page`."""
    results = stored.place.all()
    known = known_feasible(stored.feasible, results)
    plans, drives, trained = stored.plan_rows(), stored.drive_rows(), learned(results)
    cells = [(Cell.of(each), float(each["accuracy"])) for each in results]
    judged = {(cell.benchmark, cell.label): accuracy for cell, accuracy in cells}
    bounds = feasible_bounds(stored.plans.all().values())
    drawn = draw(facets(trained, plans, bounds), page.parent)
    pictures = [f"![{what}]({path})" for what, path in zip(_PICTURES, (BARS, TIMES), strict=True) if drawn]
    contenders = roster().values()
    lines = accuracies(
        [each for each in contenders if not each.plans],
        [each for each in contenders if each.plans],
        *(trained, plans, BUDGETS),
    )
    timed = latencies(plans)
    decisions = markdown(timed, filled=False) if timed else ["Nothing is measured yet."]
    return [
        *("## The paper's comparison", ""),
        *_search_first(plans),
        *(line for picture in pictures for line in (picture, "")),
        *((BARS_TEXT, "") if drawn else ()),
        *("### Plan accuracy", "", COMPARED, *markdown(lines), "", *refusals(plans), ""),
        *_block(
            "### Known and proved feasible shares",
            FEASIBLE_TEXT,
            listed("c", [*bounds.values()], FEASIBLE_BOUNDS).markdown(),
        ),
        *_block("### A decision", DECIDED, decisions),
        *_block("### Closed loop", DEPLOYED, markdown(deployments(drives, judged, contenders))),
        *("### The paper's claims", "", *listed("claims", stored.claims(), CLAIMS).markdown(), ""),
        *provenance(stored.plans.all().values(), "planner cells"),
        *(*provenance(stored.drives.all().values(), "closed-loop cells"), ""),
        *detailed(results, known, page),
    ]


_PICTURES = (
    "Plan accuracy of all methods, with intervals",
    "Plan accuracy over the processor time of a plan",
)
BARS_TEXT = """\
A bar is the longest training of a method, which is an hour for `sac:robustness` where the table has one, or
its largest planning time. The dashed line is the known feasible share."""
FEASIBLE_TEXT = """\
On the planners' starts: the share for which any cell found a satisfying plan, and the share that `plan:milp`
proved to have none. A contradiction would be a start with both.
"""


def _block(title: str, text: str, lines: Sequence[str]) -> list[str]:
    return [title, "", text, *lines, ""]


def _search_first(plans: Sequence[PlanRow]) -> list[str]:
    """Return the text on benchmarks on which search beats the trained policy.

    The section begins with this text.
    """
    found = upsets(plans)
    if not found:
        return []
    return [
        "**Search without training is at least as good as the trained policy here**, on the same starts",
        "(its least budget):",
        *("", *(f"- {each.text}" for each in found), ""),
    ]


def facets(
    trained: Iterable[Learned], plans: Sequence[PlanRow], bounds: dict[str, FeasibleBounds]
) -> list[Facet]:
    """Return the data of the figures, one `Facet` per benchmark; outdated results are left out.

    The bar of each method shows its result with the longest training, or with the largest time budget.
    """
    names = [*roster()]
    bars: dict[str, dict[str, Bar]] = {name: {} for name in BENCHMARKS}
    points: dict[str, list[Point]] = {name: [] for name in BENCHMARKS}
    for each in sorted(trained, key=lambda each: each.seconds):
        if not each.outdated and each.benchmark in bars:
            bar = Bar(each.method, each.accuracy, each.interval, plans=False)
            bars[each.benchmark][each.method] = bar
    for row in sorted(plans, key=lambda row: row.seconds or 0.0):
        if row.accuracy is None or row.interval is None or row.outdated or row.benchmark not in bars:
            continue
        if not row.label:
            bars[row.benchmark][row.method] = Bar(row.method, row.accuracy, row.interval, plans=True)
        points[row.benchmark].append(Point(row.method, row.mean_ms or 0.0, row.accuracy))
    return [
        Facet(
            *(name, tuple(sorted(own.values(), key=lambda bar: names.index(bar.label)))),
            *(tuple(points[name]), bounds[name].known if name in bounds else None),
        )
        for name, own in bars.items()
    ]
