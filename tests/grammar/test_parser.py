"""Text -> AST: every construct of the language, spans, documentation, limits."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import pytest
import yaml
from helpers.effort import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.diagnostics import Diagnostic, SpecError
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.fold import LONG_CHAIN, MAX_DEPTH
from stlc.grammar.parser import MAX_LEXEMES, MAX_TEXT, parse_expr
from stlc.grammar.spec import Spec
from stlc.source import Source
from stlc.units import Unit

ROOT = Path(__file__).resolve().parents[2]
DATA = sorted((Path(__file__).parent / "data").glob("*.stl"))
PIECES = (*'[]()@%`"\n☃|', "always", "until", "require", "##", "..", "1e400")


def expr(text: str) -> ast.Expr:
    return parse_expr(Source("text", text))


def items(text: str) -> tuple[ast.Declaration, ...]:
    return Spec.parse(Source("text", text)).items


def only(text: str) -> ast.Declaration:
    (item,) = items(text)
    return item


def code(text: str) -> str:
    with pytest.raises(SpecError) as caught:
        Spec.parse(Source("text", text))
    return caught.value.diagnostics[0].code


BOUNDS = [
    ("[0, 3 s]", False, False),
    ("[0, 3 s)", False, True),
    ("(0, 3 s]", True, False),
    ("(0, 3 s)", True, True),
]
TEXTS = [path.read_text(encoding="utf-8") for path in DATA]


# ----------------------------------------------------------------------- whole files


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem)
def test_the_six_benchmarks_parse(path):
    spec = Spec.parse(File(path).read())
    assert spec.name == path.stem
    assert any(isinstance(item, ast.Require) for item in spec.items)


def test_the_traffic_spec_is_what_it_says():
    spec = Spec.parse(File(ROOT / "specs" / "traffic.stl").read())
    assert (spec.name, spec.system, spec.time_unit) == ("traffic", "../examples/car.yaml", "")
    assert spec.system_span is not None
    assert spec.system_span.text == '"../examples/car.yaml"'
    requirements = [item for item in spec.items if isinstance(item, ast.Require)]
    assert [item.name for item in requirements] == ["no_collision", "stop_sign", "give_way", "red_light"]
    assert [tag.name for item in requirements for tag in item.tags] == [
        "safety",
        "liveness",
        "safety",
        "safety",
    ]
    assert requirements[1].doc == "(2) stop for one second at a stop sign, then go unless told to yield"


def _strings(value: object, key: str = "") -> list[str]:
    match value:
        case str() if key not in ("doc", "spec", "world", "judge"):
            return [value]
        case dict():
            return [text for name, item in value.items() for text in _strings(item, name)]
        case list():
            return [text for item in value for text in _strings(item)]
    return []


def test_every_expression_of_the_car_parses():
    texts = _strings(yaml.safe_load((ROOT / "examples" / "car.yaml").read_text(encoding="utf-8")))
    assert len(texts) > 60
    for text in texts:
        expr(text)


def test_an_expression_inside_a_longer_text_keeps_its_place():
    source = Source("car.yaml", "state:\n  x: v * (1 + dt)   # speed\n")
    start = source.text.index("v *")
    tree = parse_expr(source, start, source.text.index("   #"))
    assert isinstance(tree, ast.Binary)
    assert tree.span.text == "v * (1 + dt)"
    assert (tree.span.line, tree.span.column) == (2, 6)
    assert tree.right.span.text == "1 + dt"
    with pytest.raises(SpecError) as caught:
        parse_expr(source, start, start + 3)
    (finding,) = caught.value.diagnostics
    assert finding.span is not None
    assert (finding.span.line, finding.span.start) == (2, start + 3)


# ----------------------------------------------------------------------- expressions


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        ("2 m^2", 2, "m^2"),
        ("3 m/s^2", 3, "m/s^2"),
        ("0.01 m/rad", Fraction(1, 100), "m/rad"),
        ("5 kg*m", 5, "kg*m"),
        ("5kg*m/s^2", 5, "kg*m/s^2"),
        ("5 Hz", 5, "Hz"),
        ("3 W", 3, "W"),
        ("5 %", 5, "%"),
        ("5%", 5, "%"),
        ("4 mrad", 4, "mrad"),
        ("2 s^-1", 2, "s^-1"),
        ("25 steps", 25, "steps"),
        ("1 step", 1, "steps"),
        ("5 min", 5, "min"),
        ("1_000.5e-1", Fraction("100.05"), ""),
        (".5", Fraction(1, 2), ""),
        ("5.", 5, ""),
        ("0", 0, ""),
    ],
)
def test_quantities(text, value, unit):
    tree = expr(text)
    assert isinstance(tree, ast.Quantity)
    assert (tree.value, tree.unit) == (value, unit)


def test_every_unit_follows_a_number_and_stands_in_brackets():
    for symbol in Unit.SYMBOLS.keys() - {"1"}:
        tree, signal = expr(f"2 {symbol}"), only(f"signal x [{symbol}]")
        assert isinstance(tree, ast.Quantity)
        assert isinstance(signal, ast.Signal)
        assert tree.unit == signal.unit == symbol


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("x % 3", "x % (3)"),
        ("5 % 3", "(5) % 3"),
        ("5 % -3", "(5) % (-3)"),
        ("5 % - 3", "(5 %) - 3"),
        ("5 % x", "(5) % x"),
        ("5 % # remainder\n x", "(5) % x"),
        ("5 % and a", "(5 %) and a"),
        ("x < 5 % -> a", "(x < (5 %)) -> a"),
        ("2 s*v", "(2 s) * v"),
        ("2 m^n", "(2 m)^n"),
        ("2 m^2.5", "(2 m)^(2.5)"),
        ("2 m / 2", "(2 m) / 2"),
        ("1 / s", "(1) / (s)"),
    ],
)
def test_where_a_unit_ends(text, same):
    assert expr(text) == expr(same)


@pytest.mark.parametrize("word", ["always", "eventually", "once", "historically"])
def test_all_bounds_after_unary_words(word):
    for clock in ("", "@", " @ ", "  # a comment\n ", "@ // a comment [\n"):
        for bounds, lo_open, hi_open in BOUNDS:
            tree = expr(f"{word}{clock}{bounds} x")
            assert isinstance(tree, ast.Temporal)
            assert tree.interval is not None
            assert (tree.op, tree.interval.lo_open, tree.interval.hi_open) == (word, lo_open, hi_open)
            assert tree.interval.clock == ("start" if "@" in clock else "now")
            assert tree.interval.span.text == bounds


@pytest.mark.parametrize("word", ["until", "release", "unless", "since"])
def test_all_bounds_after_binary_words(word):
    for clock in ("", " ", "@", " @ ", "\n# a comment\n@"):
        for bounds, lo_open, hi_open in BOUNDS:
            tree = expr(f"a {word}{clock}{bounds} b")
            assert isinstance(tree, ast.Until)
            assert tree.interval is not None
            assert (tree.op, tree.interval.lo_open, tree.interval.hi_open) == (word, lo_open, hi_open)
            assert tree.interval.clock == ("start" if "@" in clock else "now")


@pytest.mark.parametrize(
    ("text", "op", "alias"),
    [
        ("G x", "always", "G"),
        ("F[0, 1] x", "eventually", "F"),
        ("alw_[0, 1] x", "always", "alw"),
        ("ev x", "eventually", "ev"),
        ("globally x", "always", "globally"),
        ("finally(x)", "eventually", "finally"),
        ("hist(0, 1] x", "historically", "hist"),
        ("a U b", "until", "U"),
        ("a U_[0, 1] b", "until", "U"),
        ("always x", "always", ""),
    ],
)
def test_aliases_are_remembered(text, op, alias):
    tree = expr(text)
    assert isinstance(tree, ast.Temporal | ast.Until)
    assert (tree.op, tree.alias) == (op, alias)


def test_a_bracket_behind_a_temporal_word_is_an_interval_only_with_a_comma():
    call, interval = expr("always (x > 0)"), expr("always (0, 1) x")
    assert isinstance(call, ast.Temporal)
    assert isinstance(interval, ast.Temporal)
    assert call.interval is None
    assert interval.interval is not None


def test_sets_ranges_and_regions():
    member = expr("x in {1, -2, stop}")
    assert isinstance(member, ast.Member)
    assert isinstance(member.region, ast.SetLiteral)
    assert len(member.region.items) == 3
    outside = expr("[x, y] not   in box([0, 0], [1, 1])")
    assert isinstance(outside, ast.Member)
    assert outside.negated
    within = expr("x in [0, 1]")
    assert isinstance(within, ast.Member)
    assert isinstance(within.region, ast.Vector)


def test_quantifiers_and_freeze():
    forall = expr("forall i in 0..6: always[0, T] q[i] < 1")
    assert isinstance(forall, ast.Quantifier)
    assert isinstance(forall.domain, tuple)
    assert (forall.var, forall.kind) == ("i", "forall")
    exists = expr("exists i in {1, 3}: x[i] > 0")
    assert isinstance(exists, ast.Quantifier)
    assert isinstance(exists.domain, ast.SetLiteral)
    freeze = expr("freeze p0 = p, q0 = q in always[0, 3 steps] norm(p - p0) <= 0.1")
    assert isinstance(freeze, ast.Freeze)
    assert [name for name, _ in freeze.bindings] == ["p0", "q0"]


def test_words_inside_names_are_no_keywords():
    for name in ("trueish", "notable", "inside", "Gain", "Fx", "always_x", "until2", "ifx", "ending", "dtx"):
        assert expr(name) == expr(f"`{name}`")


def test_edges_and_shifts_are_calls():
    for name in ("rise", "fall", "prev", "next", "shift", "sweep"):
        assert isinstance(expr(f"{name}(p)"), ast.Call)


# ---------------------------------------------------------------------- declarations


def test_signals():
    text = """
        state signal a, b : real [m/s] in [-1, 2 m/s]
        signal c : int from "col"
        env signal d : real[7] [rad] in {1, 2}
    """
    a, b, c, d = items(text)
    assert isinstance(a, ast.Signal)
    assert isinstance(b, ast.Signal)
    assert isinstance(c, ast.Signal)
    assert isinstance(d, ast.Signal)
    assert (a.name, b.name, a.role, a.unit, a.name_span.text) == ("a", "b", "state", "m/s", "a")
    assert a.domain == b.domain
    assert (c.role, c.column, c.domain) == (None, "col", None)
    assert (d.type, d.unit) == (ast.TypeRef(d.span, "real", 7), "rad")
    assert isinstance(d.domain, ast.SetLiteral)


def test_a_size_is_attached_and_a_unit_is_not():
    for text, size, unit in (
        ("real[1]", 1, ""),
        ("real [1]", None, "1"),
        ("real[3] [1/s]", 3, "1/s"),
        ("real [3]", 3, ""),
    ):
        const = only(f"const c : {text} = 0")
        assert isinstance(const, ast.Const)
        assert const.type is not None
        assert (const.type.size, const.unit) == (size, unit)


def test_params_and_externs():
    first, second, third, fourth = items(
        "param r [m] in [0.6, 1.2] param n in {1, 2} param w ~ normal(0, 1)"
        " extern fn ee(q: real[7], k) -> real[3] [m]"
    )
    assert isinstance(first, ast.Param)
    assert isinstance(second, ast.Param)
    assert isinstance(third, ast.Param)
    assert isinstance(first.domain, tuple)
    assert isinstance(second.domain, ast.SetLiteral)
    assert isinstance(third.domain, ast.Call)
    assert isinstance(fourth, ast.Extern)
    assert [formal.name for formal in fourth.formals] == ["q", "k"]


def test_enum_members_count_on():
    enum = only("enum E { a, b, c = -1, d, e = 10 }")
    assert isinstance(enum, ast.Enum)
    assert enum.members == (("a", 0), ("b", 1), ("c", -1), ("d", 0), ("e", 10))


def test_tags():
    item = only('@safety @weight(2.5) @id("R1")\nrequire a: x > 0')
    assert [tag.name for tag in item.tags] == ["safety", "weight", "id"]
    assert item.tags[2].args[0].value == ast.String(item.span, "R1")
    assert item.span.text.startswith("@safety")


def test_pragmas_and_imports():
    spec = Spec.parse(
        Source(
            "t",
            'spec a; system "s.yaml"; time ms;\nimport "lib.stl" as m\nimport std\nrequire r: m.f(x) > 0;',
        )
    )
    assert (spec.name, spec.system, spec.time_unit) == ("a", "s.yaml", "ms")
    assert [(i.target, i.is_file, i.alias) for i in spec.imports] == [
        ("lib.stl", True, "m"),
        ("std", False, None),
    ]


def test_documentation_belongs_to_the_next_declaration():
    text = (
        "## the file\nspec s\n# not this\n## one\n##\n##  two\n"
        "@safety\nrequire a: x > 0   ## not this either\n"
        '### ruler\nrequire b: x > 0\n@id("## no")\n## late\nrequire c: x > 0\n'
    )
    assert [item.doc for item in items(text)] == ["the file\none\n\n two", "", "late"]


def test_words_of_the_file_level_are_names_elsewhere():
    text = "signal time, state, input, spec, system, from, fn\nrequire a: time < 3 and\ntime in {1}"
    assert len(items(text)) == 8


def test_reserved_names_need_backticks():
    for name in ("T", "end", "dt", "G", "F", "U", "in", "until", "require", "true"):
        assert only(f"const `{name}` = 1").name == name
        assert code(f"const {name} = 1") == "E010"
    assert code("require a: forall T in 0..3: x > T") == "E010"
    assert code("def f(end) = end") == "E010"


# ---------------------------------------------------------------------------- limits


def nested(depth: int) -> str:
    return "not " * depth + "x"


def test_depth_is_bounded_with_a_diagnostic():
    expr(nested(MAX_DEPTH - 2))
    for text in (
        nested(MAX_DEPTH + 1),
        "x" + "[0" * 5000 + "]" * 5000,
        "-" * 5000 + "x",
        " - ".join("x" * 3000),
        " -> ".join("x" * 3000),
    ):
        with pytest.raises(SpecError) as caught:
            expr(text)
        assert caught.value.diagnostics[0].code == "E005"


SIGNS = {"and": min, "or": max, "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b}
SIGNS["/"] = lambda a, b: a / b


def value(node: ast.Expr) -> Fraction:
    if isinstance(node, ast.Quantity):
        return node.value
    return SIGNS[node.op](value(node.left), value(node.right))


@settings(max_examples=12)
@given(
    st.sampled_from([("and", "&&"), ("or", "|"), ("+", "-"), ("*", "/"), ("+",), ("*",)]),
    st.integers(2, 5 * LONG_CHAIN),
    st.randoms(use_true_random=False),
)
def test_a_chain_has_the_value_of_its_operators_from_the_left(signs, count, random):
    operands = [Fraction(random.randint(1, 9)) for _ in range(count)]
    operators = [random.choice(signs) for _ in operands[1:]]
    text, expected = f"({operands[0]})", operands[0]
    for sign, operand in zip(operators, operands[1:], strict=True):
        text += f" {sign} ({operand})" if random.random() < 0.5 else f" {sign} # c\n {operand}"
        expected = SIGNS[{"&&": "and", "|": "or"}.get(sign, sign)](expected, operand)
    tree = expr(text)
    assert value(tree) == expected
    for node in list(tree.walk())[:5]:
        assert value(parse_expr(Source("t", node.span.text))) == value(node)


@pytest.mark.parametrize("sign", ["and", "or", "+", "*"])
def test_a_flat_chain_is_no_nesting(sign):
    long = expr(f" {sign} ".join(["x"] * 1000))
    assert len([node for node in long.walk() if isinstance(node, ast.Name)]) == 1000
    inner = "-" * (MAX_DEPTH - LONG_CHAIN - 8) + "x"
    expr(f" {sign} ".join([inner] * 100))


def test_long_and_short_chains_group_alike():
    short = " and ".join(["x"] * LONG_CHAIN)
    left = expr(short)
    for _ in range(LONG_CHAIN - 1):
        assert isinstance(left.right, ast.Name)
        left = left.left


def test_parentheses_cost_no_depth():
    assert expr("(" * 3000 + "x" + ")" * 3000) == expr("x")


@pytest.mark.parametrize(
    "text", ["1e999999999", "1e-999999999", "9" * 5000, "1" + "0" * 350, "1e309", "0." + "1" * 5000]
)
def test_numbers_beyond_doubles_are_refused_at_once(text):
    error, spent = refused(lambda: expr(text), SpecError)
    assert error.diagnostics[0].code == "E005"
    assert spent < 10_000


def test_numbers_within_doubles_are_exact():
    tree = expr("1.7976931348623157e308")
    assert isinstance(tree, ast.Quantity)
    assert float(tree.value) == sys.float_info.max


def test_a_text_is_bounded():
    with pytest.raises(SpecError) as caught:
        Spec.parse(Source("big.stl", " " * (MAX_TEXT + 1)))
    assert caught.value.diagnostics[0].code == "E005"


@pytest.mark.parametrize("least", [5_000, pytest.param(MAX_LEXEMES, marks=pytest.mark.apart)])
@pytest.mark.parametrize(("text", "lexemes"), [("x+", 2), ("(", 1), ("if x then ", 3), ("x > 0 and ", 4)])
def test_a_text_of_endless_words_is_refused_at_once(text, lexemes, least, monkeypatch):
    monkeypatch.setattr("stlc.grammar.parser.MAX_LEXEMES", least)
    endless = text * (3 * least // (2 * lexemes))
    error, spent = refused(lambda: Spec.parse(Source("big.stl", f"require r: {endless} x > 0")), SpecError)
    assert [finding.code for finding in error.diagnostics] == ["E005"]
    assert "import" in error.diagnostics[0].help[0]
    assert spent < 6 * least


def test_empty_texts():
    assert Spec.parse(Source("empty.stl", "")).items == ()
    assert Spec.parse(Source("comment.stl", "# nothing\n\n;;")).items == ()


def test_an_enum_size_and_a_type_size_may_be_large_but_not_endless():
    assert code("signal x : real[" + "9" * 5000 + "]") == "E005"


def test_importing_the_grammar_does_not_import_lark():
    script = (
        "import sys, stlc.grammar.ast, stlc.grammar.printer, stlc.source; sys.exit('lark' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


# ------------------------------------------------------------------------------ fuzz


def findings(read: Callable[[Source], object], text: str) -> tuple[Diagnostic, ...] | None:
    """Finding about a text; None if it can be read. Any other exception is a bug."""
    try:
        read(Source("damaged.stl", text))
    except SpecError as error:
        return error.diagnostics
    return None


@st.composite
def mutations(draw: st.DrawFn) -> str:
    text = draw(st.sampled_from(TEXTS))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        size = draw(st.integers(0, 30))
        piece = draw(st.sampled_from(PIECES) | st.sampled_from([text[at : at + 12][::-1], ""]))
        text = text[:at] + piece + text[at + size :]
    return text


@settings(max_examples=18)
@given(mutations())
def test_damaged_texts_give_findings_or_trees(text):
    found = findings(Spec.parse, text)
    assert found is None or 1 <= len(found) <= 20
    for finding in found or ():
        assert finding.span is not None
        assert 0 <= finding.span.start <= finding.span.end <= len(text)


@settings(max_examples=18)
@given(st.text(max_size=60) | st.lists(st.sampled_from(PIECES), max_size=20).map(" ".join))
def test_any_text_gives_findings_or_a_tree(text):
    for read in (Spec.parse, parse_expr):
        found = findings(read, text)
        assert found is None or found


def test_expressions_of_equal_texts_share_their_tree() -> None:
    text, other = "# a comment\nx + 1", "# a comment\nx + 2"
    first = parse_expr(Source("a.yaml", text), 12)
    assert parse_expr(Source("a.yaml", "".join([text[:5], text[5:]])), 12) is first
    for source in (Source("b.yaml", text), Source("a.yaml", other)):
        assert parse_expr(source, 12).span.source == source
    long = Source("a.yaml", text + " " * 40_000)
    assert parse_expr(long, 12) is not parse_expr(long, 12)
    for _ in range(2):
        with pytest.raises(SpecError):
            parse_expr(Source("a.yaml", "x +"))
