"""Configuration of the documentation site: Sphinx with MyST; `make site` builds it (decision 42).

The navigation is the home page itself: each list of links under a heading of `index.md` becomes a part of the
sidebar, so the order of the pages is written once and reads the same on the site and in the repository.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from pygments.lexer import RegexLexer, words
from pygments.token import Comment, Keyword, Name, Number, Operator, Punctuation, String, Whitespace

from stlc.grammar.words import RESERVED
from stlc.version import __version__

project = "stlc"
author = "The stlc maintainers"
version = release = __version__
language = "en"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
suppress_warnings = ["myst.header"]  # the list of diagnostics begins below its own heading

html_theme = "furo"
html_title = f"stlc {__version__}"
html_math_renderer = "mathml"
html_copy_source = False
highlight_language = "none"

default_role = "literal"  # docstrings write `name`, as Markdown does
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
napoleon_attr_annotations = False
python_use_unqualified_type_names = True

HERE = Path(__file__).resolve().parent
LINK = re.compile(r"^- \[([^\]]+)\]\(([\w./-]+\.md)\)", re.MULTILINE)
LOCAL = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])+)\]\((?!https?:|mailto:|#)([^)#\s]+)(?:#[^)\s]*)?\)")
ANCHOR = re.compile(r'^(#+ )<a id="(\w+)"></a>', re.MULTILINE)


def navigation(home: str) -> str:
    """Table-of-contents directives, one for each second-level heading of the home page that lists pages."""
    parts = []
    for section in home.split("\n## ")[1:]:
        caption, _, body = section.partition("\n")
        entries = [f"{title} <{target.removesuffix('.md')}>" for title, target in LINK.findall(body)]
        if entries:
            lines = ["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *entries, "```"]
            parts.append("\n".join(lines))
    return "\n".join(parts)


def decisions() -> str:
    """The table-of-contents directive of all decision pages, for the page that lists them."""
    names = sorted(f"decisions/{path.stem}" for path in (HERE / "decisions").glob("*.md"))
    return "\n".join(["", "```{toctree}", ":hidden:", "", *names, "```"])


def read_page(_app: Any, name: str, source: list[str]) -> None:
    """Prepare the text of a page: its navigation, anchors as MyST targets, links that stay on the site.

    A link to a file or a folder outside `docs/` leads nowhere on the site, which shows its text.
    """
    folder = (HERE / f"{name}.md").parent

    def on_site(match: re.Match[str]) -> str:
        target = (folder / match[2]).resolve()
        return match[0] if target.is_file() and target.is_relative_to(HERE) else match[1]

    text = ANCHOR.sub(r"(\2)=\n\1", LOCAL.sub(on_site, source[0]))
    pages = {"index": navigation, "architecture": lambda _: decisions()}
    source[0] = text + pages.get(name, lambda _: "")(text)


def escape_docstring(*event: Any) -> None:
    """Escape in docstrings what reStructuredText would read as markup and Markdown does not."""
    lines: list[str] = event[-1]
    fenced = False
    for number, line in enumerate(lines):
        if line.strip().startswith("```"):
            fenced, lines[number] = not fenced, ""
            continue
        if fenced or ">>>" in line:
            continue
        pieces = re.split(r"(`[^`]*`)", line)
        pieces[::2] = [re.sub(r"(?<!\*)([*|])(?!\*)", r"\\\1", piece) for piece in pieces[::2]]
        lines[number] = re.sub(r"(`[^`]+`)(?=\w)", r"\1\\ ", "".join(pieces))


def visit_math(self: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers draw without a script or a network."""
    from docutils import nodes

    block = isinstance(node, nodes.math_block)
    self.body.append(("<div class='math'>" if block else "") + tex2mathml(node.astext(), as_block=block))
    self.body.append("</div>" if block else "")
    raise nodes.SkipNode


class StlLexer(RegexLexer):
    """Tokens of a specification, for highlighting: the reserved words are those of the parser."""

    name = "stlc"
    tokens = {  # noqa: RUF012 - Pygments reads it from the class
        "root": [
            (r"(#|//).*", Comment.Single),
            (words(sorted(RESERVED), prefix=r"\b", suffix=r"\b"), Keyword),
            (r"@\w+", Name.Decorator),
            (r'"[^"\n]*"', String),
            (r"`[^`\n]*`", Name),
            (r"\d[\d_]*(\.\d+)?(e[+-]?\d+)?", Number),
            (r"\w+", Name),
            (r"\s+", Whitespace),
            (r"[-+*/%^<>=!&|~]+", Operator),
            (r".", Punctuation),
        ]
    }


def setup(app: Any) -> None:
    """Register the hooks above with Sphinx."""
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", escape_docstring)
    app.add_lexer("stlc", StlLexer)
    app.add_html_math_renderer(
        "mathml", inline_renderers=(visit_math, None), block_renderers=(visit_math, None)
    )
