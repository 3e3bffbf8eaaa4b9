"""Traces in foreign formats: valid ones, damaged ones, and decompression bombs."""

import contextlib
import importlib
import io
import random
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np
from fuzzing.mutation import mutated

_SAMPLES = 12
_NAMES = ("x", "y", "z", "n", "flag", "mode")
_MESSAGE = "\n".join(["float64 x", "float64 y", "float64[3] q", "bool flag", "string frame"])


def foreign(rng: random.Random) -> tuple[str, bytes]:
    """A suffix and the content of the file."""
    roll = rng.random()
    if roll < 0.15:
        return rng.choice([".mat", ".mcap", ".parquet", ".npz", ".txt", ""]), _noise(rng)
    if roll < 0.3:
        return rng.choice([(".npz", _zip_bomb()), (".mat", _mat_bomb()), (".npz", _nested_zip())])
    suffix, make = rng.choice(_SOUND)
    data = make()
    return suffix, data if rng.random() < 0.1 else mutated(data, rng)


def _noise(rng: random.Random) -> bytes:
    starts = [
        b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM",
        b"\x89MCAP0\r\n",
        b"PAR1",
        b"\x89HDF\r\n\x1a\n",
    ]
    start = rng.choice([*starts, b""])
    return start + rng.randbytes(rng.choice([0, 8, 100, 2000])) + rng.choice([b"", b"PAR1", start])


def _columns() -> dict[str, np.ndarray]:
    numbers = {name: np.linspace(-1, 1, _SAMPLES) for name in _NAMES}
    return {"t": np.arange(_SAMPLES) / 10, **numbers, "q": np.ones((_SAMPLES, 3))}


@cache
def mat5() -> bytes:
    """A MATLAB file up to version 7."""
    from scipy.io import savemat

    file = io.BytesIO()
    more = {
        "s": {"y": np.ones(_SAMPLES), "deep": {"z": np.ones(_SAMPLES, dtype=np.float32)}},
        "word": "hello",
    }
    savemat(file, _columns() | more, do_compression=True)
    return file.getvalue()


@cache
def mat5_plain() -> bytes:
    """A MATLAB file up to version 7, not compressed."""
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(file, _columns(), do_compression=False)
    return file.getvalue()


@cache
def mat73() -> bytes:
    """A MATLAB 7.3 (HDF5) file with external, cyclic and dangling links."""
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as book:
        for name, values in _columns().items():
            made = book.create_dataset(name, data=values.T, compression="gzip")
            made.attrs["MATLAB_class"] = np.bytes_("double")
        book["elsewhere"] = h5py.ExternalLink("/etc/hostname", "x")
        book["round"] = h5py.SoftLink("/")
        book["nowhere"] = h5py.SoftLink("/none")
        book.create_dataset("huge", shape=(10**12,), dtype="f8", chunks=(1000,))
    return file.getvalue()


@cache
def parquet() -> bytes:
    """A Parquet file, by Arrow."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    columns = {name: pa.array(values) for name, values in _columns().items() if values.ndim == 1}
    columns["q"] = pa.array(np.ones((_SAMPLES, 3)).tolist(), pa.list_(pa.float64(), 3))
    file = io.BytesIO()
    write_table(pa.table(columns | {"word": pa.array(["a"] * _SAMPLES)}), file)
    return file.getvalue()


@cache
def mcap() -> bytes:
    """A bag of ROS 2."""
    from mcap_ros2.writer import Writer

    with tempfile.TemporaryFile() as file:
        writer = Writer(file)
        schema = writer.register_msgdef("demo/State", _MESSAGE)
        for k in range(_SAMPLES):
            stamp = 1_700_000_000_000_000_000 + k * 100_000_000
            content = {"x": k / 7, "y": 2.0, "q": [1.0, 2.0, 3.0], "flag": True, "frame": "map"}
            writer.write_message("/state", schema, content, log_time=stamp, publish_time=stamp)
        writer.finish()
        file.seek(0)
        return file.read()


_SOUND: tuple[tuple[str, Callable[[], bytes]], ...] = (
    (".mat", mat5),
    (".mat", mat5_plain),
    (".mat", mat73),
    (".parquet", parquet),
    (".mcap", mcap),
)


@cache
def _zip_bomb() -> bytes:
    """A valid header, and zeros compressed to a thousandth."""
    many = 20_000_000
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({many // 8},), }}".ljust(117) + "\n"
    member = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header.encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as bundle:
        for name in ("t", *_NAMES):
            bundle.writestr(f"{name}.npy", member + bytes(many))
    return file.getvalue()


@cache
def _nested_zip() -> bytes:
    """An archive of archives."""
    data = b"\0" * 1_000_000
    for _ in range(5):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as bundle:
            for name in ("t", "x", "y"):
                bundle.writestr(f"{name}.npy", data)
        data = file.getvalue()
    return data


@cache
def _mat_bomb() -> bytes:
    """One compressed element of MATLAB that unpacks to 100 MB."""
    packed = zlib.compress(b"\x0e\0\0\0" + (100_000_000).to_bytes(4, "little") + bytes(100_000_000), 1)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    return head + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed


def prepare() -> list[str]:
    """Make all files and import their readers, so that this does not count as run time of an input.

    Returns the formats that are skipped because a package is missing.
    """
    missing = []
    for make in (*(make for _, make in _SOUND), _zip_bomb, _nested_zip, _mat_bomb):
        try:
            make()
        except ModuleNotFoundError as error:
            missing.append(f"{make.__name__} ({error.name} is not installed)")
    for name in (
        "pyarrow.parquet",
        "pyarrow.csv",
        "h5py",
        "mcap.stream_reader",
        "rosbags.typesys",
        "lz4.frame",
    ):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    return missing
