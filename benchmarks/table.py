"""Tables as text, Markdown and JSON, and the documentation pages that contain them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from string import Formatter
from textwrap import wrap
from typing import Any, Generic, TypeAlias, TypeVar

import typer

from benchmarks.options import Output
from benchmarks.store import Result, made_here
from stlc.cli.framework.output import Document, emit, say
from stlc.cli.framework.output import table as columns_of_text
from stlc.files import File

Cell = TypeVar("Cell")
Row = TypeVar("Row")
Columns: TypeAlias = Mapping[str, "str | Callable[[Row], str]"]
"""Header -> text of a row: a function, or a template such as `{accuracy:.3f}` over the row's attributes, in
which None is empty."""

WIDTH = 120

HEAD = """# Results

Written by `python -m benchmarks paper`, `ablation` and `family` from the files in `benchmarks/results/`; each
result there says how it was made: its command, seed, versions, machine and commit. Accuracy is the share of
held-out states (the same ones in every row of a benchmark, never used in training) from which the planned
trajectory satisfies the specification: exact semantics over closed intervals, robustness of at least -1e-6 in
float64.
"""


class _Template(Formatter):
    """Formatter whose template names attributes of one object; None is written as ""."""

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> Any:  # noqa: ARG002
        return getattr(args[0], str(key))

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> Any:
        try:
            return super().get_field(field_name, args, kwargs)
        except (AttributeError, TypeError):
            if self.get_value(re.split(r"[.\[]", field_name)[0], args, kwargs) is not None:
                raise
            return None, field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        return "" if value is None else format(value, format_spec)


@dataclass(frozen=True)
class Table(Generic[Cell, Row]):
    """A table: each cell is measured in turn and gives one row.

    Attributes:
        name: name of the table.
        cells: the things to measure.
        measure: function that measures a cell and returns a row. A row is a dataclass; its fields and
            properties are the values in JSON.
        columns: header -> text of a row in this column.
        message: text printed when a row is measured; None for no message.
    """

    name: str
    cells: Iterable[Cell]
    measure: Callable[[Cell], Row]
    columns: Columns[Row]
    message: str | Callable[[Row], str] | None = None

    @cached_property
    def rows(self) -> list[Row]:
        """All rows of the table; they are measured on first access."""
        rows = []
        for cell in self.cells:
            rows.append(self.measure(cell))
            if self.message is not None:
                say(text_of(rows[-1], self.message))
        return rows

    def texts(self, rows: Iterable[Row] | None = None) -> list[tuple[str, ...]]:
        """Return the texts of `rows`, one tuple per row; by default of all rows."""
        chosen = self.rows if rows is None else rows
        return [tuple(text_of(row, shown) for shown in self.columns.values()) for row in chosen]

    def terminal(self) -> str:
        """Return the table as text with aligned columns."""
        return columns_of_text(self.texts(), header=[*self.columns], indent="")

    def markdown(self, rows: Iterable[Row] | None = None) -> list[str]:
        """Return `rows` as a Markdown table, line by line; by default all rows."""
        return markdown([*self.columns], self.texts(rows))

    def json(self) -> list[dict[str, Any]]:
        """Return each row as a dictionary of its fields and properties."""
        return [values(row) for row in self.rows]


def listed(name: str, rows: Iterable[Row], columns: Columns[Row]) -> Table[Row, Row]:
    """Return a table of the given rows, without a measurement."""
    return Table(name, rows, lambda row: row, columns)


def text_of(row: Row, shown: str | Callable[[Row], str]) -> str:
    """Return the text of a row in one column; `shown` is the function or template of the column."""
    return _Template().vformat(shown, (row,), {}) if isinstance(shown, str) else shown(row)


def values(row: Any) -> Any:
    """Return a dataclass as a dictionary of its fields and public properties, recursively.

    Other values are returned unchanged.
    """
    if not hasattr(row, "__dataclass_fields__"):
        return row
    names = [each.name for each in fields(row)]
    names += [name for name, each in vars(type(row)).items() if isinstance(each, property)]
    return {name: values(getattr(row, name)) for name in names}


def publish(
    what: str,
    output: Output,
    section: Callable[[], Iterable[str]],
    tables: Mapping[str, Table[Any, Any]],
    **facts: Any,
) -> None:
    """Write the section of a documentation page, then print the tables.

    Args:
        what: name of the table, which marks its section in the page.
        output: the page, if any, and whether JSON is printed.
        section: function that returns the lines of the section.
        tables: key in the JSON document -> table.
        facts: further entries of the JSON document; `failed` lists the measurements that failed.

    Raises:
        typer.Exit: 1, a measurement failed.
    """
    if output.page is not None:
        write_section(output.page, what, section())
        facts["page"] = str(output.page)
    code = int(bool(facts.get("failed")))
    show(what, tables, as_json=output.as_json, code=code, **facts)
    if code:
        raise typer.Exit(1)


def show(
    what: str, tables: Mapping[str, Table[Any, Any]], *, as_json: bool, code: int = 0, **facts: Any
) -> None:
    """Print the tables as text, or with `as_json` as a JSON document that also contains `facts`.

    `what` is the name of the table, and `code` the exit code of the command.
    """
    for table in tables.values():
        table.rows  # noqa: B018 - what is measured is measured before anything is printed
    if as_json:
        result = {"what": what, **facts, **{key: table.json() for key, table in tables.items()}}
        Document("benchmarks/1", code, result=result).print()
        return
    emit("\n\n".join(table.terminal() for table in tables.values()))
    if "page" in facts:
        say(f"written: {facts['page']}")


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a table as lines of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


# ----------------------------------------------------------------------- pages


def write_section(page: Path, marker: str, lines: Iterable[str]) -> None:
    """Replace the section between `<!-- marker -->` and `<!-- /marker -->` in the file `page` by `lines`.

    If the page has no such section, it is added at the end.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else HEAD
    start, end = f"<!-- {marker} -->\n", f"<!-- /{marker} -->\n"
    head, found, rest = text.partition(start)
    tail = rest.partition(end)[2] if found else ""
    before = head if found else head.rstrip("\n") + "\n\n"
    body = "\n".join(lines).strip("\n")
    File(page).write(before + start + body + "\n" + end + tail)


def provenance(results: Iterable[Result], what: str) -> list[str]:
    """Return Markdown bullets on the provenance of results, one per machine and version.

    Each bullet lists commits and dates.

    Args:
        results: the results that the page shows.
        what: noun for the results, in the plural.
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
        lines += bullet(f"{_counted(len(group), what)} on {told}; {when}; commit {commits}")
    return lines


def bullet(text: str) -> list[str]:
    """Lines of a Markdown bullet with a text, which is wrapped at `WIDTH`."""
    return wrap(f"- {text}", WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def measured_here() -> str:
    """Return a Markdown bullet with the machine, the software and the commit of the present measurement."""
    made = made_here()
    return f"- {_machine(made)}; {made['date'][:10]}; commit `{_commit(made)}`"


def _machine(made: Result) -> str:
    machine = made["hardware"]
    processor = machine.get("processor") or machine.get("machine")
    return f"{processor}, {machine.get('cores')} cores; torch {made['versions'].get('torch')}"


def _commit(made: Result) -> str:
    """Return the commit of the source tree that produced a result; a `+` marks uncommitted changes."""
    git = made.get("git") or {}
    return str(git.get("commit") or "unknown")[:10] + ("+" if git.get("dirty") else "")


def _counted(count: int, what: str) -> str:
    """Return a count with its noun as text, such as `1 core`; `what` is the noun in the plural."""
    return f"{count} {what if count != 1 else what.removesuffix('s')}"
