"""Extrema over windows, `until` and shifts as C, forwards and backwards.

Backwards, the gradient of a value goes to the operand that gave it; of equal ones one gets it. `g` before the
name of a buffer is that of its gradient. Windows that all end with the trace, or begin with it, are one pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

from stlc.compile.backends.c.index import Stretch
from stlc.compile.backends.c.numbers import literal
from stlc.compile.backends.c.steps import Extremum, Meeting, Moved, Pick
from stlc.compile.ir import nodes as ir

_WORST: Mapping[Pick, str] = {"MIN": "INFINITY", "MAX": "(-INFINITY)"}
_DUAL: Mapping[Pick, Pick] = {"MIN": "MAX", "MAX": "MIN"}
_LESS: Mapping[Pick, str] = {"MIN": "<", "MAX": ">"}


def windowed(step: Extremum | Meeting | Moved, last: int) -> list[str]:
    """Statements that give the values; `last` is the last sample."""
    match step:
        case Extremum():
            return _extremum(step, last)
        case Meeting():
            return _meeting(step, last)
        case Moved():
            return _moved(step, last)
        case _:
            assert_never(step)


def windowed_back(step: Extremum | Meeting | Moved, last: int) -> list[str]:
    """Statements that take the gradient by the values to what they came from."""
    match step:
        case Extremum():
            return _extremum_back(step, last)
        case Meeting():
            return _meeting_back(step, last)
        case Moved():
            return _moved_back(step, last)
        case _:
            assert_never(step)


# ---------------------------------------------------------------------- extrema


def _extremum(step: Extremum, last: int) -> list[str]:
    if _passes(step.window, step.run):
        return _pass(step, last)
    return [
        f"{step.run.loop()} {{",
        *(f"  {line}" for line in _scan(step, last)),
        "}",
    ]


def _scan(step: Extremum, last: int) -> list[str]:
    """The value at `k` from all samples of its window."""
    out, body, pick = step.out["k"], step.body, step.pick
    first, stop = _ends(step.window, last, back=step.back)
    return [
        f"LANE {out} = {_WORST[pick]};",
        f"for (int i = {first}; i <= {stop}; ++i) LANE {out} = {pick}({out}, {body['i']});",
    ]


def _pass(step: Extremum, last: int) -> list[str]:
    """Every value from its neighbour."""
    out, pick, lo = step.out, step.pick, step.window.lo
    there, before = (f"k - {lo}", "k - 1") if step.back else (f"k + {lo}", "k + 1")
    value = f"{pick}({out[before]}, {step.body[there]})"
    if step.back and step.run.first.low < lo:
        return [
            *_begun(step, _scan(step, last)),
            f"  else if (k < {lo}) LANE {out['k']} = {_WORST[pick]};",
            f"  else LANE {out['k']} = {value};",
            "}",
        ]
    return [*_begun(step, _scan(step, last)), f"  else LANE {out['k']} = {value};", "}"]


def _extremum_back(step: Extremum, last: int) -> list[str]:
    if _passes(step.window, step.run):
        return _pass_back(step, last)
    return [f"{step.run.loop()} {{", *(f"  {line}" for line in _scan_back(step, last)), "}"]


def _scan_back(step: Extremum, last: int) -> list[str]:
    out, body = step.out, step.body
    first, stop = _ends(step.window, last, back=step.back)
    return [
        f"double left[LANES]; LANE left[j] = g{out['k']};",
        f"for (int i = {first}; i <= {stop}; ++i) LANE {{",
        f"  const int hit = {body['i']} == {out['k']};",
        f"  g{body['i']} += hit ? left[j] : 0.0; left[j] = hit ? 0.0 : left[j];",
        "}",
    ]


def _pass_back(step: Extremum, last: int) -> list[str]:
    out, lo = step.out, step.window.lo
    there, before = (f"k - {lo}", "k - 1") if step.back else (f"k + {lo}", "k + 1")
    late = [f"  else if (k < {lo}) continue;"] if step.back and step.run.first.low < lo else []
    return [
        *_begun(step, _scan_back(step, last), reverse=True),
        *late,
        "  else LANE {",
        f"    const int hit = {step.body[there]} == {out['k']};",
        f"    g{step.body[there]} += hit ? g{out['k']} : 0.0;",
        f"    g{out[before]} += hit ? 0.0 : g{out['k']};",
        "  }",
        "}",
    ]


# ------------------------------------------------------------------------ until


def _meeting(step: Meeting, last: int) -> list[str]:
    if step.window.lo == 0 and _passes(step.window, step.run):
        return _meeting_pass(step, last)
    return [f"{step.run.loop()} {{", *(f"  {line}" for line in _meeting_scan(step, last)), "}"]


def _meeting_scan(step: Meeting, last: int) -> list[str]:
    out, pick, lo = step.out["k"], step.pick, step.window.lo
    held = f"held[j] = {_DUAL[pick]}(held[j], {step.left['i']});"
    near, far = _outwards(step, last)
    return [
        f"double held[LANES]; LANE {{ {out} = {_WORST[pick]}; held[j] = {_WORST[_DUAL[pick]]}; }}",
        *([f"{near} LANE {held}"] if lo else []),
        f"{far} LANE {{",
        f"  {held}",
        f"  const double met = {_DUAL[pick]}({step.right['i']}, held[j]);",
        f"  {out} = {pick}({out}, met);",
        "}",
    ]


def _meeting_pass(step: Meeting, last: int) -> list[str]:
    """`u(k) = min(left(k), max(right(k), u(k + 1)))`, or its dual."""
    pick, before = step.pick, "k - 1" if step.back else "k + 1"
    reached = f"{pick}({step.right['k']}, {step.out[before]})"
    value = f"{_DUAL[pick]}({step.left['k']}, {reached})"
    return [*_begun(step, _meeting_scan(step, last)), f"  else LANE {step.out['k']} = {value};", "}"]


def _meeting_back(step: Meeting, last: int) -> list[str]:
    if step.window.lo == 0 and _passes(step.window, step.run):
        return _meeting_pass_back(step, last)
    lines = _meeting_scan_back(step, last)
    return [f"{step.run.loop()} LANE {{", *(f"  {line}" for line in lines), "}"]


def _meeting_scan_back(step: Meeting, last: int) -> list[str]:
    """The first instant that gives the value: there the right side, or the worst of the left one so far."""
    out, left, right, less = step.out["k"], step.left, step.right, _LESS[_DUAL[step.pick]]
    near, far = _outwards(step, last)
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


def _meeting_pass_back(step: Meeting, last: int) -> list[str]:
    out, left, right = step.out, step.left, step.right
    before = "k - 1" if step.back else "k + 1"
    lines = ["LANE {", *(f"  {line}" for line in _meeting_scan_back(step, last)), "}"]
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


# ----------------------------------------------------------------------- shifts


def _moved(step: Moved, last: int) -> list[str]:
    out, outside = step.out["k"], literal(step.outside)
    if step.body is None:
        return [f"{step.run.loop()} LANE {out} = {outside};"]
    there = f"k + ({step.steps})"
    return [
        f"{step.run.loop()}",
        f"  if ({there} < 0 || {there} > {last}) LANE {out} = {outside};",
        f"  else LANE {out} = {step.body[there]};",
    ]


def _moved_back(step: Moved, last: int) -> list[str]:
    if step.body is None:
        return []
    there = f"k + ({step.steps})"
    return [
        f"{step.run.loop()}",
        f"  if ({there} >= 0 && {there} <= {last}) LANE g{step.body[there]} += g{step.out['k']};",
    ]


# -------------------------------------------------------------------- in common


def _ends(window: ir.Window, last: int, *, back: bool) -> tuple[str, str]:
    """First and last sample of the window of `k`."""
    if back:
        return "0" if window.hi is None else f"LATER(k - {window.hi}, 0)", f"k - {window.lo}"
    return f"k + {window.lo}", f"{last}" if window.hi is None else f"k + {window.hi}"


def _outwards(step: Meeting, last: int) -> tuple[str, str]:
    """Heads of loops from `k` to where the window begins, and on to its other end."""
    first, stop = _ends(step.window, last, back=step.back)
    if step.back:
        return f"for (int i = k; i > LATER({stop}, -1); --i)", f"for (int i = {stop}; i >= {first}; --i)"
    return f"for (int i = k; i < {first}; ++i)", f"for (int i = {first}; i <= {stop}; ++i)"


def _passes(window: ir.Window, run: Stretch) -> bool:
    return window.hi is None and not run.single


def _begun(step: Extremum | Meeting, lines: list[str], *, reverse: bool = False) -> list[str]:
    """The head of a pass, and what it begins with; `reverse`: in the other direction."""
    run = step.run
    begin = run.first if step.back else run.last
    head = run.loop(back=not step.back if not reverse else step.back)
    return [f"{head} {{", f"  if (k == {begin.text}) {{", *(f"    {line}" for line in lines), "  }"]
