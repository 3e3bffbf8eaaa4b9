"""The frame of the report: one sheet of style, one column, light and dark."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from stlc.view.html import Child, Html, el, join

SHEET = "report.css"


def _sheet() -> str:
    return (files("stlc.view") / SHEET).read_text(encoding="utf-8")


def section(anchor: str, title: str, *children: Child) -> Html:
    """A titled section that `page` lists among its links."""
    return el("section", el("h2", title), *children, attrs={"id": anchor})


def page(title: str, head: Child, sections: Sequence[tuple[str, str, Html]], foot: Child) -> str:
    """The whole document.

    Args:
        title: of the browser's tab.
        head: what stands above the links.
        sections: (anchor, title, markup) in order.
        foot: the last line.
    """
    links = el("nav", [el("a", name, attrs={"href": f"#{anchor}"}) for anchor, name, _ in sections])
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    html = el(
        "html",
        el(
            "head",
            el("meta", attrs={"charset": "utf-8"}),
            el("meta", attrs={"name": "viewport", "content": "width=device-width, initial-scale=1"}),
            el("meta", attrs={"http-equiv": "Content-Security-Policy", "content": policy}),
            el("title", title),
            el("style", Html(_sheet())),
        ),
        el("body", el("main", head, links, [markup for _, _, markup in sections], el("footer", foot))),
        attrs={"lang": "en"},
    )
    return str(join(Html("<!doctype html>\n"), html, "\n"))
