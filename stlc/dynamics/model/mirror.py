"""Mirror symmetries of a system: maps of states and controls under which the dynamics are invariant.

A ship on the left of a river is the mirror image of one on the right. A policy that uses this symmetry learns
on half of the state space and covers all of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from stlc.compile.namespace import Ops
    from stlc.dynamics.declaration.motion import Assign
    from stlc.dynamics.declaration.schema.names import ControlDecl


class Mirror:
    """The mirror symmetry that `policy: {mirror: …}` declares: a map of states and of controls.

    Applied twice, the map gives the original state.

    Attributes:
        side: index of the column that tells a state from its mirror image. The state with the larger value in
            this column is the representative of the two: the state in which the policy is evaluated.
    """

    def __init__(
        self, images: Sequence[Assign], names: Sequence[str], controls: Sequence[ControlDecl]
    ) -> None:
        """Compile the images of states and controls; the first of `images` must be the image of a state."""
        self._names = tuple(names)
        self._controls = tuple(controls)
        known = {control.name for control in controls}
        self._states = ArrayProgram({each.name: each.value for each in images if each.name not in known})
        self._inputs = ArrayProgram({each.name: each.value for each in images if each.name in known})
        self.side = self._names.index(images[0].name)

    def states(self, x: Tensor) -> Tensor:
        """Return the mirror images of states: (…, n) -> (…, n)."""
        return _applied(self._states, x, self._names)

    def plans(self, u: Tensor) -> Tensor:
        """Return the mirror images of controls: (…, m) -> (…, m).

        An angle is wrapped into the turn that begins at the lower end of its range.
        """
        moved = _applied(self._inputs, u, [control.name for control in self._controls])
        for index, each in enumerate(self._controls):
            if each.squash == "angle":
                moved[..., index] = torch.remainder(moved[..., index] - each.low, 2.0 * torch.pi) + each.low
        return moved

    def image_of_states(self, states: Mapping[str, Any], ops: Ops) -> dict[str, Any]:
        """Return the states that the mirror changes, over any array library: name -> array."""
        return self._states(states, ops) if self._states.columns else {}

    def image_of_controls(self, controls: Mapping[str, Any], ops: Ops) -> dict[str, Any]:
        """Return the controls that the mirror changes, over any array library, without wrapping angles."""
        return self._inputs(controls, ops) if self._inputs.columns else {}

    def fold(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map states (B, n) to their representatives (B, n).

        The representative of a state is either the state itself or its mirror image (see `side`). Returns
        the representatives, and a mask (B,) of the states that were replaced by their mirror images.
        """
        image = self.states(x)
        swapped = x[..., self.side] < image[..., self.side]
        return torch.where(swapped[..., None], image, x), swapped


def _applied(program: ArrayProgram, x: Tensor, names: Sequence[str]) -> Tensor:
    """Return `x` (…, k), in which the outputs of `program` replace the columns of the same names.

    `names` are the names of all k columns.
    """
    columns = dict(zip(names, x.unbind(-1), strict=True))
    images = program(columns, TORCH) if program.columns else {}
    return torch.stack([images.get(name, column) for name, column in columns.items()], -1)
