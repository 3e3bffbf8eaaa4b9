"""The language server: requests of an editor, answered from `Document`."""

from __future__ import annotations

import re
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from lsprotocol import types as lsp
from pygls import uris
from pygls.exceptions import JsonRpcInvalidParams
from pygls.lsp.server import LanguageServer

from stlc.diagnostics import Diagnostic, SpecError
from stlc.editor.completion import Kind as OfferKind
from stlc.editor.completion import Offer, complete
from stlc.editor.document import Document, Finding, Systems, definition, look_at, outline, system_place
from stlc.editor.hover import hover, summary
from stlc.editor.rename import RenameError, can_rename, rename
from stlc.editor.symbols import Kind
from stlc.grammar.format.format import format_text
from stlc.source import Source, Span
from stlc.version import __version__


class Server(LanguageServer):
    """State of the server: all open specifications, each analysed once per change."""

    def __init__(self) -> None:
        super().__init__("stlc", __version__, text_document_sync_kind=lsp.TextDocumentSyncKind.Full)
        self.systems = Systems()
        self._documents: dict[str, Document] = {}

    @property
    def encoding(self) -> Encoding:
        """Position encoding of the client."""
        chosen = str(getattr(self.workspace.position_encoding, "value", self.workspace.position_encoding))
        return "utf-8" if chosen == "utf-8" else "utf-32" if chosen == "utf-32" else "utf-16"

    @property
    def opened(self) -> tuple[str, ...]:
        """URIs of the open texts."""
        return tuple(self._documents)

    def look(self, uri: str) -> Document:
        """Analyse the text at a URI anew."""
        text = self.workspace.get_text_document(uri).source
        source = Source(uris.to_fs_path(uri) or uri if uri.startswith("file:") else uri, text)
        self._documents[uri] = look_at(source, self.systems)
        return self._documents[uri]

    def document(self, uri: str) -> Document:
        """The analysed text at a URI."""
        return self._documents.get(uri) or self.look(uri)

    def forget(self, uri: str) -> None:
        """Remove a closed text."""
        self._documents.pop(uri, None)

    def offset(self, document: Document, position: lsp.Position) -> int:
        """Offset of a position of the client."""
        return Layout(document.source.text, self.encoding).offset(
            EditorPlace(position.line, position.character)
        )

    def publish(self, uri: str) -> None:
        """Analyse a text and publish its diagnostics."""
        findings = self.look(uri).findings
        shown = [diagnostic(finding, self.encoding) for finding in findings]
        self._publish(uri, shown)

    def clear(self, uri: str) -> None:
        """Clear the published diagnostics of a text."""
        self._publish(uri, [])

    def _publish(self, uri: str, shown: list[lsp.Diagnostic]) -> None:
        self.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, shown))


def make_server() -> Server:
    """A server with all its features."""
    server = Server()
    for name, (feature, options) in _FEATURES.items():
        server.feature(name, options)(feature)
    return server


# --------------------------------------------------------------------------- changes


def _opened(server: Server, params: lsp.DidOpenTextDocumentParams) -> None:
    server.publish(params.text_document.uri)


def _changed(server: Server, params: lsp.DidChangeTextDocumentParams) -> None:
    server.publish(params.text_document.uri)


def _closed(server: Server, params: lsp.DidCloseTextDocumentParams) -> None:
    server.forget(params.text_document.uri)
    server.clear(params.text_document.uri)


def _files_changed(server: Server, _: Any) -> None:
    """Analyse all texts again, as a system file may have changed."""
    for uri in server.opened:
        server.publish(uri)


# --------------------------------------------------------------------------- questions


def _hover(server: Server, params: lsp.HoverParams) -> lsp.Hover | None:
    document = server.document(params.text_document.uri)
    found = hover(document, server.offset(document, params.position))
    if found is None:
        return None
    span, text = found
    content = lsp.MarkupContent(lsp.MarkupKind.Markdown, text)
    return lsp.Hover(content, range_of(span, server.encoding))


def _completion(server: Server, params: lsp.CompletionParams) -> lsp.CompletionList:
    document = server.document(params.text_document.uri)
    offset = server.offset(document, params.position)
    found = complete(document, offset)
    place = range_of(document.source.span(found.start, offset), server.encoding)
    items = [completion_item(offer, place) for offer in found.offers]
    return lsp.CompletionList(is_incomplete=False, items=items)


def _definition(server: Server, params: lsp.DefinitionParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    spans = definition(document, server.offset(document, params.position))
    return [location(span, server.encoding) for span in spans]


def _implementation(server: Server, params: lsp.ImplementationParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    found = document.names.at(server.offset(document, params.position))
    place = None if found is None else system_place(document, found.symbol)
    return [] if place is None else [location(place, server.encoding)]


def _references(server: Server, params: lsp.ReferenceParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    found = document.names.at(server.offset(document, params.position))
    if found is None:
        return []
    places = document.names.of(found.symbol)
    wanted = [one for one in places if params.context.include_declaration or not one.declares]
    return [location(one.span, server.encoding) for one in wanted]


def _symbols(server: Server, params: lsp.DocumentSymbolParams) -> list[lsp.DocumentSymbol]:
    document = server.document(params.text_document.uri)
    return [
        lsp.DocumentSymbol(
            name=symbol.name,
            detail=summary(document, symbol),
            kind=SYMBOLS[symbol.kind],
            range=range_of(whole, server.encoding),
            selection_range=range_of(symbol.span, server.encoding),
        )
        for symbol, whole in outline(document)
    ]


# --------------------------------------------------------------------------- changes to the text


def _prepare_rename(server: Server, params: lsp.PrepareRenameParams) -> lsp.Range | None:
    document = server.document(params.text_document.uri)
    found = can_rename(document, server.offset(document, params.position))
    return None if found is None else range_of(found.span, server.encoding)


def _rename(server: Server, params: lsp.RenameParams) -> lsp.WorkspaceEdit:
    document = server.document(params.text_document.uri)
    try:
        edits = rename(document, server.offset(document, params.position), params.new_name)
    except RenameError as error:
        raise JsonRpcInvalidParams(str(error)) from None
    changes = [text_edit(span, text, server.encoding) for span, text in edits]
    return lsp.WorkspaceEdit(changes={params.text_document.uri: changes})


def _formatting(server: Server, params: lsp.DocumentFormattingParams) -> list[lsp.TextEdit]:
    """Edits that format the whole text; none if it has syntax errors."""
    source = server.document(params.text_document.uri).source
    try:
        text = format_text(source)
    except SpecError:
        return []
    if text == source.text:
        return []
    return [text_edit(source.span(0, len(source.text)), text, server.encoding)]


def _actions(server: Server, params: lsp.CodeActionParams) -> list[lsp.CodeAction]:
    """Code actions: the fixes of the findings in a range."""
    uri = params.text_document.uri
    document = server.document(uri)
    first, last = (server.offset(document, place) for place in (params.range.start, params.range.end))
    actions = []
    for finding in document.findings:
        fix = finding.diagnostic.fix
        if fix is None or finding.span.end < first or finding.span.start > last:
            continue
        edits = [text_edit(span, text, server.encoding) for span, text in fix.edits]
        actions.append(
            lsp.CodeAction(
                title=f"write `{fix.text}`" if fix.text else f"mend {finding.diagnostic.code}",
                kind=lsp.CodeActionKind.QuickFix,
                diagnostics=[diagnostic(finding, server.encoding)],
                edit=lsp.WorkspaceEdit(changes={uri: edits}),
            )
        )
    return actions


_FEATURES: dict[str, tuple[Any, Any]] = {
    lsp.TEXT_DOCUMENT_DID_OPEN: (_opened, None),
    lsp.TEXT_DOCUMENT_DID_CHANGE: (_changed, None),
    lsp.TEXT_DOCUMENT_DID_CLOSE: (_closed, None),
    lsp.TEXT_DOCUMENT_DID_SAVE: (_files_changed, None),
    lsp.WORKSPACE_DID_CHANGE_WATCHED_FILES: (_files_changed, None),
    lsp.TEXT_DOCUMENT_HOVER: (_hover, None),
    lsp.TEXT_DOCUMENT_COMPLETION: (_completion, lsp.CompletionOptions(trigger_characters=["@", "[", "`"])),
    lsp.TEXT_DOCUMENT_DEFINITION: (_definition, None),
    lsp.TEXT_DOCUMENT_IMPLEMENTATION: (_implementation, None),
    lsp.TEXT_DOCUMENT_REFERENCES: (_references, None),
    lsp.TEXT_DOCUMENT_DOCUMENT_SYMBOL: (_symbols, None),
    lsp.TEXT_DOCUMENT_PREPARE_RENAME: (_prepare_rename, None),
    lsp.TEXT_DOCUMENT_RENAME: (_rename, lsp.RenameOptions(prepare_provider=True)),
    lsp.TEXT_DOCUMENT_FORMATTING: (_formatting, None),
    lsp.TEXT_DOCUMENT_CODE_ACTION: (
        _actions,
        lsp.CodeActionOptions(code_action_kinds=[lsp.CodeActionKind.QuickFix]),
    ),
}


# ---------------------------------------------------------------------- translate


SYMBOLS: dict[Kind, lsp.SymbolKind] = {
    "signal": lsp.SymbolKind.Variable,
    "param": lsp.SymbolKind.Variable,
    "const": lsp.SymbolKind.Constant,
    "enum": lsp.SymbolKind.Enum,
    "member": lsp.SymbolKind.EnumMember,
    "region": lsp.SymbolKind.Object,
    "def": lsp.SymbolKind.Function,
    "extern": lsp.SymbolKind.Function,
    "require": lsp.SymbolKind.Event,
    "assume": lsp.SymbolKind.Event,
    "argument": lsp.SymbolKind.Variable,
    "variable": lsp.SymbolKind.Variable,
    "module": lsp.SymbolKind.Module,
}
_OFFERS: dict[OfferKind, lsp.CompletionItemKind] = {
    "keyword": lsp.CompletionItemKind.Keyword,
    "function": lsp.CompletionItemKind.Function,
    "unit": lsp.CompletionItemKind.Unit,
    "tag": lsp.CompletionItemKind.Property,
    "type": lsp.CompletionItemKind.Class,
    "signal": lsp.CompletionItemKind.Variable,
    "constant": lsp.CompletionItemKind.Constant,
    "name": lsp.CompletionItemKind.Reference,
    "member": lsp.CompletionItemKind.EnumMember,
}


def position(place: EditorPlace) -> lsp.Position:
    """A place as an LSP position."""
    return lsp.Position(place.line, place.column)


def range_of(span: Span, encoding: Encoding) -> lsp.Range:
    """A span as an LSP range."""
    layout = Layout(span.source.text, encoding)
    return lsp.Range(position(layout.place(span.start)), position(layout.place(span.end)))


def location(span: Span, encoding: Encoding) -> lsp.Location:
    """A span as an LSP location."""
    return lsp.Location(uri_of(span.source.name), range_of(span, encoding))


def uri_of(name: str) -> str:
    """The URI of a file; an unsaved text keeps the URI under which it was opened."""
    if "://" in name or name.startswith("untitled:"):
        return name
    return uris.from_fs_path(str(Path(name).resolve())) or name


def diagnostic(finding: Finding, encoding: Encoding) -> lsp.Diagnostic:
    """A finding as an LSP diagnostic, with its secondary places and advice."""
    inner = finding.diagnostic
    warns = finding.mild or inner.severity == "warning"
    return lsp.Diagnostic(
        range=range_of(finding.span, encoding),
        message="\n".join(_lines(inner)),
        severity=lsp.DiagnosticSeverity.Warning if warns else lsp.DiagnosticSeverity.Error,
        code=inner.code,
        source="stlc",
        related_information=[
            lsp.DiagnosticRelatedInformation(location(label.span, encoding), label.text or "see here")
            for label in inner.labels
        ],
    )


def _lines(finding: Diagnostic) -> list[str]:
    head = f"{finding.message}: {finding.label}" if finding.label else finding.message
    advice = [f"help: {line}" for line in finding.help]
    fix = [] if finding.fix is None or not finding.fix.text else [f"fix: {finding.fix.text}"]
    return [head, *advice, *fix, *(f"note: {line}" for line in finding.note)]


def text_edit(span: Span, text: str, encoding: Encoding) -> lsp.TextEdit:
    """A replacement as an LSP text edit."""
    return lsp.TextEdit(range_of(span, encoding), text)


def completion_item(offer: Offer, place: lsp.Range) -> lsp.CompletionItem:
    """An offer as an LSP completion item that replaces the partial word."""
    return lsp.CompletionItem(
        label=offer.text,
        kind=_OFFERS[offer.kind],
        detail=offer.detail or None,
        documentation=lsp.MarkupContent(lsp.MarkupKind.Markdown, offer.doc) if offer.doc else None,
        sort_text=f"{offer.order}{offer.text}",
        filter_text=offer.text,
        text_edit=lsp.TextEdit(place, offer.text),
    )


# ---------------------------------------------------------------------- positions


Encoding: TypeAlias = Literal["utf-8", "utf-16", "utf-32"]
"""Position encoding: columns count bytes, 16-bit units, or characters."""

_BREAK = re.compile(r"\r\n|\r|\n")


class EditorPlace(NamedTuple):
    """A line and a column, both counted from 0."""

    line: int
    column: int


@dataclass(frozen=True)
class Layout:
    """The lines of a text. Positions beyond the end of a line or of the text are clipped to that end."""

    text: str
    encoding: Encoding = "utf-16"

    @cached_property
    def _lines(self) -> tuple[tuple[int, int], ...]:
        """First offset of every line, and the offset of its break."""
        breaks = [(match.start(), match.end()) for match in _BREAK.finditer(self.text)]
        starts = [0, *(end for _, end in breaks)]
        ends = [*(start for start, _ in breaks), len(self.text)]
        return tuple(zip(starts, ends, strict=True))

    def place(self, offset: int) -> EditorPlace:
        """Line and column of the character at `offset`."""
        offset = min(max(offset, 0), len(self.text))
        row = bisect_right(self._lines, offset, key=lambda line: line[0]) - 1
        start, end = self._lines[row]
        return EditorPlace(row, self._units(self.text[start : min(offset, end)]))

    def offset(self, place: EditorPlace) -> int:
        """The offset of a place; a column inside of a character means the character."""
        if place.line < 0:
            return 0
        if place.line >= len(self._lines):
            return len(self.text)
        start, end = self._lines[place.line]
        left = place.column
        for index in range(start, end):
            left -= self._units(self.text[index])
            if left < 0:
                return index
        return end

    @property
    def end(self) -> EditorPlace:
        """The place after the last character."""
        return self.place(len(self.text))

    def _units(self, text: str) -> int:
        match self.encoding:
            case "utf-8":
                return len(text.encode("utf-8", "surrogatepass"))
            case "utf-16":
                return len(text) + sum(char > "\uffff" for char in text)
            case _:
                return len(text)
