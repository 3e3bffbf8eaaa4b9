"""stlc as it is installed: the wheel, in environments that hold exactly what it asks for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, PathDistribution, distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]


def build_wheel(folder: Path) -> Path:
    """The wheel of the tree, built without a network."""
    program = f"from hatchling.build import build_wheel; build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@dataclass(frozen=True)
class Said:
    """Result of a command."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Installed:
    """An environment with stlc and what it needs, linked from the one that runs the tests."""

    root: Path

    @property
    def packages(self) -> Path:
        return next((self.root / "lib").glob("python*/site-packages"))

    @property
    def library(self) -> Path:
        return self.packages / "stlc/library"

    def run(self, folder: Path, *lines: Sequence[str], **variables: str) -> list[Said]:
        """Run commands in a folder, one after the other in one process."""
        lasting = {"XDG_CACHE_HOME": os.environ["XDG_CACHE_HOME"]} if "XDG_CACHE_HOME" in os.environ else {}
        clean = {"PATH": "/usr/bin:/bin", "HOME": os.environ.get("HOME", ""), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [str(self.root / "bin/python"), "-c", _COMMANDS, json.dumps([list(line) for line in lines])],
            cwd=folder,
            env={**clean, **lasting, "MPLBACKEND": "Agg", **variables},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return [Said(*each) for each in json.loads(done.stdout.splitlines()[-1])]

    def python(self, folder: Path, program: str) -> Said:
        """Run a program."""
        done = subprocess.run(
            [str(self.root / "bin/python"), "-c", program],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        return Said(done.returncode, done.stdout, done.stderr)


_COMMANDS = """
import contextlib, io, json, sys
from stlc.cli.framework.app import main
results = []
for line in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(line)
    results.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(results))
"""


def install(wheel: Path, root: Path, *extras: str) -> Installed:
    """An environment with a wheel, what it requires, and what these extras require."""
    base = Path(sys.executable).resolve()
    folder = root / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    for place in (root / "bin", folder):
        place.mkdir(parents=True)
    (root / "bin/python").symlink_to(base)
    (root / "pyvenv.cfg").write_text(f"home = {base.parent}\ninclude-system-site-packages = false\n")
    made = Installed(root)
    for part in _unpacked(wheel).iterdir():
        (made.packages / part.name).symlink_to(part)
    (info,) = made.packages.glob("stlc-*.dist-info")
    for found in _closure(PathDistribution(info), extras):
        for name in _tops(found):
            link, target = made.packages / name, Path(str(found.locate_file(name)))
            if target.exists() and not link.exists():
                link.symlink_to(target)
    return made


@cache
def _unpacked(wheel: Path) -> Path:
    """The content of a wheel, beside it."""
    folder = wheel.with_suffix("")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder)
    return folder


def _closure(root: PathDistribution, extras: Sequence[str]) -> Iterator[Distribution]:
    """Requirements of a distribution, and theirs, as they are installed here."""
    seen: set[tuple[str, str]] = set()
    queue = [(root, extra) for extra in ("", *extras)]
    while queue:
        asking, extra = queue.pop()
        for text in asking.requires or ():
            need = Requirement(text)
            if need.marker is not None and not need.marker.evaluate({"extra": extra}):
                continue
            name = canonicalize_name(need.name)
            if name == "stlc":  # an extra that is made of others
                queue += [(root, part) for part in need.extras if _new(seen, name, part)]
                continue
            try:
                found = distribution(name)
            except PackageNotFoundError:
                pytest.skip(f"{name} is not installed here")
            assert need.specifier.contains(found.version, prereleases=True), text
            for part in ("", *need.extras):
                if _new(seen, name, part):
                    queue.append((found, part))
                    yield found


def _new(seen: set[tuple[str, str]], name: str, part: str) -> bool:
    known = (name, part) in seen
    seen.add((name, part))
    return not known


@cache
def _names(name: str) -> frozenset[str]:
    files = distribution(name).files or ()
    return frozenset(file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__"))


def _tops(found: Distribution) -> frozenset[str]:
    """The files and folders of a distribution, from the folder where it is installed."""
    return _names(found.metadata["Name"])


def findings(said: Said) -> list[dict[str, Any]]:
    """The diagnostics of a command with `--json`."""
    found: list[dict[str, Any]] = json.loads(said.out)["diagnostics"]
    return found
