"""Measurements of a table: each measurement (cell) is carried out once, and stored as soon as it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from benchmarks.store import Key, Result, ResultStore, inputs_of, load
from stlc.cli.framework.output import say
from stlc.diagnostics import StlcError, UsageError


class Measurable(Protocol):
    """Interface of a measurement that can be stored: its name, and the key of its inputs."""

    @property
    def name(self) -> str:
        """Name under which the result is stored."""

    @property
    def key(self) -> Key:
        """Key under which the result is stored: its name and all its inputs.

        Raises:
            UsageError, SpecError, SystemFileError: an input file is missing or invalid.
        """


C = TypeVar("C", bound=Measurable)


@dataclass(frozen=True, slots=True)
class Measured:
    """Results of all measurements (cells) of a table.

    Attributes:
        results: stored and new results, in the order of the cells.
        new: number of new results.
        failed: name and reason of each cell that could not be measured.
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
    """Return the results of all cells: stored results, or else new ones, which are then stored.

    Progress is printed.

    Args:
        cells: measurements of the table. The next cell is taken from the iterator only after the results of
            the cells before it are stored.
        store: file of the results.
        measure: function that measures a cell and returns its result.
        doing: verb for messages, such as `planning`.
        told: function that returns a summary of a new result to print; "" for no summary.

    Raises:
        UsageError: `measure` raised this error. If it raises another error of stlc, only this cell fails.
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
                say(f"{cell.name}  broke off: {reason(error)}")
                continue
            new += 1
            if summary := told(kept):
                say(f"{cell.name}  {summary}")
        results.append(kept)
    return Measured(tuple(results), new, tuple(failed))


def reason(error: StlcError) -> str:
    """Return the messages of an error in one line."""
    return "; ".join(each.message for each in error.diagnostics)


def has_changed(result: Result, inputs: Mapping[str, Any]) -> bool:
    """True if the specification, the system or one of the other `inputs` has changed since a measurement."""
    key = result["key"]
    now = {**inputs_of(load(key["benchmark"])), **inputs}
    return any(key.get(name) != value for name, value in now.items())
