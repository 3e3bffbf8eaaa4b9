"""Dynamics and requirements -> C that differentiates robustness and states by plans.

Reverse mode through the exact minima and maxima (the first of equal ones gets the gradient) and through the
steps of the system, sixteen trajectories at a time. The forward pass is that of `emit_c`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from stlc.compile import ir
from stlc.compile.c_formulas import FormulaWriter, over
from stlc.compile.c_numbers import Untranslatable
from stlc.compile.c_slopes import SlopeWriter
from stlc.compile.emit_c import HEAD, Motion, passes, state_column

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
/* Slope of (1 + tanh(slope z)) / 2. */
static inline double bump(double z, double slope) {
  const double e = decay(-2.0 * slope * fabs(z));
  return 2.0 * slope * e / ((1.0 + e) * (1.0 + e));
}
"""


def emit_adjoint(motion: Motion, formulas: Sequence[ir.Formula], *, fixed: Collection[str] = ()) -> str:
    """The C text of `pull`; see `stlc.native` for its signature.

    Args:
        motion: one step of the system.
        formulas: the requirements.
        fixed: states that no gradient goes through on their way through time.

    Raises:
        Untranslatable: the IR holds something that has no C form.
    """
    checks = FormulaAdjoint(motion.steps + 1, state_column(motion))
    values = [checks.value(formula) for formula in formulas]
    states, controls, steps = len(motion.states), len(motion.controls), motion.steps
    return "\n".join(
        [
            HEAD,
            _BUMP,
            *passes(motion, checks, values),
            "static void uncheck(const lanes *restrict x, double *restrict room, double *restrict adjoint,",
            "                    double (*restrict g)[LANES], lanes *restrict gx, double slope) {",
            *(f"  {line}" for line in checks.declarations()),
            *(f"  LANE a{value}[0][j] += g[{i}][j];" for i, value in enumerate(values)),
            *(f"  {line}" for block in reversed(checks.back) for line in block),
            "}",
            f"static void unroll(const lanes *restrict x, const double (*restrict u)[{steps}][LANES],",
            f"                   lanes *restrict gx, double (*restrict gu)[{steps}][LANES], double slope) {{",
            f"  for (int k = {steps} - 1; k >= 0; --k) LANE {{",
            *(f"    {line}" for line in _step_back(motion, fixed)),
            "  }",
            "}",
            _PULL.format(
                states=states, controls=controls, steps=steps, rules=len(formulas), room=max(checks.size, 1)
            ),
        ]
    )


def _step_back(motion: Motion, fixed: Collection[str]) -> list[str]:
    """The gradient by sample k + 1 taken to sample k and to the controls, one lane."""
    index = {name: i for i, name in enumerate(motion.states)}

    def column(name: str) -> str:
        if name in index:
            return f"x[{index[name]}][k][j]"
        return f"u[{motion.controls.index(name)}][k][j]"

    writer = SlopeWriter(column, soft=True)
    for name, num in motion.lets:
        writer.assign(name, writer.number(num))
    seeds: dict[str, str] = {}
    for name, num in motion.next.items():
        if name not in fixed:
            register = writer.number(num)
            own = f"gx[{index[name]}][k + 1][j]"
            seeds[register] = f"{seeds[register]} + {own}" if register in seeds else own
    still = [f"gx[{i}][k][j] += gx[{i}][k + 1][j];" for name, i in index.items() if name not in motion.next]
    lines, gathered = writer.backward(seeds)
    return [*writer.lines, *lines, *(f"{place} += {value};" for place, value in gathered.items()), *still]


@dataclass(slots=True)
class FormulaAdjoint(FormulaWriter):
    """Writes formulas, and for each buffer how its gradient reaches the buffers and columns behind it.

    Attributes:
        back: statements per buffer, in the order of the forward pass.
    """

    back: list[list[str]] = field(default_factory=list)

    def declarations(self) -> list[str]:
        """The buffers and their gradients as C names."""
        values = [
            f"const double (*restrict {name})[LANES] = (const double (*)[LANES])(room + {at} * LANES);"
            for name, at in self.buffers
        ]
        gradients = [
            f"double (*restrict a{name})[LANES] = (double (*)[LANES])(adjoint + {at} * LANES);"
            for name, at in self.buffers
        ]
        return values + gradients

    def _value(self, formula: ir.Formula, start: int, count: int) -> str:
        name = FormulaWriter._value(self, formula, start, count)
        self.back.append(self._backward(name, formula, start, count))
        return name

    def _backward(self, name: str, formula: ir.Formula, start: int, count: int) -> list[str]:
        match formula:
            case ir.Truth():
                return []
            case ir.Atom():
                return [] if formula.guard else self._atom_back(name, formula, start, count)
            case ir.Join(_, items):
                return _join_back(name, [self.value(item, start, count) for item in items], count)
            case ir.Over(_, window, body):
                first, last = start + window.lo, self._last(window, start, count)
                inner = self.value(body, first, last - first + 1)
                end = f"{last - first + 1}" if window.hi is None else f"k + {window.hi - window.lo + 1}"
                return _window_back(name, inner, count, end)
            case ir.Until(op, window, left, right):
                span = self._last(window, start, count) - start + 1
                sides = self.value(left, start, span), self.value(right, start, span)
                end = f"{span}" if window.hi is None else f"k + {window.hi + 1}"
                return _until_back(name, sides, (count, window.lo, end), "<" if op == "until" else ">")
            case ir.Past() | ir.Since() | ir.Shift() | ir.Freeze() | ir.AtStart():
                raise Untranslatable(type(formula).__name__)
            case _:
                assert_never(formula)

    def _atom_back(self, name: str, atom: ir.Atom, start: int, count: int) -> list[str]:
        heads: dict[str, str] = {}
        writer = SlopeWriter(
            lambda name: self.column(name, "k"),
            lambda leaf: self._elsewhere(leaf, start, count, heads),
            soft=False,
        )
        margin = writer.number(atom.num)
        own = f"a{name}[s][j]" if atom.sign > 0 else f"-a{name}[s][j]"
        lines, gathered = writer.backward({margin: own})
        # Two indices may be the same sample: gathered apart from the loop that computes, which vectorises so.
        shares = [f"h{i}" for i in range(len(gathered))]
        return [
            over(start, count, heads),
            *(f"double {share}[LANES];" for share in shares),
            "LANE {",
            *writer.lines,
            *lines,
            *(f"{share}[j] = {value};" for share, value in zip(shares, gathered.values(), strict=True)),
            "}",
            *(f"LANE {place} += {share}[j];" for share, place in zip(shares, gathered, strict=True)),
            "}",
        ]


def _join_back(name: str, parts: Sequence[str], count: int) -> list[str]:
    lines = [f"for (int k = 0; k < {count}; ++k) LANE {{", f"double left = a{name}[k][j];"]
    for part in parts:
        lines += [
            f"{{ const int hit = {part}[k][j] == {name}[k][j];",
            f"a{part}[k][j] += hit ? left : 0.0; left = hit ? 0.0 : left; }}",
        ]
    return [*lines, "}"]


def _window_back(name: str, inner: str, count: int, end: str) -> list[str]:
    return [
        f"for (int k = 0; k < {count}; ++k) {{",
        f"double left[LANES]; LANE left[j] = a{name}[k][j];",
        f"for (int i = k; i < {end}; ++i) LANE {{",
        f"const int hit = {inner}[i][j] == {name}[k][j];",
        f"a{inner}[i][j] += hit ? left[j] : 0.0; left[j] = hit ? 0.0 : left[j]; }}",
        "}",
    ]


def _until_back(name: str, sides: tuple[str, str], at: tuple[int, int, str], less: str) -> list[str]:
    """The first instant that gives the value, and there the goal or the earliest worst of what is held."""
    (hold, goal), (count, low, end) = sides, at
    return [
        f"for (int k = 0; k < {count}; ++k) LANE {{",
        f"if (a{name}[k][j] == 0.0) continue;",
        "int worst = k;",
        f"for (int i = k; i < {end}; ++i) {{",
        f"if ({hold}[i][j] {less} {hold}[worst][j]) worst = i;",
        f"const int held = {hold}[worst][j] {less} {goal}[i][j];",
        f"if (i >= k + {low} && (held ? {hold}[worst][j] : {goal}[i][j]) == {name}[k][j]) {{",
        f"if (held) a{hold}[worst][j] += a{name}[k][j]; else a{goal}[i][j] += a{name}[k][j];",
        "break; }",
        "}",
        "}",
    ]


_PULL = """
/* Gradient of sum(g_rho * rho) + sum(g_columns * columns) by u: x0 (batch, {states}), u and gu
   (batch, {steps}, {controls}), g_rho (batch, {rules}), g_columns ({states}, {steps} + 1, batch) or NULL.
   Rows from `first` up to `last`; 0 where the dynamics give NaN. 1: no memory. */
int pull(int64_t batch, int64_t first, int64_t last, const double *x0, const double *u, const double *g_rho,
         const double *g_columns, double *g_u, double slope) {{
  enum {{ N = {states}, M = {controls}, T = {steps}, R = {rules}, ROOM = {room} }};
  lanes *x = malloc(sizeof(lanes) * N), *gx = malloc(sizeof(lanes) * N);
  double (*v)[T][LANES] = malloc(sizeof(double) * M * T * LANES);
  double (*gv)[T][LANES] = malloc(sizeof(double) * M * T * LANES);
  double *room = malloc(sizeof(double) * ROOM * LANES), *adjoint = malloc(sizeof(double) * ROOM * LANES);
  double (*out)[LANES] = malloc(sizeof(double) * (R + 1) * LANES);
  const int failed = !x || !gx || !v || !gv || !room || !adjoint || !out;
  for (int64_t at = first; at < last && !failed; at += LANES) {{
    const int here = last - at < LANES ? (int)(last - at) : LANES;
    for (int j = 0; j < LANES; ++j) {{
      const int64_t row = at + (j < here ? j : 0);
      for (int i = 0; i < N; ++i) x[i][0][j] = x0[row * N + i];
      for (int k = 0; k < T; ++k) for (int i = 0; i < M; ++i) v[i][k][j] = u[(row * T + k) * M + i];
    }}
    double bad[LANES] = {{0}};
    roll(x, (const double (*)[T][LANES])v, bad);
    check(x, room, bad, out);
    memset(adjoint, 0, sizeof(double) * ROOM * LANES);
    memset(gx, 0, sizeof(lanes) * N);
    memset(gv, 0, sizeof(double) * M * T * LANES);
    for (int i = 0; i < R; ++i) for (int j = 0; j < LANES; ++j)
      out[i][j] = j < here && !(bad[j] > 0.0) ? g_rho[(at + j) * R + i] : 0.0;
    uncheck(x, room, adjoint, out, gx, slope);
    if (g_columns)
      for (int i = 0; i < N; ++i) for (int k = 0; k <= T; ++k) for (int j = 0; j < here; ++j)
        gx[i][k][j] += g_columns[((int64_t)i * (T + 1) + k) * batch + at + j];
    unroll(x, (const double (*)[T][LANES])v, gx, gv, slope);
    for (int j = 0; j < here; ++j) for (int k = 0; k < T; ++k) for (int i = 0; i < M; ++i)
      g_u[((at + j) * T + k) * M + i] = bad[j] > 0.0 ? 0.0 : gv[i][k][j];
  }}
  free(x); free(gx); free(v); free(gv); free(room); free(adjoint); free(out);
  return failed;
}}
"""
