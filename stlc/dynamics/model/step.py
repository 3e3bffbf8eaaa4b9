"""One step of a hybrid system (Meng and Fan 2023, Eq. 6) as a list of symbolic assignments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
            state = _jump(_given(jump, given), state, soft=soft)
        moved |= {assign.name for assign in jump.resets}
    reset = {assign.name for jump in decl.jumps for assign in jump.resets}
    state = {name: _clamped(decl, name, num) if name in reset else num for name, num in state.items()}
    state = _updated(decl, writer, state)
    moved |= {assign.name for assign in decl.updates}
    ordered = [name for name in decl.signature.names if name in moved | set(decl.clamps)]
    return ModelStep(tuple(writer.lets), {name: state[name] for name in ordered})


def _given(jump: JumpDecl, given: State) -> JumpDecl:
    """Return the jump with each control in it replaced by the actuator command in `given`."""
    if not given:
        return jump
    resets = tuple(replace(each, value=each.value.substitute(given)) for each in jump.resets)
    return replace(jump, guard=jump.guard.substitute(given), resets=resets)


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
        before = at
        for jump, cond in zip(located, due, strict=True):
            resets = tuple(replace(each, value=each.value.substitute(before)) for each in jump.resets)
            at = _jump(replace(jump, guard=cond, resets=resets), at, soft=False)
        return at

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


def _jump(jump: JumpDecl, state: State, *, soft: bool) -> State:
    """Return the states after one jump; `state` is the result of the flow and of earlier jumps.

    If `soft`, the jump is a differentiable blend, otherwise an exact choice.
    """
    changed = dict(state)
    for assign in jump.resets:
        flowed = changed[assign.name]
        if soft:
            changed[assign.name] = _blend(jump.guard, assign.value, flowed, jump.sharpness)
        else:
            changed[assign.name] = jump.guard.select(assign.value, flowed)
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


def _blend(cond: ir.Formula, yes: ir.Num, no: ir.Num, sharpness: float | None) -> ir.Num:
    """Return `I yes + (1 - I) no`, where I is the smooth indicator of `cond`.

    I is the function I_w of Eq. 6, with values between 0 and 1. The result is exactly `yes` or `no` where I
    is 1 or 0.
    """
    weight = cond.indicator(sharpness)
    kept = (1.0 - weight) * no
    return kept if yes == ir.Const(0.0) else weight * yes + kept


def _clamped(decl: SystemDecl, name: str, num: ir.Num) -> ir.Num:
    """Limit the value `num` of a state to the range of its `clamp`, if it has one."""
    if name not in decl.clamps:
        return num
    low, high = decl.clamps[name]
    return num.apply("clip", low, high)
