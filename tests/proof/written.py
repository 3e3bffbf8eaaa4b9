"""Formulas -> the text of a specification, spelled and bracketed in many ways.

Which brackets are needed is said here once more, from the manual and not from stlc's own printer.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from enum import IntEnum

from proof.language import (
    Atom,
    Choice,
    Constant,
    Edge,
    Formal,
    Formula,
    Frozen,
    Many,
    Meet,
    Not,
    Over,
    Pair,
    Step,
    Use,
    Window,
    nodes,
)

HEAD = """\
spec proof

const c1 = 100 ms
const c3 = 3 * c1
const level = 1 / 2

enum Mode { idle = 0, go = 1, halt = 3 }

signal x, y, z
signal n : int
signal flag : bool
signal lamp : bool
signal mode : Mode
signal q : real[3]

region disc = circle(center = [0, 0], radius = 1)
region block = box(lower = [-1, -1/2], upper = [1, 1/2])
"""

SPELLINGS = {
    "always": ("always", "always", "globally", "alw", "G"),
    "eventually": ("eventually", "eventually", "finally", "ev", "F"),
    "historically": ("historically", "hist"),
    "once": ("once",),
    "until": ("until", "until", "U"),
    "release": ("release",),
    "unless": ("unless",),
    "since": ("since",),
    "and": ("and", "and", "&", "&&"),
    "or": ("or", "or", "|", "||"),
    "xor": ("xor",),
    "->": ("->", "->", "=>", "implies"),
    "<->": ("<->", "<->", "<=>", "iff"),
}


class Level(IntEnum):
    """Precedence of a formula, loosest first."""

    IFF = 0
    IMPLIES = 1
    OR = 2
    AND = 3
    UNTIL = 4
    PREFIX = 5
    COMPARISON = 6
    CLOSED = 7


LOGIC = {"<->": Level.IFF, "->": Level.IMPLIES, "or": Level.OR, "xor": Level.OR, "and": Level.AND}


def specification(formula: Formula, rng: random.Random) -> str:
    """A whole file with one requirement, `r`."""
    writer = _Writer(rng)
    body = writer.text(formula)
    return "\n".join([HEAD, *_declarations(formula, writer), f"require r: {body}\n"])


def _declarations(formula: Formula, writer: _Writer) -> Iterator[str]:
    """The `def`s in use, those that others use first or last as it comes."""
    seen = {node.name: node for node in nodes(formula) if isinstance(node, Use)}
    for use in seen.values():
        formals = f"({', '.join(use.formals)})" if use.formals else ""
        yield f"def {use.name}{formals} = {writer.text(use.template)}"


def _level(formula: Formula) -> Level:
    match formula:
        case Pair(op):
            return LOGIC[op]
        case Many(_, _, text) if text:
            return Level.PREFIX
        case Many(op):
            return LOGIC[op]
        case Meet():
            return Level.UNTIL
        case Not() | Over() | Choice() | Frozen():
            return Level.PREFIX
        case Atom():
            return Level.COMPARISON
        case _:
            return Level.CLOSED


class _Writer:
    def __init__(self, rng: random.Random) -> None:
        self.rng = rng

    def text(self, formula: Formula, least: Level = Level.IFF) -> str:
        """The formula, in brackets where its place asks for them, or for no reason."""
        text = self._plain(formula)
        bare = _level(formula) >= least and self.rng.random() < 0.75
        return text if bare else f"({text})"

    def _plain(self, formula: Formula) -> str:
        match formula:
            case Atom(text) | Formal(text):
                return text
            case Constant(value):
                return "true" if value else "false"
            case Not(body):
                return f"{self.rng.choice(['not ', '!'])}{self.text(body, Level.PREFIX)}"
            case Many():
                return self._many(formula)
            case Pair(op, left, right):
                return self._pair(op, left, right)
            case Choice(cond, yes, no):
                branches = f"if {self.text(cond)} then {self.text(yes)}"
                return f"{branches} else {self.text(no, Level.PREFIX)}"
            case Frozen(bindings, body):
                kept = ", ".join(f"{name} = {text}" for name, text, _ in bindings)
                return f"freeze {kept} in {self.text(body, Level.PREFIX)}"
            case Over(op, window, body):
                return f"{self._timed(op, window)} {self._after(window, body)}"
            case Meet(op, window, left, right):
                timed, right_text = self._timed(op, window), self._after(window, right)
                return f"{self.text(left, Level.PREFIX)} {timed} {right_text}"
            case _:
                return self._called(formula)

    def _after(self, window: Window, body: Formula) -> str:
        """Operand of a temporal operator; a `[` right after the word would start an interval."""
        text = self.text(body, Level.PREFIX)
        return f"({text})" if text.startswith("[") and not window.text else text

    def _called(self, formula: Formula) -> str:
        match formula:
            case Step(steps, body):
                return f"{'next' if steps > 0 else 'prev'}({self.text(body)})"
            case Edge(op, body):
                return f"{op}({self.text(body)})"
            case Use(name, _, arguments):
                return f"{name}({', '.join(map(self.text, arguments))})" if arguments else name
        raise TypeError(formula)

    def _many(self, formula: Many) -> str:
        if formula.text:
            return formula.text
        level = LOGIC[formula.op]
        first, *rest = formula.items
        operands = [self.text(first, level), *(self.text(item, Level(level + 1)) for item in rest)]
        return f" {self.rng.choice(SPELLINGS[formula.op])} ".join(operands)

    def _pair(self, op: str, left: Formula, right: Formula) -> str:
        level = LOGIC[op]
        tighter = Level(level + 1)
        low, high = (tighter, level) if op == "->" else (level, tighter)
        return f"{self.text(left, low)} {self.rng.choice(SPELLINGS[op])} {self.text(right, high)}"

    def _timed(self, op: str, window: Window) -> str:
        word = self.rng.choice(SPELLINGS[op])
        if not window.text:
            return word
        glue = self.rng.choice(["", "", "", " ", "\n  ", "_"])
        if glue == "_" and (window.absolute or window.text.startswith("(")):
            glue = ""
        at = "@" if window.absolute else ""
        return f"{word}{glue}{at}{window.text}"
