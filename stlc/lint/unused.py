"""Names that nothing uses, and a file that requires nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.children import descendants

_KINDS: dict[type[ast.Declaration], str] = {
    ast.Const: "constant",
    ast.Param: "parameter",
    ast.Enum: "enum",
    ast.Region: "region",
    ast.Def: "definition",
    ast.Extern: "function",
}


def unused_names(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W105: what is declared and never used. A signal may be there for the system's sake."""
    used = Counter(_uses(spec))
    for item in spec.items:
        kind = _KINDS.get(type(item))
        names = (
            [item.name, *(name for name, _ in item.members)] if isinstance(item, ast.Enum) else [item.name]
        )
        if kind is not None and not any(used[name] for name in names):
            yield Diagnostic(
                "W105",
                f"the {kind} `{item.name}` is never used",
                item.name_span,
                help=("remove it",),
            )
        if isinstance(item, ast.Def):
            yield from _unused_arguments(item)
    for entry in spec.imports:
        name = entry.alias or (entry.target if not entry.is_file else "")
        if name and not used[name]:
            yield Diagnostic("W105", f"the import `{name}` is never used", entry.span, help=("remove it",))


def _unused_arguments(item: ast.Def) -> Iterator[Diagnostic]:
    used = set(_uses(item.value))
    for formal in item.formals:
        if formal.name not in used:
            yield Diagnostic(
                "W105",
                f"`{item.name}` never uses its argument `{formal.name}`",
                formal.span,
                help=("remove it, here and where the definition is used",),
            )


def _uses(root: ast.Node) -> Iterator[str]:
    """Every name that is read below a node."""
    for node in descendants(root):
        match node:
            case ast.Name(name=name) | ast.TypeRef(name=name):
                yield name
            case _:
                continue


def nothing_required(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W504: signals and definitions, but no requirement. A file to be imported has no signals."""
    kinds = {type(item) for item in spec.items}
    if ast.Require not in kinds and (ast.Signal in kinds or not kinds):
        name = spec.name or spec.source.name
        yield Diagnostic(
            "W504",
            f"`{name}` requires nothing",
            spec.source.span(0, 0),
            help=("say what must hold:  require name: always[0, T] x > 0",),
        )
