"""C code of window extrema and `until`, forward and adjoint.

In the adjoint the gradient of a value goes to the operand that attains it, to one of equal ones. The prefix
`g` names the gradient of a buffer. Windows that all end or all begin with the trace are one recursive pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from stlc.compile.backends.c.plan import Buffer
from stlc.compile.ir import nodes as ir
from stlc.compile.schedule.schedule import IndexRange, earliest

Macro: TypeAlias = Literal["MIN", "MAX"]

_WORST: Mapping[Macro, str] = {"MIN": "INFINITY", "MAX": "(-INFINITY)"}
_DUAL: Mapping[Macro, Macro] = {"MIN": "MAX", "MAX": "MIN"}
_LESS: Mapping[Macro, str] = {"MIN": "<", "MAX": ">"}


@dataclass(frozen=True, slots=True)
class WindowStep:
    """Window extremum of one operand; of two operands `until` for MAX and `release` for MIN.

    Attributes:
        out: buffer of the values.
        run: instants of the values.
        pick: MAX or MIN.
        window: relative to each instant.
        back: past window (`since` and `trigger`).
        args: buffers of the operands.
        last: index of the last sample.
    """

    out: Buffer
    run: IndexRange
    pick: Macro
    window: ir.Window
    back: bool
    args: tuple[Buffer, ...]
    last: int

    @property
    def passes(self) -> bool:
        """True if each value follows from its neighbour by a recursion."""
        return self.window.hi is None and not self.run.single


def windowed(step: WindowStep) -> list[str]:
    """Return statements that compute the values."""
    return _extremum(step) if len(step.args) == 1 else _meeting(step)


def windowed_back(step: WindowStep) -> list[str]:
    """Return statements that propagate the gradient of the values to the operands."""
    return _extremum_back(step) if len(step.args) == 1 else _meeting_back(step)


def loop(run: IndexRange, *, back: bool = False) -> str:
    """Return the head of a loop over instants `k`."""
    if back:
        return f"for (int k = {run.last}; k >= {run.start}; --k)"
    return f"for (int k = {run.start}; k <= {run.last}; ++k)"


# ---------------------------------------------------------------------- extrema


def _extremum(step: WindowStep) -> list[str]:
    if step.passes:
        return _pass(step)
    return [
        f"{loop(step.run)} {{",
        *(f"  {line}" for line in _scan(step)),
        "}",
    ]


def _scan(step: WindowStep) -> list[str]:
    """Value at `k` by a loop over its window."""
    out, body, pick = step.out["k"], step.args[0], step.pick
    first, stop = _ends(step)
    return [
        f"LANE {out} = {_WORST[pick]};",
        f"for (int i = {first}; i <= {stop}; ++i) LANE {out} = {pick}({out}, {body['i']});",
    ]


def _pass(step: WindowStep) -> list[str]:
    """Values by recursion from the neighbour."""
    out, pick, lo = step.out, step.pick, step.window.lo
    there, before = (f"k - {lo}", "k - 1") if step.back else (f"k + {lo}", "k + 1")
    value = f"{pick}({out[before]}, {step.args[0][there]})"
    if step.back and earliest(step.run.start) < lo:
        return [
            *_begun(step, _scan(step)),
            f"  else if (k < {lo}) LANE {out['k']} = {_WORST[pick]};",
            f"  else LANE {out['k']} = {value};",
            "}",
        ]
    return [*_begun(step, _scan(step)), f"  else LANE {out['k']} = {value};", "}"]


def _extremum_back(step: WindowStep) -> list[str]:
    if step.passes:
        return _pass_back(step)
    return [f"{loop(step.run)} {{", *(f"  {line}" for line in _scan_back(step)), "}"]


def _scan_back(step: WindowStep) -> list[str]:
    out, body = step.out, step.args[0]
    first, stop = _ends(step)
    return [
        f"double left[LANES]; LANE left[j] = g{out['k']};",
        f"for (int i = {first}; i <= {stop}; ++i) LANE {{",
        f"  const int hit = {body['i']} == {out['k']};",
        f"  g{body['i']} += hit ? left[j] : 0.0; left[j] = hit ? 0.0 : left[j];",
        "}",
    ]


def _pass_back(step: WindowStep) -> list[str]:
    out, lo = step.out, step.window.lo
    there, before = (f"k - {lo}", "k - 1") if step.back else (f"k + {lo}", "k + 1")
    late = [f"  else if (k < {lo}) continue;"] if step.back and earliest(step.run.start) < lo else []
    return [
        *_begun(step, _scan_back(step), reverse=True),
        *late,
        "  else LANE {",
        f"    const int hit = {step.args[0][there]} == {out['k']};",
        f"    g{step.args[0][there]} += hit ? g{out['k']} : 0.0;",
        f"    g{out[before]} += hit ? 0.0 : g{out['k']};",
        "  }",
        "}",
    ]


# ------------------------------------------------------------------------ until


def _meeting(step: WindowStep) -> list[str]:
    if step.passes and not step.window.lo:
        return _meeting_pass(step)
    return [f"{loop(step.run)} {{", *(f"  {line}" for line in _meeting_scan(step)), "}"]


def _meeting_scan(step: WindowStep) -> list[str]:
    out, pick, lo = step.out["k"], step.pick, step.window.lo
    held = f"held[j] = {_DUAL[pick]}(held[j], {step.args[0]['i']});"
    near, far = _outwards(step)
    return [
        f"double held[LANES]; LANE {{ {out} = {_WORST[pick]}; held[j] = {_WORST[_DUAL[pick]]}; }}",
        *([f"{near} LANE {held}"] if lo else []),
        f"{far} LANE {{",
        f"  {held}",
        f"  const double met = {_DUAL[pick]}({step.args[1]['i']}, held[j]);",
        f"  {out} = {pick}({out}, met);",
        "}",
    ]


def _meeting_pass(step: WindowStep) -> list[str]:
    """`u(k) = min(left(k), max(right(k), u(k + 1)))`, or its dual."""
    pick, before = step.pick, "k - 1" if step.back else "k + 1"
    reached = f"{pick}({step.args[1]['k']}, {step.out[before]})"
    value = f"{_DUAL[pick]}({step.args[0]['k']}, {reached})"
    return [*_begun(step, _meeting_scan(step)), f"  else LANE {step.out['k']} = {value};", "}"]


def _meeting_back(step: WindowStep) -> list[str]:
    if step.passes and not step.window.lo:
        return _meeting_pass_back(step)
    lines = _meeting_scan_back(step)
    return [f"{loop(step.run)} LANE {{", *(f"  {line}" for line in lines), "}"]


def _meeting_scan_back(step: WindowStep) -> list[str]:
    """Gradient at the first instant that attains the value: to its right or to the worst left side so far."""
    out, left, right, less = step.out["k"], step.args[0], step.args[1], _LESS[_DUAL[step.pick]]
    near, far = _outwards(step)
    worse = f"if ({left['i']} {less} {left['worst']}) worst = i;"
    return [
        f"if (g{out} == 0.0) continue;",
        "int worst = k;",
        *([f"{near} {worse}"] if step.window.lo else []),
        f"{far} {{",
        f"  {worse}",
        f"  const int held = {left['worst']} {less} {right['i']};",
        f"  if ((held ? {left['worst']} : {right['i']}) == {out}) {{",
        f"    if (held) g{left['worst']} += g{out}; else g{right['i']} += g{out};",
        "    break;",
        "  }",
        "}",
    ]


def _meeting_pass_back(step: WindowStep) -> list[str]:
    out, left, right = step.out, step.args[0], step.args[1]
    before = "k - 1" if step.back else "k + 1"
    lines = ["LANE {", *(f"  {line}" for line in _meeting_scan_back(step)), "}"]
    return [
        *_begun(step, lines, reverse=True),
        "  else LANE {",
        f"    const double own = g{out['k']};",
        f"    const int held = {left['k']} == {out['k']}, met = {right['k']} == {out['k']};",
        f"    g{left['k']} += held ? own : 0.0;",
        f"    g{right['k']} += !held & met ? own : 0.0;",
        f"    g{out[before]} += !held & !met ? own : 0.0;",
        "  }",
        "}",
    ]


# -------------------------------------------------------------------- in common


def _ends(step: WindowStep) -> tuple[str, str]:
    """C expressions of the first and last sample of the window of `k`."""
    lo, hi = step.window.lo, step.window.hi
    if step.back:
        return "0" if hi is None else f"LATER(k - {hi}, 0)", f"k - {lo}"
    return f"k + {lo}", f"{step.last}" if hi is None else f"k + {hi}"


def _outwards(step: WindowStep) -> tuple[str, str]:
    """Loop heads from `k` to the near end of the window, and on to its far end."""
    first, stop = _ends(step)
    if step.back:
        return f"for (int i = k; i > LATER({stop}, -1); --i)", f"for (int i = {stop}; i >= {first}; --i)"
    return f"for (int i = k; i < {first}; ++i)", f"for (int i = {first}; i <= {stop}; ++i)"


def _begun(step: WindowStep, lines: list[str], *, reverse: bool = False) -> list[str]:
    """Head of a recursive pass with its initial statements; `reverse`: in the opposite direction."""
    run = step.run
    begin = run.start if step.back else run.last
    head = loop(run, back=not step.back if not reverse else step.back)
    return [f"{head} {{", f"  if (k == {begin}) {{", *(f"    {line}" for line in lines), "  }"]
