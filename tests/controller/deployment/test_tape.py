from __future__ import annotations

from threading import Thread

import numpy as np
import torch

from stlc.controller.deployment.tape import MOST_NUMBERS, Tape, TapedGenerator


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


def test_numpy_generators_that_a_world_seeds_read_the_point_too():
    points = torch.tensor([[0.25, 0.5, 0.999, 0.0, 0.9, 0.1, 0.5, 0.5, 0.75, 0.3]], dtype=torch.float64)
    tape, usual = Tape(points), np.random.default_rng
    with tape.drawing(0):
        rng = np.random.default_rng(7)
    assert np.random.default_rng is usual
    assert isinstance(rng, TapedGenerator)
    assert rng.random() == 0.25
    assert rng.uniform(2.0, 4.0) == 3.0
    assert rng.integers(10) == 9
    assert rng.permutation(3).tolist() == [0, 2, 1]
    assert rng.standard_normal() == 0.0
    assert rng.choice(["a", "b"], p=[0.5, 0.5]) == "b"
    assert rng.choice([3, 5, 7, 9]) == 9
    assert rng.uniform(0, 10, 3)[0] == 3.0
    assert tape.used == [12]
    one, two = (TapedGenerator(usual(3).bit_generator) for _ in range(2))
    assert one.random(4).tolist() == two.random(4).tolist()  # without a point, drawn as seeded
    assert sorted(one.choice(5, 3, replace=False).tolist()) == sorted(set(two.choice(5, 3, False).tolist()))


def test_other_threads_draw_as_usual():
    tape, found = Tape(torch.full((1, 8), 0.5, dtype=torch.float64)), []

    def other() -> None:
        found.append(torch.rand(1, generator=torch.Generator().manual_seed(0)).item())
        found.append(isinstance(np.random.default_rng(0), TapedGenerator))

    with tape.drawing(0):
        thread = Thread(target=other)
        thread.start()
        thread.join()
    assert found == [torch.rand(1, generator=torch.Generator().manual_seed(0)).item(), False]
    assert tape.used == [0]
