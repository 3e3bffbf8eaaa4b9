"""Tables for terminal, Markdown and JSON, and the pages that contain them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from textwrap import wrap
from typing import Any, Generic, TypeVar

from benchmarks.store import Result, made_here
from stlc.cli.framework.output import emit, emit_json, say
from stlc.cli.framework.output import table as columns_of_text
from stlc.files import write_atomic

Cell = TypeVar("Cell")
Row = TypeVar("Row")

WIDTH = 120

HEAD = """# Results

Written by `python -m benchmarks paper`, `ablation` and `family` from the files in `benchmarks/results/`; each
result there says how it was made: its command, seed, versions, machine and commit. Accuracy is the share of
held-out states (the same ones in every row of a benchmark, never used in training) from which the planned
trajectory satisfies the specification: exact semantics over closed intervals, robustness of at least -1e-6 in
float64.
"""


@dataclass(frozen=True)
class Table(Generic[Cell, Row]):
    """A table: each cell is measured in turn and gives a row.

    Attributes:
        name: of the table.
        cells: to measure.
        measure: cell -> row, a dataclass; its fields and properties are the JSON values.
        columns: header -> text of a row, for a terminal and for Markdown.
        told: message printed when a row is measured.
    """

    name: str
    cells: Iterable[Cell]
    measure: Callable[[Cell], Row]
    columns: Mapping[str, Callable[[Row], str]]
    told: Callable[[Row], str] | None = None

    @cached_property
    def rows(self) -> list[Row]:
        """All rows, measured on first access."""
        rows = []
        for cell in self.cells:
            rows.append(self.measure(cell))
            if self.told is not None:
                say(self.told(rows[-1]))
        return rows

    def texts(self, rows: Iterable[Row] | None = None) -> list[tuple[str, ...]]:
        """The cells of (some) rows as text."""
        chosen = self.rows if rows is None else rows
        return [tuple(shown(row) for shown in self.columns.values()) for row in chosen]

    def terminal(self) -> str:
        """Aligned columns."""
        return columns_of_text(self.texts(), header=[*self.columns], indent="")

    def markdown(self, rows: Iterable[Row] | None = None) -> list[str]:
        """(Some) rows as lines of Markdown."""
        return markdown([*self.columns], self.texts(rows))

    def json(self) -> list[dict[str, Any]]:
        """Fields and properties of each row."""
        return [values(row) for row in self.rows]


def values(row: Any) -> dict[str, Any]:
    """Fields and public properties of a dataclass, recursively."""
    if not hasattr(row, "__dataclass_fields__"):
        return row  # type: ignore[no-any-return]
    names = [each.name for each in fields(row)]
    names += [name for name, each in vars(type(row)).items() if isinstance(each, property)]
    return {name: values(getattr(row, name)) for name in names}


def show(
    what: str, tables: Mapping[str, Table[Any, Any]], *, as_json: bool, code: int = 0, **facts: Any
) -> None:
    """Print the tables, or the document of `--json`: `{"what", facts, "rows": […], …}`."""
    for table in tables.values():
        table.rows  # noqa: B018 - what is measured is measured before anything is printed
    if as_json:
        result = {"what": what, **facts, **{key: table.json() for key, table in tables.items()}}
        emit_json("benchmarks/1", ok=code == 0, exit_code=code, result=result)
        return
    emit("\n\n".join(table.terminal() for table in tables.values()))
    if "page" in facts:
        say(f"written: {facts['page']}")


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table as lines of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


# ----------------------------------------------------------------------- pages


def write_section(page: Path, marker: str, lines: Iterable[str]) -> None:
    """Write lines at `<!-- marker -->` in `page`, or at its end if it has no marker."""
    text = page.read_text(encoding="utf-8") if page.is_file() else HEAD
    start, end = f"<!-- {marker} -->\n", f"<!-- /{marker} -->\n"
    head, found, rest = text.partition(start)
    tail = rest.partition(end)[2] if found else ""
    before = head if found else head.rstrip("\n") + "\n\n"
    body = "\n".join(lines).strip("\n")
    write_atomic(page, before + start + body + "\n" + end + tail)


def provenance(results: Iterable[Result], what: str) -> list[str]:
    """Provenance bullets: a line for every machine and version, with commits and dates.

    Args:
        results: shown ones.
        what: noun for them, in the plural.
    """
    groups: dict[str, list[Result]] = {}
    for each in results:
        made = each["made"]
        parts = [made.get(part) and _counted(made[part], part) for part in ("threads", "cores")]
        used = ", ".join(filter(None, parts))
        told = f"{_machine(made)}, Python {made['versions'].get('python')}"
        groups.setdefault(told + (f"; {used} each" if used else ""), []).append(made)
    lines = []
    for told, group in groups.items():
        dates = sorted({str(made["date"])[:10] for made in group})
        when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        commits = ", ".join(f"`{commit}`" for commit in sorted({_commit(made) for made in group}))
        line = f"- {_counted(len(group), what)} on {told}; {when}; commit {commits}"
        lines += wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return lines


def measured_here() -> str:
    """Machine, software and commit of the present measurement, as a bullet."""
    made = made_here()
    return f"- {_machine(made)}; {made['date'][:10]}; commit `{_commit(made)}`"


def _machine(made: Result) -> str:
    machine = made["hardware"]
    processor = machine.get("processor") or machine.get("machine")
    return f"{processor}, {machine.get('cores')} cores; torch {made['versions'].get('torch')}"


def _commit(made: Result) -> str:
    """Commit of the source tree that made a result, with `+` for uncommitted changes."""
    git = made.get("git") or {}
    return str(git.get("commit") or "unknown")[:10] + ("+" if git.get("dirty") else "")


def _counted(count: int, what: str) -> str:
    """A count with its noun, such as `1 core`."""
    return f"{count} {what if count != 1 else what.removesuffix('s')}"
