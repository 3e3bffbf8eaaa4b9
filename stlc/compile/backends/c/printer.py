"""C code of a schedule's steps, forward and adjoint, over columns filled by a rollout.

The innermost loop runs over trajectories and is vectorized. `gb7` is the gradient with respect to buffer
`b7`, `gx` that with respect to the columns. The first of equal extrema gets the gradient. Loop bodies are
recomputed in the adjoint, only for iterations with a nonzero gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from stlc.compile.backends.c.numbers import LISTED, Leaf, NumberWriter, literal
from stlc.compile.backends.c.plan import Buffer, Called, Plan, Tabled, call_of
from stlc.compile.backends.c.slopes import SlopeWriter
from stlc.compile.backends.c.windows import Macro, WindowStep, loop, windowed, windowed_back
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves
from stlc.compile.schedule.schedule import PICKS, IndexRange, Loop, Pick, Step, neutral

_MACRO: Mapping[Pick, Macro] = {"min": "MIN", "max": "MAX"}

Frozen = Mapping[str, Buffer]
"""Name of a frozen value -> its buffer."""


@dataclass(frozen=True, slots=True)
class Sight:
    """C expressions of a number's leaves at sample `k`, in lane `j`.

    Attributes:
        plan: the plan.
        index: index of each state among the columns.
        held: buffers of the frozen values.
        indices: C name of a clamped sample index -> its C expression; independent of the lane.
    """

    plan: Plan
    index: Mapping[str, int]
    held: Frozen = field(default_factory=dict)
    indices: dict[str, str] = field(default_factory=dict)

    def __call__(self, leaf: Leaf) -> str | None:
        """Return the C expression of a leaf; None for a function that must be inlined."""
        match leaf:
            case ir.Signal(name):
                return column(self.index, name, "k")
            case ir.ShiftedSignal(name, steps, clamped):
                return column(self.index, name, self._index(steps, clamped=clamped))
            case ir.FrozenVar(name):
                return self.held[name][0]
            case ir.Extern(_, args, output):
                key = call_of(leaf)
                if key is None:
                    return None
                first = args[0]
                index = "k" if isinstance(first, ir.Signal) else self._later(first)
                return self.plan.buffers[self.plan.calls[key] + output][index]
            case _:
                assert_never(leaf)

    def _later(self, leaf: ir.Num) -> str:
        assert isinstance(leaf, ir.ShiftedSignal)
        return self._index(leaf.steps, clamped=leaf.clamped)

    def _index(self, steps: int, *, clamped: bool) -> str:
        """Index of the sample `steps` later; a clamped one stays within the plan."""
        index, last = f"k + ({steps})", self.plan.samples - 1
        if not clamped:
            return index
        name = f"{'after' if steps > 0 else 'before'}{abs(steps)}"
        self.indices[name] = f"{index} < {last} ? {index} : {last}" if steps > 0 else f"LATER({index}, 0)"
        return name

    def head(self, run: IndexRange) -> str:
        """Head of a loop over samples, with declarations of the indices used in it."""
        return " ".join([f"{loop(run)} {{", self.heads()])

    def heads(self) -> str:
        """Declarations of the clamped indices."""
        return " ".join(f"const int {name} = {value};" for name, value in self.indices.items())


@dataclass(frozen=True, slots=True)
class StepPrinter:
    """Printer of steps.

    Attributes:
        plan: that the steps belong to.
        index: index of each state among the columns.
    """

    plan: Plan
    index: Mapping[str, int]

    def forward(self, steps: Sequence[Step], held: Frozen) -> list[str]:
        """Return statements that fill the buffers of all steps."""
        return [line for step in steps for line in self._forward(step, held)]

    def backward(self, steps: Sequence[Step], held: Frozen) -> list[str]:
        """Return statements that propagate the gradient back through all steps."""
        return [line for step in reversed(steps) for line in self._backward(step, held)]

    def _forward(self, step: Step, held: Frozen) -> list[str]:
        out, run, args = self._out(step), step.run, self._args(step)
        match step.node:
            case ir.Truth(value):
                return _filled(out, run, math.inf if value else -math.inf)
            case ir.Predicate():
                return self._margin(step, step.node, held)
            case ir.BoolOp(op):
                # one operand per statement: nested macros double in length
                pick = _MACRO[PICKS[op]]
                rest = " ".join(f"most = {pick}(most, {item['k']});" for item in args[1:])
                return [f"{loop(run)} LANE {{ double most = {args[0]['k']}; {rest} {out['k']} = most; }}"]
            case ir.Temporal(op) | ir.PastTemporal(op) | ir.Until(op) | ir.Since(op):
                return windowed(self._window(step)) if args else _filled(out, run, neutral(PICKS[op]))
            case ir.Shift(steps, _, outside):
                beyond = math.inf if outside else -math.inf
                return self._shifted(step, steps, beyond) if args else _filled(out, run, beyond)
            case ir.AtStart():
                return [f"{loop(run)} LANE {out['k']} = {args[0][0]};"]
            case Called():
                return self._called(step, step.node)
            case ir.Freeze():
                return self._frozen(step, held)
            case Tabled():
                lines = self.forward(_loop_of(step).steps, held)
                return [*self._table_head(step, step.node), *lines, *self._gathered(step, step.node), "}}"]
            case _:
                assert_never(step.node)

    def _backward(self, step: Step, held: Frozen) -> list[str]:
        out, run, args = self._out(step), step.run, self._args(step)
        match step.node:
            case ir.Truth():
                return []
            case ir.Predicate():
                return self._margin_back(step, step.node, held)
            case ir.BoolOp():
                return _joined_back(out, run, args)
            case ir.Temporal() | ir.PastTemporal() | ir.Until() | ir.Since():
                return windowed_back(self._window(step)) if args else []
            case ir.Shift(steps):
                return self._shifted_back(step, steps) if args else []
            case ir.AtStart():
                return [f"{loop(run)} LANE g{args[0][0]} += g{out['k']};"]
            case Called():
                return self._called_back(step, step.node)
            case ir.Freeze():
                return self._frozen_back(step, step.node, held)
            case Tabled():
                return self._tabled_back(step, step.node, held)
            case _:
                assert_never(step.node)

    def _out(self, step: Step) -> Buffer:
        return self.plan.buffers[step.number]

    def _args(self, step: Step) -> tuple[Buffer, ...]:
        return tuple(self.plan.buffers[number] for number in step.operands)

    # ------------------------------------------------------------------ predicates

    def _margin(self, step: Step, node: ir.Predicate, held: Frozen) -> list[str]:
        sight, out = Sight(self.plan, self.index, held), self._out(step)
        writer = NumberWriter(sight)
        margin = writer.number(node.num)
        value = margin if node.sign > 0 else f"(-{margin})"
        if node.guard:
            value = f"({value} {'>' if node.strict else '>='} 0.0 ? INFINITY : -INFINITY)"
        body = " ".join([*writer.lines, f"bad[j] += NAN_IN({value});", f"{out['k']} = {value};"])
        return [f"{sight.head(step.run)} LANE {{ {body} }} }}"]

    def _margin_back(self, step: Step, node: ir.Predicate, held: Frozen) -> list[str]:
        if node.guard or _fixed(node.num):
            return []
        sight = Sight(self.plan, self.index, held)
        inner = _pulled(node.num, f"{'' if node.sign > 0 else '-'}g{self._out(step)['k']}", sight)
        return [sight.head(step.run), *inner, "}"]

    def _called(self, step: Step, node: Called) -> list[str]:
        writer = NumberWriter(columns(self.index))
        values = [writer.number(part) for part in node.components]
        stores = [f"{out['k']} = {value};" for out, value in zip(self._outs(step, node), values, strict=True)]
        return [f"{loop(step.run)} LANE {{ {' '.join([*writer.lines, *stores])} }}"]

    def _called_back(self, step: Step, node: Called) -> list[str]:
        writer = SlopeWriter(columns(self.index), soft=False)
        seeds: dict[str, str] = {}
        for out, part in zip(self._outs(step, node), node.components, strict=True):
            register, own = writer.number(part), f"g{out['k']}"
            seeds[register] = f"{seeds[register]} + {own}" if register in seeds else own
        lines, gathered = writer.backward(seeds)
        adds = [f"{place} += {value};" for place, value in gathered.items()]
        return [f"{loop(step.run)} LANE {{", *writer.lines, *lines, *adds, "}"]

    def _outs(self, step: Step, node: Called) -> tuple[Buffer, ...]:
        return self.plan.buffers[step.number : step.number + len(node.components)]

    # --------------------------------------------------------------- other samples

    def _window(self, step: Step) -> WindowStep:
        node, back = step.node, isinstance(step.node, (ir.PastTemporal, ir.Since))
        pick, last = _MACRO[PICKS[node.op]], self.plan.samples - 1
        return WindowStep(self._out(step), step.run, pick, node.window, back, self._args(step), last)

    def _shifted(self, step: Step, steps: int, outside: float) -> list[str]:
        out, body = self._out(step)["k"], self._args(step)[0]
        there, last = f"k + ({steps})", self.plan.samples - 1
        return [
            f"{loop(step.run)}",
            f"  if ({there} < 0 || {there} > {last}) LANE {out} = {literal(outside)};",
            f"  else LANE {out} = {body[there]};",
        ]

    def _shifted_back(self, step: Step, steps: int) -> list[str]:
        out, body = self._out(step)["k"], self._args(step)[0]
        there, last = f"k + ({steps})", self.plan.samples - 1
        return [
            f"{loop(step.run)}",
            f"  if ({there} >= 0 && {there} <= {last}) LANE g{body[there]} += g{out};",
        ]

    # ----------------------------------------------------------------------- loops

    def _frozen(self, step: Step, held: Frozen) -> list[str]:
        inner, out = _loop_of(step), self._out(step)
        return [
            _turns(step),
            *(f"  {line}" for line in self._frozen_inside(step, held)),
            f"  LANE {out[inner.index]} = {self.plan.buffers[inner.root][inner.index]};",
            "}",
        ]

    def _frozen_inside(self, step: Step, held: Frozen) -> list[str]:
        """Statements of one iteration: bind the frozen values, then run the steps."""
        inner, lines = _loop_of(step), []
        for number, (_, num) in zip(inner.bound, step.node.bindings, strict=True):
            sight = Sight(self.plan, self.index, held)
            writer = NumberWriter(sight)
            value = writer.number(num)
            body = " ".join([*writer.lines, f"{self.plan.buffers[number][0]} = {value};"])
            lines.append(f"{{ const int k = {inner.index}; {sight.heads()} LANE {{ {body} }} }}")
        return [*lines, *self.forward(inner.steps, self._held_in(step, held))]

    def _held_in(self, step: Step, held: Frozen) -> Frozen:
        names = (name for name, _ in step.node.bindings)
        bound = (self.plan.buffers[number] for number in _loop_of(step).bound)
        return {**held, **dict(zip(names, bound, strict=True))}

    def _frozen_back(self, step: Step, node: ir.Freeze, held: Frozen) -> list[str]:
        inner = _loop_of(step)
        index, seed, bound = inner.index, f"g{self._out(step)[inner.index]}", []
        for number, (_, num) in zip(inner.bound, node.bindings, strict=True):
            sight = Sight(self.plan, self.index, held)
            back = _pulled(num, f"g{self.plan.buffers[number][0]}", sight)
            bound += [f"{{ const int k = {index}; {sight.heads()}", *back, "}"]
        return [
            _turns(step),
            f"int matters = 0; LANE matters |= {seed} != 0.0;",
            "if (!matters) continue;",
            *self._frozen_inside(step, held),
            *self._blank(step),
            f"LANE g{self.plan.buffers[inner.root][index]} += {seed};",
            *self.backward(inner.steps, self._held_in(step, held)),
            *bound,
            "}",
        ]

    def _blank(self, step: Step) -> list[str]:
        """Statements that zero the gradients of buffers that each iteration recomputes."""
        own = (self.plan.buffers[number] for number in _loop_of(step).own)
        return [f"memset(g{each.name}, 0, sizeof(double) * {each.rows} * LANES);" for each in own]

    def _table_head(self, step: Step, node: Tabled) -> list[str]:
        """The table and the head of the loop over its rows, closed by two braces."""
        table, row = node.table, _loop_of(step).index
        places = {name: [self.index[state] for state in states] for name, states in table.columns.items()}
        return [
            "{",
            *_listed("double", row, {name: map(literal, values) for name, values in table.constants.items()}),
            *_listed("int", row, {name: map(str, values) for name, values in places.items()}),
            f"for (int {row} = 0; {row} < {table.rows}; ++{row}) {{",
            *(f"const double {name} = d{row}[{row}][{i}];" for i, name in enumerate(table.constants)),
            *(f"const int {name} = i{row}[{row}][{i}];" for i, name in enumerate(table.columns)),
        ]

    def _gathered(self, step: Step, node: Tabled) -> list[str]:
        """Accumulate the value of a table row into the step's buffer."""
        out, row, body = self._out(step), _loop_of(step).index, self.plan.buffers[_loop_of(step).root]
        if node.pick is None:
            return [f"LANE {out[row]} = {body[0]};"]
        here = out["k"]
        return [
            f"if ({row} == 0) {loop(step.run)} LANE {here} = {body['k']};",
            f"else {loop(step.run)} LANE {here} = {_MACRO[node.pick]}({here}, {body['k']});",
        ]

    def _tabled_back(self, step: Step, node: Tabled, held: Frozen) -> list[str]:
        """Adjoint of a table, row by row: recompute, propagate for lanes whose extremum the row attains."""
        inner, out = _loop_of(step), self._out(step)
        root = self.plan.buffers[inner.root]
        seeds = f"{loop(step.run)} LANE" if node.pick else "LANE"
        own, body = (out["k"], root["k"]) if node.pick else (out[inner.index], root[0])
        asked = f"matters[j] += fabs(g{own});"
        hits = [
            f"const double part = {body} == {own} ? g{own} : 0.0;",
            f"g{own} -= part; g{body} += part; matters[j] += fabs(part);",
        ]
        one = [f"g{body} += g{own};", asked]
        return [
            *self._table_head(step, node),
            "double matters[LANES] = {0}, any = 0.0;",
            *self.forward(inner.steps, held),
            *self._blank(step),
            f"{seeds} {{ {' '.join(hits if node.pick else one)} }}",
            "LANE any += matters[j];",
            "if (any == 0.0) continue;",
            *self.backward(inner.steps, held),
            "}}",
        ]


def _loop_of(step: Step) -> Loop:
    assert step.inner is not None
    return step.inner


def _turns(step: Step) -> str:
    """Head of the loop over the instants of a `freeze`."""
    index, run = _loop_of(step).index, step.run
    return f"for (int {index} = {run.start}; {index} <= {run.last}; ++{index}) {{"


def _filled(out: Buffer, run: IndexRange, value: float) -> list[str]:
    return [f"{loop(run)} LANE {out['k']} = {literal(value)};"]


def _joined_back(out: Buffer, run: IndexRange, args: Sequence[Buffer]) -> list[str]:
    lines = [f"{loop(run)} LANE {{", f"double left = g{out['k']};"]
    for item in args:
        lines += [
            f"{{ const int hit = {item['k']} == {out['k']};",
            f"g{item['k']} += hit ? left : 0.0; left = hit ? 0.0 : left; }}",
        ]
    return [*lines, "}"]


def _fixed(num: ir.Num) -> bool:
    """True if a number depends only on the first sample and the sample count, so that its gradient is 0."""
    return any(isinstance(leaf, ir.Signal) and leaf.name == ir.ELAPSED for leaf in leaves(num))


def _pulled(num: ir.Num, seed: str, sight: Sight) -> list[str]:
    """Statements that propagate the gradient of a number at sample `k` to its leaves.

    Leaves may alias one sample: they are accumulated apart from the computing loop, which is vectorized.
    """
    writer = SlopeWriter(sight, soft=False)
    lines, gathered = writer.backward({writer.number(num): seed})
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
    """Return the C expression of a state at a sample, of lane `j`; the state may be a table entry."""
    if name == ir.ELAPSED:
        return f"(double)({k})"
    where = name.removeprefix(LISTED) if name.startswith(LISTED) else index[name]
    return f"x[{where}][{k}][j]"


def columns(index: Mapping[str, int]) -> Callable[[Leaf], str | None]:
    """Return the C expressions of columns at sample `k`; None for other leaves, which are inlined."""
    return lambda leaf: column(index, leaf.name, "k") if isinstance(leaf, ir.Signal) else None


def _listed(kind: str, row: str, entries: Mapping[str, Iterable[str]]) -> list[str]:
    """Table entries of one type as a C array, one row per line."""
    if not entries:
        return []
    rows = [f"{{{', '.join(each)}}}," for each in zip(*entries.values(), strict=True)]
    return [f"static const {kind} {kind[0]}{row}[{len(rows)}][{len(entries)}] = {{", *rows, "};"]
