"""C code of the steps of a schedule: forward code computes values, adjoint code computes gradients.

For each kind of step there is a class that prints both codes (`FORMS`). The states are already known from a
simulation. The innermost loop runs over trajectories and is vectorized. `gb7` is the gradient with respect to
buffer `b7`, and `gx` the gradient with respect to the states. The gradient of a minimum or maximum goes to
the first of equal operands.

If a step is a loop over other steps, the adjoint code recomputes the body of the loop. Iterations whose
gradient is zero are skipped. Windows that all end with the trace, or all begin with it, are computed by one
recursion.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from stlc.compile.backends.c.numbers import LISTED, NumberWriter, literal
from stlc.compile.backends.c.plan import Buffer, Called, Frozen, Loop, Plan, Tabled, call_of
from stlc.compile.backends.c.slopes import COUNTED, SlopeWriter
from stlc.compile.backends.numbers import Leaf
from stlc.compile.backends.schedule import PICKS, IndexRange, ScheduleStep, earliest, latest, neutral
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Pick

Macro: TypeAlias = Literal["MIN", "MAX"]

_MACRO: Mapping[Pick, Macro] = {"min": "MIN", "max": "MAX"}
_WORST: Mapping[Macro, str] = {"MIN": "INFINITY", "MAX": "(-INFINITY)"}
_DUAL: Mapping[Macro, Macro] = {"MIN": "MAX", "MAX": "MIN"}
_LESS: Mapping[Macro, str] = {"MIN": "<", "MAX": ">"}

HeldBuffers: TypeAlias = Mapping[str, Buffer]
"""Name of a frozen value -> its buffer."""


@dataclass(frozen=True, slots=True)
class StepPrinter:
    """Printer of the C code of steps.

    Attributes:
        plan: schedule and memory of the steps.
        index: state name -> index in the array of trajectories.
        held: name of a frozen value (bound by `freeze`) -> its buffer.
    """

    plan: Plan
    index: Mapping[str, int]
    held: HeldBuffers = field(default_factory=dict)

    def forward(self, steps: Sequence[ScheduleStep]) -> list[str]:
        """Return C statements that compute the values of all steps."""
        return [line for step in steps for line in self._form(step).forward()]

    def backward(self, steps: Sequence[ScheduleStep]) -> list[str]:
        """Return C statements that propagate the gradient back through all steps."""
        return [line for step in reversed(steps) for line in self._form(step).backward()]

    def _form(self, step: ScheduleStep) -> StepForm:
        return FORMS[type(step.node)](self, step)


class StepForm(ABC):
    """Printer of the C code of one step: `forward` for its values, `backward` for the gradients."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        self.printer, self.plan, self.step = printer, printer.plan, step
        self.node: Any = step.node
        self.run = step.run
        self.out = self.plan.buffers[step.number]
        self.args = tuple(self.plan.buffers[number] for number in step.operands)
        self.last = self.plan.samples - 1

    @abstractmethod
    def forward(self) -> list[str]:
        """Return C statements that compute the values of the step."""

    @abstractmethod
    def backward(self) -> list[str]:
        """Return C statements that propagate the gradient from the values of the step to its operands."""

    def filled(self, value: float) -> list[str]:
        """Return C statements that set the values of the step to `value` at all instants."""
        return [f"{loop(self.run)} LANE {self.out['k']} = {literal(value)};"]


def loop(run: IndexRange, *, back: bool = False) -> str:
    """Return the head of a C loop over the instants `k` in `run`; if `back`, it runs backward in time."""
    if back:
        return f"for (int k = {run.last}; k >= {run.start}; --k)"
    return f"for (int k = {run.start}; k <= {run.last}; ++k)"


def _indented(lines: Iterable[str], by: int = 2) -> list[str]:
    return [" " * by + line for line in lines]


# ---------------------------------------------------------------------- numbers


@dataclass(frozen=True, slots=True)
class LeafReader:
    """Function that returns the C expression of a leaf (signal, call, frozen value) at sample `k`.

    Attributes:
        printer: printer of the step that contains the expression.
        indices: C name of a sample index -> its C expression, for indices that are clamped to the trajectory.
    """

    printer: StepPrinter
    indices: dict[str, str] = field(default_factory=dict)

    def __call__(self, leaf: Leaf) -> str | None:
        """Return the C expression of a leaf; None for a function that must be expanded in place."""
        if isinstance(leaf, ir.FrozenVar):
            return self.printer.held[leaf.name][0]
        if not isinstance(leaf, ir.Extern):
            return column(self.printer.index, leaf.name, self._instant(leaf))
        key, plan = call_of(leaf), self.printer.plan
        return (
            None if key is None else plan.buffers[plan.calls[key] + leaf.output][self._instant(leaf.args[0])]
        )

    def _instant(self, leaf: ir.Num) -> str:
        """C expression of the index of the sample at which a signal is read.

        If the sample may lie outside the trajectory, a clamped read gives the first or last sample instead.
        The result is then a C variable that `heads` declares.
        """
        if not isinstance(leaf, ir.ShiftedSignal):
            return "k"
        steps, last = leaf.steps, self.printer.plan.samples - 1
        index = f"k + ({steps})"
        if not leaf.clamped:
            return index
        name = f"{'after' if steps > 0 else 'before'}{abs(steps)}"
        self.indices[name] = f"{index} < {last} ? {index} : {last}" if steps > 0 else f"LATER({index}, 0)"
        return name

    def heads(self) -> str:
        """C declarations of the sample indices that are clamped to the trajectory."""
        return " ".join(f"const int {name} = {value};" for name, value in self.indices.items())


def _gradient(num: ir.Num, seed: str, reader: LeafReader) -> list[str]:
    """C statements that propagate the gradient of an expression at sample `k` to its leaves (signals, calls).

    `seed` is the C expression of the derivative of the robustness with respect to the expression. Several
    leaves may read the same sample, so gradients are added to them outside of the vectorized loop. There are
    no statements if no leaf has a gradient.
    """
    writer = SlopeWriter(reader, soft=False)
    lines, gathered = writer.backward({writer.number(num): seed})
    if not gathered:
        return []
    shares = [f"h{i}" for i in range(len(gathered))]
    return [
        *(f"double {share}[LANES];" for share in shares),
        "LANE {",
        *writer.lines,
        *lines,
        *(f"{share}[j] = {value};" for share, value in zip(shares, gathered.values(), strict=True)),
        "}",
        *(f"LANE {place} += {share}[j];" for share, place in zip(shares, gathered, strict=True)),
    ]


def column(index: Mapping[str, int], name: str, k: str) -> str:
    """Return the C expression of a state, or of the elapsed time, at sample `k`, for trajectory `j`.

    `name` is the name of a state, or of an entry in the table of a family of formulas (`FamilyTable`). Such
    an entry stands for a different state in each row.
    """
    if name == ir.ELAPSED:
        return f"{COUNTED}({k})"
    where = name.removeprefix(LISTED) if name.startswith(LISTED) else index[name]
    return f"x[{where}][{k}][j]"


class _Margin(StepForm):
    """C code of a predicate."""

    def forward(self) -> list[str]:
        node, reader = self.node, LeafReader(self.printer)
        writer = NumberWriter(reader)
        margin = writer.number(node.num)
        value = margin if node.sign > 0 else f"(-{margin})"
        if node.guard:
            value = f"({value} {'>' if node.strict else '>='} 0.0 ? INFINITY : -INFINITY)"
        body = " ".join([*writer.lines, f"bad[j] += NAN_IN({value});", f"{self.out['k']} = {value};"])
        return [f"{loop(self.run)} {{ {reader.heads()} LANE {{ {body} }} }}"]

    def backward(self) -> list[str]:
        """Return C statements that propagate the gradient; none if it is zero.

        It is zero for guards (predicates whose robustness is +inf or -inf) and for predicates on the elapsed
        time alone.
        """
        sign, reader = "" if self.node.sign > 0 else "-", LeafReader(self.printer)
        inner = [] if self.node.guard else _gradient(self.node.num, f"{sign}g{self.out['k']}", reader)
        return [f"{loop(self.run)} {{ {reader.heads()}", *inner, "}"] if inner else []


class _Call(StepForm):
    """C code of a function call with signals as arguments: all its results, at all samples."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.parts: list[ir.Extern] = self.node.components
        self.outs = self.plan.buffers[step.number : step.number + len(self.parts)]

    def _place(self, leaf: Leaf) -> str | None:
        """C expression of a signal at sample `k`; None for a function: its body is then written in place."""
        return column(self.printer.index, leaf.name, "k") if isinstance(leaf, ir.Signal) else None

    def forward(self) -> list[str]:
        writer = NumberWriter(self._place)
        values = map(writer.number, self.parts)
        stores = [f"{out['k']} = {value};" for out, value in zip(self.outs, values, strict=True)]
        return [f"{loop(self.run)} LANE {{ {' '.join([*writer.lines, *stores])} }}"]

    def backward(self) -> list[str]:
        writer = SlopeWriter(self._place, soft=False)
        lines = writer.gradients(
            (part, f"g{out['k']}") for out, part in zip(self.outs, self.parts, strict=True)
        )
        return [f"{loop(self.run)} LANE {{", *lines, "}"]


# ---------------------------------------------- values of the operands at one instant


class _Constant(StepForm):
    """C code of the constant `true` or `false`."""

    def forward(self) -> list[str]:
        return self.filled(math.inf if self.node.value else -math.inf)

    def backward(self) -> list[str]:
        return []


class _Extremum(StepForm):
    """C code of `and` or `or`, one statement per operand.

    A single statement would nest the C macros for minimum and maximum, which repeat their arguments: the text
    would double in length with each operand.
    """

    def forward(self) -> list[str]:
        pick, (first, *others) = _MACRO[PICKS[self.node.op]], self.args
        rest = " ".join(f"most = {pick}(most, {item['k']});" for item in others)
        return [f"{loop(self.run)} LANE {{ double most = {first['k']}; {rest} {self.out['k']} = most; }}"]

    def backward(self) -> list[str]:
        lines = [f"{loop(self.run)} LANE {{", f"double left = g{self.out['k']};"]
        for item in self.args:
            lines += [
                f"{{ const int hit = {item['k']} == {self.out['k']};",
                f"g{item['k']} += hit ? left : 0.0; left = hit ? 0.0 : left; }}",
            ]
        return [*lines, "}"]


class _AtStart(StepForm):
    """C code of an operator whose value, at every instant, is that of its operand at the first sample."""

    def forward(self) -> list[str]:
        return [f"{loop(self.run)} LANE {self.out['k']} = {self.args[0][0]};"]

    def backward(self) -> list[str]:
        return [f"{loop(self.run)} LANE g{self.args[0][0]} += g{self.out['k']};"]


class _Shifted(StepForm):
    """C code of an operator whose value is that of its operand some samples later or earlier."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.there = f"k + ({self.node.steps})"

    def forward(self) -> list[str]:
        outside, there = math.inf if self.node.outside else -math.inf, self.there
        if not self.args:
            return self.filled(outside)
        return [
            loop(self.run),
            f"  if ({there} < 0 || {there} > {self.last}) LANE {self.out['k']} = {literal(outside)};",
            f"  else LANE {self.out['k']} = {self.args[0][there]};",
        ]

    def backward(self) -> list[str]:
        if not self.args:
            return []
        there, seed = self.there, f"g{self.out['k']}"
        within = f"{there} >= 0 && {there} <= {self.last}"
        return [loop(self.run), f"  if ({within}) LANE g{self.args[0][there]} += {seed};"]


# ---------------------------------------------------------------------- windows


class _Windowed(StepForm):
    """C code of a temporal operator: an extremum over a window, `until`, `release`, or a past operator.

    The value at an instant is computed by a loop over its window (`_scan`). If the windows extend to the end
    or to the start of the trace, the value is computed from the value at the adjacent instant (`_step`).
    """

    lanes = ""
    """" LANE" if the adjoint of a window branches by lane."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.back = self.node.back
        self.pick = _MACRO[PICKS[self.node.op]]
        self.window: ir.Window = self.node.window
        self.before = self.out["k - 1" if self.back else "k + 1"]
        self.recursive = self.window.hi is None and not self.run.single

    @abstractmethod
    def _scan(self) -> list[str]: ...

    @abstractmethod
    def _step(self) -> str: ...

    @abstractmethod
    def _scan_back(self) -> list[str]: ...

    @abstractmethod
    def _step_back(self) -> list[str]: ...

    def forward(self) -> list[str]:
        if not self.args:
            return self.filled(neutral(PICKS[self.node.op]))
        if not self.recursive:
            return [f"{loop(self.run)} {{", *_indented(self._scan()), "}"]
        empty = self._empty(f"LANE {self.out['k']} = {_WORST[self.pick]};")
        return [*self._recursion(self._scan()), *empty, f"  else LANE {self.out['k']} = {self._step()};", "}"]

    def backward(self) -> list[str]:
        if not self.args:
            return []
        lines = self._scan_back()
        if not self.recursive:
            return [f"{loop(self.run)}{self.lanes} {{", *_indented(lines), "}"]
        if self.lanes:
            lines = ["LANE {", *_indented(lines), "}"]
        head = [*self._recursion(lines, reverse=True), *self._empty("continue;")]
        return [*head, "  else LANE {", *_indented(self._step_back(), 4), "  }", "}"]

    def _recursion(self, lines: list[str], *, reverse: bool = False) -> list[str]:
        """Head of the C loop that computes each instant from the adjacent one (for unbounded windows).

        `lines` are the C statements for the instant at which the computation starts. With `reverse` the loop
        runs in the opposite direction, as the gradient needs.
        """
        first = self.run.start if self.back else self.run.last
        head = loop(self.run, back=self.back if reverse else not self.back)
        return [f"{head} {{", f"  if (k == {first}) {{", *_indented(lines, 4), "  }"]

    def _empty(self, statement: str) -> list[str]:
        """C branch that executes `statement` at instants whose window lies outside of the trace.

        If there are no such instants, the result is empty.
        """
        lo = self.window.lo
        if self.back:
            return [f"  else if (k < {lo}) {statement}"] if earliest(self.run.start) < lo else []
        return (
            [f"  else if (k > {self.last - lo}) {statement}"]
            if latest(self.run.last) + lo > self.last
            else []
        )

    def _ends(self) -> tuple[str, str]:
        """C expressions of the first and last sample of the window at instant `k`."""
        lo, hi = self.window.lo, self.window.hi
        if self.back:
            return "0" if hi is None else f"LATER(k - {hi}, 0)", f"k - {lo}"
        if hi is None:
            return f"k + {lo}", f"{self.last}"
        leaves = latest(self.run.last) + hi > self.last
        return f"k + {lo}", f"(k + {hi} < {self.last} ? k + {hi} : {self.last})" if leaves else f"k + {hi}"


class _WindowExtremum(_Windowed):
    """C code of the minimum or maximum of one operand over a window."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.next = f"k {'-' if self.back else '+'} {self.window.lo}"
        """Sample that the window gains in a step of the recursion."""

    def _scan(self) -> list[str]:
        (first, stop), out, pick = self._ends(), self.out["k"], self.pick
        return [
            f"LANE {out} = {_WORST[pick]};",
            f"for (int i = {first}; i <= {stop}; ++i) LANE {out} = {pick}({out}, {self.args[0]['i']});",
        ]

    def _step(self) -> str:
        return f"{self.pick}({self.before}, {self.args[0][self.next]})"

    def _scan_back(self) -> list[str]:
        (first, stop), out, body = self._ends(), self.out["k"], self.args[0]["i"]
        return [
            f"double left[LANES]; LANE left[j] = g{out};",
            f"for (int i = {first}; i <= {stop}; ++i) LANE {{",
            f"  const int hit = {body} == {out};",
            f"  g{body} += hit ? left[j] : 0.0; left[j] = hit ? 0.0 : left[j];",
            "}",
        ]

    def _step_back(self) -> list[str]:
        out, gained = self.out["k"], self.args[0][self.next]
        return [
            f"const int hit = {gained} == {out};",
            f"g{gained} += hit ? g{out} : 0.0;",
            f"g{self.before} += hit ? 0.0 : g{out};",
        ]


class _Until(_Windowed):
    """C code of `until` (maximum), `release` (minimum), and their past counterparts."""

    lanes = " LANE"

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.dual = _DUAL[self.pick]
        self.recursive = self.recursive and not self.window.lo

    def _outwards(self) -> tuple[str, str]:
        """Two C loop heads: from `k` to the near end of the window, and from there to its far end."""
        first, stop = self._ends()
        if self.back:
            return f"for (int i = k; i > LATER({stop}, -1); --i)", f"for (int i = {stop}; i >= {first}; --i)"
        leaves = latest(self.run.last) + self.window.lo > self.last
        near = f"i < {first} && i <= {self.last}" if leaves else f"i < {first}"
        return f"for (int i = k; {near}; ++i)", f"for (int i = {first}; i <= {stop}; ++i)"

    def _scan(self) -> list[str]:
        out, pick, dual = self.out["k"], self.pick, self.dual
        held = f"held[j] = {dual}(held[j], {self.args[0]['i']});"
        near, far = self._outwards()
        return [
            f"double held[LANES]; LANE {{ {out} = {_WORST[pick]}; held[j] = {_WORST[dual]}; }}",
            *([f"{near} LANE {held}"] if self.window.lo else []),
            f"{far} LANE {{",
            f"  {held}",
            f"  const double met = {dual}({self.args[1]['i']}, held[j]);",
            f"  {out} = {pick}({out}, met);",
            "}",
        ]

    def _step(self) -> str:
        """C expression of `until` at `k`: `min(left(k), max(right(k), until(k + 1)))`.

        For past operators, k - 1 replaces k + 1. For `release`, min and max are exchanged.
        """
        reached = f"{self.pick}({self.args[1]['k']}, {self.before})"
        return f"{self.dual}({self.args[0]['k']}, {reached})"

    def _scan_back(self) -> list[str]:
        """C statements that pass the gradient of the value at `k` to the operand that attains the value.

        For `until`, the value is the maximum over the window of `min(right[i], left[k], …, left[i])`. The
        statements search for the first `i` whose minimum equals the value. If this minimum is `right[i]`,
        then `right` gets the gradient at `i`. Otherwise `left` gets it, at the sample of its least value. For
        `release`, minimum and maximum are exchanged.
        """
        out, (left, right), less = self.out["k"], self.args, _LESS[self.dual]
        near, far = self._outwards()
        worse = f"if ({left['i']} {less} {left['worst']}) worst = i;"
        return [
            f"if (g{out} == 0.0) continue;",
            "int worst = k;",
            *([f"{near} {worse}"] if self.window.lo else []),
            f"{far} {{",
            f"  {worse}",
            f"  const int held = {left['worst']} {less} {right['i']};",
            f"  if ((held ? {left['worst']} : {right['i']}) == {out}) {{",
            f"    if (held) g{left['worst']} += g{out}; else g{right['i']} += g{out};",
            "    break;",
            "  }",
            "}",
        ]

    def _step_back(self) -> list[str]:
        out, left, right = self.out["k"], self.args[0]["k"], self.args[1]["k"]
        return [
            f"const double own = g{out};",
            f"const int held = {left} == {out}, met = {right} == {out};",
            f"g{left} += held ? own : 0.0;",
            f"g{right} += !held & met ? own : 0.0;",
            f"g{self.before} += !held & !met ? own : 0.0;",
        ]


# ------------------------------------------------------------------------ loops


class _Repeated(StepForm):
    """C code of a step that is a loop over other steps."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        self.loop: Loop = self.node.loop
        self.root = self.plan.buffers[self.loop.root]

    def _blank(self) -> list[str]:
        """C statements that set to zero the gradients of the values that each iteration recomputes."""
        own = (self.plan.buffers[number] for number in self.loop.own)
        return [f"memset(g{each.name}, 0, sizeof(double) * {each.rows} * LANES);" for each in own]


class _FreezeLoop(_Repeated):
    """C code of a `freeze`: each iteration binds the values at one instant, then computes the body."""

    def __init__(self, printer: StepPrinter, step: ScheduleStep) -> None:
        super().__init__(printer, step)
        index = self.loop.index
        self.bound = [
            (self.plan.buffers[number], num)
            for number, (_, num) in zip(self.node.bound, self.node.node.bindings, strict=True)
        ]
        names = (name for name, _ in self.node.node.bindings)
        held = dict(zip(names, (buffer for buffer, _ in self.bound), strict=True))
        self.inner = replace(printer, held={**printer.held, **held})
        self.head = f"for (int {index} = {self.run.start}; {index} <= {self.run.last}; ++{index}) {{"

    def _iteration(self) -> list[str]:
        lines = []
        for buffer, num in self.bound:
            reader = LeafReader(self.printer)
            writer = NumberWriter(reader)
            value = writer.number(num)
            body = " ".join([*writer.lines, f"{buffer[0]} = {value};"])
            lines.append(f"{{ const int k = {self.loop.index}; {reader.heads()} LANE {{ {body} }} }}")
        return [*lines, *self.inner.forward(self.loop.steps)]

    def forward(self) -> list[str]:
        index = self.loop.index
        result = f"  LANE {self.out[index]} = {self.root[index]};"
        return [self.head, *_indented(self._iteration()), result, "}"]

    def backward(self) -> list[str]:
        index, bound = self.loop.index, []
        seed = f"g{self.out[index]}"
        for buffer, num in self.bound:
            reader = LeafReader(self.printer)
            back = _gradient(num, f"g{buffer[0]}", reader)
            bound += [f"{{ const int k = {index}; {reader.heads()}", *back, "}"]
        return [
            self.head,
            f"int matters = 0; LANE matters |= {seed} != 0.0;",
            "if (!matters) continue;",
            *self._iteration(),
            *self._blank(),
            f"LANE g{self.root[index]} += {seed};",
            *self.inner.backward(self.loop.steps),
            *bound,
            "}",
        ]


class _TableLoop(_Repeated):
    """C code of a family of formulas, which differ in parameters only.

    The code is a loop over a table, in which each row holds the parameters of one formula.
    """

    def _head(self) -> list[str]:
        """C statements that declare the table and begin the loop over its rows.

        They open two braces, which the caller must close.
        """
        table, row, index = self.node.table, self.loop.index, self.printer.index
        constants = {name: map(literal, values) for name, values in table.constants.items()}
        columns = {name: [str(index[state]) for state in states] for name, states in table.columns.items()}
        return [
            "{",
            *_listed("double", row, constants),
            *_listed("int", row, columns),
            f"for (int {row} = 0; {row} < {table.rows}; ++{row}) {{",
            *(f"const double {name} = d{row}[{row}][{i}];" for i, name in enumerate(table.constants)),
            *(f"const int {name} = i{row}[{row}][{i}];" for i, name in enumerate(table.columns)),
        ]

    def forward(self) -> list[str]:
        row, here, body = self.loop.index, self.out["k"], self.root["k"]
        if self.node.pick is None:
            gathered = [f"LANE {self.out[row]} = {self.root[0]};"]
        else:
            gathered = [
                f"if ({row} == 0) {loop(self.run)} LANE {here} = {body};",
                f"else {loop(self.run)} LANE {here} = {_MACRO[self.node.pick]}({here}, {body});",
            ]
        return [*self._head(), *self.printer.forward(self.loop.steps), *gathered, "}}"]

    def backward(self) -> list[str]:
        """Return C statements that propagate the gradient, in a loop over the rows of the table.

        Each iteration first recomputes the values of its row. If the step is an extremum over the rows, only
        the first row whose value equals the extremum gets a gradient.
        """
        if self.node.pick is None:
            own, body = self.out[self.loop.index], self.root[0]
            seeds = f"LANE {{ g{body} += g{own}; matters[j] += fabs(g{own}); }}"
        else:
            own, body = self.out["k"], self.root["k"]
            seeds = (
                f"{loop(self.run)} LANE {{ const double part = {body} == {own} ? g{own} : 0.0; "
                f"g{own} -= part; g{body} += part; matters[j] += fabs(part); }}"
            )
        return [
            *self._head(),
            "double matters[LANES] = {0}, any = 0.0;",
            *self.printer.forward(self.loop.steps),
            *self._blank(),
            seeds,
            "LANE any += matters[j];",
            "if (any == 0.0) continue;",
            *self.printer.backward(self.loop.steps),
            "}}",
        ]


def _listed(kind: str, row: str, entries: Mapping[str, Iterable[str]]) -> list[str]:
    """C declaration of a table whose entries have the C type `kind`: an array with one row per line.

    `entries` maps the name of each column to the values of the column, as texts. `row` is the C name of the
    row index; it is part of the array's name. If `entries` is empty, so is the result.
    """
    if not entries:
        return []
    rows = [f"{{{', '.join(each)}}}," for each in zip(*entries.values(), strict=True)]
    return [f"static const {kind} {kind[0]}{row}[{len(rows)}][{len(entries)}] = {{", *rows, "};"]


FORMS: Mapping[type, Callable[[StepPrinter, ScheduleStep], StepForm]] = {
    ir.Truth: _Constant,
    ir.Predicate: _Margin,
    ir.BoolOp: _Extremum,
    ir.Temporal: _WindowExtremum,
    ir.PastTemporal: _WindowExtremum,
    ir.Until: _Until,
    ir.Since: _Until,
    ir.Shift: _Shifted,
    ir.AtStart: _AtStart,
    Called: _Call,
    Frozen: _FreezeLoop,
    Tabled: _TableLoop,
}
"""Class of a step's node -> its C code; `ir.Freeze` is scheduled as `Frozen`."""
