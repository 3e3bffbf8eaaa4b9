"""Examples of the language in documents, and what is said beside them.

A fenced block of language `stlc` is a part of a specification. Behind a line, `# => …` says what comes of it:

    # => 1.5              the robustness of that line's requirement at the first sample of the page's trace
    # => -1 at 3 s        the same at another instant
    # => satisfied        its verdict (or violated, inconclusive)
    # => [-inf, 2]        its robustness over all continuations of the trace
    # => E203             a finding on that line; several codes may stand there
    # => always           the formatter writes the line with that text in it

A block without a declaration of a signal is about the signals of the page. `# for training` in its first line
compiles it for plans instead of recorded traces; a block that names a system is compiled with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

FENCE = re.compile(r"^```stlc\n(.*?)^```", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"#\s*=>\s*(?P<what>.*?)\s*$")
CODE = re.compile(r"[ESRUWB]\d{3}")
VALUE = re.compile(r"(?P<value>-?(?:inf|\d+(?:\.\d+)?))(?: at (?P<at>\d+(?:\.\d+)?) s)?")
BOUNDS = re.compile(r"\[(?P<low>-?(?:inf|[\d.]+)), (?P<high>-?(?:inf|[\d.]+))\]")


@dataclass(frozen=True)
class Claim:
    """Statement of a page about a line of an example."""

    line: int
    what: str


@dataclass(frozen=True)
class Example:
    """A fenced block and what is said beside it.

    Attributes:
        line: of the page.
        text: as it is written.
        claims: in order.
    """

    line: int
    text: str
    claims: tuple[Claim, ...]

    @property
    def stands_alone(self) -> bool:
        """True if it declares signals of its own."""
        return re.search(r"^\s*(?:(?:state|env) +)?signal\b", self.text, re.MULTILINE) is not None

    @property
    def for_training(self) -> bool:
        """True if it is about plans."""
        return self.text.startswith("# for training")


def examples(page: Path) -> Iterator[Example]:
    """The examples of a page."""
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        claims = [
            Claim(number, mark["what"])
            for number, line in enumerate(match[1].splitlines(), start=1)
            if (mark := MARK.search(line)) is not None
        ]
        yield Example(text.count("\n", 0, match.start()) + 1, match[1], tuple(claims))


def table(page: Path, marker: str) -> dict[str, list[str]]:
    """The rows of the Markdown table behind `<!-- marker -->`, by the first word of their first cell."""
    text = page.read_text(encoding="utf-8")
    _, found, rest = text.partition(f"<!-- {marker} -->\n")
    assert found, f"{page.name} has no table {marker}"
    rows = [line for line in rest.partition("\n\n")[0].splitlines() if not re.match(r"\|[-|: ]+\|$", line)]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return {row[0].partition(" ")[0].strip("`"): row[1:] for row in cells}


@dataclass(frozen=True)
class Recorded:
    """The trace of a page: columns by name, the step in seconds, the horizon in steps."""

    columns: Mapping[str, np.ndarray]
    dt: Fraction
    horizon: int


def recorded(page: Path, labels: Mapping[str, float]) -> Recorded:
    """The trace of a page, from its table; words stand for numbers."""
    rows = table(page, "trace")
    time = [Fraction(cell) for cell in rows.pop("t")]
    columns = {name: np.array([_number(cell, labels) for cell in cells]) for name, cells in rows.items()}
    return Recorded(columns, time[1] - time[0], int(table(page, "grid")["T"][0].split()[0]))


def _number(cell: str, labels: Mapping[str, float]) -> float:
    return labels[cell] if cell in labels else float(cell)


def codes(claims: Sequence[Claim]) -> set[tuple[int, str]]:
    """(line, code) of the findings that are announced."""
    return {(claim.line, code) for claim in claims for code in CODE.findall(claim.what)}
