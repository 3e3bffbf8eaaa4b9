"""The page of every code: what it means, why, a wrong and a right example."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "pages"

_FENCE = re.compile(r"^```(?P<language>\w*)(?P<notes>[^\n]*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Example:
    """A block of a page.

    Attributes:
        language: `stl`, `yaml`, `csv` or `console`.
        notes: `wrong`, `right`, and what else stands behind the language.
        body: the text.
    """

    language: str
    notes: tuple[str, ...]
    body: str


@dataclass(frozen=True, slots=True)
class Page:
    """A page: its headline and its Markdown."""

    title: str
    text: str

    @property
    def examples(self) -> tuple[Example, ...]:
        """The blocks, in order."""
        return tuple(
            Example(match["language"], tuple(match["notes"].split()), match["body"])
            for match in _FENCE.finditer(self.text)
        )

    def having(self, note: str) -> tuple[Example, ...]:
        """The blocks with this note."""
        return tuple(example for example in self.examples if note in example.notes)


def read_page(name: str) -> Page | None:
    """The page of a code, or `precedence`; None if there is none."""
    path = FOLDER / f"{name}.md"
    if not path.is_file():
        return None
    title, _, text = path.read_text(encoding="utf-8").partition("\n")
    return Page(title.removeprefix("# "), text.strip("\n") + "\n")


def in_terminal(page: Page) -> str:
    """The page as plain text: blocks indented, marks taken away."""
    return "\n".join([page.title, "", *_plain_lines(page.text)]).rstrip() + "\n"


def _plain_lines(text: str) -> Iterator[str]:
    inside = False
    for line in text.splitlines():
        if line.startswith("```"):
            inside = not inside
            notes = line.strip("`").split()
            if inside and notes[1:2] in (["wrong"], ["right"]):
                yield f"{notes[1]}:"
                yield ""
        elif inside:
            yield f"    {line}".rstrip()
        else:
            yield line.replace("**", "").removeprefix("## ")
