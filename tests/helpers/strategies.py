"""Well-formed syntax trees of the whole language, for hypothesis."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from hypothesis import strategies as st

from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.source import Source, Span

SPAN: Span = Source("random", "").span(0, 0)

UNITS = ("", "", "s", "ms", "steps", "m", "m/s^2", "kg*m", "1/s", "%", "%/s", "mrad", "deg", "Hz", "m^-1")
BRACKET_UNITS = ("", "", "m", "1", "1/s", "%", "kg*m/s^2", "deg")

# Plain names, names that look like words of the language, and names that need backticks.
PLAIN = (
    "x",
    "y",
    "v_lead",
    "Gain",
    "trueish",
    "inside",
    "s",
    "m",
    "state",
    "spec",
    "time",
    "from",
    "größe",
    "X1",
)
AWKWARD = ("T", "end", "dt", "G", "until", "in", "require", "a b", "1st", "x²", "#")

plain_names = st.sampled_from(PLAIN)
names = plain_names | st.sampled_from(AWKWARD)
texts = st.text(
    st.characters(exclude_characters='"\n\r', exclude_categories=["Cs", "Zl", "Zp", "Cc"]), max_size=8
)
decimals = st.one_of(
    st.integers(0, 1000).map(Fraction),
    st.integers(0, 10**6).map(lambda n: Fraction(n, 1000)),
    st.sampled_from([Fraction(10) ** 300, Fraction(7, 10**30), Fraction(123456789 * 10**20)]),
)


def _node(
    kind: type, *parts: st.SearchStrategy[Any], **named: st.SearchStrategy[Any]
) -> st.SearchStrategy[Any]:
    return st.builds(kind, st.just(SPAN), *parts, **named)


def _quantity(value: Fraction, unit: str) -> ast.Quantity:
    return ast.Quantity(SPAN, value, unit if unit != "1/s" else "Hz")


quantities = st.builds(_quantity, decimals, st.sampled_from(UNITS))
name_nodes = st.builds(lambda name: ast.Name(SPAN, name, quoted=name not in PLAIN), names)
atoms = st.one_of(
    quantities,
    name_nodes,
    st.sampled_from([ast.Bool(SPAN, True), ast.Bool(SPAN, False), ast.Inf(SPAN), ast.Name(SPAN, "T")]),
    _node(ast.String, texts),
)


def _tuples(items: st.SearchStrategy[Any], low: int = 1, high: int = 3) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.lists(items, min_size=low, max_size=high).map(tuple)


def intervals(bounds: st.SearchStrategy[Any]) -> st.SearchStrategy[ast.Interval]:
    """All four kinds of bounds, on both clocks."""
    return _node(
        ast.Interval, bounds, bounds, st.booleans(), st.booleans(), st.sampled_from(["now", "start"])
    )


def sets(items: st.SearchStrategy[Any]) -> st.SearchStrategy[ast.SetLiteral]:
    """`{a, b}`."""
    return _node(ast.SetLiteral, _tuples(items))


def arguments(values: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[ast.Arg, ...]]:
    """Arguments of a call or a tag."""
    return _tuples(_node(ast.Arg, st.none() | names, values), 0)


@st.composite
def _comparisons(draw: st.DrawFn, inner: st.SearchStrategy[Any]) -> ast.Compare:
    operands = draw(_tuples(inner, 2, 4))
    op = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
    return ast.Compare(SPAN, operands, tuple(draw(op) for _ in operands[1:]))


def _numbers(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.one_of(
        _node(ast.Vector, _tuples(inner, 0)),
        _node(ast.Index, inner, inner),
        _node(ast.Attr, inner, names),
        _node(ast.Call, inner, arguments(inner)),
        _node(ast.Neg, inner),
        _node(ast.Binary, st.sampled_from(["+", "-", "*", "/", "%", "^"]), inner, inner),
        _node(ast.IfThenElse, inner, inner, inner),
        _node(
            ast.Extreme, st.sampled_from(["max", "min"]), _node(ast.Interval, quantities, quantities), inner
        ),
    )


_UNARY = st.sampled_from(["always", "eventually", "once", "historically"])
_BINARY = st.sampled_from(["until", "release", "unless", "since"])


def _formulas(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    interval = st.none() | intervals(inner)
    domain = st.tuples(inner, inner) | sets(inner)
    return st.one_of(
        _comparisons(inner),
        _node(ast.Member, inner, inner | sets(inner), st.booleans()),
        _node(ast.Not, inner),
        _node(ast.Logic, st.sampled_from(["and", "or", "xor", "->", "<->"]), inner, inner),
        _node(
            ast.Temporal, st.sampled_from(["always", "eventually", "once", "historically"]), interval, inner
        ),
        _node(ast.Until, st.sampled_from(["until", "release", "unless", "since"]), interval, inner, inner),
        _node(ast.Quantifier, st.sampled_from(["forall", "exists"]), names, domain, inner),
        _node(ast.Freeze, _tuples(st.tuples(names, inner), 1, 2), inner),
    )


expressions: st.SearchStrategy[Any] = st.recursive(
    atoms, lambda inner: _numbers(inner) | _formulas(inner), max_leaves=12
)
simple = st.recursive(atoms, _numbers, max_leaves=4)

types = _node(ast.TypeRef, names, st.none() | st.integers(1, 9))
formals = _tuples(_node(ast.Formal, names, st.none() | types), 0)
tags = _tuples(_node(ast.Tag, plain_names, arguments(simple)), 0, 2)
doc_lines = texts.map(str.rstrip)
docs = st.lists(doc_lines, max_size=2).map("\n".join)
domains = st.tuples(simple, simple) | sets(simple)


def _declared(kind: type, **own: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.builds(
        kind, span=st.just(SPAN), name=names, name_span=st.just(SPAN), tags=tags, doc=docs, **own
    )


_sort = {"type": st.none() | types, "unit": st.sampled_from(BRACKET_UNITS)}
_calls = _node(ast.Call, name_nodes, arguments(simple))

declarations: st.SearchStrategy[Any] = st.one_of(
    _declared(
        ast.Signal,
        role=st.sampled_from([None, "input", "output", "state", "env"]),
        domain=st.none() | domains,
        column=st.none() | texts,
        **_sort,
    ),
    _declared(ast.Const, value=expressions, **_sort),
    _declared(ast.Param, domain=domains | _calls, **_sort),
    _declared(ast.Enum, members=_tuples(st.tuples(names, st.integers(-9, 99)))),
    _declared(ast.Region, value=simple),
    _declared(ast.Def, formals=formals, type=st.none() | types, value=expressions),
    _declared(ast.Extern, formals=formals, type=types, unit=_sort["unit"]),
    _declared(ast.Require, formula=expressions),
    _declared(ast.Assume, formula=expressions),
)
imports = st.one_of(
    _node(ast.Import, texts, st.just(True), st.none() | names),
    _node(ast.Import, names, st.just(False), st.none() | names),
)


def _spec(name: str, system: str | None, time_unit: str, *parts: Any) -> Spec:
    imported, items = parts
    return Spec(SPAN, name, system, None, time_unit, tuple(imported), tuple(items), source=SPAN.source)


specs: st.SearchStrategy[Spec] = st.builds(
    _spec,
    st.just("") | names,
    st.none() | texts,
    st.sampled_from(["", "s", "ms", "steps"]),
    st.lists(imports, max_size=2),
    st.lists(declarations, max_size=4),
)
