"""Parts of a controller as expressions of the IR (the compiler's intermediate representation).

The C header and the ONNX graphs are made from these expressions.
"""

from __future__ import annotations

import math

from stlc.compile.ir import nodes as ir
from stlc.controller.problem.task import Task


def observation(task: Task) -> list[ir.Num]:
    """Return the observation of the network, as expressions of the states."""
    system = task.system
    observed = system.decl.policy.observe or [ir.Signal(name) for name in system.decl.signature.names]
    return [*observed, *(ir.Signal(column.name) for column in system.added)]


def state_images(task: Task) -> dict[str, ir.Num]:
    """Return the states that the mirror symmetry of the system changes: name -> mirrored value.

    The mirrored value is an expression of the states, as in `{"y": -y}`. The key `mirror` of a system file
    declares the symmetry.
    """
    names = set(task.system.names)
    return {each.name: each.value for each in task.system.decl.policy.mirror if each.name in names}


def control_images(task: Task) -> dict[str, ir.Num]:
    """Return the mirrored value of every control under the symmetry of the system: name -> expression.

    The mirrored value of an unaffected control is the control itself. Angles are wrapped into their range.
    """
    images = {each.name: each.value for each in task.system.decl.policy.mirror}
    found: dict[str, ir.Num] = {}
    for each in task.system.decl.controls:
        image = images.get(each.name, ir.Signal(each.name))
        if each.squash == "angle":
            image = (image - each.low) % (2.0 * math.pi) + each.low
        found[each.name] = image
    return found
