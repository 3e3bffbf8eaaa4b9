"""The frame of the report: one sheet of style, one column, light and dark."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from stlc.view.html import Child, Html, el, join
from stlc.view.style import Picture

SHEET = "report.css"


def _sheet() -> str:
    return (files("stlc.view") / SHEET).read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: its name in links; also the file name of its picture.
        title: its heading; nothing for one that stands at the head of the page.
        body: its content.
        picture: the one drawn figure in it, if any.
    """

    anchor: str
    title: str
    body: Html
    picture: Picture | None = None

    @property
    def html(self) -> Html:
        """The markup."""
        heading = el("h2", self.title) if self.title else None
        return el("section", heading, self.body, attrs={"id": self.anchor})


def page(
    title: str, head: Child, sections: Sequence[Section], foot: Child, script: Html | None = None
) -> str:
    """The whole document.

    Args:
        title: of the browser's tab.
        head: what stands above the links.
        sections: in order.
        foot: the last line.
        script: what runs in the page; nothing else may.
    """
    links = el("nav", [el("a", part.title, attrs={"href": f"#{part.anchor}"}) for part in sections])
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    if script is not None:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        policy += f"; script-src 'sha256-{digest}'"
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
        el(
            "body",
            el("main", head, links, [part.html for part in sections], el("footer", foot)),
            el("script", script) if script is not None else None,
        ),
        attrs={"lang": "en"},
    )
    return str(join(Html("<!doctype html>\n"), html, "\n"))
