"""Training options of the user, and the options of a run resolved from them by a method."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import torch

from stlc.controller.options import MOST, Bounds, bounds_of, value_of
from stlc.controller.training.budget import Clock, StepSchedule
from stlc.diagnostics import usage
from stlc.native import cores
from stlc.registry import METHODS, PLANNERS, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.problem.task import Task

ENGINE_VERSION = 4
"""Version of the training engine; results of older versions are recomputed."""

DRIVES = 400
"""Default maximum number of closed-loop runs after training, for each kind of guard."""
HELD_OUT = 5000
HELD_OUT_SEED = 981_273
"""Seed of the held-out states: used for the final evaluation only, never during training or tuning."""

MISSION_HOLD = 0.7
"""Share of steps at peak learning rate on missions, whose training states change as the policy improves."""
MISSION_MOST = 128
"""Maximum number of hard states per search round on missions, where many hard states are similar."""


@dataclass(frozen=True, slots=True)
class PlannerChoice:
    """A planner for closed-loop planning, with its options.

    Attributes:
        name: name in `stlc.registry.PLANNERS`.
        options: options of the planner, name -> text.
        seconds: processor time for each plan, in seconds.
        evaluations: maximum number of candidate plans that are judged to find a plan; None for no limit.
    """

    name: str
    options: Mapping[str, str]
    seconds: float
    evaluations: int | None = None


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Options of the user; None leaves the choice to the system file, then to the method.

    Attributes:
        method: name of a training method, see `stlc.registry.METHODS`, or path of its file.
        budget: training time in seconds, final evaluation included; the number of steps is adapted to it.
        clock: clock that measures the budget: `wall` time or `processor` time.
        steps: number of training steps, or the recorded schedule of an earlier run, which is followed again;
            takes precedence over `budget`.
        seed: seed of all random numbers in training.
        device: torch device.
        threads: number of threads of torch; None: all cores, less one if a search runs concurrently.
        plans: number of plans that the network proposes per state.
        lr: peak learning rate.
        batch: number of newly drawn states per step.
        held_out: number of initial states of the final evaluation, on which no policy is trained.
        drives: maximum number of closed-loop simulations after the training, for each kind of guard (a guard
            checks plans at run time); 0: none.
        planner: planner of the method `plan`, with its options.
        options: options that only this method has, name -> text.
        falsify: whether states of failing closed-loop drives are mixed into the training.
    """

    method: str | None = None
    budget: float | None = None
    steps: int | StepSchedule | None = None
    seed: int | None = None
    device: str = "cpu"
    threads: int | None = None
    plans: int | None = None
    lr: float | None = None
    batch: int | None = None
    held_out: int = HELD_OUT
    clock: Clock = "wall"
    drives: int = DRIVES
    planner: PlannerChoice | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    falsify: bool = False


@dataclass(frozen=True, slots=True)
class ResolvedConfig:
    """Resolved options of a run.

    Fresh states are newly drawn initial states; hard states are those from which the policy's plans failed. A
    search round (validation) judges the policy's plans from fresh states, and starts a search for plans where
    they fail.

    Attributes:
        method: name of the method.
        seed: seed of all random numbers.
        hidden: widths of the network's hidden layers.
        plans: number of plans that the network proposes per state.
        varied: True if changed copies of the best plan are tried where no proposed plan satisfies the
            specification.
        batch: number of fresh states per step.
        hard: number of hard states per step. A hard state is used once the search has found a plan for it,
            so the first steps have none.
        lr: peak learning rate.
        warmup: share of the steps over which the learning rate rises if `hold` is 0.
        hold: share of the steps at the peak learning rate. If it is positive, the learning rate rises to the
            peak in a fixed number of steps.
        clip: bound on the norm of the gradient.
        average: decay of the moving average of the weights.
        pool: number of fresh states judged per search round.
        every: steps between search rounds.
        most: maximum number of hard states from which a search round searches.
        slope: k in the smooth switch (1 + tanh(k x)) / 2, where x is the distance to a switching condition
            of the dynamics. In gradients, the smooth switch takes the place of the exact one.
        imitation: weight of the imitation loss, the distance to the plan that the search found.
        share: weight with which the mean loss of all plans of a state is added to the loss of its best plan.
        performance: weight of the performance terms in the loss.
        held_out: number of initial states of the final evaluation, on which no policy is trained.
        threads: number of threads of torch, on which the rounding of sums depends; 0: not changed.
        samples: size of a fixed training set; 0: fresh states in every step.
        clock: clock of budgets and recorded times: `wall` or `processor`.
        ranks: number of processes that train together, each with its own batch.
        drives: maximum number of closed-loop simulations after the training, for each kind of guard (a guard
            checks plans at run time).
        falsify: whether states of failing closed-loop drives are mixed into the training; see
            `stlc.controller.training.failures`.
    """

    method: str
    seed: int
    hidden: tuple[int, ...]
    plans: int
    batch: int
    hard: int
    lr: float
    warmup: float = 0.03
    hold: float = 0.0
    clip: float = 1.0
    average: float = 0.99
    pool: int = 2048
    every: int = 50
    most: int = 768
    slope: float = 5.0
    imitation: float = 1.0
    share: float = 0.05
    performance: float = 0.3
    varied: bool = False
    held_out: int = HELD_OUT
    threads: int = 0
    samples: int = 0
    clock: Clock = "wall"
    ranks: int = 1
    drives: int = DRIVES
    falsify: bool = False
    whole: bool = False


_MOST = {
    **dict.fromkeys(("hidden", "plans", "threads", "ranks"), 65_536),
    **dict.fromkeys(("batch", "hard", "pool", "most", "held_out", "samples", "drives"), 10**8),
    **dict.fromkeys(("warmup", "average"), 1.0),
    "hold": 0.999,
    "lr": sys.float_info.max,
    "seed": 2**63 - 1,
}
"""Upper bounds other than `MOST`: on shares, on options that determine memory use, and larger ones."""
MOST_TEXT = 1000


_POSITIVE = ("hidden", "plans", "batch", "pool", "every", "ranks")


def checked_config(config: ResolvedConfig) -> ResolvedConfig:
    """Return the options unchanged if all are valid.

    Raises:
        ValueError: an option has the wrong type, is out of its bounds, or names something unknown.
    """
    words = {
        "method": METHODS.names,
        "clock": get_args(Clock),
        "planner": PLANNERS.names,
    }
    for option in fields(config):
        value = getattr(config, option.name)
        if option.name in words:
            if value not in words[option.name]:
                known = ", ".join(words[option.name])
                raise ValueError(f"`{option.name}` is {value!r:.40}, none of {known}")
            continue
        if option.type in ("str", str):
            if not isinstance(value, str) or len(value) > MOST_TEXT:
                raise ValueError(f"`{option.name}` is {value!r:.40}")
            continue
        if option.type in ("bool", bool):
            if not isinstance(value, bool):
                raise ValueError(f"`{option.name}` is {value!r:.40}, neither true nor false")
            continue
        kinds = (int, float) if option.type in ("float", float) else (int,)
        general = Bounds(float(option.name in _POSITIVE), _MOST.get(option.name, MOST))
        bounds = bounds_of(option, general)
        each = value if option.name == "hidden" else (value,)
        fits = (isinstance(x, kinds) and not isinstance(x, bool) and x in bounds for x in each)
        if not all(fits):
            raise ValueError(f"`{option.name}` is {value!r:.40}, not {bounds}")
    return config


def method_name(task: Task, given: str | None) -> str:
    """Name of the training method: the given one, or that of the system file, or the default."""
    chosen = METHODS.chosen(given) if given else None
    return chosen or task.system.decl.train.method or METHODS.default


def resolve_config(task: Task, config: TrainConfig) -> ResolvedConfig:
    """Resolve the options of a run.

    An option that the user gave is taken first, then one in the system file, then the default of the method.

    Raises:
        UsageError: U101, there is no such method or option, or a value is invalid.
    """
    name = method_name(task, config.method)
    method = METHODS.get(name)
    found: ResolvedConfig = method.resolve(task, config)
    if config.falsify and not method.falsifies:
        able = ", ".join(each for each in METHODS.own if METHODS.get(each).falsifies)
        raise usage(f"method `{name}` cannot train with `--falsify`", f"methods that can: {able}")
    if isinstance(config.steps, StepSchedule) and config.steps.rounds and not config.falsify:
        raise usage("the schedule of `--steps` has rounds of falsification", "repeat it with --falsify")
    return _with_own(replace(found, method=name, falsify=config.falsify), config)


def _with_own(found: ResolvedConfig, config: TrainConfig) -> ResolvedConfig:
    """Set the options that only the method has to the values that the user gave as text.

    Raises:
        UsageError: U101, the method has no such option, or a value is invalid.
    """
    own = {each.name: each for each in fields(found)[len(fields(ResolvedConfig)) :]}
    changed: dict[str, Any] = {}
    for name, text in config.options.items():
        if name not in own:
            known = f"options: {', '.join(own)}" if own else "it has no options of its own"
            advice = did_you_mean(name, own, known)
            raise usage(f"method `{found.method}` has no option `{name}`", *advice)
        changed[name] = value_of(f"method `{found.method}`", own[name], text)
    advice = ("stlc train SPEC --option NAME=VALUE",) if changed else ()
    try:
        return checked_config(replace(found, **changed))
    except ValueError as error:
        raise usage(f"method `{found.method}`: {error}", *advice) from None


Options = TypeVar("Options", bound=ResolvedConfig)


def base_config(
    task: Task,
    config: TrainConfig,
    *,
    kind: type[Options],
    batch: int = 1,
    plans: int = 1,
    rate: float = 1e-3,
    searches: bool = False,
) -> Options:
    """Resolve the options that all methods have.

    An option that the user gave is taken first, then one in the system file, then the default.

    Args:
        task: problem to train for.
        config: the user's options.
        kind: type of the options; fields that a method adds keep their defaults.
        batch: default number of fresh states per step.
        plans: default number of plans of the network.
        rate: default learning rate.
        searches: whether a search runs concurrently with the training steps. If so, torch uses one core less,
            which is left to the search.
    """
    declared = task.system.decl.train
    mission = bool(task.compiled.timers)
    most, aside = int(torch.get_num_threads()), searches and config.device == "cpu"
    plans = config.plans or plans
    return kind(
        method="",
        seed=declared.seed if config.seed is None else config.seed,
        hidden=task.system.decl.policy.hidden,
        plans=plans,
        batch=config.batch or declared.batch or math.ceil(batch * task.window / task.horizon),
        hard=0,
        lr=config.lr or declared.lr or rate,
        hold=MISSION_HOLD if mission else 0.0,
        most=MISSION_MOST if mission else 768,
        share=0.05 if plans > 1 else 0.0,
        held_out=config.held_out,
        threads=config.threads or (max(1, min(most, cores() - 1)) if aside else most),
        clock=config.clock,
        drives=config.drives,
        whole=task.compiled.grid.end is not None,
    )
