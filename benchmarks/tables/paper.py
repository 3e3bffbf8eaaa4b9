"""The paper's comparison: all training methods and planners on six benchmarks."""

from __future__ import annotations

from pathlib import Path

from benchmarks.cells import Selection
from benchmarks.drives import DriveRow, budget_text, driven
from benchmarks.feasible import known_feasible, prove_on, search_on
from benchmarks.learned import SHOWN, LearnedRow, row_of, tables
from benchmarks.options import Comparing, OnlyOption, Output, Training, chosen
from benchmarks.page import CLAIMS, Stored, section
from benchmarks.plannings import PlanRow, planned
from benchmarks.roster import roster
from benchmarks.store import BENCHMARKS
from benchmarks.table import Columns, listed, publish
from benchmarks.training import filled
from stlc.cli.framework.program import command

__all__ = ["SHOWN", "LearnedRow", "paper", "row_of"]
_TRAINING, _COMPARING, _OUTPUT = Training(clock="processor"), Comparing(), Output(Path("docs/results.md"))
PLANS: Columns[PlanRow] = {
    **{"benchmark": "{benchmark}", "planner": lambda row: row.label or row.method},
    "time a plan": lambda row: budget_text(row.seconds),
    **{
        "accuracy": "{accuracy:.3f} [{interval[0]:.3f}, {interval[1]:.3f}]",
        "no plan exists": "{infeasible:.3f}",
    },
    **{"ms a plan": "{mean_ms:.3g}", "ms alone": "{median_ms:.3g}", "99 %": "{p99_ms:.3g}"},
    "refused": "{refused}",
}
DRIVES: Columns[DriveRow] = {
    **{"benchmark": "{benchmark}", "policy": lambda row: row.label or row.method, "guard": "{guard}"},
    **{"size": "{size}", "accuracy": "{accuracy:.3f}", "safe": "{safety:.3f}"},
    **{"ms a decision": "{median_ms:.3g}", "99 %": "{p99_ms:.3g}", "refused": "{refused}"},
}


@command(
    "python -m benchmarks paper",
    "python -m benchmarks paper --only traffic --methods guided,plan:search --budget 60s --seeds 0",
    "python -m benchmarks paper --parts plans --plan-time 10ms",
    "python -m benchmarks paper --show",
)
def paper(
    only: OnlyOption = None,
    training: Training = _TRAINING,
    comparing: Comparing = _COMPARING,
    output: Output = _OUTPUT,
) -> None:
    """Compare all training methods and planners on the six benchmarks of the paper; write tables and figures.

    If no budget is given, policies are trained for 60 s and 300 s, and planners search for 1 ms to 1 s per
    plan. Stored results with the same inputs are reused. Interrupted training runs are resumed. Every result
    is stored as soon as it is measured. The whole comparison takes many hours. In the page, a line with empty
    entries shows the command that measures them. Exit code: 0, or 1 if a measurement failed.
    """
    comparing.check()
    known, place = roster(), training.place("paper")
    names = chosen(only, BENCHMARKS, "benchmark")
    which = [known[name] for name in chosen(comparing.methods, [*known], "method")]
    wanted, stored = Selection(names, tuple(which), training, comparing), Stored.of(place)
    filling = filled(wanted.trainings(), place)
    results = place.valid()
    for name in names if comparing.asks("learners") else ():
        own = [each for each in results if each["key"]["benchmark"] == name]
        own = [each for each in own if each["key"]["held_out"] == training.held_out]
        if own:
            search_on(own, stored.feasible, passes=comparing.passes, run=place.best_run(own))
            if comparing.proof:
                prove_on(own, stored.feasible, seconds=comparing.proof)
    plans = planned([*wanted.plans(), *wanted.policies(place)], stored.plans)
    drives = driven(wanted.drives(place), stored.drives)
    shown = tables(
        place.all() if comparing.show else filling.results, known_feasible(stored.feasible, place.all())
    )
    plan_rows = stored.plan_rows() if comparing.show else [PlanRow.of(each) for each in plans.results]
    drive_rows = stored.drive_rows() if comparing.show else [DriveRow.of(each) for each in drives.results]
    shown |= {
        "plans": listed("plans", plan_rows, PLANS),
        "drives": listed("drives", drive_rows, DRIVES),
        "claims": listed("claims", stored.claims(), CLAIMS),
    }
    page = output.page
    assert page is not None
    facts = filling.facts(len(results), (*plans.failed, *drives.failed))
    new = {"planned": plans.new, "driven": drives.new}
    publish("paper", output, lambda: section(stored, page), shown, **facts, **new)
