"""The language server: what an editor asks, answered from `Document`."""

from __future__ import annotations

from typing import Any

from lsprotocol import types as lsp
from pygls import uris
from pygls.exceptions import JsonRpcInvalidParams
from pygls.lsp.server import LanguageServer

from stlc.diagnostics import SpecError
from stlc.editor import translate
from stlc.editor.completion import complete
from stlc.editor.document import Document, Systems, look_at
from stlc.editor.hover import hover, summary
from stlc.editor.navigation import definition, outline, system_place
from stlc.editor.positions import Encoding, Layout, Place
from stlc.editor.rename import RenameError, can_rename, rename
from stlc.grammar.format.format import format_text
from stlc.source import Source
from stlc.version import __version__


class Server(LanguageServer):
    """Answers for every specification that is open, each looked at once per change."""

    def __init__(self) -> None:
        super().__init__("stlc", __version__, text_document_sync_kind=lsp.TextDocumentSyncKind.Full)
        self.systems = Systems()
        self._documents: dict[str, Document] = {}

    @property
    def encoding(self) -> Encoding:
        """How the client counts columns."""
        chosen = str(getattr(self.workspace.position_encoding, "value", self.workspace.position_encoding))
        return "utf-8" if chosen == "utf-8" else "utf-32" if chosen == "utf-32" else "utf-16"

    @property
    def opened(self) -> tuple[str, ...]:
        """The addresses of the texts that are open."""
        return tuple(self._documents)

    def look(self, uri: str) -> Document:
        """The text at an address, looked at again."""
        text = self.workspace.get_text_document(uri).source
        source = Source(uris.to_fs_path(uri) or uri if uri.startswith("file:") else uri, text)
        self._documents[uri] = look_at(source, self.systems)
        return self._documents[uri]

    def document(self, uri: str) -> Document:
        """The text at an address."""
        return self._documents.get(uri) or self.look(uri)

    def forget(self, uri: str) -> None:
        """A text has been closed."""
        self._documents.pop(uri, None)

    def offset(self, document: Document, position: lsp.Position) -> int:
        """Where a position of the client is in a text."""
        return Layout(document.source.text, self.encoding).offset(Place(position.line, position.character))

    def publish(self, uri: str) -> None:
        """Look at a text and tell the client what was found."""
        findings = self.look(uri).findings
        shown = [translate.diagnostic(finding, self.encoding) for finding in findings]
        self._publish(uri, shown)

    def clear(self, uri: str) -> None:
        """Take back what was told of a text."""
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
    """A system file may be another one now."""
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
    return lsp.Hover(content, translate.range_of(span, server.encoding))


def _completion(server: Server, params: lsp.CompletionParams) -> lsp.CompletionList:
    document = server.document(params.text_document.uri)
    offset = server.offset(document, params.position)
    found = complete(document, offset)
    place = translate.range_of(document.source.span(found.start, offset), server.encoding)
    items = [translate.completion_item(offer, place) for offer in found.offers]
    return lsp.CompletionList(is_incomplete=False, items=items)


def _definition(server: Server, params: lsp.DefinitionParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    spans = definition(document, server.offset(document, params.position))
    return [translate.location(span, server.encoding) for span in spans]


def _implementation(server: Server, params: lsp.ImplementationParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    found = document.names.at(server.offset(document, params.position))
    place = None if found is None else system_place(document, found.symbol)
    return [] if place is None else [translate.location(place, server.encoding)]


def _references(server: Server, params: lsp.ReferenceParams) -> list[lsp.Location]:
    document = server.document(params.text_document.uri)
    found = document.names.at(server.offset(document, params.position))
    if found is None:
        return []
    places = document.names.of(found.symbol)
    wanted = [one for one in places if params.context.include_declaration or not one.declares]
    return [translate.location(one.span, server.encoding) for one in wanted]


def _symbols(server: Server, params: lsp.DocumentSymbolParams) -> list[lsp.DocumentSymbol]:
    document = server.document(params.text_document.uri)
    return [
        lsp.DocumentSymbol(
            name=symbol.name,
            detail=summary(document, symbol),
            kind=translate.SYMBOLS[symbol.kind],
            range=translate.range_of(whole, server.encoding),
            selection_range=translate.range_of(symbol.span, server.encoding),
        )
        for symbol, whole in outline(document)
    ]


# --------------------------------------------------------------------------- changes to the text


def _prepare_rename(server: Server, params: lsp.PrepareRenameParams) -> lsp.Range | None:
    document = server.document(params.text_document.uri)
    found = can_rename(document, server.offset(document, params.position))
    return None if found is None else translate.range_of(found.span, server.encoding)


def _rename(server: Server, params: lsp.RenameParams) -> lsp.WorkspaceEdit:
    document = server.document(params.text_document.uri)
    try:
        edits = rename(document, server.offset(document, params.position), params.new_name)
    except RenameError as error:
        raise JsonRpcInvalidParams(str(error)) from None
    changes = [translate.text_edit(span, text, server.encoding) for span, text in edits]
    return lsp.WorkspaceEdit(changes={params.text_document.uri: changes})


def _formatting(server: Server, params: lsp.DocumentFormattingParams) -> list[lsp.TextEdit]:
    """The whole text in its one layout; nothing while it cannot be read."""
    source = server.document(params.text_document.uri).source
    try:
        text = format_text(source)
    except SpecError:
        return []
    if text == source.text:
        return []
    return [translate.text_edit(source.span(0, len(source.text)), text, server.encoding)]


def _actions(server: Server, params: lsp.CodeActionParams) -> list[lsp.CodeAction]:
    """The repairs of the findings in a range."""
    uri = params.text_document.uri
    document = server.document(uri)
    first, last = (server.offset(document, place) for place in (params.range.start, params.range.end))
    actions = []
    for finding in document.findings:
        fix = finding.diagnostic.fix
        if fix is None or finding.span.end < first or finding.span.start > last:
            continue
        edits = [translate.text_edit(span, text, server.encoding) for span, text in fix.edits]
        actions.append(
            lsp.CodeAction(
                title=f"write `{fix.text}`" if fix.text else f"mend {finding.diagnostic.code}",
                kind=lsp.CodeActionKind.QuickFix,
                diagnostics=[translate.diagnostic(finding, server.encoding)],
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
