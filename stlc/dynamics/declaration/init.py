"""Where a system begins, as data: a mixture of situations, and conditions on every state."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.model import Assign
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class GridDecl:
    """Every combination of a few values: name of a column -> its values, in the unit of the column."""

    axes: tuple[tuple[str, tuple[float, ...]], ...]


@dataclass(frozen=True, slots=True)
class FileDecl:
    """States that lie in a file: each column an array of that name, all samples of all traces."""

    path: Path
    names: tuple[str, ...]
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Situation:
    """A way to draw an initial state: assignments in order, then one of the branches.

    Attributes:
        name: for messages and tables; "" for an unnamed branch.
        weight: share among its siblings, not normalised.
        draws: in order; later ones read earlier ones. Names that are no columns are local.
        branches: a sub-mixture that goes on from here.
        points: known states of which one is taken, before anything is drawn.
    """

    name: str
    weight: float
    draws: tuple[Assign, ...]
    branches: tuple[Situation, ...] = ()
    points: GridDecl | FileDecl | None = None


@dataclass(frozen=True, slots=True)
class InitDecl:
    """The distribution of initial states: a mixture, and conditions that every state must meet.

    Attributes:
        mixture: of situations.
        where: what every state must meet.
        where_text: as written.
        params: what is drawn before a situation is picked; situations may draw it anew.
        override: what is drawn last, over what situations say.
        span: for messages.
    """

    mixture: tuple[Situation, ...]
    where: tuple[ir.Formula, ...] = ()
    where_text: tuple[str, ...] = field(default=(), compare=False)
    params: tuple[Assign, ...] = ()
    override: tuple[Assign, ...] = ()
    span: Span | None = field(default=None, compare=False, repr=False)
