/* Tables of numbers: text -> columns of doubles, each correctly rounded.

A cell is a decimal number of up to 19 digits with blanks around it, or blank, which is NaN. What is neither is a
doubt: its place is noted, and somebody else reads it. Cells of columns that nobody wants are passed over. A cell
may be in quotes, as in RFC 4180. Lines without anything in them are left out. The text ends with a byte of 0
behind its last one. */

#include <math.h>
#include <stdint.h>

typedef unsigned __int128 wide;

enum { POWERS = 28 };

static const uint64_t FULL = 1000000000000000000; /* with 19 digits; more might not fit */

typedef struct {
    const char *at, *end;
    char mark, point; /* between cells, and besides `.` before decimals */
    uint64_t fives[POWERS];
} reader;

static int bits(uint64_t x) { return 64 - __builtin_clzll(x); }

static double two_to(int power) {
    union { uint64_t bits; double value; } made = {(uint64_t)(1023 + power) << 52};
    return made.value;
}

/* `m * 10^e`, rounded once: of an exact product or quotient 63 bits or more are kept, the last says "and more". */
static double scaled(const reader *r, uint64_t m, int e) {
    if (e < 0) {
        uint64_t by = r->fives[-e];
        int shift = 63 + bits(by) - bits(m);
        wide over = (wide)m << shift;
        uint64_t quotient = (uint64_t)(over / by);
        return (double)(quotient | (over != (wide)quotient * by)) * two_to(e - shift);
    }
    wide product = (wide)m * r->fives[e];
    uint64_t high = (uint64_t)(product >> 64);
    int shift = high ? bits(high) : 0;
    uint64_t kept = (uint64_t)(product >> shift);
    return (double)(kept | (product != (wide)kept << shift)) * two_to(e + shift);
}

static int is_digit(char c) { return (unsigned char)(c - '0') < 10; }

static int ends_cell(const reader *r, const char *at) {
    return *at == r->mark || *at == '\n' || *at == '\r' || at == r->end;
}

static const char *past_blanks(const reader *r, const char *at) {
    while (*at == ' ' || (*at == '\t' && r->mark != '\t')) at++;
    return at;
}

/* The power of ten behind an `e`, if there is one; null where it is not one of up to four digits. */
static const char *exponent(const char *at, int64_t *power) {
    if (*at != 'e' && *at != 'E') return at;
    int negative = *++at == '-';
    at += negative || *at == '+';
    const char *first = at;
    int64_t read = 0;
    while (is_digit(*at) && at - first < 4) read = 10 * read + (*at++ - '0');
    *power += negative ? -read : read;
    return at == first ? 0 : at;
}

/* Where the number at `at` ends; null where it is none, or has too many digits. */
static const char *number(const reader *r, const char *at, double *value) {
    int negative = *at == '-';
    at += negative || *at == '+';
    uint64_t m = 0;
    int64_t power = 0;
    int any = 0;
    for (int behind = 0; behind < 2; behind++) {
        for (; is_digit(*at); at++, any = 1, power -= behind) {
            if (m >= FULL) return 0;
            m = 10 * m + (uint64_t)(*at - '0');
        }
        if (*at != '.' && *at != r->point) break;
        if (behind) return 0;
        at++;
    }
    at = any ? exponent(at, &power) : 0;
    if (!at) return 0;
    if (m && (power <= -POWERS || power >= POWERS)) return 0;
    *value = m ? scaled(r, m, (int)power) : 0.0;
    *value = negative ? -*value : *value;
    return at;
}

/* Where the cell in quotes at `at` ends; null where it does not, or where more than blanks follow it. */
static const char *past_quotes(const reader *r, const char *at) {
    do {
        for (at++; *at != '"'; at++)
            if (at == r->end) return 0;
    } while (*++at == '"');
    at = past_blanks(r, at);
    return ends_cell(r, at) ? at : 0;
}

/* Reads one cell, if `value` is not null, and stands behind it.
   Gives 0 for a blank one, 1 for a number, 2 for a doubt, -1 where its quotes are not closed. */
static int cell(reader *r, double *value) {
    const char *at = r->at, *behind;
    at = past_blanks(r, at);
    if (*at == '"') {
        for (behind = r->at; behind < at; behind++)
            if (*behind != ' ') return -1;
        if (value) *value = NAN;
        int blank = *(behind = past_blanks(r, at + 1)) == '"' && behind[1] != '"';
        behind = past_quotes(r, at);
        return behind ? r->at = behind, blank ? 0 : 2 : -1;
    }
    behind = value && !ends_cell(r, at) ? number(r, at, value) : 0;
    if (behind) behind = past_blanks(r, behind);
    if (behind && ends_cell(r, behind)) return r->at = behind, 1;
    if (value) *value = NAN;
    if (ends_cell(r, at)) return r->at = at, 0;
    while (!ends_cell(r, at)) at++;
    return r->at = at, 2;
}

static int is_comment(const char *at) {
    while (*at == ' ') at++;
    return *at == '#' || *at == '%' || (*at == '/' && at[1] == '/');
}

/* All lines of `text`.

   shape: bytes of text, cells of a line, rows there is room for, doubts there is room for, the mark, the point, and
   whether each line ends with a line feed, has so many cells, and has something in them.
   places: for each column its place in `out`, -1 for one that is not wanted.
   out: (wanted, rows). doubts: how many, then row, place, first and last byte of each.
   Gives the number of rows; -1 for a line with fewer cells or with more that are not blank (or otherwise than asked),
   for a comment and for quotes that are not closed; -2 for too many doubts. */
int64_t read_cells(const char *text, const int64_t *shape, const int64_t *places, double *out, int64_t *doubts) {
    int64_t width = shape[1], rows = shape[2], row = 0;
    reader r = {.at = text, .end = text + shape[0], .mark = (char)shape[4], .point = (char)shape[5], .fives = {1}};
    for (int i = 1; i < POWERS; i++) r.fives[i] = 5 * r.fives[i - 1];
    doubts[0] = 0;
    while (r.at < r.end) {
        int told = 0;
        int64_t column = 0;
        if (is_comment(r.at)) return -1;
        for (;; r.at++, column++) {
            const char *first = r.at;
            int64_t place = column < width && row < rows ? places[column] : -1;
            double value;
            int kind = cell(&r, place < 0 ? 0 : &value);
            told |= kind;
            if (kind < 0 || (kind && (column >= width || row >= rows))) return -1;
            if (place >= 0) out[place * rows + row] = value;
            if (kind == 2 && place >= 0) {
                if (doubts[0] >= shape[3]) return -2;
                int64_t *doubt = doubts + 1 + 4 * doubts[0]++;
                doubt[0] = row, doubt[1] = place, doubt[2] = first - text, doubt[3] = r.at - text;
            }
            if (r.at == r.end || *r.at != r.mark) break;
        }
        int fed = *r.at++ == '\n';
        if (shape[6]) {
            if (!fed && r.at < r.end && *r.at++ != '\n') return -1;
            if (!told || column + 1 != width) return -1;
        }
        if (!told) continue;
        if (column + 1 < width) return -1;
        row++;
    }
    return row;
}
