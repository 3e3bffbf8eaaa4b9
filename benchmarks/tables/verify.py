"""Proofs on boxes of initial states for trained policies: proved, refuted and open shares of each mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.options import Output, ResultsOption, RunsArgument
from benchmarks.store import Key, Result, ResultStore, inputs_of
from benchmarks.table import Columns, listed, provenance, publish
from benchmarks.timing import one_thread
from stlc.assurance.bounds import clopper_pearson_lower
from stlc.assurance.verification.boxes import Box, Mode
from stlc.assurance.verification.examine import SharedExaminer
from stlc.assurance.verification.plans import PolicySource, ProposedPlans
from stlc.assurance.verification.subject import VerificationSubject
from stlc.assurance.verification.verify import Verifier
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.parallel.workers import LocalProcesses
from stlc.controller.run.run import Run
from stlc.controller.training.budget import clock_of
from stlc.options import parse_seconds
from stlc.provenance import sha256
from stlc.rundir import RunDir

BOXES = 1000
"""Proved boxes of each mode at most in which random points are drawn."""

_OUTPUT = Output(Path("docs/assurance.md"))
TEXT = """\
Written by `python -m benchmarks verify` from `benchmarks/results/verify.json`. `network`: widths of the
hidden layers of the policy. `proved`, `refuted` and `open`: shares of the initial states by branch and bound.
`states`: random initial states that are in a box with a proof, of all that were drawn; the others are
violated or open. `with a proof`: share of all initial states of the mode with such a box, at least, with
95 % confidence. `violations`: random points of proved boxes from which the policy violates the specification,
of all that were drawn, in 1,000 boxes of each mode at most. Times are processor times of each process, which
has one thread.
"""


@dataclass(frozen=True, slots=True)
class VerifyRow:
    """Result for one mode of the initial states of a policy.

    Attributes:
        spec: name of the specification.
        mode: name of the mode.
        probability: its probability.
        proved: share of proved boxes.
        refuted: share of boxes with a counterexample.
        open: share of other boxes.
        states: number of random initial states.
        with_proof: number of these in a box with a proof.
        violated: number of these from which the policy violates the specification.
        violations: number of violations among random points of proved boxes.
        points: number of these points.
        network: sizes of the hidden layers of the policy's network.
    """

    spec: str
    mode: str
    probability: float
    proved: float
    refuted: float
    open: float
    states: int
    with_proof: int
    violated: int
    violations: int
    points: int
    network: str

    @property
    def least(self) -> float:
        """Lower bound on the share of initial states in a box with a proof."""
        return clopper_pearson_lower(self.with_proof, self.states) if self.states else 0.0


COLUMNS: Columns[VerifyRow] = {
    "policy": "{spec}",
    "network": "{network}",
    "initial states": "{mode}",
    "probability": "{probability:.1%}",
    "proved": lambda row: _share(row.proved),
    "refuted": lambda row: _share(row.refuted),
    "open": "{open:.1%}",
    "states": "{with_proof} / {states}",
    "with a proof": "{least:.1%}",
    "violations": "{violations} / {points:,}",
}


@command(
    "python -m benchmarks verify runs/traffic/latest",
    "python -m benchmarks verify runs/*/latest --budget 10min -j 2 --states 1000 --page docs/assurance.md",
)
def verify(
    runs: RunsArgument = None,
    budget: Annotated[
        str, typer.Option("--budget", metavar="TIME", help="Processor time of branch and bound for each run.")
    ] = "10min",
    states: Annotated[
        int, typer.Option("--states", metavar="N", min=1, help="Random initial states of each run.")
    ] = 1000,
    points: Annotated[
        int,
        typer.Option("--points", metavar="N", min=1, help="Random points in each drawn box."),
    ] = 1000,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=1, help="Processes of branch and bound, with the budget each.")
    ] = 1,
    out: ResultsOption = Path("benchmarks/results"),
    output: Output = _OUTPUT,
) -> None:
    """Prove plans of trained policies on boxes of initial states, and write the table.

    Results are stored, and not computed again while specification, system and policy are the same.
    """
    store = ResultStore("verify", out)
    folders = [RunDir.open(name) for name in runs or ["latest"]]
    results = [
        _verified(folder, _Sizes(parse_seconds(budget), states, points, jobs), store) for folder in folders
    ]

    def rows(every: Sequence[Result]) -> list[VerifyRow]:
        return [VerifyRow(**mode) for each in every for mode in each["modes"]]

    def section() -> list[str]:
        stored = store.all()
        spent = [
            f"- {name}: {each['seconds']:.0f} s in {_counted(each['key']['jobs'])}, for the states "
            f"{each['seconds_of_states']:.0f} s"
            for name, each in stored.items()
        ]
        every = [*stored.values()]
        table = listed("verify", rows(every), COLUMNS).markdown()
        return [TEXT, *table, "", *spent, *provenance(every, "runs")]

    publish("verify", output, section, {"rows": listed("verify", rows(results), COLUMNS)})


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Sizes of a measurement: budget in seconds, states, points of a box, and processes."""

    seconds: float
    states: int
    points: int
    jobs: int


def _verified(folder: RunDir, sizes: _Sizes, store: ResultStore) -> Result:
    """Result for a run, from the store or computed."""
    run = Run.open(folder.path)
    spec, network = run.task.compiled.name, "x".join(map(str, run.task.system.decl.policy.hidden))
    values: dict[str, Any] = {
        "spec": spec,
        **inputs_of(run.task),
        "policy_sha256": sha256((folder.path / "ckpt" / "last.json").read_text(encoding="utf-8")),
        **asdict(sizes),
    }

    def compute() -> Result:
        say(f"verifying {folder.shown}")
        workers = LocalProcesses(sizes.jobs, fresh=True)
        with one_thread(), SharedExaminer(PolicySource(folder.path), workers) as examiner:
            subject = ProposedPlans(run.task, run.policy)
            verifier = Verifier(subject, clock=examiner.processor_time, examiner=examiner)
            found = verifier.run(sizes.seconds)
            clock = clock_of("processor")
            begun = clock()
            around = verifier.around(sizes.states)
            spent = clock() - begun
            modes = []
            for each, near in zip(found.modes, around, strict=True):
                boxes = [*_some(each.boxes), *near.boxes]
                modes.append(
                    {
                        "spec": spec,
                        "network": network,
                        "mode": each.mode.name,
                        "probability": found.probability(each),
                        "proved": each.proved,
                        "refuted": each.refuted,
                        "open": each.open,
                        "states": near.states,
                        "with_proof": near.proved,
                        "violated": near.violated,
                        "violations": _violations(subject, each.mode, boxes, sizes.points),
                        "points": len(boxes) * sizes.points,
                    }
                )
        return {"run": folder.name, "seconds": found.seconds, "seconds_of_states": spent, "modes": modes}

    return store.get(Key(f"{spec} {network}", values), compute)


def _some(boxes: Sequence[Box]) -> list[Box]:
    """`BOXES` of the boxes at most, drawn at random."""
    rng = np.random.default_rng(12)
    return [boxes[i] for i in rng.permutation(len(boxes))[:BOXES]]


def _violations(subject: VerificationSubject, mode: Mode, boxes: Sequence[Box], points: int) -> int:
    """Number of violations among random points of proved boxes of a mode."""
    rng = np.random.default_rng(11)
    count = 0
    for box in boxes:
        at = box.centre + rng.uniform(-1.0, 1.0, (points, len(box.half))) * box.half
        at = at[subject.admits(mode, at)]
        if len(at):
            count += int(TOLERANCE.violated(subject.robustness(subject.states(mode, at))).sum())
    return count


def _counted(jobs: int) -> str:
    return "one process" if jobs == 1 else f"each of {jobs} processes"


def _share(value: float) -> str:
    return f"{value:.1%}" if value >= 5e-4 or value == 0.0 else f"{100.0 * value:.0e} %"
