"""Each target read by a reader of its own: what was written comes back, or is visibly something else."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import unicodedata
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
from helpers.hostile import CANARY, NAMES
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from stlc import escape, native
from stlc.cli.commands.compile.tree_text import dot
from stlc.cli.commands.lint import sarif_message, uri, workflow_data, workflow_property
from stlc.jsontext import dumps, loads

texts = st.text(st.characters(), max_size=40)
whole = st.text(st.characters(exclude_categories=("Cs",)), max_size=40)
needs_compiler = pytest.mark.skipif(native.compiler() is None, reason="needs a C compiler")


def invisible(text: str, *, but: str = "") -> list[str]:
    return [c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") and c not in but]


# ------------------------------------------------------------------------ terminals


def test_nothing_that_is_invisible_is_missed() -> None:
    everything = "".join(map(chr, range(sys.maxunicode + 1)))
    assert not invisible(escape.visible(everything))
    assert not invisible(escape.screen(everything), but="\n\t")


def test_what_can_be_seen_stays() -> None:
    assert escape.visible("naïve 名前 😀 e\u0301 [red] $x$") == "naïve 名前 😀 e\u0301 [red] $x$"


@given(texts)
def test_a_name_is_one_line(text: str) -> None:
    assert len(escape.visible(text).splitlines()) <= 1
    assert len(escape.visible(text)) == len(text)


def test_colours_pass_where_there_are_any_and_nothing_else_does() -> None:
    text = "\x1b[1;31merror\x1b[0m\x1b[2J\x1b]0;t\x07\x9b31m"
    assert escape.screen(text, styled=True) == "\x1b[1;31merror\x1b[0m␛[2J␛]0;t␇\ufffd31m"
    assert "\x1b" not in escape.screen(text)


def run_in_bash(line: str) -> list[str]:
    done = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], check=True, capture_output=True)
    return done.stdout.decode(errors="surrogateescape").split("\0")[:-1]


def test_a_shell_takes_each_word_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*NAMES, "a\nb", "\udcff"]
    line = escape.shell(words)
    assert not invisible(line)
    assert run_in_bash(line) == words
    assert not list(tmp_path.iterdir())


@given(st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs", "Cc", "Cf", "Zl", "Zp"))))
def test_words_that_can_be_seen_are_quoted_as_everywhere(text: str) -> None:
    assert shlex.split(escape.shell([text])) == [text]


def test_no_path_is_an_option() -> None:
    assert escape.operand("-rf") == "./-rf"
    assert escape.operand("a-b") == "a-b"


# ------------------------------------------------------------------------------- C


def built(text: str, folder: Path, *options: str) -> bytes:
    """Output of a program."""
    (folder / "main.c").write_text(text, encoding="utf-8")
    using = native.compiler()
    assert using is not None
    strict = ("-Wall", "-Wextra", "-Wtrigraphs", "-Werror")
    program = folder / "program"
    command = [using, *options, *strict, "-o", str(program), str(folder / "main.c")]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:2000]
    return subprocess.run([program], check=True, capture_output=True, cwd=folder).stdout


@needs_compiler
@pytest.mark.parametrize("options", [("-std=c99",), ("-std=c99", "-trigraphs"), ("-x", "c++", "-std=c++11")])
def test_c_gives_every_name_back_and_runs_none(options: tuple[str, ...], tmp_path: Path) -> None:
    literals = ", ".join(map(escape.c_string, NAMES))
    comments = "\n".join(f"/* {escape.c_comment(name)} */\n// {escape.c_comment(name)}" for name in NAMES)
    program = f"""{comments}
#include <stdio.h>
static const char *const names[] = {{{literals}}};
int main(void) {{
  printf("%d", (int)(sizeof names / sizeof names[0]));
  for (int i = 0; i < {len(NAMES)}; ++i) printf("\\n%s", names[i]);
  return 0;
}}
"""
    said = built(program, tmp_path, *options).decode().split("\n")
    assert said == [str(len(NAMES)), *NAMES]
    assert not (tmp_path / CANARY).exists()


@given(texts)
def test_a_comment_ends_where_it_was_to_end(text: str) -> None:
    words = escape.c_comment(text)
    assert not re.search(r"\*/|/\*|//|\?\?|\\|\n|\r", words)


# ------------------------------------------------------------------------- markup


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.other: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def handle_comment(self, data: str) -> None:
        self.other.append(data)

    def handle_decl(self, decl: str) -> None:
        self.other.append(decl)

    def handle_pi(self, data: str) -> None:
        self.other.append(data)


def seen_in_markup(name: str) -> str:
    """A name as markup may show it: what it may not hold is a sign."""
    return escape.lawful(name)


def test_html_and_xml_have_one_element_and_its_text() -> None:
    for name in NAMES:
        reader = _Reader()
        reader.feed(f'<b title="{escape.html(name)}">{escape.html(name)}</b>')
        reader.close()
        wanted = seen_in_markup(name)
        assert reader.elements == [("b", {"title": wanted})]
        assert "".join(reader.words) == wanted
        assert not reader.other
        root = ElementTree.fromstring(
            f'<?xml version="1.0"?><b title="{escape.xml(name)}">{escape.xml(name)}</b>'
        )
        assert (root.get("title"), root.text, len(root)) == (wanted, wanted, 0)


@given(texts)
def test_any_text_is_xml(text: str) -> None:
    root = ElementTree.fromstring(f'<b title="{escape.xml(text)}">{escape.xml(text)}</b>')
    assert root.get("title") == root.text or not text


@given(texts)
def test_json_in_a_page_ends_no_script(text: str) -> None:
    script_json = pytest.importorskip("stlc.view.player").script_json
    written = script_json(dumps({"name": text, text: 1}))
    assert not set(written) & set("<>&")
    assert json.loads(written) == {"name": text, text: 1}


def test_markdown_is_one_paragraph_of_text() -> None:
    for name in NAMES:
        reader = MarkdownIt("gfm-like", {"html": True, "linkify": False}).enable("table")
        for around in ("{}", "- {}", "# {}", "| {} | b |\n|---|---|\n| {} | b |", "a\n{}\nb"):
            written = reader.render(around.replace("{}", escape.markdown(name)))
            plain = reader.render(around.replace("{}", "x"))
            assert elements(written) == elements(plain)
            text = " ".join("".join(words(written)).split())
            assert " ".join(escape.visible(name).split()) in text


def test_markdown_code_is_one_name_in_code_letters() -> None:
    markdown_code = pytest.importorskip("stlc.editor.hover").markdown_code
    for name in NAMES:
        written = MarkdownIt().render(f"a {markdown_code(name)} b")
        assert elements(written) == ["p", "code"]
        assert " ".join(escape.visible(name).split()) in " ".join("".join(words(written)).split())


def elements(markup: str) -> list[str]:
    reader = _Reader()
    reader.feed(markup)
    assert not reader.other
    return [name for name, _ in reader.elements]


def words(markup: str) -> list[str]:
    reader = _Reader()
    reader.feed(markup)
    return reader.words


def test_graphviz_reads_one_word() -> None:
    for name in NAMES:
        written = dot(name)
        assert re.fullmatch(r'"(?:[^"\\]|\\["\\])*"', written)
        assert re.sub(r"\\(.)", r"\1", written[1:-1]) == escape.visible(name)


@given(texts)
def test_workflow_commands_are_one_line_and_one_property(text: str) -> None:
    assert len(workflow_data(text).splitlines()) <= 1
    written = workflow_property(text)
    assert not set(written) & set(":,\r\n")


def test_a_message_of_sarif_has_no_link_and_no_argument() -> None:
    assert sarif_message("[here](file:///etc/passwd) {0} [m/s]") == "[here\\](file:///etc/passwd) {{0}} [m/s]"


@given(whole)
def test_an_address_gives_the_path_back(path: str) -> None:
    written = uri(path)
    assert re.fullmatch(r"[\w/\-.~+@=,()%]*", written, re.A)
    assert unquote(written) == path.replace("\\", "/")


# -------------------------------------------------------------- data, tables, paths


@given(texts)
def test_json_comes_back_and_shows_all_it_holds(text: str) -> None:
    written = dumps({text: text})
    assert not invisible(written)
    assert json.loads(written) == {text: text}
    written.encode()


def test_half_a_character_of_json_is_a_sign() -> None:
    assert loads(r'{"a\ud800": "\ud83d\ude00 \\ud800 \udc00"}') == {"a\ufffd": "😀 \\ud800 \ufffd"}


def test_a_spreadsheet_runs_no_name() -> None:
    for name in NAMES:
        written = escape.spreadsheet(name)
        assert written[:1] not in ("=", "+", "-", "@", "\t", "\r")
        assert escape.from_spreadsheet(written) == name


@given(texts)
def test_what_a_spreadsheet_shows_is_read_back(text: str) -> None:
    assert escape.from_spreadsheet(escape.spreadsheet(text)) == text


def test_tags_are_parts_of_their_own() -> None:
    tag = pytest.importorskip("stlc.controller.training.tensorboard").tag
    tags = [tag(name) for name in NAMES]
    assert len(set(tags)) == len(NAMES)
    assert all(re.fullmatch(r"[\w.-]+", tag) for tag in tags)
    assert tag("no_collision") == "no_collision"


def test_a_part_of_a_path_stays_in_its_folder(tmp_path: Path) -> None:
    for name in NAMES:
        part = escape.file_part(name, empty="spec")
        path = tmp_path / part
        path.mkdir()
        assert [entry.name for entry in tmp_path.iterdir()] == [part]
        assert path.resolve().parent == tmp_path.resolve()
        assert not invisible(part)
        assert part[0] not in "-."
        assert len(part.encode()) <= escape.LONGEST
        path.rmdir()


def test_usual_names_stay_folders_of_that_name() -> None:
    for name in ("traffic", "ship_track", "reach-n-avoid", "näher"):
        assert escape.file_part(name, empty="spec") == name


def test_long_names_that_begin_alike_have_folders_of_their_own() -> None:
    first, second = (escape.file_part("x" * 300 + end, empty="spec") for end in "ab")
    assert first != second
