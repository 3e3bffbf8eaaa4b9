"""Symbols (declared names) of a specification and their occurrences in the text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, cast

from stlc.grammar import ast
from stlc.grammar.scan import Lexeme
from stlc.grammar.spec import Spec
from stlc.source import Span

Kind: TypeAlias = Literal[
    "signal",
    "const",
    "param",
    "enum",
    "member",
    "region",
    "def",
    "extern",
    "require",
    "assume",
    "argument",
    "variable",
    "module",
]


def _kind(item: ast.Declaration) -> Kind:
    return cast("Kind", type(item).__name__.lower())


@dataclass(frozen=True, slots=True)
class Symbol:
    """A name that a specification declares, or that a quantifier, `freeze` or an argument list binds.

    Attributes:
        name: the name without backticks.
        kind: kind of the declaration, such as `signal`.
        span: source location of the name in its declaration.
        item: the declaration that declares or contains the name; None for an imported module or a variable.
    """

    name: str
    kind: Kind
    span: Span
    item: ast.Declaration | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Occurrence:
    """A place in the text where a symbol is named."""

    span: Span
    symbol: Symbol

    @property
    def declares(self) -> bool:
        """True if this occurrence is the declaration of the symbol."""
        return self.span == self.symbol.span


@dataclass(frozen=True, slots=True)
class SymbolNames:
    """The symbols of a specification, in three separate namespaces.

    Attributes:
        values: names that can stand in expressions: signals, constants, definitions and others.
        types: names of enums.
        rules: names of requirements and assumptions.
        occurrences: all places where a symbol is named, in text order.
    """

    values: Mapping[str, Symbol]
    types: Mapping[str, Symbol]
    rules: Mapping[str, Symbol]
    occurrences: tuple[Occurrence, ...]

    def at(self, offset: int) -> Occurrence | None:
        """Return the occurrence under the cursor at `offset`, or None."""
        touching = [one for one in self.occurrences if one.span.start <= offset <= one.span.end]
        return max(touching, key=lambda one: one.span.start, default=None)

    def of(self, symbol: Symbol) -> tuple[Occurrence, ...]:
        """Return all occurrences of the symbol `symbol` in the text."""
        return tuple(one for one in self.occurrences if one.symbol == symbol)


Scope: TypeAlias = Mapping[str, Symbol]


def names_of(spec: Spec) -> SymbolNames:
    """Return the symbols of a specification and their occurrences.

    If a name is declared several times, the first declaration counts. The others are listed as further
    occurrences of the symbol.
    """
    values: dict[str, Symbol] = {}
    types: dict[str, Symbol] = {}
    rules: dict[str, Symbol] = {}
    modules = [_module(module) for module in spec.imports]
    for symbol in modules:
        values.setdefault(symbol.name, symbol)
    for item in spec.items:
        space = {"enum": types, "requirement": rules, "assumption": rules}.get(item.noun, values)
        space.setdefault(item.name, Symbol(item.name, _kind(item), item.name_span, item))
        if isinstance(item, ast.Enum):
            for lexeme in _member_names(item):
                member = _symbol(lexeme, "member", item.span, item)
                values.setdefault(member.name, member)
    names = SymbolNames(values, types, rules, ())
    every = [Occurrence(symbol.span, symbol) for symbol in modules]
    for item in spec.items:
        every += _of_item(item, names)
    found = {one.span: one for one in every}
    ordered = sorted(found.values(), key=lambda one: (one.span.start, one.span.end))
    return replace(names, occurrences=tuple(ordered))


def inside(spec: Spec, offset: int) -> tuple[Symbol, ...]:
    """Return the arguments and bound variables in scope at `offset`, those of outer expressions first."""
    found: list[Symbol] = []
    for item in spec.items:
        if item.span.start <= offset <= item.span.end:
            found.extend(_arguments(item).values())
            found.extend(
                symbol
                for node in item.walk()
                if node.span.start <= offset <= node.span.end
                for symbol in _bound(node).values()
            )
    return tuple(found)


# ------------------------------------------------------------------------- symbols


def _symbol(lexeme: Lexeme, kind: Kind, near: Span, item: ast.Declaration | None = None) -> Symbol:
    return Symbol(lexeme.text.strip("`"), kind, near.source.span(lexeme.start, lexeme.end), item)


def _words(span: Span, start: int | None = None, end: int | None = None) -> list[Lexeme]:
    """Return the words in a source location, or in the part of it from offset `start` to offset `end`."""
    first = span.start if start is None else start
    last = span.end if end is None else end
    return [one for one in Lexeme.scan(span.source.text, first, last) if one.kind in ("word", "quoted")]


def _module(module: ast.Import) -> Symbol:
    """Return the symbol of an imported module, whose name is its alias, or else its file name."""
    words = _words(module.span)
    if module.alias is None and module.is_file:
        name = module.target.replace("\\", "/").rpartition("/")[2].removesuffix(".stl").removesuffix(".stlc")
        return Symbol(name, "module", module.span)
    return _symbol(words[-1], "module", module.span)


def _member_names(item: ast.Enum) -> Iterator[Lexeme]:
    before = ""
    for lexeme in Lexeme.scan(item.span.source.text, item.name_span.end, item.span.end):
        if lexeme.kind in ("word", "quoted") and before in ("{", ","):
            yield lexeme
        before = lexeme.text


def _arguments(item: ast.Declaration) -> dict[str, Symbol]:
    if not isinstance(item, ast.Def | ast.Extern):
        return {}
    return {
        formal.name: _symbol(_words(formal.span)[0], "argument", formal.span, item) for formal in item.formals
    }


def _bound(node: ast.Node) -> dict[str, Symbol]:
    match node:
        case ast.Quantifier(span, _, var):
            return {var: _symbol(_words(span)[1], "variable", span)}
        case ast.Freeze(span, bindings):
            found = {}
            start = span.start
            for name, value in bindings:
                found[name] = _symbol(_words(span, start, value.span.start)[-1], "variable", span)
                start = value.span.end
            return found
        case _:
            return {}


# --------------------------------------------------------------------- occurrences


def _of_item(item: ast.Declaration, names: SymbolNames) -> Iterator[Occurrence]:
    own = Symbol(item.name, _kind(item), item.name_span, item)
    yield Occurrence(item.name_span, own)
    if isinstance(item, ast.Enum):
        for lexeme in _member_names(item):
            member = _symbol(lexeme, "member", item.span, item)
            yield Occurrence(member.span, member)
    arguments = _arguments(item)
    yield from (Occurrence(symbol.span, symbol) for symbol in arguments.values())
    scope = {**names.values, **arguments}
    for part in item.children():
        yield from _uses(part, scope, names)


def _uses(node: ast.Node, scope: Scope, names: SymbolNames) -> Iterator[Occurrence]:
    """Yield the occurrences of symbols in a part of a declaration; built-in names are left out.

    `scope` maps the names that can be used in this part to their symbols.
    """
    match node:
        case ast.Name(span, name, quoted):
            if name in scope and (quoted or name not in ("T", "end", "dt")):
                yield Occurrence(span, scope[name])
            return
        case ast.TypeRef(span, name):
            if name in names.types:
                word = _words(span)[0]
                yield Occurrence(span.source.span(word.start, word.end), names.types[name])
            return
        case ast.Tag(_, name) if name in ("group", "scale", "id"):
            return
        case ast.Call(_, ast.Name(_, name), args) if name in scope:
            called = scope[name].item
            formals = {} if called is None else _arguments(called)
            for arg in args:
                if arg.name in formals:
                    word = _words(arg.span)[0]
                    yield Occurrence(arg.span.source.span(word.start, word.end), formals[arg.name])
        case _:
            pass
    bound = _bound(node)
    yield from (Occurrence(symbol.span, symbol) for symbol in bound.values())
    for part in node.children():
        inner = isinstance(node, ast.Quantifier | ast.Freeze) and part is node.body
        yield from _uses(part, {**scope, **bound} if inner else scope, names)
