"""A model as a graph: the steps of a plan, one after the other, and together where nothing feeds back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from stlc.compile.backends.array.arith import Program
from stlc.compile.backends.array.unrolled import Columns, require_numbers
from stlc.compile.backends.onnx.ops import ONNX
from stlc.compile.backends.onnx.sheet import BATCH, Sheet, Value
from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.algebra import names_in
from stlc.dynamics.model.schedule import RolloutStage, schedule
from stlc.dynamics.model.step import Step


def rolled(step: Step, start: Mapping[str, Value], controls: Mapping[str, Value]) -> Columns:
    """The states under a plan, exact switching.

    Args:
        step: one step of the system.
        start: states, (1, batch) each.
        controls: (steps, batch) each.

    Returns:
        The states, (steps + 1, batch) each.

    Raises:
        Untranslatable: the step calls a function of Python.
    """
    require_numbers([*(num for _, num in step.lets), *step.next.values()])
    steps = len(next(iter(controls.values())))
    film = _Film(start, controls, step.next.keys(), steps)
    for stage in schedule(step):
        film.run(stage)
    still = {name: value.spread(steps + 1, value.shape[1]) for name, value in start.items()}
    return still | film.states


class _Film:
    """What is known so far: the states that move, and numbers at all steps or, in one row, at each."""

    def __init__(
        self, start: Mapping[str, Value], controls: Mapping[str, Value], moving: Iterable[str], steps: int
    ) -> None:
        self.start, self.steps = start, steps
        self.states: Columns = {}
        moving = frozenset(moving)
        self.now: Columns = {name: value for name, value in start.items() if name not in moving}
        self.now |= controls

    def run(self, stage: RolloutStage) -> None:
        """A stage whose inputs are known."""
        if stage.early:
            self.now.update(Program(stage.early)(self.now, ONNX))
        for state, source in stage.follows.items():
            self._enter(state, ONNX.cat([self.start[state], self._full(source)]))
        for state, source in stage.sums.items():
            parts = ONNX.cat([self.start[state], self._full(source)])
            axis = parts.sheet.constant(0, "int64")
            (total,) = parts.sheet.emit("CumSum", (parts, axis), [parts.shape], parts.kind)
            self._enter(state, total)
        if stage.blocks:
            self._loop(stage)

    def _enter(self, name: str, column: Value) -> None:
        self.states[name] = column
        self.now[name] = column[:-1]

    def _full(self, name: str) -> Value:
        value = self.now[name]
        return value.spread(self.steps, value.shape[1])

    def _loop(self, stage: RolloutStage) -> None:
        """Step what feeds back into itself."""
        inside = stage.stepped.keys() | {name for block in stage.blocks for name in block}
        read = {name for block in stage.blocks for num in block.values() for name in names_in(num)}
        outside = sorted(read - inside)
        timed = [name for name in outside if len(self.now[name]) == self.steps]
        steady = [name for name in outside if name not in timed]
        blocks = [Program(block) for block in stage.blocks]
        moving, sources = list(stage.stepped), list(stage.stepped.values())
        kept = list(dict.fromkeys((*sources, *stage.lets)))

        def turn(
            sheet: Sheet, now: Sequence[Value], rows: Sequence[Value]
        ) -> tuple[Sequence[Value], Sequence[Value]]:
            env = {name: self.now[name].on(sheet) for name in steady}
            env |= dict(zip(timed, rows, strict=False))
            env |= dict(zip(moving, now, strict=True))
            for block in blocks:
                env.update(block(env, ONNX))
            later = [env[name].spread(1, BATCH, like=now[0]) for name in sources]
            return later, [env[name] for name in kept]

        carried = [self.start[name] for name in moving]
        rows = [self.now[name] for name in timed] or [
            carried[0].sheet.constant([[float(k)] for k in range(self.steps)])
        ]
        seen = carried[0].sheet.repeated(carried, rows, turn)
        history = dict(zip(kept, seen, strict=True))
        for state, source in stage.stepped.items():
            self._enter(state, ONNX.cat([self.start[state], history[source]]))
        self.now.update((name, history[name]) for name in stage.lets)


def assigned(numbers: Mapping[str, ir.Num], columns: Mapping[str, Value]) -> Columns:
    """Numbers that follow from columns, which broadcast against them.

    Raises:
        Untranslatable: one calls a function of Python.
    """
    require_numbers(list(numbers.values()))
    return Program(dict(numbers))(columns, ONNX) if numbers else {}
