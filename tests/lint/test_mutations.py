"""Whatever is done to a specification: parse, lint, fix and fmt give findings or a text, no traceback."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from stlc.diagnostics import SpecError
from stlc.grammar.english import sentence
from stlc.grammar.format.format import format_text
from stlc.grammar.scan import Lexeme
from stlc.grammar.spec import Spec
from stlc.lint.lint import Selection, fix, lint
from stlc.source import Source

ROOT = Path(__file__).resolve().parents[2]
TEXTS = [path.read_text() for path in sorted((ROOT / "tests/grammar/data").glob("*.stl"))]
PIECES = [
    *(
        "always",
        "G",
        "U",
        "until[0, 1 s]",
        "and",
        "||",
        "->",
        "(",
        ")",
        "[",
        "]",
        "{",
        "@",
        ";",
        ",",
        "..",
        "%",
    ),
    *("# c\n", "// d\n", "## e\n", "\n", " ", "require r:", "def f(a) =", "const c =", "signal x", "@safety"),
    *("1e308", "1e999", "0", "-", "!", "not", "in", "□", "≤", "|", '"', "`", "\0", "\r", "freeze a = b in"),
    *(
        "if a then b else",
        "forall i in 0..2:",
        "5 %",
        "m/s^2",
        "T",
        "end",
        "inf",
        "end",
        "\u202e",
        "²",
        "..",
        "%",
    ),
]
EVERYTHING = Selection(("ALL",))


def mutated(text: str, source: random.Random) -> str:
    """The text after a few cuts, swaps, repetitions and insertions."""
    for _ in range(source.randint(1, 4)):
        items = list(Lexeme.scan(text))
        if not items:
            return source.choice(PIECES)
        one, other = source.choice(items), source.choice(items)
        match source.randrange(5):
            case 0:
                text = text[: one.start] + text[one.end :]
            case 1:
                text = text[: one.start] + source.choice(PIECES) + text[one.start :]
            case 2:
                text = text[: one.start] + other.text + text[one.end :]
            case 3:
                first, last = sorted((one.start, other.start))
                text = text[:first] + text[min(last, first + 200) :]
            case _:
                first, last = sorted((one.start, other.end))
                text = text[:last] + " " + text[first : min(last, first + 100)] + text[last:]
    return text


def tread(text: str) -> bool:
    """Everything that reads a text; whether it is well-formed."""
    source = Source("mutated", text)
    found = lint(source, selection=EVERYTHING)
    assert all(finding.code for finding in found)
    repaired = fix(source, lint)
    errors = [sum(f.severity == "error" for f in some) for some in (found, repaired.findings)]
    assert errors[1] <= errors[0]
    try:
        spec = Spec.parse(source)
    except SpecError:
        return False
    for item in spec.items:
        if hasattr(item, "formula"):
            assert sentence(item)
    once = format_text(source)
    assert Spec.parse(Source("again", once)) == spec
    assert format_text(Source("again", once)) == once
    return True


def run(count: int, seed: int) -> int:
    source = random.Random(seed)
    valid = 0
    for _ in range(count):
        text = mutated(source.choice(TEXTS)[: source.choice((400, 1500))], source)
        valid += tread(text)
    return valid


def test_mutated_specifications():
    assert run(40, seed=1) > 0


@pytest.mark.slow
def test_many_mutated_specifications():
    """5,000 of them."""
    assert run(5000, seed=2) > 100
