"""Analysis of a specification that is open in an editor: findings, symbols, and the meaning of names."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from stlc.compile.frontend.declare import ranged
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.expressions import resolve_formula
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import declared
from stlc.compile.frontend.scope import Definition, Failed, Known, Scope
from stlc.compile.frontend.values import Value
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.nodes import Window
from stlc.compile.ir.simplify import simplify
from stlc.diagnostics import Diagnostic, SpecError, StlcError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.load import load_system_decl
from stlc.editor.symbols import Symbol, SymbolNames, names_of
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.scan import Lexeme, declaration_starts
from stlc.grammar.spec import Module, Spec
from stlc.lint.lint import Surroundings, lint
from stlc.monitor.facts.findings import findings_on
from stlc.signature import Column
from stlc.source import Source, Span

_ONLY_FOR_TRAINING = frozenset({"E306", "E307", "E309", "E310", "E312"})
_MAX_LABELS = 8


@dataclass(frozen=True, slots=True)
class Finding:
    """A diagnostic and its location in the edited text.

    Attributes:
        diagnostic: the same diagnostic that `stlc lint` prints.
        span: location in the edited text.
        mild: True for an error that prevents training but not monitoring. The editor shows it as a warning.
    """

    diagnostic: Diagnostic
    span: Span
    mild: bool = False


@dataclass(frozen=True)
class Document:
    """Analysis of one version of a text, from which all requests of the editor are answered.

    Attributes:
        source: the text, with the path of its file.
        spec: syntax tree of the declarations without syntax errors.
        unread: errors of the declarations that could not be parsed.
        system: declaration of the system that the text names, or None.
        missing: errors because of which the system could not be loaded; empty if it was loaded.
        trace: path of a recording, whose facts are shown too; None for none.
    """

    source: Source
    spec: Spec = field(repr=False)
    unread: tuple[Diagnostic, ...]
    system: SystemDecl | None
    missing: tuple[Diagnostic, ...]
    trace: Path | None = None

    @cached_property
    def names(self) -> SymbolNames:
        """Symbols of the text and their occurrences."""
        return names_of(self.spec)

    @property
    def grid(self) -> Grid:
        """Time step (s) and horizon (steps) of the system; both are None without a system."""
        return Grid() if self.system is None else Grid(self.system.dt, self.system.horizon)

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """Imported modules; empty if any of their files cannot be read."""
        try:
            return self.spec.modules()
        except StlcError:
            return ()

    @cached_property
    def meaning(self) -> Meaning:
        """The part of the specification that can be resolved: names, columns, formulas and intervals."""
        interface = None if self.system is None else self.system.interface()
        return understand(self.spec, self.modules, interface=interface, grid=self.grid)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of `stlc lint`, and errors of the system file, in text order."""
        found = [self._about_system(self.missing)] if self.missing else []
        within = None
        if self.system is not None:
            judge = self.system.judges_by(Path(self.source.name))
            within = Surroundings(self.system.interface(), self.grid, "check" if judge else "train")
        linted = self.unread or lint(self.source, within=within)
        errors = {one.code for one in linted if one.severity == "error"}
        if self.trace is not None and not (errors or self.missing):
            linted = (*linted, *findings_on(self.spec, self.trace, self.spec.system))
        mild = bool(errors) and errors <= _ONLY_FOR_TRAINING
        for one in linted:
            if one.span is not None and one.span.source.name == self.source.name:
                placed = Finding(one, self.source.span(one.span.start, one.span.end))
            else:  # it is of another file
                placed = self._about_system((one,))
            found.append(replace(placed, mild=mild and one.severity == "error"))
        return tuple(sorted(found, key=lambda one: one.span.start))

    def _about_system(self, findings: tuple[Diagnostic, ...]) -> Finding:
        first = findings[0]
        labels = [one.span.label(f"{one.code}: {one.message}") for one in findings if one.span is not None]
        place = self.spec.system_span
        span = self.source.span(0, 0) if place is None else self.source.span(place.start, place.end)
        more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        whole = replace(first, message=first.message + more, labels=(*labels[:_MAX_LABELS], *first.labels))
        return Finding(whole, span)


class Systems:
    """Cache of loaded system files; a file is read again when it has changed."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, int], SystemDecl | StlcError]] = {}

    def load(self, name: str, spec_path: Path) -> SystemDecl:
        """Load the system that a specification names. Raises StlcError if it is missing or invalid."""
        path = File(name).system(spec_path)
        status = path.stat()
        stamp = (status.st_mtime_ns, status.st_size)
        known = self._known.get(path)
        if known is None or known[0] != stamp:
            try:
                known = (stamp, load_system_decl(path))
            except StlcError as error:
                known = (stamp, error)
            self._known[path] = known
        if isinstance(known[1], StlcError):
            raise known[1]
        return known[1]


def analyse(source: Source, systems: Systems, trace: Path | None = None) -> Document:
    """Analyse a text together with the system that it names, and with a recording, if there is one."""
    spec, unread = read(source)
    if spec.system is None:
        return Document(source, spec, unread, None, (), trace)
    try:
        return Document(source, spec, unread, systems.load(spec.system, Path(source.name)), (), trace)
    except StlcError as error:
        return Document(source, spec, unread, None, error.diagnostics)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        finding = Diagnostic("U102", f"cannot read `{spec.system}`: {reason}")
        return Document(source, spec, unread, None, (finding,))


# ---------------------------------------------------------------------- reading


_ROUNDS = 8
_INK = re.compile(r"[^\n]")


def read(source: Source) -> tuple[Spec, tuple[Diagnostic, ...]]:
    """Parse a text; return the tree of all declarations without syntax errors, and diagnostics of the others.

    Source locations in the tree are valid for `source`: declarations with errors are blanked, not cut out.
    """
    try:
        return Spec.parse(source), ()
    except SpecError as error:
        findings = error.diagnostics
    kept = source
    faults = findings
    for _ in range(_ROUNDS):
        kept = _without(kept, faults)
        try:
            return Spec.parse(kept), findings
        except SpecError as error:
            faults = error.diagnostics
    return Spec.parse(Source(source.name, _INK.sub(" ", source.text))), findings


def _without(source: Source, faults: tuple[Diagnostic, ...]) -> Source:
    """Return the text with every declaration that has a syntax error replaced by blanks.

    The whole text is replaced if an error lies in no declaration.
    """
    starts = declaration_starts(source.text)
    ends = [*starts[1:], len(source.text)]
    text = source.text
    places = [fault.span.start for fault in faults if fault.span is not None]
    for place in places:
        index = bisect_right(starts, place) - 1
        start, end = starts[index], ends[index]
        if not text[start:end].strip() and index:
            start = starts[index - 1]
        text = text[:start] + _INK.sub(" ", text[start:end]) + text[end:]
    return Source(source.name, text if places and text != source.text else _INK.sub(" ", source.text))


# ---------------------------------------------------------------------- meaning


_OUTWARD = ("always", "historically", "release")


@dataclass(frozen=True, slots=True)
class Meaning:
    """Result of resolving names in a specification, as far as that is possible despite errors.

    Attributes:
        scope: table of the names in the file.
        columns: name of a declared signal or parameter -> its scalar columns, with unit and range.
        formulas: name of a requirement, of an assumption or of a definition without arguments -> its formula.
        grid: time step (s) and horizon (steps) of the system; both are None without a system.
        interface: states, parameters and functions of the system, to which the specification can refer, or
            None.
    """

    scope: Scope
    columns: Mapping[str, tuple[Column, ...]]
    formulas: Mapping[str, typed.Formula]
    grid: Grid
    interface: Interface | None = field(default=None, repr=False)

    def value(self, name: str) -> Value | None:
        """Return the value of a signal, constant, region or definition without arguments, else None."""
        entry = self.scope.entries.get(name)
        if isinstance(entry, Known):
            return entry.value
        if not isinstance(entry, Definition) or entry.formals or entry.span is None:
            return None
        try:
            with self.scope.meter.fresh():
                return evaluate(ast.Name(entry.span, name, quoted=True), self.scope)
        except Failed:
            return None

    def steps(self, name: str) -> int | None:
        """Return the lookahead of a formula in samples.

        A lookahead of 5 means that the value at sample k depends on samples up to k + 5. The result is
        None if there is no formula of that name, or if the time step is unknown.
        """
        formula = self.formulas.get(name)
        if formula is None:
            return None
        sink: list[Diagnostic] = []
        lowered = self.grid.lower(formula, sink)
        if any(finding.severity == "error" for finding in sink):
            return None
        return simplify(lowered).reach.future

    def interval(self, span: Span) -> tuple[typed.Interval, Window | None] | None:
        """Return the interval of the temporal operator that is written at `span`, and its window in steps.

        The window is None if the time step is unknown; the result is None if no such operator could be
        resolved.
        """
        for formula in self.formulas.values():
            for node in formula.temporals():
                if node.interval.span == span:
                    sink: list[Diagnostic] = []
                    window = self.grid.window(node.interval, sink, outward=node.op in _OUTWARD)
                    return node.interval, None if any(one.severity == "error" for one in sink) else window
        return None


def understand(
    spec: Spec, modules: tuple[Module, ...], *, interface: Interface | None, grid: Grid
) -> Meaning:
    """Resolve the names of a specification as far as possible.

    Errors are skipped without a message, because the compiler reports them.
    """
    scope = Scope(temporal=True, time_unit=spec.time_unit)
    file = declared(spec, modules, interface, {}, scope)
    columns = {}
    for decl, plain, unit in file.found.columns:
        columns[decl.name] = plain
        with suppress(Failed):
            columns[decl.name] = ranged(plain, unit, decl, file.scope)
    meaning = Meaning(file.scope, columns, {}, grid, interface)
    return replace(meaning, formulas=_formulas(spec, meaning))


def _formulas(spec: Spec, meaning: Meaning) -> dict[str, typed.Formula]:
    """Return the formulas of a specification by name.

    If a requirement and a definition have the same name, the name stands for the formula of the requirement.
    """
    found: dict[str, typed.Formula] = {}
    for item in spec.items:
        if isinstance(item, ast.Def):
            value = meaning.value(item.name)
            if isinstance(value, typed.Formula):
                found[item.name] = value
    for item in spec.rules:
        try:
            found[item.name] = resolve_formula(item.formula, meaning.scope)
        except Failed:
            continue
    return found


# ---------------------------------------------------------------------- modules


@dataclass(frozen=True, slots=True)
class Borrowed:
    """A place in the text that names a declaration of an imported module, as `module.name`.

    Attributes:
        span: location of the part after the dot.
        module: the imported module.
        item: declaration of the name in the module; None if the module has no such name.
    """

    span: Span
    module: Module
    item: ast.Declaration | None


def shared(module: Module) -> tuple[ast.Declaration, ...]:
    """Return the declarations of a module that can be imported: all but its requirements."""
    return module.spec.vocabulary


def borrowed_at(spec: Spec, modules: tuple[Module, ...], offset: int) -> Borrowed | None:
    """Return the imported name under the cursor at `offset`, or None."""
    by_alias = {module.alias: module for module in modules}
    for node in (part for item in spec.items for part in item.walk()):
        if not isinstance(node, ast.Attr) or not isinstance(node.base, ast.Name):
            continue
        if node.base.name not in by_alias:
            continue
        words = list(Lexeme.scan(node.span.source.text, node.base.span.end, node.span.end))
        span = node.span.source.span(words[-1].start, words[-1].end)
        if span.start <= offset <= span.end:
            module = by_alias[node.base.name]
            item = next((item for item in shared(module) if item.name == node.name), None)
            return Borrowed(span, module, item)
    return None


# ---------------------------------------------------------------------- navigation


def definition(document: Document, offset: int) -> tuple[Span, ...]:
    """Return the source locations to which "go to definition" leads from the cursor at `offset`.

    A name leads to its declaration. In the declaration itself, the name of a signal, parameter or constant
    leads to its entry in the system file. `system "file"` leads to that file, and `module.name` leads to the
    declaration in the module. The result is empty if the cursor is at none of these.
    """
    place = document.spec.system_span
    if place is not None and place.start <= offset <= place.end:
        return () if document.system is None else (document.system.source.span(0, 0),)
    borrowed = borrowed_at(document.spec, document.modules, offset)
    if borrowed is not None:
        return () if borrowed.item is None else (borrowed.item.name_span,)
    found = document.names.at(offset)
    if found is None:
        return ()
    if not found.declares:
        return (found.symbol.span,)
    beyond = system_place(document, found.symbol)
    return (found.symbol.span if beyond is None else beyond,)


def system_place(document: Document, symbol: Symbol) -> Span | None:
    """Return the source location of a symbol in the system file; None if it is not declared there."""
    if document.system is None or symbol.kind not in ("signal", "param", "const", "extern"):
        return None
    item = symbol.item
    name = item.column or symbol.name if isinstance(item, ast.Signal) else symbol.name
    return document.system.places.get(name)


def outline(document: Document) -> tuple[tuple[Symbol, Span], ...]:
    """Return the declarations of a file in order, as pairs (symbol, location of the whole declaration)."""
    names = document.names
    found = [
        (one.symbol, one.symbol.item.span)
        for one in names.occurrences
        if one.declares and one.symbol.item is not None and one.symbol.kind not in ("argument", "member")
    ]
    return tuple(found)
