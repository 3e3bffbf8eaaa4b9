"""Monitors of streams in C: every sub-formula is a transducer, from its operands' values to its own.

`streams.c` has the transducers; this module writes what differs between monitors: tables of nodes, and code
for the predicates. A requirement gives two programs over the same nodes.

- *Values*: bounds at each instant, in order, as soon as all samples that they depend on were received. A
  window is two lists of partial maxima, `until` the same over functions `x -> min(c, max(f, x))`, operators
  of the past are recursions. After the last sample, the same transducers give bounds over all continuations
  if unknown samples follow, and the value of the ended trace if instants that do not exist follow.
- *Truths*: what is already certain. The truth of a predicate decides a range of instants of the operator
  above it, and so on up to the requirement. Each instant of each operator is decided once.

Minima are maxima of negated operands, so that there is one transducer per pair of dual operators. Windows to
the end of the trace are judged at one instant; the function from their values to that of the requirement is
kept as its values where each of them is +inf or -inf (`coefficients`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from stlc.compile.backends.c.numbers import NumberWriter
from stlc.compile.backends.numbers import Leaf, Untranslatable
from stlc.compile.backends.schedule import PICKS
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.holes import unsure
from stlc.compile.ir.support import NOW, Offsets

RUNTIME = Path(__file__).with_name("streams.c")

_MOST = 5
"""Greatest number of operators with windows to the end of the trace; there are 2^n coefficients."""

_ENTRIES = 256
"""Greatest number of operators around these, as in `streams.c`."""

_LARGEST = 1 << 31
"""Rows of a ring of values from which a monitor is refused."""


class Lasting(ir.Temporal):
    """Left side of an `until` before its window; the end of the trace does not cut it."""


class Begun(ir.Shift):
    """An unbounded `until` with its part before the window: unknown until a sample of its window exists."""

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        return (NOW,)


def normal(formula: ir.Formula) -> ir.Formula:
    """Return an equal formula of fewer kinds of nodes.

    `until` and `since` have windows from 0, those of `since` are unbounded, and so `always p` without bounds
    is a `release`.
    """
    match formula:
        case ir.Predicate() | ir.Truth():
            return formula
        case ir.Freeze() | ir.AtStart():
            raise Untranslatable(type(formula).__name__)
    whole: Any = formula.map_children(formulas=normal)
    if not isinstance(whole, ir.Windowed):
        return whole  # type: ignore[no-any-return]
    return _windowed(whole, whole.names[0])


def _windowed(whole: Any, least: str) -> ir.Formula:
    """`normal` of an operator with a window; `least` is the name of those of its kind that take a minimum."""
    lo, hi, every = whole.window.lo, whole.window.hi, whole.op == least
    bounded = isinstance(whole, (ir.Temporal, ir.PastTemporal))
    if bounded and hi is not None:
        return whole  # type: ignore[no-any-return]
    left, right = (ir.Truth(not every), whole.body) if bounded else (whole.left, whole.right)
    kind = ir.Since if whole.back else ir.Until
    window = ir.Window(0, None if hi is None or whole.back else hi - lo)
    node: ir.Formula = kind(kind.names[not every], window, left, right)  # type: ignore[arg-type]
    if lo:
        node = ir.Shift(-lo, node, outside=every) if whole.back else ir.Shift(lo, node, weak=every)
    parts, extremum = [node], ir.PastTemporal if whole.back else ir.Temporal
    if hi is not None:
        parts.append(extremum(extremum.names[not every], whole.window, right))  # type: ignore[arg-type]
    if lo and not bounded:
        held: Any = extremum if whole.back else Lasting
        parts.append(held(extremum.names[every], ir.Window(0, lo - 1), left))
    if len(parts) == 1:
        return node
    together = ir.BoolOp("or" if every else "and", tuple(parts))
    return together if hi is not None or whole.back else Begun(lo, together)


@dataclass(slots=True, eq=False)
class Node:
    """A sub-formula and its transducers.

    Attributes:
        form: the sub-formula, in normal form.
        args: the operands.
        near: least instant, relative to now, at which it reads its operands or signals.
        far: greatest one.
        delay: samples after an instant until its value is known.
        ahead: instants after the latest sample at which its truth may be known.
        ends: whether its own window extends to the end of the trace.
        endless: whether its window, or that of a part, does.
        lasts: whether its truth may be known at all instants from one on.
        index: number of the node; operands come before the nodes that read them.
        readers: the nodes that read it.
        age: instants before the latest sample at which its truth still matters.
        kept: greatest number of samples after which its values are still read.
        ring: place of its values in the state.
    """

    form: ir.Formula
    args: tuple[Node, ...]
    near: int
    far: int
    delay: int
    ahead: int
    ends: bool
    endless: bool
    lasts: bool
    index: int = 0
    readers: list[Node] = field(default_factory=list)
    age: int = 0
    kept: int = 0
    ring: int = 0

    @property
    def dual(self) -> bool:
        """True if the node takes a minimum."""
        return PICKS.get(getattr(self.form, "op", "")) == "min"

    def read(self, first: int, since: int) -> Row:
        """Row of this node as an operand that is read at the instant `since` samples ago."""
        if isinstance(self.form, ir.Truth):
            return (first + self.index, -2 if self.form.value else -1, 0, 0)
        return (first + self.index, self.ring, _ring(self.kept + 1) - 1, since)

    @property
    def since(self) -> int:
        """Samples between the instant at which it reads its operands, and the latest one."""
        return self.delay - self.far

    @property
    def early(self) -> bool:
        """True if its truth at an instant may be known before the samples up to there."""
        return self.lasts or self.ahead > 0 or self.far < 0 or isinstance(self.form, ir.Shift)

    @property
    def rows(self) -> int:
        """Length of the ring of its truths, a power of 2."""
        return _ring(self.age + self.ahead + 3)


def _reads(form: ir.Formula) -> tuple[int, int]:
    """Least and greatest instant, relative to now, at which a node reads its operands or signals."""
    if isinstance(form, ir.Predicate):
        past, future = form.num.farthest
        return -past if past < 1 << 29 else 0, future
    first, last = form.offsets[-1] if isinstance(form, ir.Operator) else NOW
    return first or 0, last or 0


def _ring(rows: int) -> int:
    if rows >= _LARGEST:
        raise Untranslatable("a window of more samples than memory holds")
    return 1 << (rows - 1).bit_length()


class Graph:
    """Sub-formulas of one formula, with all that is known of them before the first sample.

    Args:
        formula: formula in negation normal form.
        lag: samples after an instant until its value is counted, at least.
        signals: name of a signal -> its index in a sample.

    Raises:
        Untranslatable: there is no transducer for an operator where it stands.
    """

    def __init__(self, formula: ir.Formula, lag: int, signals: Mapping[str, int]) -> None:
        self.signals = signals
        self._known: dict[ir.Formula, Node] = {}
        self.root = self._place(normal(formula))
        self.nodes = sorted(
            self._known.values(), key=lambda node: (node.endless, not isinstance(node.form, ir.Predicate))
        )
        """Predicates first, nodes with windows to the end last; operands stay before their readers."""
        self.skeleton: dict[tuple[Node, int], list[int]] = {}
        """Part of a formula with windows to the end, and instants after the formula's -> its operands."""
        if self.root.endless:
            self._skeleton(self.root, 0)
            lag = max(lag, *(part.delay + later for part, later in self.skeleton))
        self.coefficients = [key for key in self.skeleton if key[0].ends]
        if len(self.coefficients) > _MOST:
            raise Untranslatable("too many windows to the end")
        self.lag = max(lag, self.root.delay)
        self._sizes()

    # ------------------------------------------------------------------- construction

    def _place(self, form: ir.Formula) -> Node:
        if form in self._known:
            return self._known[form]
        parts, outside = form.operands, getattr(form, "outside", None)
        if isinstance(form, (ir.Until, ir.Since)) and parts[0] == ir.Truth(PICKS[form.op] == "max"):
            parts = parts[1:]
        args = tuple(map(self._place, parts))
        args = tuple(dict.fromkeys(args)) if isinstance(form, ir.BoolOp) else args
        near, far = _reads(form)
        delay = max(max((arg.delay for arg in args), default=0) + far, 0)
        ahead = max((arg.ahead for arg in args), default=0)
        if outside is not None:
            ahead = max(ahead, -1)
        ahead -= far if isinstance(form, ir.Predicate) else near
        if isinstance(form, ir.PastTemporal):
            ahead = max(ahead, -far - 1)
        lasts = isinstance(form, (ir.Truth, ir.Since)) or any(arg.lasts for arg in args)
        ends = isinstance(form, ir.Until) and form.window.hi is None
        endless = ends or any(arg.endless for arg in args)
        self._known[form] = Node(form, args, near, far, delay, ahead, ends, endless, lasts)
        return self._known[form]

    def _skeleton(self, node: Node, later: int) -> int:
        """Add operators with windows to the end, and the nodes without that they read; return the number."""
        key = node, later
        if node.endless:
            steps = getattr(node.form, "steps", 0)
            fixed = isinstance(node.form, ir.Windowed) and not node.ends
            if fixed or steps < 0 or getattr(node.form, "outside", None) is not None:
                raise Untranslatable("a window to the end inside of another operator")
        if key not in self.skeleton:
            args = node.args if node.endless else ()
            self.skeleton[key] = [self._skeleton(arg, later + node.near) for arg in args]
        return [*self.skeleton].index(key)

    def _sizes(self) -> None:
        for index, node in enumerate(self.nodes):
            node.index = index
            for arg in dict.fromkeys(node.args):
                arg.readers.append(node)
        self.root.age = self.lag
        for node in reversed(self.nodes):
            node.ahead = max(node.ahead, 0)
            for arg in node.args:
                arg.ahead = max(arg.ahead, node.ahead if isinstance(node.form, ir.BoolOp) else 0)
                arg.age = max(arg.age, node.age - node.near)
        reads = [(arg, node.since) for node in self.nodes if not node.endless for arg in node.args]
        reads += [(node, self.lag - later) for node, later in self.skeleton or {(self.root, 0)}]
        for node, since in reads:
            node.kept = max(node.kept, since - node.delay)

    @property
    def samples(self) -> int:
        """Number of samples that predicates read, the latest included."""
        found = (node for node in self.nodes if isinstance(node.form, ir.Predicate))
        return max((node.far - node.near + 1 for node in found), default=1)

    @property
    def far(self) -> int:
        """Number of unknown samples after which more of them change no bounds."""
        return self.lag + 2 + sum(max(-node.near, 0) + max(node.far, 0) for node in self.nodes)

    # ------------------------------------------------------------------------- tables

    def tables(self, out: Streams, *, cut: bool) -> int:
        """Add the tables of the graph; return its number."""
        first, spans, ints = len(out.tables["nodes"]), 0, 0

        def room(count: int) -> int:
            nonlocal spans
            spans += count
            return spans - count

        for node in self.nodes:
            form, windows = node.form, isinstance(node.form, (ir.Temporal, ir.PastTemporal))
            lo, hi = sorted((abs(node.near), abs(node.far)))
            match form:
                case ir.Predicate():
                    lo = hi = 0
                case ir.Truth(value):
                    lo = _TRUTHS[value]
                case ir.Shift(steps, _, outside):
                    lo, hi = steps, _TRUTHS[outside]
            flags = _DUAL * node.dual | _WEAK * getattr(form, "weak", False)
            flags |= _UNCUT * isinstance(form, Lasting) | _ENDLESS * node.endless
            flags |= _LASTS * node.lasts | _ROOT * (node is self.root) | _AHEAD * node.early
            operands = out.add("operands", *(arg.read(first, node.since) for arg in node.args))
            readers = out.add("readers", *((first + reader.index,) for reader in node.readers))
            rows, kept = node.rows, _ring(node.kept + 1)
            window = ends = place = skip = 0
            node.ring = 0 if node.endless else room(kept)
            if windows or (isinstance(form, ir.Until) and not node.endless):
                window, place, ints = room((hi - lo + 2) * (1 if windows else 2)), ints, ints + 1
            elif isinstance(form, ir.Since):
                window = room(1)
            truth = 0 if isinstance(form, ir.Truth) else out.room("truths", rows)
            if windows or isinstance(form, ir.BoolOp):
                skip = out.room("ints", rows)
            if windows:
                ends = out.room("ints", node.args[0].rows)
            since = out.room("times", 3 if windows else 2 * node.lasts)
            sizes = (node.delay, node.age, node.ahead, operands, len(node.args), readers, len(node.readers))
            places = (node.ring, kept - 1, window, place, truth, rows - 1, skip, ends, since)
            out.add("nodes", (_KINDS[type(form)], flags, lo, hi, *sizes, *places))
        entries, bits = self._entries(first, out), len(self.coefficients)
        coefficients = room(1 << bits) if bits else 0
        neutral = sum(1 << i for i, (node, _) in enumerate(self.coefficients) if node.dual)
        steps = sum(not node.endless for node in self.nodes)
        leaves = sum(isinstance(node.form, ir.Predicate) for node in self.nodes)
        shape = (first, first + leaves, first + steps, len(self.nodes), first + self.root.index)
        to_end = (coefficients, bits, neutral, out.add("entries", *entries), len(entries))
        if len(entries) > _ENTRIES:
            raise Untranslatable("too many operators around windows to the end")
        state = (out.room("spans", spans * (1 + cut)), spans, out.room("ints", ints * (1 + cut)), ints)
        early = sum(node.early for node in self.nodes)
        return out.add("graphs", (*shape, self.lag, self.far, early, *to_end, *state))

    def _entries(self, first: int, out: Streams) -> list[Row]:
        """Parts of a formula with windows to the end, operands first."""
        entries: list[Row] = []
        for (node, later), args in self.skeleton.items():
            if not node.endless:
                operands = out.add("operands", node.read(first, self.lag - later))
                entries.append((_KINDS[ir.Predicate], 0, operands, 1, later, 0))
                continue
            own = [first + node.index] if node.ends else []
            operands = out.add("operands", *((arg, 0, 0, 0) for arg in [*args, *own]))
            flags = _WEAK * getattr(node.form, "weak", False) | _DUAL * node.dual
            bit = self.coefficients.index((node, later)) if node.ends else 0
            there = later + getattr(node.form, "steps", 0)
            entries.append((_KINDS[type(node.form)], flags, operands, len(args), there, bit))
        return entries

    def predicates(self, number: int) -> str:
        """Function that writes the values of the predicates."""
        return f"""\
static void predicates_{number}(const samples *x, at n, int mode, int clip, span *v) {{
  (void)x; (void)n; (void)mode; (void)clip; (void)v;
{"".join(self._predicate(node, node.form) for node in self.nodes if isinstance(node.form, ir.Predicate))}}}
"""

    def _predicate(self, node: Node, atom: ir.Predicate) -> str:
        near, far = atom.num.reach, atom.num.farthest

        def place(leaf: Leaf) -> str | None:
            if isinstance(leaf, ir.Extern):
                return None
            steps = getattr(leaf, "steps", 0)
            if leaf.name == ir.ELAPSED:
                return "(real)t"
            column = self.signals[leaf.name]
            if steps < -(1 << 29):
                return f"x->first[{column}]"
            instant = f"t + {steps}" if steps >= 0 else f"t - {-steps}"
            if getattr(leaf, "clamped", False):
                instant = f"sooner({instant}, x->known - 1)" if steps > 0 else f"later({instant}, 0)"
            return f"X({column}, {instant})"

        reads = {place(leaf) for leaf in atom.num.leaves() if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))}
        known = " && ".join(f"{text} == {text}" for text in sorted(filter(None, reads - {"(real)t"}))) or "1"
        chooses = any(isinstance(part, (ir.Where, ir.Indicator)) for part in atom.num.subexpressions())
        sides = []
        for least in (True, False):
            writer = NumberWriter(place)
            bounded = unsure(atom, frozenset(), least=least, infinite=chooses)  # elsewhere NaN is seen
            assert isinstance(bounded, ir.Predicate)
            value = writer.number(bounded.num) if atom.sign > 0 else f"-{writer.number(bounded.num)}"
            if atom.guard:
                value = f"gated({value}, {int(atom.strict)})"
            sides.append([*writer.lines, f"out.{'lo' if least else 'hi'} = {value};"])
        (*first, low), (*second, high) = sides
        body = [*first, low, high] if first == second else ["{", *first, low, "}", "{", *second, high, "}"]
        values = "".join(f"        {line}\n" for line in body)
        return f"""\
  if (n >= {node.delay}) {{
    const at t = n - {node.delay};
    span out = spanned(-INF, INF);
    if (t >= {near.past} && t + (mode >= ENDED ? {near.future} : {far.future}) < x->known) {{
      if ({known}) {{
{values}        if (!(out.lo <= out.hi)) out = spanned(-INF, INF); /* NaN, as of inf - inf */
      }}
    }} else if (clip) {{
      out = certain({int(atom.sign < 0)});
    }}
    v[{node.ring} + (t & {_ring(node.kept + 1) - 1})] = out;
  }}
"""


_DUAL, _WEAK, _UNCUT, _ENDLESS, _LASTS, _ROOT, _AHEAD = 1, 2, 4, 8, 16, 32, 64
_TRUTHS = {None: 0, False: 1, True: 2}
"""Truth, None if it is unknown -> its number in `streams.c`."""
_KINDS: dict[type, int] = {
    ir.Truth: 0,
    ir.Predicate: 1,
    ir.BoolOp: 2,
    ir.Temporal: 3,
    Lasting: 3,
    ir.PastTemporal: 4,
    ir.Shift: 5,
    Begun: 6,
    ir.Until: 7,
    ir.Since: 8,
}
"""Class of a node -> its number in `streams.c`, which explains the flags too."""

Row: TypeAlias = tuple[Any, ...]


TABLES = {
    "node": "nodes",
    "operand": "operands",
    "int32_t": "readers",
    "entry": "entries",
    "graph": "graphs",
    "rule": "rules",
}
"""C type of a row -> name of the table."""

SIZES = ("signals", "rows", "judged", "spans", "times", "ints", "truths")
"""Last members of the structure `tables`."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Requirement of a monitor of streams.

    Attributes:
        formula: its formula.
        deciding: formula whose sign is the verdict; mostly `formula`.
        lag: samples after a start until it is counted, at least.
    """

    formula: ir.Formula
    deciding: ir.Formula
    lag: int


@dataclass(slots=True)
class Streams:
    """Program of a monitor of streams.

    Attributes:
        tables: C name of a table -> its rows, all numbers int32.
        sizes: name of a size of the structure `tables` -> its value.
        predicates: C text of the function `predicates`, after the types.
    """

    tables: dict[str, list[Row]] = field(default_factory=lambda: {name: [] for name in TABLES.values()})
    sizes: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(SIZES, 0)))
    predicates: str = ""

    def add(self, table: str, *rows: Row) -> int:
        """Add rows to a table; return the number of the first."""
        self.tables[table] += rows
        return len(self.tables[table]) - len(rows)

    def room(self, part: str, count: int) -> int:
        """Reserve `count` places of a part of the state; return the first."""
        self.sizes[part] += count
        return self.sizes[part] - count


def streams_of(rules: Sequence[Rule], signals: Sequence[str], *, cut: bool) -> Streams:
    """Return the program of a monitor of `rules` over samples of `signals`.

    `cut`: whether the monitor can cut windows at the end of the trace.

    Raises:
        Untranslatable: a formula has no transducers.
    """
    index, out, texts, calls = {name: i for i, name in enumerate(signals)}, Streams(), [], []
    out.sizes["signals"], out.sizes["rows"], out.sizes["judged"] = len(signals), 1, len(rules)

    def added(graph: Graph) -> int:
        number = graph.tables(out, cut=cut)
        texts.append(graph.predicates(number))
        calls.append(f"  case {number}: predicates_{number}(x, n, mode, clip, v); return;\n")
        out.sizes["rows"] = max(out.sizes["rows"], _ring(graph.samples))
        return number

    for rule in rules:
        values = Graph(rule.formula, rule.lag, index)
        deciding = values if rule.deciding == rule.formula else Graph(rule.deciding, values.lag, index)
        if deciding.lag != values.lag:
            values = Graph(rule.formula, deciding.lag, index)
        truths = added(deciding)
        numbers = (truths if values is deciding else added(values), truths)
        root = deciding.root.rows
        out.add("rules", (*numbers, out.room("ints", root), root - 1))
    if any(size >= _LARGEST for size in out.sizes.values()):
        raise Untranslatable("windows of more samples than memory holds")
    stored = out.sizes["rows"]
    out.predicates = f"""\
#define X(i, q) x->x[(i) * {stored} + ((q) & {stored - 1})]
{"".join(texts)}API void predicates(int32_t g, const samples *x, at n, int mode, int clip, span *v) {{
  switch (g) {{
{"".join(calls)}  default: return;
  }}
}}
"""
    return out


def runtime() -> tuple[str, str]:
    """C text of the types and small functions that predicates use, and of the transducers."""
    types, functions = RUNTIME.read_text(encoding="utf-8").split("/* PREDICATES */\n")
    return HEAD + types, functions


HEAD = """
#include <math.h>
#include <stddef.h>
#include <stdint.h>

typedef REAL real;
typedef int64_t at;
#define INF ((real)INFINITY)
#if defined(__GNUC__) && !defined(__OPTIMIZE_SIZE__)
#define INLINED static inline __attribute__((always_inline))
#else
#define INLINED static inline
#endif
#define MIN(a, b) ((b) < (a) ? (b) : (a)) /* a where it is NaN */
#define MAX(a, b) ((b) > (a) ? (b) : (a))
#define LEAST(a, b) ((b) < (a) || (b) != (b) ? (b) : (a)) /* NaN where either is */
#define MOST(a, b) ((b) > (a) || (b) != (b) ? (b) : (a))

static inline real floored_mod(real a, real b) {
  const real r = (real)fmod(a, b); /* exact, unlike a - b * floor(a / b) where a / b rounds up */
  return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}
"""
