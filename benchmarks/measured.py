"""Cells of a table, each measured once and stored when it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from benchmarks.store import Key, Result, ResultStore, inputs_of, load
from stlc.cli.framework.output import say
from stlc.diagnostics import StlcError, UsageError


class Measurable(Protocol):
    """A cell of a table: its name, and the key of its inputs."""

    @property
    def name(self) -> str:
        """Of its result."""

    @property
    def key(self) -> Key:
        """Of its result. Raises UsageError, SpecError, SystemFileError for a bad file."""


C = TypeVar("C", bound=Measurable)


@dataclass(frozen=True, slots=True)
class Measured:
    """Outcome of the cells of a table.

    Attributes:
        results: stored or new, in the order of the cells.
        new: number of new ones.
        failed: name and reason of cells that could not be measured.
    """

    results: tuple[Result, ...]
    new: int
    failed: tuple[dict[str, str], ...]


def measured(
    cells: Iterable[C],
    store: ResultStore,
    measure: Callable[[C], Result],
    *,
    doing: str,
    told: Callable[[Result], str] = lambda _: "",
) -> Measured:
    """Results of cells, stored or newly measured, each stored at once; prints progress.

    Args:
        cells: may be drawn one by one, each when the results before it are stored.
        store: of the results.
        measure: measures a cell.
        doing: what is done with a cell, such as `planning`.
        told: summary of a new result; "" for none.

    Raises:
        UsageError: from `measure`. Other errors of stlc cost their own cell only.
    """
    results, failed, new = [], [], 0
    for cell in cells:
        key = cell.key
        kept = store.find(key)
        if kept is None:
            say(f"{doing} {cell.name}")
            try:
                kept = store.put(key, measure(cell))
            except StlcError as error:
                if isinstance(error, UsageError):
                    raise
                failed.append({"name": cell.name, "why": reason(error)})
                continue
            new += 1
            if summary := told(kept):
                say(f"{cell.name}  {summary}")
        results.append(kept)
    return Measured(tuple(results), new, tuple(failed))


def reason(error: StlcError) -> str:
    """The message of an error, in one line."""
    return "; ".join(each.message for each in error.diagnostics)


def has_changed(result: Result, versions: Mapping[str, Any]) -> bool:
    """True if the specification, the system or one of the `versions` has changed since a measurement."""
    key = result["key"]
    now = {**inputs_of(load(key["benchmark"])), **versions}
    return any(key.get(name) != value for name, value in now.items())
