"""Certificates of policies in their worlds: coverage of the bounds over recalibrations, and drives needed.

The drives of a world, one agent each, are recorded once. They are then taken as the whole population, whose
share of satisfied drives and whose robustness are known exactly: each recalibration draws drives from it with
replacement. The shifted next drive comes, with the probability of the shift, from a scenario instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.deployments import NOMINAL, key_of
from benchmarks.options import Output, ResultsOption, RunsArgument
from benchmarks.store import Key, Result, ResultStore
from benchmarks.table import Columns, Table, listed, provenance, publish
from stlc.assurance.bounds import Tally, betting_lower, clopper_pearson_lower, drives_needed
from stlc.assurance.campaign import SEED
from stlc.assurance.certificate import Sample, joined
from stlc.assurance.conformal import lower_bound
from stlc.assurance.drives import PolicyDrives
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.rules import Rules
from stlc.controller.run.run import Run
from stlc.registry import GUARDS
from stlc.rundir import RunDir

SHARE, CONFIDENCE = 0.99, 0.95
SHIFT = 0.02
_OUTPUT = Output(Path("docs/assurance.md"))
TEXT = """\
Written by `python -m benchmarks certificates` from `benchmarks/results/certificates.json`: drives of one
agent each, taken as the population, from which 200 recalibrations draw 100 drives with replacement. `share`:
part of the recalibrations in which the lower bound is at most the true share (Clopper-Pearson, betting).
`next drive`: chance that the next drive's robustness reaches its conformal bound; `shifted`: the same if 2 %
of the next drives come from the scenario `mismatch-20`, with the bound for a total variation of .02 and with
the plain one. All but the last should be at least .95. `needed`: worlds without a failure that certify .99
with 95 % confidence, for a number fixed in advance and for any stopping time.
"""


@dataclass(frozen=True, slots=True)
class CertificatesRow:
    """Coverage of bounds in one world.

    Attributes:
        spec: name of the specification.
        steps: length of a drive.
        drives: number of recorded drives.
        satisfied: number of these that satisfy everything.
        exact: part of the recalibrations in which the Clopper-Pearson bound holds.
        betting: the same for the betting bound.
        next_drive: mean chance that the next drive reaches its conformal bound.
        shifted: the same after the shift, with the bound that allows for it.
        unaware: the same after the shift, with the bound that does not.
        needed: drives without a failure that certify .99, their number fixed in advance.
        needed_any_time: the same if they are stopped by their results.
    """

    spec: str
    steps: int
    drives: int
    satisfied: int
    exact: float
    betting: float
    next_drive: float
    shifted: float
    unaware: float
    needed: int
    needed_any_time: int


COLUMNS: Columns[CertificatesRow] = {
    "world": "{spec}",
    "drives x steps": "{drives} x {steps}",
    "satisfied": "{satisfied}",
    "share: exact": "{exact:.3f}",
    "share: betting": "{betting:.3f}",
    "next drive": "{next_drive:.3f}",
    "shifted": "{shifted:.3f}",
    "shifted, plain bound": "{unaware:.3f}",
    "needed": "{needed} / {needed_any_time}",
}


def coverage(result: Result, recalibrations: int, drives: int) -> CertificatesRow:
    """Recalibrate the bounds on stored drives, and compare them with the whole population."""
    good, robustness, other = (np.array(result[name], dtype=float) for name in ("good", "rho", "shifted"))
    rng, share = np.random.default_rng(0), float(good.mean())
    found = []
    for _ in range(recalibrations):
        drawn = rng.integers(len(good), size=drives)
        total = int(good[drawn].sum())
        plain, aware = (lower_bound(robustness[drawn], CONFIDENCE, shift) for shift in (0.0, SHIFT))
        here, there = (
            [float((each >= bound).mean()) for bound in (plain, aware)] for each in (robustness, other)
        )
        after = [(1 - SHIFT) * a + SHIFT * b for a, b in zip(here, there, strict=True)]
        exact = clopper_pearson_lower(total, drives, CONFIDENCE) <= share
        bet = betting_lower(Tally.counted(total, drives), CONFIDENCE) <= share
        found.append((exact, bet, here[0], after[1], after[0]))
    exact_, betting_, next_drive, shifted, unaware = map(float, np.mean(found, axis=0))
    return CertificatesRow(
        spec=str(result["key"]["spec"]),
        steps=int(result["key"]["steps"]),
        drives=len(good),
        satisfied=int(good.sum()),
        exact=exact_,
        betting=betting_,
        next_drive=next_drive,
        shifted=shifted,
        unaware=unaware,
        needed=drives_needed(SHARE, CONFIDENCE),
        needed_any_time=drives_needed(SHARE, CONFIDENCE, any_time=True),
    )


@command(
    "python -m benchmarks certificates runs/ship_safe/latest",
    "python -m benchmarks certificates runs/*/latest --drives 200 --page docs/assurance.md",
)
def certificates(
    runs: RunsArgument = None,
    drives: Annotated[
        int, typer.Option("--drives", metavar="N", min=20, help="Recorded drives of each world.")
    ] = 400,
    recalibrations: Annotated[
        int, typer.Option("--recalibrations", metavar="N", min=1, help="How often bounds are made.")
    ] = 200,
    steps: Annotated[
        int | None, typer.Option("--steps", metavar="N", min=1, help="Of each drive, at most.")
    ] = None,
    out: ResultsOption = Path("benchmarks/results"),
    output: Output = _OUTPUT,
) -> None:
    """Check the coverage of certificates in the worlds of trained policies, and write the table.

    Drives are stored when they end, and not simulated again while specification, system and policy are the
    same.
    """
    store = ResultStore("certificates", out)
    results = [_drives_of(RunDir.open(name), drives, steps, store) for name in runs or ["latest"]]

    def table(every: Sequence[Result]) -> Table[Any, CertificatesRow]:
        rows = [coverage(each, recalibrations, min(100, drives)) for each in every]
        return listed("certificates", rows, COLUMNS)

    def section() -> list[str]:
        every = [*store.all().values()]
        return [TEXT, *table(every).markdown(), "", *provenance(every, "worlds")]

    publish("certificates", output, section, {"rows": table(results)})


def _drives_of(folder: RunDir, drives: int, steps: int | None, store: ResultStore) -> Result:
    """Drives of a run, as it is and in the scenario, from the store or simulated."""
    run, test = Run.open(folder.path), Run.open(folder.path).task.system.decl.test
    setting = Setting((), 1, min(steps or test.steps, test.steps), test.replan)
    key = key_of(run, NOMINAL, GUARDS.default, setting)
    key = Key(run.task.compiled.name, {**key.values, "drives": drives, "first_seed": SEED})

    def simulate() -> Result:
        say(f"driving {key.name}")
        usual, other = (
            _recorded(Run.open(folder.path, scenario=scenario), setting, seeds)
            for scenario, seeds in ((None, range(SEED, SEED + drives)), ("mismatch-20", range(drives // 2)))
        )
        return {
            "run": folder.name,
            "good": usual.overall.satisfied.astype(int),
            "rho": usual.overall.robustness.round(6),
            "shifted": other.overall.robustness.round(6),
        }

    return store.get(key, simulate)


def _recorded(run: Run, setting: Setting, seeds: Sequence[int]) -> Sample:
    drives = PolicyDrives(run, Rules.of(run), GUARDS.default, replace(setting, seeds=()))
    return joined([*drives.observed(seeds)])
