"""`stlc doctor`: installed and missing packages, and the commands that need a missing one."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer

from stlc.cli.framework.output import Answer, emit, say, table
from stlc.cli.framework.program import command
from stlc.diagnostics import StlcError
from stlc.extras import commands
from stlc.plugins import installed

MISSING = 5

_SLOWER = "torch does its work, about ten times slower"
_NEEDED = ("numpy", "lark", "pyyaml", "typer", "rich")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing of an installation.

    Attributes:
        name: its name.
        state: `off`: it is missing, but only some commands need it.
        detail: its version or place, or the way to get it.
    """

    name: str
    state: Literal["ok", "missing", "off"]
    detail: str


@dataclass(frozen=True, slots=True)
class InstallationReport:
    """Everything that an installation may have."""

    findings: Sequence[Finding]


@command("stlc doctor")
def doctor(
    quick: Annotated[bool, typer.Option("--quick", help="Import neither torch nor plugins.")] = False,
) -> Answer[InstallationReport]:
    """Check the installation: versions, devices, packages, plugins.

    Exit code: 0, or 5 if a required package is missing.
    """
    from stlc.version import __version__

    completion = _completion()
    findings = [
        Finding("stlc", "ok", f"{__version__} in {Path(__file__).parents[2]}"),
        Finding("python", "ok", ".".join(map(str, sys.version_info[:3]))),
        *(*_packages(), *_devices(quick=quick), _cache(), _compiler()),
        Finding("completion", "ok" if completion else "off", completion or "stlc --install-completion"),
        *_plugins(quick=quick),
    ]
    missing = [finding.name for finding in findings if finding.state == "missing"]

    def show() -> None:
        emit(table([astuple(finding) for finding in findings]))
        say(f"missing: {', '.join(missing)}" if missing else "all that is needed is there")

    return Answer(InstallationReport(findings), show, MISSING if missing else 0)


def _packages() -> Iterator[Finding]:
    for name in _NEEDED:
        found = _version(name)
        yield Finding(name, "ok" if found else "missing", found or f"pip install {name}")
    for package, advice in commands().items():
        found = _version(package)
        yield Finding(package, "ok" if found else "off", found or advice)


def _version(package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _devices(*, quick: bool) -> Iterator[Finding]:
    from stlc.provenance import hardware

    machine = hardware()
    memory = machine.get("memory_gib")
    detail = f"{machine.get('processor') or machine.get('machine')}, {machine.get('cores')} cores"
    yield Finding("cpu", "ok", detail + (f", {memory} GiB" if memory else ""))
    if quick or find_spec("torch") is None:
        return
    import torch

    if torch.cuda.is_available():
        names = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
        yield Finding("cuda", "ok", names)
    else:
        yield Finding("cuda", "off", "no device; everything runs on the processor")


def _plugins(*, quick: bool) -> Iterator[Finding]:
    """Yield a line for each plugin of other packages; it is imported unless `quick`."""
    for plugin in installed():
        try:
            _ = quick or plugin.load()
        except StlcError as error:
            yield Finding(plugin.name, "off", " ".join((plugin.source, *error.diagnostics[0].note)))
        else:
            yield Finding(plugin.name, "ok", f"{plugin.source}, {plugin.group}")


def _cache() -> Finding:
    """Return the line of the report on the cache folder, which keeps compiled kernels and parser tables."""
    from stlc.cache import Unusable, opened, why_not

    try:
        kept = opened()
    except Unusable:
        return Finding("cache", "off", f"{why_not()}; starting takes 0.1 s longer, kernels are built anew")
    count, size = kept.size()
    if not os.access(kept.folder, os.W_OK):
        return Finding("cache", "off", f"{kept.shown} cannot be written to; new kernels are not kept")
    return Finding(
        "cache", "ok", f"{kept.shown}: {count} file{'' if count == 1 else 's'}, {size / 1e6:.1f} MB"
    )


def _compiler() -> Finding:
    """Return the line of the report on the C compiler.

    It says whether plans are evaluated in C or in torch, and names a recent failure of the compiler.
    """
    from stlc.toolchain import compiler, remembered, works

    found = compiler()
    if found is None:
        return Finding("compiler", "off", f"no C compiler (cc, gcc, clang, $CC); {_SLOWER}")
    before = remembered()
    why = works(found)
    if why:
        return Finding("compiler", "off", f"{found} {why}; {_SLOWER}")
    detail = f"{found}; training, search and backup run as C"
    if before:
        detail += f" (a short while ago it {before[0]}; it is tried again from now on)"
    return Finding("compiler", "ok", detail)


def _completion() -> str:
    """Path of the file that sets up command completion in the user's shell; "" if there is none."""
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
