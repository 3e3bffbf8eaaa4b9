"""Initial states: order, local names, mixtures, rejection, reproducible draws."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from stlc.diagnostics import SystemFileError
from stlc.dynamics.model.samplers import Rows
from stlc.dynamics.system import System

Make = Callable[..., System]

PLAIN = """\
time: {{dt: 0.5 s, horizon: 4 steps}}
state: {{x: {{}}, y: {{}}}}
control: {{u: {{range: [-1, 1]}}}}
flow: {{x: u}}
init:
{init}
"""


def columns(system: System, n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    x, y = system.sample(n, seed=seed, dtype=torch.float64).unbind(1)
    return x, y


@pytest.mark.parametrize(
    ("expr", "mean", "deviation", "low", "high"),
    [
        ("uniform(2, 5)", 3.5, 3 / math.sqrt(12), 2, 5),
        ("normal(1, 2)", 1, 2, -math.inf, math.inf),
        ("truncnorm(0, 1, -1, 2)", 0.22962, 0.72129, -1, 2),
        ("truncnorm(0, 1, 9, 20)", 9.10849, 0.10732, 9, 20),
        ("truncnorm(1, 2, -39, -17)", -17.21705, 0.21461, -39, -17),
        ("bernoulli(0.3)", 0.3, math.sqrt(0.21), 0, 1),
        ("randint(3, 7)", 5, math.sqrt(2), 3, 7),
        ("choice(1, 4, 7)", 4, math.sqrt(6), 1, 7),
        ("2 * uniform(0, 1) - uniform(0, 1)", 0.5, math.sqrt(5 / 12), -1, 2),
        ("uniform(0, 1) - uniform(0, 1)", 0, math.sqrt(1 / 6), -1, 1),
    ],
)
def test_samplers_have_their_moments(
    make: Make, expr: str, mean: float, deviation: float, low: float, high: float
) -> None:
    n = 40_000
    x, _ = columns(make(PLAIN.format(init=f"  mixture: [{{draw: {{x: '{expr}', y: 0}}}}]")), n)
    assert float(x.mean()) == pytest.approx(mean, abs=5 * deviation / math.sqrt(n))
    assert float(x.std()) == pytest.approx(deviation, rel=0.03)
    assert low <= float(x.min())
    assert float(x.max()) <= high


def test_every_value_of_a_discrete_sampler_comes_equally_often(make: Make) -> None:
    init = "  mixture: [{draw: {x: 'randint(-1, 2)', y: 'choice(5, 6, 9)'}}]"
    x, y = columns(make(PLAIN.format(init=init)), 40_000)
    for values, options in ((x, (-1, 0, 1, 2)), (y, (5, 6, 9))):
        assert set(values.tolist()) == set(options)
        for option in options:
            share = float((values == option).double().mean())
            assert share == pytest.approx(1 / len(options), abs=0.012)


def test_later_lines_read_earlier_ones_and_local_names(make: Make) -> None:
    init = """\
  mixture:
    - draw: {x: "uniform(0, 1)", y: half + offset}
      let: {half: x / 2, offset: half + 3}
"""
    x, y = columns(make(PLAIN.format(init=init)), 100)
    assert torch.allclose(y, x + 3)


def test_a_local_name_is_drawn_once(make: Make) -> None:
    init = """\
  mixture: [{draw: {x: r, y: r}, let: {r: "uniform(0, 1)"}}]
"""
    x, y = columns(make(PLAIN.format(init=init)), 100)
    assert torch.equal(x, y)
    assert len(set(x.tolist())) == 100


def test_also_overrides_what_an_anchor_draws(make: Make) -> None:
    init = """\
  mixture:
    - &base {weight: 0, draw: {x: 1, y: x + 1}}
    - {<<: *base, weight: 1, also: {x: 5}}
"""
    x, y = columns(make(PLAIN.format(init=init)), 10)
    assert (x == 5).all()
    assert (y == 6).all()


def test_nested_choices_keep_rows_together(make: Make) -> None:
    init = """\
  mixture:
    - weight: 1
      draw: {x: "uniform(0, 1)"}
      choose:
        - {weight: 1, draw: {y: x + 10}}
        - weight: 3
          choose:
            - {draw: {y: x + 20}}
            - {draw: {y: x + 30}}
    - {weight: 1, draw: {y: "uniform(0, 1)", x: y - 5}}
"""
    n = 40_000
    x, y = columns(make(PLAIN.format(init=init)), n)
    shares = {-5: 0.5, 10: 0.125, 20: 0.1875, 30: 0.1875}
    offset = torch.where(x < 0, x - y, y - x).round()
    for value, share in shares.items():
        assert float((offset == value).double().mean()) == pytest.approx(share, abs=0.012)
    assert torch.isin(offset, torch.tensor(list(shares), dtype=torch.float64)).all()


def test_where_keeps_only_what_holds(make: Make) -> None:
    init = """\
  mixture: [{draw: {x: "uniform(-1, 1)", y: "uniform(-1, 1)"}}]
  where: [x^2 + y^2 <= 1, not (x > 0 and y > 0)]
"""
    system = make(PLAIN.format(init=init))
    x, y = columns(system, 5000)
    assert x.shape == (5000,)
    assert (x**2 + y**2 <= 1).all()
    assert not ((x > 0) & (y > 0)).any()
    assert system.initial.acceptance == pytest.approx(math.pi / 4 * 0.75, abs=0.03)
    assert system.probe() == ()


def test_few_accepted_states_are_a_warning(make: Make) -> None:
    init = """\
  mixture: [{draw: {x: "uniform(0, 1)", y: 0}}]
  where: [x < 0.004]
"""
    warnings = make(PLAIN.format(init=init)).probe()
    assert [warning.code for warning in warnings] == ["W601"]
    assert warnings[0].span is not None
    assert warnings[0].span.text == "[x < 0.004]"


def test_no_accepted_state_is_an_error(make: Make) -> None:
    init = """\
  mixture: [{draw: {x: "uniform(0, 1)", y: 0}}]
  where:
    - x > 2
"""
    with pytest.raises(SystemFileError, match="S301") as caught:
        make(PLAIN.format(init=init)).sample(10, seed=0)
    assert caught.value.exit_code == 3
    span = caught.value.diagnostics[0].span
    assert span is not None
    assert span.text == "- x > 2"


def test_the_same_seed_gives_the_same_states(car: System) -> None:
    first = car.sample(500, seed=1, dtype=torch.float64)
    assert torch.equal(first, car.sample(500, seed=1, dtype=torch.float64))
    assert torch.equal(first.float(), car.sample(500, seed=1))
    assert not torch.equal(first, car.sample(500, seed=2, dtype=torch.float64))
    assert not torch.equal(car.sample(500), car.sample(500))


def test_a_generator_moves_on_and_nothing_else_does(car: System) -> None:
    before = torch.get_rng_state()
    generator = torch.Generator().manual_seed(1)
    first, second = car.sample(50, generator=generator), car.sample(50, generator=generator)
    assert not torch.equal(first, second)
    assert torch.equal(first, car.sample(50, seed=1))
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_rows(car: System, n: int) -> None:
    assert car.sample(n, seed=0).shape == (n, 7)


def test_pick_ignores_situations_of_weight_0() -> None:
    rows = Rows(5000, torch.Generator().manual_seed(0))
    assert set(rows.pick([0.0, 2.0, 0.0, 1.0]).tolist()) == {1, 3}
