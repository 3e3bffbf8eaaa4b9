"""Records of keys: what is read, what is reported, and the JSON Schema of system files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from stlc.dynamics.declaration.schema.names import Context, Names
from stlc.dynamics.declaration.schema.reader import Reader
from stlc.dynamics.declaration.schema.record import (
    FLAG,
    OF,
    integer,
    json_schema,
    key,
    keys_of,
    read,
    reference,
    word,
)
from stlc.dynamics.declaration.schema.yaml_nodes import load_yaml
from stlc.dynamics.declaration.sections import SystemKeys, system_schema
from stlc.source import Source

EXAMPLES = sorted((Path(__file__).parents[4] / "examples").glob("*.yaml"))


@dataclass(frozen=True, slots=True)
class Engine:
    size: int = key(integer(1, 8), "in litres", 2)
    fuel: str = key(word(("petrol", "none")), "what it burns", "none", label=OF)
    turbo: bool = key(FLAG, "compressed air", False, name="turbo charged")


def engine(text: str) -> tuple[Engine, list[str]]:
    source = Source("car.yaml", text)
    reader = Reader(source)
    found = read(Engine, Context.of(reader, Names()), load_yaml(source, sink=reader.findings), "the engine")
    return found, [finding.message for finding in reader.findings]


def test_a_record_is_read_and_defaults_stay() -> None:
    assert engine("size: 3") == (Engine(3), [])
    assert engine("turbo charged: true\nfuel: petrol") == (Engine(2, "petrol", True), [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("size: 9", "`size` must be a whole number between 1 and 8, this is `9`"),
        ("fuel: wood", "`fuel` of the engine must be `petrol` or `none`, this is `wood`"),
        ("sise: 1", "unknown key `sise` in the engine"),
    ],
)
def test_what_is_wrong_is_reported_and_the_default_stays(text: str, message: str) -> None:
    assert engine(text) == (Engine(), [message])


def test_schema_and_reference_are_printed_from_the_same_keys() -> None:
    assert list(json_schema(Engine)["properties"]) == list(keys_of(Engine))
    assert json_schema(Engine)["properties"]["size"]["maximum"] == 8
    assert "| `size` | whole number from 1 to 8 | `2` | in litres |" in list(reference(Engine, "engine"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_fit_the_schema(path: Path) -> None:
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    errors = [error.message for error in Draft202012Validator(system_schema()).iter_errors(found)]
    assert not errors


def test_the_schema_refuses_an_unknown_key() -> None:
    file = {"stlc": 1, "name": "a", "time": {"dt": 0.1, "horizon": 3, "integrater": "heun"}}
    assert not Draft202012Validator(system_schema()).is_valid(file)
    assert set(system_schema()["properties"]) == set(keys_of(SystemKeys))
