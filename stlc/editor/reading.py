"""A text that is being written -> a tree of what can be read of it.

Declarations that cannot be read are blanked out, so that the others keep their places and their names: while
one line is typed, the rest of the file goes on to complete, to explain and to lead somewhere.
"""

from __future__ import annotations

import re
from bisect import bisect_right

from stlc.diagnostics import Diagnostic, SpecError
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.grammar.scan import declaration_starts
from stlc.source import Source

_ROUNDS = 8
_INK = re.compile(r"[^\r\n]")


def read(source: Source) -> tuple[ast.Spec, tuple[Diagnostic, ...]]:
    """The tree of everything that can be read, and what is wrong with the rest.

    Spans of the tree point into `source` or into a text of the same length.
    """
    try:
        return parse(source), ()
    except SpecError as error:
        findings = error.diagnostics
    kept = source
    faults = findings
    for _ in range(_ROUNDS):
        kept = _without(kept, faults)
        try:
            return parse(kept), findings
        except SpecError as error:
            faults = error.diagnostics
    return parse(Source(source.name, _INK.sub(" ", source.text))), findings


def _without(source: Source, faults: tuple[Diagnostic, ...]) -> Source:
    """The text with every declaration blanked out that holds one of the faults; all of it if none does."""
    starts = declaration_starts(source.text)
    ends = [*starts[1:], len(source.text)]
    text = source.text
    places = [fault.span.start for fault in faults if fault.span is not None]
    for place in places:
        index = bisect_right(starts, place) - 1
        start, end = starts[index], ends[index]
        if not text[start:end].strip() and index:
            start = starts[index - 1]
        text = text[:start] + _INK.sub(" ", text[start:end]) + text[end:]
    return Source(source.name, text if places and text != source.text else _INK.sub(" ", source.text))
