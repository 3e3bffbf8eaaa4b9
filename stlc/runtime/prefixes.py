"""Prefixes (first controls of a plan) that the backup policy tries.

In a prefix, each control takes one of a few given values at each step. Either all such prefixes are tried, or
a sample of them. Samples are computed with 64-bit integers, so that NumPy, torch and the exported C try the
same prefixes. There are two ways to sample:

"lattice" is Richtmyer's sequence of low discrepancy, in fixed point: entry d of point k is k sqrt(p_d) mod 1,
where p_d is the d-th prime (H. Niederreiter, "Quasi-Monte Carlo methods and pseudo-random numbers", Bull. AMS
84, 1978).

"random" is a hash of the index: splitmix64 (G. L. Steele et al., "Fast splittable pseudorandom number
generators", OOPSLA 2014).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import isqrt, prod
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

Sampling: TypeAlias = Literal["lattice", "random"]
SAMPLINGS: tuple[Sampling, ...] = get_args(Sampling)
SAMPLES = 16_384
"""Default maximum number of prefixes of one length that are tried."""
GOLDEN, FIRST, SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_WORD = 1 << 64


@dataclass(frozen=True, slots=True)
class PrefixGrid:
    """Grid of prefixes: sequences of the first T0 controls of a plan, each control from a set of values.

    Attributes:
        values: values that each control takes in the prefixes.
        lengths: lengths T0 of the prefixes, in the order in which they are tried.
        batch: number of trajectories evaluated at a time.
        samples: greatest number of prefixes of one length that are tried.
        sampling: method by which `samples` prefixes are chosen if the grid has more, "lattice" or "random".
    """

    values: tuple[tuple[float, ...], ...]
    lengths: tuple[int, ...]
    batch: int
    samples: int = SAMPLES
    sampling: Sampling = "lattice"

    def size(self, length: int) -> int:
        """Number of all prefixes of one length, M = L^(m T0), for L values of each of m controls."""
        return int(prod(len(values) for values in self.values) ** length)

    def count(self, length: int) -> int:
        """Number of prefixes of `length` steps that are tried: all of them, but at most `samples`."""
        return min(self.size(length), self.samples)

    def prefixes(self, length: int) -> NDArray[np.float64]:
        """Return the prefixes of `length` steps that are tried, (count, length, m)."""
        if self.size(length) > self.samples:
            levels = np.array([len(values) for values in self.values] * length, dtype=np.uint64)
            index = below(words(self.sampling, self.samples, len(levels)), levels)
            index = index.reshape(self.samples, length, len(self.values))
            return np.stack([np.array(each)[index[:, :, i]] for i, each in enumerate(self.values)], 2)
        actions = np.array(list(product(*self.values)), dtype=np.float64)
        places = len(actions) ** np.arange(length)[::-1]
        found: NDArray[np.float64] = actions[np.arange(self.size(length))[:, None] // places % len(actions)]
        return found


def generators(dims: int) -> tuple[int, ...]:
    """Fractional parts of the square roots of the first `dims` primes, in units of 2^-64."""
    primes: list[int] = []
    number = 2
    while len(primes) < dims:
        if all(number % prime for prime in primes):
            primes.append(number)
        number += 1
    return tuple(isqrt(prime << 128) % _WORD for prime in primes)


def words(sampling: Sampling, count: int, dims: int) -> NDArray[np.uint64]:
    """Return the first `count` points of a sampling sequence in the unit cube, (count, dims).

    The coordinates are integers, in units of 2^-64.
    """
    if sampling == "lattice":
        steps = np.array(generators(dims), dtype=np.uint64)
        return np.arange(1, count + 1, dtype=np.uint64)[:, None] * steps
    place = np.arange(1, count * dims + 1, dtype=np.uint64).reshape(count, dims)
    word = place * np.uint64(GOLDEN)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(FIRST)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(SECOND)
    return word ^ (word >> np.uint64(31))


def below(word: NDArray[np.uint64], bounds: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Map numbers u in [0, 1), given in units of 2^-64, to integers: u times the bound, rounded down.

    `word`: the numbers, (…, dims); only their upper 32 bits are used. `bounds`: (dims,), less than 2^32. The
    results lie between 0 and the bound minus 1.
    """
    return (((word >> np.uint64(32)) * bounds) >> np.uint64(32)).astype(np.int64)
