"""`extends`: a system file that begins as another one; what it says itself wins, entry by entry."""

from __future__ import annotations

from pathlib import Path

from stlc.diagnostics import StlcError
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Scalar, load_yaml
from stlc.files import beside, read_source
from stlc.source import Source

MAX_FILES = 8
KEY = "extends"


def extended(root: Mapping, reader: Reader) -> tuple[Mapping, tuple[Source, ...]]:
    """The document with everything that the files it extends say, and the texts of these.

    A section that is a mapping in both keeps the entries of both, and where both have an entry that of the
    extending file; an entry that is nothing (`~`) takes that of the extended file away, and anything else is
    replaced. Every value keeps the place where it is written. S209 is
    reported where a file cannot be read, or leads back to itself.
    """
    sources: list[Source] = []
    seen = {Path(reader.source.name).resolve()}
    chain = [root]
    while (node := chain[-1].get(KEY)) is not None:
        text = reader.text(node, f"`{KEY}`")
        if text is None:
            break
        path = beside(Path(node.span.source.name).parent, text)
        if path.resolve() in seen or len(chain) > MAX_FILES:
            again = path.resolve() in seen
            why = "leads back to itself" if again else f"goes through more than {MAX_FILES} files"
            reader.report("S209", f"`{KEY}: {text}` {why}", node.span, label="named here")
            break
        seen.add(path.resolve())
        try:
            source = read_source(path)
            chain.append(load_yaml(source, sink=reader.findings))
        except StlcError as error:
            reader.report("S209", f"`{text}` cannot be read", node.span, error.diagnostics[0].message)
            break
        sources.append(source)
    merged = chain[-1]
    for document in reversed(chain[:-1]):
        merged = _merged(merged, document)
    return merged, tuple(sources)


def _merged(base: Mapping, own: Mapping) -> Mapping:
    """Two documents: the sections of both, mappings entry by entry."""
    result = Mapping(own.span, base.entries, base.size)
    for entry in own.entries:
        if _removes(entry, base):
            result = result.without(entry.key.text)
        else:
            result = result.replaced(entry.key, _section(base.get(entry.key.text), entry.value))
    return result


def _removes(entry: Entry, base: Mapping) -> bool:
    """Whether an entry takes one of the extended file away: `brake: ~`."""
    return isinstance(entry.value, Scalar) and entry.value.is_null and base.get(entry.key.text) is not None


def _section(base: Node | None, own: Node) -> Node:
    if not isinstance(base, Mapping) or not isinstance(own, Mapping):
        return own
    result = Mapping(own.span, base.entries, base.size)
    for entry in own.entries:
        removed = _removes(entry, base)
        result = result.without(entry.key.text) if removed else result.replaced(entry.key, entry.value)
    return result
