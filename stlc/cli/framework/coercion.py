"""Values of options without pydantic, where nothing has to be converted.

Newer releases of typer build a pydantic adapter for every parameter of a command that runs, which takes a
tenth of a second. Most values are texts already; they are passed on, and typer converts the others. Releases
that do without adapters are left alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

HELP_NAMES = ("-h", "--help")
_SLOT = "_runtime_param"


def spare_adapters(command: Any) -> None:
    """Let the parameters of a command, and of those below it, convert only what needs it."""
    queue = [command]
    while queue:
        entry = queue.pop()
        queue.extend(getattr(entry, "commands", {}).values())
        for param in (*getattr(entry, "params", ()), *_help_option(entry)):
            if getattr(param, _SLOT, param) is None and hasattr(param, "type_descriptor"):
                setattr(param, _SLOT, _AsGiven())


def _help_option(command: Any) -> list[Any]:
    """The option `--help`, which a command makes when it is first asked for it and then keeps."""
    if not hasattr(command, "get_help_option"):
        return []
    option = command.get_help_option(typer.Context(command, help_option_names=list(HELP_NAMES)))
    return [] if option is None else [option]


class _AsGiven:
    """Stands in for typer's converter of one parameter until a value needs one."""

    def coerce(self, value: Any, *, param: Any, ctx: Any) -> Any:
        """The value as the command takes it."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        annotation = param.type_descriptor.annotation
        if several and get_origin(annotation) is list and isinstance(value, list | tuple):
            kinds = get_args(annotation)
            if len(kinds) == 1 and all(_fits(item, kinds[0]) for item in value):
                return list(value)
        elif not several and _fits(value, annotation):
            return value
        setattr(param, _SLOT, None)
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


def _fits(value: Any, annotation: Any) -> bool:
    """Whether a value is already what its annotation says."""
    if annotation in (str, bool, int, float):
        return type(value) is annotation
    if get_origin(annotation) is Literal:
        return isinstance(value, str) and value in get_args(annotation)
    return annotation is Path and isinstance(value, Path)
