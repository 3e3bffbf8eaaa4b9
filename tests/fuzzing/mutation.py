"""Mutation of random inputs: corpus files of the tree, words of the language, and damage."""

import random
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_WORDS = """
always eventually until release unless once historically since not and or xor -> <-> implies iff if then else
forall exists freeze in true false inf require assume def const param signal region enum extern import spec
system time input output state env G F U T end dt rise fall next prev shift sweep x y z n q flag mode disc
near go abs min max norm circle box polygon union dilate ind 0 1 2 0.5 1e308 1e-308 s ms m steps m/s ( ) [ ]
{ } , : ; . ..
= == != < <= > >= + - * / % ^ @ @[ @safety @weight(2) # // ## " ` ~ $ \\ | || & && ! => ? □ ◇ ∧ ¬ π µ ² ½
9007199254740993 1_000 .5 5. 1e400 0x10 1e-400
"""
WORDS = tuple(_WORDS.split())

_PLAIN = """
(((( )))) [[[[ {{{{ ' " ` # \\ %s%n ../../etc/passwd ~ *a ? | 1e308 -1e308 NaN inf -inf 1e400 0.1e-320
99999999999999999999 ǅİßﬀ 💩 ---
"""
_RAW = (
    *(b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\r\n", b"\r", b"\t", b"\x1b[31m", b"\xc3\x28", b"\xed\xa0\x80"),
    *(b"&a ", b"<<: *a", b"!!python/object/apply:os.system ['x']", b"---\n", b"...\n", b">-\n", b"9" * 400),
    *(b"\xe2\x80\xae", b"\xe2\x80\x8b", b"e\xcc\x81" * 20, b"\n" * 50),
)
PIECES = (*_RAW, *(text.encode() for text in _PLAIN.split()))


@cache
def corpus(pattern: str) -> tuple[bytes, ...]:
    """Contents of the files of the tree that match a pattern."""
    return tuple(path.read_bytes() for path in sorted(ROOT.glob(pattern)))


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Data with some bytes changed, cut, doubled, moved, or replaced by problematic tokens."""
    for _ in range(rng.choice([1, 1, 2, 3, 6, 15])):
        at, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
        end = min(end, at + rng.choice([1, 2, 5, 20, 200]))
        middle = data[at:end]
        match rng.randrange(9):
            case 0:
                middle = bytes(rng.randrange(256) for _ in range(rng.choice([1, 1, 4])))
            case 1:
                middle = b""
            case 2:
                middle *= rng.choice([2, 3, 50])
            case 3 | 4:
                middle += rng.choice(PIECES)
            case 5 | 6:
                middle = rng.choice(WORDS).encode() + b" "
            case 7:
                middle = middle[::-1]
            case _:
                middle = str(rng.choice([0, -1, 1e308, 2**63, 1e-9, 10**40, 0.1])).encode()
        data = data[:at] + middle + data[end:]
    if rng.random() < 0.05:
        data = data[: rng.randrange(len(data) + 1)]
    if rng.random() < 0.02:
        data = data.decode("utf-8", "replace").encode(
            rng.choice(["utf-16", "utf-32-be", "cp037", "utf-7"]), "replace"
        )
    return data


def soup(rng: random.Random) -> str:
    """Words of the language in random order."""
    glue = rng.choice([" ", " ", "", "\n"])
    return glue.join(rng.choices(WORDS, k=rng.choice([3, 20, 100, 1000])))
