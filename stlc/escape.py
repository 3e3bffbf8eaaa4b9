"""Escaping of untrusted text for C, markup, tables, terminals, shells and paths.

Names, comments, units and file names come from untrusted files. For each kind of output there is one
function, here or in the module that writes it, and every text for this output passes through it. If the
output can represent every character, reading it restores the text exactly. If it cannot (a comment, a
terminal, a picture), the other characters become visible symbols.
"""

from __future__ import annotations

import hashlib
import html as _html
import re
import shlex
from collections.abc import Iterable

_UNSEEN = (
    r"\x00-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u180e\u200b-\u200f\u2028-\u202e"
    r"\u2060-\u2064\u2066-\u206f\ud800-\udfff\ufeff\ufff9-\ufffb\U000110bd\U000110cd\U00013430-\U0001343f"
    r"\U0001bca0-\U0001bca3\U0001d173-\U0001d17a\U000e0001\U000e0020-\U000e007f"
)
"""Control and format characters, surrogates, line separators, which control a terminal or hide text."""

_INVISIBLE = re.compile(f"[{_UNSEEN}]")
_ON_SCREEN = re.compile(f"(?![\n\t])[{_UNSEEN}]")
_STYLE = re.compile(r"\x1b\[[0-9;]*m")
_SURROGATE = re.compile("[\ud800-\udfff]")

# ------------------------------------------------------------------------ terminals


def visible(text: str) -> str:
    """Return a name that is safe in one line of a terminal.

    Control characters, line breaks and characters that change the text direction are replaced by symbols.
    """
    return text if text.isascii() and text.isprintable() else _INVISIBLE.sub(_sign, text)


def unseen(text: str) -> str:
    """The first character of a text that `visible` would replace; "" if there is no such character."""
    found = _INVISIBLE.search(text)
    return "" if found is None else found[0]


def screen(text: str, *, styled: bool = False) -> str:
    """Return a text that is safe for a terminal: only line breaks and tabs remain as control characters.

    Args:
        text: text of one or more lines.
        styled: whether colour codes in `text` are kept. If so, the caller of `screen` must have applied
            `visible` to every untrusted name in the text, because a name could contain such codes.
    """
    if text.isascii() and text.isprintable():
        return text
    if not styled:
        return _ON_SCREEN.sub(_sign, text)
    pieces = _STYLE.split(text)
    styles = [*_STYLE.findall(text), ""]
    shown = [_ON_SCREEN.sub(_sign, piece) for piece in pieces]
    return "".join(part for pair in zip(shown, styles, strict=True) for part in pair)


def _sign(match: re.Match[str]) -> str:
    """The Unicode symbol of a control character; `\N{REPLACEMENT CHARACTER}` if it has none."""
    code = ord(match[0])
    if code < 0x20:
        return chr(0x2400 + code)
    return "\u2421" if code == 0x7F else "\ufffd"


def shell(words: Iterable[str]) -> str:
    """Return a command line that can be copied into a shell: each word is quoted as one argument.

    Control characters are written as escape sequences.
    """
    special = {"\\": r"\\", "'": r"\'"}
    quoted: list[str] = []
    for word in words:
        if _INVISIBLE.search(word):
            quoted.append("$'" + "".join(special.get(char, _ansi(char)) for char in word) + "'")
        else:
            quoted.append(shlex.quote(word))
    return " ".join(quoted)


def operand(path: str) -> str:
    """Return a path for use as a command-line argument; `./` is put before a leading dash."""
    return f"./{path}" if path.startswith("-") else path


def _ansi(char: str) -> str:
    """A character as written within `$'…'` in a shell; an invisible character is written as its bytes."""
    if not _INVISIBLE.match(char):
        return char
    raw = "\udc80" <= char <= "\udcff"  # an invalid UTF-8 byte in a file name, as Python represents it
    return "".join(f"\\x{byte:02x}" for byte in char.encode("utf-8", "surrogateescape" if raw else "replace"))


def encodable(text: str) -> str:
    """The text without what UTF-8 cannot encode, such as the invalid bytes of a file name."""
    return text if text.isascii() else _SURROGATE.sub("\ufffd", text)


# ------------------------------------------------------------------------- C


def c_string(text: str) -> str:
    """A string literal of C99 and C++11 that holds the text in UTF-8, with its quotes.

    A byte that is not printable ASCII is written as a backslash and three octal digits. Question marks are
    written so that they form no trigraphs. The literal is not a format string: print it with `%s`.
    """
    data = encodable(text).encode()
    return '"' + "".join(_C_BYTES.get(byte) or f"\\{byte:03o}" for byte in data) + '"'


_C_BYTES = {code: chr(code) for code in range(0x20, 0x7F)} | {0x22: r"\"", 0x5C: r"\\", 0x3F: r"\?"}


def c_comment(text: str) -> str:
    """Return a text for use within a C comment, `//` or `/* */`.

    The text cannot end the comment, continue it on the next line, or open another one.
    """
    words = visible(text).replace("\\", "\N{SET MINUS}")
    return re.sub(r"\*(?=/)|/(?=[*/])|\?(?=\?)", r"\g<0> ", words)


# ----------------------------------------------------------------------- markup


def lawful(text: str) -> str:
    """Text with the characters that HTML and XML 1.0 forbid replaced by symbols; nothing is escaped."""
    return _REFUSED_IN_MARKUP.sub(_sign, text)


def html(text: str) -> str:
    """Escape a text for HTML, for use between tags or as an attribute value in double quotes."""
    return _html.escape(lawful(text), quote=True)


_REFUSED_IN_MARKUP = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufdd0-\ufdef\ufffe\uffff]"
)
"""Characters that XML 1.0 forbids, that HTML replaces or rejects, or that change the text direction."""


def xml(text: str) -> str:
    """Escape a text for XML 1.0, for use between tags or as an attribute value in double quotes.

    Line breaks and tabs are kept as character references.
    """
    return html(text).replace("\n", "&#10;").replace("\t", "&#9;")


def markdown(text: str) -> str:
    """Escape a text for a line or table cell of Markdown: mark-up, links, HTML and `|` lose their meaning."""
    words = re.sub(r"[\\`*_{}\[\]()#+\-.!|<>~&$:@=]", r"\\\g<0>", visible(text))
    return re.sub(r"^ +| +\Z", lambda match: "\N{NO-BREAK SPACE}" * len(match[0]), words)


# ---------------------------------------------------------------- pictures and logs


def json_text(text: str) -> str:
    """Return a JSON text in which invisible characters are escaped, for a file or a terminal."""
    if text.isascii() and "\x7f" not in text:
        return text
    return _ON_SCREEN.sub(lambda match: _unit(match[0]), text)


def _unit(char: str) -> str:
    data = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{data[i]:02x}{data[i + 1]:02x}" for i in range(0, len(data), 2))


# ------------------------------------------------------------------- tables and paths

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def spreadsheet(text: str) -> str:
    """Return the text of a table cell such that no spreadsheet program interprets it as a formula.

    A quote is put before a text that looks like a formula.
    """
    return f"'{text}" if _FORMULA.match(text) else text


def from_spreadsheet(text: str) -> str:
    """Return the original text of a table cell that `spreadsheet` wrote."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


LONGEST = 80
"""Maximum bytes of a path component made from a name; file systems allow 255."""

_RESERVED = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.I)


def file_part(name: str, *, empty: str) -> str:
    """Return a name as one path component: letters, digits, `_`, `-`, `.`; at most `LONGEST` bytes.

    Args:
        name: any name.
        empty: result for a name without any allowed character.
    """
    part = re.sub(r"[^\w.-]+", "-", visible(name).replace("\ufffd", "-")).strip("-.") or empty
    if len(part.encode()) <= LONGEST and not _RESERVED.fullmatch(part):
        return part
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    kept = part.encode()[: LONGEST - len(digest) - 1].decode("utf-8", "ignore").rstrip("-.")
    return f"{kept}-{digest}"
