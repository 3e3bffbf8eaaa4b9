"""Ensemble of probabilistic networks: a model of one step of a system, learnt from observed transitions.

The networks, their loss and their bounded variances follow Chua, Calandra, McAllister and Levine, "Deep
reinforcement learning in a handful of trials using probabilistic dynamics models" (NeurIPS 2018), Section 4
and Appendix A.1. Two more rules follow Janner, Fu, Zhang and Levine, "When to trust your model" (NeurIPS
2019): training ends when the error on validation data stops falling, and then the best networks are selected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

LOWEST, HIGHEST = -10.0, 0.5
"""Initial bounds on the logarithm of a variance, in units of the spread of the targets."""
BOUNDS = 0.01
"""Weight in the loss of the distance between the bounds on the logarithm of a variance."""
STILL = 1e-7
"""Standard deviation of a change, as a share of that of the state, below which the state is constant."""
GAIN = 0.01
"""Relative fall of a validation error that counts as an improvement (Janner et al. 2019)."""
FEWEST = 2
"""Number of validation samples below which all samples are used for training."""


class BatchedMlp(nn.Module):
    """Several MLPs of the same shape, evaluated together by one batched matrix product per layer.

    Args:
        count: number of networks, E.
        widths: number of inputs, of units in each hidden layer, and of outputs.
        activation: function between the layers.
        generator: source of the random initial weights. They are normal with standard deviation
            1 / (2 sqrt(inputs)), cut off at two standard deviations (Chua et al. 2018); biases are 0.
    """

    def __init__(
        self,
        count: int,
        widths: Sequence[int],
        *,
        activation: Callable[[Tensor], Tensor] = functional.silu,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self._activation = activation
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for inputs, outputs in pairwise(widths):
            std = 0.5 / math.sqrt(inputs)
            weight = torch.empty(count, inputs, outputs)
            nn.init.trunc_normal_(weight, 0.0, std, -2.0 * std, 2.0 * std, generator=generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(count, 1, outputs)))

    def forward(self, x: Tensor) -> Tensor:
        """Outputs of all networks: (E, B, inputs) -> (E, B, outputs)."""
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if index < last:
                x = self._activation(x)
        return x


@dataclass(frozen=True, slots=True)
class Fit:
    """Options of the training of an ensemble.

    Attributes:
        lr: learning rate of Adam.
        decay: factor of the penalty on the sum of squared weights.
        batch: number of samples per gradient step and network.
        epochs: maximum number of passes over the data.
        patience: number of passes after which training ends if no network has improved; 0: all passes are
            made.
        held: share of the samples held out for validation; 0: none.
    """

    lr: float = 1e-3
    decay: float = 1e-5
    batch: int = 256
    epochs: int = 20
    patience: int = 5
    held: float = 0.2


class Ensemble(nn.Module):
    """Ensemble of networks; each predicts the change of a state in one step, as a Gaussian distribution.

    Inputs are states and controls; targets are the changes of the states in one step. The networks learn from
    different bootstrap samples. Inputs and targets are normalised, since the components of a state have
    different units. Components that never change in the data are predicted not to change.

    Attributes:
        body: the networks, (E, B, inputs) -> (E, B, 2 outputs): means and logarithms of variances.
        lowest: learnt lower bounds on the logarithms of variances, (outputs,).
        highest: learnt upper bounds on the logarithms of variances, (outputs,).
        centre: mean of the inputs, (inputs,).
        spread: standard deviation of the inputs, (inputs,).
        drift: mean of the targets, (outputs,).
        scale: standard deviation of the targets, (outputs,); 0 for a component that never changes.
        elites: indices of the networks with the least validation error, (elites,).
    """

    centre: Tensor
    spread: Tensor
    drift: Tensor
    scale: Tensor
    elites: Tensor

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        networks: int = 7,
        elites: int = 5,
        hidden: Sequence[int] = (200, 200, 200, 200),
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.body = BatchedMlp(networks, [inputs, *hidden, 2 * outputs], generator=generator)
        self.lowest = nn.Parameter(torch.full((outputs,), LOWEST))
        self.highest = nn.Parameter(torch.full((outputs,), HIGHEST))
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("spread", torch.ones(inputs))
        self.register_buffer("drift", torch.zeros(outputs))
        self.register_buffer("scale", torch.ones(outputs))
        self.register_buffer("elites", torch.arange(min(elites, networks)))

    @property
    def networks(self) -> int:
        """Number of networks, E."""
        return len(self.body.weights[0])

    def normalise(self, inputs: Tensor, targets: Tensor) -> None:
        """Compute the means and standard deviations of the normalisation from training data.

        Args:
            inputs: samples of the inputs, (N, inputs).
            targets: their targets, (N, outputs); component i is the change of component i of the input.
        """
        spread = inputs.std(0)
        scale = targets.std(0)
        self.centre.copy_(inputs.mean(0))
        self.spread.copy_(torch.where(spread > STILL, spread, torch.ones_like(spread)))
        self.drift.copy_(targets.mean(0))
        still = scale <= STILL * self.spread[: len(scale)]
        self.scale.copy_(torch.where(still, torch.zeros_like(scale), scale))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log-variances of the normalised change, (change - `drift`) / `scale`.

        (E, B, inputs) -> two tensors (E, B, outputs).
        """
        mean, log = self.body((inputs - self.centre) / self.spread).chunk(2, -1)
        return mean, _bounded(log, self.lowest, self.highest)

    def loss(self, inputs: Tensor, targets: Tensor) -> Tensor:
        """Negative log-likelihood (Chua et al. 2018, Section 4), summed over the networks: ().

        Args:
            inputs: (E, B, inputs).
            targets: changes in physical units, (E, B, outputs).
        """
        mean, log = self(inputs)
        error = (mean - self._scaled(targets)).square()
        each = (error * torch.exp(-log) + log).mean((1, 2)).sum()
        loss: Tensor = each + BOUNDS * (self.highest.sum() - self.lowest.sum())
        return loss

    @torch.no_grad()
    def errors(self, inputs: Tensor, targets: Tensor) -> Tensor:
        """Mean squared error of each network's normalised predictions, all on the same samples: (E,).

        Args:
            inputs: (N, inputs).
            targets: changes in physical units, (N, outputs).
        """
        total, wanted = self.scale.new_zeros(self.networks), self._scaled(targets)
        for part, target in zip(torch.split(inputs, 2048), torch.split(wanted, 2048), strict=True):
            mean = self(part.expand(self.networks, -1, -1))[0]
            total += (mean - target).square().mean(2).sum(1)
        return total / len(inputs)

    @torch.no_grad()
    def variance(self, inputs: Tensor) -> Tensor:
        """Variance of the predicted change of the state in one step.

        The prediction is an equal mixture of the Gaussians of the elites (networks with the least validation
        error).

        (B, inputs) -> (B, outputs), in squared physical units.
        """
        mean, log = self(inputs.expand(self.networks, -1, -1))
        mean, log = mean[self.elites], log[self.elites]
        found: Tensor = (log.exp().mean(0) + mean.var(0, unbiased=False)) * self.scale.square()
        return found

    def predictor(self) -> Predictor:
        """Make a predictor, which draws samples of the change of the state, without gradient.

        The predictor holds a copy of the elites (networks with the least validation error): further training
        of the ensemble does not change it.
        """
        return Predictor(self)

    def _scaled(self, targets: Tensor) -> Tensor:
        unit = torch.where(self.scale > 0.0, self.scale, torch.ones_like(self.scale))
        scaled: Tensor = (targets - self.drift) / unit
        return scaled


def _bounded(log: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    """Limit logarithms of variances smoothly to their bounds (Chua et al. 2018, Appendix A.1)."""
    log = highest - functional.softplus(highest - log)
    return lowest + functional.softplus(log - lowest)


class Predictor:
    """Sampler of the change of a state in one step, as an ensemble predicts it.

    A sample is drawn from the Gaussian that one of the elites predicts, the networks with the least
    validation error.

    Attributes:
        elites: number of elites.
    """

    def __init__(self, ensemble: Ensemble) -> None:
        chosen = ensemble.elites
        self.elites = len(chosen)
        body = ensemble.body
        with torch.no_grad():
            self._layers = [
                (weight[chosen].clone(), bias[chosen].clone())
                for weight, bias in zip(body.weights, body.biases, strict=True)
            ]
            first, shift = self._layers[0]  # the normalisation of the inputs, folded into the first layer
            scaled = first / ensemble.spread[:, None]
            self._layers[0] = scaled, shift - ensemble.centre[None, None] @ scaled
            self._bounds = ensemble.lowest.clone(), ensemble.highest.clone()
            self._drift, self._scale = ensemble.drift.clone(), ensemble.scale.clone()

    @torch.no_grad()
    def __call__(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """Draw a sample of the change of the state for every input; network i predicts for `inputs[i]`.

        Args:
            inputs: (k, B, inputs), where k is at most `elites`.
            generator: source of the random numbers of the noise.

        Returns:
            Changes in physical units, (k, B, outputs).
        """
        count, x = len(inputs), inputs
        last = len(self._layers) - 1
        for index, (weight, bias) in enumerate(self._layers):
            x = torch.baddbmm(bias[:count], x, weight[:count])
            if index < last:
                functional.silu(x, inplace=True)
        mean, log = x.chunk(2, -1)
        noise = torch.randn(mean.shape, generator=generator)
        return (mean + noise * torch.exp(0.5 * _bounded(log, *self._bounds))) * self._scale + self._drift


def optimizer_of(ensemble: Ensemble, fit: Fit) -> torch.optim.Optimizer:
    """Make an Adam optimiser of all networks; weight decay does not apply to the bounds on variances."""
    groups = [
        {"params": list(ensemble.body.parameters()), "weight_decay": fit.decay},
        {"params": [ensemble.lowest, ensemble.highest], "weight_decay": 0.0},
    ]
    return torch.optim.Adam(groups, lr=fit.lr, fused=True)


def train_ensemble(
    ensemble: Ensemble,
    optimizer: torch.optim.Optimizer,
    inputs: Tensor,
    targets: Tensor,
    *,
    fit: Fit,
    generator: torch.Generator,
) -> float:
    """Train all networks, each on its own bootstrap sample; select the best ones, the elites.

    If there are validation data, every network keeps the weights with the least validation error, and
    training ends once no network has improved by 1 % within `fit.patience` passes.

    Args:
        ensemble: the networks; training continues from their present weights.
        optimizer: optimiser made by `optimizer_of`.
        inputs: (N, inputs).
        targets: (N, outputs).
        fit: options of the training.
        generator: source of all random numbers.

    Returns:
        Mean squared error of the elites on the validation data, or on the training data if there are no
        validation data. Targets are divided by their standard deviation first. NaN if a loss was not finite;
        training ends at once in this case.
    """
    ensemble.normalise(inputs, targets)
    order = torch.randperm(len(inputs), generator=generator)
    held = int(fit.held * len(inputs))
    held = held if held >= FEWEST and len(inputs) - held >= FEWEST else 0
    judged = order[:held] if held else order
    own = order[held:]
    draws = torch.randint(len(own), (ensemble.networks, len(own)), generator=generator)
    samples = own[draws]
    best = _Best(ensemble, ensemble.errors(inputs[judged], targets[judged]) if held else None)
    for _ in range(fit.epochs):
        samples = samples[:, torch.randperm(len(own), generator=generator)]
        for rows in torch.split(samples, fit.batch, 1):
            loss = ensemble.loss(inputs[rows], targets[rows])
            if not bool(torch.isfinite(loss)):
                return math.nan
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        if held and best.update(ensemble.errors(inputs[judged], targets[judged])) >= fit.patience > 0:
            break
    best.restore()
    errors = ensemble.errors(inputs[judged], targets[judged])
    ensemble.elites.copy_(errors.argsort(stable=True)[: len(ensemble.elites)])
    return float(errors[ensemble.elites].mean())


class _Best:
    """Store of each network's best weights so far: those with the least validation error.

    The method `restore` sets the networks to these weights. The object also counts the passes over the data
    since a network last improved.
    """

    def __init__(self, ensemble: Ensemble, errors: Tensor | None) -> None:
        self._ensemble, self._errors, self._idle = ensemble, errors, 0
        self._kept = [] if errors is None else [each.detach().clone() for each in ensemble.body.parameters()]

    def update(self, errors: Tensor) -> int:
        """Store the weights of the networks whose validation error has improved by 1 %.

        Args:
            errors: present validation errors, (E,).

        Returns:
            Number of calls of this method since any network last improved; 0 if one has improved now.
        """
        assert self._errors is not None
        better = errors < (1.0 - GAIN) * self._errors
        self._idle = 0 if bool(better.any()) else self._idle + 1
        self._errors = torch.where(better, errors, self._errors)
        for kept, now in zip(self._kept, self._ensemble.body.parameters(), strict=True):
            kept[better] = now.detach()[better]
        return self._idle

    @torch.no_grad()
    def restore(self) -> None:
        """Set every network to its stored weights; do nothing without validation data."""
        for kept, now in zip(self._kept, self._ensemble.body.parameters(), strict=False):
            now.copy_(kept)
