"""Optional packages: the extra of stlc that brings each of them, and the error where one is missing."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from stlc.diagnostics import MissingError

EXTRAS = {
    "train": ("torch", "safetensors", "mpmath"),
    "plot": ("matplotlib", "pillow"),
    "parquet": ("pyarrow",),
    "mat": ("h5py",),
    "mcap": ("mcap", "protobuf"),
    "bag": ("rosbags", "lz4", "zstandard"),
    "ulg": ("pyulog",),
    "mf4": ("asammdf",),
    "lsp": ("pygls",),
    "log": ("tensorboardX",),
    "gym": ("gymnasium",),
    "onnx": ("onnx", "onnxruntime"),
    "fmu": ("fmpy",),
    "cluster": ("ray",),
    "plan": ("highspy",),
    "panda": ("pybullet", "pytorch-kinematics"),
    "bench": ("stable-baselines3", "cma", "casadi", "reelay", "sentil", "mstlo-python"),
}
"""Extras with the packages that they bring, named as in `pyproject.toml`."""
CPU_BUILD = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
"""Command for the build of PyTorch without CUDA, which is smaller by several GB."""
_PACKAGES = {"PIL": "pillow", "google": "protobuf", "lsprotocol": "pygls", "pybullet_data": "pybullet"}
"""Packages with other names than their modules."""


class NotInstalledError(MissingError, ModuleNotFoundError):
    """Error R301: a package is not installed. Also a `ModuleNotFoundError`, for callers who import."""


def not_installed(*packages: str, need: str = "this needs") -> NotInstalledError:
    """Return the error R301, with the commands that install the packages.

    Args:
        packages: names of packages of one extra, or of none.
        need: subject and verb of the message.
    """
    extra = next((name for name, brought in EXTRAS.items() if packages[0] in brought), "")
    names = " and ".join(f"`{name}`" for name in packages)
    message = f"{need} {names}{extra and f' of the extra `{extra}`'}, which is not installed"
    advice = [CPU_BUILD] if "torch" in packages else []
    advice.append(installation(extra) if extra else f"pip install {packages[0]}")
    error = NotInstalledError.of("R301", message, help=tuple(advice))
    error.name = packages[0]
    return error


def commands() -> dict[str, str]:
    """Optional packages, each with the first command that installs it."""
    packages = (package for brought in EXTRAS.values() for package in brought)
    return {package: not_installed(package).diagnostics[0].help[0] for package in packages}


def installation(extra: str) -> str:
    """Command that installs an extra of stlc from the checkout, address or index that stlc itself is from."""
    from importlib.metadata import distributions

    root = Path(__file__).resolve().parents[1]
    if (root / "pyproject.toml").is_file():
        return f"pip install -e {_quoted(f'{root}[{extra}]')}"
    records = (each.read_text("direct_url.json") or "{}" for each in distributions(name="stlc"))
    origin = json.loads(next(records, '{"url": "git+URL"}'))  # PEP 610
    version = origin.get("vcs_info")
    prefix, suffix = (f"{version['vcs']}+", f"@{version['commit_id']}") if version else ("", "")
    address = f" @ {prefix}{origin['url']}{suffix}" if origin else ""
    return f"pip install {_quoted(f'stlc[{extra}]{address}')}"


def _quoted(text: str) -> str:
    return f'"{text}"' if os.name == "nt" else shlex.quote(text)


def needed(module: str, need: str = "this needs") -> Any:
    """Import and return a module of an optional package. Raises NotInstalledError (R301)."""
    try:
        return import_module(module)
    except ImportError:
        raise not_installed(package_of(module), need=need) from None


@contextmanager
def explained() -> Iterator[None]:
    """Context in which the import of a missing optional package raises NotInstalledError (R301)."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (known := absent(error)) is None:
            raise
        raise known from None


def absent(error: ModuleNotFoundError) -> NotInstalledError | None:
    """Return the error R301 if the module that was not found is of an optional package."""
    package = package_of(error.name or "")
    return not_installed(package) if any(package in brought for brought in EXTRAS.values()) else None


def package_of(module: str) -> str:
    """Name of the package of a module."""
    top = module.partition(".")[0]
    return _PACKAGES.get(top, top.replace("_", "-"))
