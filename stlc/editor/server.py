"""The language server: answers requests of an editor from the analysis of the open text (`Document`)."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from lsprotocol import types as lsp
from pygls import uris
from pygls.exceptions import JsonRpcInvalidParams
from pygls.lsp.server import LanguageServer
from pygls.workspace import PositionCodec

from stlc.diagnostics import Severity, SpecError
from stlc.editor.completion import Offer, complete
from stlc.editor.document import Document, Finding, Systems, analyse, definition, outline, system_place
from stlc.editor.hover import hover, summary
from stlc.editor.rename import RenameError, can_rename, rename
from stlc.editor.symbols import Kind
from stlc.grammar.format.format import format_text
from stlc.source import Source, Span
from stlc.version import __version__

_SEVERITIES: Mapping[Severity, lsp.DiagnosticSeverity] = {
    "error": lsp.DiagnosticSeverity.Error,
    "warning": lsp.DiagnosticSeverity.Warning,
    "fact": lsp.DiagnosticSeverity.Information,
}
_BREAK = re.compile(r"\r\n|\r|\n")


class PositionMapper:
    """Conversion between offsets in a text and positions (line, column) of the language server protocol.

    A position beyond the end of a line or of the text is converted to that end. Lines end at CR, LF or CRLF,
    as the protocol says. The library pygls cannot be used for this, because its lines also end at Unicode
    separators.
    """

    def __init__(self, text: str, codec: PositionCodec) -> None:
        """Find the lines of `text`; `codec` counts columns in units of the encoding that the editor uses."""
        breaks = list(_BREAK.finditer(text))
        self.text = text
        self._units = codec.client_num_units
        self._starts = [0, *(found.end() for found in breaks)]
        self._ends = [*(found.start() for found in breaks), len(text)]

    def place(self, offset: int) -> lsp.Position:
        """Return the position of the character at `offset`."""
        row = bisect_right(self._starts, offset) - 1
        return lsp.Position(row, self._units(self.text[self._starts[row] : min(offset, self._ends[row])]))

    def offset(self, place: lsp.Position) -> int:
        """Return the offset of the character at a position.

        The position may lie within the character: in UTF-16, for instance, some characters count as two
        columns.
        """
        if place.line >= len(self._starts):
            return len(self.text)
        left = place.character
        for index in range(self._starts[place.line], self._ends[place.line]):
            left -= self._units(self.text[index])
            if left < 0:
                return index
        return self._ends[place.line]


@lru_cache(maxsize=16)
def mapper_of(text: str, codec: PositionCodec) -> PositionMapper:
    """Mapper of a text; one for all places in it, since finding the lines takes time in a long text."""
    return PositionMapper(text, codec)


class Server(LanguageServer):
    """Language server that stores an analysis of every open specification, renewed after each change.

    `trace` is the path of a recording, whose facts are shown in every specification; None for none.
    """

    def __init__(self, trace: Path | None = None) -> None:
        super().__init__("stlc", __version__, text_document_sync_kind=lsp.TextDocumentSyncKind.Full)
        self.systems = Systems()
        self.trace = trace
        self.documents: dict[str, Document] = {}

    def analyse(self, uri: str) -> Document:
        """Analyse the current text of the file at a URI, and store the result."""
        text = self.workspace.get_text_document(uri).source
        source = Source(uris.to_fs_path(uri) or uri if uri.startswith("file:") else uri, text)
        self.documents[uri] = analyse(source, self.systems, self.trace)
        return self.documents[uri]

    def document(self, params: Any) -> Document:
        """Return the analysis of the file that the parameters of a request name."""
        uri = params.text_document.uri
        return self.documents.get(uri) or self.analyse(uri)

    def cursor(self, params: Any) -> tuple[Document, int]:
        """Return the analysis of the file that a request names, and the offset of the cursor in it."""
        document = self.document(params)
        return document, self.offset(document, params.position)

    def publish(self, uri: str) -> None:
        """Analyse the file at a URI and send its diagnostics to the editor."""
        shown = [self.diagnostic(finding) for finding in self.analyse(uri).findings]
        self.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, shown))

    # ---------------------------------------------------------------- values of the protocol

    def offset(self, document: Document, position: lsp.Position) -> int:
        """Return the character offset of a position that the editor sent."""
        return mapper_of(document.source.text, self.workspace.position_codec).offset(position)

    def range(self, span: Span) -> lsp.Range:
        """Convert a source location to a range (start and end) of the language server protocol (LSP)."""
        layout = mapper_of(span.source.text, self.workspace.position_codec)
        return lsp.Range(layout.place(span.start), layout.place(span.end))

    def location(self, span: Span) -> lsp.Location:
        """Convert a source location to an LSP location (URI and range); an unsaved text keeps its URI."""
        name = span.source.name
        if "://" not in name and not name.startswith("untitled:"):
            name = uris.from_fs_path(str(Path(name).resolve())) or name
        return lsp.Location(name, self.range(span))

    def diagnostic(self, finding: Finding) -> lsp.Diagnostic:
        """Convert a finding to an LSP diagnostic, with its advice and its further locations in the text."""
        inner = finding.diagnostic
        severity = lsp.DiagnosticSeverity.Warning if finding.mild else _SEVERITIES[inner.severity]
        head = f"{inner.message}: {inner.label}" if inner.label else inner.message
        advice = [f"help: {line}" for line in inner.help]
        fix = [] if inner.fix is None or not inner.fix.text else [f"fix: {inner.fix.text}"]
        return lsp.Diagnostic(
            range=self.range(finding.span),
            message="\n".join([head, *advice, *fix, *(f"note: {line}" for line in inner.note)]),
            severity=severity,
            code=inner.code,
            source="stlc",
            related_information=[
                lsp.DiagnosticRelatedInformation(self.location(label.span), label.text or "see here")
                for label in inner.labels
            ],
        )


# --------------------------------------------------------------------------- changes


def _changed(server: Server, params: lsp.DidOpenTextDocumentParams | lsp.DidChangeTextDocumentParams) -> None:
    server.publish(params.text_document.uri)


def _closed(server: Server, params: lsp.DidCloseTextDocumentParams) -> None:
    uri = params.text_document.uri
    server.documents.pop(uri, None)
    server.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, []))


def _files_changed(server: Server, _: Any) -> None:
    """Analyse all open texts again after a change of files on disk, such as a system file."""
    for uri in tuple(server.documents):
        server.publish(uri)


# --------------------------------------------------------------------------- questions


def _hover(server: Server, params: lsp.HoverParams) -> lsp.Hover | None:
    found = hover(*server.cursor(params))
    if found is None:
        return None
    span, text = found
    return lsp.Hover(lsp.MarkupContent(lsp.MarkupKind.Markdown, text), server.range(span))


def _completion(server: Server, params: lsp.CompletionParams) -> lsp.CompletionList:
    document, offset = server.cursor(params)
    found = complete(document, offset)
    place = server.range(document.source.span(found.start, offset))
    return lsp.CompletionList(is_incomplete=False, items=[_item(offer, place) for offer in found.offers])


def _item(offer: Offer, place: lsp.Range) -> lsp.CompletionItem:
    return lsp.CompletionItem(
        label=offer.text,
        kind=lsp.CompletionItemKind[offer.kind],
        detail=offer.detail or None,
        documentation=lsp.MarkupContent(lsp.MarkupKind.Markdown, offer.doc) if offer.doc else None,
        sort_text=f"{offer.order}{offer.text}",
        filter_text=offer.text,
        text_edit=lsp.TextEdit(place, offer.text),
    )


def _definition(server: Server, params: lsp.DefinitionParams) -> list[lsp.Location]:
    return [server.location(span) for span in definition(*server.cursor(params))]


def _implementation(server: Server, params: lsp.ImplementationParams) -> list[lsp.Location]:
    document, offset = server.cursor(params)
    found = document.names.at(offset)
    place = None if found is None else system_place(document, found.symbol)
    return [] if place is None else [server.location(place)]


def _references(server: Server, params: lsp.ReferenceParams) -> list[lsp.Location]:
    document, offset = server.cursor(params)
    found = document.names.at(offset)
    places = () if found is None else document.names.of(found.symbol)
    wanted = [one for one in places if params.context.include_declaration or not one.declares]
    return [server.location(one.span) for one in wanted]


_SYMBOL_KINDS: dict[Kind, lsp.SymbolKind] = {
    "const": lsp.SymbolKind.Constant,
    "enum": lsp.SymbolKind.Enum,
    "region": lsp.SymbolKind.Object,
    "def": lsp.SymbolKind.Function,
    "extern": lsp.SymbolKind.Function,
    "require": lsp.SymbolKind.Event,
    "assume": lsp.SymbolKind.Event,
}
"""Kinds of declarations in an outline; a kind that is not listed is shown as a variable."""


def _symbols(server: Server, params: lsp.DocumentSymbolParams) -> list[lsp.DocumentSymbol]:
    document = server.document(params)
    return [
        lsp.DocumentSymbol(
            name=symbol.name,
            detail=summary(document, symbol),
            kind=_SYMBOL_KINDS.get(symbol.kind, lsp.SymbolKind.Variable),
            range=server.range(whole),
            selection_range=server.range(symbol.span),
        )
        for symbol, whole in outline(document)
    ]


# --------------------------------------------------------------------------- changes to the text


def _prepare_rename(server: Server, params: lsp.PrepareRenameParams) -> lsp.Range | None:
    found = can_rename(*server.cursor(params))
    return None if found is None else server.range(found.span)


def _rename(server: Server, params: lsp.RenameParams) -> lsp.WorkspaceEdit:
    try:
        edits = rename(*server.cursor(params), params.new_name)
    except RenameError as error:
        raise JsonRpcInvalidParams(str(error)) from None
    changes = [lsp.TextEdit(server.range(span), text) for span, text in edits]
    return lsp.WorkspaceEdit(changes={params.text_document.uri: changes})


def _formatting(server: Server, params: lsp.DocumentFormattingParams) -> list[lsp.TextEdit]:
    """Return the edits that format the whole text; none if it has syntax errors."""
    source = server.document(params).source
    try:
        text = format_text(source)
    except SpecError:
        return []
    whole = server.range(source.span(0, len(source.text)))
    return [] if text == source.text else [lsp.TextEdit(whole, text)]


def _actions(server: Server, params: lsp.CodeActionParams) -> list[lsp.CodeAction]:
    document = server.document(params)
    first, last = (server.offset(document, place) for place in (params.range.start, params.range.end))
    actions = []
    for finding in document.findings:
        fix = finding.diagnostic.fix
        if fix is None or finding.span.end < first or finding.span.start > last:
            continue
        edits = [lsp.TextEdit(server.range(span), text) for span, text in fix.edits]
        actions.append(
            lsp.CodeAction(
                title=fix.text or f"mend {finding.diagnostic.code}",
                kind=lsp.CodeActionKind.QuickFix,
                diagnostics=[server.diagnostic(finding)],
                edit=lsp.WorkspaceEdit(changes={params.text_document.uri: edits}),
            )
        )
    return actions


_FEATURES: dict[str, tuple[Any, Any]] = {
    lsp.TEXT_DOCUMENT_DID_OPEN: (_changed, None),
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


def make_server(trace: Path | None = None) -> Server:
    """Return a language server with all request handlers; `trace` is a recording whose facts it shows."""
    server = Server(trace)
    for name, (feature, options) in _FEATURES.items():
        server.feature(name, options)(feature)
    return server
