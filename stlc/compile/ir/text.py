"""Readable text of the IR: predicates as comparisons, windows in samples."""

from __future__ import annotations

import re
from typing import assert_never

from stlc.compile.ir import nodes as ir
from stlc.grammar.show.printer import show_name

_INFIX = {
    "add": ("+", 1),
    "sub": ("-", 1),
    "mul": ("*", 2),
    "div": ("/", 2),
    "mod": ("%", 2),
    "pow": ("^", 4),
}
_FROZEN = re.compile(r"#\d+@.*", re.S)
_COMPONENT = re.compile(r"(?<!^)\[\d+\]\Z")
_UNARY = 3
_TOP = 5
_FLIPPED = {">": "<", ">=": "<=", "<": ">", "<=": ">="}


def show_window(window: ir.Window, end: str = "end") -> str:
    """Return a window in samples, `[0..25]`, `[5..end]`; past ones run back to `end` "start"."""
    return f"[{window.lo}..{end if window.hi is None else window.hi}]"


def show_formula(formula: ir.Formula) -> str:
    """Return the text of a formula with minimal parentheses."""
    match formula:
        case ir.Truth(value):
            return "true" if value else "false"
        case ir.Predicate():
            return _atom(formula)
        case ir.BoolOp(op, items):
            shown_items = _without_lacks(items)
            return f" {op} ".join(map(_operand, shown_items))
        case ir.Temporal(op, window, body) | ir.PastTemporal(op, window, body):
            end = "end" if isinstance(formula, ir.Temporal) else "start"
            return f"{op}{show_window(window, end)} {_operand(body)}"
        case ir.Until(op, window, left, right):
            return f"{_operand(left)} {op}{show_window(window)} {_operand(right)}"
        case ir.Since(op, window, left, right):
            return f"{_operand(left)} {op}{show_window(window, 'start')} {_operand(right)}"
        case ir.Shift(steps, body):
            name = {1: "next", -1: "prev"}.get(steps, f"shift[{steps}]")
            return f"{name}({show_formula(body)})"
        case ir.Freeze(bindings, body):
            bound = ", ".join(f"{shown(name)} = {show_number(num, 1)}" for name, num in bindings)
            return f"freeze {bound} in {_operand(body)}"
        case ir.AtStart(body):
            return f"at the start ({show_formula(body)})"
        case _:
            assert_never(formula)


def _operand(formula: ir.Formula) -> str:
    """Return an operand, in parentheses if it has several operands itself."""
    text = show_formula(formula)
    several = isinstance(formula, (ir.Until, ir.Since))
    several |= isinstance(formula, ir.BoolOp) and len(_without_lacks(formula.items)) > 1
    return f"({text})" if several else text


def _without_lacks(items: tuple[ir.Formula, ...]) -> list[ir.Formula]:
    """Drop predicates that only quantify the failure of an adjacent time test (`timers.timer_test`)."""
    tests = {item.num for item in items if isinstance(item, ir.Predicate) and item.guard}
    return [
        item
        for item in items
        if not (
            isinstance(item, ir.Predicate)
            and isinstance(item.num, ir.Op)
            and item.num.name == "mul"
            and item.num.args[0] in tests
        )
    ]


def _atom(atom: ir.Predicate) -> str:
    """Return a comparison, with the varying side first: `0.5 >= abs(s - 1)` is reversed."""
    sign = {(1, True): ">", (1, False): ">=", (-1, True): "<", (-1, False): "<="}[atom.sign, atom.strict]
    left, right = _sides(atom.num)
    if isinstance(left, ir.Const) and not isinstance(right, ir.Const):
        left, right, sign = right, left, _FLIPPED[sign]
    return f"{show_number(left)} {sign} {show_number(right)}"


def _sides(num: ir.Num) -> tuple[ir.Num, ir.Num]:
    match num:
        case ir.Op("sub", (left, right)):
            return left, right
        case _:
            return num, ir.Const(0.0)


def shown(name: str) -> str:
    """Return a name as written, without the unique suffix of a frozen value."""
    name = _FROZEN.sub("", name)
    part = _COMPONENT.search(name)
    return show_name(name) if part is None else show_name(name[: part.start()]) + part[0]


def show_number(num: ir.Num, level: int = 0) -> str:
    """Return a number in infix notation; `level` is the precedence of its context."""
    text, own = _number(num)
    return f"({text})" if own < level else text


def _leaf(leaf: ir.Signal | ir.ShiftedSignal | ir.FrozenVar) -> str:
    match leaf:
        case ir.Signal(ir.ELAPSED):
            return "elapsed"
        case ir.ShiftedSignal(name) if leaf == ir.at_first(ir.Signal(name)):
            return f"first({shown(name)})"
        case ir.ShiftedSignal(name, 1):
            return f"next({shown(name)})"
        case ir.ShiftedSignal(name, -1):
            return f"prev({shown(name)})"
        case ir.ShiftedSignal(name, steps):
            return f"shift({shown(name)}, {steps})"
        case _:
            return shown(leaf.name)


def _number(num: ir.Num) -> tuple[str, int]:
    match num:
        case ir.Const(value):
            return f"{value:g}", _TOP if value >= 0 else _UNARY
        case ir.Signal() | ir.ShiftedSignal() | ir.FrozenVar():
            return _leaf(num), _TOP
        case ir.Op("neg", (arg,)):
            return f"-{show_number(arg, _UNARY)}", _UNARY
        case ir.Op("sub", (left, ir.Const(value))) if value < 0:
            return f"{show_number(left, 1)} + {-value:g}", 1
        case ir.Op("square", (arg,)):
            return f"{show_number(arg, _TOP)}^2", 4
        case ir.Op(name, (left, right)) if name in _INFIX:
            sign, own = _INFIX[name]
            return f"{show_number(left, own)} {sign} {show_number(right, own + 1)}", own
        case ir.Op(name, args) | ir.Extern(name, args):
            return f"{name}({', '.join(map(show_number, args))})", _TOP
        case ir.Indicator(cond):
            return f"ind({show_formula(cond)})", _TOP
        case ir.Where(cond, yes, no):
            return f"if {show_formula(cond)} then {show_number(yes)} else {show_number(no)}", 0
        case _:
            assert_never(num)
