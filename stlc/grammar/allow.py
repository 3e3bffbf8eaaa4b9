"""Comments that silence a warning at one place: `# stlc: allow W311`.

Such a comment applies to the declaration beside it. On a line of its own, it applies to the declaration
around it, or to the next one. Only warnings are silenced, not errors.
"""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from stlc.diagnostics import CODES, Diagnostic
from stlc.grammar.scan import Lexeme, comments, declaration_starts
from stlc.source import Source, Span

_DIRECTIVE = re.compile(r"(?:#+|/{2,})[ \t]*stlc:[ \t]*(?P<word>\w*)(?P<codes>(?:[ \t,]+[A-Za-z]\d+\b)*)")
_CODE = re.compile(r"[A-Za-z]\d+")


@dataclass(frozen=True, slots=True)
class Allowance:
    """A warning that a comment allows: its code, the code's location, and where it is allowed."""

    code: str
    span: Span
    where: Span

    def covers(self, finding: Diagnostic) -> bool:
        """True if the finding is a warning of this code that starts where the warning is allowed."""
        place, where = finding.span, self.where
        return (
            finding.code == self.code
            and finding.severity != "error"
            and place is not None
            and place.source == where.source
            and where.start <= place.start <= where.end
        )


def not_allowed(findings: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Return the findings that no comment silences, in order.

    The comments of the texts in which the findings lie are read.
    """
    found = list(findings)
    sources = {id(one.span.source): one.span.source for one in found if one.span is not None}
    allowed = [each for source in sources.values() for each in allowances(source)]
    return [one for one in found if not any(each.covers(one) for each in allowed)]


def allowances(source: Source) -> Iterator[Allowance]:
    """Yield the warnings that the comments of a text allow."""
    for comment, found in _directives(source):
        if found["word"] == "allow":
            where = _declaration(comment)
            yield from (Allowance(code.text.upper(), code, where) for code in _codes(comment, found))


def misunderstood(source: Source) -> Iterator[Diagnostic]:
    """Yield W319 for each comment `# stlc: …` that allows nothing, and each code in it that is no warning."""
    for comment, found in _directives(source):
        codes = _codes(comment, found)
        if found["word"] != "allow" or not codes:
            message = "a comment for stlc that it does not understand"
            yield Diagnostic("W319", message, comment, help=("write `# stlc: allow W311`, with any codes",))
        for code in codes:
            known = code.text.upper()
            if known not in CODES:
                missing = Diagnostic("W319", f"there is no code `{known}`", code)
                yield missing.near(known, CODES, "stlc explain  lists the codes")
            elif not known.startswith("W"):
                yield Diagnostic("W319", f"`{known}` is an error; only warnings can be allowed", code)


def _directives(source: Source) -> Iterator[tuple[Span, re.Match[str]]]:
    """Yield the comments that begin with `stlc:`, each with its match of `_DIRECTIVE`."""
    if "stlc:" in source.text:
        for comment in comments(source):
            found = _DIRECTIVE.match(comment.text)
            if found is not None:
                yield comment, found


def _codes(comment: Span, found: re.Match[str]) -> list[Span]:
    start = comment.start + found.start("codes")
    places = _CODE.finditer(found["codes"])
    return [comment.source.span(start + code.start(), start + code.end()) for code in places]


def _declaration(comment: Span) -> Span:
    """Return the declaration to which a comment applies, with the lines between the two.

    A comment on a line of its own also applies to the next line, which may be a comment.
    """
    source = comment.source
    text = source.text
    items = list(Lexeme.scan(text))
    starts = declaration_starts(text)
    after = bisect_left(items, comment.end, key=lambda item: item.start)
    alone = not text[text.rfind("\n", 0, comment.start) + 1 : comment.start].strip()
    index = after if alone and after < len(items) else after - 1
    if index < 0:
        return source.span(0, len(text))
    at = bisect_right(starts, items[index].start)
    limit = starts[at] if at < len(starts) else len(text)
    last = bisect_left(items, limit, key=lambda item: item.start) - 1
    found = text.find("\n", max(comment.end + alone, items[last].end))
    ends = len(text) if found < 0 else found
    return source.span(min(comment.start, starts[at - 1]), ends)
