"""Specifications that are deeply nested, long, or contain huge numbers."""

import random

SMALL = """spec small
const c = 0.5 s
enum Mode { idle = 0, go = 1 }
signal x [m] in [-10, 10]
signal y, z
signal n : int
signal flag : bool
signal mode : Mode
signal q : real[3]
region disc = circle(center = [0, 0], radius = 1)
def near(a, b) = norm([a, b]) <= 1.5
## never leave
@safety
require stay: always[0, 1 s] (x < 2 and (flag -> n >= 0))
@liveness @weight(2)
require reach: eventually[0, 0.3 s] near(x, y) until(0, 3 steps] [y, z] in disc
require past: always (once[c, 1 s] mode == go or forall i in 0..2: q[i] > 0 since rise(y > z))
require clock: not always@[0.2 s, 0.4 s] x > 0 -> freeze x0 = x in next(abs(x - x0) < 1)
"""


TRAINED = (
    SMALL.replace("signal n : int\n", "")
    .replace("signal q : real[3]\n", "")
    .replace("n >= 0", "z > 0")
    .replace("once[c, 1 s] mode == go or forall i in 0..2: q[i] > 0", "once[0, c] mode == go or z > 0")
    .replace("freeze x0 = x in next(abs(x - x0) < 1)", "z < 2")
)
"""The part of `SMALL` that a system can declare."""

SYSTEM = """stlc: 1
name: small
time: {dt: 0.1 s, horizon: 12 steps, integrator: euler}
state:
  x: {unit: m, range: [-10, 10]}
  y: {}
  z: {}
  flag: {bool: true, role: env}
  mode: {enum: {idle: 0, go: 1}, role: env}
control:
  u: {range: [-1, 1], squash: tanh}
flow: {x: u * 1 m, y: x / 1 m - y, z: sin(y)}
init:
  mixture:
    - name: all
      weight: 1
      draw: {x: 'uniform(-1, 1)', y: 0, z: 0, flag: bernoulli(0.5), mode: go}
"""


def monster(rng: random.Random) -> str:
    """An extreme declaration."""
    text = rng.choice(rng.choice([_deep, _far, _wide])(rng))
    return text + rng.choice(["", "\n", "\r\n", " ;"])


_PREFIXES = "always|eventually|once|historically|not|next|G|prev|rise|always[0, 1 s]|freeze p = x in"
_INFIXES = "and|or|->|<->|xor|since|unless|release|+|*|^|-|until[0, 1 s]|unless@[0, 1 s]"


def _count(rng: random.Random) -> int:
    return rng.choices([10, 100, 1000, 20_000], weights=[4, 4, 2, 1])[0]


def _word(rng: random.Random) -> str:
    return rng.choice(_PREFIXES.split("|"))


def _between(rng: random.Random) -> str:
    return rng.choice(_INFIXES.split("|"))


def _deep(rng: random.Random) -> list[str]:
    """Declarations that multiply when expanded."""
    few, both = rng.choice([5, 20, 40]), _between(rng)
    doubled = "".join(f"def d{i} = d{i - 1} {both} d{i - 1}\n" for i in range(1, few))
    return [
        f"require r: {f' {both} '.join(['(x > 0)'] * few)}",
        f"require r: {'always[0, 1e9 steps] eventually[0, 1e9 steps] ' * few} x > 0",
        f"require r: {'always[0, 50 s] once[0, 50 s] ' * few} x > 0",
        f"require r: {'forall i in 0..30: ' * few}x > i",
        f"require r: {'exists i in 0..1: ' * few}x > i",
        f"require r: {'freeze p = x in ' * few}x > p",
        f"def d0 = x > 0\n{doubled}require r: d{few - 1}",
        f"def d0 = x\n{doubled}require r: d{few - 1} > 0",
        f"def f(a) = {'a + ' * few}a\nrequire r: {'f(' * few}x{')' * few} > 0",
        f"signal `{'in ' * few}`, `always`, `\u202e`, `a\tb`\nrequire `require`: `always` > 0",
        f"require r: x > 0.{'0' * few * 50}1 and x < 1e{'9' * few}",
        f'import "{"../" * few}x.stl" as m\nrequire r: m.p',
        "require r: x > 0" + "\0" * few,
    ]


def _far(rng: random.Random) -> list[str]:
    """Declarations with huge numbers."""
    few, n, word = rng.choice([5, 20, 40]), _count(rng), _word(rng)
    big = rng.choice(["1e308", "9" * 300, "1e18", "1e12", "2^63", "10^400", "1e-300", "1e400", "9^9^9"])
    unit = rng.choice(["s", "steps", "ms", "h", ""])
    return [
        f"require r: {word}[0, {big} {unit}] x > 0",
        f"require r: {word}[{big} {unit}, {big} {unit}] x > 0",
        f"require r: x > 0 until[{big} {unit}, inf] y > 0",
        f"require r: always@[{big} {unit}, {big} {unit}] x > 0",
        f"require r: x > {big}",
        f"require r: x * {big} * {big} > {big} / 1e-300",
        f"require r: {big}^{big} > x",
        f"require r: x^{big} > 0 and {big}^x > 0 and exp({big} * x) > 0",
        f"require r: x % {big} > 0 and x / (y - y) > 0 and log(x) > sqrt(y) and asin(z) > tan({big})",
        f"require r: shift(x, {big}) > 0 and next(prev(next(x > 0)))",
        f"require r: forall i in 0..{big}: x > i",
        f"const k = {big} {unit}\nrequire r: always[0, k] x > k",
        f"enum E {{ a = {big}, b = -{few} }}\nsignal e : E\nrequire r: e == a",
        f"region p = circle(center = [{big}, -{big}], radius = {big})\nrequire r: [x, y] not in p",
        f"signal {'v' * n} in [{big}, -{big}]\nrequire r: {'v' * n} > 0",
        f"signal u [m^{big}]\nrequire r: u > 1 m",
        f"@weight({big}) @scale({big})\nrequire r: x > 0",
    ]


def _wide(rng: random.Random) -> list[str]:
    """Very long brackets, chains and lists."""
    n, word, both = _count(rng), _word(rng), _between(rng)
    return [
        f"require r: {'(' * n}x > 0{')' * n}",
        f"require r: {'(' * n}x > 0",
        f"require r: {(word + ' ') * n}x > 0",
        f"require r: {(word + '(') * n}x > 0{')' * n}",
        f"require r: {'[' * n}x{']' * n} in disc",
        f"require r: {f' {both} '.join(['x > 0'] * n)}",
        f"require r: x > {f' {both} '.join(['y'] * n)}",
        f"require r: x > {'-' * n}1",
        f"require r: {'if x > 0 then ' * n}y > 0{' else y > 0' * n}",
        f"require r: forall i in 0..{n}: q[i] > 0",
        "def f(a) = g(a)\ndef g(a) = f(a)\nrequire r: f(x) > 0",
        f"signal w : real[{rng.choice([0, 1, 3, 10**3, 10**9, 10**30])}]\nrequire r: norm(w) > 0",
        f"enum E {{ {', '.join(f'e{i}' for i in range(n))} }}",
        f"region p = polygon({', '.join(f'[{i}, {i * i % 7}]' for i in range(n))})\nrequire r: [x, y] in p",
        f"region p = {'complement(' * n}disc{')' * n}\nrequire r: [x, y] in p",
        f"region p = union({', '.join(['disc'] * n)})\nrequire r: [x, y] in p",
        f"signal u [{'m*' * n}s]\nrequire r: u > 0",
        f"# {'x' * n * 5}\nrequire r: x > 0 // {'(' * n}",
        f"require r: x > {'9' * n}",
        f"{'@safety ' * n}require r: x > 0",
        "\n".join(f"require r{i}: x > {i}" for i in range(min(n, 2000))),
        "\n".join(f"signal w{i}" for i in range(min(n, 2000))),
        f"require r: x in {{{', '.join(map(str, range(min(n, 3000))))}}}",
        f"require r: 0 {' '.join(f'< x + {i}' for i in range(min(n, 3000)))}",
        f"require r: {'x > 0 ) ' * n}",
        f'system "{rng.choice(["/dev/zero", "/dev/null", ".", "a.stl", "t.npz", "~", "x" * 5000])}"',
    ]
