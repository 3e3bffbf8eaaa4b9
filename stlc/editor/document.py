"""A specification as it stands in an editor: what is wrong with it, and what its names mean."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from stlc.compile.frontend.modules import Module, load_modules
from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import Diagnostic, Label, StlcError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.load import load_system_decl
from stlc.editor.meaning import Meaning, understand
from stlc.editor.reading import read
from stlc.editor.symbols import Names, names_of
from stlc.files import find_system
from stlc.grammar import ast
from stlc.lint.lint import Surroundings, lint
from stlc.source import Source, Span

_ONLY_FOR_TRAINING = frozenset({"E306", "E307", "E309", "E310", "E312"})
_MAX_LABELS = 8


@dataclass(frozen=True, slots=True)
class Finding:
    """What is to be shown at a place of the text.

    Attributes:
        diagnostic: as the command line would show it.
        span: where, always in the text itself.
        mild: it only keeps the specification from being trained on.
    """

    diagnostic: Diagnostic
    span: Span
    mild: bool = False


@dataclass(frozen=True)
class Document:
    """One text, looked at once. Everything that is asked of it comes from here.

    Attributes:
        source: the text, under the path of its file.
        spec: the tree of what can be read of it.
        unread: what cannot be read.
        system: what the system file says that it names, or None.
        missing: why there is no system although the text names one.
    """

    source: Source
    spec: ast.Spec = field(repr=False)
    unread: tuple[Diagnostic, ...]
    system: SystemDecl | None
    missing: tuple[Diagnostic, ...]

    @cached_property
    def names(self) -> Names:
        """Its symbols and where they are written."""
        return names_of(self.spec)

    @property
    def grid(self) -> Grid:
        """The step and the horizon of its system."""
        return Grid() if self.system is None else Grid(self.system.dt, self.system.horizon)

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """What it imports; nothing where a file cannot be read."""
        try:
            return load_modules(self.spec)
        except StlcError:
            return ()

    @cached_property
    def meaning(self) -> Meaning:
        """What its names and intervals come to."""
        interface = None if self.system is None else self.system.interface()
        return understand(self.spec, self.modules, interface=interface, grid=self.grid)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that `stlc lint` says of it, in the order of the text.

        Where only training is in the way of it, errors are mild: a monitor takes such a specification.
        """
        found = [self._about_system(self.missing)] if self.missing else []
        said = self.unread or lint(self.source, within=self._surroundings())
        errors = {one.code for one in said if one.severity == "error"}
        mild = bool(errors) and errors <= _ONLY_FOR_TRAINING
        found += [replace(self._place(one), mild=mild and one.severity == "error") for one in said]
        return tuple(sorted(found, key=lambda one: one.span.start))

    def _surroundings(self) -> Surroundings | None:
        return None if self.system is None else Surroundings(self.system.interface(), self.grid)

    def _place(self, finding: Diagnostic) -> Finding:
        """A finding with its place in this text; one about another file stands where that is named."""
        span = finding.span
        if span is not None and span.source.name == self.source.name:
            return Finding(finding, self.source.span(span.start, span.end))
        return self._about_system((finding,))

    def _about_system(self, findings: tuple[Diagnostic, ...]) -> Finding:
        first = findings[0]
        labels = [Label(one.span, f"{one.code}: {one.message}") for one in findings if one.span is not None]
        place = self.spec.system_span
        span = self.source.span(0, 0) if place is None else self.source.span(place.start, place.end)
        more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        whole = replace(first, message=first.message + more, labels=(*labels[:_MAX_LABELS], *first.labels))
        return Finding(whole, span)


class Systems:
    """System files, read again when they change."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, int], SystemDecl | StlcError]] = {}

    def load(self, name: str, spec_path: Path) -> SystemDecl:
        """The system that a specification names. Raises StlcError, with what is wrong with it."""
        path = find_system(name, spec_path)
        status = path.stat()
        stamp = (status.st_mtime_ns, status.st_size)
        known = self._known.get(path)
        if known is None or known[0] != stamp:
            known = (stamp, _load(path))
            self._known[path] = known
        if isinstance(known[1], StlcError):
            raise known[1]
        return known[1]


def _load(path: Path) -> SystemDecl | StlcError:
    try:
        return load_system_decl(path)
    except StlcError as error:
        return error


def look_at(source: Source, systems: Systems) -> Document:
    """A text as a document."""
    spec, unread = read(source)
    if spec.system is None:
        return Document(source, spec, unread, None, ())
    try:
        return Document(source, spec, unread, systems.load(spec.system, Path(source.name)), ())
    except StlcError as error:
        return Document(source, spec, unread, None, error.diagnostics)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        finding = Diagnostic("U102", f"cannot read `{spec.system}`: {reason}")
        return Document(source, spec, unread, None, (finding,))
