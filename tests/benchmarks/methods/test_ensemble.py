"""The ensemble of probabilistic networks: what it learns, how sure it is, and that its state is whole."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks.methods._ensemble import BatchedMlp, Ensemble, Fit, optimizer_of, train_ensemble

pytestmark = pytest.mark.apart

NOISE = 0.1
MATRIX = torch.tensor([[0.5, -0.2, 1.0], [0.1, 0.3, -0.7]])
FIT = Fit(lr=3e-3, batch=64, epochs=12)


def linear(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Inputs, noisy changes with a column that is constant, and the changes without noise."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 2.0 * torch.rand(count, 3, generator=generator) - 1.0
    exact = torch.cat((inputs @ MATRIX.T, torch.zeros(count, 1)), 1)
    noise = NOISE * torch.randn(count, 3, generator=generator)
    noise[:, 2] = 0.0
    return inputs, exact + noise, exact


def small(seed: int = 0) -> Ensemble:
    generator = torch.Generator().manual_seed(seed)
    return Ensemble(3, 3, networks=4, elites=3, hidden=(32, 32), generator=generator)


def fitted(fit: Fit = FIT) -> tuple[Ensemble, float]:
    ensemble, (inputs, targets, _) = small(), linear(2000, 1)
    generator = torch.Generator().manual_seed(2)
    optimizer = optimizer_of(ensemble, fit)
    error = train_ensemble(ensemble, optimizer, inputs, targets, fit=fit, generator=generator)
    return ensemble, error


@pytest.fixture(scope="module")
def learnt() -> Ensemble:
    return fitted()[0]


def test_it_learns_a_linear_system_below_the_noise(learnt: Ensemble) -> None:
    inputs, _, exact = linear(500, 3)
    mean = learnt(inputs.expand(4, -1, -1))[0][learnt.elites].mean(0) * learnt.scale + learnt.drift
    assert float((mean - exact).detach()[:, :2].square().mean().sqrt()) < 0.5 * NOISE


def test_it_learns_the_noise(learnt: Ensemble) -> None:
    inputs = linear(500, 3)[0]
    noise = learnt.variance(inputs)[:, :2].mean(0).sqrt()
    assert bool(((noise > 0.7 * NOISE) & (noise < 1.5 * NOISE)).all())


def test_its_variance_grows_off_the_data(learnt: Ensemble) -> None:
    inputs = linear(200, 4)[0]
    near, far = (float(learnt.variance(scale * inputs)[:, :2].mean()) for scale in (1.0, 10.0))
    assert far > 5.0 * near


def test_samples_are_of_the_elites(learnt: Ensemble) -> None:
    inputs, count = linear(1, 5)[0], 4000
    predictor = learnt.predictor()
    samples = predictor(inputs.expand(3, count, -1), torch.Generator().manual_seed(0))
    mean, log = (part.detach()[learnt.elites] for part in learnt(inputs.expand(4, 1, -1)))
    expected = mean[:, 0] * learnt.scale + learnt.drift
    deviation = (0.5 * log[:, 0]).exp() * learnt.scale
    assert bool(((samples.mean(1) - expected).abs() <= 6.0 * deviation / math.sqrt(count) + 1e-6).all())
    torch.testing.assert_close(samples.std(1)[:, :2], deviation[:, :2], rtol=0.1, atol=0.0)


def test_constant_columns_stay_exactly(learnt: Ensemble) -> None:
    inputs = 5.0 * linear(50, 6)[0]
    samples = learnt.predictor()(inputs.expand(3, -1, -1), torch.Generator().manual_seed(0))
    assert bool((samples[..., 2] == 0.0).all())
    assert bool((learnt.variance(inputs)[:, 2] == 0.0).all())


def test_the_elites_have_the_least_error(learnt: Ensemble) -> None:
    assert len(set(learnt.elites.tolist())) == 3
    assert int(learnt.elites.max()) < 4


def test_the_same_seed_gives_the_same_networks(learnt: Ensemble) -> None:
    again = fitted()[0]
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in learnt.state_dict().items())


def test_it_trains_without_validation() -> None:
    ensemble, error = fitted(Fit(lr=3e-3, batch=64, epochs=2, held=0.0))
    assert 0.0 < error < 1.0
    assert torch.isfinite(ensemble.variance(torch.zeros(1, 3))).all()


def test_values_that_are_not_finite_are_told() -> None:
    inputs, targets, _ = linear(100, 1)
    targets[3, 0] = math.nan
    ensemble = small()
    generator = torch.Generator().manual_seed(0)
    error = train_ensemble(
        ensemble, optimizer_of(ensemble, FIT), inputs, targets, fit=FIT, generator=generator
    )
    assert math.isnan(error)


def test_batched_networks_are_those_one_by_one() -> None:
    body = BatchedMlp(3, [2, 5, 1], generator=torch.Generator().manual_seed(0))
    x = torch.linspace(-1.0, 1.0, 8).view(4, 2)
    both = body(x.expand(3, -1, -1)).detach()
    (first, last), (shift, offset) = (
        [each.detach() for each in part] for part in (body.weights, body.biases)
    )
    for index in range(3):
        inner = torch.nn.functional.silu(x @ first[index] + shift[index])
        torch.testing.assert_close(both[index], inner @ last[index] + offset[index])
