"""Printing a tree and reading it back gives the same tree."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from helpers.strategies import SPAN, declarations, expressions, specs
from hypothesis import given, settings

from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.parser import parse_expr
from stlc.grammar.printer import show
from stlc.grammar.spec import Spec
from stlc.source import Source

DATA = sorted((Path(__file__).parent / "data").glob("*.stl"))


def expr(text: str) -> ast.Expr:
    return parse_expr(Source("text", text))


@settings(max_examples=18)
@given(expressions)
def test_an_expression_reads_back(tree):
    assert expr(show(tree)) == tree


@settings(max_examples=30)
@given(declarations)
def test_a_declaration_reads_back(tree):
    assert Spec.parse(Source("text", show(tree))).items == (tree,)


@settings(max_examples=24)
@given(specs)
def test_a_specification_reads_back(tree):
    assert Spec.parse(Source("text", show(tree))) == tree


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem)
def test_the_benchmarks_read_back(path):
    spec = Spec.parse(File(path).read())
    text = show(spec)
    assert Spec.parse(Source("text", text)) == spec
    assert show(Spec.parse(Source("text", text))) == text


@pytest.mark.parametrize(
    ("written", "canonical"),
    [
        ("((a and b)) and (c)", "a and b and c"),
        ("a and (b and c)", "a and (b and c)"),
        ("(a -> b) -> (c -> d)", "(a -> b) -> c -> d"),
        ("(always[0, T] a) and b", "always[0, T] a and b"),
        ("always[0,T](a and b)", "always[0, T] (a and b)"),
        ("not(a) or !b", "not a or not b"),
        ("G[0:5 s](x>0)", "always[0, 5 s] x > 0"),
        ("(a U b) or (a U(0,1] b)", "a until b or a until(0, 1] b"),
        ("(a until b) until c", "(a until b) until c"),
        ("(-x)^2 + -(x^2)", "(-x)^2 + -x^2"),
        ("(2^x)^3^4", "(2^x)^3^4"),
        ("a - (b - c) - d", "a - (b - c) - d"),
        ("a*(b/c)%d", "a * (b / c) % d"),
        ("(5 m)^2 + 5 m^2", "(5 m)^2 + 5 m^2"),
        ("0 <= (x) < 5", "0 <= x < 5"),
        ("(a < b) == c", "(a < b) == c"),
        ("always ([x, y] not in A)", "always ([x, y] not in A)"),
        ("always[0, T] [x, y] not in A", "always[0, T] [x, y] not in A"),
        ("(1).x + 1.5[0]", "(1).x + (1.5)[0]"),
        ("a => b <=> c || d && e", "a -> b <-> c or d and e"),
        ("always @ [ 0 , 3 s ) x in { 1 , -2 }", "always@[0, 3 s) x in {1, -2}"),
        ("if a then b else (c and d)", "if a then b else (c and d)"),
        ("`T` + T + `x`", "`T` + T + x"),
        ("5% - 3", "5 % - 3"),
        ("1 step + 2 step", "1 step + 2 steps"),
        ("1e3 + 1e-3 + 1e30 + 1_000.50", "1000 + 0.001 + 1e30 + 1000.5"),
        ("1e-20", "1e-20"),
    ],
)
def test_parentheses_and_spellings(written, canonical):
    assert show(expr(written)) == canonical
    assert expr(canonical) == expr(written)


def test_names_that_mean_something_keep_their_backticks():
    own, built_in = expr("`T`"), expr("T")
    assert isinstance(own, ast.Name)
    assert isinstance(built_in, ast.Name)
    assert (own.quoted, built_in.quoted) == (True, False)
    assert (show(own), show(built_in)) == ("`T`", "T")


def test_a_fraction_without_a_decimal_is_a_quotient():
    assert show(ast.Quantity(SPAN, Fraction(1, 3))) == "(1 / 3)"


def test_related_declarations_stand_together():
    text = "spec s\n\nconst a = 1\nconst b = 2\n\n## why\n@safety\nrequire r: x > a\n"
    assert show(Spec.parse(Source("text", text))) == text


def test_parts_have_a_text_of_their_own():
    (item,) = Spec.parse(Source("t", "@weight(2)\nextern fn f(a: real[3], b) -> real [m]")).items
    assert isinstance(item, ast.Extern)
    assert show(item.tags[0]) == "@weight(2)"
    assert [show(formal) for formal in item.formals] == ["a: real[3]", "b"]
    assert show(item.type) == "real"
    call = expr("f(center = [1, 2]) in {1, 2}")
    assert isinstance(call, ast.Member)
    assert isinstance(call.item, ast.Call)
    assert isinstance(call.region, ast.SetLiteral)
    assert show(call.item.args[0]) == "center = [1, 2]"
    assert show(call.region) == "{1, 2}"
    always = expr("always@(0, 1] x")
    assert isinstance(always, ast.Temporal)
    assert always.interval is not None
    assert show(always.interval) == "@(0, 1]"
