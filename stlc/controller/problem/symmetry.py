"""Whether a declared mirror is a symmetry: images must move, and satisfy, as what they are images of does.

Margins may differ: `g > 0 -> ...` says the same of an image of g, and is as far from the truth as g says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.controller.problem.task import satisfied
from stlc.diagnostics import Diagnostic, SystemFileError

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

SAMPLES = 1024
NEAR = 1e-6
"""What rounding may change, relative to 1 or to the value, whichever is larger."""
ODD = 0.02
"""Share of samples that may disagree: rounding decides where a switch is nearly tied."""


def check_mirror(task: Task) -> None:
    """Drive random states and their images, and compare.

    Raises SystemFileError (S304) where they differ: the mirror is no symmetry of system and specification.
    """
    mirror = task.system.mirror
    if mirror is None:
        return
    generator = torch.Generator().manual_seed(0)
    x0 = task.sample(SAMPLES, generator=generator, dtype=torch.float64)
    low, high = task.system.control_low.double(), task.system.control_high.double()
    shape = (SAMPLES, task.horizon, len(low))
    u = low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)
    image, there = mirror.states(x0), mirror.plans(u)
    _compare(task, task.names, mirror.states(image), x0, "the image of the image of a state")
    _compare(task, task.system.control_names, mirror.plans(there), u, "the image of the image of a control")
    one, two = task.judge(x0, u), task.judge(image, there)
    names = tuple(f"`{rule.name}`" for rule in task.rules)
    last = torch.stack([column[-1] for column in one.columns.values()], -1)
    moved = torch.stack([column[-1] for column in two.columns.values()], -1)
    _compare(task, task.names, moved, mirror.states(last), "where the image of a state gets to")
    there_true, here_true = (satisfied(each.requirements).double() for each in (two, one))
    _compare(task, names, there_true, here_true, "whether an image satisfies a requirement")


def _compare(task: Task, names: tuple[str, ...], found: Tensor, wanted: Tensor, what: str) -> None:
    """Report the column that differs most, where more of its rows do than a near-tie explains."""
    found, wanted = found.reshape(-1, len(names)), wanted.reshape(-1, len(names))
    off = ~torch.isclose(found, wanted, rtol=NEAR, atol=NEAR, equal_nan=True)
    shares = off.double().mean(0)
    worst = int(shares.argmax())
    if float(shares[worst]) <= ODD:
        return
    row = int(off[:, worst].nonzero()[0])
    raise SystemFileError(
        Diagnostic(
            "S304",
            f"the `mirror` of the policy is not a symmetry: {what} differs in {names[worst]}",
            task.system.decl.policy.mirror_span,
            "declared here",
            help=("write the image of every state and control that changes sides, or leave `mirror` out",),
            note=(
                f"{float(found[row, worst]):.6g} instead of {float(wanted[row, worst]):.6g} for one of "
                f"{SAMPLES} random states, and something of the kind for {float(shares[worst]):.0%} of them",
            ),
        )
    )
