"""The documentation site: its navigation, its anchors, the names of the API page, and its build."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from pygments.lexers import find_lexer_class_by_name
from pygments.util import ClassNotFound

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)])
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]*)#([^)\s]+)\)")


def anchors(page: Path) -> set[str]:
    """The anchors of a page: the slugs of its headings, and those that are written."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = set(re.findall(r'<a id="([^"]+)"', text))
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        plain = re.sub(r"<[^>]+>|\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        found.add(re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-"))
    return found


def anchored_links() -> Iterator[tuple[Path, Path, str]]:
    for page in PAGES:
        for target, anchor in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
            if "://" not in target:
                yield page, (page.parent / target if target else page), anchor


def test_links_lead_to_headings_that_exist():
    known = {page.resolve(): anchors(page) for page in PAGES}
    missing = [
        f"{page.name} -> {target.name}#{anchor}"
        for page, target, anchor in anchored_links()
        if anchor not in known[target.resolve()]
    ]
    assert missing == []


def test_the_home_page_lists_every_page_once():
    listed = re.findall(r"^- \[[^\]]+\]\(([\w-]+\.md)\): ", (DOCS / "index.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted({path.name for path in DOCS.glob("*.md")} - {"index.md"})


def api_names() -> list[tuple[str, str]]:
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    return re.findall(r"^\.\. auto(module|function|class|exception):: (\S+)$", text, re.MULTILINE)


@pytest.mark.parametrize(("kind", "name"), api_names())
def test_the_api_page_names_what_exists(kind, name):
    if kind == "module":
        assert find_spec(name), name
    else:
        module, _, attribute = name.rpartition(".")
        assert getattr(import_module(module), attribute).__doc__


def test_the_api_page_has_all_names_of_the_package():
    import stlc

    text = (DOCS / "api.md").read_text(encoding="utf-8")
    listed = {name for _, name in api_names()} | {"stlc.__version__"}
    listed |= set(re.findall(r"^\.\. function:: ([\w.]+)\(", text, re.MULTILINE))
    assert {f"stlc.{name}" for name in stlc.__all__} <= listed


def test_the_configuration_imports_what_exists():
    tree = ast.parse((DOCS / "conf.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stlc"):
            module = import_module(str(node.module))
            assert all(hasattr(module, alias.name) for alias in node.names)


def test_code_blocks_name_a_language_that_the_site_highlights():
    """An unknown name is a warning of Sphinx, thus an error of `make site`; GitHub draws `stl` as a solid."""
    named = {
        (page.name, language)
        for page in PAGES
        for language in re.findall(r"^ *```([\w+-]+)", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert [each for each in sorted(named) if not highlighted(each[1])] == []


def highlighted(language: str) -> bool:
    try:
        return language == "stlc" or bool(find_lexer_class_by_name(language))
    except ClassNotFound:
        return False


def cells(row: str) -> int:
    """Number of cells of a row of a table, as Markdown counts them: `|` parts cells even within code."""
    return len(re.split(r"(?<!\\)\|", row.strip().strip("|")))


def test_rows_of_tables_have_as_many_cells_as_their_heads():
    wrong = []
    for page in PAGES:
        width = 0
        for number, line in enumerate(FENCE.sub(blank, page.read_text(encoding="utf-8")).splitlines(), 1):
            width = (width or cells(line)) if line.startswith("|") else 0
            if width and cells(line) != width:
                wrong.append(f"{page.name}:{number}")
    assert wrong == []


def blank(block: re.Match[str]) -> str:
    return "\n" * block[0].count("\n")


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    pytest.importorskip("sphinx")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-E",
        "-b",
        "html",
        str(DOCS),
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    for page in ("index.html", "api.html", "semantics.html", "decisions/0001-callable-package.html"):
        assert (tmp_path / page).is_file()
    assert "<math" in (tmp_path / "semantics.html").read_text(encoding="utf-8")
    assert 'id="e203"' in (tmp_path / "errors.html").read_text(encoding="utf-8")
