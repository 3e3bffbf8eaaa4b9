"""The steps of a plan as C, backwards: the gradient by the values of a buffer, taken to what they came from.

`gb7` holds the gradient by the buffer `b7`, and `gx` that by the columns. Of equal minima and maxima the
first gets it. What stands in a `freeze` is computed anew, and only for the instants that matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import assert_never

from stlc.compile.backends.c.formulas import Forward, Sight, columns, components, table_head
from stlc.compile.backends.c.slopes import SlopeWriter
from stlc.compile.backends.c.steps import (
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
)
from stlc.compile.backends.c.windows import windowed_back
from stlc.compile.ir.nodes import ELAPSED, Num, Signal
from stlc.compile.ir.traverse import leaves


@dataclass(frozen=True, slots=True)
class Backward:
    """Writes steps backwards.

    Attributes:
        plan: that they belong to.
        index: place of each state among the columns.
    """

    plan: Plan
    index: Mapping[str, int]

    def lines(self, steps: Sequence[Step]) -> list[str]:
        """Statements that take the gradient back through all steps."""
        return [line for step in reversed(steps) for line in self._step(step)]

    def _step(self, step: Step) -> list[str]:
        match step:
            case Fill():
                return []
            case Margin():
                return [] if step.atom.guard or _fixed(step.atom.num) else self._margin(step)
            case Joined():
                return _joined(step)
            case Extremum() | Meeting() | Moved():
                return windowed_back(step, self.plan.samples - 1)
            case Repeated(out, run, body):
                return [f"{run.loop()} LANE g{body['0']} += g{out['k']};"]
            case Called():
                return self._called(step)
            case Frozen():
                return self._frozen(step)
            case Tabled():
                return self._tabled(step)
            case _:
                assert_never(step)

    def _margin(self, step: Margin) -> list[str]:
        sign = "" if step.atom.sign > 0 else "-"
        sight = Sight(self.plan, self.index, step.held)
        inner = _pulled(step.atom.num, f"{sign}g{step.out['k']}", sight)
        return [sight.head(step.run), *inner, "}"]

    def _called(self, step: Called) -> list[str]:
        writer = SlopeWriter(columns(self.index), soft=False)
        seeds: dict[str, str] = {}
        for out, part in zip(step.outs, components(step), strict=True):
            register, own = writer.number(part), f"g{out['k']}"
            seeds[register] = f"{seeds[register]} + {own}" if register in seeds else own
        lines, gathered = writer.backward(seeds)
        adds = [f"{place} += {value};" for place, value in gathered.items()]
        return [f"{step.run.loop()} LANE {{", *writer.lines, *lines, *adds, "}"]

    def _frozen(self, step: Frozen) -> list[str]:
        index, seed = step.index, f"g{step.out[step.index]}"
        bound = []
        for buffer, num in step.bindings:
            sight = Sight(self.plan, self.index, step.held)
            inner = _pulled(num, f"g{buffer['0']}", sight)
            bound += [f"{{ const int k = {index}; {sight.heads()}", *inner, "}"]
        return [
            f"for (int {index} = {step.run.first.text}; {index} <= {step.run.last.text}; ++{index}) {{",
            f"int matters = 0; LANE matters |= {seed} != 0.0;",
            "if (!matters) continue;",
            *Forward(self.plan, self.index).inside(step),
            *_blank(step),
            f"LANE g{step.body[index]} += {seed};",
            *self.lines(step.steps),
            *bound,
            "}",
        ]

    def _tabled(self, step: Tabled) -> list[str]:
        """Row by row: computed anew, and taken back where a lane has its value from there."""
        seeds = f"{step.run.loop()} LANE" if step.pick else "LANE"
        own, body = step.out["k"] if step.pick else step.out[step.index], step.body["k" if step.pick else "0"]
        asked = f"matters[j] += fabs(g{own});"
        hits = [
            f"const double part = {body} == {own} ? g{own} : 0.0;",
            f"g{own} -= part; g{body} += part; matters[j] += fabs(part);",
        ]
        one = [f"g{body} += g{own};", asked]
        matters = "double matters[LANES] = {0}, any = 0.0;"
        return [
            *table_head(step, self.index),
            matters,
            *Forward(self.plan, self.index).lines(step.steps),
            *_blank(step),
            f"{seeds} {{ {' '.join(hits if step.pick else one)} }}",
            "LANE any += matters[j];",
            "if (any == 0.0) continue;",
            *self.lines(step.steps),
            "}}",
        ]


def _blank(step: Frozen | Tabled) -> list[str]:
    """The gradients of what is computed anew in each turn, set to nothing."""
    return [f"memset(g{buffer.name}, 0, sizeof(double) * {buffer.rows} * LANES);" for buffer in step.own]


def _fixed(num: Num) -> bool:
    """Whether a number follows from the first sample and the count of samples: no plan changes it."""
    return any(isinstance(leaf, Signal) and leaf.name == ELAPSED for leaf in leaves(num))


def _pulled(num: Num, seed: str, sight: Sight) -> list[str]:
    """Gradient by a number at sample `k`, taken to its leaves.

    Two leaves may be the same sample: added apart from the loop that computes, which becomes vector code so.
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


def _joined(step: Joined) -> list[str]:
    out = step.out["k"]
    lines = [f"{step.run.loop()} LANE {{", f"double left = g{out};"]
    for item in step.items:
        lines += [
            f"{{ const int hit = {item['k']} == {out};",
            f"g{item['k']} += hit ? left : 0.0; left = hit ? 0.0 : left; }}",
        ]
    return [*lines, "}"]
