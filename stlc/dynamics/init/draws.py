"""Random numbers from expressions: `uniform`, `normal` and their like, with an explicit generator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import sampler_names
from stlc.compile.semantics.switch import Hard
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.model.algebra import map_parts

_HARD = Hard()
_SAMPLERS = frozenset(sampler_names())


@dataclass(frozen=True, slots=True)
class Rows:
    """Number of rows to draw, and a random generator; float64 on the generator's device."""

    count: int
    generator: torch.Generator

    def _drawn(self, sampler: Callable[..., Tensor]) -> Tensor:
        generator = self.generator
        return sampler(self.count, generator=generator, dtype=torch.float64, device=generator.device)

    def uniforms(self) -> Tensor:
        """Uniform numbers in [0, 1), (count,)."""
        return self._drawn(torch.rand)

    def normals(self) -> Tensor:
        """Standard normal numbers, (count,)."""
        return self._drawn(torch.randn)

    def blank(self) -> Tensor:
        """Zeros, (count,), to broadcast constants."""
        return torch.zeros(self.count, dtype=torch.float64, device=self.generator.device)

    def pick(self, weights: Sequence[float]) -> Tensor:
        """Random indices with probabilities proportional to `weights`, (count,)."""
        edges = torch.tensor(weights, dtype=torch.float64).cumsum(0)
        edges = (edges / edges[-1])[:-1].to(self.generator.device)
        return torch.bucketize(self.uniforms(), edges, right=True)


@dataclass(frozen=True, slots=True)
class _Call:
    """One occurrence of a sampler; equal expressions are drawn independently."""

    name: str
    sampler: str
    args: ArrayProgram
    arity: int


class Drawing:
    """An assignment with its samplers compiled."""

    def __init__(self, assign: Assign) -> None:
        self.name = assign.name
        self._calls: list[_Call] = []
        self._seen: dict[int, ir.Num] = {}
        self._program = ArrayProgram({assign.name: self._extract(assign.value)})
        self._seen.clear()

    def __call__(self, env: Mapping[str, Tensor], rows: Rows) -> Tensor:
        """Value in every row, (count,) float64; `env` holds at least one (count,) column."""
        if self._calls:
            env = dict(env)
            for call in self._calls:
                args = call.args(env, TORCH, _HARD)
                env[call.name] = _draw(call.sampler, [args[str(i)] for i in range(call.arity)], rows)
        value: Tensor = self._program(env, TORCH, _HARD)[self.name]
        return value.expand(rows.count)

    def _extract(self, num: ir.Num) -> ir.Num:
        """The number with every sampler replaced by a column drawn before."""
        if id(num) in self._seen:
            return self._seen[id(num)]
        if isinstance(num, ir.Op) and num.name in _SAMPLERS:
            args = {str(i): self._extract(arg) for i, arg in enumerate(num.args)}
            name = f"draw#{len(self._calls)}"
            self._calls.append(_Call(name, num.name, ArrayProgram(args), len(args)))
            found: ir.Num = ir.Signal(name)
        else:
            found = map_parts(num, self._extract)
        self._seen[id(num)] = found
        return found


def _draw(sampler: str, args: list[Tensor], rows: Rows) -> Tensor:
    """Draw from a sampler, one number per row."""
    match sampler, args:
        case "uniform", [low, high]:
            return torch.lerp(low, high, rows.uniforms())
        case "normal", [mean, deviation]:
            return mean + deviation * rows.normals()
        case "truncnorm", [mean, deviation, low, high]:
            below, above = (torch.special.ndtr((end - mean) / deviation) for end in (low, high))
            quantile = torch.lerp(below, above, rows.uniforms())
            return torch.clamp(mean + deviation * torch.special.ndtri(quantile), low, high)
        case "bernoulli", [chance]:
            return (rows.uniforms() < chance).to(torch.float64)
        case "randint", [low, high]:
            span = high - low + 1.0
            return low + torch.minimum(torch.floor(rows.uniforms() * span), span - 1.0)
        case "choice", options:
            index = torch.floor(rows.uniforms() * len(options)).to(torch.int64)
            return torch.stack(options).gather(0, index[None])[0]
        case _:
            raise ValueError(f"unknown sampler {sampler}")
