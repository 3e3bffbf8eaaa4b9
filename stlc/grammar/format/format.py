"""The one layout of a specification: blanks, line breaks, spellings; never its meaning.

    comments     stay where they are: above a line, behind it, or between the parts of a long formula
    empty lines  stay, one at a time, so the groups of the author stay
    spellings    `G`, `&&`, `=>` and their like become the words of the language, tags get their own lines
    columns      within a group names, formulas and comments stand below each other
    parentheses  are added where other tools would read a formula differently (W301)

Law: formatting twice changes nothing more, and the tree before and after is the same.
"""

from __future__ import annotations

from stlc.diagnostics import SpecError
from stlc.grammar import ast
from stlc.grammar.ambiguity import ambiguities
from stlc.grammar.errors.spelling import plain_text
from stlc.grammar.format.lines import lay_out
from stlc.grammar.parse.parser import parse
from stlc.grammar.parse.tokens import tokenize
from stlc.source import Source

WIDTH = 100


def format_text(source: Source) -> str:
    """The text in its one layout, with a line break at the end.

    Characters of papers (`□`, `≤`, `∧`) become what the language writes for them.

    Raises:
        SpecError: the text is no specification.
    """
    source, spec = _read(source)
    formatted = lay_out(tokenize(source), tuple(ambiguities(spec)), width=WIDTH)
    again = parse(Source(source.name, formatted))
    if again != spec:
        raise AssertionError(f"the layout of {source.name} would change its meaning")
    return formatted


def _read(source: Source) -> tuple[Source, ast.Spec]:
    """A text that can be read, and its tree; the findings are those of the text that was given."""
    try:
        return source, parse(source)
    except SpecError as error:
        plain = Source(source.name, plain_text(source.text))
        if plain.text == source.text:
            raise
        try:
            return plain, parse(plain)
        except SpecError:
            raise error from None
