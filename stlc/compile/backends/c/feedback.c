/* Solve a quadratic problem along the trajectory of each plan, and follow the solution with its feedback
   gains. Definitions of `step`, `lane`, LANES, N (states), M and INPUTS (controls) come before this text.

   Row-major arrays: n of the states move, `moving` has their places.
     by_state (steps, plans, n, n), by_control (steps, plans, n, INPUTS): derivatives of each step.
     curve (steps + 1, plans, n, n), pull (steps + 1, plans, n): derivatives of the cost by the states.
     own, push (steps, plans, INPUTS): derivatives of the cost by each control alone.
     gains (steps, plans, INPUTS, n + 1): result; feedback of the states, and the change itself. */

enum { Z = N + 1, W = N + 1 + M };

/* Replace the columns of b by the solutions of a x = -b, with m rows; a is destroyed. */
static void solved(int m, int columns, double a[M][M], double b[M][Z]) {
  for (int i = 0; i < m; ++i) {
    int pivot = i;
    for (int r = i + 1; r < m; ++r)
      if (fabs(a[r][i]) > fabs(a[pivot][i])) pivot = r;
    for (int c = 0; c < m; ++c) { const double t = a[i][c]; a[i][c] = a[pivot][c]; a[pivot][c] = t; }
    for (int c = 0; c < columns; ++c) { const double t = b[i][c]; b[i][c] = b[pivot][c]; b[pivot][c] = t; }
    for (int r = i + 1; r < m; ++r) {
      const double share = a[r][i] / a[i][i];
      for (int c = i + 1; c < m; ++c) a[r][c] -= share * a[i][c];
      for (int c = 0; c < columns; ++c) b[r][c] -= share * b[i][c];
    }
  }
  for (int i = m - 1; i >= 0; --i)
    for (int c = 0; c < columns; ++c) {
      double rest = b[i][c];
      for (int r = i + 1; r < m; ++r) rest += a[i][r] * b[r][c];
      b[i][c] = -rest / a[i][i];
    }
}

void riccati(int64_t steps, int64_t plans, int64_t n, const double *restrict by_state,
             const double *restrict by_control, const double *restrict curve, const double *restrict pull,
             const double *restrict own, const double *restrict push, double *restrict gains) {
  const int m = INPUTS, z = (int)n + 1, w = z + m;
  for (int64_t b = 0; b < plans; ++b) {
    double ahead[Z][Z] = {{0}}, joint[Z][W] = {{0}}, along[Z][W], whole[W][W], square[M][M], gain[M][Z];
    for (int64_t k = steps; k >= 0; --k) {
      const double *bend = curve + (k * plans + b) * n * n, *slope = pull + (k * plans + b) * n;
      if (k < steps) {
        const double *a = by_state + (k * plans + b) * n * n, *g = by_control + (k * plans + b) * n * m;
        for (int i = 0; i < n; ++i) { /* of (states, 1) after the step by (states, 1, controls) */
          for (int c = 0; c < n; ++c) joint[i][c] = a[i * n + c];
          for (int c = 0; c < m; ++c) joint[i][z + c] = g[i * m + c];
        }
        joint[n][n] = 1.0;
        for (int i = 0; i < z; ++i)
          for (int c = 0; c < w; ++c) {
            double sum = 0.0;
            for (int r = 0; r < z; ++r) sum += ahead[i][r] * joint[r][c];
            along[i][c] = sum;
          }
        for (int i = 0; i < w; ++i)
          for (int c = 0; c < w; ++c) {
            double sum = 0.0;
            for (int r = 0; r < z; ++r) sum += joint[r][i] * along[r][c];
            whole[i][c] = sum;
          }
        const double *mine = own + (k * plans + b) * m, *first = push + (k * plans + b) * m;
        for (int i = 0; i < m; ++i) {
          whole[z + i][z + i] += mine[i];
          whole[z + i][n] += first[i];
        }
        for (int i = 0; i < m; ++i) {
          for (int c = 0; c < m; ++c) square[i][c] = whole[z + i][z + c];
          for (int c = 0; c < z; ++c) gain[i][c] = whole[z + i][c];
        }
        solved(m, z, square, gain);
        for (int i = 0; i < m; ++i)
          for (int c = 0; c < z; ++c) gains[((k * plans + b) * m + i) * z + c] = gain[i][c];
      }
      for (int i = 0; i < z; ++i)
        for (int c = 0; c <= i; ++c) {
          double sum = i < n ? bend[i * n + c] : c < n ? slope[c] : 0.0;
          if (k < steps) {
            sum += 0.5 * (whole[i][c] + whole[c][i]);
            for (int r = 0; r < m; ++r)
              sum += 0.5 * (whole[z + r][i] * gain[r][c] + whole[z + r][c] * gain[r][i]);
          }
          ahead[i][c] = ahead[c][i] = sum;
        }
    }
  }
}

/* Change plans by `lengths` shares of the change. A control moves at most to a share `inside` of its distance
   from its bounds, 0 and 1. shares (plans, steps, INPUTS) and path (plans, steps + 1, N) are the present
   controls and states; found (plans, lengths, steps, INPUTS) and states (plans, lengths, steps + 1, N) the
   new ones. A control is low + span * share. */
void follow(int64_t steps, int64_t plans, int64_t n, const int64_t *restrict moving,
            const double *restrict gains, const double *restrict shares, const double *restrict path,
            const double *restrict low, const double *restrict span, double inside, int64_t lengths,
            const double *restrict length, double *restrict found, double *restrict states) {
  lane x[N], y[N], u[M], c[M];
  for (int64_t at = 0; at < plans * lengths; at += LANES) {
    const int here = plans * lengths - at < LANES ? (int)(plans * lengths - at) : LANES;
    for (int64_t k = 0; k <= steps; ++k) {
      for (int j = 0; j < LANES; ++j) {
        const int64_t row = at + (j < here ? j : 0), b = row / lengths;
        const double *old = path + (b * (steps + 1) + k) * N;
        if (k == 0) for (int i = 0; i < N; ++i) x[i][j] = old[i];
        if (j < here) for (int i = 0; i < N; ++i) states[(row * (steps + 1) + k) * N + i] = x[i][j];
        for (int i = 0; i < INPUTS && k < steps; ++i) {
          const double *gain = gains + ((k * plans + b) * INPUTS + i) * (n + 1);
          const double now = shares[(b * steps + k) * INPUTS + i], most = 1.0 - inside * (1.0 - now);
          double share = now + gain[n] * length[row % lengths];
          for (int r = 0; r < n; ++r) share += gain[r] * (x[moving[r]][j] - old[moving[r]]);
          share = share < inside * now ? inside * now : share > most ? most : share;
          if (!isfinite(share)) share = now;
          u[i][j] = low[i] + span[i] * share;
          if (j < here) found[(row * steps + k) * INPUTS + i] = share;
        }
      }
      if (k == steps) break;
      step((const lane *)x, (const lane *)u, y, c);
      memcpy(x, y, sizeof x);
    }
  }
}
