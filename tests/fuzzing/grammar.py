"""Random specifications from a grammar: all constructs, mostly well-formed, often well-typed."""

import random
import re
from collections.abc import Callable

Draw = Callable[[random.Random, int], str]
_DEEPEST = 4
_SPACES = ("", " ", " ", " ", " ", "\n  ", " # c\n")


def specification(rng: random.Random) -> str:
    """A whole file: some declarations and some requirements."""
    heads = ["", "", "", "", "spec drawn\n", "time s\n", "import std\n", "time steps\nimport std as s\n"]
    names = "signal x, y, z in [-5, 5]\nsignal flag : bool\nsignal q : real[3]\n"
    items = [rng.choice(_ITEMS)(rng, number) for number in range(rng.choice([0, 1, 1, 2, 4]))]
    items += [_require(rng, number) for number in range(rng.choice([1, 1, 1, 2]))]
    if rng.random() < 0.05:
        rng.shuffle(items)
    return rng.choice(heads) + names + "\n".join(items) + rng.choice(["", "\n"])


def formula(rng: random.Random, depth: int = 1) -> str:
    """A formula, sometimes malformed."""
    if depth >= _DEEPEST or rng.random() < 0.2 * depth:
        return rng.choice(_ATOMS)(rng, depth + 1)
    return rng.choice(_FORMULAS)(rng, depth + 1)


def number(rng: random.Random, depth: int = 0) -> str:
    """A numeric expression, sometimes malformed."""
    if depth >= _DEEPEST or rng.random() < 0.5:
        return rng.choice(_NUMBERS) if rng.random() < 0.6 else f"{literal(rng)}{rng.choice(_UNITS)}"
    return rng.choice(_ARITHMETIC)(rng, depth + 1)


def literal(rng: random.Random) -> str:
    """A number as written."""
    usual = ("0", "1", "2", "0.5", "10", "1e-3", "3.", ".5", "1_000")
    return rng.choice(usual if rng.random() < 0.97 else _ODD)


_ODD = ("1e308", "1e-308", "5e-324", "1e309", "9007199254740993", "1e18", "10000000000000000000000", "1e-400")
_NUMBERS = (*"xy" * 12, *"z" * 8, *["q[0]", "q[1]"] * 4, "k", "i", "flag", "p", "q")
_UNITS = (*[""] * 30, " m", " s", " ms", " m/s", " deg", " %", " steps", " h", " km^2")
_NAMES = ("d", "near", "near", "near", "k", "r", "x", "`always`", "π")


def _interval(rng: random.Random) -> str:
    low, high = rng.choice(["0", "0", "0.1", "1", "0.05"]), rng.choice(["1", "0.3", "2", "T", "end", "inf"])
    if rng.random() < 0.05:
        low, high = number(rng, 3), number(rng, 3)
    unit = rng.choice(["", " s", " s", " steps", " ms"])
    low, high = (f"{end}{unit}" if end.replace(".", "").isdigit() else end for end in (low, high))
    return rng.choice(["", "", "", "@"]) + rng.choice("[[[(") + f"{low}, {high}" + rng.choice("]]])")


def _window(rng: random.Random) -> str:
    return _interval(rng) if rng.random() < 0.75 else ""


def _gap(rng: random.Random) -> str:
    return rng.choice(_SPACES)


def _temporal(rng: random.Random, depth: int) -> str:
    word = rng.choice(["always", "eventually", "once", "historically", "G", "F"])
    window = _window(rng) if rng.random() < 0.98 else rng.choice(["@", "[0,", "(0 s]", "[0 s s, 1]"])
    return f"{word}{window} {_wrapped(rng, depth)}"


def _until(rng: random.Random, depth: int) -> str:
    word = rng.choice(["until", "release", "unless", "since", "U"])
    return f"{_wrapped(rng, depth)} {word}{_window(rng)} {_wrapped(rng, depth)}"


def _wrapped(rng: random.Random, depth: int) -> str:
    text = formula(rng, depth)
    return f"({text})" if rng.random() < 0.8 else text


def _joined(rng: random.Random, depth: int) -> str:
    word = rng.choice(["and", "or", "->", "<->", "xor", "&", "||", "=>", "iff", "implies"])
    return f" {word}{_gap(rng)} ".join(_wrapped(rng, depth) for _ in range(rng.choice([2, 2, 3])))


def _bound(rng: random.Random, depth: int) -> str:
    return rng.choice(
        [
            f"forall i in 0..{rng.choice(['1', '2', '2', '9', 'k'])}: {_wrapped(rng, depth)}",
            f"exists i in {{0, {literal(rng)}}}: {_wrapped(rng, depth)}",
            f"freeze p = {number(rng, depth)} in {_wrapped(rng, depth)}",
            f"if {formula(rng, depth)} then {formula(rng, depth)} else {_wrapped(rng, depth)}",
            f"{rng.choice(['rise', 'fall', 'prev', 'not ', '!', 'next'])}({formula(rng, depth)})",
            f"shift({formula(rng, depth)}, {rng.choice(['1 steps', '-2', '1'])})",
            f"not {rng.choice(['s.', 'std.'])}response({formula(rng, depth)}, {formula(rng, depth)}, 1 s)",
        ]
    )


_FORMULAS: tuple[Draw, ...] = (_temporal, _temporal, _until, _joined, _joined, _bound)


def _comparison(rng: random.Random, depth: int) -> str:
    signs = rng.choices(["<", "<=", ">", ">="] * 6 + ["==", "!="], k=rng.choice([1, 1, 1, 2]))
    return number(rng, depth) + "".join(f" {sign}{_gap(rng)}{number(rng, depth)}" for sign in signs)


def _member(rng: random.Random, depth: int) -> str:
    word = rng.choice(["in", "not in"])
    if rng.random() < 0.3:
        return f"{number(rng, depth)} {word} {{{number(rng, depth)}, 2}}"
    return f"[{number(rng, depth)}, {number(rng, depth)}] {word} {region(rng, depth)}"


def _simple(rng: random.Random, _depth: int) -> str:
    return rng.choice(
        ["x > 0", "y <= 1", "flag", "true", "false", "d", "near(x, y)", "z in {1, 2}", "q[2] < 1"]
    )


_ATOMS: tuple[Draw, ...] = (_comparison, _comparison, _simple, _member)


def region(rng: random.Random, depth: int = 0) -> str:
    """A region, sometimes malformed."""
    a, b = number(rng, depth), number(rng, depth)
    simple = [
        f"circle(center = [{a}, {b}], radius = {literal(rng)})",
        f"box([{a}, 0], [{b}, 2])",
        f"halfspace([1, {a}], {b})",
        f"polygon([0, 0], [1, 0], [{a}, 1], [0, {b}])",
    ]
    if depth >= _DEEPEST:
        return rng.choice(simple)
    nested = [
        f"{rng.choice(['union', 'intersect'])}({region(rng, depth + 1)}, {region(rng, depth + 1)})",
        f"complement({region(rng, depth + 1)})",
        f"dilate({region(rng, depth + 1)}, {a})",
    ]
    return rng.choice([*simple, *nested])


def _binary(rng: random.Random, depth: int) -> str:
    return f"{number(rng, depth)} {rng.choice('++-**/%^')} {number(rng, depth)}"


def _call(rng: random.Random, depth: int) -> str:
    name = rng.choice(_CALLED.split())
    return f"{name}({', '.join(number(rng, depth) for _ in range(rng.choice([1, 1, 2, 2, 3])))})"


_CALLED = (
    "abs abs sqrt exp log sin cos tan atan2 min max min max norm floor sign clip ind prev delta dist dot pow"
)


def _odd(rng: random.Random, depth: int) -> str:
    return rng.choice(
        [
            f"-{number(rng, depth)}",
            f"({number(rng, depth)})",
            f"[{number(rng, depth)}, {number(rng, depth)}]",
            f"(if {formula(rng, depth)} then {number(rng, depth)} else {number(rng, depth)})",
            f"ind({formula(rng, depth)})",
            f"q[{number(rng, depth)}]",
            f"norm([{number(rng, depth)}, {number(rng, depth)}])",
            f"f({number(rng, depth)})",
            "m.x",
        ]
    )


_ARITHMETIC: tuple[Draw, ...] = (_binary, _binary, _call, _odd)


def _require(rng: random.Random, number_: int) -> str:
    tag = rng.choice(["@safety ", "@liveness ", "@weight(2) ", "@scale(3) ", '@id("r1") ', "", "", ""])
    doc = rng.choice(["", "", "## why\n", "# not why\n"])
    return f"{doc}{tag}require r{number_}: {formula(rng)}"


def _region(rng: random.Random, _number: int) -> str:
    return f"region disc = {region(rng, 2)}"


def _about_a(text: str) -> str:
    return re.sub(r"\bx\b", "a", text)


def _define(rng: random.Random, number_: int) -> str:
    if rng.random() < 0.5:
        return f"def f{number_}(a) = {_about_a(number(rng, 2))}"
    return f"def {rng.choice(_NAMES)}(a, b) = {_about_a(formula(rng, 3))}"


def _constant(rng: random.Random, number_: int) -> str:
    value = f"{literal(rng)}{rng.choice(_UNITS)}" if rng.random() < 0.5 else number(rng, 2)
    return f"const {rng.choice(['k', 'k', f'k{number_}'])} = {value}"


def _other(rng: random.Random, number_: int) -> str:
    file = rng.choice(["a.stl", "b.yaml", "none.stl", ".", "/dev/null"])
    return rng.choice(
        [
            f"param p{number_} in [{literal(rng)}, {literal(rng)}]",
            f"enum E{number_} {{ a{number_} = {rng.choice(['0', '7', literal(rng)])}, b{number_} = -1 }}",
            f"def d = {formula(rng, 2)}",
            f"extern fn g{number_}(a: real, b: real) -> real [m]",
            f"assume a{number_}: {formula(rng, 3)}",
            f"{rng.choice(['', 'input ', 'env '])}signal w{number_} [{rng.choice(['m', '1', 'm/s^2'])}]",
            f'system "{file}"',
            f'import "{file}" as m',
        ]
    )


_ITEMS: tuple[Draw, ...] = (_region, _define, _constant, _other, _other)
