"""`stlc schema`: JSON Schemas of the documents that the commands print with --json."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from stlc.cli.framework.output import Document, emit
from stlc.cli.framework.program import command
from stlc.cli.framework.results import RESULTS, result_of
from stlc.diagnostics import usage

SYSTEM_FILE, PLANT_FILE, LINE = "system-file", "plant-file", "robustness-line"
_DIALECT = "https://json-schema.org/draft/2020-12/schema"


@command("stlc schema", "stlc schema check/1")
def schema(
    name: Annotated[
        str | None, typer.Argument(metavar="SCHEMA", help="Such as check/1; without /1, the newest version.")
    ] = None,
) -> None:
    """Print the JSON Schema of the --json output of a command.

    Without a name, all schemas are listed. Within one major version, keys are added but never removed.
    """
    if name is None:
        emit("\n".join(names()))
        return
    emit(json.dumps(load_schema(name), indent=2))


def names() -> list[str]:
    """Return the names of all schemas, such as `check/1`.

    Most schemas describe the output of a command. `system-file/1` describes system files, and
    `plant-file/1` plant files.
    """
    return sorted(f"{name}/1" for name in (*RESULTS, LINE, SYSTEM_FILE, PLANT_FILE))


def load_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema called `name`, such as `check/1`; `check` without a number means `check/1`.

    The schema of a command describes a complete document: the keys that all commands share, and the result of
    the command.

    Raises:
        UsageError: U101, there is no such schema.
    """
    wanted = name if "/" in name else f"{name}/1"
    if wanted not in names():
        missing = usage(f"there is no schema `{name}`")
        raise missing.near(wanted, names(), "stlc schema  lists them")
    command = wanted.partition("/")[0]
    if command == SYSTEM_FILE:
        from stlc.dynamics.declaration.sections import system_schema

        return {"$schema": _DIALECT, "title": wanted, **system_schema()}
    if command == PLANT_FILE:
        from stlc.plants.declaration import plant_schema

        return {"$schema": _DIALECT, "title": wanted, **plant_schema()}
    from stlc.records import schema_of

    if command == LINE:
        from stlc.controller.deployment.live import RobustnessLine

        return {"$schema": _DIALECT, "title": wanted, **schema_of(RobustnessLine)}
    frame = schema_of(Document)
    frame["properties"] |= {"schema": {"const": wanted}, "result": schema_of(result_of(command))}
    return {"$schema": _DIALECT, "title": wanted, **frame}
