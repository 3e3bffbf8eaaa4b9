"""Input files of a problem: the specification, and what it and its system name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from stlc.diagnostics import StlcError
from stlc.dynamics.load import load_system_decl
from stlc.files import File
from stlc.grammar.spec import Module, Spec


def input_files(
    path: Path, system: str | None = None, overrides: Mapping[str, str] | None = None
) -> tuple[Path, ...]:
    """Paths of the input files of a problem.

    If a file has errors, the files that it names may be missing; whoever reads it reports the errors.

    Args:
        path: path of the specification.
        system: system file that replaces the one named by the specification.
        overrides: values of `--set`.
    """
    path = File(path).spec()
    found: dict[Path, None] = {path: None}
    with suppress(StlcError):
        spec = Spec.parse(File(path).read())
        found.update(dict.fromkeys(_imported(spec.modules())))
        if (wanted := system or spec.system) is not None:
            there = File(wanted).system(path)
            found[there] = None
            decl = load_system_decl(there, overrides or {})
            found.update(dict.fromkeys(decl.files.values()))
            found.update(dict.fromkeys(world.path for world in decl.worlds))
            for judge in decl.judges:
                found[judge.path] = None
                found.update(dict.fromkeys(_imported(Spec.parse(File(judge.path).read()).modules())))
    return tuple(file for file in found if file.is_file())


def _imported(modules: tuple[Module, ...]) -> Iterator[Path]:
    for module in modules:
        yield Path(module.spec.source.name)
        yield from _imported(module.imports)
