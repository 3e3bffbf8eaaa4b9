"""Adam, the optimiser of the learners.

A step is a call of torch's function, not of the class `torch.optim.Adam`: the first step of the class imports
torch's compiler, which takes more than a second and is never used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

BETAS = 0.9, 0.999
EPSILON = 1e-8
MOMENTS = "step", "exp_avg", "exp_avg_sq"


class Adam:
    """Adam (Kingma and Ba 2015) with torch's fused step and the defaults of `torch.optim.Adam`.

    Args:
        parameters: the weights that are changed in place; those without a gradient are left alone.
    """

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        self._parameters = list(parameters)
        self._moments: dict[int, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        """Forget the gradients of all weights."""
        for weight in self._parameters:
            weight.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Change all weights by one step of the learning rate `rate`."""
        moved = [i for i, weight in enumerate(self._parameters) if weight.grad is not None]
        weights = [self._parameters[i] for i in moved]
        for i, weight in zip(moved, weights, strict=True):
            if i not in self._moments:
                count = torch.zeros((), dtype=torch.float32, device=weight.device)
                zeros = (torch.zeros_like(weight) for _ in BETAS)
                self._moments[i] = dict(zip(MOMENTS, (count, *zeros), strict=True))
        steps, means, squares = ([self._moments[i][name] for i in moved] for name in MOMENTS)
        adam(
            weights,
            [weight.grad for weight in weights if weight.grad is not None],
            means,
            squares,
            [],
            steps,
            fused=True,
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint, by the index of a weight and a name, such as `0.exp_avg`."""
        return {f"{i}.{name}": value for i, found in self._moments.items() for name, value in found.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from the tensors of a checkpoint."""
        for key, value in tensors.items():
            index, name = key.split(".")
            weight = self._parameters[int(index)]
            self._moments.setdefault(int(index), {})[name] = value.to(weight.device)
