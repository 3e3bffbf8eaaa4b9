from __future__ import annotations

import torch

from stlc.controller.deployment.tape import MOST_NUMBERS, Tape


def test_given_numbers_replace_drawn_ones_and_the_rest_is_as_seeded():
    points = torch.tensor([[0.25, 0.5, 0.75]], dtype=torch.float64)
    generator, tape = torch.Generator().manual_seed(3), Tape(points)
    tape.own([generator])
    with tape.drawing():
        found = torch.rand(5, generator=generator, dtype=torch.float64)
    plain = torch.rand(5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert found[:3].tolist() == points[0].tolist()
    assert torch.equal(found[3:], plain[3:])
    assert tape.used == [5]


def test_each_call_reads_quantiles_of_its_distribution():
    points = torch.tensor([[0.5, 0.999, 0.0, 0.9, 0.1, 0.5]], dtype=torch.float64)
    generator, tape = torch.Generator().manual_seed(0), Tape(points)
    tape.own([generator])
    with tape.drawing():
        assert torch.randn(1, generator=generator, dtype=torch.float64).item() == 0.0
        assert torch.randint(3, 6, (2,), generator=generator).tolist() == [5, 3]
        assert torch.randperm(3, generator=generator).tolist() == [1, 2, 0]


def test_simulations_have_points_of_their_own():
    points = torch.tensor([[0.1], [0.9]], dtype=torch.float64)
    one, two, other = (torch.Generator().manual_seed(seed) for seed in range(3))
    tape = Tape(points)
    tape.own([one, two])
    with tape.drawing():
        drawn = [torch.rand(1, generator=each, dtype=torch.float64).item() for each in (two, one, other)]
    assert drawn[:2] == [0.9, 0.1]
    assert drawn[2] == torch.rand(1, generator=torch.Generator().manual_seed(2), dtype=torch.float64).item()
    again = Tape(points)
    with again.drawing(1):  # numbers from a generator that a world made
        assert torch.rand(1, generator=other, dtype=torch.float64).item() == 0.9


def test_seeds_and_tables_are_drawn():
    points = torch.full((1, 2 * MOST_NUMBERS), 0.5, dtype=torch.float64)
    generator, tape = torch.Generator().manual_seed(0), Tape(points)
    tape.own([generator])
    with tape.drawing():
        seed = torch.randint(2**62, (), generator=generator)
        table = torch.rand(MOST_NUMBERS + 1, generator=generator)
    same = torch.Generator().manual_seed(0)
    assert seed == torch.randint(2**62, (), generator=same)
    assert torch.equal(table, torch.rand(MOST_NUMBERS + 1, generator=same))
    assert tape.used == [0]


def test_outside_of_the_context_nothing_is_replaced():
    generator, tape = torch.Generator().manual_seed(0), Tape(torch.full((1, 4), 0.5, dtype=torch.float64))
    tape.own([generator])
    torch.rand(4, generator=generator)
    assert tape.used == [0]
