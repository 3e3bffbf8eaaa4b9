"""Readable text of the IR: predicates as comparisons, windows in samples."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.grammar.printer import show_name

_LEVELS = {"+": 1, "-": 1, "*": 2, "/": 2, "%": 2, "^": 4}
"""Sign of an operator between two numbers -> its precedence."""
_FROZEN = re.compile(r"#\d+@.*", re.S)
_COMPONENT = re.compile(r"(?<!^)\[\d+\]\Z")
_UNARY = 3
_TOP = 5
_FLIPPED = {">": "<", ">=": "<=", "<": ">", "<=": ">="}


def show_formula(formula: ir.Formula) -> str:
    """Return the text of a formula with minimal parentheses."""
    match formula:
        case ir.Truth(value):
            return "true" if value else "false"
        case ir.Predicate():
            return _atom(formula)
        case ir.Shift(steps, body):
            name = {1: "next", -1: "prev"}.get(steps, f"shift[{steps}]")
            return f"{name}({show_formula(body)})"
        case ir.Freeze(bindings, body):
            bound = ", ".join(f"{shown(name)} = {show_number(num, 1)}" for name, num in bindings)
            return f"freeze {bound} in {_operand(body)}"
        case ir.AtStart(body):
            return f"at the start ({show_formula(body)})"
        case ir.Windowed():  # as `always[0..3] p` or `p until[0..3] q`
            *before, last = map(_operand, _parts(formula))
            window, end = formula.window, "start" if formula.back else "end"
            op = f"{formula.op}[{window.lo}..{end if window.hi is None else window.hi}]"
            return " ".join([*before, op, last])
        case ir.BoolOp(op):
            return f" {op} ".join(map(_operand, _parts(formula)))
        case _:
            raise TypeError(type(formula).__name__)


def _operand(formula: ir.Formula) -> str:
    """Return the text of an operand, in parentheses if it is an operator between several operands."""
    text = show_formula(formula)
    return f"({text})" if len(_parts(formula)) > 1 else text


def _parts(formula: ir.Formula) -> Sequence[ir.Formula]:
    """Return the operands of a formula that its text shows.

    The test of a timer is an `or` of two predicates: one with infinite robustness, and one with finite
    robustness (`timers.timer_test`). The text shows only the first one.
    """
    items = formula.operands
    if not isinstance(formula, ir.BoolOp):
        return items
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
    """Return the text of a predicate as a comparison, a constant on the right.

    `0.5 >= abs(s - 1)` becomes `abs(s - 1) <= 0.5`.
    """
    sign = {(1, True): ">", (1, False): ">=", (-1, True): "<", (-1, False): "<="}[atom.sign, atom.strict]
    num = atom.num
    left, right = num.args if isinstance(num, ir.Op) and num.name == "sub" else (num, ir.Const(0.0))
    if isinstance(left, ir.Const) and not isinstance(right, ir.Const):
        left, right, sign = right, left, _FLIPPED[sign]
    return f"{show_number(left)} {sign} {show_number(right)}"


def shown(name: str) -> str:
    """Return a name as written in the source, without the suffix that makes a frozen value unique."""
    name = _FROZEN.sub("", name)
    part = _COMPONENT.search(name)
    return show_name(name) if part is None else show_name(name[: part.start()]) + part[0]


def show_number(num: ir.Num, level: int = 0) -> str:
    """Return a number in infix notation.

    The text is in parentheses if the outermost operator has a lower precedence than `level`.
    """
    text, own = _number(num)
    return f"({text})" if own < level else text


def _leaf(leaf: Any) -> str:
    name = shown(leaf.name)
    if not isinstance(leaf, ir.ShiftedSignal):
        return "elapsed" if leaf == ir.Signal(ir.ELAPSED) else name
    if leaf == ir.Signal(leaf.name).at_first:
        return f"first({name})"
    stepping = {1: "next", -1: "prev"}.get(leaf.steps)
    return f"{stepping}({name})" if stepping else f"shift({name}, {leaf.steps})"


def _number(num: ir.Num) -> tuple[str, int]:
    """Return the text of a number, and the precedence of its outermost operator."""
    match num:
        case ir.Const(value):
            return f"{value:g}", _TOP if value >= 0 else _UNARY
        case ir.Op("neg", (arg,)):
            return f"-{show_number(arg, _UNARY)}", _UNARY
        case ir.Op("sub", (left, ir.Const(value))) if value < 0:
            return f"{show_number(left, 1)} + {-value:g}", 1
        case ir.Op("square", (arg,)):
            return f"{show_number(arg, _TOP)}^2", 4
        case ir.Op(name, (left, right)) if sign := FUNCTIONS[name].symbol:
            own = _LEVELS[sign]
            return f"{show_number(left, own)} {sign} {show_number(right, own + 1)}", own
        case ir.Op(name, args) | ir.Extern(name, args):
            return f"{name}({', '.join(map(show_number, args))})", _TOP
        case ir.Indicator(cond):
            return f"ind({show_formula(cond)})", _TOP
        case ir.Where(cond, yes, no):
            return f"if {show_formula(cond)} then {show_number(yes)} else {show_number(no)}", 0
        case _:
            return _leaf(num), _TOP
