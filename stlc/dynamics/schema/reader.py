"""Checked access to YAML nodes: known keys, kinds of values, findings with source locations."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from stlc.diagnostics import Diagnostic, Findings, Label, SystemFileError, tell
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Scalar, Sequence, as_bool, as_float, as_int
from stlc.escape import unseen
from stlc.registry import closest
from stlc.source import Source, Span

MAX_NAME = 200
"""Maximum length of a free-text name: of a system, an event, a scenario, a word of an enum."""
_OPENING, _CLOSING = "([{", ")]}"


@dataclass
class Reader:
    """Checked access to the values of a system file, and the findings about them.

    Every method returns None (or omits a key) where it has reported a finding.
    """

    source: Source
    findings: list[Diagnostic] = field(default_factory=Findings)

    def report(
        self,
        code: str,
        message: str,
        span: Span,
        *help_: str,
        label: str = "",
        labels: tuple[Label, ...] = (),
    ) -> None:
        """Record a finding."""
        self.add(Diagnostic(code, message, span, label, labels, tuple(line for line in help_ if line)))

    def add(self, *findings: Diagnostic) -> None:
        """Record findings, one per source location: an error in a reused anchor is reported once."""
        for finding in findings:
            tell(self.findings, finding)

    def close(self) -> None:
        """Raise SystemFileError with all errors, in file order, if there are any."""
        errors = [finding for finding in self.findings if finding.severity == "error"]
        if errors:
            raise SystemFileError(*sorted(errors, key=lambda error: error.span.start if error.span else 0))

    # ------------------------------------------------------------------ collections

    def entries(self, node: Node | None, where: str) -> tuple[Entry, ...]:
        """Entries of a mapping with free keys."""
        if node is None or (isinstance(node, Scalar) and node.is_null):
            return ()
        if not isinstance(node, Mapping):
            self.wrong(node, where, "a mapping `{key: value}`")
            return ()
        return self._whole(node.entries)

    def fields(
        self, node: Node | None, where: str, known: Collection[str], required: Iterable[str] = ()
    ) -> dict[str, Node]:
        """Values by key of a mapping with fixed keys."""
        found: dict[str, Node] = {}
        for entry in self.entries(node, where):
            if entry.key.text in known:
                found[entry.key.text] = entry.value
            else:
                self.unknown(entry.key, where, known)
        missing = [key for key in required if key not in found]
        if missing and (node is None or isinstance(node, Mapping)):
            listed = " and ".join(f"`{key}`" for key in missing)
            span = first_line(node.span) if node else self.source.span(0, 1)
            self.report("S102", f"{where} lacks {listed}", span, f"keys of {where}: {', '.join(known)}")
        return found

    def unknown(self, key: Scalar, where: str, known: Collection[str], code: str = "S101") -> None:
        """Report an unknown key."""
        near = closest(key.text, known)
        guess = f"did you mean `{near}`?  " if near else ""
        self.report(
            code,
            f"unknown key `{key.text}` in {where}",
            key.span,
            f"{guess}keys of {where}: {', '.join(known)}",
        )

    def items(self, node: Node | None, where: str) -> tuple[Node, ...]:
        """Items of a sequence."""
        if node is None or (isinstance(node, Scalar) and node.is_null):
            return ()
        if not isinstance(node, Sequence):
            self.wrong(node, where, "a list")
            return ()
        cut = next((item for item in node.items if isinstance(item, Scalar) and _closes_more(item)), None)
        if cut is not None:
            self._chopped(cut.span)
            return ()
        return node.items

    def _whole(self, entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
        """Entries without the fragments of expressions that a comma inside `{…}` has split off."""
        kept: list[Entry] = []
        open_value = False
        for entry in entries:
            empty = isinstance(entry.value, Scalar) and entry.value.is_null
            if empty and (open_value or _closes_more(entry.key)):
                self._chopped(entry.key.span)
                if open_value:
                    kept.pop()
                open_value = open_value and not _closes_more(entry.key)
                continue
            kept.append(entry)
            open_value = isinstance(entry.value, Scalar) and _opens_more(entry.value)
        return tuple(kept)

    def _chopped(self, span: Span) -> None:
        self.report(
            "S103",
            f"`{span.text}` looks like the rest of an expression that was cut at a comma",
            span,
            'inside `{…}` and `[…]` an expression with a comma needs quotes: {x: "uniform(0, 5)"}',
        )

    # ---------------------------------------------------------------------- scalars

    def wrong(self, node: Node, where: str, wanted: str, *help_: str) -> None:
        """Report a value of the wrong kind."""
        self.report("S103", f"{where} must be {wanted}, this is {_kind(node)}", first_line(node.span), *help_)

    def text(self, node: Node | None, where: str) -> str | None:
        """A text."""
        if node is None:
            return None
        if not isinstance(node, Scalar) or node.is_null:
            self.wrong(node, where, "a text")
            return None
        return node.text

    def name(self, node: Node | None, where: str) -> str | None:
        """A text that can be a name: printable and not too long."""
        text = self.text(node, where)
        return text if text is None or self.nameable(node, where) else None

    def nameable(self, node: Node | None, where: str) -> bool:
        """True if a text can be a name: printable and not too long; otherwise reports the reason."""
        assert isinstance(node, Scalar)
        hidden = unseen(node.text)
        if not hidden and len(node.text) <= MAX_NAME:
            return True
        wanted = f"a text of at most {MAX_NAME} characters that can all be seen"
        told = f"of {len(node.text)} characters" if not hidden else f"with the character U+{ord(hidden):04X}"
        self.report("S103", f"{where} must be {wanted}, this is one {told}", first_line(node.span))
        return False

    def integer(self, node: Node | None, where: str, *, low: int = 1, high: int = 10**9) -> int | None:
        """An integer between `low` and `high`."""
        if node is None:
            return None
        value = as_int(node) if isinstance(node, Scalar) else None
        if value is None or not low <= value <= high:
            bounds = (
                f"between {low} and {high}" if value is not None and value > high else f"of at least {low}"
            )
            self.wrong(node, where, f"a whole number {bounds}")
            return None
        return value

    def number(self, node: Node | None, where: str, *, low: float = 0.0) -> float | None:
        """A finite number of at least `low`."""
        if node is None:
            return None
        value = as_float(node) if isinstance(node, Scalar) else None
        if value is None or value < low:
            self.wrong(node, where, f"a number of at least {low:g}")
            return None
        return value

    def flag(self, node: Node | None, where: str) -> bool | None:
        """`true` or `false`."""
        if node is None:
            return None
        value = as_bool(node) if isinstance(node, Scalar) else None
        if value is None:
            self.wrong(node, where, "`true` or `false`")
        return value

    def option(self, node: Node | None, where: str, options: Collection[str]) -> str | None:
        """One of a few words."""
        word = self.text(node, where)
        if node is None or word is None:
            return None
        if word in options:
            return word
        near = closest(word, options)
        guess = f"did you mean `{near}`?" if near else ""
        self.wrong(node, where, " or ".join(f"`{option}`" for option in options), guess)
        return None


def _kind(node: Node) -> str:
    """Description of a value in messages."""
    match node:
        case Sequence():
            return "a list"
        case Mapping():
            return "a mapping"
        case Scalar() if node.is_null:
            return "nothing"
        case Scalar():
            return f"`{node.text if len(node.text) <= 40 else node.text[:39] + '…'}`"


def first_line(span: Span) -> Span:
    """First line of a span, which carets underline."""
    length = span.text.find("\n")
    return span if length < 0 else Span(span.source, span.start, span.start + max(length, 1))


def _opens_more(node: Scalar) -> bool:
    """True if a plain text leaves a bracket open."""
    return node.style == "plain" and _balance(node.text) > 0


def _closes_more(node: Scalar) -> bool:
    """True if a plain text closes a bracket that it did not open."""
    return node.style == "plain" and _balance(node.text) < 0


def _balance(text: str) -> int:
    return sum((char in _OPENING) - (char in _CLOSING) for char in text)
