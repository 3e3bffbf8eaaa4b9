"""Valid files of every trace format, damaged: the file itself, or its compressed content.

Damaged content is compressed again with valid checksums, so that it reaches the parser. Formats whose library
is not installed raise ModuleNotFoundError and count as skipped.
"""

import bz2
import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np
from fuzzing.foreign import mat5, mat5_plain, mcap, parquet
from helpers import robot_logs

SAMPLES = 21
WAVE = [float(x) for x in np.sin(np.arange(SAMPLES) / 3)]

SPEC = """signal x
signal y
require low: always x > -0.5
require back: eventually[0, 1 s] (x < 0.9 and y > 0)
"""
"""Specification by which all traces are judged."""

_LENGTHS = (
    0,
    1,
    0x7F,
    0xFF,
    0x7FFF,
    0xFFFF,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53,
    2**62,
    2**63 - 1,
    2**63,
)
_NUMBERS = (
    0.0,
    -0.0,
    5e-324,
    1e-300,
    1e300,
    1.7e308,
    float("inf"),
    float("-inf"),
    float("nan"),
    1e-9,
    2.0**63,
)


def battered(data: bytes, rng: random.Random, others: tuple[bytes, ...] = ()) -> bytes:
    """Data with flipped bits, huge numbers, or pieces cut, doubled, swapped, or of another file."""
    for _ in range(rng.choice([1, 1, 1, 1, 2, 6])):
        at = _place(len(data), rng)
        size = rng.choice([1, 2, 4, 8, 16, 64, 512, max(len(data) // 4, 1)])
        match rng.randrange(10):
            case 0 | 1:
                data = (
                    data[:at] + bytes(b ^ 1 << rng.randrange(8) for b in data[at : at + 1]) + data[at + 1 :]
                )
            case 2 | 3:
                width, order = rng.choice([1, 2, 4, 8]), rng.choice("<>")
                value = rng.choice(_LENGTHS) + rng.choice([-1, 0, 0, 1, 8])
                code = {1: "B", 2: "H", 4: "I", 8: "Q"}[width]
                data = data[:at] + struct.pack(order + code, value % (1 << 8 * width)) + data[at + width :]
            case 4:
                data = data[:at] + struct.pack(rng.choice("<>") + "d", rng.choice(_NUMBERS)) + data[at + 8 :]
            case 5:
                data = data[:at] + data[at + size :]
            case 6:
                data = data[:at] + data[at : at + size] * rng.choice([2, 2, 3, 40]) + data[at + size :]
            case 7:
                to = _place(len(data), rng)
                first, second = sorted((at, to))
                part, last = data[first : first + size], data[second : second + size]
                data = data[:first] + last + data[first + size : second] + part + data[second + size :]
            case 8:
                other = rng.choice([data, *others])
                start = _place(len(other), rng)
                data = data[:at] + other[start : start + size] + data[at + rng.choice([0, size]) :]
            case _:
                data = data[:at] + rng.randbytes(min(size, 64)) + data[at + rng.choice([0, size]) :]
    if rng.random() < 0.08:
        data = data[: _place(len(data), rng)]
    return data


def _place(size: int, rng: random.Random) -> int:
    """A random position, more often near the ends, where headers and tables are."""
    near = min(size, 300)
    return rng.choice([rng.randrange(size + 1), rng.randrange(near + 1), size - rng.randrange(near + 1)])


# ---------------------------------------------------------------------------------- formats


def csv(rng: random.Random) -> tuple[str, bytes]:
    """A CSV table, often with a non-numeric cell."""
    mark = rng.choice([",", ",", ";", "\t"])
    wave = WAVE * rng.choice([1, 1, 1, 60])
    rows = [["t", "x [m]", "y"], *([f"{k / 10!r}", repr(v), "1"] for k, v in enumerate(wave))]
    if rng.random() < 0.3:
        cells = ["nan", "", "inf", "1e400", '"2"', "true", "x", "1,5", "2001-01-01T00:00:00", "-", "1_0", "٣"]
        rng.choice(rows)[rng.randrange(3)] = rng.choice(cells)
    text = rng.choice(["\n", "\r\n", "\n"]).join(mark.join(row) for row in rows)
    return ".csv", battered(text.encode(), rng) if rng.random() < 0.8 else text.encode()


_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


def npz(rng: random.Random) -> tuple[str, bytes]:
    """An `.npz` of arrays, compressed in any way, with its specification."""
    said = {"dt": 0.1, "spec_text": SPEC, "spec_set": {}, "signals": {"x": {"unit": "m", "kind": "real"}}}
    meta = json.dumps(said)
    if rng.random() < 0.3:
        meta = battered(meta.encode(), rng).decode("utf-8", "replace")
    arrays = {
        "t": np.arange(SAMPLES) / 10,
        "x": np.array(WAVE),
        "y": np.ones((2, SAMPLES)),
        "meta": np.array(meta),
    }
    inside, file = rng.random() < 0.6, io.BytesIO()
    with zipfile.ZipFile(file, "w", rng.choice(_METHODS)) as bundle:
        for name, values in arrays.items():
            member = io.BytesIO()
            np.save(member, values)
            damaged = inside and rng.random() < 0.4
            bundle.writestr(f"{name}.npy", battered(member.getvalue(), rng) if damaged else member.getvalue())
    return ".npz", file.getvalue() if inside else battered(file.getvalue(), rng)


def tables(rng: random.Random) -> tuple[str, bytes]:
    """A Parquet table."""
    return ".parquet", battered(parquet(), rng)


def mat(rng: random.Random) -> tuple[str, bytes]:
    """A MATLAB file up to version 7 with damaged compressed elements."""
    if rng.random() < 0.4:
        return ".mat", battered(mat5(), rng, (mat5_plain(),))
    if rng.random() < 0.5:
        return ".mat", mat5_plain()[:128] + battered(mat5_plain()[128:], rng)
    out, plain, at = mat5_plain()[:128], mat5_plain(), 128
    while at < len(plain):
        size = 8 + struct.unpack_from("<I", plain, at + 4)[0]
        element = plain[at : at + size]
        packed = zlib.compress(battered(element, rng) if rng.random() < 0.2 else element)
        out += struct.pack("<II", 15, len(packed)) + packed
        at += size
    return ".mat", out


def hdf5(rng: random.Random) -> tuple[str, bytes]:
    """A MATLAB 7.3 file."""
    return ".mat", battered(_mat73(), rng)


@cache
def _mat73() -> bytes:
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as book:
        for name, values in {
            "t": np.arange(SAMPLES) / 10,
            "x": np.array(WAVE),
            "s/y": np.ones(SAMPLES),
        }.items():
            book.create_dataset(name, data=values[None].T, compression="gzip")
            book[name].attrs["MATLAB_class"] = np.bytes_("double")
        book["y"] = np.ones((1, SAMPLES))
        pairs = np.zeros((1, SAMPLES), dtype=[("real", "f8"), ("imag", "f8")])
        book["z"] = pairs
        book["round"] = h5py.SoftLink("/")
    return file.getvalue()


def log(rng: random.Random) -> tuple[str, bytes]:
    """An MCAP file with ROS 2 or JSON messages and damaged chunks."""
    data = rng.choice([mcap, lambda: robot_logs.json_mcap(WAVE)])()
    if rng.random() < 0.5:
        return ".mcap", battered(data, rng)
    return ".mcap", _chunked(data, rng)


def _chunked(data: bytes, rng: random.Random) -> bytes:
    """MCAP records with one chunk modified and compressed again."""
    import zstandard

    out, at = data[:8], 8
    while at + 9 <= len(data):
        kind, size = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        content = data[at + 9 : at + 9 + size]
        if kind == 6:
            (letters,) = struct.unpack_from("<I", content, 28)
            inner = zstandard.ZstdDecompressor().decompress(content[32 + letters + 8 :])
            inner = battered(inner, rng)
            how, packed = rng.choice([(b"", inner), (b"zstd", zstandard.compress(inner))])
            told = len(inner) if rng.random() < 0.8 else rng.choice(_LENGTHS) % 2**63
            head = (
                content[:16] + struct.pack("<QII", told, 0, len(how)) + how + struct.pack("<Q", len(packed))
            )
            content = head + packed
        out += data[at : at + 1] + len(content).to_bytes(8, "little") + content
        at += 9 + size
    return out + data[at:]


def bag(rng: random.Random) -> tuple[str, bytes]:
    """A ROS 1 bag with a damaged chunk."""
    data = robot_logs.bag(WAVE, compression=rng.choice(["none", "bz2"]))
    if rng.random() < 0.5:
        return ".bag", battered(data, rng)
    how = rng.choice(["none", "bz2"])
    return ".bag", robot_logs.bag(WAVE, compression=how, change=lambda inner: battered(inner, rng))


def database(rng: random.Random) -> tuple[str, bytes]:
    """The database of a ROS 2 bag."""
    return ".db3", battered(robot_logs.bag2(WAVE), rng)


# ------------------------------------------------------------------------------------ bombs


@cache
def _bombs() -> tuple[tuple[str, Callable[[], bytes]], ...]:
    return (
        (".npz", _npz_bomb),
        (".bag", _bag_bomb),
        (".mcap", _mcap_bomb),
        (".parquet", _parquet_bomb),
        (".mat", _hdf5_bomb),
        (".csv", lambda: b"t,x,y\n" + b"1,1,1\n" * 500_000),
        (".csv", lambda: b"t," + b",".join(b"x%d" % i for i in range(60_000)) + b"\n0\n"),
        (".db3", _rows_bomb),
    )


def bomb(rng: random.Random) -> tuple[str, bytes]:
    """A decompression bomb."""
    suffix, make = rng.choice(_bombs())
    return suffix, _kept(make)


@cache
def _kept(make: Callable[[], bytes]) -> bytes:
    return make()


def _npz_bomb() -> bytes:
    file, many = io.BytesIO(), 400_000_000
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({many // 8},), }}".ljust(117) + "\n"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as bundle, bundle.open("t.npy", "w") as member:
        member.write(b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header.encode())
        for _ in range(40):
            member.write(bytes(many // 40))
    return file.getvalue()


def _bag_bomb() -> bytes:
    """A ROS 1 bag of many chunks, each of 60 MB."""
    packed = bz2.compress(bytes(60_000_000))
    fields = {b"op": b"\5", b"compression": b"bz2", b"size": struct.pack("<I", 60_000_000)}
    pairs = [name + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(pair)) + pair for pair in pairs)
    record = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    return b"#ROSBAG V2.0\n" + record * 200


def _mcap_bomb() -> bytes:
    import zstandard

    packed = zstandard.compress(bytes(60_000_000))
    head = struct.pack("<QQQII4sQ", 0, 0, 60_000_000, 0, 4, b"zstd", len(packed))
    record = b"\x06" + struct.pack("<Q", len(head) + len(packed)) + head + packed
    return b"\x89MCAP0\r\n" + b"\1" + struct.pack("<QII", 8, 0, 0) + record * 200


def _parquet_bomb() -> bytes:
    import pyarrow as pa
    from pyarrow.parquet import write_table

    column = pa.array(np.zeros(20_000_000))
    file = io.BytesIO()
    write_table(pa.table({"t": column, "x": column, "y": column}), file, compression="zstd")
    return file.getvalue()


def _hdf5_bomb() -> bytes:
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as book:
        for name in ("t", "x", "y", "z"):
            book.create_dataset(
                name, data=np.zeros((1, 30_000_000)), compression="gzip", chunks=(1, 1_000_000)
            )
    return file.getvalue()


def _rows_bomb() -> bytes:
    """Two million messages without content."""
    import sqlite3
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db3"
        path.write_bytes(robot_logs.bag2([]))
        book = sqlite3.connect(path)
        many = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 1000000)"
        book.execute(f"{many} INSERT INTO messages(topic_id, timestamp, data) SELECT 1, i, x'' FROM n")
        book.commit()
        book.close()
        return path.read_bytes()


FORMATS: dict[str, Callable[[random.Random], tuple[str, bytes]]] = {
    **{"csv": csv, "npz": npz, "parquet": tables, "mat": mat, "hdf5": hdf5, "mcap": log, "bag": bag},
    **{"bag2": database, "bomb": bomb},
}


def prepare(formats: tuple[str, ...] = tuple(FORMATS)) -> list[str]:
    """Make all bombs and valid files in advance; return missing packages."""
    missing = []
    makers = [
        *((name, lambda name=name: FORMATS[name](random.Random(0))) for name in formats if name != "bomb")
    ]
    makers += [
        (f"bomb{suffix}", lambda make=make: _kept(make)) for suffix, make in _bombs() if "bomb" in formats
    ]
    for name, make in makers:
        try:
            make()
        except ModuleNotFoundError as error:
            missing.append(f"{name} ({error.name} is not installed)")
    return missing
