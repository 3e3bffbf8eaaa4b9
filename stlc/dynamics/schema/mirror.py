"""The entry `mirror` of the section `policy`: what states and controls become under a symmetry."""

from __future__ import annotations

from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.schema.expressions import Expressions, written
from stlc.dynamics.schema.flow import state_assigns
from stlc.dynamics.schema.names import Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Node


def read_mirror(node: Node | None, reader: Reader, names: Names) -> tuple[Assign, ...]:
    """The mirror image of every state and control that has another one than itself.

    Whether dynamics and specification stay what they are is known when both are: see `controller.symmetry`.
    """
    here = names.expressions(reader)
    found: list[Assign] = []
    for entry in reader.entries(node, "`mirror`"):
        found.extend(_image(entry, here, names))
    first = found[0].name if found else ""
    if found and not any(column.name == first for column in names.columns):
        reader.report(
            "S103",
            f"`mirror` begins with the control `{first}`",
            reader.entries(node, "`mirror`")[0].key.span,
            "write a state first: it tells a state from its mirror image",
        )
    return tuple(found)


def _image(entry: Entry, here: Expressions, names: Names) -> tuple[Assign, ...]:
    """The image of a control, or of a state component by component."""
    control = next((control for control in names.controls if control.name == entry.key.text), None)
    if control is None:
        return state_assigns(entry, "`mirror`", here, names)
    value = here.stored(entry.value, f"`{control.name}`", control.unit)
    return () if value is None else (Assign(control.name, value, written(entry.value)),)
