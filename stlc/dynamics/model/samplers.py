"""Random initial states, drawn with an explicit generator.

A situation is one of several ways to draw a state. It is picked by its weight. Its variables are drawn in
order from samplers such as `uniform`. States that violate a condition of `where` are rejected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import sampler_names
from stlc.compile.namespace import Array, Ops
from stlc.diagnostics import Diagnostic, StlcError, SystemFileError
from stlc.dynamics.declaration.init import FileDecl, GridDecl, InitDecl, Situation
from stlc.dynamics.declaration.motion import Assign
from stlc.signature import Column
from stlc.trace import read_recording
from stlc.trace.enums import in_numbers
from stlc.trace.recording import Recording, conversion

Draw: TypeAlias = Callable[[str, list[Any]], Array]
"""Function from the name of a sampler, such as `uniform`, and its arguments to its value."""

_SAMPLERS = frozenset(sampler_names())
_FAR = 6.0
"""Deviations from the mean beyond which `truncnorm` computes with logarithms of probabilities."""
_TAIL_ROUNDS = 6
"""Rounds of Newton's method there: more than the numbers change in."""


@dataclass(slots=True)
class Rows:
    """Source of random numbers for drawing `count` states at once, one number per state.

    The numbers are float64, on the device of `generator`.
    """

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
        """Zeros, (count,). A constant that is added to them gets the shape of the random numbers."""
        return torch.zeros(self.count, dtype=torch.float64, device=self.generator.device)

    def pick(self, weights: Sequence[float]) -> Tensor:
        """Random indices into `weights`, (count,), with probabilities proportional to these weights."""
        edges = torch.tensor(weights, dtype=torch.float64).cumsum(0)
        edges = (edges / edges[-1])[:-1].to(self.generator.device)
        return torch.bucketize(self.uniforms(), edges, right=True)

    def index(self, count: int) -> Tensor:
        """Random indices from 0 to `count` - 1, (self.count,).

        They are drawn evenly: any two indices occur equally often, or one of them once more than the other.
        """
        generator, device = self.generator, self.generator.device
        rounds = -(-self.count // count)
        orders = [torch.randperm(count, generator=generator, device=device) for _ in range(rounds)]
        return torch.cat(orders)[: self.count] if orders else torch.zeros(0, dtype=torch.int64, device=device)

    def subset(self, at: Tensor) -> Rows:
        """Source of random numbers for the states with indices `at`, (k,)."""
        return Rows(len(at), self.generator)


@dataclass(frozen=True, slots=True)
class _Call:
    """One occurrence of a sampler, such as `uniform(0, 1)`, in an expression.

    Two occurrences are drawn independently, even if their texts are the same.

    Attributes:
        name: name of the column that receives the drawn numbers; it replaces the sampler in the expression.
        sampler: name of the sampler, such as `uniform`.
        args: program that computes the arguments of the sampler; its outputs are called "0", "1", ….
        arity: number of arguments.
    """

    name: str
    sampler: str
    args: ArrayProgram
    arity: int


class Drawing:
    """An assignment compiled for drawing.

    First the samplers in its value are drawn, then the value is computed from the drawn numbers.
    """

    def __init__(self, assign: Assign) -> None:
        self.name = assign.name
        self._calls: list[_Call] = []
        self._seen: dict[int, ir.Num] = {}
        self._program = ArrayProgram({assign.name: self._extract(assign.value)})
        self._seen.clear()

    def __call__(self, env: Mapping[str, Tensor], rows: Rows) -> Tensor:
        """Return the assigned values, one per drawn state: (count,), float64.

        `env` maps the names that the assignment reads to their values (count,); it must not be empty.
        """
        value: Tensor = self.value(env, TORCH, partial(_draw, rows=rows))
        return value.expand(rows.count)

    def value(self, env: Mapping[str, Array], ops: Ops, draw: Draw) -> Array:
        """Return the assigned values, where `draw` gives the value of each sampler.

        Args:
            env: name -> array, for the names that the assignment reads; it must not be empty.
            ops: the array library of `env`.
            draw: function from the name of a sampler and its arguments to its value.
        """
        if self._calls:
            env = dict(env)
            for call in self._calls:
                args = call.args(env, ops)
                env[call.name] = draw(call.sampler, [args[str(i)] for i in range(call.arity)])
        return self._program(env, ops)[self.name]

    @property
    def samplers(self) -> frozenset[str]:
        """Names of the samplers in the value, such as `uniform`."""
        return frozenset(call.sampler for call in self._calls)

    @property
    def reads(self) -> frozenset[str]:
        """Names of the columns that the assignment reads, in the arguments of its samplers, too."""
        programs = (self._program, *(call.args for call in self._calls))
        drawn = {call.name for call in self._calls}
        return frozenset().union(*(program.columns for program in programs)) - drawn

    def _extract(self, num: ir.Num) -> ir.Num:
        """Return the number with each sampler, such as `uniform(0, 1)`, replaced by a column.

        The samplers are appended to `_calls`.
        """
        if id(num) in self._seen:
            return self._seen[id(num)]
        if isinstance(num, ir.Op) and num.name in _SAMPLERS:
            args = {str(i): self._extract(arg) for i, arg in enumerate(num.args)}
            name = f"draw#{len(self._calls)}"
            self._calls.append(_Call(name, num.name, ArrayProgram(args), len(args)))
            found: ir.Num = ir.Signal(name)
        else:
            found = num.map_parts(self._extract)
        self._seen[id(num)] = found
        return found


def _draw(sampler: str, args: list[Tensor], rows: Rows) -> Tensor:
    """Draw one random number per state from the sampler called `sampler`, with arguments `args`."""
    match sampler, args:
        case "uniform", [low, high]:
            return torch.lerp(low, high, rows.uniforms())
        case "normal", [mean, deviation]:
            return mean + deviation * rows.normals()
        case "truncnorm", [mean, deviation, low, high]:
            first, last = ((end - mean) / deviation for end in (low, high))
            share = rows.uniforms()
            chance = torch.lerp(torch.special.ndtr(first), torch.special.ndtr(last), share)
            found: Tensor = torch.special.ndtri(chance)
            far = (first * last > 0.0) & (torch.minimum(first.abs(), last.abs()) > _FAR)
            if bool(far.any()):
                found = torch.where(far, _in_tail(first, last, share), found)
            return torch.clamp(mean + deviation * found, low, high)
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


def _in_tail(first: Tensor, last: Tensor, share: Tensor) -> Tensor:
    """Standard normal numbers from `first` to `last`, at the given shares of the probability between them.

    Both ends are far on one side, where only logarithms hold the probabilities.
    """
    one, other = first.abs(), last.abs()
    near, end = torch.minimum(one, other), torch.maximum(one, other)
    start, least = (torch.special.log_ndtr(-each) for each in (near, end))
    share = torch.where(one <= other, share, 1.0 - share)
    rest = torch.maximum(torch.log1p(share * torch.expm1(least - start)), least - start)
    x = torch.sqrt(near.square() - 2.0 * rest)
    for _ in range(_TAIL_ROUNDS):  # Newton's method; the slope is that of the logarithm, nearly
        x = x + (torch.special.log_ndtr(-x) - (start + rest)) / (x + 1.0 / x)
    return torch.copysign(x, first)


MAX_ROUNDS = 500
MAX_BATCH = 1 << 20
FEW = 0.01
"""Acceptance rate below which W601 is reported and training is refused."""
RATED = 10_000

SHUFFLED = 1 << 20
"""Grids up to this size are drawn in permutations; in larger ones each axis is drawn independently."""

Table = dict[str, Tensor]


class _Draws:
    """A situation (one of several ways to draw an initial state), compiled for drawing."""

    def __init__(self, situation: Situation) -> None:
        self.weight = situation.weight
        self.draws = tuple(Drawing(assign) for assign in situation.draws)
        self.mixture = _Mixture(situation.branches) if situation.branches else None
        self.points: _Grid | _File | None = None
        if isinstance(situation.points, GridDecl):
            self.points = _Grid(situation.points)
        elif situation.points is not None:
            self.points = _File(situation.points)

    def __call__(self, table: Table, rows: Rows) -> Table:
        """Draw `rows.count` states from this situation.

        `table` maps the names drawn before to their values, (count,). It is returned with the new values
        added.
        """
        if self.points is not None:
            table = {**table, **self.points(rows)}
        for drawing in self.draws:
            table = {**table, drawing.name: drawing(table, rows)}
        return self.mixture(table, rows) if self.mixture else table


class _Mixture:
    """Mixture of situations (ways to draw an initial state), compiled for drawing.

    For every state one situation is picked at random, by weight.
    """

    def __init__(self, situations: tuple[Situation, ...]) -> None:
        self.parts = tuple(_Draws(situation) for situation in situations)
        self.weights = [part.weight for part in self.parts]

    def __call__(self, table: Table, rows: Rows) -> Table:
        if len(self.parts) == 1:
            return self.parts[0](table, rows)
        picked = rows.pick(self.weights)
        where = [torch.nonzero(picked == index).flatten() for index in range(len(self.parts))]
        drawn = [
            part({name: column[at] for name, column in table.items()}, rows.subset(at))
            for part, at in zip(self.parts, where, strict=True)
        ]
        names = set(drawn[0]).intersection(*drawn[1:])
        home = torch.argsort(torch.cat(where))
        return {name: torch.cat([part[name] for part in drawn])[home] for name in names}


class InitialStates:
    """Distribution of the initial states of a declaration.

    Attributes:
        drawn: number of states proposed since construction.
        accepted: number of these that met every condition.
    """

    def __init__(self, decl: InitDecl, names: tuple[str, ...]) -> None:
        self.decl = decl
        self.names = names
        self.drawn = 0
        self.accepted = 0
        self._params = tuple(Drawing(assign) for assign in decl.params)
        self._mixture = _Mixture(decl.mixture)
        self._override = tuple(Drawing(assign) for assign in decl.override)
        self._computed = tuple(Drawing(assign) for assign in decl.computed)
        self._where = ArrayProgram({f"{i}": cond.indicator() for i, cond in enumerate(decl.where)})

    @property
    def acceptance(self) -> float:
        """Share of proposed states that were accepted; 1 before the first draw."""
        return self.accepted / self.drawn if self.drawn else 1.0

    def sample(self, n: int, generator: torch.Generator) -> Tensor:
        """Draw n initial states, (n, dim) float64 on the generator's device.

        Raises SystemFileError (S301) if (nearly) every proposed state is rejected.
        """
        if not self.decl.where:
            self.drawn, self.accepted = self.drawn + n, self.accepted + n
            return self._propose(n, generator)
        found: list[Tensor] = []
        missing, drawn, accepted = n, 0, 0
        for _ in range(MAX_ROUNDS):
            rate = max(accepted / drawn, 1e-4) if drawn else 0.5
            batch = min(int(missing / rate * 1.1) + 64, MAX_BATCH)
            proposed = self._propose(batch, generator)
            good = proposed[self.holds(proposed)]
            drawn, accepted = drawn + batch, accepted + len(good)
            found.append(good[:missing])
            missing -= len(found[-1])
            if not missing or (drawn >= 1_000_000 and accepted < drawn * 1e-5):
                break
        self.drawn, self.accepted = self.drawn + drawn, self.accepted + accepted
        if missing:
            raise self._rejected(drawn, accepted)
        return torch.cat(found)

    def _propose(self, n: int, generator: torch.Generator) -> Tensor:
        """Draw states (n, dim) without applying the conditions of `where`."""
        return self.proposed(Rows(n, generator))

    def proposed(self, rows: Rows) -> Tensor:
        """Draw states (n, dim) with the random numbers `rows`, without the conditions of `where`."""
        table = {"": rows.blank()}
        for drawing in self._params:
            table[drawing.name] = drawing(table, rows)
        table = self._mixture(table, rows)
        for drawing in (*self._override, *self._computed):
            table[drawing.name] = drawing(table, rows)
        return torch.stack([table[name] for name in self.names], 1)

    def completed(self, states: Tensor, keep: Collection[str] = ()) -> Tensor:
        """Compute the columns of states (n, dim) that follow from the others, but not those in `keep`."""
        return completed(states, self.names, [each for each in self._computed if each.name not in keep], {})

    def holds(self, states: Tensor) -> Tensor:
        """Mask (n,) of the states (n, dim) that meet every condition of `where`."""
        return self._each_holds(states).all(0)

    def _each_holds(self, states: Tensor) -> Tensor:
        """Mask (conditions, n): whether each of the states (n, dim) meets each condition of `where`."""
        env = dict(zip(self.names, states.unbind(1), strict=True))
        marks = self._where(env, TORCH)
        found = [mark.expand(len(states)) > 0.5 for mark in marks.values()]
        return torch.stack(found) if found else torch.ones(0, len(states), dtype=torch.bool)

    def require_many(self) -> None:
        """Draw 256 states; raise SystemFileError (S301) if less than 1 % of proposed states is accepted."""
        before = self.drawn, self.accepted
        self.sample(256, torch.Generator().manual_seed(0))
        drawn, accepted = self.drawn - before[0], self.accepted - before[1]
        if accepted < FEW * drawn:
            raise self._rejected(drawn, accepted)

    def _rejected(self, drawn: int, accepted: int) -> SystemFileError:
        message = f"of {drawn} initial states that were drawn, {accepted} meet every condition of `where`"
        proposed = self._propose(RATED, torch.Generator().manual_seed(0))
        rates = self._each_holds(proposed).double().mean(1).tolist()
        told = sorted(zip(rates, self.decl.where_text, strict=True))
        note = tuple(f"`{text}` holds for {rate:.2%} of what is drawn" for rate, text in told)
        return SystemFileError(
            self._finding("S301", message, "too narrow, or it contradicts `mixture`", note)
        )

    def _finding(self, code: str, message: str, label: str, note: tuple[str, ...] = ()) -> Diagnostic:
        """Make a diagnostic located at the conditions of `where`, with the given code, message and label."""
        advice = "draw the states closer to what `where` asks for"
        return Diagnostic(code, message, self.decl.span, label, help=(advice,), note=note)

    def warnings(self) -> tuple[Diagnostic, ...]:
        """Return W601 if less than 1 % of the proposed states were accepted, else an empty tuple."""
        if self.acceptance >= FEW:
            return ()
        message = f"only {100 * self.acceptance:.2g} % of the initial states that are drawn meet `where`"
        return (self._finding("W601", message, "sampling is slow"),)


def completed(
    states: Tensor, names: Sequence[str], drawings: Sequence[Drawing], further: Mapping[str, Tensor]
) -> Tensor:
    """Compute columns of states again that follow from the others.

    Args:
        states: the states, (n, dim).
        names: their names, (dim,).
        drawings: values of the columns, in order, without random numbers.
        further: name -> values, (n,), of further columns that they read.
    """
    rows = Rows(len(states), torch.Generator())
    table = {**further, **dict(zip(names, states.double().unbind(1), strict=False))}
    for drawing in drawings:
        table[drawing.name] = drawing(table, rows)
    found = [table[name].to(states) for name in names]
    return torch.cat((torch.stack(found, 1), states[:, len(names) :]), 1) if drawings else states


# ------------------------------------------------------------------------- given states


class _Grid:
    """Source of initial states: random points of a grid.

    The grid itself is never stored. A point is computed from its index, in which the last axis varies
    fastest.
    """

    def __init__(self, decl: GridDecl) -> None:
        self._axes = [(name, torch.tensor(values, dtype=torch.float64)) for name, values in decl.axes]
        self._count = math.prod(len(values) for _, values in self._axes)

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        if self._count > SHUFFLED:
            return {
                name: values.to(rows.generator.device)[rows.index(len(values))] for name, values in self._axes
            }
        number = rows.index(self._count)
        found: dict[str, Tensor] = {}
        for name, values in reversed(self._axes):
            found[name] = values.to(number.device)[number % len(values)]
            number = number // len(values)
        return found


class _File:
    """Source of initial states: random samples of a file."""

    def __init__(self, decl: FileDecl) -> None:
        self._decl = decl
        self._columns: dict[str, Tensor] = {}

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        """Draw states: name of a column -> (count,).

        Raises SystemFileError (S303) if the file lacks a column or its values are unusable.
        """
        if not self._columns:
            self._columns = self._read()
        first = next(iter(self._columns.values()))
        number = rows.index(len(first))
        return {name: column.to(number.device)[number] for name, column in self._columns.items()}

    def _read(self) -> dict[str, Tensor]:
        path = self._decl.path
        try:
            recording = read_recording(path)
            words = {column.name: column.words for column in self._decl.columns}
            recording = in_numbers(recording, words)
            arrays = {group.named: group.clock for group in recording.groups if group.clock is not None}
            arrays |= {name: each for group in recording.groups for name, each in group.arrays.items()}
            found = {column.name: _values(column, arrays, recording) for column in self._decl.columns}
        except StlcError as error:
            raise self._refused(error.diagnostics[0].message) from None
        missing = [name for name, column in found.items() if column is None]
        if missing:
            listed = ", ".join(f"`{name}`" for name in missing)
            raise self._refused(f"`{path}` has no {listed}", f"it holds {', '.join(arrays)}")
        columns = {name: torch.from_numpy(column) for name, column in found.items() if column is not None}
        sizes = {len(column) for column in columns.values()}
        if len(sizes) > 1 or 0 in sizes:
            counts = ", ".join(f"`{name}` {len(column)}" for name, column in columns.items())
            raise self._refused(f"`{path}` does not hold as many values for every state", counts)
        bad = [name for name, column in columns.items() if not bool(torch.isfinite(column).all())]
        if bad:
            raise self._refused(f"`{path}` holds NaN or infinity in `{bad[0]}`")
        for each in self._decl.columns:
            worth = each.words
            odd = np.setdiff1d(columns[each.name].numpy(), list(worth.values())) if worth else np.zeros(0)
            if odd.size:
                listed = ", ".join(worth)
                raise self._refused(f"`{path}` holds {odd[0]:g} in `{each.name}`, which is one of {listed}")
        return columns

    def _refused(self, message: str, note: str = "") -> SystemFileError:
        notes = (note,) if note else ()
        return SystemFileError.of("S303", message, self._decl.span, "named here", note=notes)


def _values(column: Column, arrays: Mapping[str, np.ndarray], recording: Recording) -> np.ndarray | None:
    """Return all samples of a column in its unit as (count,), or None if the arrays of a file lack it.

    A component `p[1]` of a vector may be stored as slice 1 of the last axis of the array `p`. `recording`
    knows the units of the file. Raises TraceError (E605) if one measures another quantity.
    """
    name = column.name
    base, bracket, index = name.partition("[")
    values = arrays.get(name)
    if values is None and bracket and base in arrays and arrays[base].ndim:
        component = int(index.rstrip("]"))
        whole = arrays[base]
        values = whole[..., component] if component < whole.shape[-1] else None
    if values is None or values.dtype.kind not in "biuf":
        return None
    stored = recording.column(base if name not in arrays else name)
    change = conversion(recording.name, column, stored.unit)
    numbers = values.astype(np.float64).ravel()
    return numbers if change is None else change(numbers)


def seeded(base: int, key: int) -> torch.Generator:
    """Generator derived from the seed `base` and the number `key`.

    The random numbers for different keys are independent.
    """
    seed = np.random.SeedSequence(base, spawn_key=(key,)).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(seed[0] >> np.uint64(1)))
