"""C code of dynamics and requirements: rollout, exact robustness, and NaN check.

The code is made from the same IR as the torch graph. Conditions are evaluated exactly. Numbers are double,
and `LANES` trajectories are computed at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from stlc.compile.backends.c.local_search import LOCAL_SEARCH
from stlc.compile.backends.c.numbers import NumberWriter
from stlc.compile.backends.c.parts import Frame, declared, in_parts
from stlc.compile.backends.c.plan import Plan, Storage, plan_of
from stlc.compile.backends.c.printer import StepPrinter
from stlc.compile.backends.numbers import Leaf
from stlc.compile.backends.schedule import End
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE

LANES = 16

HEAD = f"""
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* The vector forms of the GNU C library, where the build links them. */
#if defined(VECTOR_MATH) && defined(__GNUC__) && !defined(__clang__)
#define VECTOR(f) __attribute__((simd("notinbranch"), const)) double f(double);
VECTOR(sin) VECTOR(cos) VECTOR(exp) VECTOR(log)
#endif

#define LANES {LANES}
#define LANE for (int j = 0; j < LANES; ++j)
#define MIN(a, b) ((b) < (a) ? (b) : (a)) /* a where it is NaN */
#define MAX(a, b) ((b) > (a) ? (b) : (a))
#if defined(__GNUC__)
#define APART __attribute__((noinline))
#else
#define APART
#endif
#define LATER(a, b) ((a) > (b) ? (a) : (b))
#define LEAST(a, b) (MIN(a, b) + ((b) != (b) ? (b) : 0.0)) /* NaN where either is; loops vectorise */
#define MOST(a, b) (MAX(a, b) + ((b) != (b) ? (b) : 0.0))
#define NAN_IN(a) ((double)((a) != (a)))
#define STLC_TOLERANCE {TOLERANCE!r}

static inline int satisfied(double rho) {{ return rho >= -STLC_TOLERANCE; }}

/* Robustness times weight / scale, at least -STLC_TOLERANCE where it is itself: `weighed` in Python. */
static inline double weighed(double rho, double factor) {{
  if (factor == 1.0) return rho;
  return satisfied(rho) ? MAX(rho * factor, -STLC_TOLERANCE)
                        : (rho + STLC_TOLERANCE) * factor - STLC_TOLERANCE;
}}

static inline double floored_mod(double a, double b) {{
  const double r = fmod(a, b); /* exact, unlike a - b * floor(a / b) where a / b rounds up */
  return r != 0.0 && (r < 0.0) != (b < 0.0) ? r + b : r;
}}
"""


@dataclass(frozen=True, slots=True)
class Motion:
    """One step of a system as straight-line code: expressions of states, controls and intermediate variables.

    Attributes:
        states: names of the states, in order.
        controls: names of the controls, in order.
        lets: intermediate variables as (name, expression), in order.
        next: state name -> expression of its value one step later; states that do not change are absent.
        steps: number of steps of a plan.
        dt: time step in seconds.
    """

    states: tuple[str, ...]
    controls: tuple[str, ...]
    lets: tuple[tuple[str, ir.Num], ...]
    next: Mapping[str, ir.Num]
    steps: int
    dt: float


def emit(motion: Motion, formulas: Sequence[ir.Formula], end: End = "strict") -> str:
    """Return the C source of the functions `judge` (robustness) and `local_search`.

    `stlc.controller.problem.kernel` describes these functions. With `end` "truncate", windows are cut at the
    end of the plan.

    Raises:
        Untranslatable: the IR has a node without a C form.
    """
    plan = plan_of(formulas, motion.steps + 1, end)
    states, rules, steps = len(motion.states), len(formulas), motion.steps
    read = {leaf.name for formula in formulas for leaf in formula.leaves() if not isinstance(leaf, ir.Const)}
    moving = ", ".join(str(int(name in motion.next)) for name in motion.states)
    return "\n".join(
        [
            HEAD,
            f"static const int MOVING[] = {{{moving}}};",
            *passes(motion, plan, read),
            (_DRIVER + LOCAL_SEARCH).format(
                states=states,
                controls=len(motion.controls),
                steps=steps,
                rules=rules,
                room=max(plan.size, 1),
            ),
        ]
    )


def state_index(motion: Motion) -> dict[str, int]:
    """Return state name -> index of the state in the array of trajectories."""
    return {name: i for i, name in enumerate(motion.states)}


def passes(motion: Motion, plan: Plan, read: Collection[str] | None = None) -> list[str]:
    """Return the lines of the C functions `rollout` (computes states) and `check` (computes robustness).

    States that do not change are copied from the first sample to all others, or only those in `read`.
    """
    blocks = forward_blocks(plan, state_index(motion))
    return [
        "typedef double lane[LANES];",
        f"typedef double lanes[{motion.steps + 1}][LANES];",
        f"typedef double inputs[{motion.steps}][LANES];",
        "static void rollout(lanes *restrict x, const inputs *restrict u, double *restrict bad) {",
        f"  for (int k = 0; k < {motion.steps}; ++k) LANE {{",
        *(f"    {line}" for line in _step(motion)),
        "  }",
        *(
            f"  for (int k = 0; k < {motion.steps}; ++k) LANE x[{i}][k + 1][j] = x[{i}][0][j];"
            for name, i in state_index(motion).items()
            if name not in motion.next and (read is None or name in read)
        ),
        "}",
        *in_parts(CHECK, blocks, declared(plan)),
    ]


def forward_blocks(plan: Plan, index: Mapping[str, int]) -> list[list[str]]:
    """Return blocks of C statements that compute all sub-formulas, then store the formulas' robustness.

    `plan` is the list of the sub-formulas with their memory. `index` maps the name of a state to its index in
    the array of trajectories.
    """
    printer = StepPrinter(plan, index)
    roots = along_roots(plan, "LANE out[{i}][j] = {value};")
    return [*(printer.forward([step]) for step in plan.schedule.steps), roots]


def along_roots(plan: Plan, form: str) -> list[str]:
    """Return the C statements that result from the template `form` for all requirements.

    In `form`, `{i}` stands for the index of a requirement and `{value}` for the C expression of its
    robustness. An example is `LANE out[{i}][j] = {value};`.
    """
    lines = []
    for first, root, rows in _side_by_side(plan):
        if rows == 1:
            lines.append(form.format(i=first, value=root.buffer[str(root.row)]))
        else:
            text = form.format(i=f"{first} + i", value=root.buffer[f"{root.row} + i"])
            lines.append(f"for (int i = 0; i < {rows}; ++i) {text}")
    return lines


def _side_by_side(plan: Plan) -> list[tuple[int, Storage, int]]:
    """Group the requirements whose robustness values are stored in consecutive rows of memory.

    Returns a tuple for each group: the index of its first requirement, the location of the first value, and
    the number of requirements.
    """
    runs: list[tuple[int, Storage, int]] = []
    for i, root in enumerate(plan.roots):
        if runs and root == Storage(runs[-1][1].buffer, runs[-1][1].row + runs[-1][2]):
            runs[-1] = (*runs[-1][:2], runs[-1][2] + 1)
        else:
            runs.append((i, root, 1))
    return runs


CHECK = Frame(
    "check",
    (
        "const lanes *restrict x",
        "double *restrict room",
        "double *restrict bad",
        "lane *restrict out",
    ),
)


def place_in_step(
    motion: Motion, *, first: frozenset[str] = frozenset(), sample: str = "[k]"
) -> Callable[[Leaf], str | None]:
    """Return the function that maps a state or control to its C expression in a step.

    The C expression is for sample `k` and trajectory `j`; for the states in `first`, it is for the first
    sample. With `sample` = "", the arrays hold a single sample. For anything but a state or control, such as
    a function call, the returned function gives None.
    """
    index = state_index(motion)

    def place(leaf: Leaf) -> str | None:
        if not isinstance(leaf, ir.Signal):
            return None
        if leaf.name in index:
            return f"x[{index[leaf.name]}]{'[0]' if leaf.name in first else sample}[j]"
        return f"u[{motion.controls.index(leaf.name)}]{sample}[j]"

    return place


def _step(motion: Motion) -> list[str]:
    """C code of a step of one trajectory: from sample k to sample k + 1.

    States that do not change are read at the first sample; they are copied to the others later.
    """
    index = state_index(motion)
    writer = NumberWriter(place_in_step(motion, first=frozenset(index) - motion.next.keys()))
    for name, num in motion.lets:
        writer.bound[name] = writer.number(num)
    after = {name: writer.number(num) for name, num in motion.next.items()}
    moved = [
        f"x[{index[name]}][k + 1][j] = {value}; bad[j] += NAN_IN({value});" for name, value in after.items()
    ]
    return [*writer.lines, *moved]


_DRIVER = """
/* x0 (batch, {states}), u (batch, {steps}, {controls}) -> rho (batch, {rules}); columns
   ({states}, {steps} + 1, batch) where asked for. Rows from `first` up to `last`. 1: no memory. */
int judge(int64_t batch, int64_t first, int64_t last, const double *x0, const double *u, double *rho,
          double *columns) {{
  enum {{ N = {states}, M = {controls}, T = {steps}, R = {rules} }};
  lanes *x = malloc(sizeof(lanes) * N);
  inputs *v = malloc(sizeof(double) * (M * T + 1) * LANES);
  double *room = malloc(sizeof(double) * {room} * LANES);
  lane *out = malloc(sizeof(double) * (R + 1) * LANES);
  if (!x || !v || !room || !out) {{ free(x); free(v); free(room); free(out); return 1; }}
  for (int64_t at = first; at < last; at += LANES) {{
    const int here = last - at < LANES ? (int)(last - at) : LANES;
    for (int j = 0; j < LANES; ++j) {{
      const int64_t row = at + (j < here ? j : 0);
      for (int i = 0; i < N; ++i) x[i][0][j] = x0[row * N + i];
      for (int k = 0; k < T; ++k) for (int i = 0; i < M; ++i) v[i][k][j] = u[(row * T + k) * M + i];
    }}
    double bad[LANES] = {{0}};
    rollout(x, (const inputs *)v, bad);
    check(x, room, bad, out);
    for (int j = 0; j < here; ++j) for (int i = 0; i < R; ++i)
      rho[(at + j) * R + i] = bad[j] > 0.0 ? NAN : out[i][j];
    if (columns)
      for (int i = 0; i < N; ++i) for (int k = 0; k <= T; ++k) for (int j = 0; j < here; ++j)
        columns[((int64_t)i * (T + 1) + k) * batch + at + j] = x[i][MOVING[i] ? k : 0][j];
  }}
  free(x); free(v); free(room); free(out);
  return 0;
}}
"""
