"""Formulas -> RTAMT's language, and RTAMT's values.

RTAMT (nickovic/rtamt) in discrete time cuts windows to the trace, as `--end truncate` does. What it means by
some operators is not what stlc means; the mapping says so line by line:

- its `until[a,b]` does not ask the left side for the instant at which the right side is met, ours does;
- it has no open bounds and no `inf`; time is counted in steps here, of a second each;
- its `<->` is `-|a - b|`, ours both implications;
- its `prev` and `next` are true outside of the trace, its `rise` takes "false" for what was before it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import count
from typing import Any

from proof.language import Atom, Edge, Formula, Many, Meet, Not, Over, Pair, Step, Window
from proof.levels import inside

from benchmarks.answers import import_rtamt

RTAMT = import_rtamt()

_NEGATIVE = re.compile(r"[(]-")


def values(formula: Formula, signals: Mapping[str, Any]) -> list[float]:
    """RTAMT's robustness at every sample; the trace has two at least."""
    spec = RTAMT.StlDiscreteTimeSpecification()
    for name in "xyz":
        spec.declare_var(name, "float")
    spec.spec = mapped(formula)
    spec.set_sampling_period(1, "s", 0.1)
    spec.parse()
    data = {
        "time": list(range(len(signals["x"]))),
        **{name: list(map(float, signals[name])) for name in "xyz"},
    }
    return [value for _, value in spec.evaluate(data)]


def mapped(formula: Formula) -> str:
    """The same formula in RTAMT's language and meaning."""
    match formula:
        case Atom(text):
            return f"({_NEGATIVE.sub('(0 - ', text)})"
        case Not(body):
            return _not(mapped(body))
        case Many(op, items):
            return "(" + f" {op} ".join(map(mapped, items)) + ")"
        case Pair(op, left, right):
            return _pair(op, mapped(left), mapped(right))
        case Over(op, window, body):
            return _over(op, window, mapped(body))
        case Meet(op, window, left, right):
            return _meet(op, window, mapped(left), mapped(right))
        case Step(steps, body):
            return _at("eventually" if steps > 0 else "once", 1, mapped(body))
        case Edge(op, body):
            now, before = mapped(body), _at("once", 1, mapped(body))
            if op == "fall":
                return f"({_not(now)} and {before})"
            return f"({now} and {_at('once', 1, _not(mapped(body)))})"
    raise TypeError(formula)


def _not(text: str) -> str:
    return f"(not {text})"


def _pair(op: str, left: str, right: str) -> str:
    there, back = f"({left} -> {right})", f"({right} -> {left})"
    if op == "->":
        return there
    both = f"({there} and {back})"
    return both if op == "<->" else _not(both)


def _steps(window: Window) -> tuple[int, int | None]:
    """First and last step of a window on the grid; None: to the end."""
    first = next(k for k in count() if inside(window, k, outward=False))
    if window.hi is None:
        return first, None
    return first, max(k for k in range(int(window.hi) + 1) if inside(window, k, outward=False))


def _bounds(first: int, last: int) -> str:
    return f"[{first}, {last}]"


def _at(op: str, steps: int, text: str) -> str:
    return f"({op}{_bounds(steps, steps)} {text})"


def _over(op: str, window: Window, body: str) -> str:
    first, last = _steps(window)
    if last is not None:
        return f"({op}{_bounds(first, last)} {body})"
    return _at(op, first, f"({op} {body})")


def _meet(op: str, window: Window, left: str, right: str) -> str:
    if op == "release":
        return _not(_meet("until", window, _not(left), _not(right)))
    first, last = _steps(window)
    if op == "unless":
        held = f"(always {left})" if last is None else f"(always{_bounds(0, last)} {left})"
        return f"({held} or {_meet('until', window, left, right)})"
    met = f"({left} and {right})"
    if last is not None:
        return f"({left} {op}{_bounds(first, last)} {met})"
    on_the_way, there = ("always", "eventually") if op == "until" else ("historically", "once")
    return f"(({on_the_way}{_bounds(0, first)} {left}) and {_at(there, first, f'({left} {op} {met})')})"
