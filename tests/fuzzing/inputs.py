"""Random, mutated and malicious inputs for `tools/fuzz.py`: a command line and its files.

Inputs are determined by one `random.Random` and the specifications and systems of the tree.
"""

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import islice

from fuzzing.bombs import specifications, systems
from fuzzing.files import extended, imports
from fuzzing.foreign import foreign
from fuzzing.grammar import specification
from fuzzing.hostile import hostile
from fuzzing.mutation import WORDS, corpus, mutated, soup
from fuzzing.runs import a_run
from fuzzing.specs import SMALL, SYSTEM, TRAINED, monster
from fuzzing.systems import monstrous_yaml
from fuzzing.traces import archived, small_trace, table
from fuzzing.valid import FORMATS, SPEC, WAVE, battered


@dataclass
class Input:
    """A command line, and the files in its working folder.

    Without a command line `a.stl` is read by the library (`fuzz_laws.laws`).
    """

    kind: str
    arguments: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    typed: bytes = b""
    """The standard input."""
    odd: dict[str, str] = field(default_factory=dict)
    """Links, pipes, folders and sparse files in the folder; see `fuzzing.hostile`."""
    drives: bool | None = None
    """True if the command may run Python of a run, if what it reads, writes and runs is watched."""
    missing: str = ""
    """Name of a missing package that the input needs, or ""."""


def draw(rng: random.Random, kinds: tuple[str, ...] = ()) -> Input:
    """Draw one input, of one of `kinds` if any are given; it is determined by `rng`."""
    known = kinds or tuple(KINDS)
    (kind,) = rng.choices(known, weights=[KINDS[name][1] for name in known])
    try:
        return KINDS[kind][0](rng)
    except ModuleNotFoundError as error:
        return Input(kind, missing=str(error.name))


def _text(rng: random.Random) -> Input:
    roll = rng.random()
    if roll < 0.65:
        data = specification(rng).encode()
    elif roll < 0.83:
        data = mutated(specification(rng).encode(), rng)
    elif roll < 0.95:
        data = mutated(
            _piece(rng.choice(corpus("specs/*.stl") + corpus("tests/grammar/data/*.stl")), rng), rng
        )
    elif roll < 0.97:
        data = mutated(_piece(rng.choice(corpus("docs/*.md") + corpus("stlc/**/*.stl")), rng), rng)
    else:
        data = _bomb(rng).encode("utf-8", "replace")
    return Input("text", files={"a.stl": data})


def _piece(data: bytes, rng: random.Random) -> bytes:
    """A random part of a file: whole files are slow and repetitive."""
    return data[: rng.choice([300, 300, 1000, 1000, len(data)])]


def _bomb(rng: random.Random) -> str:
    """A bomb of some size; the largest are rare."""
    size = rng.choices([5, 30, 300, 3000, 100_000], weights=[40, 40, 15, 4, 1])[0]
    return _pick(specifications(size), _BOMBS, rng)


def _pick(bombs: Iterator[tuple[str, str]], many: int, rng: random.Random) -> str:
    """A random element of a lazy sequence."""
    at = rng.randrange(many)
    return next(islice(bombs, at, None))[1]


_BOMBS = sum(1 for _ in specifications(5))
_YAML_BOMBS = sum(1 for _ in systems(5, SYSTEM))


def _spec(rng: random.Random) -> Input:
    base, system = rng.choice([(SMALL, None), (TRAINED, SYSTEM), (TRAINED, SYSTEM)])
    base = _some(base, rng)
    roll = rng.random()
    if roll < 0.1:
        number = rng.randrange(len(corpus("specs/*.stl")))
        text, system = (
            mutated(_piece(corpus("specs/*.stl")[number], rng), rng),
            rng.choice(corpus("examples/*.yaml")),
        )
    elif roll < 0.55:
        text = mutated(base.encode(), rng)
    elif roll < 0.85:
        text = (base + rng.choice(["require r: ", "def d = ", "const k = ", ""]) + soup(rng)).encode()
    elif roll < 0.97:
        text = (base + monster(rng)).encode("utf-8", "replace")
    else:
        text = rng.choice(
            [b"", b"\n", rng.randbytes(rng.choice([1, 100, 5000])), b"\0" * 100, b"solid x\n facet"]
        )
    files = {"a.stl": text, "t.npz": small_trace()}
    if system is None:
        return Input("spec", _on_spec(rng), files)
    files["b.yaml"] = system.encode() if isinstance(system, str) else system
    return Input("spec", _with_system(rng) if rng.random() < 0.5 else _on_spec(rng), files)


def _some(text: str, rng: random.Random) -> str:
    """The declarations of a specification and a few of its requirements, for speed."""
    if rng.random() < 0.2:
        return text
    lines = text.splitlines(keepends=True)
    kept = rng.sample(range(len(lines)), len(lines) // 4)
    return "".join(
        line for i, line in enumerate(lines) if i in kept or not line.startswith(("require", "@", "##"))
    )


def _with_system(rng: random.Random) -> list[str]:
    more = rng.choice([[], ["--json"], ["--show", "ir"], ["--set", f"c={rng.choice(WORDS)}"]])
    return ["compile", "a.stl", "--system", "b.yaml", *more]


def _on_spec(rng: random.Random) -> list[str]:
    choices = [
        ["check", "a.stl", "t.npz"],
        ["check", "a.stl", "t.npz", "--json", "--end", "truncate"],
        ["check", "a.stl", "t.npz", "--at", "all", "--tolerance", "0"],
    ]
    choices += [[name, "a.stl", *more] for name, more in _READERS if name in commands()]
    return rng.choice(choices)


_READERS = (
    *(("lint", ()), ("lint", ("--json",)), ("lint", ("--fix",)), ("fmt", ()), ("fmt", ("--check",))),
    *(("compile", ("--show", "ast")), ("compile", ("--show", "ast", "--json")), ("explain", ())),
)


@cache
def commands() -> frozenset[str]:
    """Names of all commands."""
    from stlc.cli.framework.app import PROGRAM

    return frozenset(PROGRAM.names())


def _system(rng: random.Random) -> Input:
    spec, text = TRAINED.encode(), SYSTEM.encode()
    if rng.random() < 0.5:
        spec, text = rng.choice(corpus("specs/*.stl")), rng.choice(corpus("examples/*.yaml"))
    roll = rng.random()
    if roll < 0.7:
        data = mutated(text, rng)
    elif roll < 0.8:
        size = rng.choices([5, 30, 300, 3000, 100_000], weights=[10, 10, 6, 3, 1])[0]
        data = _pick(systems(size, SYSTEM), _YAML_BOMBS, rng).encode("utf-8", "replace")
    elif roll < 0.83:
        data = rng.choice([b"", b"null", b"[]", b"3", b"\0", rng.randbytes(300), b"a: b: c", b"- " * 5000])
    else:
        data = monstrous_yaml(text.decode(), rng).encode("utf-8", "replace")
    command = rng.choice([["compile", "a.stl"], ["compile", "a.stl", "--json"], ["check", "a.stl", "t.npz"]])
    arguments = [*command, "--system", "b.yaml"]
    if "system" in commands() and rng.random() < 0.6:
        arguments = ["system", rng.choice(["show", "show", "show", "check"]), "b.yaml"]
    return Input("system", arguments, {"a.stl": spec, "b.yaml": data, "t.npz": small_trace()})


def _trace(rng: random.Random) -> Input:
    suffix, data = rng.choice([archived, archived, table, table, foreign])(rng)
    name = f"t{suffix}"
    arguments = [
        "check",
        "a.stl",
        name,
        *rng.choice([[], ["--json"], ["--end", "truncate"], ["--at", "all"]]),
    ]
    if rng.random() < 0.1:
        arguments = ["check", name]
    return Input("trace", arguments, {"a.stl": SMALL.encode(), name: data})


def _files(rng: random.Random) -> Input:
    """An input of files that refer to others."""
    if rng.random() < 0.3:
        command = rng.choice([["system", "show"], ["system", "check"], ["compile", "a.stl", "--system"]])
        return Input("files", [*command, "b.yaml"], {"a.stl": TRAINED.encode(), **extended(rng)})
    return Input("files", _on_spec(rng), {"t.npz": small_trace(), **imports(rng)})


def _of(form: str) -> Callable[[random.Random], Input]:
    """A maker of inputs: a damaged file of a format, and a command that reads it."""

    def make(rng: random.Random) -> Input:
        suffix, data = FORMATS[form](rng)
        name = f"t{suffix}"
        choices = [[], [], ["--resample", "0.1s"], ["--at", "all", "--json"], ["--chunk", "7"]]
        if suffix in (".bag", ".db3", ".mcap"):
            topic = "robot.state" if suffix != ".mcap" or b"robot" in data else "state"
            inner = "position." if topic == "robot.state" else ""
            choices = [
                ["--resample", "0.1s", "--map", f"x={topic}.{inner}x", "--map", f"y={topic}.{inner}y"],
                [],
            ]
        arguments = ["check", "a.stl", name, *rng.choice(choices)]
        if suffix == ".npz" and rng.random() < 0.2:
            arguments = rng.choice([["check", name], ["explain", name]])
        return Input(form, arguments, {"a.stl": SPEC.encode(), name: data})

    return make


def _stream(rng: random.Random) -> Input:
    """An input of streamed samples: CSV or JSON lines, for a usual or a random specification."""
    roll = rng.random()
    if roll < 0.5:
        spec = SPEC.encode()
    elif roll < 0.95:
        spec = _some(SMALL, rng).encode()
    else:
        spec = (SMALL.split("##")[0] + soup(rng)).encode()
    names = ["t", "x", "y", "z", "n", "flag", "mode", "q[0]", "q[1]", "q[2]"]
    if rng.random() < 0.5:
        lines = [",".join(names), *(f"{k / 10!r},{v!r},1,0,0,1,go,1,1,1" for k, v in enumerate(WAVE))]
        text = "\n".join(lines)
    else:
        rest = '"z": 0, "n": 1, "flag": true, "mode": "go", "q": [1, 2, 3]'
        samples = (f'{{"t": {k / 10}, "x": {v!r}, "y": 1, {rest}}}' for k, v in enumerate(WAVE))
        text = "\n".join(samples)
    typed = text.encode()
    if rng.random() < 0.8:
        typed = battered(typed, rng) if rng.random() < 0.4 else mutated(typed, rng)
    more = rng.choice([[], [], [], ["--json"], ["--end", "truncate"], ["--tolerance", "0"]])
    return Input("stream", ["check", "a.stl", "-", *more], {"a.stl": spec}, typed)


def _run(rng: random.Random) -> Input:
    """The folder of a run."""
    arguments, files, odd = a_run(rng)
    return Input("run", arguments, files, odd=odd)


def _hostile(rng: random.Random) -> Input:
    """The folder of a run of a stranger."""
    found = hostile(rng)
    return Input("hostile", found.arguments, found.files, odd=found.odd, drives=found.drives)


# -------------------------------------------------------------------------- command lines


_OPTIONS = """
--json --system -s --set --show --spec --require --at --end --tolerance --map --fail-under --runs -q --quiet
--color --version --help -h -- - --seed --steps --budget --resume --name --record --guard --backup --at=all
--show=ir --end=strict --tolerance=nan --tolerance=-1 --color=never --fail-under=2 --junit --resample --fix
"""
OPTIONS = tuple(_OPTIONS.split())

_VALUES = """
a.stl t.npz b.yaml . nan -1 1e999 0 all c=1s c= = x=y * ~ latest 0.5 60s -5s 1e400s none é /dev/null
nonexistent/a.stl a.stl/b E203 E999 precedence -- T_red=3s k=v=w
"""
VALUES = (*_VALUES.split(), "", " ", "\n", "9" * 4000, "x" * 5000, "\udc80", "a\x00b")


_BUSY = frozenset({"train", "simulate", "lsp", "doctor"})
"""Commands that may run or wait for too long."""


def _line(rng: random.Random) -> Input:
    names = sorted(commands() - _BUSY)
    front = (
        [rng.choice(names)] if rng.random() < 0.9 else [rng.choice([*VALUES, "chek", "train", "simulate"])]
    )
    words = [rng.choice(OPTIONS if rng.random() < 0.5 else VALUES) for _ in range(rng.randrange(6))]
    if front[0] in _BUSY:  # nothing that can run
        words = ["--no-such-option", *words]
    files = {"a.stl": SMALL.encode(), "t.npz": small_trace(), "b.yaml": corpus("examples/*.yaml")[0]}
    return Input("line", [*front, *words], files)


KINDS: dict[str, tuple[Callable[[random.Random], Input], int]] = {
    **{"text": (_text, 20), "spec": (_spec, 15), "system": (_system, 18), "trace": (_trace, 12)},
    **{"files": (_files, 3), "line": (_line, 3), "stream": (_stream, 8), "run": (_run, 5)},
    "hostile": (_hostile, 3),
    **{form: (_of(form), 1 if form == "bomb" else 2) for form in FORMATS},
}
"""Maker and weight of each kind of input."""
