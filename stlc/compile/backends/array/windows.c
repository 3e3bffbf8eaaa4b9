/* Extrema over sliding windows and `until`, with exact subgradients.

   REAL, INDEX (an integer as wide) and BYTES (of a vector) are defined before this text. Traces are taken
   LANES at a time, their samples beside each other, whatever the layout of the arrays. Windows are put
   together from the end of one block and the beginning of the next (van Herk; Gil and Werman). Every value
   carries the row that it came from; the gradient goes there, whole where rows tie. NaN wins. Long arrays are
   taken CHUNK windows at a time, so that memory follows the width of the windows and not their number.

   `shape` is {rows, count, width, traces, step and trace strides of each array in turn}. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* A vector that the processor does not have would be taken apart into numbers. */
#if BYTES > 32 && !defined(__AVX512F__)
#undef BYTES
#define BYTES 32
#endif
#if BYTES > 16 && !defined(__AVX2__)
#undef BYTES
#define BYTES 16
#endif

#define LANES ((int64_t)(BYTES / sizeof(REAL)))
#define AHEAD 16 /* rows that memory is asked for before they are needed */
#ifndef CHUNK
#define CHUNK 4096 /* windows that are taken at a time, at least */
#endif

enum { VALUES, PULL, PUSH }; /* what is computed: values, gradients of the operands, changes of the values */

typedef REAL Values __attribute__((vector_size(BYTES)));
typedef INDEX Rows __attribute__((vector_size(BYTES)));
typedef struct { Values value; Rows from; } Best;
typedef struct { int64_t rows, count, width, apart; } Sliding; /* apart: from the left operand to the right one */

static int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

static inline Best at(const Values *x, int64_t row, int64_t number)
{
    return (Best){x[row], (INDEX)number + (Rows){0}};
}

/* The neutral value: the extremum of nothing. */
static inline Best none(int max) { return (Best){(REAL)(max ? -INFINITY : INFINITY) + (Values){0}, (Rows){0}}; }

/* The better of two; the first one where they tie. */
static inline Best better(Best a, Best b, int max)
{
    Rows take = (max ? b.value > a.value : b.value < a.value) | (b.value != b.value);
    return (Best){(Values)(((Rows)b.value & take) | ((Rows)a.value & ~take)), (b.from & take) | (a.from & ~take)};
}

/* The value is written to a row, or the gradient of the row is added where it came from, or a change is taken
   from there. */
static inline void emit(Best found, Values *row, REAL *at, int how)
{
    if (how == VALUES) {
        *row = found.value;
        return;
    }
    for (int64_t lane = 0; lane < LANES; lane++) {
        REAL *there = at + found.from[lane] * LANES + lane;
        if (how == PULL)
            *there += (*row)[lane];
        else
            (*row)[lane] = *there;
    }
}

static inline __attribute__((always_inline)) void
slide(Sliding s, const Values *x, Values *rows, Values *to, Best *tails, int max, int how)
{
    for (int64_t begin = 0; begin < s.count; begin += s.width) {
        int64_t stop = least(begin + s.width, s.rows), last = least(begin + s.width, s.count);
        Best tail = none(max), head = none(max);
        for (int64_t t = stop - 1; t >= begin; t--)
            tails[t - begin] = tail = better(at(x, t, t), tail, max);
        for (int64_t j = begin; j < last; j++) {
            int64_t t = j + s.width - 1;
            if (j > begin && t < s.rows)
                head = better(head, at(x, t, t), max);
            emit(better(tails[j - begin], head, max), rows + j, (REAL *)to, how);
        }
    }
}

static inline __attribute__((always_inline)) void
until(Sliding s, const Values *x, Values *rows, Values *to, Best *tails, int max, int how)
{
    const Values *left = x, *right = x + s.apart;
    for (int64_t begin = 0; begin < s.count; begin += s.width) {
        int64_t stop = least(begin + s.width, s.rows), last = least(begin + s.width, s.count);
        Best held = none(!max), met = none(max), head = none(!max), reach = none(max);
        for (int64_t t = stop - 1; t >= begin; t--) {
            Best l = at(left, t, t);
            met = better(l, better(at(right, t, s.apart + t), met, max), !max);
            held = better(l, held, !max);
            tails[2 * (t - begin)] = met;
            tails[2 * (t - begin) + 1] = held;
        }
        for (int64_t j = begin; j < last; j++) {
            int64_t t = j + s.width - 1;
            if (j > begin && t < s.rows) {
                head = better(head, at(left, t, t), !max);
                reach = better(reach, better(at(right, t, s.apart + t), head, !max), max);
            }
            Best later = better(tails[2 * (j - begin) + 1], reach, !max);
            emit(better(tails[2 * (j - begin)], later, max), rows + j, (REAL *)to, how);
        }
    }
}

/* A row is rarely aligned: it lies in two lines of the cache. */
#define ask_for(row, write) (__builtin_prefetch(row, write), __builtin_prefetch((row) + LANES - 1, write))

/* A square of samples turned round. */
static void turn(const REAL *restrict x, int64_t x_stride, REAL *restrict y, int64_t y_stride)
{
    for (int64_t i = 0; i < LANES; i++)
        for (int64_t j = 0; j < LANES; j++)
            y[i * y_stride + j] = x[j * x_stride + i];
}

/* Some traces of an array, samples beside each other; what is not there is 0. */
static void load(const REAL *x, const int64_t *stride, int64_t rows, int64_t lanes, Values *y)
{
    REAL *to = (REAL *)y;
    int64_t t = 0;
    if (lanes == LANES && stride[1] == 1) {
        for (; t < rows; t++) {
            ask_for(x + (t + AHEAD) * stride[0], 0);
            memcpy(to + t * LANES, x + t * stride[0], BYTES);
        }
    } else if (lanes == LANES && stride[0] == 1) {
        for (; t + LANES <= rows; t += LANES)
            turn(x + t, stride[1], to + t * LANES, LANES);
    }
    for (; t < rows; t++)
        for (int64_t lane = 0; lane < LANES; lane++)
            to[t * LANES + lane] = lane < lanes ? x[t * stride[0] + lane * stride[1]] : 0;
}

/* The other way. */
static void store(const Values *y, const int64_t *stride, int64_t rows, int64_t lanes, REAL *x)
{
    const REAL *from = (const REAL *)y;
    int64_t t = 0;
    if (lanes == LANES && stride[1] == 1) {
        for (; t < rows; t++) {
            ask_for(x + (t + AHEAD) * stride[0], 1);
            memcpy(x + t * stride[0], from + t * LANES, BYTES);
        }
    } else if (lanes == LANES && stride[0] == 1) {
        for (; t + LANES <= rows; t += LANES)
            turn(from + t * LANES, LANES, x + t, stride[1]);
    }
    for (; t < rows; t++)
        for (int64_t lane = 0; lane < lanes; lane++)
            x[t * stride[0] + lane * stride[1]] = from[t * LANES + lane];
}

typedef void Walk(Sliding, const Values *, Values *, Values *, Best *, int, int);

/* Rows that no window sees have no gradient. */
static void clear(const int64_t *stride, int64_t rows, int64_t lanes, REAL *x)
{
    for (int64_t t = 0; t < rows; t++)
        for (int64_t lane = 0; lane < lanes; lane++)
            x[t * stride[0] + lane * stride[1]] = 0;
}

/* Some of the windows of an array: those from row `begin` on, and the rows that they see. */
static Sliding chunk_at(Sliding all, int64_t begin, int64_t some, int64_t apart)
{
    int64_t count = least(some, all.count - begin);
    return (Sliding){least(count + all.width - 1, all.rows - begin), count, all.width, apart};
}

/* `arrays` are the operands; their changes (PUSH) or the gradient of the values (PULL); and the results. */
static inline __attribute__((always_inline)) int
judge(REAL **arrays, const int64_t *shape, int operands, Walk walk, int max, int how)
{
    Sliding all = {shape[0], shape[1], least(shape[2], shape[0]), 0};
    int beside = how == PUSH ? 2 * operands : operands; /* the array of one row per window */
    const int64_t *stride = shape + 4, *mine = stride + 2 * beside;
    int64_t some = least(all.count, 8 * all.width > CHUNK ? 8 * all.width : CHUNK);
    int64_t apart = least(some + all.width - 1, all.rows), block = least(all.width, apart);
    int64_t room = operands * apart * (how == VALUES ? 1 : 2) + some + 2 * operands * block;
    Values *memory = aligned_alloc(BYTES, (size_t)room * BYTES);
    if (!memory)
        return 1;
    Values *x = memory, *to = x + operands * apart, *rows = to + (how == VALUES ? 0 : operands * apart);
    for (int64_t first = 0; first < shape[3]; first += LANES) {
        int64_t lanes = least(shape[3] - first, LANES);
        if (how == PULL)
            memset(to, 0, (size_t)(operands * apart) * BYTES);
        for (int64_t begin = 0; begin < all.count; begin += some) {
            Sliding s = chunk_at(all, begin, some, apart);
            int last = begin + s.count == all.count;
            for (int i = 0; i < (how == PUSH ? 2 : 1) * operands; i++) {
                const int64_t *its = stride + 2 * i;
                load(arrays[i] + first * its[1] + begin * its[0], its, s.rows, lanes, x + i * apart);
            }
            REAL *values = arrays[beside] + first * mine[1] + begin * mine[0];
            if (how == PULL)
                load(values, mine, s.count, lanes, rows);
            walk(s, x, rows, to, (Best *)(rows + some), max, how);
            if (how != PULL)
                store(rows, mine, s.count, lanes, values);
            for (int i = 0; how == PULL && i < operands; i++) {
                const int64_t *its = mine + 2 + 2 * i;
                REAL *gradient = arrays[operands + 1 + i] + first * its[1] + begin * its[0];
                int64_t done = last ? s.rows : s.count, left = s.rows - done;
                store(to + i * apart, its, done, lanes, gradient);
                if (last) {
                    clear(its, all.rows - begin - done, lanes, gradient + done * its[0]);
                    continue;
                }
                memmove(to + i * apart, to + i * apart + done, (size_t)left * BYTES);
                memset(to + i * apart + left, 0, (size_t)(apart - left) * BYTES);
            }
        }
    }
    free(memory);
    return 0;
}

/* The better of two values; the earlier one where they tie. */
#define BETTER(a, b, max) ((((max) ? (b) > (a) : (b) < (a)) | ((b) != (b))) ? (b) : (a))

/* The same where `b` depends on what was computed before: quicker if `a` is a number. */
#define CHAINED(a, b, max) ((a) != (a) && (b) == (b) ? (a) : ((max) ? (a) > (b) : (a) < (b)) ? (a) : (b))

/* Extrema of `x` over all rows from one on, values alone; with `left`, `until`. Rows lie beside each other. */
static inline __attribute__((always_inline)) void
ended(const REAL *left, const REAL *x, REAL *out, int64_t rows, int64_t count, int64_t traces, int max)
{
    REAL best = (REAL)(max ? -INFINITY : INFINITY);
    for (int64_t i = 0; i < traces; i++)
        out[(count - 1) * traces + i] = best;
    for (int64_t t = rows - 1; t >= 0; t--) {
        const REAL *after = out + least(t + 1, count - 1) * traces;
        REAL *to = out + least(t, count - 1) * traces;
        for (int64_t i = 0, at = t * traces; i < traces; i++, at++) {
            best = CHAINED(x[at], traces == 1 ? best : after[i], max);
            to[i] = best = left ? CHAINED(left[at], best, !max) : best;
        }
    }
}

/* Extrema over `width` rows each: blocks of 1, 2, 4, … rows are joined, some windows at a time, so that they stay in
   the cache. */
static inline __attribute__((always_inline)) int
doubled(const REAL *x, REAL *out, int64_t rows, int64_t count, int64_t width, int64_t traces, int max)
{
    int64_t some = least(count, 4 * width > CHUNK / 2 / traces ? 4 * width : CHUNK / 2 / traces + 1);
    int64_t room = (some + width) * traces;
    REAL *memory = malloc((size_t)(2 * room) * sizeof(REAL));
    if (!memory)
        return 1;
    for (int64_t begin = 0; begin < count; begin += some) {
        int64_t windows = least(some, count - begin) * traces, cells = windows + (width - 1) * traces;
        int64_t there = least(cells, (rows - begin) * traces);
        REAL *from = memory, *to = memory + room;
        memcpy(from, x + begin * traces, (size_t)there * sizeof(REAL));
        for (int64_t i = there; i < cells; i++)
            from[i] = (REAL)(max ? -INFINITY : INFINITY);
        for (int64_t size = 1, next; size < width; size += next) {
            next = least(size, width - size);
            cells -= next * traces;
            const REAL *restrict a = from, *restrict b = from + next * traces;
            REAL *restrict both = to;
            for (int64_t i = 0; i < cells; i++)
                both[i] = BETTER(a[i], b[i], max);
            to = from;
            from = both;
        }
        memcpy(out + begin * traces, from, (size_t)windows * sizeof(REAL));
    }
    free(memory);
    return 0;
}

#define JUDGED(OPERANDS, WALK, HOW) \
    (max ? judge(arrays, shape, OPERANDS, WALK, 1, HOW) : judge(arrays, shape, OPERANDS, WALK, 0, HOW))

/* Both return other than 0 where there is no memory. `max` asks for the maximum, and for `until`; else for the
   minimum, and for `release`. */
int slide_all(REAL **arrays, const int64_t *shape, int max, int how)
{
    return how == VALUES ? JUDGED(1, slide, VALUES) : how == PULL ? JUDGED(1, slide, PULL) : JUDGED(1, slide, PUSH);
}

int double_all(const REAL *x, REAL *out, int64_t rows, int64_t count, int64_t width, int64_t traces, int max)
{
    return max ? doubled(x, out, rows, count, width, traces, 1) : doubled(x, out, rows, count, width, traces, 0);
}

void end_all(const REAL *left, const REAL *x, REAL *out, int64_t rows, int64_t count, int64_t traces, int max)
{
    if (left)
        max ? ended(left, x, out, rows, count, traces, 1) : ended(left, x, out, rows, count, traces, 0);
    else
        max ? ended(0, x, out, rows, count, traces, 1) : ended(0, x, out, rows, count, traces, 0);
}

int until_all(REAL **arrays, const int64_t *shape, int max, int how)
{
    return how == VALUES ? JUDGED(2, until, VALUES) : how == PULL ? JUDGED(2, until, PULL) : JUDGED(2, until, PUSH);
}

/* A step of the plan of a short trace. Numbers are in places, a base and a row there: base 0 is working memory,
   the others are arrays that are given. Without a second place, `number` stands for it. */
typedef struct { int64_t base, row; } Place;
typedef struct { int64_t kind, max, rows, count, width; Place x, y, to; REAL number; } Step;

enum { COPY, ABS, NEG, ADD, MUL, PICK, FILL, WINDOW };

#define EACH(value) \
    for (int64_t i = 0; i < n; i++) { \
        const REAL a = x[i], b = y ? y[i] : number; \
        (void)b; \
        to[i] = (value); \
    } \
    break

/* Returns other than 0 where there is no memory for `room` rows. */
int run_all(const Step *steps, int64_t many, REAL **bases, int64_t room, int64_t traces)
{
    REAL *memory = malloc((size_t)(room * traces + 1) * sizeof(REAL));
    int failed = !memory;
    bases[0] = memory;
    for (const Step *s = steps; s < steps + many && !failed; s++) {
        const REAL *x = bases[s->x.base] + s->x.row * traces, number = s->number;
        const REAL *y = s->y.base < 0 ? 0 : bases[s->y.base] + s->y.row * traces;
        REAL *to = bases[s->to.base] + s->to.row * traces;
        const int64_t n = s->count * traces;
        switch (s->kind) {
        case COPY: memcpy(to, x, (size_t)n * sizeof(REAL)); break;
        case ABS: EACH((REAL)fabs(a));
        case NEG: EACH(-a);
        case ADD: EACH(a + b);
        case MUL: EACH(a * b);
        case PICK:
            if (s->max) { EACH(BETTER(a, b, 1)); } else { EACH(BETTER(a, b, 0)); }
            break;
        case FILL:
            for (int64_t i = 0; i < n; i++)
                to[i] = number;
            break;
        case WINDOW:
            if (s->width >= s->rows)
                end_all(0, x, to, s->rows, s->count, traces, (int)s->max);
            else
                failed = double_all(x, to, s->rows, s->count, s->width, traces, (int)s->max);
        }
    }
    free(memory);
    return failed;
}
