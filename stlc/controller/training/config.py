"""Training options of the user, from which a method resolves those of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from stlc.controller.options import value_of
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.budget import StepSchedule
from stlc.controller.training.options import TrainOptions
from stlc.diagnostics import usage
from stlc.native import cores
from stlc.registry import METHODS

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner_policy import PlannerChoice

ENGINE_VERSION = 4
"""Version of the training engine; results of older versions are recomputed."""

MISSION_HOLD = 0.7
"""Share of steps at peak learning rate on missions, whose training states change as the policy improves."""
MISSION_MOST = 128
"""Maximum number of hard states per search round on missions, where many hard states are similar."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(TrainOptions):
    """Options of a training, and the planner of the method `plan`."""

    planner: PlannerChoice | None = None


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
            raise usage(f"method `{found.method}` has no option `{name}`").near(name, own, known)
        changed[name] = value_of(f"method `{found.method}`", own[name], text)
    advice = ("stlc train SPEC --option NAME=VALUE",) if changed else ()
    try:
        return replace(found, **changed).checked()
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
