"""A generated header as a guest: its names, its numbers, and what C++ does not know."""

from __future__ import annotations

from stlc.export.c_header import public

HEADER = """\
#ifndef OURS_H
#define OURS_H
#include "stlc_weights.h"
#define LANES 16
#define STLC_TOLERANCE 1e-6
typedef double lane[LANES];
static const double stlc_dt = (0x1.999999999999ap-4);
typedef struct { double depth; } stlc_state;
APART static void roll_0(const lane *restrict x, double *restrict out) { /* roll_0 of LANES, restrict */
  out[0] = x[0][0] * (-0x1.0000000000000p+3) + centre[0];
}
static inline int roll(stlc_state *c) { c->lane = LANES; return "roll"[0]; }
#endif
"""
WEIGHTS = "static const float centre[] = {1.0f};\n"


def written() -> dict[str, str]:
    return public({"ours.h": HEADER, "stlc_weights.h": WEIGHTS}, "OURS_H")


def test_what_is_declared_is_prefixed_wherever_it_is_used() -> None:
    text = written()["ours.h"]
    assert "#define STLC_LANES 16\n" in text
    assert "typedef double stlc_lane[STLC_LANES];" in text
    assert "APART static void stlc_roll_0(const stlc_lane *STLC_RESTRICT x" in text
    assert "+ stlc_centre[0];" in text
    assert written()["stlc_weights.h"] == "static const float stlc_centre[] = {1.0f};\n"


def test_what_is_public_or_no_name_stays() -> None:
    text = written()["ours.h"]
    assert "static const double stlc_dt" in text
    assert "#define STLC_TOLERANCE 1e-6" in text
    assert '#include "stlc_weights.h"' in text
    assert "/* roll_0 of LANES, restrict */" in text
    assert 'c->lane = STLC_LANES; return "roll"[0];' in text  # neither a member nor a string


def test_numbers_are_the_same_in_digits_that_cpp_reads() -> None:
    text = written()["ours.h"]
    assert "0x" not in text
    assert "stlc_dt = (0.1);" in text
    assert "(-8.0)" in text


def test_compilers_are_told_once_and_told_off_again() -> None:
    text = written()["ours.h"]
    assert text.startswith(
        "#ifndef OURS_H\n#define OURS_H\n\n#ifdef __cplusplus\n#define STLC_RESTRICT __restrict\n"
    )
    assert text.count("diagnostic push") == text.count("diagnostic pop") == 1
    assert text.endswith("#pragma GCC diagnostic pop\n#endif\n\n#endif\n")
    assert "#pragma" not in written()["stlc_weights.h"]
