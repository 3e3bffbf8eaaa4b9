"""HTML that is safe against injection: text is escaped unless it is wrapped in `Html`."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import TypeAlias

from stlc.escape import html as text_of
from stlc.grammar.words import PRAGMAS, RESERVED, ROLES
from stlc.view.style import Picture

_VOID = frozenset({"br", "hr", "img", "input", "meta"})


class Html(str):
    """Trusted HTML markup; a plain `str` is text and gets escaped."""

    __slots__ = ()


Child: TypeAlias = "Html | str | Iterable[Html | str] | None"


def el(name: str, *children: Child, attrs: Mapping[str, str] | None = None) -> Html:
    """Return the HTML element `name` with the attributes `attrs` and the children `children`.

    A child that is None is left out.
    """
    written = "".join(f' {key}="{text_of(value)}"' for key, value in (attrs or {}).items())
    if name in _VOID:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{join(*children)}</{name}>")


def join(*children: Child) -> Html:
    """Concatenate `children`."""
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
    """Return the HTML element `name` with the CSS class `kind` and the children `children`."""
    return el(name, *children, attrs={"class": kind})


def with_code(text: str) -> Html:
    """Return the text as HTML; parts in backticks are marked as code."""
    return join([el("code", part) if i % 2 else part for i, part in enumerate(text.split("`"))])


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[Child]],
    *,
    numeric: Sequence[int] = (),
    kind: str = "plain",
) -> Html:
    """HTML table with the CSS class `kind`; the columns with indices `numeric` are right-aligned."""

    def row(cell: str, cells: Sequence[Child]) -> Html:
        attrs = [{"class": "num"} if index in numeric else None for index in range(len(cells))]
        return el("tr", [el(cell, each, attrs=own) for each, own in zip(cells, attrs, strict=True)])

    head = el("thead", row("th", header)) if header else None
    body = el("tbody", [row("td", cells) for cells in rows])
    return classed("div", "scroll", classed("table", kind, head, body))


def figure(uri: str, alt: str, caption: Child = None, *, kind: str = "plain") -> Html:
    """Picture with a caption; `uri` is its address and `alt` its description."""
    image = classed("div", "scroll", el("img", attrs={"src": uri, "alt": alt}))
    return classed("figure", kind, image, el("figcaption", caption) if caption else None)


def facts(pairs: Iterable[tuple[str, Child]]) -> Html:
    """HTML list of (name, value) pairs in two columns; pairs with an empty value are left out."""
    return classed("dl", "facts", [Html(el("dt", name) + el("dd", value)) for name, value in pairs if value])


# ---------------------------------------------------------------------- page


@dataclass(frozen=True, slots=True)
class Section:
    """A section of the page.

    Attributes:
        anchor: name of the section in links; also the file name of its picture.
        title: heading; empty for the section at the head of the page.
        body: content.
        picture: the drawn figure in the section, if any.
    """

    anchor: str
    title: str
    body: Html
    picture: Picture | None = None

    @property
    def html(self) -> Html:
        """Markup of the section."""
        heading = el("h2", self.title) if self.title else None
        return el("section", heading, self.body, attrs={"id": self.anchor})


def page(
    title: str, head: Child, sections: Sequence[Section], foot: Child, script: Html | None = None
) -> str:
    """HTML text of a self-contained page.

    Args:
        title: title of the browser's tab.
        head: content above the links to the sections.
        sections: sections in order.
        foot: last line of the page.
        script: the only script that the page's security policy allows; None: no script.
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
            el("style", Html((files("stlc.view") / "report.css").read_text(encoding="utf-8"))),
        ),
        el(
            "body",
            el("main", head, links, [part.html for part in sections], el("footer", foot)),
            el("script", script) if script is not None else None,
        ),
        attrs={"lang": "en"},
    )
    return str(join(Html("<!doctype html>\n"), html, "\n"))


# ---------------------------------------------------------------------- highlight


_SPEC = re.compile(
    r"(?P<cm>#[^\n]*|//[^\n]*)|(?P<text>\"[^\"\n]*\")|(?P<kw>@\w+|\b(?:"
    + "|".join(sorted((*RESERVED, *PRAGMAS, *ROLES), key=len, reverse=True))
    + r")\b)"
)
_YAML = re.compile(r"(?P<cm>(?:^|(?<=\s))#[^\n]*)|(?P<kw>^[ ]*(?:- )?[\w.-]+(?=:(?:\s|$)))", re.MULTILINE)


def spec_html(text: str) -> Html:
    """The text of a specification with highlighted syntax."""
    return _marked(text, _SPEC)


def yaml_html(text: str) -> Html:
    """The text of a system file with highlighted syntax."""
    return _marked(text, _YAML)


def _marked(text: str, pattern: re.Pattern[str]) -> Html:
    parts: list[Html | str] = []
    last = 0
    for match in pattern.finditer(text):
        parts.append(text[last : match.start()])
        kind = match.lastgroup
        parts.append(classed("span", kind, match[0]) if kind in ("cm", "kw") else match[0])
        last = match.end()
    return join([*parts, text[last:]])
