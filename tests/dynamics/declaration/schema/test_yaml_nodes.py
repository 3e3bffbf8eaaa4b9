"""YAML with marks: places, meaning of scalars, bounds."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from stlc.diagnostics import Diagnostic, StlcError, SystemFileError
from stlc.dynamics.declaration.schema import yaml_nodes
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping, Node, Scalar, Sequence, load_yaml
from stlc.source import Source

EXAMPLES = Path(__file__).resolve().parents[4] / "examples"


def load(text: str) -> Mapping:
    sink: list[Diagnostic] = []
    node = load_yaml(Source("a.yaml", text), sink=sink)
    assert sink == []
    return node


def scalar(node: Node | None) -> Scalar:
    assert isinstance(node, Scalar)
    return node


@pytest.mark.parametrize(
    ("written", "inside"),
    [
        ("x + 1", "x + 1"),
        ('"uniform(0, 5)"', "uniform(0, 5)"),
        ("'a b'", "a b"),
        ("{b: 2}", None),
        ("x   # comment", "x"),
        ("é + ü", "é + ü"),
    ],
)
def test_values_know_where_they_stand(written: str, inside: str | None) -> None:
    for text in (
        f"k: {written}\n",
        f"ü: 1\nk:   {written}\nz: 3",
        f"\ufeffk: {written}\n",
        f"q: 1\r\nk: {written}\r\n",
    ):
        value = load(text).get("k")
        if inside is None:
            assert value is not None
            assert value.span.text == written
        else:
            assert scalar(value).inside.text == scalar(value).text == inside


def test_values_in_flow_collections_know_where_they_stand() -> None:
    node = load("a: {x: \"f(1, 2)\", y: [1, 'two', three four]}")
    inner = node.get("a")
    assert isinstance(inner, Mapping)
    assert scalar(inner.get("x")).inside.text == "f(1, 2)"
    items = inner.get("y")
    assert isinstance(items, Sequence)
    assert [scalar(item).inside.text for item in items.items] == ["1", "two", "three four"]
    assert [entry.key.span.text for entry in inner.entries] == ["x", "y"]


def test_block_scalars_hold_expressions_too() -> None:
    value = scalar(load("a: |\n  x +\n  1\nb: 2").get("a"))
    assert value.text == "x +\n1\n"
    assert value.inside.text.split() == ["x", "+", "1"]


def test_escapes_are_noticed() -> None:
    assert scalar(load(r'a: "x\ty"').get("a")).escaped
    assert scalar(load("a: 'it''s'").get("a")).escaped
    assert not scalar(load("a: 'x'").get("a")).escaped


@pytest.mark.parametrize(
    ("text", "integer", "number", "truth"),
    [
        ("1e-3", None, 1e-3, None),
        ("5e4", None, 5e4, None),
        ("012", 12, 12.0, None),
        ("0x1f", None, None, None),
        ("12:30", None, None, None),
        ("1_000", None, None, None),
        ("+7", 7, 7.0, None),
        ("9" * 5000, None, None, None),
        ("9" * 400, None, None, None),
        (".5", None, 0.5, None),
        ("5.", None, 5.0, None),
        (".nan", None, None, None),
        (".inf", None, None, None),
        ("true", None, None, True),
        ("False", None, None, False),
        ("on", None, None, None),
        ("yes", None, None, None),
        ("'1'", None, None, None),
        ('"true"', None, None, None),
    ],
)
def test_scalars_mean_what_yaml_1_2_says(
    text: str, integer: int | None, number: float | None, truth: bool | None
) -> None:
    value = scalar(load(f"a: {text}").get("a"))
    assert (value.integer, value.number, value.boolean) == (integer, number, truth)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_float_comes_back(value: float) -> None:
    assert scalar(load(f"a: {value!r}").get("a")).number == value


@pytest.mark.parametrize("text", ["", "~", "null", "Null"])
def test_nothing_is_null(text: str) -> None:
    assert scalar(load(f"a: {text}\nb: 1").get("a")).is_null


def test_aliases_share_and_merge_keys_give_way() -> None:
    node = load("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3, z: 4}\nc: {<<: [*a, {x: 9, w: 0}]}\nd: *a")
    assert node.get("d") is node.get("a")

    def values(key: str) -> dict[str, str]:
        inner = node.get(key)
        assert isinstance(inner, Mapping)
        return {entry.key.text: scalar(entry.value).text for entry in inner.entries}

    assert values("b") == {"x": "1", "y": "3", "z": "4"}
    assert values("c") == {"x": "1", "y": "2", "w": "0"}


def test_the_first_of_two_equal_keys_counts_and_the_second_is_reported() -> None:
    sink: list[Diagnostic] = []
    node = load_yaml(Source("a.yaml", "a: 1\nb: 2\na: 3\n"), sink=sink)
    assert scalar(node.get("a")).text == "1"
    assert [(finding.code, finding.span and finding.span.line) for finding in sink] == [("S102", 3)]
    assert sink[0].labels[0].span.line == 1


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/name:os.system x",
        "a: !custom 1",
        "!!map {a: 1}",
        "a: *nothing",
        "a: &x {b: *x}",
        "? [1, 2]\n: 3",
        "a: 1\n...\nb: 2\n",
        "{" * 60 + "}" * 60,
        "a: " + "- " * 100,
        "k: [" + "1," * 30_000 + "]",
    ],
)
def test_what_is_not_plain_data_is_refused(text: str) -> None:
    with pytest.raises(SystemFileError, match="S100"):
        load_yaml(Source("a.yaml", text), sink=[])


def test_doubling_aliases_cost_nothing() -> None:
    lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 200)]
    with pytest.raises(SystemFileError, match="expand to more than"):
        load_yaml(Source("a.yaml", "\n".join(lines)), sink=[])


@given(st.text(alphabet=st.sampled_from("ab1 :,-[]{}&*!|>\"'#\n\t?%@`.<~"), max_size=60))
@example('a: "\\')
@example("%TAG ! x\n---\na: 1")
@example("a: \x85b")
def test_any_text_is_read_or_refused(text: str) -> None:
    source = Source("a.yaml", text)
    try:
        node = load_yaml(source, sink=[])
    except StlcError as error:
        for finding in error.diagnostics:
            assert finding.span is not None
            assert 0 <= finding.span.start <= finding.span.end <= len(text)
    else:
        assert math.isfinite(node.size)
        assert node.span.source is source


# ------------------------------------------------------------------- the parser in C


def read_by(text: str, fast: object, monkeypatch: pytest.MonkeyPatch) -> object:
    """The document, or what is said about it, as one parser gives it."""
    monkeypatch.setattr(yaml_nodes, "_FAST", fast)
    sink: list[Diagnostic] = []
    try:
        return yaml_nodes.load_node(Source("a.yaml", text), sink=sink), sink
    except SystemFileError as error:
        return [(d.code, d.message, d.span and (d.span.start, d.span.end)) for d in error.diagnostics]


ODD = (
    *(
        "a: |\n  x\n  y\n\nb: >-\n  z\n\n",
        "a: \"x\\n y\"\nb: 'it''s'\n",
        "a:\n- 1\n-\n- 3\n",
        "a: \n",
        "a:\n\n\n",
    ),
    *(
        "é: ü\nb: 💩\nc: d # é\n",
        "a: 1\r\nb: |\r\n  x\r\n",
        "\ufeffa: 1\nb: 2",
        "? a\n: b\n",
        "a: &x 1\nb: *x\n",
    ),
    *("a: !!str 1", "--- \na: 1\n...\n", "a: 1\n---\nb: 1", "%YAML 1.1\n---\na: 1", "a: x\x85y\nb: 1\n"),
    *("a: x\u2028y\nb: z\n", "k: [a,\n  b]\n\n# c\n", "a: b: c", "a: {b:1, c}", "a: [x:y]", '{"a":1}'),
    *("doc\t: x\n", "u: {sq?uash: tanh}\n", "a: 5 m \t  # c\n"),
    *("a: 1\na: 2\n", "a: &a [*a]", "[" * 99, "a: - 1", 'a: "b" c', "", "#", "a: \ud800", "a\0b", "\t a: 1"),
)


@pytest.mark.skipif(yaml_nodes._FAST is None, reason="PyYAML has no parser in C here")
@pytest.mark.parametrize("part", range(2))
def test_both_parsers_give_the_same_document(part: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, fast = random.Random(part), yaml_nodes._FAST
    texts = [path.read_text() for path in sorted(EXAMPLES.glob("*.yaml"))]
    for k in range(25):
        text = rng.choice(texts)[: rng.choice([300, 1000, 4000])]
        for _ in range(rng.choice([0, 1, 1, 3])):
            at = rng.randrange(len(text) + 1)
            text = (
                text[:at]
                + rng.choice([*"\n\t :-#[]{}'\"|>&*!%@`é", "  ", "- ", ": ", *ODD])
                + text[at + k % 3 :]
            )
        assert read_by(text, fast, monkeypatch) == read_by(text, None, monkeypatch), text
    for text in ODD[part::2]:
        assert read_by(text, fast, monkeypatch) == read_by(text, None, monkeypatch), text


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("a: 1\nb: {c: 2}\n   d: {e: 3}\n", 3),
        ("a:\n   b: 1\n  c: 2\n", 3),
        ("a:\n   b: 1\n\n  # why\n  c: 2\n", 5),
    ],
)
def test_lines_that_are_indented_differently_are_both_shown(text: str, row: int) -> None:
    with pytest.raises(SystemFileError) as caught:
        load(text)
    (finding,) = caught.value.diagnostics
    assert finding.span is not None
    assert finding.span.line == row
    assert "indented differently" in finding.message
    (label,) = finding.labels
    assert label.span.line == 2
    assert label.text.startswith("indented by ")
