"""Which parts of training run as emitted C, and why the others do not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import emit
from stlc.compile.backends.c.numbers import Untranslatable
from stlc.controller.problem.kernel import motion_of
from stlc.native import why_none
from stlc.toolchain import compiler

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig


def by_torch(task: Task, engine: ResolvedConfig, device: str) -> Mapping[str, str]:
    """Why torch does the work: for each part of training a reason, or "" where it runs as C.

    The parts are `verdicts` of plans, `search` for better ones and the `gradient` of robustness.
    """
    if device != "cpu":
        return dict.fromkeys(("verdicts", "search", "gradient"), f"the device is {device}")
    rules = [rule.formula for rule in task.rules]
    judged = "" if task.native is not None else _reason(lambda: emit(motion_of(task), rules))
    if engine.method == "gradient":
        gradient = "the paper's objective is smooth"
    elif judged or task.gradient is not None:
        gradient = judged
    else:
        gradient = _reason(lambda: emit_adjoint(motion_of(task), rules))
    searched = {"search": judged} if engine.method == "guided" else {}
    return {"verdicts": judged, **searched, "gradient": gradient}


def _reason(text: Callable[[], str]) -> str:
    """Why there is no library of a text."""
    if compiler() is None:
        return "there is no C compiler"
    try:
        return why_none(text())
    except Untranslatable as why:
        return f"{why} has no C form"
