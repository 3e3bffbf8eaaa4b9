"""Splitting of long C functions into parts, since compile time grows fast with the length of a function."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from stlc.compile.backends.c.plan import Plan

LONG = 4_000
"""Length in characters from which a part is closed after its current block."""

_NAME = re.compile(r"\bg?b\d+\b")


@dataclass(frozen=True, slots=True)
class Frame:
    """C function that is split into parts.

    Attributes:
        name: name of the function; its parts are numbered.
        formals: C declarations of its arguments.
        locals: statements at the start of every part.
    """

    name: str
    formals: tuple[str, ...]
    locals: tuple[str, ...] = ()


def in_parts(frame: Frame, blocks: Sequence[Sequence[str]], buffers: Mapping[str, str]) -> list[str]:
    """Split a long C function into short ones; return these, then a function that calls them in order.

    Args:
        frame: name, arguments and local statements of the function.
        blocks: groups of statements that must stay together.
        buffers: C name of a buffer -> its declaration. Each part declares the buffers that it uses.
    """
    lines, calls = [], []
    names = [formal.rpartition(" ")[2] for formal in frame.formals]
    for number, part in enumerate(_parts(blocks)):
        used = dict.fromkeys(name for line in part for name in _NAME.findall(line))
        lines += [
            f"APART static void {frame.name}_{number}({', '.join(frame.formals)}) {{",
            *(f"  {line}" for line in (*frame.locals, *(buffers[name] for name in used), *part)),
            "}",
        ]
        calls.append(f"  {frame.name}_{number}({', '.join(names)});")
    return [*lines, f"static void {frame.name}({', '.join(frame.formals)}) {{", *calls, "}"]


def _parts(blocks: Sequence[Sequence[str]]) -> Iterator[list[str]]:
    part: list[str] = []
    for block in blocks:
        part += block
        if sum(map(len, part)) > LONG:
            yield part
            part = []
    if part:
        yield part


def declared(plan: Plan, *, room: str = "room", prefix: str = "") -> dict[str, str]:
    """Return the C declaration of each buffer of an evaluation plan, by the C name of the buffer.

    Each buffer is declared as a pointer into the C array `room`, the working memory. The names begin with
    `prefix`, so that values and their gradients can have buffers of different names.
    """
    return {
        f"{prefix}{buffer.name}": f"double (*restrict {prefix}{buffer.name})[LANES] ="
        f" (double (*)[LANES])({room} + {buffer.place} * LANES);"
        for buffer in plan.buffers
    }
