"""Breaking of formatted text into lines of limited width, and alignment of adjacent lines.

A text to be broken is a sequence of layout elements: `Word`, `Blank`, `Line`, `Nest` and `Group`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, assert_never

from stlc.grammar.tokens import Comment

INDENT = 4


@dataclass(frozen=True, slots=True)
class Word:
    """Text that is never broken, and its comments.

    `before` has the comments on the lines above the text, and `after` is the comment behind it.
    """

    text: str
    before: tuple[Comment, ...] = ()
    after: Comment | None = None


@dataclass(frozen=True, slots=True)
class Blank:
    """Blank between two words; it is dropped at the start and the end of a line."""


@dataclass(frozen=True, slots=True)
class Line:
    """Possible line break.

    If the surrounding group fits on a line, the text `flat` is printed instead of a line break.
    """

    flat: str = " "


@dataclass(frozen=True, slots=True)
class Nest:
    """Sequence of layout elements; lines that begin within it are indented by one more level."""

    parts: tuple[Doc, ...]


@dataclass(frozen=True, slots=True)
class Group:
    """Sequence of layout elements that is printed on one line if it fits."""

    parts: tuple[Doc, ...]


Doc: TypeAlias = Word | Blank | Line | Nest | Group

BLANK = Blank()
LINE = Line()
SOFT = Line("")

_Entry: TypeAlias = tuple[int, bool, Doc]


def render(parts: Sequence[Doc], *, width: int) -> list[str]:
    """Return the lines of a sequence of layout elements, of at most `width` characters.

    Only a word may exceed that width.
    """
    page = _Page()
    stack: list[_Entry] = [(0, False, part) for part in reversed(parts)]
    while stack:
        level, flat, doc = stack.pop()
        match doc:
            case Word():
                page.write(doc, level)
            case Blank():
                page.blank = True
            case Line(text):
                if flat:
                    page.blank = page.blank or text == " "
                else:
                    page.end_line(level)
            case Nest(inner):
                stack.extend((level + INDENT, flat, part) for part in reversed(inner))
            case Group(inner):
                fits = flat or _fits(doc, stack, width - page.column)
                stack.extend((level, fits, part) for part in reversed(inner))
            case _:
                assert_never(doc)
    return page.finish()


def is_plain(parts: Sequence[Doc]) -> bool:
    """True if no layout element has a comment."""
    stack = list(parts)
    while stack:
        doc = stack.pop()
        if isinstance(doc, Word) and (doc.before or doc.after is not None):
            return False
        if isinstance(doc, Nest | Group):
            stack.extend(doc.parts)
    return True


def _fits(group: Group, rest: Sequence[_Entry], room: int) -> bool:
    """True if a group, and the elements after it up to the next line break, fit into `room` characters."""
    inside: list[_Entry] = [(0, True, group)]
    behind = len(rest)
    while inside or behind:
        if inside:
            _, flat, doc = inside.pop()
        else:
            behind -= 1
            _, flat, doc = rest[behind]
        if isinstance(doc, Nest | Group):
            inside.extend((0, flat, part) for part in reversed(doc.parts))
            continue
        width = _width(doc)
        commented = isinstance(doc, Word) and (bool(doc.before) or doc.after is not None)
        if commented and flat:
            return False
        room -= width
        if room < 0 or commented or (isinstance(doc, Line) and not flat):
            break
    return room >= 0


def _width(doc: Word | Blank | Line) -> int:
    """Width of a layout element in characters; a possible line break has the width of its text `flat`.

    The width is 0 for a word that has comments above it, because such a word begins a new line.
    """
    match doc:
        case Word(text, before, _):
            return 0 if before else len(text)
        case Line(text):
            return len(text)
        case _:
            return 1


class _Page:
    """Lines under construction; only the last line can still grow."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.line = ""
        self.indent = 0
        self.blank = False
        self.commented = False

    @property
    def column(self) -> int:
        """Width of the current line in characters, including the blank before the next word."""
        return (self.indent if not self.line else len(self.line)) + self.blank

    def write(self, word: Word, level: int) -> None:
        """Append a word to the current line.

        The word begins a new line if there are comments above it, or if it follows a comment. The new line is
        indented by `level` blanks.
        """
        if word.before or self.commented:
            self.end_line(level)
        for comment in word.before:
            self.lines.append(" " * self.indent + comment.text)
        if word.text:
            glue = " " if self.line and self.blank else ""
            self.line = (self.line or " " * self.indent) + glue + word.text
            self.blank = False
        if word.after is not None:
            self.line += f"  {word.after.text}"
            self.commented = True

    def end_line(self, level: int) -> None:
        """End the current line, and begin a new one that is indented by `level` blanks.

        If the current line is empty, it is dropped.
        """
        if self.line:
            self.lines.append(self.line)
        self.line, self.indent, self.blank, self.commented = "", level, False, False

    def finish(self) -> list[str]:
        """End the current line and return all lines."""
        self.end_line(0)
        return self.lines


_SPREAD = 12
_COMMENT_SPREAD = 40


@dataclass(frozen=True, slots=True)
class AlignedColumn:
    """Line of formatted text, the parts of which are yet to be aligned with those of the lines around it.

    Attributes:
        text: the line without its comment.
        kind: grammar rule of the declaration on this line; "tag" or "comment"; "part" for a line of a
            declaration that takes several lines.
        head: width of the first part of the line, such as `def NAME`, in characters; 0 without such a part.
            It is padded to be equal in adjacent lines of one kind.
        comment: comment at the end of the line.
        apart: whether there is an empty line before this line.
    """

    text: str
    apart: bool = False
    kind: str = ""
    head: int = 0
    comment: str = ""


def align(lines: Sequence[AlignedColumn]) -> Iterator[str]:
    """Yield the text of each line, aligned with its neighbours, and the empty lines between them."""
    padded = _pad_heads(lines)
    for line, text in zip(padded, _with_comments(padded), strict=True):
        if line.apart:
            yield ""
        yield text.rstrip()


def _pad_heads(lines: Sequence[AlignedColumn]) -> list[AlignedColumn]:
    """Return the lines with first parts, such as `def NAME`, padded to equal width.

    Adjacent declarations of one kind get a common width.
    """
    result = list(lines)
    for group in _groups(lines, by_kind=True):
        heads = [i for i in group if lines[i].head]
        for part in _close(heads, [lines[i].head for i in heads], _SPREAD):
            width = max(lines[i].head for i in part)
            for i in part:
                text, head = lines[i].text, lines[i].head
                result[i] = replace(lines[i], text=text[:head] + " " * (width - head) + text[head:])
    return result


def _with_comments(lines: Sequence[AlignedColumn]) -> list[str]:
    """Return each line with its comment; comments of adjacent lines start in the same column."""
    texts = [line.text for line in lines]
    for group in _groups(lines, by_kind=False):
        noted = [i for i in group if lines[i].comment]
        for part in _close(noted, [len(texts[i]) for i in noted], _COMMENT_SPREAD):
            width = max(len(texts[i]) for i in part)
            for i in part:
                texts[i] = f"{texts[i]:<{width}}  {lines[i].comment}"
    return texts


def _groups(lines: Sequence[AlignedColumn], *, by_kind: bool) -> Iterator[list[int]]:
    """Yield the indices of adjacent lines that are aligned with each other.

    A tag belongs to the group of the declaration below it. If `by_kind`, a group has declarations of one kind
    only, such as constants.
    """
    group: list[int] = []
    kind = ""
    for index, line in enumerate(lines):
        whole = line.kind not in ("comment", "part")
        other = by_kind and line.kind != "tag" and kind not in ("", line.kind)
        if group and (line.apart or other or not whole):
            yield group
            group, kind = [], ""
        if whole:
            group.append(index)
            kind = kind if line.kind == "tag" else line.kind
    yield group


def _close(items: Iterable[int], widths: Sequence[int], spread: int) -> Iterator[list[int]]:
    """Split `items` into groups of consecutive items whose widths differ by at most `spread`.

    `widths` has the width of each item, in characters.
    """
    part: list[int] = []
    within: list[int] = []
    for item, width in zip(items, widths, strict=True):
        if part and max(*within, width) - min(*within, width) > spread:
            yield part
            part, within = [], []
        part.append(item)
        within.append(width)
    if part:
        yield part
