"""`stlc verify`: proofs that a trained policy satisfies its specification, on boxes of initial states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.activity import PULSE
from stlc.cli.certify.text import floored
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import (
    FailUnderOption,
    JobsOption,
    PythonOption,
    RunsOption,
    SeedOption,
    SystemOption,
    parse_clock,
    parse_seconds,
)
from stlc.cli.framework.output import Answer, emit, show_diagnostics, table
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, usage
from stlc.escape import visible
from stlc.foreign import driving

if TYPE_CHECKING:
    from stlc.assurance.verification.loop import NetworkLoop
    from stlc.assurance.verification.plans import PolicySource
    from stlc.assurance.verification.verified import Verified
    from stlc.assurance.verification.verify import Verification

_MOST = 3
"""Counterexamples that the text shows."""


@command(
    "stlc verify latest",
    "stlc verify traffic --budget 10min --jobs 2 --fail-under 0.5",
    "stlc verify latest --states 1000",
    "stlc verify loop.stl --controller network.onnx --period 0.1s",
)
def verify(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN|SPEC", help="A run, or with --controller a specification.", autocompletion=run_names
        ),
    ] = "latest",
    controller: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A network in ONNX that controls the system of SPEC."),
    ] = None,
    period: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Control period of the network.", show_default="the time step"),
    ] = None,
    continuous: Annotated[
        bool,
        typer.Option("--continuous", help="Bound solutions of the differential equations, not the model's."),
    ] = False,
    system: SystemOption = None,
    budget: Annotated[str, typer.Option(metavar="TIME", help="Time of the search for proofs.")] = "60s",
    boxes: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Boxes of each mode to examine at most.")
    ] = None,
    states: Annotated[
        int, typer.Option(min=0, metavar="N", help="Random initial states around which to prove boxes.")
    ] = 0,
    clock: Annotated[
        str, typer.Option(metavar="wall|processor", help="Clock of the search for proofs.")
    ] = "wall",
    jobs: JobsOption = 1,
    seed: SeedOption = 0,
    fail_under: FailUnderOption = None,
    python: PythonOption = False,
    runs: RunsOption = Path("runs"),
) -> Answer[Verified]:
    """Prove plans or closed loops on boxes of states.

    Each way to draw an initial state is divided into boxes. A box is proved if bounds on network, motion and
    robustness show that one proposal of the network satisfies the specification from every state in it. It is
    refuted if the policy violates the specification from a sampled state. More time proves more, and so do
    more processes (--jobs), each of which has the whole budget if --clock is processor. With --states, boxes
    are also searched around random initial states; the number of states with a proof bounds the share of all
    states that have one, with 95 % confidence. Exit code: 0 all proved, 1 a counterexample was found, 4 open;
    with --fail-under, 0 if at least that share is proved.

    With --controller, a network acts on the system of SPEC once per period, and the whole horizon is proved,
    at the samples of the model or, with --continuous, of the exact solutions.
    """
    import torch

    from stlc.assurance.verification.examine import SharedExaminer
    from stlc.assurance.verification.plans import PolicySource
    from stlc.assurance.verification.verified import Verified
    from stlc.assurance.verification.verify import Verifier
    from stlc.controller.parallel.workers import LocalProcesses
    from stlc.controller.training.budget import clock_of
    from stlc.rundir import RunDir

    torch.set_num_threads(1)  # for the few states of a box, threads cost more than they save
    seconds, measured = parse_seconds(budget), parse_clock(clock)
    source: PolicySource | _LoopSource
    if controller is None:
        if period is not None or system is not None or continuous:
            raise usage("--period, --system and --continuous are for a network: --controller FILE")
        folder = RunDir.open(run, runs)
        name, source = folder.shown, PolicySource(folder.path)
    else:
        name, source = run, _LoopSource(run, system, controller, period, continuous)
    with driving(python):
        subject = source.load()
    with nullcontext() if jobs == 1 else SharedExaminer(source, LocalProcesses(jobs, fresh=True)) as shared:
        tick = clock_of(measured)
        if shared is not None and measured == "processor":
            tick = shared.processor_time
        verifier = Verifier(subject, seed=seed, clock=tick, examiner=shared)
        with PULSE.doing("proving"):
            found = verifier.run(seconds, boxes=boxes)
    with PULSE.doing("proving boxes around random states"):
        near = verifier.around(states, seed=seed)
    record = Verified(name, found, near)
    lost = () if shared is None or not shared.lost else (_lost(shared.lost),)

    def show() -> None:
        show_diagnostics(lost)
        emit("\n".join(_lines(record)))

    return Answer(record, show, _exit_code(found, fail_under), lost)


def _lost(reasons: Sequence[str]) -> Diagnostic:
    """The finding R406 about batches of boxes that were lost with their processes."""
    count = f"{len(reasons):,} batch{'es' if len(reasons) > 1 else ''} of boxes"
    message = f"{count} stayed open: lost with the processes that examined them"
    return Diagnostic("R406", message, note=tuple(dict.fromkeys(reasons)))


@dataclass(frozen=True, slots=True)
class _LoopSource:
    """Closed loop of a system and a network, for this process and others.

    Attributes:
        spec: path or name of the specification.
        system: path or name of the system; None: that of the specification.
        controller: file of the network.
        period: control period with its unit; None: the time step.
        continuous: whether solutions of the differential equations are bounded, not the model's.
    """

    spec: str
    system: str | None
    controller: Path
    period: str | None
    continuous: bool

    def load(self) -> NetworkLoop:
        """Load the closed loop."""
        from stlc.assurance.verification.loop import NetworkLoop
        from stlc.assurance.verification.onnx_layers import read_onnx
        from stlc.controller.problem.load import load_task

        task = load_task(self.spec, self.system)
        dt = float(task.system.decl.dt)
        steps = 1.0 if self.period is None else parse_seconds(self.period) / dt
        if steps < 0.5 or abs(steps - round(steps)) > 1e-6:
            raise usage(f"the control period `{self.period}` is not a multiple of the time step {dt:g} s")
        return NetworkLoop(task, read_onnx(self.controller), round(steps), continuous=self.continuous)


def _exit_code(found: Verification, fail_under: float | None) -> int:
    if fail_under is not None:
        return 0 if found.proved >= fail_under else 1 if 1.0 - found.refuted < fail_under else 4
    if any(each.witness is not None for each in found.modes):
        return 1
    return 4 if found.open > 0.0 else 0


def _lines(told: Verified) -> Iterator[str]:
    """Lines of text that show the result of `stlc verify`."""
    found, modes = told.found, told.modes
    rows = [
        (
            visible(mode.result.mode.name or "initial set"),
            *map(_percent, (mode.probability, mode.result.proved, mode.result.refuted, mode.result.open)),
        )
        for mode in modes
    ]
    rows.append(("all", *map(_percent, (1.0, found.proved, found.refuted, found.open))))
    yield f"{visible(told.run)}    {found.seconds:.0f} s"
    yield ""
    yield table(rows, header=("initial states", "probability", "proved", "refuted", "open"))
    if told.states:
        yield ""
        yield (
            f"{told.states_proved} of {told.states} random initial states are in a proved box, "
            f"{told.states_violated} are violated; so at least {floored(told.states_share)} of all initial "
            "states have such a box (95 % confidence)"
        )
    known = [(mode.result.mode.name, each) for mode in modes if (each := mode.result.witness) is not None]
    for name, witness in sorted(known, key=lambda pair: pair[1].robustness)[:_MOST]:
        state = ", ".join(f"{each}={value:.6g}" for each, value in witness.state.items())
        yield ""
        yield (
            f"{visible(name or 'initial set')}: violated from {visible(state)}, "
            f"robustness {witness.robustness:+.3g}"
        )


def _percent(share: float) -> str:
    value = 100.0 * share
    return f"{value:.1f} %" if value >= 0.05 or value == 0.0 else f"{value:.1g} %"
