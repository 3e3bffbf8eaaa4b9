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

    listed = {name for _, name in api_names()} | {"stlc.compile", "stlc.__version__"}
    assert {f"stlc.{name}" for name in stlc.__all__} <= listed


def test_the_configuration_imports_what_exists():
    tree = ast.parse((DOCS / "conf.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stlc"):
            module = import_module(str(node.module))
            assert all(hasattr(module, alias.name) for alias in node.names)


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
