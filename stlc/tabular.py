"""Results as small tables: HTML for notebooks, and data frames of pandas or polars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import zip_longest
from typing import Any

from stlc.escape import html
from stlc.extras import not_installed

_RED = ' style="color:#c0261c"'


def html_table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], marked: Sequence[bool] = ()
) -> str:
    """Return a table as HTML for a notebook; all texts are escaped, and `marked` rows are red."""
    left = ' style="text-align:left"'

    def line(cells: Sequence[str], tag: str, style: str = "") -> str:
        return f"<tr{style}>{''.join(f'<{tag}{left}>{html(each)}</{tag}>' for each in cells)}</tr>"

    lines = [line(row, "td", _RED if bad else "") for row, bad in zip_longest(rows, marked)]
    return f"<table><caption>{html(title)}</caption>{line(header, 'th')}{''.join(lines)}</table>"


def frame(columns: Mapping[str, Any]) -> Any:
    """Return columns of one length as a data frame of pandas, or of polars if pandas is not installed.

    Raises:
        MissingError: R301, neither package is installed.
    """
    for package in ("pandas", "polars"):
        try:
            return import_module(package).DataFrame(dict(columns))
        except ModuleNotFoundError:
            continue
    raise not_installed("pandas", need="a data frame needs")
