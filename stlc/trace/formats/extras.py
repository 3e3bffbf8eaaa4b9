"""Packages that only some formats of traces need: imported when such a file is opened, or a diagnostic."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from stlc.diagnostics import Diagnostic, MissingError

_EXTRAS = {
    **{"pyarrow": "parquet", "h5py": "mat", "mcap": "mcap", "google": "mcap"},
    **{"rosbags": "bag", "lz4": "bag", "zstandard": "bag"},
}
_PACKAGES = {"google": "protobuf"}
"""Names of packages that differ from those of their modules."""


def needed(module: str) -> Any:
    """The module, imported.

    Raises:
        MissingError: R301, its package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        extra = _EXTRAS.get(package, "all")
        named = _PACKAGES.get(package, package)
        message = f"this needs the package `{named}`, which is not installed"
        raise MissingError(Diagnostic("R301", message, help=(f"pip install 'stlc[{extra}]'",))) from None
