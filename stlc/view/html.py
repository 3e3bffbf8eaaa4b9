"""HTML that cannot be broken from outside: whatever is not `Html` is text and gets escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

from stlc.escape import html as text_of

_VOID = frozenset({"br", "hr", "img", "input", "meta"})


class Html(str):
    """Markup that is safe to stand in a page. Plain `str` is text and gets escaped."""

    __slots__ = ()


Child: TypeAlias = "Html | str | Iterable[Html | str] | None"


def el(name: str, *children: Child, attrs: Mapping[str, str] | None = None) -> Html:
    """The element `name` with `attrs` around `children`; None leaves a child out."""
    written = "".join(f' {key}="{text_of(value)}"' for key, value in (attrs or {}).items())
    if name in _VOID:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{join(*children)}</{name}>")


def join(*children: Child) -> Html:
    """`children` one after the other."""
    return Html("".join(_written(child) for child in children))


def _written(child: Child) -> str:
    if child is None:
        return ""
    if isinstance(child, Html):
        return str(child)
    if isinstance(child, str):
        return text_of(child)
    return "".join(_written(item) for item in child)


def classed(name: str, kind: str, *children: Child) -> Html:
    """The element `name` of class `kind`."""
    return el(name, *children, attrs={"class": kind})


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[Child]],
    *,
    numeric: Sequence[int] = (),
    kind: str = "plain",
) -> Html:
    """A table of class `kind`; the columns `numeric` stand right."""

    def row(cell: str, cells: Sequence[Child]) -> Html:
        return el("tr", [_cell(cell, value, i in numeric) for i, value in enumerate(cells)])

    head = el("thead", row("th", header)) if header else None
    body = el("tbody", [row("td", cells) for cells in rows])
    return classed("div", "scroll", classed("table", kind, head, body))


def _cell(name: str, value: Child, numeric: bool) -> Html:
    return el(name, value, attrs={"class": "num"} if numeric else None)


def figure(uri: str, alt: str, caption: Child = None, *, kind: str = "plain") -> Html:
    """A picture with its words."""
    image = classed("div", "scroll", el("img", attrs={"src": uri, "alt": alt}))
    return classed("figure", kind, image, el("figcaption", caption) if caption else None)


def facts(pairs: Iterable[tuple[str, Child]]) -> Html:
    """Names and values, side by side."""
    return classed("dl", "facts", [Html(el("dt", name) + el("dd", value)) for name, value in pairs if value])
