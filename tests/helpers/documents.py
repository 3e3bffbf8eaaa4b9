"""Schemas of JSON documents, for the tests of all commands that print one."""

from __future__ import annotations

from typing import Any

from jsonschema import Draft202012Validator


def misfits(value: Any, schema: dict[str, Any]) -> list[str]:
    """Places where a document is not what its schema says, and its keys that the schema lacks."""
    found = Draft202012Validator(closed(schema)).iter_errors(value)
    return [f"{error.json_path}: {error.message}"[:400] for error in found]


def closed(schema: Any) -> Any:
    """The schema where objects have no properties but those that are listed."""
    if isinstance(schema, list):
        return [closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    inner = {key: closed(value) for key, value in schema.items()}
    if isinstance(schema.get("properties"), dict) and "type" in schema:
        inner.setdefault("additionalProperties", False)
    return inner
