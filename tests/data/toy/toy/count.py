"""Command `count`: the number of requirements."""

from typing import Annotated, TypedDict

import typer

from stlc.cli.framework.output import Answer, emit
from stlc.cli.framework.program import command


class Count(TypedDict):
    """Record of `stlc count --json`."""

    requirements: int


@command("stlc count specs/traffic.stl")
def count(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="The specification.")],
) -> Answer[Count]:
    """Count the requirements of a specification."""
    import stlc
    from stlc.grammar import ast

    found = sum(isinstance(item, ast.Require) for item in stlc.load(spec).items)
    return Answer({"requirements": found}, lambda: emit(str(found)))
