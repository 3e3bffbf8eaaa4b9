"""Lint rules on the syntax tree or the text; types, units and times are checked by the compiler."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import TypeAlias

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.allow import misunderstood
from stlc.grammar.ambiguity import Ambiguity, AmbiguityKind, ambiguities
from stlc.grammar.scan import Lexeme, comments
from stlc.grammar.spec import Spec
from stlc.grammar.words import OPERATORS
from stlc.source import Span

_WHY: dict[AmbiguityKind, str] = {
    "scope": "here a temporal word ends before `{outer}`; RTAMT, MoonLight and FalCAuN take in what follows",
    "mixed": "`and` binds tighter here; `or` does in RTAMT and MoonLight, and STLRom has one rank for both",
    "chain": "`->` goes from the right here; RTAMT and MoonLight read it from the left",
    "until": "`until` and its kin bind tighter than `{outer}` here; RTAMT and MoonLight bind them looser",
    "implication": "`->` binds loosest here; MoonLight binds it tightest, STLRom has one rank for all",
}


def missing_parentheses(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W301 for expressions that other STL tools would parse differently for lack of parentheses."""
    return (_finding("W301", part) for part in ambiguities(spec))


def unclear_implications(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W302 for `and` or `or` next to `->` without parentheses; most tools parse it as stlc does."""
    parts = ambiguities(spec, implications=True)
    return (_finding("W302", part) for part in parts if part.kind == "implication")


def _finding(code: str, part: Ambiguity) -> Diagnostic:
    start, end = part.span.start, part.span.end
    source = part.span.source
    edits = ((source.span(start, start), "("), (source.span(end, end), ")"))
    text = " ".join(part.span.text.split())
    shown = f"({text})" if "#" not in text and "//" not in text else "(…)"
    return Diagnostic(
        code,
        "other tools read this differently without parentheses",
        part.span,
        note=(_WHY[part.kind].format(outer=part.outer),),
        fix=Fix(edits, f"write `{shown}`; `stlc fmt` does"),
    )


_SIGNS = {"&&": "and", "&": "and", "||": "or", "|": "or", "!": "not", "=>": "->", "<=>": "<->"}
_WORDS = {
    **{word: each.name for word, each in OPERATORS.items() if word != each.name},
    **{"implies": "->", "iff": "<->"},
}


def foreign_spellings(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W106 for operators spelled as in other tools, such as `G`, `ev`, `&&`, `=>`."""
    source = spec.source
    end = Lexeme("sign", "", len(source.text), len(source.text))
    for item, following in pairwise([*Lexeme.scan(source.text), end]):
        name = _own(item, following)
        if name is None:
            continue
        span = source.span(item.start, item.end)
        joined = following.start == item.end and following.kind in ("word", "number")  # `!p` is no `notp`
        text = f"{name} " if name[-1].isalpha() and joined else name
        if item.start and name[0].isalpha() and source.text[item.start - 1].isalnum():
            text = f" {text}"
        yield Diagnostic(
            "W106",
            f"`{item.text}` is spelled `{name}` here",
            span,
            fix=Fix(((span, text),), f"write `{name}`; `stlc fmt` does"),
        )


def _own(item: Lexeme, following: Lexeme) -> str | None:
    """Return the spelling in this language of a word or sign of another tool, such as `always` for `alw`.

    `item` is the word or sign, and `following` the one after it. None means that `item` is not replaced.
    """
    if item.kind == "sign":
        return _SIGNS.get(item.text)
    if item.kind != "word":
        return None
    bare = item.text.removesuffix("_") if following.text == "[" else item.text
    name = _WORDS.get(bare)
    return bare if name is None and bare != item.text and bare in OPERATORS else name


def unused_names(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W105 for declarations that are never used; signals are exempt, as the system may need them."""
    used = Counter(_uses(spec))
    for item in spec.items:
        exempt = item.noun in ("signal", "requirement", "assumption")
        if not exempt and not any(used[name] for name in item.names):
            yield _unused(f"the {item.noun} `{item.name}` is never used", item.name_span)
        if isinstance(item, ast.Def):
            inner = set(_uses(item.value))
            for formal in item.formals:
                if formal.name not in inner:
                    message = f"`{item.name}` never uses its argument `{formal.name}`"
                    yield _unused(message, formal.span, ", here and where the definition is used")
    for entry in spec.imports:
        name = entry.alias or (entry.target if not entry.is_file else "")
        if name and not used[name]:
            yield _unused(f"the import `{name}` is never used", entry.span)


def _unused(message: str, span: Span, where: str = "") -> Diagnostic:
    return Diagnostic("W105", message, span, help=(f"remove it{where}",))


def _uses(root: ast.Node) -> Iterator[str]:
    return (node.name for node in root.walk() if isinstance(node, ast.Name | ast.TypeRef))


def nothing_required(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W504 for a file that declares signals but no requirement.

    A file without signals is meant to be imported, so it is exempt.
    """
    if not spec.requirements and (spec.signals or not spec.items):
        name = spec.name or spec.source.name
        message, advice = (
            f"`{name}` requires nothing",
            "say what must hold:  require name: always[0, T] x > 0",
        )
        yield Diagnostic("W504", message, spec.source.span(0, 0), help=(advice,))


_REQUIREMENT = re.compile(r"(?:#+|//+)\s*(?:@\w+(?:\([^)]*\))?\s*)*require\s+(?P<name>\w+)\s*:(?!\s*$)")


def requirements_in_comments(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W315 for comments that read as a requirement, unless there is a requirement of this name."""
    names = {item.name for item in spec.items}
    for comment in comments(spec.source):
        found = _REQUIREMENT.match(comment.text)
        if found is not None and found["name"] not in names:
            message = f"`{found['name']}` is in a comment, so nothing requires it"
            yield Diagnostic("W315", message, comment, help=("remove the `#`, or the comment",))


def unread_comments(spec: Spec) -> Iterator[Diagnostic]:
    """Yield W319 for comments such as `# stlc: alow W311`, and for codes in them that are no warnings."""
    return misunderstood(spec.source)


Check: TypeAlias = Callable[[Spec], Iterator[Diagnostic]]


@dataclass(frozen=True, slots=True)
class LintRule:
    """A lint rule: a check of the syntax tree that yields warnings of one code.

    Attributes:
        check: function that returns the findings in a specification without syntax errors.
        usual: whether the rule is active by default.
    """

    check: Check
    usual: bool = True


RULES: Mapping[str, LintRule] = MappingProxyType(
    {
        "W105": LintRule(unused_names),
        "W106": LintRule(foreign_spellings),
        "W301": LintRule(missing_parentheses),
        "W302": LintRule(unclear_implications, usual=False),
        "W315": LintRule(requirements_in_comments),
        "W319": LintRule(unread_comments),
        "W504": LintRule(nothing_required),
    }
)
"""Code -> rule; `stlc explain CODE` gives the rationale."""
