"""A guard that does not ship, `braking`: its own file, and the file of its stage."""

from __future__ import annotations

from pathlib import Path

GUARD = '''"""`braking`: full braking, before the shortest prefix."""

from stlc.controller.guard.kind import GuardKind

GUARD = GuardKind(
    name="braking",
    title="braking guard",
    cost=1.5,
    help="brakes first",
    stages=("full_braking", "prefix_shooting"),
    timed=False,
)
'''

STAGE = '''"""Full braking."""

import torch
from stlc.controller.guard.candidates import REPAIRED, Candidates
from stlc.controller.guard.stages import GuardStage


class Braking(GuardStage):
    def __init__(self, setup):
        self.task = setup.task

    def wanted(self, best):
        return torch.ones_like(best.is_safe)

    def propose(self, rejected, rows, deadline):
        low = self.task.system.control_low.to(rejected.x)
        plans = low.expand(len(rows), self.task.horizon, -1)
        return Candidates.judged(self.task, rejected.x[rows], plans, REPAIRED)


STAGE = Braking
'''

PACKAGES = {"kinds": "stlc.controller.guard.kinds", "stages": "stlc.controller.guard.stages"}
"""Folder -> package that it extends."""


def write_guard(folder: Path) -> str:
    """Write both files below `folder`, and return the name of the guard."""
    for name, text in (("kinds/braking.py", GUARD), ("stages/full_braking.py", STAGE)):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return "braking"
