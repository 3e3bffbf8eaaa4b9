"""What tests of emitted C share."""

from __future__ import annotations

from formula_strategies import NAMES

from stlc.compile import ir
from stlc.compile.c_numbers import Untranslatable
from stlc.compile.emit_c import Motion, emit

STEPS = 14

OPERATIONS = {
    "add": 2, "sub": 2, "mul": 2, "div": 2, "mod": 2, "atan2": 2, "neg": 1, "square": 1, "abs": 1, "relu": 1,
    "floor": 1, "ceil": 1, "round": 1, "sign": 1, "sin": 1, "cos": 1, "tan": 1, "atan": 1, "exp": 1,
    "min": 3, "max": 3, "clip": 3, "norm": 3, "norm1": 3, "norminf": 3,
}  # fmt: skip
"""Functions of the table with how many arguments they are tried."""


def follower(steps: int = STEPS) -> Motion:
    """A system whose next state is its control: any trace is one of its rollouts."""
    controls = tuple(f"to_{name}" for name in NAMES)
    after = {name: ir.Col(control) for name, control in zip(NAMES, controls, strict=True)}
    return Motion(NAMES, controls, (), after, steps, 0.1)


def translatable(rule: ir.Formula) -> bool:
    """Whether a requirement has a C form."""
    try:
        emit(follower(), [rule])
    except Untranslatable:
        return False
    return True
