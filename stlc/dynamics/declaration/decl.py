"""Declaration of a system: declared names, expressions with checked units, and a description.

Expressions are in the compiler's intermediate representation (IR). Nothing here imports torch.
"""

from __future__ import annotations

import copyreg
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import Diagnostic
from stlc.dynamics.declaration.deployment import BackupDecl, JudgeRef, ScenarioDecl, TestDecl, WorldRef
from stlc.dynamics.declaration.functions import FunctionDecl
from stlc.dynamics.declaration.init import FileDecl, InitDecl
from stlc.dynamics.declaration.inputs import InputDecl
from stlc.dynamics.declaration.learning import Feedback, ObjectiveDecl, PolicyDecl, TrainDecl
from stlc.dynamics.declaration.motion import Assign, JumpDecl
from stlc.dynamics.declaration.schema.names import ControlDecl
from stlc.dynamics.declaration.tables import TableDecl
from stlc.escape import visible
from stlc.files import File
from stlc.signature import Column, Signature
from stlc.source import Source, Span
from stlc.units import Unit, time_text

LEARNT = (
    *("dt", "horizon", "substeps", "integrator", "discrete", "constants", "signature", "controls"),
    *("flow", "jumps", "clamps", "init", "objective", "policy", "feedback"),
)
"""Fields of a system that determine what a policy learns."""
_HASHED_AS = {
    **{"Const": "Lit", "Signal": "Col", "ShiftedSignal": "At", "FrozenVar": "Held"},
    **{"Indicator": "Ind", "Predicate": "Atom", "BoolOp": "Join"},
}
"""Earlier class names of nodes, used in hashes so that those of existing runs stay valid."""


def _read_only(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


copyreg.pickle(MappingProxyType, lambda found: (_read_only, (dict(found),)))
"""Declarations can be pickled: their read-only mappings as dictionaries."""


@dataclass(frozen=True)
class SystemDecl:
    """A system file, read and validated.

    Attributes:
        name: name of the system, from the file.
        doc: description of the system in one line.
        path: path of the system file.
        source: text of the system file.
        spec: path of the default specification, or None.
        dt: time step in seconds, exact.
        horizon: planning horizon in steps.
        mission: last step of the missions to whose end plans reach; 0: plans have the horizon, and regard no
            end; None: that is so in training, and planners reach to the end of a deployment.
        substeps: integration steps within one time step.
        integrator: name of the integration method.
        discrete: whether `flow` gives next values of the states instead of derivatives.
        constants: name -> (value in SI units, unit).
        signature: the state columns (one per scalar state or vector component), in order.
        controls: planned variables, in order: the inputs of the system or, with an inner feedback, the
            deviations of the inputs from the commands of the feedback.
        flow: derivative of each column in its unit per second, or its next value; a column that is not listed
            is constant.
        jumps: discrete transitions, in file order.
        clamps: column -> (low, high), the range to which the column is limited after every step.
        init, objective, policy, train, backup, test: the sections with these names.
        feedback: inner feedback law; None if plans are the actuator commands themselves.
        scenarios: named changes of the system for deployments.
        scenario: the scenario applied to this declaration, or None.
        functions: external functions that specifications may call.
        bases: texts of the files that this file extends, the nearest first.
        overrides: values of `--set`.
        places: name of a state, control, constant or definition -> source location of its declaration.
        warnings: findings that are not errors.
        inputs: input signals, which are functions of time that no policy chooses.
        tables: interpolation tables that expressions of the file call.
        updates: columns that are computed at every sample after flow and jumps, in order. A name in their
            values stands for the value at that sample; with the suffix `ir.BEFORE`, at the sample before.
        hidden: columns that policies do not observe by default: the numbers that determine input signals,
            clocks, and earlier values.
    """

    name: str
    doc: str
    path: Path
    source: Source = field(repr=False)
    spec: Path | None
    dt: Fraction
    horizon: int
    mission: int | None
    substeps: int
    integrator: str
    discrete: bool
    constants: Mapping[str, tuple[float, Unit]]
    signature: Signature
    controls: tuple[ControlDecl, ...]
    flow: tuple[Assign, ...]
    jumps: tuple[JumpDecl, ...]
    clamps: Mapping[str, tuple[float, float]]
    init: InitDecl
    objective: ObjectiveDecl
    policy: PolicyDecl
    train: TrainDecl
    backup: BackupDecl
    test: TestDecl
    feedback: Feedback | None = None
    scenarios: tuple[ScenarioDecl, ...] = ()
    scenario: ScenarioDecl | None = None
    functions: tuple[FunctionDecl, ...] = ()
    bases: tuple[Source, ...] = field(default=(), repr=False)
    overrides: Mapping[str, str] = field(default_factory=dict)
    places: Mapping[str, Span] = field(default_factory=dict, repr=False)
    warnings: tuple[Diagnostic, ...] = field(default=(), repr=False)
    inputs: tuple[InputDecl, ...] = ()
    tables: tuple[TableDecl, ...] = ()
    updates: tuple[Assign, ...] = ()
    hidden: tuple[str, ...] = ()

    @property
    def hash(self) -> str:
        """SHA-256, in hexadecimal, of the file, the files that it extends, and the values of `--set`."""
        changes = "".join(f"\0{key}={value}" for key, value in sorted(self.overrides.items()))
        texts = "".join(base.text for base in self.bases)
        return hashlib.sha256((self.source.text + texts + changes).encode()).hexdigest()

    @property
    def learnt(self) -> str:
        """SHA-256 of the fields that determine what a policy learns, in hexadecimal."""
        text = repr([getattr(self, name) for name in LEARNT])
        if self.updates or self.tables:
            text += repr((self.updates, self.init.computed, self.tables))
        text += "".join(f"located {jump.name}" for jump in self.jumps if jump.located)
        text = re.sub(r"\b[A-Z]\w+(?=\()", lambda found: _HASHED_AS.get(found[0], found[0]), text)
        text = re.sub(r"(dims=\([^()]*), 0, 0\)", r"\1)", text)  # mol and cd came later
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def worlds(self) -> tuple[WorldRef, ...]:
        """The worlds that the section `test` and the scenarios refer to.

        A world is a simulator in a Python file.
        """
        named = (self.test.world, *(scenario.world for scenario in self.scenarios))
        return tuple(world for world in named if world is not None)

    @property
    def judges(self) -> tuple[JudgeRef, ...]:
        """References to the specifications by which closed-loop runs are judged.

        They are given by the key `judge` in the section `test` and in scenarios.
        """
        named = (self.test.judge, *(scenario.judge for scenario in self.scenarios))
        return tuple(judge for judge in named if judge is not None)

    @property
    def files(self) -> dict[str, Path]:
        """Files that the system file refers to: name -> path.

        These are the files that the system file extends, the files of its functions, and files of initial
        states. If a file is below the folder of the system file, its name is its path relative to this
        folder. Otherwise its name is its file name.
        """
        home = self.path.parent.resolve()
        named = [Path(base.name) for base in self.bases]
        named += [function.module for function in self.functions if isinstance(function.module, Path)]
        named += [part.points.path for part in self.init.mixture if isinstance(part.points, FileDecl)]
        found: dict[str, Path] = {}
        for path in (each.resolve() for each in named if each.is_file()):
            below = path.is_relative_to(home)
            found[path.relative_to(home).as_posix() if below else path.name] = path
        return found

    @property
    def commands(self) -> dict[str, ir.Num]:
        """Actuator commands as functions of state and plan: name of a control -> numeric expression.

        Empty without inner feedback. Commands are computed once per step, as in a sampled-data controller.
        """
        feedback = self.feedback
        if feedback is None:
            return {}
        found: dict[str, ir.Num] = {}
        for i, each in enumerate(self.controls):
            back: ir.Num = ir.Const(0.0)
            for gain, state, at in zip(feedback.gain[i], self.signature.names, feedback.state, strict=True):
                if gain:
                    back = back + ir.Const(gain) * (ir.Const(at) - ir.Signal(state))
            most = feedback.authority[i]
            bounded = back.apply("clip", -most, most)
            total = ir.Signal(each.name) + feedback.control[i] + bounded
            found[each.name] = total.apply("clip", feedback.low[i], feedback.high[i])
        return found

    def describe(self) -> str:
        """Lines of text on the system: states, controls, flow, jumps, initial states and scenarios."""
        head = visible(f"{self.name}: {self.doc}" if self.doc else self.name)
        substeps = f", {self.substeps} substeps" if self.substeps > 1 else ""
        kind = "discrete" if self.discrete else self.integrator
        horizon = time_text(self.dt * self.horizon)
        grid = f"dt = {float(self.dt):g} s, T = {self.horizon} steps = {horizon}, {kind}{substeps}"
        flow = {assign.name: assign.text for assign in self.flow}
        rate = "{}' =" if self.discrete else "d{}/dt ="
        jumps = [
            (jump.name, f"when {jump.text}", ", ".join(f"{each.name} := {each.text}" for each in jump.resets))
            for jump in self.jumps
        ]
        columns = self.signature.columns
        moves = {each.name: "set from outside" if each.role == "env" else "constant" for each in columns}
        moves |= {name: f"{rate.format(name)} {text}" for name, text in flow.items()}
        moves |= {assign.name: f"= {assign.text}" for assign in self.updates}
        apart = {*self.hidden, *(each.name for each in self.inputs)}
        states = [
            (each.name, f"[{each.unit}]" * bool(each.unit.text), _values(each), moves[each.name])
            for each in columns
            if each.name not in apart
        ]
        weights = sum(situation.weight for situation in self.init.mixture) or 1.0
        blocks = (
            ("states", states),
            ("input signals", [_input(each) for each in self.inputs]),
            (
                "controls",
                [
                    (
                        each.name,
                        f"[{each.unit}]" * bool(each.unit.text),
                        f"[{each.low:g}, {each.high:g}]",
                        each.squash,
                    )
                    for each in self.controls
                ],
            ),
            ("feedback beneath the plans", _feedback(self)),
            ("jumps", jumps),
            (
                "initial situations",
                [
                    (each.name or f"situation {index}", f"{100 * each.weight / weights:.3g} %")
                    for index, each in enumerate(self.init.mixture, 1)
                ],
            ),
            ("kept where", [(text,) for text in self.init.where_text]),
            ("scenarios", [(scenario.name, scenario.doc) for scenario in self.scenarios]),
        )
        return "\n".join([head, grid, *(line for title, rows in blocks for line in _table(title, rows))])

    def judges_by(self, spec: Path) -> bool:
        """True if the key `judge` of the section `test` or of a scenario refers to the file `spec`.

        A specification that judges closed-loop runs is compiled for recorded traces, not for plans.
        """
        return any(File(judge.path).real == File(spec).real for judge in self.judges)

    @property
    def grid(self) -> Grid:
        """Time step and horizon of the system; formulas are compiled for them."""
        return Grid(self.dt, self.horizon)

    def interface(self) -> Interface:
        """Return the interface that specifications are compiled against.

        External Python functions are named in it but not loaded.
        """
        names = frozenset(function.name for function in self.functions)
        known = {function.name: function for function in self.functions if function.body is not None}
        return Interface(
            self.name,
            self.signature,
            self.constants,
            names,
            known,
            path=self.source.name,
            places=self.places,
            unread=self._unread(),
        )

    def _unread(self) -> dict[str, str]:
        """Return an advice for each name of the file that no specification can use."""
        where = self.source.name
        shared = {*(column.name.partition("[")[0] for column in self.signature.columns), *self.constants}
        found = {
            name: f"`{name}` is a definition of {where}; repeat it here, `def {name} = …`, to use it"
            for name in self.places.keys() - shared
        }
        for table in self.tables:
            found[table.name] = f"`{table.name}` is a table of {where}; requirements cannot call it"
        for control in self.controls:
            name = control.name.partition("[")[0]
            found[name] = f"`{name}` is a control of {where}; requirements cannot read it: they read states"
        return found


Row = tuple[str, ...]


def _input(decl: InputDecl) -> Row:
    unit = f"[{decl.unit}]" if decl.unit.text else ""
    pieces = "constant" if not decl.moves else f"{decl.pieces} pieces, {decl.interpolate}"
    span = time_text(decl.duration) + (", free times" if decl.free_times else "")
    return decl.name, unit, f"[{decl.low:g}, {decl.high:g}]", f"{pieces}, {span}" if decl.moves else pieces


def _values(column: Column) -> str:
    """Describe the values that a column can take."""
    if column.kind == "bool":
        return "bool"
    if column.labels:
        return ", ".join(f"{label} = {value:g}" for label, value in column.labels)
    if column.low is None or column.high is None:
        return "any"
    return f"[{column.low:g}, {column.high:g}]" + (" clamped" if column.fact else "")


def _feedback(decl: SystemDecl) -> list[Row]:
    """Return one row per control that describes the feedback law.

    A row has four cells: control, unit, range of the actuator, and law. The law may read `plan +0, and +3.1
    (0 - x) within 4`: the actuator gets the planned control, plus 0, plus 3.1 (0 - x) limited to ±4.
    """
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


def _table(title: str, rows: Sequence[Row]) -> list[str]:
    """Return a table as lines: the title, then the rows with aligned cells; no lines if there are no rows."""
    if not rows:
        return []
    rows = [tuple(map(visible, row)) for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return ["", title, *(f"  {line}".rstrip() for line in lines)]
