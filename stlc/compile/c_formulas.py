"""Formulas of the IR as C: exact robustness at the first sample, over columns that a rollout has filled.

Values of a sub-formula at `count` instants stand in a buffer `[count][LANES]`; the innermost loop runs over
trajectories, so every line of it becomes vector code. Only the instants that the root needs are computed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import assert_never

from stlc.compile import ir
from stlc.compile.c_numbers import NumberWriter, Untranslatable
from stlc.compile.samples import everything


@dataclass(slots=True)
class FormulaWriter:
    """Writes formulas over trajectories of `samples` samples.

    Attributes:
        samples: T + 1.
        column: C expression of an environment entry at a sample, which is one too, and lane `j`.
        lines: statements written so far.
        size: doubles that the buffers take per lane.
        buffers: their names, and where they begin.
    """

    samples: int
    column: Callable[[str, str], str]
    lines: list[str] = field(default_factory=list)
    size: int = 0
    buffers: list[tuple[str, int]] = field(default_factory=list)
    _known: dict[tuple[ir.Formula, int, int], str] = field(default_factory=dict)
    _calls: dict[tuple[str, tuple[ir.Num, ...]], list[str]] = field(default_factory=dict)

    def value(self, formula: ir.Formula, start: int = 0, count: int = 1) -> str:
        """The buffer with the robustness of a formula at `count` instants from `start` on."""
        formula = _split(formula)
        key = (formula, start, count)
        known = self._known.get(key)
        if known is None:
            if count < 1 or start < 0 or start + count > self.samples:
                raise Untranslatable("a window that leaves the plan")
            known = self._known[key] = self._value(formula, start, count)
        return known

    def _value(self, formula: ir.Formula, start: int, count: int) -> str:
        match formula:
            case ir.Truth(value):
                return self._fill(count, "INFINITY" if value else "(-INFINITY)")
            case ir.Atom():
                return self._atom(formula, start, count)
            case ir.Join(op, items):
                pick = "MIN" if op == "and" else "MAX"
                parts = [self.value(item, start, count) for item in items]
                text = f"{parts[0]}[k][j]"
                for part in parts[1:]:
                    text = f"{pick}({text}, {part}[k][j])"
                return self._fill(count, text)
            case ir.Over(op, window, body):
                return self._window("MIN" if op == "always" else "MAX", window, body, start, count)
            case ir.Until(op, window, left, right):
                return self._until(op == "until", window, (left, right), (start, count))
            case ir.Past() | ir.Since() | ir.Shift() | ir.Freeze() | ir.AtStart():
                raise Untranslatable(type(formula).__name__)
            case _:
                assert_never(formula)

    def _atom(self, atom: ir.Atom, start: int, count: int) -> str:
        heads: dict[str, str] = {}
        writer = NumberWriter(
            lambda name: self.column(name, "k"),
            lambda leaf: self._elsewhere(leaf, start, count, heads),
            self._called,
        )
        margin = writer.number(atom.num)
        value = margin if atom.sign > 0 else f"(-{margin})"
        if atom.guard:
            value = f"({value} {'>' if atom.strict else '>='} 0.0 ? INFINITY : -INFINITY)"
        name = self._buffer(count)
        body = " ".join([*writer.lines, f"bad[j] += NAN_IN({value});", f"{name}[s][j] = {value};"])
        self.lines.append(f"{over(start, count, heads)} LANE {{ {body} }} }}")
        return name

    def _elsewhere(self, leaf: ir.At, start: int, count: int, heads: dict[str, str]) -> str:
        """A column so many samples from here; a clamped one stays within the plan.

        What its index is goes to `heads`: it does not depend on the lane.
        """
        last = self.samples - 1
        index = f"k + ({leaf.steps})"
        if leaf.clamped:
            kept = f"{index} < {last} ? {index} : {last}" if leaf.steps > 0 else f"{index} > 0 ? {index} : 0"
            index = f"{'after' if leaf.steps > 0 else 'before'}{abs(leaf.steps)}"
            heads[index] = kept
        elif start + leaf.steps < 0 or start + count - 1 + leaf.steps > last:
            raise Untranslatable("a sample outside of the plan")
        return self.column(leaf.name, index)

    def _called(self, num: ir.Extern) -> str | None:
        """A function of columns, computed once for all samples and all predicates that call it."""
        if not isinstance(num.function, ir.Body) or not all(isinstance(arg, ir.Col) for arg in num.args):
            return None
        key = (num.name, num.args)
        if key not in self._calls:
            writer = NumberWriter(lambda name: self.column(name, "k"))
            parts = [replace(num, output=index) for index in range(len(num.function.outputs))]
            values = [writer.number(part) for part in parts]
            names = [self._buffer(self.samples) for _ in parts]
            stores = [f"{name}[k][j] = {value};" for name, value in zip(names, values, strict=True)]
            body = " ".join([*writer.lines, *stores])
            self.lines.append(f"for (int k = 0; k < {self.samples}; ++k) LANE {{ {body} }}")
            self._calls[key] = names
        return f"{self._calls[key][num.output]}[k][j]"

    def _last(self, window: ir.Window, start: int, count: int) -> int:
        """Last sample that the window of the last instant reaches."""
        latest = start + count - 1
        last = self.samples - 1 if window.hi is None else latest + window.hi
        if latest + window.lo > last:
            raise Untranslatable("a window that begins beyond the plan")
        return last

    def _window(self, pick: str, window: ir.Window, body: ir.Formula, start: int, count: int) -> str:
        first, last = start + window.lo, self._last(window, start, count)
        inner = self.value(body, first, last - first + 1)
        end = f"{last - first + 1}" if window.hi is None else f"k + {window.hi - window.lo + 1}"
        name = self._buffer(count)
        self.lines += [
            f"for (int k = 0; k < {count}; ++k) {{",
            f"  LANE {name}[k][j] = {inner}[k][j];",
            f"  for (int i = k + 1; i < {end}; ++i) LANE {name}[k][j] = {pick}({name}[k][j], {inner}[i][j]);",
            "}",
        ]
        return name

    def _until(
        self, until: bool, window: ir.Window, sides: tuple[ir.Formula, ir.Formula], at: tuple[int, int]
    ) -> str:
        (left, right), (start, count) = sides, at
        last = self._last(window, start, count)
        span = last - start + 1
        hold, goal = self.value(left, start, span), self.value(right, start, span)
        inner, outer, worst = ("MIN", "MAX", "-INFINITY") if until else ("MAX", "MIN", "INFINITY")
        end = f"{span}" if window.hi is None else f"k + {window.hi + 1}"
        name, run = self._buffer(count), self._buffer(1)
        self.lines += [
            f"for (int k = 0; k < {count}; ++k) {{",
            f"  LANE {{ {name}[k][j] = {worst}; {run}[0][j] = -({worst}); }}",
            f"  for (int i = k; i < {end}; ++i) LANE {{",
            f"    {run}[0][j] = {inner}({run}[0][j], {hold}[i][j]);",
            f"    const double both = {inner}({goal}[i][j], {run}[0][j]);",
            f"    {name}[k][j] = i >= k + {window.lo} ? {outer}({name}[k][j], both) : {name}[k][j];",
            "  }",
            "}",
        ]
        return name

    def _fill(self, count: int, value: str) -> str:
        name = self._buffer(count)
        self.lines.append(f"for (int k = 0; k < {count}; ++k) LANE {name}[k][j] = {value};")
        return name

    def _buffer(self, count: int) -> str:
        name = f"b{len(self.buffers)}"
        self.buffers.append((name, self.size))
        self.lines.append(
            f"double (*restrict {name})[LANES] = (double (*)[LANES])(room + {self.size} * LANES);"
        )
        self.size += count
        return name


def over(start: int, count: int, heads: Mapping[str, str]) -> str:
    """The head of a loop over `count` samples `k` from `start` on, `s` counting from 0, and its indices."""
    indices = " ".join(f"const int {name} = {value};" for name, value in heads.items())
    return f"for (int s = 0, k = {start}; s < {count}; ++s, ++k) {{ {indices}"


LARGE = 64
"""Nodes of a number from which on its extrema are computed apart: compilers take long over long loops."""


def _split(formula: ir.Formula) -> ir.Formula:
    """A predicate over the extremum of large numbers as a formula over predicates; anything else as it is."""
    if not isinstance(formula, ir.Atom) or formula.guard or not isinstance(formula.num, ir.Op):
        return formula
    name, args = formula.num.name, formula.num.args
    if name not in ("min", "max", "neg") or not _large(formula.num):
        return formula
    if name == "neg":
        return _split(replace(formula, num=args[0], sign=-formula.sign, strict=formula.strict))
    if len(args) == 1:
        return _split(replace(formula, num=args[0]))
    both = (name == "min") == (formula.sign > 0)
    return ir.Join("and" if both else "or", tuple(replace(formula, num=arg) for arg in args), formula.span)


def _large(num: ir.Num) -> bool:
    return next(islice(everything(num), LARGE, None), None) is not None
