"""`stlc doctor`: installed and missing packages, and their consequences."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer

from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.program import command

State = Literal["ok", "missing", "off"]
MISSING = 5

_SLOWER = "torch does its work, about ten times slower"
_NEEDED = ("torch", "numpy", "lark", "pyyaml", "safetensors", "typer", "rich")


@dataclass(frozen=True, slots=True)
class HealthFinding:
    """One checked item.

    Attributes:
        name: of it.
        state: "off" for a missing item that only some commands need.
        detail: a version, a path, or advice.
    """

    name: str
    state: State
    detail: str


@command("stlc doctor")
def doctor(
    quick: Annotated[bool, typer.Option("--quick", help="Do not import torch to look for devices.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check the installation: versions, devices, packages.

    Shell completion too. Exit code: 0, or 5 if a required package is missing.
    """
    findings = [*_python(), *_packages(), *_devices(quick=quick), *_tools()]
    missing = [finding.name for finding in findings if finding.state == "missing"]
    code = MISSING if missing else 0
    if as_json:
        rows = [{"name": f.name, "state": f.state, "detail": f.detail} for f in findings]
        emit_json("doctor/1", ok=not missing, exit_code=code, result={"findings": rows})
    else:
        emit(table([(finding.name, finding.state, finding.detail) for finding in findings]))
        say(f"missing: {', '.join(missing)}" if missing else "all that is needed is there")
    raise typer.Exit(code)


def _python() -> Iterator[HealthFinding]:
    from stlc.version import __version__

    yield HealthFinding("stlc", "ok", f"{__version__} in {Path(__file__).parents[2]}")
    found = ".".join(map(str, sys.version_info[:3]))
    enough = sys.version_info >= (3, 11)
    yield HealthFinding(
        "python", "ok" if enough else "missing", found if enough else f"{found}; 3.11 is needed"
    )


def _packages() -> Iterator[HealthFinding]:
    for name in _NEEDED:
        found = _version(name)
        yield HealthFinding(name, "ok" if found else "missing", found or f"pip install {name}")
    for package, extra in _optional().items():
        found = _version(package)
        yield HealthFinding(package, "ok" if found else "off", found or f"pip install 'stlc[{extra}]'")


def _optional() -> dict[str, str]:
    """Package -> the extra that installs it, from the metadata of stlc."""
    from importlib.metadata import PackageNotFoundError, requires

    try:
        declared = requires("stlc") or []
    except PackageNotFoundError:
        return {}
    found: dict[str, str] = {}
    for entry in declared:
        requirement, _, marker = entry.partition(";")
        extra = marker.partition("extra ==")[2].strip(" '\"()")
        name = requirement.split("[")[0].split(">")[0].split("=")[0].split("<")[0].split("!")[0].strip()
        if extra and extra not in ("dev", "all") and name != "stlc":
            found.setdefault(name, extra)
    return found


def _version(package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _devices(*, quick: bool) -> Iterator[HealthFinding]:
    from stlc.provenance import hardware

    machine = hardware()
    memory = machine.get("memory_gib")
    detail = f"{machine.get('processor') or machine.get('machine')}, {machine.get('cores')} cores"
    yield HealthFinding("cpu", "ok", detail + (f", {memory} GiB" if memory else ""))
    if quick or find_spec("torch") is None:
        return
    import torch

    if torch.cuda.is_available():
        names = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
        yield HealthFinding("cuda", "ok", names)
    else:
        yield HealthFinding("cuda", "off", "no device; everything runs on the processor")


def _tools() -> Iterator[HealthFinding]:
    yield _cache()
    yield _compiler()
    installed = _completion()
    yield HealthFinding("completion", "ok" if installed else "off", installed or "stlc --install-completion")


def _cache() -> HealthFinding:
    """The cache folder of kernels and parser tables."""
    from stlc.cache import Unusable, opened, why_not

    try:
        kept = opened()
    except Unusable:
        return HealthFinding(
            "cache", "off", f"{why_not()}; starting takes 0.1 s longer, kernels are built anew"
        )
    count, size = kept.size()
    if not os.access(kept.folder, os.W_OK):
        return HealthFinding("cache", "off", f"{kept.shown} cannot be written to; new kernels are not kept")
    return HealthFinding(
        "cache", "ok", f"{kept.shown}: {count} file{'' if count == 1 else 's'}, {size / 1e6:.1f} MB"
    )


def _compiler() -> HealthFinding:
    """Evaluator of plans, C kernels or torch, and remembered failures of the compiler."""
    from stlc.toolchain import compiler, remembered, works

    found = compiler()
    if found is None:
        return HealthFinding("compiler", "off", f"no C compiler (cc, gcc, clang, $CC); {_SLOWER}")
    before = remembered()
    why = works(found)
    if why:
        return HealthFinding("compiler", "off", f"{found} {why}; {_SLOWER}")
    detail = f"{found}; training, search and backup run as C"
    if before:
        detail += f" (a short while ago it {before[0]}; it is tried again from now on)"
    return HealthFinding("compiler", "ok", detail)


def _completion() -> str:
    """The file that completes commands in the user's shell; "" if there is none."""
    try:
        home = Path.home()
    except (RuntimeError, OSError):
        return ""
    places = (
        home / ".bash_completions/stlc.sh",
        home / ".zfunc/_stlc",
        home / ".config/fish/completions/stlc.fish",
    )
    return next((str(path) for path in places if os.path.isfile(path)), "")  # noqa: PTH113 - False where it may not be seen
