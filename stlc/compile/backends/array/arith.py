"""Numeric expressions (`ir.Num`) as programs over any array library.

A program is built once and called often. Its operations are recorded on a tape, a list of operations
(`stlc.compile.backends.array.tape`). There are two tapes: one evaluates conditions exactly, as 0 or 1; the
other evaluates them smoothly, as numbers between 0 and 1. The operations are then bound to the functions of
an array library, and each call executes them in order.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, TypeAlias

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.tape import GradientTape, Instr, Operand
from stlc.compile.backends.numbers import Leaf, NumberEvaluator
from stlc.compile.backends.schedule import IndexRange
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.switch import Hard, Switch

ExternFunction: TypeAlias = Callable[..., Sequence[Array]]
"""A function that the system provides: arrays in, its components out."""


_TAKES_FLOATS = frozenset({"pow"})
"""Kernels that take a constant as a Python float."""

_HARD = Hard()

_ROOM = 1 << 24
"""Numbers in all registers of a program beyond which a recording is computed in blocks of samples."""


class ArrayProgram:
    """Program that computes several numeric expressions from arrays.

    Args:
        outputs: name of an output -> expression to compute.
        constants: name of a signal -> value, for signals that are constant (`dt`, constants of a system).
        externs: name of a function that the system provides (`ir.Extern`) -> the function.

    A call takes a dictionary with one array for each name in the attribute `columns`; the shapes of the
    arrays must broadcast. If an expression reads a signal some samples earlier or later, the shifted signal
    is a separate array; the attribute `shifted` lists the names of such arrays; if there is none, and no
    time, the program is `plain`. The call returns one array per output. A constant output has the shape of
    the first array in the dictionary. Common sub-expressions are computed once. Large arrays of NumPy and of
    intervals are computed in blocks along axis 0, so that the memory for intermediate results is bounded.
    """

    def __init__(
        self,
        outputs: Mapping[str, ir.Num],
        *,
        constants: Mapping[str, float] | None = None,
        externs: Mapping[str, ExternFunction] | None = None,
    ) -> None:
        self._outputs = dict(outputs)
        self._constants = {name: float(value) for name, value in (constants or {}).items()}
        self._externs = dict(externs or {})
        self._tapes: dict[bool, tuple[GradientTape, dict[str, Operand]]] = {}
        self._bound: dict[tuple[str, Switch, Hashable], _Bound] = {}
        tape, _ = self._tape(exact=True)
        self.columns = frozenset(str(i.params[0]) for i in tape.code if i.kernel == "input")
        shifted = (
            leaf for num in outputs.values() for leaf in num.leaves() if isinstance(leaf, ir.ShiftedSignal)
        )
        self.shifted = {_key_of(leaf): leaf for leaf in shifted}
        self.plain = not self.shifted and ir.ELAPSED not in self.columns

    def __call__(
        self, env: Mapping[str, Array], ops: Ops = NUMPY, switch: Switch | None = None
    ) -> dict[str, Array]:
        """Return the value of each output, by name, computed from the arrays `env`.

        `switch` converts a condition to a number from 0 (false) to 1 (true). If `switch` is None, the number
        is exactly 0 or 1.
        """
        switch = switch or _HARD
        like, library = _first(env), ops.name
        key = (library, switch, ops.kind(like))
        bound = self._bound.get(key)
        if bound is None:
            bound = self._bound[key] = self._bind(ops, switch, like)
        with ops.quiet():
            if library in ("numpy", "intervals"):  # shapes of exported torch programs are symbols
                numbers = math.prod(like.shape) * len(bound.code)
                if numbers > _ROOM:
                    return bound.run_in_blocks(env, ops, max(len(like) * _ROOM // numbers, 1))
            return bound.run(env, ops)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_bound": {}}

    def operations(self, *, exact: bool = True) -> int:
        """Number of array operations per call.

        If `exact`, conditions are evaluated as 0 or 1. Otherwise they are evaluated as numbers between 0 and
        1.
        """
        tape, outputs = self._tape(exact=exact)
        free = ("input", "pick")
        return sum(tape.code[i].kernel not in free for i in _needed(tape, outputs.values()))

    def instructions(self) -> tuple[dict[int, Instr], dict[str, Operand]]:
        """Instructions in order, by the register that they write, and outputs; conditions are exact."""
        tape, outputs = self._tape(exact=True)
        return {register: tape.code[register] for register in _needed(tape, outputs.values())}, outputs

    def _tape(self, *, exact: bool) -> tuple[GradientTape, dict[str, Operand]]:
        if exact not in self._tapes:
            writer = _TapeWriter(self._constants, exact=exact)
            outputs = {name: writer.number(num) for name, num in self._outputs.items()}
            self._tapes[exact] = writer.tape, outputs
        return self._tapes[exact]

    def _bind(self, ops: Ops, switch: Switch, like: Array) -> _Bound:
        tape, outputs = self._tape(exact=switch.exact)
        registers: list[Any] = [None] * len(tape.code)

        def place(value: object) -> int:
            registers.append(value)
            return len(registers) - 1

        inputs, code, guarded = [], [], tape.guarded()
        for register in _needed(tape, outputs.values()):
            instr = tape.code[register]
            if instr.kernel == "input":
                inputs.append((str(instr.params[0]), register))
                continue
            literal = instr.kernel in _TAKES_FLOATS
            args = [
                arg if isinstance(arg, int) else place(arg if literal else ops.constant(arg, like))
                for arg in instr.args
            ]
            args += [place(param) for param in instr.params]
            library = ops.guarded if register in guarded else ops
            code.append((self._kernel(instr, library, switch), tuple(args), register))
        numbers = {name: value for name, value in outputs.items() if isinstance(value, float)}
        arrays = {name: value for name, value in outputs.items() if isinstance(value, int)}
        return _Bound(inputs, code, registers, arrays, numbers)

    def _kernel(self, instr: Instr, ops: Ops, switch: Switch) -> Callable[..., Any]:
        match instr.kernel:
            case "indicator":
                return partial(switch.indicator, ops=ops)
            case "blend":
                return partial(switch.blend, ops=ops)
            case "settle":
                return partial(switch.settle, ops=ops)
            case "extern":
                (given,) = instr.params
                function: Any = self._externs[given] if isinstance(given, str) else given
                return lambda *args: function(*args[:-1])
            case "pick":
                return operator.getitem
            case name:
                return getattr(ops, name)  # type: ignore[no-any-return]


@dataclass(frozen=True, slots=True)
class _Bound:
    """Tape (list of operations) bound to the functions of an array library, ready to run.

    A register is a numbered place in memory. It holds an input, a constant, or the result of an operation.

    Attributes:
        inputs: (name of an input, register that receives this input) pairs.
        code: operations in order, as (function, registers of the operands, register of the result).
        registers: contents of all registers at the start of a run: the constants, and None elsewhere.
        arrays: name of an output -> register with its value.
        numbers: name of a constant output -> its value.
    """

    inputs: list[tuple[str, int]]
    code: list[tuple[Callable[..., Any], tuple[int, ...], int]]
    registers: list[Any]
    arrays: dict[str, int]
    numbers: dict[str, float]

    def run_in_blocks(self, env: Mapping[str, Array], ops: Ops, size: int) -> dict[str, Array]:
        """Run on blocks of `size` rows along axis 0, if all arrays have the same shape."""
        whole = {name: value for name, value in env.items() if isinstance(value, (int, float))}
        arrays = {name: env[name] for name, _ in self.inputs if name not in whole}
        shapes = {tuple(array.shape) for array in arrays.values()}
        if len(shapes) != 1 or not (shape := shapes.pop()):
            return self.run(env, ops)
        parts = [
            self.run(whole | {name: value[first : first + size] for name, value in arrays.items()}, ops)
            for first in range(0, shape[0], size)
        ]
        return {name: ops.cat([part[name] for part in parts]) for name in parts[0]}

    def run(self, env: Mapping[str, Array], ops: Ops) -> dict[str, Array]:
        """Run on the arrays `env`; return the outputs by name."""
        registers = self.registers.copy()
        for name, register in self.inputs:
            value = env[name]
            constant = isinstance(value, (int, float))
            registers[register] = ops.full((), float(value), _first(env)) if constant else value
        for kernel, args, register in self.code:
            registers[register] = kernel(*[registers[arg] for arg in args])
        out = {name: registers[register] for name, register in self.arrays.items()}
        for name, number in self.numbers.items():
            like = _first(env)
            out[name] = ops.full(tuple(like.shape), number, like)
        return out


def _first(env: Mapping[str, Array]) -> Array:
    for value in env.values():
        if not isinstance(value, (int, float)):
            return value
    raise ValueError("no array is given")


def _needed(tape: GradientTape, outputs: Any) -> list[int]:
    """Registers of `tape` that must be computed to obtain `outputs`, in ascending order.

    An int in `outputs` is a register. A float is a constant, which needs no computation.
    """
    wanted: set[int] = set()
    stack = [value for value in outputs if isinstance(value, int)]
    while stack:
        register = stack.pop()
        if register not in wanted:
            wanted.add(register)
            stack.extend(arg for arg in tape.code[register].args if isinstance(arg, int))
    return sorted(wanted)


class _TapeWriter(NumberEvaluator[Operand]):
    """Writer that appends the operations of expressions and conditions to a tape.

    A condition is a formula without temporal operators. If `exact`, a condition becomes a mask of booleans.
    Otherwise it becomes a soft weight between 0 (false) and 1 (true), computed from its robustness.
    """

    def __init__(self, constants: Mapping[str, float], *, exact: bool) -> None:
        super().__init__()
        self.tape = GradientTape()
        self._constants = constants
        self._exact = exact

    def _constant(self, value: float) -> Operand:
        return float(value)

    def _leaf(self, num: Leaf) -> Operand:
        if isinstance(num, ir.Extern):
            if isinstance(num.function, ir.Body):
                inner = self.inlined(num.function, [self.number(arg) for arg in num.args])
                return inner.number(num.function.outputs[num.output])
            whole = self.tape.emit("extern", *map(self.number, num.args), params=(num.function or num.name,))
            return self.tape.emit("pick", whole, params=(num.output,))
        if isinstance(num, ir.Signal):
            known = self.bound.get(num.name, self._constants.get(num.name))
            if known is not None:
                return known
        return self.tape.emit("input", params=(_key_of(num),))

    def _function(self, name: str, args: list[Operand]) -> Operand:
        function = FUNCTIONS[name]
        if function.array is None:
            return self.tape.call(name, *args)
        written: Operand = function.array(self.tape, *args)
        return written

    # ------------------------------------------------------------- conditions

    def _indicator(self, cond: ir.Formula, sharpness: float | None) -> Operand:
        if self._exact:
            mask = self._truth(cond)
            return float(mask) if isinstance(mask, bool) else self.tape.number(mask)
        return self._weight(cond, sharpness)

    def _choice(self, cond: ir.Formula, yes: Operand, no: Operand) -> Operand:
        if type(yes) is type(no) and yes == no:
            return yes
        if isinstance(yes, float) and isinstance(no, float) and math.isfinite(yes - no):
            return self.tape.add(self.tape.mul(self._indicator(cond, None), yes - no), no)
        choice = self._truth(cond) if self._exact else self._weight(cond, None)
        if isinstance(choice, (bool, float)):
            return yes if choice else no
        return self.tape.emit("where" if self._exact else "blend", choice, yes, no)

    def _truth(self, cond: ir.Formula) -> int | bool:
        """Return the register of the mask that is True where the condition `cond` holds.

        If `cond` is always true or always false, the truth value itself is returned. `cond` is a formula
        without temporal operators. A margin of exactly 0 satisfies `>=`, but not `>`.
        """
        match cond:
            case ir.Truth(value):
                return value
            case ir.Predicate(num, sign, strict):
                margin = self.number(num)
                return self.tape.compare(margin if sign > 0 else self.tape.neg(margin), strict)
            case ir.BoolOp(op, items):
                return self._combine(op, [self._truth(item) for item in items])
            case _:
                raise TypeError(f"not a state formula: {type(cond).__name__}")

    def _combine(self, op: str, masks: Sequence[int | bool]) -> int | bool:
        absorbing = op == "or"
        if any(mask is absorbing for mask in masks):
            return absorbing
        registers = [mask for mask in masks if not isinstance(mask, bool)]
        if not registers:
            return not absorbing
        kernel = "either" if op == "or" else "both"
        return reduce(lambda a, b: a if a == b else self.tape.emit(kernel, a, b), registers)

    def _weight(self, cond: ir.Formula, sharpness: float | None) -> Operand:
        """Return the register of the soft weight of the condition `cond`, a number between 0 and 1.

        If the weight is constant, its value is returned instead. A `Switch` computes the weight from the
        margin (robustness) of `cond`, for instance as `(1 + tanh(sharpness * margin)) / 2`. If `sharpness` is
        None, the default of the switch is used.

        Where the margin is 0, a condition that contains both `>` and `>=` may be true or false. For such a
        condition the exact truth is computed as well, and `Switch.settle` corrects the weight.
        """
        kinds = _strictness(cond)
        margin = self.margin(cond)
        truth = self._truth(cond) if len(kinds) > 1 else None
        if isinstance(margin, float):
            known = truth if isinstance(truth, bool) else (margin > 0 if True in kinds else margin >= 0)
            return float(known)
        weight = self.tape.emit("indicator", margin, params=(True in kinds, sharpness))
        if truth is None:
            return weight
        return self.tape.emit("settle", weight, float(truth) if isinstance(truth, bool) else truth)


def _strictness(cond: ir.Formula) -> set[bool]:
    match cond:
        case ir.Predicate(_, _, strict):
            return {strict}
        case ir.BoolOp(_, items):
            return set().union(*map(_strictness, items))
        case _:
            return set()


# ------------------------------------------------------------------------- inputs


def inputs(program: ArrayProgram, env: Mapping[str, Array], run: IndexRange, ops: Ops) -> Mapping[str, Array]:
    """Return the arrays that `program` reads at the instants `run`: name -> array `(run.count, batch)`.

    If the program reads no signal, the result contains an arbitrary signal, since the constant outputs of the
    program take their shape from it.

    Args:
        program: program whose inputs are read.
        env: signal name -> all samples, `(time, batch)`.
        run: instants within the trace. Every sample that `program` needs at these instants must exist.
        ops: the array library of `env`.
    """
    if program.plain and run.start == 0 and run.count == len(next(iter(env.values()))):
        return env

    def read(name: str) -> Array:
        if name == ir.ELAPSED:
            return ops.counted(run.start, run.count, next(iter(env.values())))
        if name not in program.shifted:
            return _rows(env[name], run.start, run.count)
        # a read before the first sample gives the first sample, a read after the last gives the last
        at = program.shifted[name]
        column, start, count = env[at.name], run.start + at.steps, run.count
        samples = len(column)
        before, after = min(max(-start, 0), count), min(max(start + count - samples, 0), count)
        if not before and not after:
            return _rows(column, start, count)
        inside = [column[max(start, 0) : min(start + count, samples)]] if before + after < count else []
        return ops.cat([*[column[:1]] * before, *inside, *[column[-1:]] * after])

    return {name: read(name) for name in program.columns or list(env)[:1]}


def _rows(column: Array, start: int, count: int) -> Array:
    return column if start == 0 and len(column) == count else column[start : start + count]


def _key_of(leaf: ir.Signal | ir.ShiftedSignal | ir.FrozenVar) -> str:
    """Return the name of the input of a compiled program that provides a signal or a frozen value.

    A shifted signal is an input of its own; the name of this input contains the number of steps.
    """
    if isinstance(leaf, ir.ShiftedSignal):
        return f"{leaf.name}\0{leaf.steps}{'!' * leaf.clamped}"
    return leaf.name
