"""One step of a hybrid system (Meng and Fan 2023, Eq. 6) as a list of symbolic assignments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.assignments import Assignments
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.motion import JumpDecl
from stlc.dynamics.model.integrators._tableau import State
from stlc.dynamics.model.located import LocatedJumps
from stlc.registry import INTEGRATORS


@dataclass(frozen=True, slots=True)
class ModelStep:
    """One step as a list of assignments; each reads states, controls and earlier assignments.

    Attributes:
        lets: (name, numeric expression) of the intermediate results, in order.
        next: name of a state that moves -> expression for its value one step later.
    """

    lets: tuple[tuple[str, ir.Num], ...]
    next: Mapping[str, ir.Num]

    @property
    def numbers(self) -> Mapping[str, ir.Num]:
        """All expressions: name of an intermediate result, or of a state with `'` appended -> expression."""
        return dict(self.lets) | {f"{name}'": num for name, num in self.next.items()}


def build_step(decl: SystemDecl, *, soft: bool) -> ModelStep:
    """Build the step of a declaration.

    If `soft`, a jump with guard g is the differentiable blend `I_w(g) reset + (1 - I_w(g)) flow`, where
    I_w(g) is a smooth indicator of g between 0 and 1. Otherwise a jump is an exact choice. Guards and resets
    read the state at the start of the step. Limits (`clamp`) are applied after each substep. If two jumps set
    the same state, the later one wins. Jumps that are located within the step are exact choices, through
    which no derivative of their instants passes.
    """
    writer = Assignments()
    start: State = {name: ir.Signal(name) for name in decl.signature.names}
    given = {name: writer.name(num, name + "#{}") for name, num in decl.commands.items()}
    state = _flow(decl, writer, start, given)
    moved = {assign.name for assign in decl.flow}
    for jump in decl.jumps:
        if not jump.located:
            state = _jump(jump, given, state, soft=soft)
        moved |= {assign.name for assign in jump.resets}
    reset = {assign.name for jump in decl.jumps for assign in jump.resets}
    state = {name: _clamped(decl, name, num) if name in reset else num for name, num in state.items()}
    state = _updated(decl, writer, state)
    moved |= {assign.name for assign in decl.updates}
    ordered = [name for name in decl.signature.names if name in moved | set(decl.clamps)]
    return ModelStep(tuple(writer.lets), {name: state[name] for name in ordered})


def _flow(decl: SystemDecl, writer: Assignments, state: State, given: State) -> State:
    """Return the states after the flow of one step, integrated over all substeps.

    States are expressions by name. Intermediate results are appended to `writer`; `given` are the actuator
    commands.
    """

    def named(at: State) -> State:
        return {name: writer.name(num, name + "#{}") for name, num in at.items()}

    def rate(at: State) -> State:
        table = {**named(at), **given}
        return {assign.name: assign.value.substitute(table) for assign in decl.flow}

    def happened(at: State, due: Sequence[ir.Formula]) -> State:
        changed = dict(at)
        for jump, cond in zip(located, due, strict=True):
            for assign in jump.resets:
                changed[assign.name] = cond.select(assign.value.substitute(at), changed[assign.name])
        return changed

    integrate = INTEGRATORS.get(decl.integrator)
    length = float(decl.dt) / decl.substeps
    located = [jump for jump in decl.jumps if jump.located]
    for substep in range(decl.substeps):
        if substep:
            state = named(state)
        if decl.discrete:
            moved: State = {**state, **rate(state)}
        elif located:
            moved = LocatedJumps(located, writer, happened).advanced(integrate, rate, state, length)
        else:
            moved = integrate(rate, state, length, named)
        state = {name: _clamped(decl, name, num) for name, num in moved.items()}
    return state


def _jump(jump: JumpDecl, given: State, state: State, *, soft: bool) -> State:
    """Return the states after one jump; `state` is the result of the flow and of earlier jumps.

    If `soft`, the result is a differentiable blend of the states with and without the jump, weighted by the
    smooth indicator I_w of Eq. 6; where I_w is 1 or 0, it is exactly one of them. Otherwise it is an exact
    choice. `given` are the actuator commands.
    """
    changed, guard = dict(state), jump.guard.substitute(given)
    for assign in jump.resets:
        flowed, value = changed[assign.name], assign.value.substitute(given)
        if soft:
            weight = guard.indicator(jump.sharpness)
            kept = (1.0 - weight) * flowed
            changed[assign.name] = kept if value == ir.Const(0.0) else weight * value + kept
        else:
            changed[assign.name] = guard.select(value, flowed)
    return changed


def _updated(decl: SystemDecl, writer: Assignments, state: State) -> State:
    """Return the states with the columns that are computed at every sample.

    `state` is the result of flow and jumps. Intermediate results are appended to `writer`.
    """
    if not decl.updates:
        return state
    before = {each.before.name: each for each in map(ir.Signal, decl.signature.names)}
    read = frozenset[str]().union(*(assign.value.columns for assign in decl.updates))
    known = {name: writer.name(num, name + "#{}") if name in read else num for name, num in state.items()}
    for assign in decl.updates:
        num = assign.value.substitute({**known, **before})
        known[assign.name] = writer.name(num, assign.name + "#{}") if assign.name in read else num
    return known


def _clamped(decl: SystemDecl, name: str, num: ir.Num) -> ir.Num:
    """Limit the value `num` of a state to the range of its `clamp`, if it has one."""
    if name not in decl.clamps:
        return num
    low, high = decl.clamps[name]
    return num.apply("clip", low, high)
