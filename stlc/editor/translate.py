"""Spans, findings and symbols as the language server protocol says them."""

from __future__ import annotations

from pathlib import Path

from lsprotocol import types as lsp
from pygls import uris

from stlc.diagnostics import Diagnostic
from stlc.editor.completion import Kind as OfferKind
from stlc.editor.completion import Offer
from stlc.editor.document import Finding
from stlc.editor.positions import Encoding, Layout, Place
from stlc.editor.symbols import Kind
from stlc.source import Span

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


def position(place: Place) -> lsp.Position:
    """A place."""
    return lsp.Position(place.line, place.column)


def range_of(span: Span, encoding: Encoding) -> lsp.Range:
    """A span of its own text."""
    layout = Layout(span.source.text, encoding)
    return lsp.Range(position(layout.place(span.start)), position(layout.place(span.end)))


def location(span: Span, encoding: Encoding) -> lsp.Location:
    """A span and the file that it is in."""
    return lsp.Location(uri_of(span.source.name), range_of(span, encoding))


def uri_of(name: str) -> str:
    """The address of a file; a text that has none yet keeps the address that it was opened under."""
    if "://" in name or name.startswith("untitled:"):
        return name
    return uris.from_fs_path(str(Path(name).resolve())) or name


def diagnostic(finding: Finding, encoding: Encoding) -> lsp.Diagnostic:
    """A finding, its secondary places and its advice."""
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
    """A replacement."""
    return lsp.TextEdit(range_of(span, encoding), text)


def completion_item(offer: Offer, place: lsp.Range) -> lsp.CompletionItem:
    """An offer, in place of what is written already."""
    return lsp.CompletionItem(
        label=offer.text,
        kind=_OFFERS[offer.kind],
        detail=offer.detail or None,
        documentation=lsp.MarkupContent(lsp.MarkupKind.Markdown, offer.doc) if offer.doc else None,
        sort_text=f"{offer.order}{offer.text}",
        filter_text=offer.text,
        text_edit=lsp.TextEdit(place, offer.text),
    )
