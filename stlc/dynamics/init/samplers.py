"""Initial states: a mixture of situations, drawn in order, filtered by what must hold."""

from __future__ import annotations

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import Program
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.switch import Hard
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.dynamics.declaration.init import InitDecl, Situation
from stlc.dynamics.init.draws import Drawing, Rows
from stlc.dynamics.init.points import points_of

MAX_ROUNDS = 500
MAX_BATCH = 1 << 20
FEW = 0.01
"""Acceptance rate below which W601 speaks up, and nothing is trained."""
RATED = 10_000

_HARD = Hard()
Table = dict[str, Tensor]


class _Draws:
    """A situation, ready to be drawn."""

    def __init__(self, situation: Situation) -> None:
        self.weight = situation.weight
        self.draws = tuple(Drawing(assign) for assign in situation.draws)
        self.mixture = _Mixture(situation.branches) if situation.branches else None
        self.points = points_of(situation.points) if situation.points is not None else None

    def __call__(self, table: Table, rows: Rows) -> Table:
        """`table` with this situation's names added, all (count,)."""
        if self.points is not None:
            table = {**table, **self.points(rows)}
        for drawing in self.draws:
            table = {**table, drawing.name: drawing(table, rows)}
        return self.mixture(table, rows) if self.mixture else table


class _Mixture:
    """Situations of which one is picked for every row."""

    def __init__(self, situations: tuple[Situation, ...]) -> None:
        self.parts = tuple(_Draws(situation) for situation in situations)
        self.weights = [part.weight for part in self.parts]

    def __call__(self, table: Table, rows: Rows) -> Table:
        if len(self.parts) == 1:
            return self.parts[0](table, rows)
        picked = rows.pick(self.weights)
        where = [torch.nonzero(picked == index).flatten() for index in range(len(self.parts))]
        drawn = [
            part({name: column[at] for name, column in table.items()}, Rows(len(at), rows.generator))
            for part, at in zip(self.parts, where, strict=True)
        ]
        names = set(drawn[0]).intersection(*drawn[1:])
        home = torch.argsort(torch.cat(where))
        return {name: torch.cat([part[name] for part in drawn])[home] for name in names}


class InitialStates:
    """The distribution of a declaration's initial states.

    Attributes:
        drawn: states that were proposed so far.
        kept: states that met every condition.
    """

    def __init__(self, decl: InitDecl, names: tuple[str, ...]) -> None:
        self.decl = decl
        self.names = names
        self.drawn = 0
        self.kept = 0
        self._params = tuple(Drawing(assign) for assign in decl.params)
        self._mixture = _Mixture(decl.mixture)
        self._override = tuple(Drawing(assign) for assign in decl.override)
        self._where = (
            Program({f"{i}": ir.Indicator(cond) for i, cond in enumerate(decl.where)}) if decl.where else None
        )

    @property
    def acceptance(self) -> float:
        """Share of proposed states that were kept; 1 before anything was drawn."""
        return self.kept / self.drawn if self.drawn else 1.0

    def sample(self, n: int, generator: torch.Generator) -> Tensor:
        """Initial states, (n, dim) float64 on the generator's device.

        Raises SystemFileError (S301) where (nearly) every proposed state is rejected.
        """
        if self._where is None:
            self.drawn, self.kept = self.drawn + n, self.kept + n
            return self._propose(n, generator)
        found: list[Tensor] = []
        missing, drawn, kept = n, 0, 0
        for _ in range(MAX_ROUNDS):
            rate = max(kept / drawn, 1e-4) if drawn else 0.5
            batch = min(int(missing / rate * 1.1) + 64, MAX_BATCH)
            proposed = self._propose(batch, generator)
            good = proposed[self.holds(proposed)]
            drawn, kept = drawn + batch, kept + len(good)
            found.append(good[:missing])
            missing -= len(found[-1])
            if not missing or (drawn >= 1_000_000 and kept < drawn * 1e-5):
                break
        self.drawn, self.kept = self.drawn + drawn, self.kept + kept
        if missing:
            raise self._rejected(drawn, kept)
        return torch.cat(found)

    def _propose(self, n: int, generator: torch.Generator) -> Tensor:
        """States before rejection, (n, dim)."""
        rows = Rows(n, generator)
        table = {"": rows.blank()}
        for drawing in self._params:
            table[drawing.name] = drawing(table, rows)
        table = self._mixture(table, rows)
        for drawing in self._override:
            table[drawing.name] = drawing(table, rows)
        return torch.stack([table[name] for name in self.names], 1)

    def holds(self, states: Tensor) -> Tensor:
        """Where (n, dim) states meet every condition of `where`, (n,) booleans."""
        return self._each_holds(states).all(0)

    def _each_holds(self, states: Tensor) -> Tensor:
        """Where each condition of `where` holds, (conditions, n) booleans."""
        if self._where is None:
            return torch.ones(0, len(states), dtype=torch.bool, device=states.device)
        env = dict(zip(self.names, states.unbind(1), strict=True))
        marks = self._where(env, TORCH, _HARD)
        return torch.stack([mark.expand(len(states)) > 0.5 for mark in marks.values()])

    def require_many(self, n: int = 256, *, seed: int = 0) -> None:
        """Raise SystemFileError (S301) where less than one proposed state in a hundred is kept."""
        before = self.drawn, self.kept
        self.sample(n, torch.Generator().manual_seed(seed))
        drawn, kept = self.drawn - before[0], self.kept - before[1]
        if kept < FEW * drawn:
            raise self._rejected(drawn, kept)

    def _rejected(self, drawn: int, kept: int) -> SystemFileError:
        return SystemFileError(
            Diagnostic(
                "S301",
                f"of {drawn} initial states that were drawn, {kept} meet every condition of `where`",
                self.decl.span,
                label="too narrow, or it contradicts `mixture`",
                help=("draw the states closer to what `where` asks for",),
                note=self._rates(),
            )
        )

    def _rates(self) -> tuple[str, ...]:
        """How often each condition holds, the rarest first."""
        proposed = self._propose(RATED, torch.Generator().manual_seed(0))
        rates = self._each_holds(proposed).double().mean(1).tolist()
        told = sorted(zip(rates, self.decl.where_text, strict=True))
        return tuple(f"`{text}` holds for {rate:.2%} of what is drawn" for rate, text in told)

    def warnings(self) -> tuple[Diagnostic, ...]:
        """W601 where few of the states drawn so far were kept."""
        if self.acceptance >= FEW:
            return ()
        return (
            Diagnostic(
                "W601",
                f"only {100 * self.acceptance:.2g} % of the initial states that are drawn meet `where`",
                self.decl.span,
                label="sampling is slow",
                help=("draw the states closer to what `where` asks for",),
            ),
        )
