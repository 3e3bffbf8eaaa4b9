"""Local search over plans in C: each generation perturbs the best plan and keeps the best candidate.

The code is appended to the source of `emit` and calls its functions `rollout` and `check` (robustness).
Each initial state has its own random stream, so the result does not depend on the number of threads.
"""

from __future__ import annotations

LOCAL_SEARCH = """
/* Random numbers: splitmix64 (Steele, Lea & Flood, 2014); a normal one is the sum of four uniform ones. */
static inline uint64_t draw(uint64_t *s) {{
  uint64_t z = (*s += 0x9E3779B97F4A7C15ull);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
  return z ^ (z >> 31);
}}
static inline double uniform(uint64_t *s) {{ return (double)(draw(s) >> 11) * 0x1p-53; }}
static inline int below(uint64_t *s, int n) {{ return (int)(((draw(s) >> 32) * (uint64_t)n) >> 32); }}
static inline double normal(uint64_t *s) {{
  const uint64_t z = draw(s);
  const uint64_t sum = (z & 65535) + (z >> 16 & 65535) + (z >> 32 & 65535) + (z >> 48);
  return ((double)sum - 131070.0) * (1.7320508075688772 / 65535.0);
}}
static inline double bounded(double u, double low, double high, int turns) {{
  if (turns) return u - (high - low) * floor((u - low) / (high - low));
  return u < low ? low : u > high ? high : u;
}}

/* One changed plan for one control of lane j: a stretch of time gets noise, a shift or one level. */
static void change(lane *restrict v, int j, int kind, double low, double high, int turns,
                   uint64_t *s) {{
  const double span = high - low, size = span * ldexp(0.5, -below(s, 7));
  const int from = below(s, {steps}), end = from + 1 + below(s, {steps}), to = end < {steps} ? end : {steps};
  const double shift = kind == 1 ? size * normal(s) : 0.0, level = low + span * uniform(s);
  for (int k = from; k < to; ++k) {{
    const double u = kind == 0 ? v[k][j] + size * normal(s) : kind == 1 ? v[k][j] + shift : level;
    v[k][j] = bounded(u, low, high, turns);
  }}
}}

/* Replaces all or the last steps of a plan by those of a plan in the library, or by four random levels if
   the library is empty. */
static void transplant(inputs *restrict v, int j, const double *restrict library, int64_t stored,
                       const double *restrict low, const double *restrict high, uint64_t *s) {{
  if (stored > 0) {{
    const double *from = library + (int64_t)(uniform(s) * (double)stored) * {steps} * {controls};
    const int first = draw(s) & 1 ? 0 : below(s, {steps});
    for (int i = 0; i < {controls}; ++i)
      for (int k = first; k < {steps}; ++k) v[i][k][j] = from[k * {controls} + i];
    return;
  }}
  const int piece = ({steps} + 3) / 4;
  for (int i = 0; i < {controls}; ++i) {{
    double level = 0.0;
    for (int k = 0; k < {steps}; ++k) {{
      if (k % piece == 0) level = low[i] + (high[i] - low[i]) * uniform(s);
      v[i][k][j] = level;
    }}
  }}
}}

/* Improves plans (batch, {steps}, {controls}) in place; rho (batch). Rows from `first` up to `last`.
   1: no memory. bounds: low ({controls}), high ({controls}), turns ({controls}); factors ({rules}), then 1
   for rules of safety ({rules}). Plans are compared by the worst rule. If cycle > 0, this changes after so
   many generations: by the sum over rules of what each lacks, r / (1 + r) or log(1 + r), then by the worst
   rule, and so on. Of plans that violate rules, a safe one with the least sum of logarithms is returned. */
int local_search(int64_t first, int64_t last, const double *x0, double *plans, double *rho,
                 const double *bounds, const double *factors, const double *library, int64_t stored,
                 int generations, double target, uint64_t seed, int cycle) {{
  enum {{ N = {states}, M = {controls}, T = {steps}, R = {rules} }};
  const double UNSAFE = 1e6; /* more than any sum of logarithms */
  const double *low = bounds, *high = bounds + M, *turns = bounds + 2 * M;
  lanes *x = malloc(sizeof(lanes) * N);
  inputs *v = malloc(sizeof(double) * M * T * LANES);
  double *room = malloc(sizeof(double) * {room} * LANES), *now = malloc(sizeof(double) * M * T);
  lane *out = malloc(sizeof(double) * (R + 1) * LANES);
  if (!x || !v || !room || !now || !out) {{ free(x); free(v); free(room); free(now); free(out); return 1; }}
  for (int64_t row = first; row < last; ++row) {{
    uint64_t s = seed ^ (uint64_t)row * 0xD1B54A32D192ED03ull;
    double *plan = plans + row * T * M, most = -INFINITY, best = -INFINITY; /* of all; of the present one */
    memcpy(now, plan, sizeof(double) * M * T);
    for (int i = 0; i < N; ++i) LANE x[i][0][j] = x0[row * N + i];
    for (int g = 0; g < generations && most < target; ++g) {{
      const int begins = cycle ? g % cycle == 0 : g == 0, by = cycle ? (g / cycle + 1) % 3 : 0;
      if (begins) best = -INFINITY;
      for (int i = 0; i < M; ++i) for (int k = 0; k < T; ++k) LANE v[i][k][j] = now[k * M + i];
      for (int j = begins; j < LANES; ++j) {{
        const int kind = j % 4;
        if (kind == 3) {{ transplant(v, j, library, stored, low, high, &s); continue; }}
        const int only = M > 1 && (draw(&s) & 1) ? below(&s, M) : -1;
        for (int i = 0; i < M; ++i)
          if (only < 0 || only == i) change(v[i], j, kind, low[i], high[i], turns[i] > 0.0, &s);
      }}
      double bad[LANES] = {{0}};
      rollout(x, (const inputs *)v, bad);
      check(x, room, bad, out);
      int which = -1, top = -1;
      for (int j = 0; j < LANES; ++j) {{
        double value = INFINITY, safe = INFINITY, shares = 0.0, lack = 0.0;
        for (int i = 0; i < R; ++i) {{
          const double part = weighed(out[i][j], factors[i]), miss = part < 0.0 ? MIN(-part, 1e9) : 0.0;
          value = MIN(value, part);
          if (!cycle) continue;
          if (factors[R + i] > 0.0) safe = MIN(safe, part);
          shares += miss / (1.0 + miss);
          lack += log1p(miss);
        }}
        if (bad[j] > 0.0 || isnan(value)) continue;
        const double all = !cycle || value >= 0.0 ? value : safe >= 0.0 ? -lack : -UNSAFE - lack;
        if (all > most) {{ most = all; top = j; }}
        if (by && value < 0.0) value = by == 1 ? -shares : -lack;
        if (value > best) {{ best = value; which = j; }}
        if (g == 0 && most >= target) break; /* the plan itself */
      }}
      if (top >= 0) for (int i = 0; i < M; ++i) for (int k = 0; k < T; ++k) plan[k * M + i] = v[i][k][top];
      if (which >= 0) for (int i = 0; i < M; ++i) for (int k = 0; k < T; ++k) now[k * M + i] = v[i][k][which];
    }}
    rho[row] = most;
  }}
  free(x); free(v); free(room); free(now); free(out);
  return 0;
}}
"""
