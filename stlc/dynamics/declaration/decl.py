"""Declaration of a system: bound names, checked units, expressions in the IR. No torch."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import Diagnostic
from stlc.dynamics.declaration.deployment import BackupDecl, JudgeRef, ScenarioDecl, TestDecl, WorldRef
from stlc.dynamics.declaration.functions import FunctionDecl
from stlc.dynamics.declaration.init import InitDecl
from stlc.dynamics.declaration.learning import Feedback, ObjectiveDecl, PolicyDecl, TrainDecl
from stlc.dynamics.declaration.motion import Assign, JumpDecl
from stlc.dynamics.schema.names import ControlDecl
from stlc.signature import Signature
from stlc.source import Source, Span
from stlc.units import Unit

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


@dataclass(frozen=True)
class SystemDecl:
    """A system file, validated.

    Attributes:
        name: as written.
        doc: one line for people.
        path: of the file.
        source: its text.
        spec: path of its default specification, or None.
        dt: seconds a step, exact.
        horizon: planning horizon in steps.
        substeps: integration steps within one step.
        integrator: name of the integrator.
        discrete: whether `flow` holds next-state maps instead of derivatives.
        constants: name -> (value in SI units, unit).
        signature: the state columns, in order.
        controls: planned variables, in order: the inputs, or their deviations from `feedback`.
        flow: derivative (or next value) per column, in its unit per second; unlisted ones are constant.
        jumps: in file order.
        clamps: column -> (low, high) to which it is limited.
        feedback: inner feedback law; None where plans are the actuator commands.
        scenarios: named overlays.
        scenario: the applied overlay, if any.
        functions: external functions for specifications.
        bases: texts of the extended files, the nearest first.
        overrides: values of `--set`.
        places: name of a state, control, constant or definition -> where it is declared.
        warnings: findings that are not errors.
    """

    name: str
    doc: str
    path: Path
    source: Source = field(repr=False)
    spec: Path | None
    dt: Fraction
    horizon: int
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

    @property
    def hash(self) -> str:
        """SHA-256 of the text and the overrides, in hexadecimal."""
        changes = "".join(f"\0{key}={value}" for key, value in sorted(self.overrides.items()))
        texts = "".join(base.text for base in self.bases)
        return hashlib.sha256((self.source.text + texts + changes).encode()).hexdigest()

    @property
    def learnt(self) -> str:
        """SHA-256 of the fields that determine what a policy learns, in hexadecimal."""
        text = repr([getattr(self, name) for name in LEARNT])
        text = re.sub(r"\b[A-Z]\w+(?=\()", lambda found: _HASHED_AS.get(found[0], found[0]), text)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def worlds(self) -> tuple[WorldRef, ...]:
        """Every world that the file names, for `test` and for scenarios."""
        named = (self.test.world, *(scenario.world for scenario in self.scenarios))
        return tuple(world for world in named if world is not None)

    @property
    def judges(self) -> tuple[JudgeRef, ...]:
        """Every specification for closed-loop runs that the file names, for `test` and for scenarios."""
        named = (self.test.judge, *(scenario.judge for scenario in self.scenarios))
        return tuple(judge for judge in named if judge is not None)

    def judges_by(self, spec: Path) -> bool:
        """True if this specification judges closed-loop runs, so that it applies to recorded traces."""
        return any(judge.path.resolve() == spec.resolve() for judge in self.judges)

    @property
    def grid(self) -> Grid:
        """Time grid that formulas are compiled for."""
        return Grid(self.dt, self.horizon)

    def interface(self) -> Interface:
        """Interface that specifications are compiled against; no function is loaded."""
        names = frozenset(function.name for function in self.functions)
        known = {function.name: function for function in self.functions if function.body is not None}
        path = self.source.name
        return Interface(
            self.name, self.signature, self.constants, names, known, path=path, places=self.places
        )
