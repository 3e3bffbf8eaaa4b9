"""C code of one step of a system, with its observation and reward, for many states at once.

Conditions are evaluated exactly. Numbers are double, and `LANES` state vectors are computed at a time.
Observations are written as float32, the type that learning methods read. `feedback.c` repeats the step along
trajectories, with feedback gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from stlc.compile.backends.c.emit import HEAD, Motion, place_in_step, state_index
from stlc.compile.backends.c.numbers import NumberWriter
from stlc.compile.ir import nodes as ir

FEEDBACK = Path(__file__).with_name("feedback.c")


def emit_advance(
    motion: Motion, *, observed: Sequence[ir.Num], reward: ir.Num | None, commands: Mapping[str, ir.Num]
) -> str:
    """Return the C source of steps, observations and feedback along trajectories.

    `stlc.controller.problem.kernel.Advance` calls them.

    Args:
        motion: one step of the system.
        observed: inputs of the policy, as expressions of the states.
        reward: reward of a step, as an expression of the states after the step and the actuator commands of
            the step. None if there is no reward.
        commands: name of a control -> actuator command, as an expression of the states before the step and
            the controls. The actuator of a control that is not listed gets the control itself.

    Raises:
        Untranslatable: the IR has a node without a C form.
    """
    states, controls = len(motion.states), len(motion.controls)
    return "\n".join(
        [
            HEAD,
            "typedef double lane[LANES];",
            *_function(
                "step", "const lane *restrict u, lane *restrict y, lane *restrict c", _step(motion, commands)
            ),
            *_function("see", "lane *restrict y", _numbers(motion, observed)),
            *_function(
                "earn",
                "const lane *restrict u, lane *restrict y",
                _numbers(motion, [ir.Const(0.0) if reward is None else reward]),
            ),
            _DRIVER.format(states=states, controls=max(controls, 1), inputs=controls, seen=len(observed)),
            FEEDBACK.read_text(encoding="utf-8"),
        ]
    )


def _function(name: str, more: str, body: Sequence[str]) -> list[str]:
    head = f"static void {name}(const lane *restrict x, {more}) {{"
    return [head, "  LANE {", *(f"    {line}" for line in body), "  }", "}"]


def _step(motion: Motion, commands: Mapping[str, ir.Num]) -> list[str]:
    """C statements of a time step: they compute the next states and the actuator commands.

    The C arrays `x` and `u` hold the states and the controls. The next states are stored in `y`, the commands
    in `c`.
    """
    index, writer = state_index(motion), NumberWriter(place_in_step(motion, sample=""))
    given = [writer.number(commands.get(name, ir.Signal(name))) for name in motion.controls]
    for name, num in motion.lets:
        writer.bound[name] = writer.number(num)
    after = {name: writer.number(num) for name, num in motion.next.items()}
    moved = [f"y[{i}][j] = {after.get(name, f'x[{i}][j]')};" for name, i in index.items()]
    return [*writer.lines, *moved, *(f"c[{i}][j] = {value};" for i, value in enumerate(given))]


def _numbers(motion: Motion, numbers: Sequence[ir.Num]) -> list[str]:
    """C statements that store the values of the expressions `numbers` in the C array `y`.

    The expressions may read states from the C array `x`, and actuator commands from the C array `u`.
    """
    writer = NumberWriter(place_in_step(motion, sample=""))
    values = [writer.number(num) for num in numbers]
    return [*writer.lines, *(f"y[{i}][j] = {value};" for i, value in enumerate(values))]


_DRIVER = """
enum {{ N = {states}, M = {controls}, INPUTS = {inputs}, K = {seen} }};

static void shown(int64_t at, int here, const lane *restrict y, double share, float *restrict seen) {{
  lane s[K + 1];
  see(y, s);
  for (int j = 0; j < here; ++j) {{
    for (int i = 0; i < K; ++i) seen[(at + j) * (K + 1) + i] = (float)s[i][j];
    seen[(at + j) * (K + 1) + K] = (float)share;
  }}
}}

/* x (batch, {states}), u (batch, {inputs}) -> after (batch, {states}), seen (batch, {seen} + 1) with
   `share` last, reward (batch) where asked for. */
void advance(int64_t batch, const double *restrict from, const double *restrict given, double share,
             double *restrict after, float *restrict seen, double *restrict reward) {{
  lane x[N], y[N], u[M], c[M], r[1];
  for (int64_t at = 0; at < batch; at += LANES) {{
    const int here = batch - at < LANES ? (int)(batch - at) : LANES;
    for (int j = 0; j < LANES; ++j) {{
      const int64_t row = at + (j < here ? j : 0);
      for (int i = 0; i < N; ++i) x[i][j] = from[row * N + i];
      for (int i = 0; i < INPUTS; ++i) u[i][j] = given[row * INPUTS + i];
    }}
    step((const lane *)x, (const lane *)u, y, c);
    for (int j = 0; j < here; ++j) for (int i = 0; i < N; ++i) after[(at + j) * N + i] = y[i][j];
    shown(at, here, (const lane *)y, share, seen);
    if (reward) {{
      earn((const lane *)y, (const lane *)c, r);
      for (int j = 0; j < here; ++j) reward[at + j] = r[0][j];
    }}
  }}
}}

/* x (batch, {states}) -> seen (batch, {seen} + 1) with `share` last. */
void look(int64_t batch, const double *restrict from, double share, float *restrict seen) {{
  lane x[N];
  for (int64_t at = 0; at < batch; at += LANES) {{
    const int here = batch - at < LANES ? (int)(batch - at) : LANES;
    for (int j = 0; j < LANES; ++j)
      for (int i = 0; i < N; ++i) x[i][j] = from[(at + (j < here ? j : 0)) * N + i];
    shown(at, here, (const lane *)x, share, seen);
  }}
}}
"""
