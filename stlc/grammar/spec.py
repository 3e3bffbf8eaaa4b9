"""Specifications: the syntax tree of a whole file, its parser, and the specifications that it imports.

A text is split before each declaration and the pieces are parsed separately, so that one run reports all
independent errors.

Imports come from files, or from the texts stored with a run or a trace. An imported file is identified by its
key: its path relative to the folder of the main specification, or `@std` for the library. Stored texts have
the same keys, so that a specification keeps its meaning when it is moved to another folder.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from stlc.diagnostics import Diagnostic, SpecError, UsageError
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.builder import BuildContext
from stlc.grammar.declarations import Item, Pragma
from stlc.grammar.scan import declaration_starts
from stlc.jsontext import dumps
from stlc.provenance import sha256
from stlc.source import Source, Span

D = TypeVar("D", bound=ast.Declaration)

STD = "@std"
_STD_FILE = Path(__file__).with_name("std.stl")
_MOST = 100
"""Limit on direct and indirect imports; repeated imports count each time."""


@dataclass(frozen=True, slots=True)
class Spec(ast.Node):
    """Syntax tree of a whole file.

    Attributes:
        name: name given by `spec NAME`; "" without it.
        system: path given by `system "…"`, or None.
        system_span: location of that path in the source, or None.
        time_unit: unit of interval bounds that are written without a unit, given by the line `time UNIT`; ""
            if there is no such line.
        imports: imports, in order.
        items: declarations, in order.
        source: the source text.
        library: key of an imported file -> its text. A trace, for example, stores such texts. If None, the
            files are read from disk.
    """

    name: str
    system: str | None
    system_span: Span | None = field(compare=False, repr=False)
    time_unit: str
    imports: tuple[ast.Import, ...]
    items: tuple[ast.Declaration, ...]
    source: Source = field(compare=False, repr=False)
    library: Mapping[str, str] | None = field(default=None, compare=False, repr=False)

    @classmethod
    def load(cls, path: Path | str) -> Spec:
        """Read and parse a specification file, or an installed specification (`stlc.files.File.spec`).

        Raises:
            UsageError: U102, there is no such file.
            SpecError: the text is not a specification; the error carries all diagnostics.
        """
        return cls.parse(File(File(path).spec()).read())

    @classmethod
    def parse(cls, source: Source) -> Spec:
        """Return the syntax tree of a specification.

        Raises:
            SpecError: the text has errors; of the independent ones, the first `MAX_ERRORS` are reported.
        """
        from stlc.grammar.errors.failure import Piece  # these import Lark, which a printer does not need
        from stlc.grammar.fold import PieceError
        from stlc.grammar.parser import MAX_ERRORS, build, check_text

        check_text(source, 0, len(source.text))
        context = BuildContext(source)
        items: list[Item] = []
        starts = declaration_starts(source.text)
        skip_line = 0
        for start, end in zip(starts, [*starts[1:], len(source.text)], strict=True):
            if skip_line and source.position(start)[0] == skip_line:
                continue
            skip_line = 0
            piece = Piece(source, start, end, "start")
            try:
                items.extend(build(piece, context))
            except PieceError as error:
                context.findings.append(error.finding)
                skip_line = source.position(max(start, end - 1))[0]
            if len(context.findings) >= MAX_ERRORS:
                break
        spec = cls._of(source, items, context.findings)
        if context.findings:
            raise SpecError(*context.findings[:MAX_ERRORS])
        return spec

    @classmethod
    def _of(cls, source: Source, items: Sequence[Item], findings: list[Diagnostic]) -> Spec:
        """Return the specification that consists of the pragmas, imports and declarations in `items`.

        Pragmas are the lines about the whole file. E102 is appended to `findings` for a pragma that is
        repeated.
        """
        pragmas: dict[str, Pragma] = {}
        imports: list[ast.Import] = []
        declared: list[ast.Declaration] = []
        for item in items:
            match item:
                case Pragma(kind, _, span):
                    if kind in pragmas:
                        findings.append(_twice(pragmas[kind], span))
                    pragmas.setdefault(kind, item)
                case ast.Import():
                    imports.append(item)
                case tuple():
                    declared.extend(item)
                case _:
                    declared.append(item)
        system = pragmas.get("system")
        return cls(
            source.span(0, len(source.text)),
            name=pragmas["spec"].value if "spec" in pragmas else "",
            system=None if system is None else system.value,
            system_span=None if system is None else system.span,
            time_unit=pragmas["time"].value if "time" in pragmas else "",
            imports=tuple(imports),
            items=tuple(declared),
            source=source,
        )

    def modules(self) -> tuple[Module, ...]:
        """Return the modules that the specification imports, each with the modules that it imports in turn.

        Raises:
            SpecError: a file cannot be read or imports itself (E106), or has syntax errors.
        """
        return _Loader(self).imports(self, "", ())

    def imported_texts(self) -> dict[str, str]:
        """Return the text of each imported file by its key, with which the specification can be stored."""
        found = {module.key: module.spec.source.text for module in _every(self.modules())}
        return dict(sorted(found.items()))

    def imported_files(self) -> list[Path]:
        """Return the paths of the imported files, and of those that these import."""
        return [Path(module.spec.source.name) for module in _every(self.modules())]

    @property
    def sha256(self) -> str:
        """SHA-256 of the text and of the imported texts, in hexadecimal digits."""
        library = self.imported_texts()
        return sha256(self.source.text + dumps(library)) if library else sha256(self.source.text)

    @property
    def requirements(self) -> dict[str, ast.Require]:
        """Requirements by name, in order."""
        return {item.name: item for item in self._all(ast.Require)}

    @property
    def signals(self) -> tuple[ast.Signal, ...]:
        """Signals, in order."""
        return self._all(ast.Signal)

    @property
    def constants(self) -> tuple[ast.Const, ...]:
        """Constants, in order."""
        return self._all(ast.Const)

    @property
    def rules(self) -> tuple[ast.Require | ast.Assume, ...]:
        """Requirements and assumptions, in order."""
        return tuple(item for item in self.items if isinstance(item, (ast.Require, ast.Assume)))

    @property
    def parameters(self) -> tuple[ast.Param, ...]:
        """Parameters, in order."""
        return self._all(ast.Param)

    @property
    def read(self) -> tuple[ast.Signal | ast.Param, ...]:
        """Signals and parameters, which have values along a trace, in order."""
        return tuple(item for item in self.items if isinstance(item, (ast.Signal, ast.Param)))

    @property
    def functions(self) -> tuple[ast.Extern, ...]:
        """Functions from outside, in order."""
        return self._all(ast.Extern)

    @property
    def enums(self) -> tuple[ast.Enum, ...]:
        """Enumerations, in order."""
        return self._all(ast.Enum)

    @property
    def settable(self) -> frozenset[str]:
        """Names of the constants and parameters, whose values `--set` replaces."""
        return frozenset(item.name for item in self.items if isinstance(item, (ast.Const, ast.Param)))

    @property
    def definitions(self) -> dict[str, ast.Expr]:
        """Expressions that macros and regions stand for, by name."""
        return {item.name: item.value for item in self.items if isinstance(item, (ast.Def, ast.Region))}

    @property
    def vocabulary(self) -> tuple[ast.Declaration, ...]:
        """Declarations other than requirements and assumptions, which other specifications may use."""
        return tuple(item for item in self.items if not isinstance(item, (ast.Require, ast.Assume)))

    def _all(self, kind: type[D]) -> tuple[D, ...]:
        return tuple(item for item in self.items if isinstance(item, kind))


def _twice(first: Pragma, span: Span) -> Diagnostic:
    return Diagnostic(
        "E102",
        f"`{first.kind}` is given twice",
        span,
        label="again",
        labels=(first.span.label("first"),),
        help=("keep one of them",),
    )


# --------------------------------------------------------------------------- imports


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
    spec: Spec
    imports: tuple[Module, ...]


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

    def __init__(self, spec: Spec) -> None:
        self.library = spec.library
        self.home = Path(spec.source.name).parent
        self.specs: dict[str, Spec] = {}
        self.sizes: dict[str, int] = {}
        self.found: dict[str, tuple[Module, ...] | SpecError] = {}

    def imports(self, spec: Spec, key: str, around: tuple[str, ...]) -> tuple[Module, ...]:
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

    def _imports(self, spec: Spec, key: str, around: tuple[str, ...]) -> tuple[Module, ...]:
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
        if written.is_file:
            key = posixpath.normpath(posixpath.join(posixpath.dirname(importer), written.target))
        elif written.target == "std":
            key = STD
        else:
            help_ = f'`import std`, or a file: `import "{written.target}.stl" as {written.target}`'
            raise _refused(written, f"there is no library `{written.target}`", help_)
        if key in around:
            chain = " -> ".join(name or self.home.name for name in (*around[around.index(key) :], key))
            raise _refused(written, f"`{written.target}` imports itself", note=chain)
        alias = written.alias or Path(written.target).stem
        if not (written.alias or alias.isidentifier()):
            raise _refused(written, f"`{alias}` cannot be a name", f'import "{written.target}" as m')
        if key not in self.specs:
            if max(len(self.specs), len(around)) >= _MOST:
                raise _refused(written, f"more than {_MOST} files are imported")
            self.specs[key] = Spec.parse(self._source(written, key))
        spec = self.specs[key]
        return Module(key, alias, written, spec, self.imports(spec, key, around))

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


def _refused(written: ast.Import, message: str, *help_: str, note: str = "") -> SpecError:
    return SpecError.of("E106", message, written.span, help=help_, note=(note,) if note else ())
