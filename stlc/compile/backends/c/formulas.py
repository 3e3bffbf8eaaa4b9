"""The steps of a plan as C, forwards: exact robustness over columns that a rollout has filled.

The innermost loop runs over trajectories, so every line of it becomes vector code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from stlc.compile.backends.c.index import Stretch
from stlc.compile.backends.c.numbers import LISTED, Leaf, NumberWriter, literal
from stlc.compile.backends.c.steps import (
    Buffer,
    Called,
    Extremum,
    Fill,
    Frozen,
    Joined,
    Margin,
    Meeting,
    Moved,
    Plan,
    Repeated,
    Step,
    Tabled,
    call_of,
)
from stlc.compile.backends.c.windows import windowed
from stlc.compile.ir import nodes as ir


@dataclass(frozen=True, slots=True)
class Sight:
    """Where the leaves of a number stand at sample `k`, in lane `j`.

    Attributes:
        plan: what is computed.
        index: place of each state among the columns.
        held: buffers of the frozen values.
        indices: C names of samples within the plan -> what they are; they do not depend on the lane.
    """

    plan: Plan
    index: Mapping[str, int]
    held: Mapping[str, Buffer] = field(default_factory=dict)
    indices: dict[str, str] = field(default_factory=dict)

    def __call__(self, leaf: Leaf) -> str | None:
        """C expression of a leaf; None for a function that is to be written out."""
        match leaf:
            case ir.Signal(name):
                return column(self.index, name, "k")
            case ir.ShiftedSignal(name, steps, clamped):
                return column(self.index, name, self._index(steps, clamped=clamped))
            case ir.FrozenVar(name):
                return self.held[name]["0"]
            case ir.Extern(_, args, output):
                key = call_of(leaf)
                if key is None:
                    return None
                first = args[0]
                index = "k" if isinstance(first, ir.Signal) else self._later(first)
                return self.plan.calls[key][output][index]
            case _:
                assert_never(leaf)

    def _later(self, leaf: ir.Num) -> str:
        assert isinstance(leaf, ir.ShiftedSignal)
        return self._index(leaf.steps, clamped=leaf.clamped)

    def _index(self, steps: int, *, clamped: bool) -> str:
        """So many samples from here; a clamped one stays within the plan."""
        index, last = f"k + ({steps})", self.plan.samples - 1
        if not clamped:
            return index
        name = f"{'after' if steps > 0 else 'before'}{abs(steps)}"
        self.indices[name] = f"{index} < {last} ? {index} : {last}" if steps > 0 else f"LATER({index}, 0)"
        return name

    def head(self, run: Stretch) -> str:
        """The head of a loop over samples, and the indices that are read in it."""
        return " ".join([f"{run.loop()} {{", self.heads()])

    def heads(self) -> str:
        """The indices."""
        return " ".join(f"const int {name} = {value};" for name, value in self.indices.items())


@dataclass(frozen=True, slots=True)
class Forward:
    """Writes steps forwards.

    Attributes:
        plan: that they belong to.
        index: place of each state among the columns.
    """

    plan: Plan
    index: Mapping[str, int]

    def lines(self, steps: Sequence[Step]) -> list[str]:
        """Statements that fill the buffers of all steps."""
        return [line for step in steps for line in self._step(step)]

    def _step(self, step: Step) -> list[str]:
        match step:
            case Fill(out, run, value):
                return [f"{run.loop()} LANE {out['k']} = {literal(value)};"]
            case Margin():
                return self._margin(step)
            case Joined(out, run, pick, items):
                # one operand a statement: a macro in itself doubles its text each time
                rest = " ".join(f"most = {pick}(most, {item['k']});" for item in items[1:])
                return [f"{run.loop()} LANE {{ double most = {items[0]['k']}; {rest} {out['k']} = most; }}"]
            case Extremum() | Meeting() | Moved():
                return windowed(step, self.plan.samples - 1)
            case Repeated(out, run, body):
                return [f"{run.loop()} LANE {out['k']} = {body['0']};"]
            case Called():
                return self._called(step)
            case Frozen():
                return self._frozen(step)
            case Tabled():
                return self._tabled(step)
            case _:
                assert_never(step)

    def _margin(self, step: Margin) -> list[str]:
        sight = Sight(self.plan, self.index, step.held)
        writer = NumberWriter(sight)
        margin = writer.number(step.atom.num)
        value = margin if step.atom.sign > 0 else f"(-{margin})"
        if step.atom.guard:
            value = f"({value} {'>' if step.atom.strict else '>='} 0.0 ? INFINITY : -INFINITY)"
        body = " ".join([*writer.lines, f"bad[j] += NAN_IN({value});", f"{step.out['k']} = {value};"])
        return [f"{sight.head(step.run)} LANE {{ {body} }} }}"]

    def _called(self, step: Called) -> list[str]:
        writer = NumberWriter(columns(self.index))
        values = [writer.number(part) for part in components(step)]
        stores = [f"{out['k']} = {value};" for out, value in zip(step.outs, values, strict=True)]
        return [f"{step.run.loop()} LANE {{ {' '.join([*writer.lines, *stores])} }}"]

    def _frozen(self, step: Frozen) -> list[str]:
        index = step.index
        return [
            f"for (int {index} = {step.run.first.text}; {index} <= {step.run.last.text}; ++{index}) {{",
            *(f"  {line}" for line in self.inside(step)),
            f"  LANE {step.out[index]} = {step.body[index]};",
            "}",
        ]

    def inside(self, step: Frozen) -> list[str]:
        """One turn of the loop: values are frozen, and the steps follow."""
        lines = []
        for buffer, num in step.bindings:
            sight = Sight(self.plan, self.index, step.held)
            writer = NumberWriter(sight)
            value = writer.number(num)
            body = " ".join([*writer.lines, f"{buffer['0']} = {value};"])
            lines.append(f"{{ const int k = {step.index}; {sight.heads()} LANE {{ {body} }} }}")
        return [*lines, *self.lines(step.steps)]

    def _tabled(self, step: Tabled) -> list[str]:
        return [*table_head(step, self.index), *self.lines(step.steps), *_gathered(step), "}}"]


def components(step: Called) -> list[ir.Extern]:
    """The components of a function as numbers."""
    call = step.function
    return [ir.Extern(call.name, call.args, output, call.function) for output in range(len(step.outs))]


def column(index: Mapping[str, int], name: str, k: str) -> str:
    """C expression of a state at a sample, of lane `j`; the state may be an entry of a table."""
    if name == ir.ELAPSED:
        return f"(double)({k})"
    where = name.removeprefix(LISTED) if name.startswith(LISTED) else index[name]
    return f"x[{where}][{k}][j]"


def columns(index: Mapping[str, int]) -> Callable[[Leaf], str | None]:
    """Where columns stand at sample `k`; what else there may be is written out."""
    return lambda leaf: column(index, leaf.name, "k") if isinstance(leaf, ir.Signal) else None


def table_head(step: Tabled, index: Mapping[str, int]) -> list[str]:
    """The table, and the head of the loop over its rows; two braces end it."""
    table, row = step.table, step.index
    places = {name: [index[state] for state in states] for name, states in table.columns.items()}
    return [
        "{",
        *_listed("double", row, {name: map(literal, values) for name, values in table.constants.items()}),
        *_listed("int", row, {name: map(str, values) for name, values in places.items()}),
        f"for (int {row} = 0; {row} < {table.rows}; ++{row}) {{",
        *(f"const double {name} = d{row}[{row}][{i}];" for i, name in enumerate(table.constants)),
        *(f"const int {name} = i{row}[{row}][{i}];" for i, name in enumerate(table.columns)),
    ]


def _listed(kind: str, row: str, entries: Mapping[str, Iterable[str]]) -> list[str]:
    """The entries of one type as an array, a row a line."""
    if not entries:
        return []
    rows = [f"{{{', '.join(each)}}}," for each in zip(*entries.values(), strict=True)]
    return [f"static const {kind} {kind[0]}{row}[{len(rows)}][{len(entries)}] = {{", *rows, "};"]


def _gathered(step: Tabled) -> list[str]:
    """What a row of a table gives, added to what the earlier ones gave."""
    out, body, row = step.out, step.body, step.index
    if step.pick is None:
        return [f"LANE {out[row]} = {body['0']};"]
    here = out["k"]
    return [
        f"if ({row} == 0) {step.run.loop()} LANE {here} = {body['k']};",
        f"else {step.run.loop()} LANE {here} = {step.pick}({here}, {body['k']});",
    ]
