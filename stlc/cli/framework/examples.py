"""The examples that a project may begin with: the installed systems, each with its specifications."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from stlc.diagnostics import Diagnostic, UsageError
from stlc.files import SPECS, SYSTEMS
from stlc.registry import closest

FIRST, EMPTY = "cart", "empty"

_SYSTEM = re.compile(r'^(system\s+")[^"\n]*?([^"/\n]+\.yaml)"', re.MULTILINE)
_JUDGE = re.compile(r"^ *judge: *(?:[^\s#]*/)?([\w-]+\.stl)\b", re.MULTILINE)
_BESIDE = re.compile(r"[\w-]+\.(?:py|urdf)\b")


def examples(incomplete: str = "") -> list[str]:
    """Names of all examples that begin so."""
    found = {system.removesuffix(".yaml") for _, system in _pairs()}
    return [name for name in (FIRST, *sorted(found), EMPTY) if name.startswith(incomplete)]


def example_files(name: str) -> dict[str, str]:
    """Path within the project -> text: the specifications of a system, the system, and what it needs.

    Raises:
        UsageError: U101, there is no such example.
    """
    specs = [path for path, system in _pairs() if name in (system.removesuffix(".yaml"), path.stem)]
    if not specs:
        near = closest(name, examples())
        advice = (f"did you mean `{near}`?",) if near else ()
        note = (f"there are {', '.join(examples())}",)
        raise UsageError(Diagnostic("U101", f"there is no example `{name}`", help=advice, note=note))
    files: dict[str, str] = {}
    judges = [SPECS / judge for _, system in _pairs(specs) for judge in _JUDGE.findall(_text(system))]
    for path in dict.fromkeys((*specs, *judges)):
        text = path.read_text(encoding="utf-8")
        system = next(found[2] for found in _SYSTEM.finditer(text))
        files[f"specs/{path.name}"] = _SYSTEM.sub(r'\1../systems/\2"', text)
        files |= _system(system)
    return files


def judges(texts: Iterable[str]) -> set[str]:
    """Names of the specifications by which the systems among these texts judge drives."""
    return {name for text in texts for name in _JUDGE.findall(text)}


def _pairs(specs: Iterable[Path] | None = None) -> Iterator[tuple[Path, str]]:
    """Every specification (of those given) whose system is installed, and the name of that file."""
    for path in sorted(SPECS.glob("*.stl")) if specs is None else specs:
        named = _SYSTEM.search(path.read_text(encoding="utf-8"))
        if named and (SYSTEMS / named[2]).is_file():
            yield path, named[2]


def _system(name: str) -> dict[str, str]:
    """A system file, and the files beside it that it names."""
    text = _text(name)
    beside = [word for word in dict.fromkeys(_BESIDE.findall(text)) if (SYSTEMS / word).is_file()]
    return {f"systems/{file}": (SYSTEMS / file).read_text(encoding="utf-8") for file in (name, *beside)}


def _text(system: str) -> str:
    return (SYSTEMS / system).read_text(encoding="utf-8")
