"""Errors and warnings (diagnostics) as text with the underlined source.

The main source location is underlined with `^`, further ones with `-`. Each label has a line of its own. Then
follow advice (`help`, `fix`) and reasons (`note`).
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from stlc.diagnostics import Diagnostic
from stlc.escape import visible
from stlc.source import Label, Source, Span

TAB = 4
MAX_COLUMNS = 160
_LEAD = 40

_RESET = "\x1b[0m"
_STYLES = {
    "error": "\x1b[1;31m",
    "warning": "\x1b[1;33m",
    "fact": "\x1b[1;34m",
    "headline": "\x1b[1m",
    "frame": "\x1b[1;34m",
    "secondary": "\x1b[34m",
    "help": "\x1b[1;36m",
}

# -------------------------------------------------------------------------- text


@dataclass(frozen=True, slots=True)
class Paint:
    """Function that adds the colour codes of a style to a text.

    If `color` is False, it returns the text unchanged.
    """

    color: bool

    def __call__(self, style: str, text: str) -> str:
        return f"{_STYLES[style]}{text}{_RESET}" if self.color and text else text


@dataclass(frozen=True, slots=True)
class _Mark:
    """A place in the source to underline, with the text beside it.

    `primary` is True for the place of the finding itself, and False for further places that explain it.
    """

    span: Span
    text: str
    primary: bool


def render_text(diagnostics: Iterable[Diagnostic], *, color: bool) -> str:
    """Findings as text, with an empty line between two findings and a line break at the end."""
    paint = Paint(color)
    blocks = []
    for each in diagnostics:
        title = f"{each.severity}[{each.code}]"
        head = f"{paint(each.severity, title)}{paint('headline', f': {visible(each.message)}')}"
        marks = [_Mark(label.span, label.text, primary=False) for label in each.labels]
        marks = [] if each.span is None else [_Mark(each.span, each.label, primary=True), *marks]
        fixes = [("fix", each.fix.text)] if each.fix is not None and each.fix.text else []
        helps, notes = (("help", entry) for entry in each.help), (("note", entry) for entry in each.note)
        body = _body(marks, (*helps, *fixes, *notes), paint, each.severity)
        blocks.append("\n".join((head, *body)))
    return "\n\n".join(blocks) + "\n" if blocks else ""


def render_place(
    place: Label, labels: Iterable[Label], advice: Iterable[tuple[str, str]], *, color: bool
) -> str:
    """Text that shows `place` in the source, in the layout of a finding without its headline.

    The location `place` is underlined with `^`, and the locations in `labels` are underlined with `-`. Then
    follow the (word, text) pairs in `advice`.
    """
    marks = [_Mark(place.span, place.text, primary=True)]
    marks += [_Mark(label.span, label.text, primary=False) for label in labels]
    return "\n".join(_body(marks, advice, Paint(color), "error")) + "\n"


def _body(
    marks: Sequence[_Mark], advice: Iterable[tuple[str, str]], paint: Paint, severity: str
) -> Iterator[str]:
    width = max((len(str(mark.span.line)) for mark in marks), default=1)
    margin = " " * (width + 1)
    if marks:
        yield from _snippets(marks, width, paint, severity)
    for word, entry in advice:
        first, *more = (visible(line) for line in entry.split("\n"))
        yield f"{margin}{paint('frame', '=')} {paint('help', f'{word}:')} {first}"
        yield from (f"{margin}  {' ' * len(word)}  {line}" for line in more)


# ---------------------------------------------------------------------- snippets


def _snippets(marks: Sequence[_Mark], width: int, paint: Paint, severity: str) -> Iterator[str]:
    """Yield the lines of the source excerpts, one excerpt per file.

    The first excerpt is that of the file in which the finding itself lies. `width` is the number of digits of
    the greatest line number.
    """
    margin = " " * width
    for index, source in enumerate(dict.fromkeys(mark.span.source for mark in marks)):
        own = [mark for mark in marks if mark.span.source is source]
        place = own[0].span
        arrow = "-->" if index == 0 else ":::"
        name = visible(source.name)
        yield f"{margin}{paint('frame', arrow)} {name}:{place.line}:{place.column}"
        yield f"{margin} {paint('frame', '|')}"
        yield from _lines(source, own, width, paint, severity)
    yield f"{margin} {paint('frame', '|')}"


def _lines(source: Source, marks: Sequence[_Mark], width: int, paint: Paint, severity: str) -> Iterator[str]:
    previous: int | None = None
    for number in sorted({mark.span.line for mark in marks}):
        if previous is not None and number > previous + 1:
            yield f"{' ' * width} {paint('frame', '...')}"
        previous = number
        row = _SourceLine(source, number, [mark for mark in marks if mark.span.line == number])
        yield f"{paint('frame', f'{number:>{width}} |')} {row.text}".rstrip()
        for mark in row.marks:
            style = severity if mark.primary else "secondary"
            under = " " * row.column(mark.span.start) + paint(style, row.underline(mark))
            label = f" {paint(style, visible(mark.text))}" if mark.text else ""
            yield f"{' ' * width} {paint('frame', '|')} {under}{label}"


class _SourceLine:
    """One source line as displayed: tabs expanded, control characters visible, truncated if very long."""

    def __init__(self, source: Source, number: int, marks: Sequence[_Mark]) -> None:
        self.marks = marks
        line = source.line(number)
        first = source.line_starts[number - 1]
        begin = 0
        if len(line) > MAX_COLUMNS:
            begin = max(0, min(mark.span.start for mark in marks) - first - _LEAD)
        shown = line[begin : begin + MAX_COLUMNS]
        self._first = first + begin
        self._columns, self.text = _laid_out(shown, indent=1 if begin else 0)
        if begin:
            self.text = f"…{self.text}"
        if begin + MAX_COLUMNS < len(line):
            self.text += "…"

    def column(self, offset: int) -> int:
        """Display column of the character at `offset` in the source.

        For a character that is not displayed, the column of the nearest displayed character is returned.
        """
        return self._columns[min(max(offset - self._first, 0), len(self._columns) - 1)]

    def underline(self, mark: _Mark) -> str:
        """The carets or dashes under a mark: at least one, and none beyond the end of this line."""
        length = self.column(mark.span.end) - self.column(mark.span.start)
        return ("^" if mark.primary else "-") * max(length, 1)


def _laid_out(line: str, *, indent: int) -> tuple[list[int], str]:
    """Return the display columns of a line in the source, and the line as printed.

    There is a column for each character of the line, and one for its end. `indent` is the first column.
    """
    columns: list[int] = []
    shown: list[str] = []
    column = indent
    for char in line:
        columns.append(column)
        text = " " * (TAB - column % TAB) if char == "\t" else visible(char)
        shown.append(text)
        column += sum(map(_width, text))
    return [*columns, column], "".join(shown)


def _width(char: str) -> int:
    """Number of columns that a character takes in a terminal: 0, 1 or 2."""
    if unicodedata.category(char) in ("Mn", "Me"):
        return 0
    return 2 if unicodedata.east_asian_width(char) in ("W", "F") else 1
