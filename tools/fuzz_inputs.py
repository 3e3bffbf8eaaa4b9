"""Random, mutated and malicious inputs for `tools/fuzz.py`: a command line and its files.

Everything follows from one `random.Random`; nothing is read but the specifications and systems of the tree.
"""

import random
from dataclasses import dataclass, field
from functools import cache

from fuzz_mutation import WORDS, corpus, mutated, soup
from fuzz_specs import SMALL, SYSTEM, TRAINED, monster
from fuzz_systems import monstrous_yaml
from fuzz_traces import archived, foreign, small_trace, table


@dataclass
class Input:
    """A command line, and the files that lie in the folder where it runs."""

    kind: str
    arguments: list[str]
    files: dict[str, bytes] = field(default_factory=dict)


def draw(rng: random.Random) -> Input:
    """One input."""
    maker = rng.choices([_spec, _system, _trace, _line], weights=[50, 20, 22, 8])[0]
    return maker(rng)


def _spec(rng: random.Random) -> Input:
    base, system = rng.choice([(SMALL, None), (TRAINED, SYSTEM), (TRAINED, SYSTEM)])
    roll = rng.random()
    if roll < 0.1:
        number = rng.randrange(len(corpus("specs/*.stl")))
        text, system = mutated(corpus("specs/*.stl")[number], rng), rng.choice(corpus("examples/*.yaml"))
    elif roll < 0.55:
        text = mutated(base.encode(), rng)
    elif roll < 0.7:
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
    *(("parse", ()), ("parse", ("--json",)), ("explain", ())),
)


@cache
def commands() -> frozenset[str]:
    """Names of the commands that there are."""
    import typer

    from stlc.cli.app import app

    return frozenset(typer.main.get_command(app).commands)


def _system(rng: random.Random) -> Input:
    spec, text = TRAINED.encode(), SYSTEM.encode()
    if rng.random() < 0.5:
        spec, text = rng.choice(corpus("specs/*.stl")), rng.choice(corpus("examples/*.yaml"))
    if rng.random() < 0.7:
        data = mutated(text, rng)
    elif rng.random() < 0.1:
        data = rng.choice([b"", b"null", b"[]", b"3", b"\0", rng.randbytes(300), b"a: b: c", b"- " * 5000])
    else:
        data = monstrous_yaml(text.decode(), rng).encode("utf-8", "replace")
    command = rng.choice([["compile", "a.stl"], ["compile", "a.stl", "--json"], ["check", "a.stl", "t.npz"]])
    arguments = [*command, "--system", "b.yaml"]
    if "system" in commands() and rng.random() < 0.2:
        arguments = ["system", "check", "b.yaml"]
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
"""Commands that may work, or wait, for longer than any input is worth."""


def _line(rng: random.Random) -> Input:
    names = sorted(commands() - _BUSY)
    front = (
        [rng.choice(names)] if rng.random() < 0.9 else [rng.choice([*VALUES, "chek", "train", "simulate"])]
    )
    words = [rng.choice(OPTIONS if rng.random() < 0.5 else VALUES) for _ in range(rng.randrange(6))]
    if front[0] in _BUSY:  # nothing that could run
        words = ["--no-such-option", *words]
    files = {"a.stl": SMALL.encode(), "t.npz": small_trace(), "b.yaml": corpus("examples/*.yaml")[0]}
    return Input("line", [*front, *words], files)
