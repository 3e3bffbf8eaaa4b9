"""Results of a verification: what is proved and refuted, also around random states."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from stlc.activity import PULSE
from stlc.assurance.bounds import clopper_pearson_lower
from stlc.assurance.options import VerifyOptions
from stlc.assurance.verification.around import Around
from stlc.assurance.verification.verify import ModeResult, Verification, Verifier
from stlc.diagnostics import usage
from stlc.foreign import driving
from stlc.jsontext import Num
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.assurance.verification.loop import NetworkLoop
    from stlc.assurance.verification.plans import PolicySource
    from stlc.controller.run.run import Run


@dataclass(frozen=True, slots=True)
class VerifiedMode:
    """Proved, refuted and open shares of one mode of the initial states, and boxes around random states."""

    JSON: ClassVar = (
        "name=result.mode.name probability proved=result.proved refuted=result.refuted open=result.open "
        "proved_boxes examined_boxes=result.examined witness robustness states=near.states "
        "states_proved=near.proved states_violated=near.violated"
    )

    result: ModeResult
    probability: Num
    near: Around

    @property
    def proved_boxes(self) -> int:
        """Number of proved boxes."""
        return len(self.result.boxes)

    @property
    def witness(self) -> dict[str, Num] | None:
        """Initial state of the worst counterexample; None if none was found."""
        return None if self.result.witness is None else dict(self.result.witness.state)

    @property
    def robustness(self) -> Num | None:
        """Robustness from that state."""
        return None if self.result.witness is None else self.result.witness.robustness


@dataclass(frozen=True, slots=True)
class Verified:
    """Proved, refuted and open shares of the initial states of a run.

    `lost`: reasons for which batches of boxes were lost with their processes, and stayed open.
    """

    JSON: ClassVar = (
        "run seconds=found.seconds proved=found.proved refuted=found.refuted open=found.open states "
        "states_proved states_violated states_share modes"
    )

    run: str
    found: Verification
    near: Sequence[Around]
    lost: tuple[str, ...] = ()

    def __repr__(self) -> str:
        shares = (f"{word} {getattr(self.found, word):.3g}" for word in ("proved", "refuted", "open"))
        return f"Verified({self.run}: {', '.join(shares)})"

    @property
    def modes(self) -> list[VerifiedMode]:
        """The modes."""
        pairs = zip(self.found.modes, self.near, strict=True)
        return [VerifiedMode(each, self.found.probability(each), around) for each, around in pairs]

    @property
    def states(self) -> int:
        """Number of random states."""
        return sum(each.states for each in self.near)

    @property
    def states_proved(self) -> int:
        """Number of those in a proved box around them."""
        return sum(each.proved for each in self.near)

    @property
    def states_violated(self) -> int:
        """Number of those from which the policy's plan violates the specification."""
        return sum(each.violated for each in self.near)

    @property
    def states_share(self) -> Num:
        """Share of all initial states with such a box, at least, with 95 % confidence."""
        return clopper_pearson_lower(self.states_proved, self.states) if self.states else 0.0


@Options.taking(VerifyOptions)
def verify(run: Run | Path | str, options: VerifyOptions) -> Verified:
    """Prove on boxes of initial states that plans of a policy, or loops with a network, satisfy a spec.

    A box is proved if bounds on network, motion and robustness show that one proposal of the network
    satisfies the specification from every state in it, and refuted if the policy violates it from a sampled
    state.

    Args:
        run: the run, or its folder, number, words or specification, or `latest`; with the option
            `controller`, a specification.
        options: fields of `stlc.assurance.options.VerifyOptions`; times are in seconds.

    Raises:
        UsageError: U101, an option is for a network; the period is not a multiple of the time step.
        StlcError: a file is invalid, or its parts have no bounds.
    """
    import torch

    from stlc.assurance.verification.examine import SharedExaminer
    from stlc.assurance.verification.plans import PolicySource
    from stlc.controller.parallel.workers import LocalProcesses
    from stlc.controller.run.run import Run
    from stlc.controller.training.budget import clock_of

    torch.set_num_threads(1)  # for the few states of a box, threads cost more than they save
    source: PolicySource | _LoopSource
    if options.controller is not None:
        name, source = str(run), _LoopSource(str(run), options.controller, options)
    elif options.period is not None or options.system is not None or options.continuous:
        raise usage("--period, --system and --continuous are for a network: --controller FILE")
    else:
        folder = Run.folder(run, options.runs)
        name, source = folder.shown, PolicySource(folder.path)
    with driving(options.python):
        subject = source.load()
    jobs, tick = options.jobs, clock_of(options.clock)
    with nullcontext() if jobs == 1 else SharedExaminer(source, LocalProcesses(jobs, fresh=True)) as shared:
        if shared is not None and options.clock == "processor":
            tick = shared.processor_time
        verifier = Verifier(subject, seed=options.seed, clock=tick, examiner=shared)
        with PULSE.doing("proving"):
            found = verifier.run(options.budget, boxes=options.boxes)
    with PULSE.doing("proving boxes around random states"):
        near = verifier.around(options.states, seed=options.seed)
    return Verified(name, found, near, () if shared is None else tuple(shared.lost))


@dataclass(frozen=True, slots=True)
class _LoopSource:
    """Closed loop of the system of a specification and a network, for this process and others."""

    spec: str
    controller: Path
    options: VerifyOptions

    def load(self) -> NetworkLoop:
        """Load the closed loop."""
        from stlc.assurance.verification.loop import NetworkLoop
        from stlc.assurance.verification.onnx_layers import read_onnx
        from stlc.controller.problem.task import Task

        period, task = self.options.period, Task.load(self.spec, self.options.system)
        dt = float(task.system.decl.dt)
        steps = 1.0 if period is None else period / dt
        if steps < 0.5 or abs(steps - round(steps)) > 1e-6:
            raise usage(f"the control period {period:g} s is not a multiple of the time step {dt:g} s")
        return NetworkLoop(task, read_onnx(self.controller), round(steps), continuous=self.options.continuous)
