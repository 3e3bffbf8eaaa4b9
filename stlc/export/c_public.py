"""A generated header as a guest in somebody's program: C99 and C++11, and no name but its own.

The passes of a controller are those of the native kernel, which stands alone and calls its functions `roll`
and `check`. In a header such names would meet those of the program that includes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

PREFIX = "stlc_"
OWN = ("stlc_", "STLC_")

_DECLARED = (
    re.compile(r"^(?:APART )?static (?:inline )?(?:const )?\w+ \**(\w+)\(", re.M),  # functions
    re.compile(r"^typedef \w+ (\w+)(?:\[\w+\])*;", re.M),
    re.compile(r"^static const [\w *]*?(\w+)(?:\[\w*\])+ = ", re.M),  # arrays
)
_DEFINED = re.compile(r"^#define (\w+)", re.M)
_TOKEN = re.compile(
    r"""/\*.*?\*/ | "(?:\\.|[^"\\])*" | \#include[^\n]*            # left as they are
    | (?P<hex>0x[0-9a-f]+(?:\.[0-9a-f]*)?p[+-]?\d+)
    | (?P<word>(?<![\w.])(?<!->)[A-Za-z_]\w*)""",
    re.S | re.X,
)
_OPENING = """
#ifdef __cplusplus
#define STLC_RESTRICT __restrict
#else
#define STLC_RESTRICT restrict
#endif
#if defined(__GNUC__) /* what the generated passes do not need of what they are given */
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#endif
"""
_CLOSING = """
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
"""


def public(texts: Mapping[str, str], guard: str) -> dict[str, str]:
    """Files of a header with every name of theirs prefixed, and with nothing that C++11 does not know.

    Args:
        texts: name of a file -> its text; what one declares the others may use.
        guard: the macro that keeps the header from being read twice, by an `#endif` in its last line.
    """
    names = dict(found for text in texts.values() for found in _renamed(text))
    names |= {"restrict": "STLC_RESTRICT", guard: guard}
    written = {file: _TOKEN.sub(lambda token: _written(token, names), text) for file, text in texts.items()}
    return {file: _framed(text, f"#define {guard}\n") for file, text in written.items()}


def _renamed(text: str) -> Iterator[tuple[str, str]]:
    """What a text declares, and what it is called from now on."""
    for pattern in _DECLARED:
        yield from ((name, PREFIX + name) for name in pattern.findall(text) if not name.startswith(OWN))
    for name in _DEFINED.findall(text):
        if not name.startswith(OWN):
            yield name, PREFIX.upper() + name


def _written(token: re.Match[str], names: Mapping[str, str]) -> str:
    if token["hex"]:
        return repr(float.fromhex(token["hex"]))  # C++ knows hexadecimal fractions from C++17 on
    return names.get(token["word"], token[0]) if token["word"] else token[0]


def _framed(text: str, guard: str) -> str:
    """The file with the guard, between what its compiler is told before and after; others as they are."""
    if guard not in text:
        return text
    body, end = text.replace(guard, guard + _OPENING, 1).rsplit("#endif", 1)
    return f"{body.rstrip()}\n{_CLOSING}\n#endif{end}"
