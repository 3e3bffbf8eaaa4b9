"""What stands below each other: the heads of like declarations, and the comments behind lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

_SPREAD = 12
_COMMENT_SPREAD = 40


@dataclass(frozen=True, slots=True)
class Column:
    """A line.

    Attributes:
        text: without its comment.
        kind: the rule of its declaration; "tag", "comment", or "part" of several lines.
        head: columns of its first part, which like lines share; 0 for none.
        comment: behind it.
        apart: an empty line stands before it.
    """

    text: str
    apart: bool = False
    kind: str = ""
    head: int = 0
    comment: str = ""


def align(lines: Sequence[Column]) -> Iterator[str]:
    """The lines as text, in order, with the empty lines between them."""
    padded = _pad_heads(lines)
    for line, text in zip(padded, _with_comments(padded), strict=True):
        if line.apart:
            yield ""
        yield text.rstrip()


def _pad_heads(lines: Sequence[Column]) -> list[Column]:
    """Like declarations without an empty line or a comment between them share the width of their heads."""
    result = list(lines)
    for group in _groups(lines, by_kind=True):
        heads = [i for i in group if lines[i].head]
        for part in _close(heads, [lines[i].head for i in heads], _SPREAD):
            width = max(lines[i].head for i in part)
            for i in part:
                text, head = lines[i].text, lines[i].head
                result[i] = replace(lines[i], text=text[:head] + " " * (width - head) + text[head:])
    return result


def _with_comments(lines: Sequence[Column]) -> list[str]:
    """Comments behind lines that follow each other start in one column."""
    texts = [line.text for line in lines]
    for group in _groups(lines, by_kind=False):
        noted = [i for i in group if lines[i].comment]
        for part in _close(noted, [len(texts[i]) for i in noted], _COMMENT_SPREAD):
            width = max(len(texts[i]) for i in part)
            for i in part:
                texts[i] = f"{texts[i]:<{width}}  {lines[i].comment}"
    return texts


def _groups(lines: Sequence[Column], *, by_kind: bool) -> Iterator[list[int]]:
    """Runs of whole lines without an empty line between them; tags belong to the declaration below them."""
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
    """Neighbours whose widths differ by no more than `spread`."""
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
