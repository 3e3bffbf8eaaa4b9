"""Results in notebooks: small tables as HTML, data frames of pandas or polars, and figures of matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import zip_longest
from typing import Any

from stlc.diagnostics import usage
from stlc.escape import html
from stlc.extras import not_installed

_PICTURES = {"Verdict": "stlc.view.plotted"}
"""Type of a result -> module above whose function `plot` draws it."""
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


def plot(result: object) -> Any:
    """Return the picture of a result as a figure of matplotlib.

    A verdict shows the judged signals, with thresholds and deciding values, and the robustness at each
    sample; of several traces, the worst and a typical one.

    Raises:
        MissingError: R301, matplotlib is not installed.
        UsageError: U101, a result of this type has no picture.
    """
    name = type(result).__name__
    if name not in _PICTURES:
        raise usage(f"a `{name}` has no picture", "a Verdict has one")
    return import_module(_PICTURES[name]).plot(result)
