"""YAML nodes with source locations, read strictly and safely.

The reader uses the event stream of PyYAML. No object is ever constructed from a tag, aliases share one node
instead of being copied, and depth and size are bounded while reading. Scalars stay text until the reader of a
field interprets them by the rules of YAML 1.2 (`1e-3` is a number, `on` and `yes` are words, `012` is twelve,
`12:30` is a word).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import yaml

from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.source import Label, Source, Span

MAX_DEPTH = 40
MAX_NODES = 20_000
MERGE_KEY = "<<"
_FAST = getattr(yaml, "CSafeLoader", None)
_LAX = re.compile("[\t?\ufeff]")
"""Text that the C parser reads differently: tabs and `?` within words, byte order marks."""
_PLAIN_WORDS = (("character '\\t'", "a tab"), ("'<stream end>'", "the end of the file"), ("'", "`"))

Style: TypeAlias = Literal["plain", "single", "double", "block"]
_STYLES: dict[str, Style] = {"": "plain", "'": "single", '"': "double", "|": "block", ">": "block"}


@dataclass(frozen=True, slots=True)
class Scalar:
    """A YAML scalar, kept as text.

    Attributes:
        span: source location of the text, quotes included.
        text: the value, without quotes and with escapes resolved.
        style: quoting or block style in the file.
    """

    span: Span
    text: str
    style: Style = "plain"
    size: int = field(default=1, compare=False, repr=False)

    @property
    def inside(self) -> Span:
        """Source location of the value's characters, without quotes or block header."""
        quote = self.style in ("single", "double")
        head = self.span.text.find("\n") + 1 if self.style == "block" else int(quote)
        return Span(self.span.source, self.span.start + head, self.span.end - quote)

    @property
    def escaped(self) -> bool:
        """True if the value differs from the text between the quotes, because escapes were resolved."""
        inside = self.inside.text
        return "\\" in inside if self.style == "double" else self.style == "single" and "''" in inside

    @property
    def is_null(self) -> bool:
        """True if the value is null: empty, `~` or `null`."""
        return self.style == "plain" and self.text in {"", "~", "null", "Null", "NULL"}

    @property
    def boolean(self) -> bool | None:
        """The truth value of `true` or `false`; None for any other text."""
        if self.style != "plain":
            return None
        return True if self.text in _TRUE else False if self.text in _FALSE else None

    @property
    def integer(self) -> int | None:
        """The value of a decimal integer of 300 digits at most; None for any other text."""
        return int(self.text) if self.style == "plain" and _INT.match(self.text) else None

    @property
    def number(self) -> float | None:
        """The value of a finite decimal number; None for any other text, such as `.nan` or `.inf`."""
        value = float(self.text) if self.style == "plain" and _FLOAT.match(self.text) else math.inf
        return value if math.isfinite(value) else None


@dataclass(frozen=True, slots=True)
class Sequence:
    """A list, in block or flow style."""

    span: Span
    items: tuple[Node, ...]
    size: int = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Entry:
    """One `key: value` of a mapping."""

    key: Scalar
    value: Node

    def place(self, key: str) -> Span:
        """Return the source location of the value of `key`, where the value of this entry is a mapping.

        If the mapping lacks this key, the source location of the mapping is returned.
        """
        node = self.value.get(key) if isinstance(self.value, Mapping) else None
        return self.value.span if node is None else node.span


@dataclass(frozen=True, slots=True)
class Mapping:
    """A YAML mapping: its entries in order, with merge keys (`<<`) resolved."""

    span: Span
    entries: tuple[Entry, ...]
    size: int = field(compare=False, repr=False)

    def get(self, key: str) -> Node | None:
        """The value of `key`, or None."""
        return next((entry.value for entry in self.entries if entry.key.text == key), None)

    def without(self, key: str) -> Mapping:
        """Return the mapping without the entry of `key`."""
        return Mapping(self.span, tuple(old for old in self.entries if old.key.text != key), self.size)

    def replaced(self, key: Scalar, value: Node) -> Mapping:
        """Return the mapping with `key` set to `value`; a new key is appended."""
        entry = Entry(key, value)
        if self.get(key.text) is None:
            entries = (*self.entries, entry)
        else:
            entries = tuple(entry if old.key.text == key.text else old for old in self.entries)
        return Mapping(self.span, entries, self.size + value.size)


Node: TypeAlias = Scalar | Sequence | Mapping

# ------------------------------------------------------------- meaning of plain scalars

_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_HALF = re.compile("[\ud800-\udfff]")
_INT = re.compile(r"[-+]?[0-9]{1,300}\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")


# ---------------------------------------------------------------------------- reading


def load_yaml(source: Source, *, sink: list[Diagnostic]) -> Mapping:
    """Read a text that must be a single YAML document and a mapping.

    For a duplicate key, S102 is appended to `sink`, and the first entry is used. Raises SystemFileError
    (S100) if the text is no YAML mapping, or not safe to read.
    """
    node = load_node(source, sink=sink)
    if isinstance(node, Mapping):
        return node
    if node is None or (isinstance(node, Scalar) and node.is_null):
        problem, span = "empty", source.span(0, min(1, len(source.text)))
        advice = "a system file starts with `stlc: 1` and `name: …`"
    else:
        start = node.span.start
        stop = min(node.span.end, source.text.find("\n", start) % (len(source.text) + 1))
        problem, span = "not a mapping of keys to values", source.span(start, max(stop, start + 1))
        advice = "a system file consists of lines `key: value`"
    raise SystemFileError.of("S100", f"`{source.name}` is {problem}", span, help=(advice,))


def load_node(source: Source, *, sink: list[Diagnostic]) -> Node | None:
    """Read a text that must be a single YAML document of any kind; None if the text is empty.

    Findings about duplicate keys are appended to `sink`. PyYAML's C parser, if available, is ten times
    faster. Errors are reported by the Python parser, whose messages and locations are better.
    """
    found: list[Diagnostic] = []
    if _FAST is not None and not _LAX.search(source.text):
        with suppress(yaml.YAMLError, SystemFileError, UnicodeEncodeError):
            node = _Builder(source, found, _FAST).document()
            sink += found
            return node
    builder = _Builder(source, sink, yaml.SafeLoader)
    try:
        return builder.document()
    except yaml.MarkedYAMLError as error:
        raise SystemFileError(_syntax(source, error)) from None
    except yaml.reader.ReaderError as error:
        offset = min(int(error.position), len(source.text))
        char = source.text[offset : offset + 1]
        raise SystemFileError.of(
            "S100",
            f"a character that YAML does not allow: U+{ord(char or chr(0)):04X}",
            source.span(offset, offset + 1),
        ) from None


def _syntax(source: Source, error: yaml.MarkedYAMLError) -> Diagnostic:
    """Return an error of PyYAML as a diagnostic."""
    mark = error.problem_mark or error.context_mark
    offset = min(mark.index if mark else 0, max(len(source.text) - 1, 0))
    labels: tuple[Label, ...] = ()
    if error.context and error.context_mark and error.context_mark.index < offset:
        start = error.context_mark.index
        labels = (source.span(start, start + 1).label(error.context),)
    problem = error.problem or error.context or "cannot be read"
    for ugly, plain in _PLAIN_WORDS:
        problem = problem.replace(ugly, plain)
    helps = ("indent with blanks",) if "\t" in source.text[offset : offset + 1] else ()
    row, column = source.position(offset)
    above = next((line for line in range(row - 1, 0, -1) if source.line(line).split("#")[0].strip()), 0)
    indent = len(source.line(above)) - len(source.line(above).lstrip()) if above else column - 1
    if "block end" in (error.problem or "") and indent != column - 1:
        start = source.line_starts[above - 1] + indent
        said = f"indented by {indent}, the line below by {column - 1}"
        labels = (source.span(start, start + 1).label(said),)
        problem = "two neighbouring lines are indented differently"
        helps = ("keys of one mapping start in one column; keys below a key, farther right",)
    return Diagnostic(
        "S100", f"not YAML: {problem}", source.span(offset, offset + 1), labels=labels, help=helps
    )


class _Builder:
    """Builder of the nodes of a YAML document from parser events; limits depth and size."""

    def __init__(self, source: Source, sink: list[Diagnostic], loader: Any) -> None:
        self.source = source
        self.sink = sink
        self.events: Iterator[Any] = iter(yaml.parse(source.text, Loader=loader))
        self.anchors: dict[str, Node | None] = {}
        self.read = 0

    def document(self) -> Node | None:
        """Build the node of the document; None if there is none. A second document is an error."""
        root: Node | None = None
        documents = 0
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self.refuse(event, "a second YAML document in one file")
                root = self.node(next(self.events), 0)
        return root

    def refuse(self, event: Any, message: str, *help_: str) -> SystemFileError:
        """Return an S100 error with the given message and advice, located at `event`."""
        return SystemFileError.of("S100", message, self.span(event), help=help_)

    def span(self, start: Any, end: Any = None) -> Span:
        """Return the source location from event `start` to event `end`, without trailing blanks.

        If `end` is None, it is the location of `start`.
        """
        first, last = start.start_mark.index, (end or start).end_mark.index
        last = first + len(self.source.text[first:last].rstrip())
        return self.source.span(first, max(last, min(first + 1, len(self.source.text))))

    def node(self, event: Any, depth: int) -> Node:
        """Build the node that starts with `event`."""
        self.read += 1
        if depth > MAX_DEPTH:
            raise self.refuse(event, f"nested more than {MAX_DEPTH} levels deep")
        if self.read > MAX_NODES:
            raise self.refuse(event, f"more than {MAX_NODES} values in one file")
        if isinstance(event, yaml.AliasEvent):
            return self.alias(event)
        if event.tag is not None:
            raise self.refuse(event, f"a tag, `{event.tag}`: tags are not read", "write plain values")
        if event.anchor is not None:
            self.anchors[event.anchor] = None
        node = self.collection(event, depth)
        if node.size > MAX_NODES:
            raise self.refuse(event, f"aliases that expand to more than {MAX_NODES} values")
        if event.anchor is not None:
            self.anchors[event.anchor] = node
        return node

    def collection(self, event: Any, depth: int) -> Node:
        """Build the scalar, sequence or mapping that starts with `event`."""
        if isinstance(event, yaml.MappingStartEvent):
            return self.mapping(event, depth)
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Node] = []
            while not isinstance(end := next(self.events), yaml.SequenceEndEvent):
                items.append(self.node(end, depth + 1))
            return Sequence(self.span(event, end), tuple(items), 1 + sum(item.size for item in items))
        index = event.start_mark.index
        missing = not event.value and not event.style
        span = self.source.span(index, index) if missing else self.span(event)
        return Scalar(span, self.joined(event), _STYLES[event.style or ""])

    def joined(self, event: Any) -> str:
        """Return the value of a scalar; surrogate pairs written as escapes are joined to one character."""
        value: str = event.value
        if not _HALF.search(value):
            return value
        try:
            return value.encode("utf-16", "surrogatepass").decode("utf-16")
        except UnicodeDecodeError:
            message = "half of a character (U+D800 to U+DFFF), which no file can hold"
            raise self.refuse(event, message) from None

    def alias(self, event: Any) -> Node:
        """Return the node that an alias (`*name`) refers to."""
        node = self.anchors.get(event.anchor)
        if node is None:
            inside = event.anchor in self.anchors
            problem = "stands inside the value that it names" if inside else "names no anchor"
            raise self.refuse(event, f"the alias `*{event.anchor}` {problem}")
        return node

    def mapping(self, start: Any, depth: int) -> Mapping:
        """Build a mapping, up to the event that ends it.

        An entry written in the mapping replaces an entry of the same key that a merge key (`<<`) adds.
        """
        written: dict[str, Entry] = {}
        merged: dict[str, Entry] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            key = self.node(event, depth + 1)
            if not isinstance(key, Scalar):
                raise self.refuse(event, "a key that is not a word")
            value = self.node(next(self.events), depth + 1)
            if key.text == MERGE_KEY and key.style == "plain":
                for entry in self.merge(key, value):
                    merged.setdefault(entry.key.text, entry)
            elif key.text in written:
                self.duplicate(key, written[key.text].key)
            else:
                written[key.text] = Entry(key, value)
        kept = tuple(written.get(name, entry) for name, entry in merged.items())
        entries = (*kept, *(entry for name, entry in written.items() if name not in merged))
        size = 1 + sum(1 + entry.value.size for entry in entries)
        return Mapping(self.span(start, event), entries, size)

    def merge(self, key: Scalar, value: Node) -> tuple[Entry, ...]:
        """Return the entries that a merge key (`<<`) adds."""
        if isinstance(value, Mapping):
            return value.entries
        if isinstance(value, Sequence) and all(isinstance(item, Mapping) for item in value.items):
            return tuple(entry for item in value.items if isinstance(item, Mapping) for entry in item.entries)
        raise SystemFileError.of("S100", "`<<` merges mappings; this is none", key.span.to(value.span))

    def duplicate(self, key: Scalar, first: Scalar) -> None:
        """Report S102 for a key that occurs twice in one mapping, with both source locations."""
        self.sink.append(
            Diagnostic(
                "S102",
                f"the key `{key.text}` is given twice",
                key.span,
                label="given again",
                labels=(first.span.label("given first"),),
                help=("remove one of the two",),
            )
        )
