"""What a guard is asked to spare: numbers, one for all or by requirement, or what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from stlc.controller.guard.margin_calibration import SHARE, measured_margin
from stlc.diagnostics import Diagnostic, UsageError
from stlc.registry import closest

if TYPE_CHECKING:
    from stlc.controller.guard.guard import Mode
    from stlc.controller.guard.tightened import Spare
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

AUTO = "auto"
FORMS = "--margin 0.2, --margin NAME=0.2, --margin auto, or auto:95 to cover 95 % of plans, not 99"


@dataclass(frozen=True, slots=True)
class Asked:
    """Margins as they are asked for; see `parse_margins`.

    Attributes:
        every: of each safety requirement that is not named.
        named: requirement -> margin.
        share: of plans that what is measured covers; None where nothing is measured.
    """

    every: float = 0.0
    named: Mapping[str, float] = field(default_factory=dict)
    share: float | None = None

    def of(self, task: Task, policy: Policy, mode: Mode, replan: int = 1) -> Spare:
        """The margins of a task under its scenario, where everybody plans every `replan` steps.

        Raises UsageError (U101) where a name is no safety requirement.
        """
        names = [rule.name for rule in task.compiled.safety]
        for name in self.named:
            if name not in names:
                near = closest(name, names)
                help_ = (f"did you mean `{near}`?",) if near else ()
                listed = f"safety requirements: {', '.join(names) or 'none'}"
                raise UsageError(
                    Diagnostic("U101", f"`{name}` is no safety requirement", help=(*help_, listed))
                )
        found = dict.fromkeys(names, self.every)
        if self.share is not None and mode != "none":
            looks = 1 if mode == "full" else replan
            found |= measured_margin(task, policy, looks, self.share)
        found |= self.named
        return {name: margin for name, margin in found.items() if margin}


def parse_margins(texts: Sequence[str]) -> Asked:
    """Margins such as `0.2`, `avoid=0.2`, `auto`, `auto:99`; of several of a kind the last counts.

    Raises:
        UsageError: U101, one is none of these.
    """
    asked = Asked()
    for text in texts:
        name, equals, number = text.rpartition("=")
        kind, colon, percent = text.partition(":")
        if kind.strip() == AUTO:
            asked = Asked(asked.every, asked.named, _number(percent, text, 100.0) / 100 if colon else SHARE)
        elif equals:
            asked = Asked(asked.every, {**asked.named, name.strip(): _number(number, text)}, asked.share)
        else:
            asked = Asked(_number(text, text), asked.named, asked.share)
    return asked


def _number(text: str, whole: str, most: float = 1e9) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= most:
        raise UsageError(Diagnostic("U101", f"`{whole}` is no margin", help=(FORMS,)))
    return value
