"""Which reader reads which file: by its suffix; everything that is not known is taken for an `.npz`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from zipfile import is_zipfile

from stlc.trace.formats.csv import read_csv
from stlc.trace.formats.npz import read_npz, unreadable
from stlc.trace.formats.table import of_table
from stlc.trace.meta import read_meta
from stlc.trace.recording import Recording, of_arrays

Reader = Callable[[Path], Recording]

TABLES = (".csv", ".tsv")
SUFFIXES = (".npz", *TABLES, ".parquet", ".pq", ".mat", ".mcap", ".bag", ".db3")

_LAZY: Mapping[str, str] = {
    ".parquet": "stlc.trace.formats.parquet:read_parquet",
    ".pq": "stlc.trace.formats.parquet:read_parquet",
    ".mat": "stlc.trace.formats.mat:read_mat",
    ".mcap": "stlc.trace.formats.mcap:read_mcap",
    ".bag": "stlc.trace.formats.bag:read_bag",
    ".db3": "stlc.trace.formats.bag:read_bag2",
}
_FOLDER = "stlc.trace.formats.bag:read_bag2"


def read_recording(path: Path) -> Recording:
    """Read a file of any format.

    Raises:
        UsageError: U102, no such file.
        MissingError: R301, the format needs a package that is not installed.
        TraceError: the file cannot be read (E603) or does not fit together (E605).
    """
    suffix = path.suffix.lower()
    if suffix in TABLES:
        return of_table(path, read_csv(path))
    where = _FOLDER if path.is_dir() else _LAZY.get(suffix)
    if where is None:
        return _from_npz(path)
    module, _, function = where.partition(":")
    reader: Reader = getattr(import_module(module), function)
    return reader(path)


def _from_npz(path: Path) -> Recording:
    if path.suffix.lower() not in SUFFIXES and path.is_file() and not is_zipfile(path):
        why = f"its suffix is none of {' '.join(SUFFIXES)}"
        raise unreadable(path, why, advice="give it the suffix of its format")
    arrays = read_npz(path)
    meta, columns = read_meta(path, arrays.pop("meta", None))
    recording = of_arrays(path, arrays, meta)
    (strand,) = recording.strands
    return Recording(str(path), (strand,), columns, meta, recording.extras)
