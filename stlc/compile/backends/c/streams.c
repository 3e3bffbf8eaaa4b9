/* Transducers of a monitor of streams.

   Instants are counted from 0. A truth is 0 (unknown), NO or YES. Minima are maxima of negated operands: the
   operators `always`, `historically`, `release`, `trigger` and `and` are dual to those that are written here. */

/* Bounds on a robustness; both are its value where nothing is unknown. */
typedef struct { real lo, hi; } span;

/* What a step is: a sample; an unknown sample of a trace that may end with any sample, where the end cuts the
   windows to the end (OPEN) or all of them (GROWING); no sample, where the windows to the end (ENDED) or all
   windows (CLIPPED) end with the last one. */
enum { SAMPLE, OPEN, GROWING, ENDED, CLIPPED };
enum { TRUTH, PREDICATE, JOIN, FUTURE, PAST, SHIFT, BEGUN, UNTIL, SINCE };
enum { NO = 1, YES = 2 };
enum { DUAL = 1, WEAK = 2, UNCUT = 4, ENDLESS = 8, LASTS = 16, ROOT = 32, AHEAD = 64 };

/* A sub-formula. `lo` and `hi` are its window, the truth of a constant, or the steps of a shift and the truth
   outside of the trace (0: unknown). `delay` is the time until a value is known; `age` and `ahead` are the times
   before and after the latest sample at which a truth matters and may be known. Then: where its operands, its
   readers and its parts of the state are. */
typedef struct {
  int32_t kind, flags, lo, hi, delay, age, ahead, operands, count, readers, reading;
  int32_t ring, ring_mask, window, place, truth, truth_mask, skip, ends, from;
} node;
/* An operand, where its values are, and the samples since the instant of the one that is read; a constant has no
   place: -1 (no) or -2 (yes). */
typedef struct { int32_t node, ring, mask, since; } operand;
/* Part of a formula with windows to the end of the trace; `later`: instants after that of the formula. */
typedef struct { int32_t kind, flags, first, count, later, bit; } entry;
/* Nodes: predicates up to `leaves`, others with values up to `steps`, and those with windows to the end; how many have a
   truth that may be known ahead (AHEAD). */
typedef struct {
  int32_t first, leaves, steps, count, root, lag, far, early, coefficients, bits, neutral, entries, entered;
  int32_t spans, span_count, ints, int_count; /* its parts of the state; another follows for a trace that cuts windows */
} graph;
/* Graphs of the robustness and of the verdict, often the same one; where the starts that the latest step decided are. */
typedef struct { int32_t values, truths, news, news_mask; } rule;
typedef struct { at known; real *first, *x; } samples; /* first values; the latest `rows` of each signal */
typedef struct { at instants, holds, fails, low_at, high_at; real low, high; } tally;
typedef struct { at begin; real slack; int32_t everywhere, cut, said, over, waiting; tally sum; span last[2]; } verdicts;
typedef struct { at count, first, last; } gap; /* samples at which a signal is unknown */
typedef struct {
  const node *nodes;
  const operand *operands;
  const int32_t *readers;
  const entry *entries;
  const graph *graphs;
  const rule *rules;
  void (*predicates)(int32_t g, const samples *x, at n, int mode, int clip, span *v);
  int32_t signals, rows, judged, spans, times, ints, truths;
} tables;
typedef struct {
  const tables *t;
  samples s;
  at *times;
  gap *gaps;
  verdicts *of;
  span *spans;
  int32_t *ints;
  unsigned char *truths;
} monitor;

static inline span spanned(real lo, real hi) { span out; out.lo = lo; out.hi = hi; return out; }
static inline span certain(int yes) { return yes ? spanned(INF, INF) : spanned(-INF, -INF); }
static inline span minus(span a) { return spanned(-a.hi, -a.lo); }
static inline span least(span a, span b) {
  return spanned(b.lo < a.lo ? b.lo : a.lo, b.hi < a.hi ? b.hi : a.hi);
}
static inline span most(span a, span b) {
  return spanned(b.lo > a.lo ? b.lo : a.lo, b.hi > a.hi ? b.hi : a.hi);
}
static inline span pick(span a, span b, int dual) { return dual ? least(a, b) : most(a, b); }
/* Margin of a comparison that only holds or not; NaN where its own is. */
static inline real gated(real margin, int strict) {
  return margin != margin ? margin : (strict ? margin > 0 : margin >= 0) ? INF : -INF;
}
static inline at later(at a, at b) { return a > b ? a : b; }
static inline at sooner(at a, at b) { return a < b ? a : b; }

/* PREDICATES */

#define BITS 5 /* windows to the end of the trace in a formula, at most */
#define ENTRIES 256 /* parts of such a formula, at most */

/* ------------------------------------------------------------------------------------------------ values */

/* Operand of a maximum over future instants, at an instant beyond the last sample. */
static span beyond(span x, int mode, int endless) {
  if (mode == CLIPPED || (endless && mode == ENDED)) return certain(0);
  return mode == GROWING || (endless && mode == OPEN) ? spanned(-INF, x.hi) : x;
}

/* Value of a shift to an instant beyond the last sample. */
static span shifted(span x, int mode, int weak, int outside) {
  if (mode == CLIPPED) return certain(outside ? outside == YES : weak);
  if (mode != GROWING) return x;
  return weak ? spanned(x.lo, INF) : spanned(-INF, x.hi);
}

/* Extremum over the last `width` operands: suffixes of the block before, and the prefix of this one. */
INLINED span extremum(span *v, int32_t *place, at q, int32_t width, span x, int dual) {
  const int32_t k = *place;
  span *sum = v + width;
  *place = k + 1 == width ? 0 : k + 1;
  if (k == 0) {
    if (q >= width) for (int32_t i = width - 2; i > 0; --i) v[i] = pick(v[i], v[i + 1], dual);
    *sum = x;
  } else {
    *sum = pick(*sum, x, dual);
  }
  v[k] = x;
  return q >= width && k + 1 < width ? pick(*sum, v[k + 1], dual) : *sum;
}

/* The same for `until`, which is a composition of functions x -> min(f[1], max(f[0], x)), the oldest outermost. */
static inline span applied(const span *f, span x) { return least(f[1], most(f[0], x)); }
static span composition(span *v, int32_t *place, at q, int32_t width, span floor, span ceil) {
  const int32_t k = *place;
  span out, *sum = v + 2 * width;
  if (k == 0) {
    if (q >= width)
      for (int32_t i = width - 2; i > 0; --i) {
        v[2 * i + 1] = applied(v + 2 * i, v[2 * i + 3]);
        v[2 * i] = applied(v + 2 * i, v[2 * i + 2]);
      }
    sum[0] = floor;
    sum[1] = ceil;
  } else {
    const span f = applied(sum, floor), c = applied(sum, ceil);
    sum[0] = f;
    sum[1] = c;
  }
  out = q >= width && k + 1 < width ? applied(v + 2 * k + 2, sum[0]) : sum[0];
  v[2 * k] = floor;
  v[2 * k + 1] = ceil;
  *place = k + 1 == width ? 0 : k + 1;
  return out;
}

static inline span value_of(const span *v, const operand *from, at n) {
  if (from->ring < 0) return certain(from->ring == -2);
  return v[from->ring + ((n - from->since) & from->mask)];
}
static inline span value_at(const span *v, const node *o, at t) {
  if (o->kind == TRUTH) return certain(o->lo == YES);
  return v[o->ring + (t & o->ring_mask)];
}

/* Value of a node at the instant that the latest step makes known; none before the first one. */
INLINED void advance(const tables *t, const node *o, const samples *x, at n, int mode, int clip, span *v, int32_t *ints) {
  const operand *in = t->operands + o->operands;
  const int dual = o->flags & DUAL;
  const at now = n - o->delay;
  span out, left, right;
  at q;
  switch (o->kind) {
  case JOIN:
    if (now < 0) return;
    out = value_of(v, in, n);
    for (int32_t i = 1; i < o->count; ++i) out = pick(out, value_of(v, in + i, n), dual);
    break;
  case FUTURE:
    q = now + o->hi;
    if (q < 0) return;
    out = value_of(v, in, n);
    if (q >= x->known && (!(o->flags & UNCUT) || mode == CLIPPED))
      out = dual ? minus(beyond(minus(out), mode, 0)) : beyond(out, mode, 0);
    out = extremum(v + o->window, ints + o->place, q, o->hi - o->lo + 1, out, dual);
    break;
  case PAST:
    if (now < 0) return;
    q = now - o->lo;
    if (q < 0) {
      out = certain(dual);
    } else {
      out = extremum(v + o->window, ints + o->place, q, o->hi - o->lo + 1, value_of(v, in, n), dual);
    }
    break;
  case SHIFT:
    if (now < 0) return;
    q = now + o->lo;
    if (q < 0) {
      out = o->hi ? certain(o->hi == YES) : clip ? certain(o->flags & WEAK) : spanned(-INF, INF);
    } else {
      out = value_of(v, in, n);
      if (o->lo > 0 && q >= x->known) out = shifted(out, mode, o->flags & WEAK, o->hi);
    }
    break;
  case UNTIL:
    q = now + o->hi;
    if (q < 0) return;
    left = o->count == 2 ? value_of(v, in, n) : certain(!dual);
    right = value_of(v, in + o->count - 1, n);
    if (dual) { left = minus(left); right = minus(right); }
    if (q >= x->known) right = beyond(right, mode, 0);
    if (q >= x->known && mode == CLIPPED) left = certain(1);
    out = composition(v + o->window, ints + o->place, q, o->hi + 1, least(left, right), left);
    if (dual) out = minus(out);
    break;
  case SINCE:
    if (now < 0) return;
    right = value_of(v, in + o->count - 1, n);
    if (dual) right = minus(right);
    if (now > 0) right = most(right, v[o->window]);
    if (o->count == 2) {
      left = value_of(v, in, n);
      right = least(dual ? minus(left) : left, right);
    }
    v[o->window] = right;
    out = dual ? minus(right) : right;
    break;
  default:
    return;
  }
  if (now >= 0) v[o->ring + (now & o->ring_mask)] = out;
}

/* Coefficients: values of the formula at `begin` where each window to the end, from the instant after `f` on, is
   +inf (bits of `s`) or -inf. The next instant gives new ones from these. */
static void coefficients(const tables *t, const graph *g, const samples *x, at n, int mode, at begin, span *v) {
  const at f = n - g->lag;
  span e[ENTRIES], rest[BITS], next[1 << BITS], *c = v + g->coefficients;
  const int sets = 1 << g->bits;
  const entry *last = t->entries + g->entries + g->entered - 1;
  if (f < begin) return;
  if (g->entered == 2 && last->count == 1 && f + last->later < x->known) { /* one extremum to the end */
    const span all = value_of(v, t->operands + (last - 1)->first, n);
    c[!g->neutral] = certain(!g->neutral);
    c[g->neutral] = f == begin ? all : pick(c[g->neutral], all, g->neutral);
    return;
  }
  for (int s = 0; s < sets; ++s) {
    for (int32_t i = 0; i < g->entered; ++i) {
      const entry *o = t->entries + g->entries + i;
      const at there = f + o->later;
      const int dual = o->flags & DUAL;
      span out;
      if (o->kind == PREDICATE) { /* any part without windows to the end */
        out = value_of(v, t->operands + o->first, n);
      } else if (o->kind == JOIN) {
        out = e[t->operands[o->first].node];
        for (int32_t k = 1; k < o->count; ++k) {
          const span other = e[t->operands[o->first + k].node];
          out = dual ? least(out, other) : most(out, other);
        }
      } else if (o->kind == SHIFT) {
        out = e[t->operands[o->first].node];
        if (there >= x->known) out = shifted(out, mode, o->flags & WEAK, 0);
      } else if (o->kind == BEGUN) {
        out = e[t->operands[o->first].node];
        if (there >= x->known && (mode == OPEN || mode == ENDED)) out = spanned(-INF, INF);
      } else {
        span right = e[t->operands[o->first + o->count - 1].node];
        if (dual) right = minus(right);
        if (there >= x->known) right = beyond(right, mode, 1);
        out = most(right, certain((s >> o->bit & 1) != dual));
        if (o->count == 2 && !(there >= x->known && mode >= ENDED))
          out = least(dual ? minus(e[t->operands[o->first].node]) : e[t->operands[o->first].node], out);
        if (dual) out = minus(out);
        rest[o->bit] = out;
        if (there >= x->known && mode == CLIPPED) out = certain(dual);
        else if (there >= x->known && mode != GROWING) out = spanned(-INF, INF);
      }
      e[i] = out;
    }
    if (f == begin) {
      next[s] = e[g->entered - 1];
      continue;
    }
    next[s] = certain(0);
    for (int old = 0; old < sets; ++old) {
      span one = c[old];
      for (int32_t i = 0; i < g->bits; ++i) if (old >> i & 1) one = least(one, rest[i]);
      next[s] = most(next[s], one);
    }
  }
  for (int s = 0; s < sets; ++s) c[s] = next[s];
}

/* Take a step; return bounds at the instant `lag` samples before, or of the formula with windows to the end. */
INLINED span stepped(const monitor *m, const graph *g, at n, int mode, int clip, at begin) {
  const tables *t = m->t;
  span *v = m->spans + g->spans + (clip ? g->span_count : 0);
  int32_t *ints = m->ints + g->ints + (clip ? g->int_count : 0);
  t->predicates((int32_t)(g - t->graphs), &m->s, n, mode, clip, v);
  for (int32_t i = g->leaves; i < g->steps; ++i) advance(t, t->nodes + i, &m->s, n, mode, clip, v, ints);
  if (g->bits) {
    coefficients(t, g, &m->s, n, mode, begin, v);
    return n - g->lag >= begin ? v[g->coefficients + g->neutral] : spanned(-INF, INF);
  }
  return n >= g->lag ? value_at(v, t->nodes + g->root, n - g->lag) : spanned(-INF, INF);
}
static span valued(const monitor *m, const graph *g, at n, int mode, int clip, at begin) {
  return stepped(m, g, n, mode, clip, begin);
}

/* ------------------------------------------------------------------------------------------------ truths */

static void ever(monitor *m, int32_t r, int32_t i, at from, int truth);
static void mark(monitor *m, int32_t r, int32_t i, at first, at last, int truth);

static inline int truth_of(span x, real slack) { return x.lo >= slack ? YES : x.hi < slack ? NO : 0; }
static inline at since_when(const monitor *m, const node *o, int truth) { /* 0: not, or the instant + 1 */
  return o->flags & LASTS ? m->times[o->from + truth - 1] : 0;
}
static int truth_at(const monitor *m, const node *o, at t) {
  if (o->kind == TRUTH) return o->lo;
  if (t < m->s.known + o->ahead) return m->truths[o->truth + (t & o->truth_mask)];
  for (int truth = NO; truth <= YES; ++truth)
    if (since_when(m, o, truth) && t + 1 >= since_when(m, o, truth)) return truth;
  return 0;
}

/* Decide the starts from `first` to `last` that exist. */
static void decide(monitor *m, int32_t r, at first, at last, int truth) {
  verdicts *of = m->of + r;
  int32_t *news = m->ints + m->t->rules[r].news;
  const int32_t mask = m->t->rules[r].news_mask;
  first = later(first, of->begin);
  last = sooner(last, of->everywhere ? m->s.known - 1 : sooner(of->begin, m->s.known - 1));
  if (of->said || first > last) return;
  if (!of->everywhere) of->said = truth;
  for (at t = first; t <= last; ++t) news[of->waiting++ & mask] = (int32_t)(m->s.known - t);
}

/* Add the instants `first` to `last` to runs of the same truth: both ends of a run hold its length - 1. */
static void join_runs(monitor *m, const node *o, const node *part, int truth, at *first, at *last) {
  const at oldest = later(m->s.known - 1 - part->age, 0), newest = m->s.known - 1 + part->ahead;
  int32_t *ends = m->ints + o->ends;
  const unsigned char *known = m->truths + part->truth;
  const at mask = part->truth_mask, before = *first - 1, after = *last + 1;
  if (before >= oldest && known[before & mask] == truth) *first = later(before - ends[before & mask], oldest);
  if (after <= newest && known[after & mask] == truth) *last = after + ends[after & mask];
  ends[*first & mask] = ends[*last & mask] = (int32_t)(*last - *first);
  if (*last >= newest && since_when(m, part, truth) && *last + 2 >= since_when(m, part, truth)) *last = INT64_MAX / 2;
}

/* First instant of the run of a truth that lasts from one instant on. */
static at run_before(const monitor *m, const node *o, const node *part, at from, int truth) {
  const at oldest = later(m->s.known - 1 - part->age, 0), before = from - 1;
  if (part->kind == TRUTH || before < oldest || before >= m->s.known + part->ahead) return from;
  if (m->truths[part->truth + (before & part->truth_mask)] != truth) return from;
  return later(before - m->ints[o->ends + (before & part->truth_mask)], oldest);
}

/* Pass on to the node `r` that its operand `p` is `truth` at the instants `first` to `last`, all of them new. */
INLINED void react(monitor *m, int32_t r, int32_t i, int32_t p, at first, at last, int truth) {
  const node *o = m->t->nodes + i, *part = m->t->nodes + p;
  const at n = m->s.known - 1;
  const int cut = m->of[r].cut, yes = o->flags & DUAL ? NO : YES;
  at begin = first, end = last;
  switch (o->kind) {
  case JOIN:
    if (truth == yes) {
      mark(m, r, i, first, last, truth);
      return;
    }
    for (at t = later(first, n - o->age); t <= sooner(last, n + o->ahead); ++t)
      if (++m->ints[o->skip + (t & o->truth_mask)] == o->count) mark(m, r, i, t, t, truth);
    return;
  case FUTURE:
    if (truth == yes) {
      if (cut && !(o->flags & UNCUT)) last = sooner(last, n);
      if (first <= last) mark(m, r, i, first - o->hi, last - o->lo, truth);
      return;
    }
    join_runs(m, o, part, truth, &begin, &end);
    if (end - begin >= o->hi - o->lo) /* else no window is all within the run */
      mark(m, r, i, later(begin - o->lo, first - o->hi), sooner(end - o->hi, last - o->lo), truth);
    return;
  case PAST:
    if (truth == yes) {
      mark(m, r, i, first + o->lo, last + o->hi, truth);
      return;
    }
    join_runs(m, o, part, truth, &begin, &end);
    mark(m, r, i, later(begin > 0 ? begin + o->hi : 0, first + o->lo), sooner(end + o->lo, last + o->hi), truth);
    return;
  case SHIFT:
    if (cut && o->lo > 0 && truth == (o->flags & WEAK ? NO : YES)) last = sooner(last, n);
    mark(m, r, i, first - o->lo, last - o->lo, truth);
    return;
  case BEGUN:
    mark(m, r, i, first, cut ? last : sooner(last, n - o->lo), truth);
    return;
  default:
    mark(m, r, i, first, last, 0);
  }
}

/* Whether a window to the end is unknown where it begins after the latest sample. */
static int unseen(const monitor *m, int32_t r, const node *o) {
  return o->kind == UNTIL && o->flags & ENDLESS && !m->of[r].cut;
}

/* Make the truth of a node known at instants at which it was not. */
INLINED void settled(monitor *m, int32_t r, int32_t i, at first, at last, int truth) {
  const node *o = m->t->nodes + i;
  unsigned char *known = m->truths + o->truth;
  int32_t *skip = m->ints + o->skip;
  const at mask = o->truth_mask;
  const int windows = o->kind == FUTURE || o->kind == PAST;
  for (at t = first; t <= last; ++t) {
    known[t & mask] = (unsigned char)truth;
    if (windows) skip[t & mask] = 1;
  }
  if (o->flags & ROOT) decide(m, r, first, last, truth);
  if (unseen(m, r, o)) last = sooner(last, m->s.known - 1);
  for (int32_t k = 0; k < o->reading && first <= last; ++k) react(m, r, m->t->readers[o->readers + k], i, first, last, truth);
  if (o->kind == SINCE) { /* it stays true while the left side does, and false while the right side does */
    const operand *in = m->t->operands + o->operands;
    const int yes = o->flags & DUAL ? NO : YES;
    at from = 1;
    if (truth != yes) from = since_when(m, m->t->nodes + in[o->count - 1].node, truth);
    else if (o->count == 2) from = since_when(m, m->t->nodes + in[0].node, truth);
    if (from && from - 1 <= last) ever(m, r, i, later(first, from - 1), truth);
  }
}
static void settle(monitor *m, int32_t r, int32_t i, at first, at last, int truth) {
  settled(m, r, i, first, last, truth);
}

/* Truth of `until` or `since` at an instant, from those of its operands and its own at the next or last one. */
static int chained(const monitor *m, int32_t r, const node *o, at t) {
  const operand *in = m->t->operands + o->operands;
  const int yes = o->flags & DUAL ? NO : YES, no = 3 - yes;
  const int left = o->count == 2 ? truth_at(m, m->t->nodes + in[0].node, t) : yes;
  const int right = truth_at(m, m->t->nodes + in[o->count - 1].node, t);
  const int near = o->kind == UNTIL ? truth_at(m, o, t + 1) : t ? truth_at(m, o, t - 1) : no;
  const int late = o->kind == UNTIL && t >= m->s.known && (m->of[r].cut || o->flags & ENDLESS);
  if (left == no || (right == no && near == no)) return no;
  return left == yes && ((right == yes && !late) || near == yes) ? yes : 0;
}

/* Make the truth of a node known at those of some instants at which it is not. */
static void mark(monitor *m, int32_t r, int32_t i, at first, at last, int truth) {
  const node *o = m->t->nodes + i;
  const at oldest = later(m->s.known - 1 - o->age, 0), newest = m->s.known - 1 + o->ahead;
  unsigned char *known = m->truths + o->truth;
  const at mask = o->truth_mask;
  at *done = o->kind == FUTURE || o->kind == PAST ? m->times + o->from + 2 : 0; /* before it, all are known */
  const at from = done ? later(*done, oldest) : oldest;
  first = later(first, from);
  last = sooner(last, newest);
  if (first > last) return;
  if (o->kind == UNTIL || o->kind == SINCE) {
    const at step = o->kind == UNTIL ? -1 : 1, end = o->kind == UNTIL ? first : last;
    for (at t = o->kind == UNTIL ? last : first; t >= oldest && t <= newest; t += step) {
      const int found = known[t & mask] ? 0 : chained(m, r, o, t);
      if (found) settle(m, r, i, t, t, found);
      else if ((t - end) * step >= 0) return;
    }
    return;
  }
  if (done && first == from) *done = last + 1;
  for (at t = first; t <= last;) {
    const at begin = t;
    if (known[t & mask] && done) { /* on to the next that is unknown */
      int32_t *skip = m->ints + o->skip;
      const at next = t + skip[t & mask];
      if (next <= last && known[next & mask]) skip[t & mask] += skip[next & mask];
      t = next;
      continue;
    }
    while (t <= last && !known[t & mask]) ++t;
    if (t > begin) settle(m, r, i, begin, t - 1, truth);
    else ++t;
  }
}

/* Make the truth of a node known at all instants from one on. */
static void ever(monitor *m, int32_t r, int32_t i, at from, int truth) {
  const node *o = m->t->nodes + i;
  const at n = m->s.known - 1;
  at *own = m->times + o->from + truth - 1;
  from = later(from, 0);
  if (*own && *own <= from + 1) return;
  *own = from + 1;
  for (at t = later(from, n - o->age); t <= n + o->ahead && o->kind != TRUTH; ++t)
    if (!m->truths[o->truth + (t & o->truth_mask)]) settle(m, r, i, t, t, truth);
  if (unseen(m, r, o)) return;
  for (int32_t k = 0; k < o->reading; ++k) {
    const int32_t reader = m->t->readers[o->readers + k];
    const node *a = m->t->nodes + reader;
    const operand *in = m->t->operands + a->operands;
    const int yes = a->flags & DUAL ? NO : YES, no = 3 - yes, cut = m->of[r].cut;
    at all[3] = {0, 0, 0};
    for (int32_t j = 0; j < a->count; ++j)
      for (int each = NO; each <= YES; ++each) {
        const at when = since_when(m, m->t->nodes + in[j].node, each);
        all[each] = all[each] < 0 || !when ? -1 : later(all[each], when);
      }
    switch (a->kind) {
    case JOIN:
      if (truth == yes) ever(m, r, reader, from, truth);
      else if (all[no] > 0) ever(m, r, reader, all[no] - 1, no);
      break;
    case FUTURE:
      if (truth == no) ever(m, r, reader, run_before(m, a, o, from, truth) - a->lo, truth);
      else if (!cut || a->flags & UNCUT) ever(m, r, reader, from - a->hi, truth);
      break;
    case PAST:
      if (truth == no && !run_before(m, a, o, from, truth)) ever(m, r, reader, 0, truth);
      else ever(m, r, reader, from + (truth == yes ? a->lo : a->hi), truth);
      break;
    case SHIFT:
      if (!(cut && a->lo > 0 && truth == (a->flags & WEAK ? NO : YES))) ever(m, r, reader, from - a->lo, truth);
      break;
    case BEGUN:
      if (cut) ever(m, r, reader, from, truth);
      break;
    default:
      if (truth == no && a->count == 2 && in[0].node == i) ever(m, r, reader, from, no);
      else if (truth == no && a->kind == UNTIL) ever(m, r, reader, from, no);
      else if (truth == yes && a->kind == SINCE && all[yes] > 0) ever(m, r, reader, all[yes] - 1, yes);
      else if (truth == yes && !cut && !(a->flags & ENDLESS) && all[yes] > 0) ever(m, r, reader, all[yes] - 1, yes);
      mark(m, r, reader, 0, n + a->ahead, 0);
      if (a->kind == SINCE)
        for (at t = later(from, n - a->age); t <= n + a->ahead; ++t) {
          const int known = m->truths[a->truth + (t & a->truth_mask)];
          const at when = known ? known == yes && a->count == 1 ? 1
                                 : since_when(m, m->t->nodes + in[known == yes ? 0 : a->count - 1].node, known) : 0;
          if (when && when <= t + 1) ever(m, r, reader, t, known);
        }
    }
  }
}

/* Make room for the next instants; make known what no sample decides, and what only had to be seen to exist. */
static void begin(monitor *m, int32_t r, const graph *g) {
  const at n = m->s.known - 1;
  const int cut = m->of[r].cut;
  const node *nodes = m->t->nodes + g->first, *end = nodes + g->count;
  unsigned char *truths = m->truths;
  for (const node *o = nodes; o < end; ++o) {
    if (o->kind == TRUTH) continue;
    truths[o->truth + ((n + o->ahead) & o->truth_mask)] = 0;
    if (o->kind == JOIN) m->ints[o->skip + ((n + o->ahead) & o->truth_mask)] = 0;
  }
  {
    const node *root = m->t->nodes + g->root;
    const int truth = root->kind == TRUTH ? root->lo : m->truths[root->truth + (n & root->truth_mask)];
    if (truth) decide(m, r, n, n, truth);
  }
  if (!g->early && !cut) return;
  for (int32_t i = g->first + g->count - 1; i >= g->first; --i) { /* what was known of instants without room or samples */
    const node *o = m->t->nodes + i;
    if (!(o->flags & AHEAD)) continue;
    const int truth = unseen(m, r, o) && o->ahead ? m->truths[o->truth + (n & o->truth_mask)] : 0;
    for (int32_t k = 0; k < o->reading && truth; ++k) react(m, r, m->t->readers[o->readers + k], i, n, n, truth);
    for (int32_t j = 0; o->kind == JOIN && j < o->count; ++j) {
      const int32_t p = m->t->operands[o->operands + j].node;
      const int no = o->flags & DUAL ? YES : NO;
      const at top = n + o->ahead, when = since_when(m, m->t->nodes + p, no);
      if (m->t->nodes[p].ahead > o->ahead && when && top + 1 >= when) react(m, r, i, p, top, top, no);
    }
  }
  for (int32_t i = g->first; i < g->first + g->count; ++i) {
    const node *o = m->t->nodes + i;
    if (!(o->flags & AHEAD) && !cut) continue;
    const node *part = m->t->nodes + (o->count ? m->t->operands[o->operands].node : i);
    const int yes = o->flags & DUAL ? NO : YES;
    const at top = n + o->ahead;
    if (o->kind == TRUTH && !n) ever(m, r, i, 0, o->lo);
    for (int truth = NO; o->kind != TRUTH && truth <= YES; ++truth)
      if (since_when(m, o, truth) && top + 1 >= since_when(m, o, truth)) mark(m, r, i, top, top, truth);
    if (o->kind == PAST && (n ? top : 0) < o->lo) {
      for (at t = n ? top : 0; t <= top && t < o->lo; ++t) mark(m, r, i, t, t, 3 - yes);
    } else if (o->kind == SHIFT && o->hi && (n ? top : 0) < -o->lo) {
      for (at t = n ? top : 0; t <= top && t < -o->lo; ++t) mark(m, r, i, t, t, o->hi);
    } else if (o->kind == BEGUN) {
      if (!cut && n >= o->lo && truth_at(m, part, n - o->lo)) mark(m, r, i, n - o->lo, n - o->lo, truth_at(m, part, n - o->lo));
    } else if (o->kind == UNTIL) {
      if (cut || o->flags & ENDLESS) mark(m, r, i, n, n, 0);
    } else if (cut && o->kind == SHIFT && o->lo > 0) {
      const int weak = o->flags & WEAK ? NO : YES;
      if (truth_at(m, part, n) == weak) mark(m, r, i, n - o->lo, n - o->lo, weak);
    } else if (cut && o->kind == FUTURE && !(o->flags & UNCUT)) {
      if (truth_at(m, part, n) == yes) mark(m, r, i, n - o->hi, n - o->lo, yes);
    }
  }
}

/* Decide a formula with windows to the end from its coefficients. */
static void decide_endless(monitor *m, int32_t r, const graph *g, const span *v) {
  const at f = m->s.known - 1 - g->lag;
  const span *c = v + g->coefficients;
  int rest[BITS], holds = 0, fails = 1;
  if (f < m->of[r].begin || m->of[r].said) return;
  for (int32_t i = 0; i < g->entered; ++i) {
    const entry *o = m->t->entries + g->entries + i;
    if (o->kind == UNTIL) rest[o->bit] = truth_at(m, m->t->nodes + m->t->operands[o->first + o->count].node, f + 1 + o->later);
  }
  for (int s = 0; s < 1 << g->bits; ++s) {
    int every = 1, none = c[s].hi < m->of[r].slack;
    for (int32_t i = 0; i < g->bits; ++i)
      if (s >> i & 1) {
        every &= rest[i] == YES;
        none |= rest[i] == NO;
      }
    holds |= every && c[s].lo >= m->of[r].slack;
    fails &= none;
  }
  if (holds || fails) decide(m, r, m->of[r].begin, m->of[r].begin, fails ? NO : YES);
}

/* ---------------------------------------------------------------------------------------------- monitors */

static void counted(verdicts *of, at t, span value, span deciding) {
  of->last[0] = value;
  of->last[1] = deciding;
  of->sum.instants += 1;
  of->sum.holds += deciding.lo >= of->slack;
  of->sum.fails += deciding.hi < of->slack;
  if (value.lo < of->sum.low) { of->sum.low = value.lo; of->sum.low_at = t; }
  if (value.hi < of->sum.high) { of->sum.high = value.hi; of->sum.high_at = t; }
}

static void judged(monitor *m, int32_t r) {
  const rule *a = m->t->rules + r;
  const graph *values = m->t->graphs + a->values, *truths = m->t->graphs + a->truths;
  verdicts *of = m->of + r;
  const at n = m->s.known - 1, t = n - truths->lag;
  const int apart = a->values != a->truths;
  span *live = m->spans + truths->spans, value, deciding;
  const node *root = m->t->nodes + truths->root;
  at there;
  begin(m, r, truths);
  deciding = stepped(m, truths, n, SAMPLE, 0, of->begin);
  for (int32_t i = truths->first; i < truths->leaves; ++i) {
    const node *o = m->t->nodes + i;
    const int truth = n < o->delay ? 0 : truth_of(value_at(live, o, n - o->delay), of->slack);
    if (truth) settled(m, r, i, n - o->delay, n - o->delay, truth);
  }
  if (of->cut) deciding = valued(m, truths, n, SAMPLE, 1, of->begin);
  value = deciding;
  for (int clip = 0; apart && clip <= of->cut; ++clip) value = valued(m, values, n, SAMPLE, clip, of->begin);
  if (truths->bits) {
    decide_endless(m, r, truths, live);
    return;
  }
  there = n - root->delay;
  if (there >= 0 && !truth_at(m, root, there)) {
    const int truth = truth_of(value_at(live + (of->cut ? truths->span_count : 0), root, there), of->slack);
    if (truth) settle(m, r, truths->root, there, there, truth);
  }
  if (t < of->begin) return;
  counted(of, t, value, deciding);
  if (!of->everywhere) of->over = 1;
}

/* Bytes of a state: of this structure, and of the arrays that follow it. */
API int64_t stlc_size(const tables *t) {
  return (int64_t)(sizeof(monitor) + sizeof(at) * (size_t)t->times + sizeof(gap) * (size_t)t->signals +
                   sizeof(verdicts) * (size_t)t->judged + sizeof(span) * (size_t)t->spans +
                   sizeof(real) * (size_t)t->signals * (size_t)(t->rows + 1) + sizeof(int32_t) * (size_t)t->ints +
                   (size_t)t->truths);
}

/* Find the arrays of a state, which begins as zeros or is the copy of another. */
API void stlc_place(monitor *m, const tables *t) {
  m->t = t;
  m->times = (at *)(m + 1);
  m->gaps = (gap *)(m->times + t->times);
  m->of = (verdicts *)(m->gaps + t->signals);
  m->spans = (span *)(m->of + t->judged);
  m->s.first = (real *)(m->spans + t->spans);
  m->s.x = m->s.first + t->signals;
  m->ints = (int32_t *)(m->s.x + (at)t->signals * t->rows);
  m->truths = (unsigned char *)(m->ints + t->ints);
}

API void stlc_init(monitor *m, int32_t r, int64_t start, int everywhere, int cut, real tolerance) {
  verdicts *of = m->of + r;
  of->begin = of->sum.low_at = of->sum.high_at = start;
  of->everywhere = everywhere;
  of->cut = cut;
  of->slack = -tolerance;
  of->sum.low = of->sum.high = INF;
  of->last[0] = of->last[1] = certain(1);
}

/* Take a sample; return how many starts it decides. */
API int64_t stlc_step(monitor *m, const real *row) {
  const at n = m->s.known++;
  int64_t decided = 0;
  for (int32_t i = 0; i < m->t->signals; ++i) {
    m->s.x[(at)i * m->t->rows + (n & (m->t->rows - 1))] = row[i];
    if (!n) m->s.first[i] = row[i];
    if (row[i] == row[i]) continue;
    if (!m->gaps[i].count++) m->gaps[i].first = n;
    m->gaps[i].last = n;
  }
  for (int32_t r = 0; r < m->t->judged; ++r) {
    m->of[r].waiting = 0;
    if (!m->of[r].over) judged(m, r);
    decided += m->of[r].waiting;
  }
  return decided;
}

/* Take samples, with `pause` up to the first that decides a start; return how many starts they decide. */
API int64_t stlc_block(monitor *m, const real *rows, int64_t count, int pause, int64_t *taken) {
  int64_t decided = 0;
  for (*taken = 0; *taken < count && !(pause && decided); ++*taken) decided += stlc_step(m, rows + m->t->signals * *taken);
  return decided;
}

/* Start `i` of those of a requirement that the latest sample decided, and its truth. */
static void stlc_one(const monitor *m, int32_t r, int32_t i, int64_t *start, int64_t *truth) {
  const rule *a = m->t->rules + r;
  const verdicts *of = m->of + r;
  *start = m->s.known - m->ints[a->news + (i & a->news_mask)];
  *truth = of->said ? of->said : truth_at(m, m->t->nodes + m->t->graphs[a->truths].root, *start);
}

/* Starts that the latest sample decided, `most` of them at most: requirement, start and truth of each. Return their
   number. */
API int64_t stlc_news(const monitor *m, int64_t *out, int64_t most) {
  int64_t found = 0;
  for (int32_t r = 0; r < m->t->judged; ++r)
    for (int32_t i = 0; i < m->of[r].waiting; ++i, ++found) {
      if (found >= most) continue;
      out[3 * found] = r;
      stlc_one(m, r, i, out + 3 * found + 1, out + 3 * found + 2);
    }
  return found;
}

/* Instants that are counted, that hold, that fail, and those of the least bounds; these bounds, those at the instant
   that was counted last, and those that decide it. */
API void stlc_tally(const monitor *m, int32_t r, int64_t *counts, real *bounds) {
  const verdicts *of = m->of + r;
  counts[0] = of->sum.instants; counts[1] = of->sum.holds; counts[2] = of->sum.fails;
  counts[3] = of->sum.low_at; counts[4] = of->sum.high_at;
  bounds[0] = (real)of->sum.low; bounds[1] = (real)of->sum.high;
  for (int i = 0; i < 2; ++i) { bounds[2 + 2 * i] = (real)of->last[i].lo; bounds[3 + 2 * i] = (real)of->last[i].hi; }
}

/* Number of samples at which a signal is unknown, the first and the last of them. */
API void stlc_gap(const monitor *m, int32_t i, int64_t *out) {
  out[0] = m->gaps[i].count; out[1] = m->gaps[i].first; out[2] = m->gaps[i].last;
}

/* Bounds at `count` starts from `start` on if steps of the kind `mode` follow: robustness, and what decides. Spoils the state. */
API void stlc_look(monitor *m, int32_t r, int mode, int clip, int64_t start, int64_t count, real *out) {
  const rule *a = m->t->rules + r;
  const graph *values = m->t->graphs + a->values, *truths = m->t->graphs + a->truths;
  const at far = values->bits ? m->s.known - 1 + values->far : start + count - 1 + truths->lag;
  for (at n = m->s.known; n <= far; ++n) {
    const at t = values->bits ? start : n - truths->lag;
    const span deciding = valued(m, truths, n, mode, clip, m->of[r].begin);
    span value = deciding;
    if (a->values != a->truths) value = valued(m, values, n, mode, clip, m->of[r].begin);
    if (t < start || t >= start + count) continue;
    out[4 * (t - start)] = (real)value.lo; out[4 * (t - start) + 1] = (real)value.hi;
    out[4 * (t - start) + 2] = (real)deciding.lo; out[4 * (t - start) + 3] = (real)deciding.hi;
  }
}

/* End the trace: count the first start if its windows are incomplete. Spoils the state for more samples. */
API void stlc_finish(monitor *m) {
  for (int32_t r = 0; r < m->t->judged; ++r) {
    verdicts *of = m->of + r;
    real row[4];
    span value, deciding;
    if (of->sum.instants || of->begin >= m->s.known) continue;
    stlc_look(m, r, of->cut ? CLIPPED : ENDED, of->cut, of->begin, 1, row);
    value = spanned(row[0], row[1]);
    deciding = spanned(row[2], row[3]);
    counted(of, of->begin, value, deciding);
  }
}
