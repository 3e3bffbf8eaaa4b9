"""Options of a training, as arguments of a function and on the command line; no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from stlc.controller.run.config import DRIVES, HELD_OUT
from stlc.controller.training.budget import StepSchedule
from stlc.diagnostics import usage
from stlc.options import Option, Options, parse_count
from stlc.registry import METHODS


def parse_method(name: str) -> str:
    """Return the name of the training method with a name, or whose file it names.

    Raises UsageError (U101) if there is none.
    """
    name = METHODS.chosen(name)
    if name not in METHODS:
        raise usage(f"there is no method `{name}`", METHODS.suggest(name))
    return name


def parse_steps(text: str) -> int | StepSchedule:
    """Parse the steps of a training: a number of steps, or a schedule that was recorded by another run.

    A run with a time budget adjusts its total number of steps as it proceeds, and records these totals as a
    schedule. In `10000,1240@10` the total is 10000 at first, and 1240 after step 10; `simulations=6@400` is a
    round of falsification after step 400.
    """
    if text.strip().isdecimal():
        return parse_count(text, "--steps")
    try:
        return StepSchedule.parse(text)
    except ValueError as error:
        help_ = ("--steps 1200", "the schedule of a run is in its report and in its run.json")
        message = f"`--steps {text}` is no number of steps"
        raise usage(message, *help_, note=(str(error),)) from None


def parse_rate(text: str) -> float:
    """Parse a learning rate. Raises UsageError (U101) if it is not positive and finite."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise usage(f"`--lr {text}` is not a learning rate", "--lr 1e-3")
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions(Options):
    """Options of a training; None leaves the choice to the system file, then to the method.

    Attributes:
        method: How to train, see docs/methods.md; by default the system's, or guided.
        budget: Training time, such as 5min; the steps are adapted; by default 60s.
        clock: Clock of the budget; processor time is that of an idle machine; by default wall.
        steps (N): Steps of the optimiser instead of a budget, or a recorded schedule.
        seed: Seed of everything random; by default the system's.
        device: auto, cpu, cuda or cuda:N.
        threads: Threads of torch.
        plans: Plans that the network proposes.
        lr (X): Peak learning rate.
        batch: New states per step.
        held_out: Held-out starts of the verdict.
        drives: Drives after the training per guard, at most.
        options: An option of --method; repeatable.
        falsify: Also train on the states of drives that falsification makes fail.
    """

    method: Annotated[str | None, Option(metavar="|".join((*METHODS.installed, "FILE.py"))), parse_method] = (
        None
    )
    budget: Options.Seconds | None = None
    clock: Options.Clock = "wall"
    steps: Annotated[int | StepSchedule | None, Option(), parse_steps] = None
    seed: Options.Seed | None = None
    device: str = "cpu"
    threads: Options.Positive | None = None
    plans: Options.Positive | None = None
    lr: Annotated[float | None, Option(), parse_rate] = None
    batch: Options.Positive | None = None
    held_out: Options.Positive = HELD_OUT
    drives: Options.Natural = DRIVES
    options: Options.OfMethod = field(default_factory=dict)
    falsify: bool = False
