"""Conversion of words in a trace to numbers; words are members of enums, or truth values.

An array of words or complex numbers may not be needed as a signal. It is then kept as an extra, which is
never evaluated. In a needed signal, complex numbers and words without a number are errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.trace.formats.cells import value_of
from stlc.trace.recording import ClockGroup, Recording

Words = Mapping[str, float]


def in_numbers(recording: Recording, words: Mapping[str, Words]) -> Recording:
    """Return the content of a trace file with words converted to numbers.

    Args:
        recording: content of the trace file; its arrays may be texts.
        words: numbers that stand for words, such as `{"sign": {"stop": 0, "light": 1}}`. The keys are the
            names that all needed signals have in the file. The value for a signal of numbers is an empty
            mapping. Other arrays of words or complex numbers become extras, which are never evaluated.

    Raises:
        TraceError: E603, words or complex numbers where numbers are needed, or a word that is not a value of
            the signal.
    """
    groups: list[ClockGroup] = []
    extras = dict(recording.extras)
    for group in recording.groups:
        arrays = dict(group.arrays)
        for name in [name for name, values in arrays.items() if _is_odd(values)]:
            key = name if name in words else name.partition("[")[0]  # of a vector, all components
            if key in words:
                arrays[name] = _numbers(recording.name, name, arrays[name], words[key])
            else:
                extras[name] = arrays.pop(name)
        groups.append(replace(group, arrays=arrays))
    return replace(recording, groups=tuple(groups), extras=extras)


def wordless(recording: Recording) -> Recording:
    """Return the content of a trace file with signals of words moved to the extras (unevaluated arrays).

    Raises:
        TraceError: E603, all signals are words.
    """
    signals = [values for group in recording.groups for values in group.arrays.values()]
    none_left = all(map(_is_odd, signals))
    return in_numbers(recording, {name: {} for name in recording.signals} if none_left else {})


def _is_odd(values: NDArray[Any] | None) -> bool:
    """True if an array contains words, dates or complex numbers, which are not signal values."""
    return values is not None and values.dtype.kind in "UcMm"


def _require_numbers(trace: str, name: str, values: NDArray[Any]) -> None:
    if values.dtype.kind == "U":
        return
    held, advice = (
        "complex numbers",
        f"save the parts that are meant, e.g.  re = real({name});  im = imag({name});",
    )
    if values.dtype.kind in "Mm":
        held, advice = "dates, not numbers", f"as the clock of the trace:  --clock {name}"
    raise TraceError.of("E603", f"`{name}` in `{trace}` holds {held}", help=(advice,))


def number_of_word(trace: str, name: str, word: str, words: Words) -> float:
    """Return the number that `word` stands for. Raises TraceError (E603) for an unknown word."""
    worth = _worth(word, words)
    if worth is None:
        raise TraceError(_unknown(trace, name, word, words))
    return worth


def _numbers(trace: str, name: str, values: NDArray[Any], words: Words) -> NDArray[np.float64]:
    _require_numbers(trace, name, values)
    found, places = np.unique(values, return_inverse=True)
    worth = [_worth(str(word), words) for word in found]
    if None in worth:
        odd = str(found[worth.index(None)])
        raise TraceError(_unknown(trace, name, odd, words))
    return np.asarray(worth, dtype=np.float64)[places].reshape(values.shape)


def _worth(word: str, words: Words) -> float | None:
    """Return the number that a word stands for; NaN for an empty word, None for an unknown one."""
    if word in words:
        return words[word]
    if not word:
        return math.nan
    alike = {value for name, value in words.items() if name.lower() == word.lower()}
    return alike.pop() if len(alike) == 1 else value_of(word.strip())


def _unknown(trace: str, name: str, word: str, words: Words) -> Diagnostic:
    shown = word if len(word) <= 40 else f"{word[:40]}…"
    if not words:
        advice = (
            "truth values are written as true and false, or as 1 and 0",
            f"words need an enum in the specification: enum Kind {{ … }}  and  signal {name} : Kind",
        )
        return Diagnostic("E603", f"`{name}` in `{trace}` holds words (`{shown}`), not numbers", help=advice)
    note = (f"it is one of {', '.join(words)}, or a number",)
    return Diagnostic("E603", f"`{name}` in `{trace}` cannot be `{shown}`", note=note).near(word, words)
