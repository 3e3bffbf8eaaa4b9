"""Modulo of what moves: its robustness jumps, which gradients do not see."""

from __future__ import annotations

from collections.abc import Iterator

from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.children import descendants


def modulos(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W403: a signal under `%`."""
    signals = {item.name for item in spec.items if isinstance(item, ast.Signal | ast.Param)}
    for node in descendants(spec):
        if isinstance(node, ast.Binary) and node.op == "%" and _moves(node.left, signals):
            yield Diagnostic(
                "W403",
                "the robustness of a modulo jumps at its multiples",
                node.span,
                help=("keep the phase in a state that jumps back: `jump` in the system file",),
                note=("a gradient pulls away from the jump, never across it",),
            )


def _moves(node: ast.Expr, signals: set[str]) -> bool:
    return any(isinstance(part, ast.Name) and part.name in signals for part in descendants(node))
