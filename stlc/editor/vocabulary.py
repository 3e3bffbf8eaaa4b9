"""Descriptions of the words of the language (keywords, functions, types), one sentence each."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from stlc.compile.ir.functions import FUNCTIONS as TABLE
from stlc.grammar.words import OPERATORS

TEMPORAL: Mapping[str, str] = MappingProxyType({word.name: word.meaning for word in OPERATORS.values()})

BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "T": "The planning horizon of the system.",
        "end": "The last sample of the trace.",
        "dt": "The time between two samples.",
    }
)

TAGS: Mapping[str, str] = MappingProxyType(
    {
        "safety": "Part of phi_safe, which even an emergency plan keeps.",
        "liveness": "Something good that must happen; not part of phi_safe.",
        "weight": "`@weight(w)`: its robustness counts w times in the whole.",
        "scale": "`@scale(s)`, `@scale(auto)`: its robustness is divided by s, or by its reach.",
        "product": "`x in [lo, hi]` has the robustness `(x - lo) * (hi - x)` of the paper.",
        "id": '`@id("R1")`: what it is called elsewhere.',
        "group": "`@group(name)`: requirements that belong together.",
        "hold": "`@hold signal x`: the last value holds; `@hold(0.5 s)`: unknown when it is older.",
        "linear": "`@linear signal x`: between its samples on the line.",
        "angle": "`@angle signal x`: between its samples on the shorter arc.",
    }
)

FUNCTIONS: Mapping[str, str] = MappingProxyType(
    {
        **{function.name: function.doc for function in TABLE.values() if function.doc},
        "dot": "`dot(a, b)`: the scalar product.",
        "cross": "`cross(a, b)`: the vector product; a number in the plane.",
        "dist": "`dist(a, b)`: the Euclidean distance of two points.",
        "deg": "`deg(x)`: a plain number of degrees as an angle, or an angle as a plain number.",
        "rad": "`rad(x)`: a plain number of radians as an angle, or an angle as a plain number.",
        "sdist": "`sdist(p, R)`: the signed distance of a point to a region, positive inside.",
        "ind": "`ind(p)`: 1 where a formula about one instant holds, else 0.",
        "circle": "`circle(center, radius)`: a disc of the plane.",
        "ball": "`ball(center, radius)`: the points within a distance.",
        "box": "`box(lower, upper)`: the points between two corners.",
        "polygon": "`polygon(p1, p2, …)`: the polygon with these corners, in order.",
        "halfspace": "`halfspace(a, b)`: the points p with dot(a, p) <= b.",
        "union": "`union(R1, R2, …)`: the points of any of the regions.",
        "intersect": "`intersect(R1, R2, …)`: the points of all of the regions.",
        "complement": "`complement(R)`: the points outside.",
        "dilate": "`dilate(R, d)`: the region grown by d.",
        "next": "`next(p)`: p at the sample after this one.",
        "prev": "`prev(p)`: p at the sample before this one.",
        "rise": "`rise(p)`: p has just become true; false at the first sample.",
        "fall": "`fall(p)`: p has just become false; false at the first sample.",
        "shift": "`shift(x, 2)`, `shift(x, 0.2 s)`: a signal so many samples, or so much time, later.",
        "delta": "`delta(x)`: how much a signal has changed since the sample before.",
        "sweep": "`sweep(p)`: the straight segment from a point's sample to the next one.",
    }
)

KEYWORDS: Mapping[str, str] = MappingProxyType(
    {
        "require": "`require NAME: formula`: what must hold.",
        "assume": "`assume NAME: formula`: where the specification applies.",
        "def": "`def NAME(arguments) = expression`: a name for an expression.",
        "const": "`const NAME [unit] = value`: known when compiling; `--set NAME=VALUE` changes it.",
        "param": "`param NAME [unit] in [low, high]`: drawn once for every trajectory.",
        "signal": "`signal NAME [unit] in [low, high]`: a column of the trace.",
        "region": "`region NAME = circle(…)`: a set of points.",
        "enum": "`enum NAME { a = 0, b = 1 }`: a type with these values.",
        "extern": "`extern fn NAME(q: real[7]) -> real[3] [m]`: a function that the system provides.",
        "import": '`import "file.stl" as m`, `import std`: the definitions of another file.',
        "spec": "`spec NAME`: what the specification is called.",
        "system": '`system "file.yaml"`: the system that it is about.',
        "time": "`time UNIT`: the unit of bare numbers in intervals.",
        "forall": "`forall i in 0..6: p`: p for every i.",
        "exists": "`exists i in 0..6: p`: p for some i.",
        "freeze": "`freeze a = x in p`: p, where a is x as it is now.",
        "if": "`if p then a else b`: for numbers and for formulas.",
        "in": "`p in R`: a point in a region, a number in `[low, high]` or in `{1, 2}`.",
        "inf": "Without end.",
        "xor": "One of both, and not the other.",
        "not": "Negation.",
        "state": "A signal that the dynamics move.",
        "env": "A signal of the world around; its range is a fact.",
        "input": "A signal that is given.",
        "output": "A signal that is produced.",
    }
)

TYPES: Mapping[str, str] = MappingProxyType(
    {
        "real": "A number; `real[3]` is a vector.",
        "int": "A whole number.",
        "bool": "True or false; stored as 1 and 0.",
        "formula": "Something that holds or does not; of an argument of a `def`.",
    }
)
