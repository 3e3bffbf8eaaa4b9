"""Files that refer to others: imports and `extends` in cycles, in diamonds, and to missing files."""

import random

from fuzzing.mutation import mutated
from fuzzing.specs import SMALL, SYSTEM

_FAR = ("", ".", "..", "/dev/null", "/dev/zero", "a.stl/b", "none.stl", "x" * 300, "~", "a\\b.stl", "é.stl")


def imports(rng: random.Random) -> dict[str, bytes]:
    """`a.stl` and its imported files."""
    several = rng.choice([2, 3, 3, 5, 12, 30])
    names = ["a.stl", *(f"m{i}.stl" for i in range(1, several))]
    texts = {name: _module(rng, i, names) for i, name in enumerate(names)}
    if rng.random() < 0.3:
        at = rng.choice(names)
        return {name: text.encode() for name, text in texts.items()} | {at: mutated(texts[at].encode(), rng)}
    return {name: text.encode() for name, text in texts.items()}


def _module(rng: random.Random, at: int, names: list[str]) -> str:
    """A module with imports in a ring, in nested diamonds, of all others, or at random."""
    following = names[(at + 1) % len(names)]
    down = names[at + 1 :]
    shape = rng.random()
    if shape < 0.2:
        targets = [following]
    elif shape < 0.6:
        targets = [down[0]] * rng.choice([1, 2, 2, 9]) if down else []
    elif shape < 0.75:
        targets = list(names)
    elif shape < 0.9:
        targets = down
    else:
        targets = [rng.choice([*names, *_FAR]) for _ in range(rng.choice([1, 3]))]
    lines = [f'import "{target}" as m{i}' for i, target in enumerate(targets)]
    used = "m0.d" if targets else "x > 0"
    body = SMALL.split("region")[0].partition("\n")[2] if at == 0 or rng.random() < 0.3 else "signal x [m]\n"
    return "\n".join([*lines, body, f"def d = {rng.choice(['x > 0', used, used])}", f"require r{at}: {used}"])


def extended(rng: random.Random) -> dict[str, bytes]:
    """`b.yaml` and the files that it extends."""
    several = rng.choice([1, 2, 3, 9, 40])
    names = ["b.yaml", *(f"c{i}.yaml" for i in range(1, several))]
    files = {}
    for at, name in enumerate(names):
        target = rng.choice([names[(at + 1) % several], names[(at + 1) % several], rng.choice(names)])
        target = rng.choice(_FAR) if rng.random() < 0.1 else target
        text = SYSTEM if rng.random() < 0.5 else "stlc: 1\nname: other\n"
        text += f"extends: {target}\n" if target or rng.random() < 0.9 else ""
        files[name] = mutated(text.encode(), rng) if rng.random() < 0.3 else text.encode()
    return files
