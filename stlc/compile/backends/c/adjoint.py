"""C code for the gradient of robustness and states with respect to plans (control sequences).

First the states and the robustness are computed (by the code of the module `emit`). Then the gradient is
computed in reverse: through the formulas back to the states, and through the steps of the system back to the
controls. Minimum and maximum are exact, and the first of equal operands gets the gradient. The code works on
sixteen trajectories at a time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from stlc.compile.backends.c.emit import HEAD, Motion, along_roots, passes, place_in_step, state_index
from stlc.compile.backends.c.parts import Frame, declared, in_parts
from stlc.compile.backends.c.plan import plan_of
from stlc.compile.backends.c.printer import StepPrinter
from stlc.compile.backends.c.slopes import SlopeWriter
from stlc.compile.backends.schedule import End
from stlc.compile.ir import nodes as ir

_BUMP = """
/* e^x for x <= 0, to the last digits, in a form that vectorises. */
static inline double decay(double x) {
  const double at = x < -700.0 ? -700.0 : x;
  const double n = rint(at * 1.4426950408889634);
  const double r = (at - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10;
  double p = 1.0 / 6227020800.0;
  const double c[] = {1.0 / 479001600.0, 1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0,
                      1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0};
  for (int i = 0; i < 13; ++i) p = p * r + c[i];
  union { int64_t bits; double value; } power;
  power.bits = ((int64_t)n + 1023) << 52;
  return p * power.value;
}
/* x, or 0 where it is infinite or NaN, as in a branch that is not taken. */
static inline double finite(double x) { return fabs(x) < INFINITY ? x : 0.0; }
/* Slope of (1 + tanh(slope z)) / 2. */
static inline double bump(double z, double slope) {
  const double e = decay(-2.0 * slope * fabs(z));
  return 2.0 * slope * e / ((1.0 + e) * (1.0 + e));
}
"""


def emit_adjoint(
    motion: Motion,
    formulas: Sequence[ir.Formula],
    *,
    fixed: Collection[str] = (),
    end: End = "strict",
) -> str:
    """Return the C source of the function `pull`, which computes the gradient.

    `stlc.controller.problem.kernel` describes its signature.

    Args:
        motion: one step of the system.
        formulas: the requirements.
        fixed: names of states whose next value is treated as a constant: no gradient passes through it.
        end: treatment of windows that extend beyond the end of a plan.

    Raises:
        Untranslatable: the IR has a node without a C form.
    """
    plan = plan_of(formulas, motion.steps + 1, end)
    printer = StepPrinter(plan, state_index(motion))
    blocks = [along_roots(plan, "LANE g{value} += g[{i}][j];")]
    blocks += [printer.backward([step]) for step in reversed(plan.schedule.steps)]
    states, controls, steps = len(motion.states), len(motion.controls), motion.steps
    return "\n".join(
        [
            HEAD,
            _BUMP,
            *passes(motion, plan),
            *in_parts(CHECK_ADJOINT, blocks, declared(plan) | declared(plan, room="adjoint", prefix="g")),
            "static void rollout_adjoint(const lanes *restrict x, const inputs *restrict u,",
            "                            lanes *restrict gx, inputs *restrict gu, double slope) {",
            f"  for (int k = {steps} - 1; k >= 0; --k) LANE {{",
            *(f"    {line}" for line in _step_back(motion, fixed)),
            "  }",
            "}",
            _PULL.format(
                states=states, controls=controls, steps=steps, rules=len(formulas), room=max(plan.size, 1)
            ),
        ]
    )


def _step_back(motion: Motion, fixed: Collection[str]) -> list[str]:
    """C code that propagates the gradient one step back in time.

    The gradient with respect to the states at sample k + 1 is passed to the states and controls at sample k.
    Several trajectories are computed side by side; the code is for one of them, number `j`. The next value of
    a state in `fixed` is treated as a constant: no gradient passes through it.
    """
    index = state_index(motion)
    writer = SlopeWriter(place_in_step(motion), soft=True)
    for name, num in motion.lets:
        writer.bound[name] = writer.number(num)
    outputs = [
        (num, f"gx[{index[name]}][k + 1][j]") for name, num in motion.next.items() if name not in fixed
    ]
    still = [f"gx[{i}][k][j] += gx[{i}][k + 1][j];" for name, i in index.items() if name not in motion.next]
    return [*writer.gradients(outputs), *still]


CHECK_ADJOINT = Frame(
    "check_adjoint",
    (
        "const lanes *restrict x",
        "double *restrict room",
        "double *restrict adjoint",
        "const lane *restrict g",
        "lanes *restrict gx",
    ),
    ("double bad[LANES] = {0}; (void)bad;",),
)

_PULL = """
/* Gradient of sum(g_rho * rho) + sum(g_columns * columns) by u: x0 (batch, {states}), u and gu
   (batch, {steps}, {controls}), g_rho (batch, {rules}), g_columns ({states}, {steps} + 1, batch) or NULL.
   and by x0 into g_x0 (batch, {states}) unless that is NULL. Rows from `first` up to `last`; 0 where the
   dynamics give NaN. 1: no memory. */
int pull(int64_t batch, int64_t first, int64_t last, const double *x0, const double *u, const double *g_rho,
         const double *g_columns, double *g_u, double slope, double *g_x0) {{
  enum {{ N = {states}, M = {controls}, T = {steps}, R = {rules}, ROOM = {room} }};
  lanes *x = malloc(sizeof(lanes) * N), *gx = malloc(sizeof(lanes) * N);
  inputs *v = malloc(sizeof(double) * (M * T + 1) * LANES);
  inputs *gv = malloc(sizeof(double) * (M * T + 1) * LANES);
  double *room = malloc(sizeof(double) * ROOM * LANES), *adjoint = malloc(sizeof(double) * ROOM * LANES);
  lane *out = malloc(sizeof(double) * (R + 1) * LANES);
  const int failed = !x || !gx || !v || !gv || !room || !adjoint || !out;
  for (int64_t at = first; at < last && !failed; at += LANES) {{
    const int here = last - at < LANES ? (int)(last - at) : LANES;
    for (int j = 0; j < LANES; ++j) {{
      const int64_t row = at + (j < here ? j : 0);
      for (int i = 0; i < N; ++i) x[i][0][j] = x0[row * N + i];
      for (int k = 0; k < T; ++k) for (int i = 0; i < M; ++i) v[i][k][j] = u[(row * T + k) * M + i];
    }}
    double bad[LANES] = {{0}};
    rollout(x, (const inputs *)v, bad);
    check(x, room, bad, out);
    memset(adjoint, 0, sizeof(double) * ROOM * LANES);
    memset(gx, 0, sizeof(lanes) * N);
    memset(gv, 0, sizeof(double) * M * T * LANES);
    for (int i = 0; i < R; ++i) for (int j = 0; j < LANES; ++j)
      out[i][j] = j < here && !(bad[j] > 0.0) ? g_rho[(at + j) * R + i] : 0.0;
    check_adjoint(x, room, adjoint, out, gx);
    if (g_columns)
      for (int i = 0; i < N; ++i) for (int k = 0; k <= T; ++k) for (int j = 0; j < here; ++j)
        gx[i][k][j] += g_columns[((int64_t)i * (T + 1) + k) * batch + at + j];
    rollout_adjoint(x, (const inputs *)v, gx, gv, slope);
    if (g_x0) for (int j = 0; j < here; ++j) for (int i = 0; i < N; ++i)
      g_x0[(at + j) * N + i] = bad[j] > 0.0 ? 0.0 : gx[i][0][j];
    for (int j = 0; j < here; ++j) for (int k = 0; k < T; ++k) for (int i = 0; i < M; ++i)
      g_u[((at + j) * T + k) * M + i] = bad[j] > 0.0 ? 0.0 : gv[i][k][j];
  }}
  free(x); free(gx); free(v); free(gv); free(room); free(adjoint); free(out);
  return failed;
}}
"""
