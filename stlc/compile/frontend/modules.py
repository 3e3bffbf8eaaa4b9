"""Imports of other specifications, from files or from the texts stored with a run or a trace.

An imported file is identified by its key: its path relative to the folder of the main specification, or
`@std` for the library. Stored texts have the same keys, so that a specification keeps its meaning when it is
moved to another folder.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from stlc.diagnostics import Diagnostic, SpecError, UsageError
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.parser import parse
from stlc.jsontext import dumps
from stlc.provenance import sha256
from stlc.source import Source

STD = "@std"
_STD_FILE = Path(__file__).with_name("std.stl")
_MOST = 100
"""Limit on direct and indirect imports; repeated imports count each time."""


@dataclass(frozen=True, slots=True)
class Module:
    """Imported specification.

    Attributes:
        key: path relative to the folder of the main specification, or `@std` for the library.
        alias: name in the importing file.
        written: import declaration.
        spec: syntax tree of the imported file.
        imports: modules that the imported file imports itself.
    """

    key: str
    alias: str
    written: ast.Import
    spec: ast.Spec
    imports: tuple[Module, ...]


def load_modules(spec: ast.Spec) -> tuple[Module, ...]:
    """Return the modules that `spec` imports, each with the modules that it imports in turn.

    Raises:
        SpecError: a file cannot be read or imports itself (E106), or has syntax errors.
    """
    return _Loader(spec).imports(spec, "", ())


def library_of(spec: ast.Spec) -> dict[str, str]:
    """Return the text of each imported file by its key, so that `spec` can be stored without its folder."""
    found: dict[str, str] = {}
    for module in _every(load_modules(spec)):
        found[module.key] = module.spec.source.text
    return dict(sorted(found.items()))


def imported_files(spec: ast.Spec) -> list[Path]:
    """Paths of the files that `spec` imports, and of those that these import."""
    return [Path(module.spec.source.name) for module in _every(load_modules(spec))]


def spec_sha256(text: str, library: Mapping[str, str]) -> str:
    """Return the SHA-256 of a specification and its imports, in hexadecimal digits.

    `text` is the text of the specification; `library` contains the text of each imported file by its key.
    """
    return sha256(text + dumps(dict(sorted(library.items())))) if library else sha256(text)


def file_of(key: str) -> str:
    """Return the relative path at which the text of an imported file is stored.

    Each `..` in `key` is replaced by `__`, so that the path stays below its folder.
    """
    return "/".join("__" if part == ".." else part for part in key.split("/") if part) + (
        ".stl" if key == STD else ""
    )


def _every(modules: tuple[Module, ...]) -> Iterator[Module]:
    for module in modules:
        yield module
        yield from _every(module.imports)


class _Loader:
    """Loader of imported files that reads each file once."""

    def __init__(self, spec: ast.Spec) -> None:
        self.library = spec.library
        self.home = Path(spec.source.name).parent
        self.specs: dict[str, ast.Spec] = {}
        self.sizes: dict[str, int] = {}
        self.found: dict[str, tuple[Module, ...] | SpecError] = {}

    def imports(self, spec: ast.Spec, key: str, around: tuple[str, ...]) -> tuple[Module, ...]:
        """Return the modules that one file imports. Each file is read once.

        Args:
            spec: syntax tree of the file.
            key: path of the file relative to the folder of the main specification, or `@std` for the library.
            around: keys of the files through which this file is imported, from the main specification
                inwards.

        Raises:
            SpecError: a file cannot be read or imports itself (E106), or has syntax errors.
        """
        if key not in self.found:
            try:
                self.found[key] = self._imports(spec, key, around)
            except SpecError as error:
                self.found[key] = error
        found = self.found[key]
        if isinstance(found, SpecError):
            raise found
        return found

    def _imports(self, spec: ast.Spec, key: str, around: tuple[str, ...]) -> tuple[Module, ...]:
        found: list[Module] = []
        faults: list[Diagnostic] = []
        for written in spec.imports:
            try:
                found.append(self._module(written, key, (*around, key)))
            except SpecError as error:
                faults += error.diagnostics
            if sum(self.sizes[module.key] for module in found) > _MOST:
                faults += _refused(written, f"more than {_MOST} files are imported").diagnostics
                break
        if faults:
            raise SpecError(*dict.fromkeys(faults))
        self.sizes[key] = 1 + sum(self.sizes[module.key] for module in found)
        return tuple(found)

    def _module(self, written: ast.Import, importer: str, around: tuple[str, ...]) -> Module:
        key = self._key(written, importer)
        if key in around:
            chain = " -> ".join(name or self.home.name for name in (*around[around.index(key) :], key))
            raise _refused(written, f"`{written.target}` imports itself", note=chain)
        alias = written.alias or _stem(written)
        if key not in self.specs:
            if max(len(self.specs), len(around)) >= _MOST:
                raise _refused(written, f"more than {_MOST} files are imported")
            self.specs[key] = parse(self._source(written, key))
        spec = self.specs[key]
        return Module(key, alias, written, spec, self.imports(spec, key, around))

    def _key(self, written: ast.Import, importer: str) -> str:
        if written.is_file:
            return posixpath.normpath(posixpath.join(posixpath.dirname(importer), written.target))
        if written.target != "std":
            help_ = f'`import std`, or a file: `import "{written.target}.stl" as {written.target}`'
            raise _refused(written, f"there is no library `{written.target}`", help_)
        return STD

    def _source(self, written: ast.Import, key: str) -> Source:
        if self.library is not None and key in self.library:
            return Source(f"lib/{file_of(key)}", self.library[key])
        if key == STD:
            return File(_STD_FILE).read()
        if self.library is not None:
            raise _refused(written, f"the text of `{written.target}` was not stored with this specification")
        try:
            return File(self.home / key).read()
        except UsageError as error:
            first = error.diagnostics[0]
            raise _refused(written, first.message, *first.help) from None


def _stem(written: ast.Import) -> str:
    name = Path(written.target).stem
    if name.isidentifier():
        return name
    raise _refused(written, f"`{name}` cannot be a name", f'import "{written.target}" as m')


def _refused(written: ast.Import, message: str, *help_: str, note: str = "") -> SpecError:
    return SpecError.of("E106", message, written.span, help=help_, note=(note,) if note else ())
