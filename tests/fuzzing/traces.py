"""Traces: damaged, empty, with false sizes, or in another format than their suffix."""

import io
import json
import random
import zipfile
from functools import cache

import numpy as np
from fuzzing.mutation import mutated
from fuzzing.specs import SMALL


@cache
def small_trace() -> bytes:
    """A valid trace for `SMALL`."""
    return archive({name: np.linspace(-1, 1, 12) for name in ("x", "y", "z")} | _rest())


def _rest() -> dict[str, np.ndarray]:
    words = {"n": np.arange(12), "flag": np.arange(12) % 2, "mode": np.zeros(12)}
    return words | {f"q[{i}]": np.full(12, float(i)) for i in range(3)} | {"t": np.arange(12) / 10}


def archive(arrays: dict[str, np.ndarray]) -> bytes:
    """An `.npz` file; objects are pickled, as an attacker would."""
    file = io.BytesIO()
    np.savez(file, **{name.replace("/", "_"): values for name, values in arrays.items()})
    return file.getvalue()


def archived(rng: random.Random) -> tuple[str, bytes]:
    """An `.npz`: its suffix and content."""
    if rng.random() < 0.4:
        return ".npz", mutated(small_trace(), rng)
    if rng.random() < 0.1:
        return ".npz", rng.choice([b"", b"PK\x03\x04", b"PK\x05\x06" + b"\0" * 18, rng.randbytes(200)])
    samples = rng.choice([0, 1, 2, 12, 1000])
    numbers = np.random.default_rng(rng.getrandbits(32))
    odd = [
        np.full(samples, np.nan),
        np.full(samples, rng.choice([np.inf, -np.inf, 1e308, -1e308, 5e-324])),
        numbers.normal(size=(rng.choice([0, 1, 3]), samples)),
        numbers.normal(size=(2, 2, samples)),
        np.zeros((samples, 0)),
        np.float64(3.0),
        np.arange(samples).astype(
            rng.choice(["i1", "u8", "f2", "c16", "M8[s]", "S3", "U4", "?", ">f4", "f8"])
        ),
        np.array([{"a": 1}, None], dtype=object),
        np.zeros(samples, dtype=[("a", "f8"), ("b", "i4")]),
        np.array(json.dumps({"spec_text": SMALL, "dt": rng.choice([0, -1, 1e-320, 1e308])})),
        np.array(
            rng.choice(["{", "[]", "{}", '{"dt": 0.1}', '{"signals": {"x": {"unit": "m^^2"}}}', "[" * 5000])
        ),
    ]
    arrays = {name: numbers.normal(size=samples) for name in ("x", "y", "z")}
    arrays |= {name: numbers.integers(0, 2, size=samples) for name in ("n", "flag", "mode")}
    arrays |= {f"q[{i}]": numbers.normal(size=samples) for i in range(3)} | {"t": np.arange(samples) / 10}
    for _ in range(rng.choice([1, 1, 2, 4])):
        arrays[rng.choice(["t", "t", "x", "y", "meta", "q[0]", "extra.a", "", "..", "x" * 300])] = rng.choice(
            odd
        )
    if rng.random() < 0.2:
        arrays["t"] = np.cumsum(numbers.choice([0.1, 0.1, 0.0, -0.1, 1e300, 1e-300, np.nan], size=samples))
    data = archive(arrays)
    return ".npz", _claimed(rng) if rng.random() < 0.1 else data


def _claimed(rng: random.Random) -> bytes:
    """An array whose header claims far more data than present."""
    shape = rng.choice(
        ["(1000000000000,)", "(-1,)", "(2, 99999999999, 9999999999)", "(1e9,)", "'x'", "(1,) * 99"]
    )
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(118) + "\n"
    member = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 80
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as bundle:
        bundle.writestr("x.npy", member)
        bundle.writestr("t.npy", b"\0" * rng.choice([0, 10, 10_000_000]))
    return file.getvalue()


def table(rng: random.Random) -> tuple[str, bytes]:
    """A `.csv`: its suffix and content."""
    names = ["t", "x", "y", "z", "n", "flag", "mode", "q[0]", "q[1]", "q[2]"]
    rows = [",".join(names), *(",".join([f"{k / 10}", *"001010010"]) for k in range(12))]
    if rng.random() < 0.5:
        at, cell = rng.randrange(13), rng.randrange(10)
        cells = rows[at].split(",")
        junk = [
            "nan",
            "inf",
            "1e400",
            "",
            " ",
            '"',
            "0x10",
            "1,5",
            "x" * 200_000,
            "9" * 5000,
            "٣",
            "\0",
            "true",
            "-",
        ]
        cells[cell] = rng.choice(junk)
        rows[at] = ",".join(cells)
    glue = rng.choice(["\n", "\n", "\r\n", "\r", "\n\n"])
    text = glue.join(rows * rng.choice([1, 1, 1, 2]))
    if rng.random() < 0.2:
        text = text.replace(",", rng.choice([";", "\t", " ", ",,", "|"]))
    if rng.random() < 0.05:
        text = rng.choice(
            ["", "t", "\n", "t\n", ",,,\n,,,", '"' * 9999, "t,t\n1,2\n", "t,x\n" + "1\n" * 9999]
        )
    data = text.encode(rng.choice(["utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "utf-7"]))
    return ".csv", mutated(data, rng) if rng.random() < 0.5 else data
