"""Pages of the manual on codes and topics, and specifications in words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from stlc.diagnostics import usage
from stlc.grammar import ast
from stlc.grammar.english import Meanings
from stlc.grammar.spec import Spec

FOLDER = Path(__file__).parents[1] / "pages"
_FENCE = re.compile(r"^```(?P<language>\w*)(?P<notes>[^\n]*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class CodeList:
    """Codes of errors and warnings, and what they mean."""

    codes: dict[str, str]


@dataclass(frozen=True, slots=True)
class Example:
    """An example in a manual page: a code block with a language and notes.

    Attributes:
        language: `stl`, `yaml`, `csv` or `console`.
        notes: words after the language, such as `wrong` and `right`.
        body: text of the block.
    """

    JSON: ClassVar = "language notes text=body"

    language: str
    notes: tuple[str, ...]
    body: str


@dataclass(frozen=True, slots=True)
class Page:
    """Manual page of a code (such as E101): its headline and its text in Markdown."""

    JSON: ClassVar = "name title text examples"

    name: str
    title: str
    text: str

    @property
    def examples(self) -> tuple[Example, ...]:
        """Examples in the page, in order."""
        return tuple(
            Example(match["language"], tuple(match["notes"].split()), match["body"])
            for match in _FENCE.finditer(self.text)
        )

    @classmethod
    def read(cls, name: str) -> Page | None:
        """Return the manual page `name` (an error code or `precedence`); None if there is no such page."""
        path = FOLDER / f"{name}.md"
        if not path.is_file():
            return None
        title, _, text = path.read_text(encoding="utf-8").partition("\n")
        return cls(name, title.removeprefix("# "), text.strip("\n") + "\n")


@dataclass(frozen=True, slots=True)
class RequirementInWords:
    """A requirement or an assumption as an English sentence, with the meaning of the names in it."""

    name: str
    kind: Literal["require", "assume"]
    tags: tuple[str, ...]
    doc: str
    sentence: str
    where: dict[str, str]


@dataclass(frozen=True, slots=True)
class SpecInWords:
    """A specification in English, requirement by requirement."""

    spec: str
    requirements: tuple[RequirementInWords, ...]

    @classmethod
    def of(cls, spec: Spec, name: str, wanted: Sequence[str] = ()) -> SpecInWords:
        """Translate the requirements of a specification called `name`: those in `wanted`, all if it is empty.

        Raises UsageError (U101) if there is no such requirement.
        """
        items = spec.rules
        for one in wanted:
            if one not in [item.name for item in items]:
                missing = usage(f"`{name}` has no requirement `{one}`")
                raise missing.near(one, [item.name for item in items])
        meanings = Meanings(spec)
        found = [
            RequirementInWords(
                item.name,
                "require" if isinstance(item, ast.Require) else "assume",
                tuple(tag.name for tag in item.tags),
                item.doc,
                meanings.sentence(item),
                dict(meanings.of(item)),
            )
            for item in items
            if not wanted or item.name in wanted
        ]
        return cls(name, tuple(found))
