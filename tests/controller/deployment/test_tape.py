from __future__ import annotations

from threading import Thread
from typing import Any

import numpy as np
import pytest
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


CALLS = {
    "random": [(), (3,), ((2, 2),), (3, np.float32), (None, np.float32)],
    "uniform": [(), (2.0, 4.0), ([0.0, 10.0], 20.0), (0.0, [1.0, 2.0], (3, 2)), (0.0, 1.0, 2)],
    "integers": [
        (5,),
        (2, 5),
        ([2, 10],),
        (0, [1, 5, 9]),
        (1, 6, None, np.int64, True),
        (1, 6, (2, 2), np.int8, True),
        (0, 2, 3, bool),
        (4, None, None, int),
    ],
    "standard_normal": [(), (3,), (2, np.float32)],
    "normal": [(), (1.0, 2.0), ([0.0, 5.0], 1.0), (0.0, [1.0, 2.0, 3.0]), (np.zeros(3), 1.0), (0, 1, (2, 3))],
    "permutation": [(4,), ([3, 5, 7],), (np.arange(6).reshape(2, 3), 1)],
    "choice": [
        (5,),
        (5, 3),
        (["a", "b"], 4),
        (5, 3, False),
        (5, (2, 2), False),
        (3, 2, True, [0.2, 0.3, 0.5]),
        (3, 2, False, [0.2, 0.3, 0.5]),
        (np.arange(6).reshape(2, 3), 4, True, None, 1),
        (np.arange(6).reshape(2, 3),),
    ],
}
"""Calls of the methods that read a point."""


@pytest.mark.apart
@pytest.mark.parametrize(("name", "args"), [(name, args) for name, calls in CALLS.items() for args in calls])
def test_numpy_draws_are_distributed_as_numpys(name: str, args: tuple[Any, ...]) -> None:
    points, shown = np.random.default_rng(1).random((400, 8)), []
    usual = np.random.default_rng(2)
    drawn = [getattr(usual, name)(*args) for _ in points]
    for point in points:
        taped = TapedGenerator(np.random.PCG64(5), lambda count, point=point: point[:count])
        shown.append(getattr(taped, name)(*args))
    one, two = drawn[0], shown[0]
    assert (type(two), np.shape(two)) == (type(one), np.shape(one))
    assert np.asarray(two).dtype == np.asarray(one).dtype
    if np.asarray(one).dtype.kind == "U":
        assert {*np.ravel(shown)} == {*np.ravel(drawn)}
        return
    one, two = (np.reshape(each, (400, -1)).astype(float) for each in (drawn, shown))
    spread = one.std(0).max()
    assert abs(one.mean(0) - two.mean(0)).max() <= 6 * spread / np.sqrt(200)
    assert two.std(0) == pytest.approx(one.std(0), rel=0.25)
    for column in range(1, two.shape[1]):  # a number each: without replacement they differ, too
        assert (two[:, column] != two[:, column - 1]).any()
    often = {each for each in one.ravel() if (one == each).mean() > 0.02}
    assert {*two.ravel()} >= often


def test_numpy_numbers_behind_the_point_are_as_seeded_and_wrong_arguments_are_numpys() -> None:
    taped = TapedGenerator(np.random.PCG64(5), lambda count: np.full(min(count, 2), 0.5))
    plain = np.random.Generator(np.random.PCG64(5))
    found = taped.normal(1.0, 2.0, 4)
    assert found[:2].tolist() == [1.0, 1.0]
    assert found[2:].tolist() == plain.normal(1.0, 2.0, 4)[2:].tolist()
    assert taped.integers(2**62) == plain.integers(2**62)  # a seed
    assert taped.integers(2**62, 2**62 + 8) == 2**62 + 4
    given = np.zeros(3)
    assert taped.random(out=given) is given
    assert given[:2].tolist() == [0.5, 0.5]
    for name, args in (("integers", (5, 5)), ("normal", (0.0, -1.0)), ("choice", (2, 3, False))):
        with pytest.raises(ValueError, match=r"low|scale|larger"):
            getattr(taped, name)(*args)
    with pytest.raises(TypeError):
        taped.integers(1, hihg=3)


def test_ends_of_torchs_whole_numbers_may_have_names() -> None:
    points = torch.full((1, 9), 0.999, dtype=torch.float64)
    generator, tape = torch.Generator().manual_seed(0), Tape(points)
    tape.own([generator])
    with tape.drawing():
        assert torch.randint(3, high=6, size=(1,), generator=generator).item() == 5
        assert torch.randint(low=3, high=6, size=(1,), generator=generator).item() == 5
        assert torch.randint(high=6, size=(1,), generator=generator).item() == 5
        assert torch.randint(0, np.int64(6), (1,), generator=generator).item() == 5


def test_uniform_numbers_of_any_precision_are_below_one() -> None:
    generator, tape = torch.Generator().manual_seed(0), Tape(torch.ones((1, 4), dtype=torch.float64))
    tape.own([generator])
    with tape.drawing(0):
        assert torch.rand(1, generator=generator).item() < 1.0
        assert torch.rand(1, generator=generator, dtype=torch.float16).item() < 1.0
        rng = np.random.default_rng(0)
    assert rng.random(dtype=np.float32) < 1.0
    assert rng.random() < 1.0


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
