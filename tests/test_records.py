"""Records: what is written of them is read back, fits their schema, and damage is a diagnostic."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest
from helpers.documents import misfits
from hypothesis import given
from hypothesis import strategies as st

from stlc.diagnostics import RunError
from stlc.jsontext import Num, dumps, keys_below, plain
from stlc.records import from_json, schema_of


@dataclass(frozen=True)
class Inner:
    name: str
    least: Num = 0.0


@dataclass(frozen=True)
class Outer:
    JSON: ClassVar = "kind count=number least inner pair path? more? table double"

    kind: Literal["a", "b"]
    number: Annotated[int, 0]
    inner: tuple[Inner, ...]
    least: float | None = None
    pair: tuple[float, float] = (0.0, 1.0)
    path: Path | None = None
    more: str = ""
    table: dict[str, Inner] = field(default_factory=dict)

    @property
    def double(self) -> int:
        return 2 * self.number


finite = st.floats(-1e99, 1e99)
inners = st.builds(Inner, st.text(), finite | st.just(float("inf")))
outers = st.builds(
    Outer,
    st.sampled_from(["a", "b"]),
    st.integers(0, 10**9),
    st.lists(inners).map(tuple),
    st.none() | finite,
    st.tuples(finite, finite),
    st.none() | st.sampled_from([Path("a/b"), Path("c")]),
    st.text(),
    st.dictionaries(st.text(), inners, max_size=3),
)


@given(outers)
def test_a_record_comes_back_and_fits_its_schema(record):
    text = dumps(record)
    assert from_json(Outer, text, "f.json") == record
    assert from_json(Outer, text.encode(), "f.json") == record
    assert misfits(json.loads(text), schema_of(Outer)) == []


def test_keys_are_those_that_the_class_lists():
    found = plain(Outer("a", 3, (Inner("x", float("inf")),)))
    assert list(found) == ["kind", "count", "least", "inner", "pair", "table", "double"]
    assert found["double"] == 6
    assert found["inner"] == [{"name": "x", "least": "inf"}]


@dataclass(frozen=True)
class Holder:
    JSON: ClassVar = f"name {keys_below('outer', Outer)} text??"

    name: str
    outer: Outer | None = None
    text: str | None = None


@pytest.mark.parametrize("outer", [None, Outer("a", 3, (), least=None, more="x")])
@pytest.mark.parametrize("text", [None, "", "x"])
def test_keys_below_what_is_not_there_are_left_out(outer, text):
    found, schema = plain(Holder("h", outer, text)), schema_of(Holder)
    below = {} if outer is None else plain(outer)
    assert found == {"name": "h", **below, **({} if text is None else {"text": text})}
    assert misfits(found, schema) == []
    assert (schema["required"], schema["properties"]["text"]) == (["name"], {"type": "string"})


junk: Any = st.none() | st.booleans() | st.integers() | st.text(max_size=3) | st.just([]) | st.just({})
paths = st.sampled_from(
    [
        ("kind",),
        ("count",),
        ("least",),
        ("inner",),
        ("inner", 0),
        ("inner", 0, "name"),
        ("pair", 1),
        ("table",),
    ]
)


@given(outers.filter(lambda each: each.inner), paths, junk | st.just(float("inf")) | st.just(1e300))
def test_damage_is_a_diagnostic_or_a_valid_record(record, path, value):
    document: Any = plain(record)
    place = document
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    try:
        found = from_json(Outer, document, "f.json")
    except RunError as error:
        (finding,) = error.diagnostics
        assert (finding.code, finding.message) == ("R101", "`f.json` is damaged")
        assert ".".join(map(str, path)) in finding.note[0]
    else:
        assert misfits(plain(found), schema_of(Outer)) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1", "Expecting"),
        ("[]", "it is [], not a JSON object"),
        ("{}", "it has no `kind`"),
        ('{"kind": "c"}', "`kind` is 'c', not one of a, b"),
        ('{"kind": "a", "count": -1}', "`count` is -1, not a number from 0 on"),
        ('{"kind": "a", "count": true}', "`count` is True, not a whole number"),
        ('{"kind": "a", "count": 1, "inner": [{}]}', "`inner.0` has no `name`"),
        ('{"kind": "a", "count": 1, "inner": [], "least": "inf"}', "`least` is 'inf', not a number"),
        ('{"kind": "a", "count": 1, "inner": [], "pair": [1]}', "`pair` is [1], not a list of 2"),
        ('{"kind": "a", "count": 1, "inner": [], "least": NaN}', "`least` is not finite"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_the_note_names_the_key(text, said):
    with pytest.raises(RunError) as caught:
        from_json(Outer, text, "f.json")
    assert said in caught.value.diagnostics[0].note[0]
