"""Size bombs: specifications and systems with `n`-fold nesting, chaining or multiplication of constructs."""

from collections.abc import Iterator

_HEAD = "signal x\nsignal y\nsignal q : real[3]\nregion disc = circle(center = [0, 0], radius = 1)\n"
_COMMENT = "\n# c\n"
_BEFORE = (
    *("not ", "!", "-", "+", "always ", "eventually ", "once ", "historically ", "next ", "G ", "F ", "□"),
    *("always[0, 1 s] ", "eventually(0, 1 s] ", "once@[0, 1 s] ", "freeze p = x in ", "forall i in 0..1: "),
    *("exists i in {0, 1}: ", "if x > 0 then y > 0 else ", "if x > 0 then ", "x > 0 until ", "x > 0 -> "),
    *("x + ", "x ^ ", "x - -", "x * (", "x / ", "x > ", "x > 0 and (", "(", "[", "{", '"', "`", "@safety "),
    *("always[", "always[0, ", "always(", "until[0, 1 s] ", "until (", "f(", "x[", "x.", "norm([", "prev("),
    *("next(", "ind(", "sweep(", "shift(", "complement(", "union(disc, ", "dilate(", "x in union(", "## a\n"),
)
_BETWEEN = (
    *("and", "or", "->", "<->", "xor", "until", "since", "release", "unless", "until[0, 1 s]", "&", "||"),
    *("<", "==", "in", "+", "-", "*", "/", "%", "^", ",", ";", ".", "..", "@"),
)
_AROUND = ("()", "[]", "{}", ("norm([", "])"), ("complement(", ")"), ("next(", ")"), ("abs(", ")"))


def specifications(n: int) -> Iterator[tuple[str, str]]:
    """(name, text) of every bomb of size `n`."""
    for before in _BEFORE:
        yield f"{n} times {before!r}", f"{_HEAD}require r: {before * n}x > 0"
        yield f"{n} times {before!r} alone", before * n
    for between in _BETWEEN:
        for part in ("x > 0", "x", "(x > 0)"):
            yield f"{n} times {between!r} of {part}", f"{_HEAD}require r: {f' {between} '.join([part] * n)}"
    for first, last in _AROUND:
        yield f"{n} times {first} {last}", f"{_HEAD}require r: {first * n}x > 0{last * n}"
        yield f"{n} times {first} {last} reversed", f"{_HEAD}require r: {last * n}x > 0{first * n}"
    yield from _chains(n)
    yield from _multiplied(min(n, 60))
    yield from _huge()


def _chains(n: int) -> Iterator[tuple[str, str]]:
    for kind, first, step in (
        ("def", "def d0 = x > 0", "def d{i} = not d{j}"),
        ("const", "const d0 = 1", "const d{i} = d{j} + 1"),
        ("call", "def d0(a) = a > 0", "def d{i}(a) = d{j}(a + 1)"),
        ("region", "region d0 = disc", "region d{i} = complement(d{j})"),
        ("power", "const d0 = 2", "const d{i} = d{j} * d{j}"),
        ("squares", "const d0 = 2.5", "const d{i} = d{j} ^ 2"),
    ):
        lines = [first, *(step.format(i=i, j=i - 1) for i in range(1, n))]
        use = {"def": "d{}", "call": "d{}(x)", "region": "[x, y] in d{}"}.get(kind, "x > d{}").format(n - 1)
        yield f"a chain of {n} {kind}", "\n".join([_HEAD, *lines, f"require r: {use}"])
        yield f"a chain of {n} {kind}, backwards", "\n".join([_HEAD, f"require r: {use}", *lines[::-1]])
    yield from _lists(n)
    yield from _letters(n)


def _lists(n: int) -> Iterator[tuple[str, str]]:
    """Long lists and chains."""
    members = ", ".join(f"e{i}" for i in range(n))
    yield f"{n} members", f"enum E {{ {members} }}\nsignal e : E\nrequire r: e == e{n - 1}"
    points = ", ".join(f"[{i}, {i * i}]" for i in range(n))
    yield f"{n} vertices", f"{_HEAD}region p = polygon({points})\nrequire r: [x, y] in p"
    crossed = ", ".join(f"[{i * 7 % 101}, {i * 11 % 97}]" for i in range(n))
    yield f"{n} crossed vertices", f"{_HEAD}region p = polygon({crossed})\nrequire r: [x, y] in p"
    yield f"{n} requirements", _HEAD + "\n".join(f"require r{i}: x > {i}" for i in range(n))
    yield f"{n} times the same requirement", _HEAD + "require r: x > 0\n" * n
    yield f"{n} unknown names", _HEAD + "\n".join(f"require r{i}: u{i} > 0" for i in range(n))
    yield f"{n} parameters", f"def f({', '.join(f'a{i}' for i in range(n))}) = a0\nrequire r: f(1) > 0"
    yield f"{n} named arguments", f"{_HEAD}require r: f({', '.join(f'a{i} = x' for i in range(n))}) > 0"
    yield (
        f"{n} frozen names",
        f"{_HEAD}require r: freeze {', '.join(f'p{i} = x' for i in range(n))} in x > p0",
    )


def _letters(n: int) -> Iterator[tuple[str, str]]:
    """Long words, blanks and comments."""
    yield f"{n} letters", f"signal {'v' * n}\nrequire r: {'v' * n}x > 0"
    yield f"{n} digits", f"{_HEAD}require r: x > {'9' * n}"
    yield f"{n} blanks", f"{_HEAD}require r:{' ' * n}x > 0"
    yield f"{n} blanks and a bracket", f"{_HEAD}require r: always{' ' * n}x > 0 until{' ' * n}@ (x > 0)"
    yield f"{n} comments", f"{_HEAD}require r: always{'# c' * n}{_COMMENT * n}x > 0"
    yield f"{n} symbols of a unit", f"signal u [{'m*' * n}s]\nrequire r: u > 1 {'m*' * n}s"
    yield f"{n} lines", "\n" * n
    yield f"{n} zeros", "\0" * n


def _multiplied(few: int) -> Iterator[tuple[str, str]]:
    """Constructs that grow exponentially when expanded."""
    for word in ("and", "or", "<->", "->", "xor", "until", "since", "unless[0, 1 s]", "+", "*", "^"):
        start = "x" if word in "+*^" else "x > 0"
        doubled = "\n".join(f"def d{i} = (d{i - 1}) {word} (d{i - 1})" for i in range(1, few))
        goal = f"d{few - 1}" + (" > 0" if start == "x" else "")
        yield f"{few} doublings by {word}", f"{_HEAD}def d0 = {start}\n{doubled}\nrequire r: {goal}"
        calls = "\n".join(f"def f{i}(a) = f{i - 1}(a) {word} f{i - 1}(a)" for i in range(1, few))
        goal = f"f{few - 1}(x)" + (" > 0" if start == "x" else "")
        head = f"def f0(a) = {start.replace('x', 'a')}"
        yield f"{few} doubled calls by {word}", f"{_HEAD}{head}\n{calls}\nrequire r: {goal}"
    for word in ("union", "intersect"):
        lines = "\n".join(f"region g{i} = {word}(g{i - 1}, g{i - 1})" for i in range(1, few))
        yield (
            f"{few} doublings by {word}",
            f"{_HEAD}region g0 = disc\n{lines}\nrequire r: [x, y] in g{few - 1}",
        )
    grown = "\n".join(f"def v{i} = [v{i - 1}, v{i - 1}]" for i in range(1, few))
    yield f"{few} doubled vectors", f"{_HEAD}def v0 = x\n{grown}\nrequire r: norm(v{few - 1}) > 0"
    for text in (
        "forall i in 0..9: ",
        "exists i in 0..30: ",
        "always[0, 9 s] once[0, 9 s] ",
        "not always@[1 s, 2 s] ",
    ):
        yield f"{few} nested {text!r}", f"{_HEAD}require r: {text * few}x > 0"
        names = "".join(text.replace(" i ", f" i{k} ") for k in range(few))
        yield f"{few} nested {text!r} of other names", f"{_HEAD}require r: {names}x > i0"
    pairs = " <-> ".join(["(x > 0 until y > 0)"] * few)
    yield f"{few} equivalences", f"{_HEAD}require r: {pairs}"
    yield f"{few} absolute ones", f"{_HEAD}require r: {' or '.join(['always@[1 s, 2 s] x > 0'] * few)}"


_NUMBERS = (
    *(
        "1e308",
        "1e400",
        "1e999999999",
        "10^999999999",
        "2^2^2^2^2^2^2",
        "9" * 5000,
        "-1e308",
        "nan",
        "inf",
    ),
    *(
        "1e-400",
        "0",
        "1e308 h",
        "1e308 km",
        "1e12 s",
        "1e12 steps",
        "2 ^ 0.5 ^ 1e308",
        "1e308 * 1e308",
        "T",
    ),
    *(
        "1e300 steps * 1e300",
        "1e308 deg",
        "1e-308 ns",
        "exp(1000)",
        "exp(exp(exp(9)))",
        "10^308 - 10^309",
    ),
)
_PLACES_OF_NUMBERS = (
    *("require r: x > {}", "require r: always[0, {}] x > 0", "require r: always[{0}, {0}] x > 0"),
    *("require r: x > 0 until@[{}, inf] y > 0", "require r: once[0, {}] x > 0", "signal w : real[{}]"),
    *("require r: forall i in 0..{}: x > i", "require r: exists i in {{{}}}: x > i", "const k = {}"),
    *("signal w [m] in [-{0}, {0}]\nrequire r: w > {0}", "signal w [km] in [0, {}]\nrequire r: w > 0"),
    *("enum E {{ a = {} }}\nsignal e : E\nrequire r: e == a", "param p in [0, {}]\nrequire r: x > p"),
    *(
        "region p = circle(center = [{0}, 0], radius = {0})\nrequire r: [x, y] in p",
        "require r: q[{}] > 0",
    ),
    *(
        "region p = polygon([0, 0], [{0}, 0], [0, {0}])\nrequire r: [x, y] in p",
        "@weight({0}) require r: x > 0",
    ),
    *("@scale({0}) require r: x > 0", "require r: shift(x > 0, {}) and shift(x, -{}) > 0", "time {}"),
    *("require r: x ^ {0} > {0} ^ x", "require r: x % {0} > {0} % x and x / {0} > 0", "signal w [m^{}]"),
    *(
        "const k [ns] = {}\nrequire r: always[0, k] x > 0",
        "const k [km] = {}\nrequire r: norm([k, k]) > 1 m",
    ),
    *("def f(a) = a * {}\nrequire r: f({}) > 0 m and f(x) > 0", "require r: dilate(disc, {}) > 0"),
    *("require r: [x, y] in dilate(disc, {})", "require r: next prev(x > {}) and delta(x) > {}"),
    "require r: always[0, {} - {}] eventually[{} / 3, T / {}] x > 0",
)


def _huge() -> Iterator[tuple[str, str]]:
    """Huge numbers wherever a number may stand."""
    for place in _PLACES_OF_NUMBERS:
        for value in _NUMBERS:
            blanks = place.replace("{{", "").replace("{0}", "{}").count("{}")
            yield f"{value[:20]} in {place!r}", _HEAD + place.format(*[value] * max(blanks, 1))


_YAML = "[;{a: ;- ;? ;[];{};&a ;!t ;*a ;';\";\t;---\n;...\n;|\n"


def systems(n: int, base: str) -> Iterator[tuple[str, str]]:
    """(name, text) of YAML bombs of size `n`; `base` is a sound system."""
    few = min(n, 30)
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, few)
    )
    merged = "b0: &b0 {k: 1}\n" + "".join(
        f"b{i}: &b{i} {{<<: [{', '.join([f'*b{i - 1}'] * 9)}], k{i}: 1}}\n" for i in range(1, few)
    )
    yield from {"laughs": laughs, "merges": merged}.items()
    yield from {"laughs after": base + laughs, "merges after": base + merged, "a loop": "a: &a [*a]"}.items()
    for text in _YAML.split(";"):
        yield f"{n} times {text!r}", text * n
        yield f"{n} times {text!r} in a system", f"{base}\nmeta: {text * n}"
        yield f"{n} times {text!r} in a flow", base.replace("flow: {x: u", f"flow: {{x: {text * n}u")
    yield f"{n} deep", "".join(" " * i + "a:\n" for i in range(min(n, 2000)))
    yield f"{n} brackets", "[" * n + "]" * n
    yield f"{n} keys", "".join(f"k{i}: {i}\n" for i in range(n))
    yield f"{n} times a key", "k: 1\n" * n
    yield f"{n} states", base.replace("  y: {}\n", "  y: {}\n" + "".join(f"  s{i}: {{}}\n" for i in range(n)))
    yield f"{n} letters", f"{base}name: {'x' * n}\n? {'y' * n}\n: z\n"
    yield from _values(n, base)


def _values(n: int, base: str) -> Iterator[tuple[str, str]]:
    """Values of wrong types."""
    expressions = (
        *(
            "(" * n + "x" + ")" * n,
            "x + " * n + "x",
            "-" * n + "x",
            "sin(" * n + "x" + ")" * n,
            "x ^ " * n + "x",
        ),
        *(
            "if x > 0 then " * n + "x",
            "9" * n,
            "1e308 * 1e308",
            "10^999999999",
            "2^2^2^2^2^2^2",
            "1e400",
            ".nan",
        ),
        *(
            ".inf",
            "0x" + "f" * n,
            "1:30:00",
            "1_0",
            "~",
            "''",
            "2001-12-14",
            "!!int 3",
            "1e308 h",
            "1e308 km",
        ),
    )
    for value in expressions:
        for old in (
            "dt: 0.1 s",
            "horizon: 12 steps",
            "u * 1 m",
            "range: [-1, 1]",
            "uniform(-1, 1)",
            "bernoulli(0.5)",
        ):
            key = old.partition(":")[0] + ": " if ": " in old else ""
            yield f"{value[:20]} for {old}", base.replace(old, f"{key}{value}")
