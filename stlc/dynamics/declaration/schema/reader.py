"""Checked access to YAML nodes: known keys, kinds of values, findings with source locations."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from stlc.diagnostics import Diagnostic, Findings, SystemFileError, tell
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node, Scalar, Sequence
from stlc.escape import unseen
from stlc.similar import did_you_mean
from stlc.source import Label, Source, Span

V = TypeVar("V")
MAX_NAME = 200
"""Maximum length of a free-text name: of a system, an event, a scenario, a word of an enum."""
_OPENING, _CLOSING = "([{", ")]}"


@dataclass
class Reader:
    """Checked access to the values of a system file; collects findings (errors and warnings) about them.

    A method that reads one value returns None if it has reported a finding. A method that reads a mapping or
    a list returns its valid entries.
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
        """Record a finding (error or warning) with the given code and message.

        `span` is its source location and `label` the text beside it; `labels` are further locations. `help_`
        are lines of advice.
        """
        self.add(Diagnostic(code, message, span, label, labels, tuple(line for line in help_ if line)))

    def add(self, *findings: Diagnostic) -> None:
        """Record findings, each once.

        A finding is dropped if a finding with the same code, source location and message is already recorded.
        Thus an error in a value that is used twice through a YAML anchor is reported once.
        """
        for finding in findings:
            tell(self.findings, finding)

    def close(self) -> None:
        """Raise SystemFileError with all errors, in file order, if there are any."""
        errors = [finding for finding in self.findings if finding.severity == "error"]
        if errors:
            raise SystemFileError(*sorted(errors, key=lambda error: error.span.start if error.span else 0))

    # ------------------------------------------------------------------ collections

    def entries(self, node: Node | None, where: str) -> tuple[Entry, ...]:
        """Read the entries of a mapping with arbitrary keys; empty for a missing or null node.

        `where` names the mapping in messages.
        """
        if node is None or (isinstance(node, Scalar) and node.is_null):
            return ()
        if not isinstance(node, Mapping):
            self.wrong(node, where, "a mapping `{key: value}`")
            return ()
        return self._whole(node.entries)

    def fields(
        self, node: Node | None, where: str, known: Collection[str], required: Iterable[str] = ()
    ) -> dict[str, Node]:
        """Read a mapping with the keys `known`; return the values by key.

        Unknown keys (S101) and missing keys among `required` (S102) are reported. `where` names the mapping
        in messages.
        """
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
        """Report the key `key`, which is not in `known`; the most similar known key is given as advice.

        `where` names the mapping in the message.
        """
        listed = f"keys of {where}: {', '.join(known)}"
        found = Diagnostic(code, f"unknown key `{key.text}` in {where}", key.span)
        self.add(found.near(key.text, known, listed=listed))

    def items(self, node: Node | None, where: str) -> tuple[Node, ...]:
        """Read the items of a list; empty for a missing or null node. `where` names the list in messages."""
        if node is None or (isinstance(node, Scalar) and node.is_null):
            return ()
        if not isinstance(node, Sequence):
            self.wrong(node, where, "a list")
            return ()
        cut = next((item for item in node.items if isinstance(item, Scalar) and _balance(item) < 0), None)
        if cut is not None:
            self._chopped(cut.span)
            return ()
        return node.items

    def _whole(self, entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
        """Return the entries without those that are only pieces of an expression; the pieces are reported.

        In `{x: min(a, b)}` YAML ends the value of `x` at the comma, and reads `b)` as a further key.
        """
        kept: list[Entry] = []
        open_value = False
        for entry in entries:
            empty = isinstance(entry.value, Scalar) and entry.value.is_null
            if empty and (open_value or _balance(entry.key) < 0):
                self._chopped(entry.key.span)
                if open_value:
                    kept.pop()
                open_value = open_value and _balance(entry.key) >= 0
                continue
            kept.append(entry)
            open_value = isinstance(entry.value, Scalar) and _balance(entry.value) > 0
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
        """Report S103: the value named `where`, at `node`, is not `wanted`.

        `wanted` describes the accepted values, such as "a list".
        """
        self.report("S103", f"{where} must be {wanted}, this is {_kind(node)}", first_line(node.span), *help_)

    def text(self, node: Node | None, where: str) -> str | None:
        """Read a value as text; it must not be null. `where` names it in messages."""
        found = node.text if isinstance(node, Scalar) and not node.is_null else None
        return self._valid(node, where, "a text", found)

    def name(self, node: Node | None, where: str) -> str | None:
        """Read a text that can be a name: printable and not too long. `where` names it in messages."""
        text = self.text(node, where)
        return text if isinstance(node, Scalar) and text is not None and self.nameable(node, where) else None

    def nameable(self, node: Scalar, where: str) -> bool:
        """True if a text can be a name: printable and not too long. Otherwise the reason is reported.

        `where` names the text in messages.
        """
        hidden = unseen(node.text)
        if not hidden and len(node.text) <= MAX_NAME:
            return True
        wanted = f"a text of at most {MAX_NAME} characters that can all be seen"
        flaw = f"with the character U+{ord(hidden):04X}" if hidden else f"of {len(node.text)} characters"
        self.report("S103", f"{where} must be {wanted}, this is one {flaw}", first_line(node.span))
        return False

    def _valid(self, node: Node | None, where: str, wanted: str, value: V | None) -> V | None:
        """Return `value`. If it is None, report that the value named `where`, at `node`, is not `wanted`."""
        if node is not None and value is None:
            self.wrong(node, where, wanted)
        return value

    def integer(self, node: Node | None, where: str, *, low: int = 1, high: int = 10**9) -> int | None:
        """Read an integer between `low` and `high`. `where` names it in messages."""
        value = node.integer if isinstance(node, Scalar) else None
        above = value is not None and value > high
        bounds = f"between {low} and {high}" if above else f"of at least {low}"
        value = value if value is not None and low <= value <= high else None
        return self._valid(node, where, f"a whole number {bounds}", value)

    def number(self, node: Node | None, where: str, *, low: float = 0.0) -> float | None:
        """Read a finite number of at least `low`. `where` names it in messages."""
        value = node.number if isinstance(node, Scalar) else None
        value = value if value is not None and value >= low else None
        return self._valid(node, where, f"a number of at least {low:g}", value)

    def flag(self, node: Node | None, where: str) -> bool | None:
        """Read `true` or `false`. `where` names the value in messages."""
        value = node.boolean if isinstance(node, Scalar) else None
        return self._valid(node, where, "`true` or `false`", value)

    def option(
        self, node: Node | None, where: str, options: Collection[str], moved: dict[str, str] | None = None
    ) -> str | None:
        """Read a word, which must be one of `options`. `where` names it in messages.

        `moved` maps former options to the files that have them now.
        """
        word = self.text(node, where)
        if node is None or word is None or word in options:
            return word
        guess = did_you_mean(word, options)
        if moved and word in moved:
            guess = (f"it is a file of the repository now: --method {moved[word]}",)
        self.wrong(node, where, " or ".join(f"`{option}`" for option in options), *guess)
        return None


def _kind(node: Node) -> str:
    """Describe a value in messages, such as "a list"."""
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
    """Return the first line of a span, which is what messages underline."""
    length = span.text.find("\n")
    return span if length < 0 else Span(span.source, span.start, span.start + max(length, 1))


def _balance(node: Scalar) -> int:
    """Return how many more brackets an unquoted text opens than it closes; 0 for a quoted text."""
    plain = node.text if node.style == "plain" else ""
    return sum((char in _OPENING) - (char in _CLOSING) for char in plain)
