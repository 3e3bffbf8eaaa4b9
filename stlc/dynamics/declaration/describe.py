"""Description of a system as tables of text: states, controls, flow, jumps and scenarios. No torch."""

from __future__ import annotations

from collections.abc import Sequence

from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.init import Situation
from stlc.dynamics.declaration.motion import Assign
from stlc.escape import visible
from stlc.signature import Column

Row = tuple[str, ...]


def describe(decl: SystemDecl) -> str:
    """Describe states, controls, flow, jumps, initial situations and scenarios as lines of text."""
    head = visible(f"{decl.name}: {decl.doc}" if decl.doc else decl.name)
    substeps = f", {decl.substeps} substeps" if decl.substeps > 1 else ""
    kind = "discrete" if decl.discrete else decl.integrator
    seconds = float(decl.dt * decl.horizon)
    grid = f"dt = {float(decl.dt):g} s, T = {decl.horizon} steps = {seconds:g} s, {kind}{substeps}"
    flow = {assign.name: assign.text for assign in decl.flow}
    rate = "{}' =" if decl.discrete else "d{}/dt ="
    blocks = (
        ("states", [_state(column, flow.get(column.name), rate) for column in decl.signature.columns]),
        ("controls", [_control(decl, index) for index in range(len(decl.controls))]),
        ("feedback beneath the plans", _feedback(decl)),
        ("jumps", [(jump.name, f"when {jump.text}", _resets(jump.resets)) for jump in decl.jumps]),
        ("initial situations", _situations(decl.init.mixture)),
        ("kept where", [(text,) for text in decl.init.where_text]),
        ("scenarios", [(scenario.name, scenario.doc) for scenario in decl.scenarios]),
    )
    return "\n".join([head, grid, *(line for title, rows in blocks for line in _table(title, rows))])


def _state(column: Column, flow: str | None, rate: str) -> Row:
    moves = (
        f"{rate.format(column.name)} {flow}"
        if flow
        else "set from outside"
        if column.role == "env"
        else "constant"
    )
    return column.name, f"[{column.unit}]" if column.unit.text else "", _values(column), moves


def _values(column: Column) -> str:
    """Values of a column in words."""
    if column.kind == "bool":
        return "bool"
    if column.labels:
        return ", ".join(f"{label} = {value:g}" for label, value in column.labels)
    if column.low is None or column.high is None:
        return "any"
    return f"[{column.low:g}, {column.high:g}]" + (" clamped" if column.fact else "")


def _control(decl: SystemDecl, index: int) -> Row:
    control = decl.controls[index]
    unit = f"[{control.unit}]" if control.unit.text else ""
    return control.name, unit, f"[{control.low:g}, {control.high:g}]", control.squash


def _feedback(decl: SystemDecl) -> list[Row]:
    """Feedback law, one row per control: `u  [N]  u0 + plan + 3.1 (x0 - x) within 4, then within [-8, 8]`."""
    feedback = decl.feedback
    rows: list[Row] = []
    for i, control in enumerate(decl.controls if feedback is not None else ()):
        assert feedback is not None
        entries = zip(decl.signature.names, feedback.gain[i], feedback.state, strict=True)
        parts = [f"{gain:+.4g} ({at:.4g} - {name})" for name, gain, at in entries if gain]
        most, back = feedback.authority[i], " ".join(parts) or "0"
        law = f"plan {feedback.control[i]:+.4g}, and {back} within {most:.4g}"
        unit = f"[{control.unit}]" if control.unit.text else ""
        rows.append((control.name, unit, f"actuator [{feedback.low[i]:g}, {feedback.high[i]:g}]", law))
    return rows


def _resets(resets: Sequence[Assign]) -> str:
    return ", ".join(f"{reset.name} := {reset.text}" for reset in resets)


def _situations(mixture: Sequence[Situation]) -> list[Row]:
    total = sum(situation.weight for situation in mixture) or 1.0
    return [
        (situation.name or f"situation {index + 1}", f"{100 * situation.weight / total:.3g} %")
        for index, situation in enumerate(mixture)
    ]


def _table(title: str, rows: Sequence[Row]) -> list[str]:
    """A title and aligned rows; no lines without rows."""
    if not rows:
        return []
    rows = [tuple(map(visible, row)) for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return ["", title, *(f"  {line}".rstrip() for line in lines)]
