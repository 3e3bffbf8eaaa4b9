"""The tables kept between processes: the same parser, and never a reason to fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.grammar.tables import cache_name, grammar_text, load_parser

SPEC = (Path(__file__).parent / "data" / "navigation.stl").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def fresh():
    """Parser that a new process would get."""
    return load_parser.__wrapped__()


def test_tables_read_back_are_the_same_parser(folder, monkeypatch):
    built = fresh()
    (path,) = (folder / "stlc").iterdir()
    assert path.name == cache_name(grammar_text())
    monkeypatch.setattr("stlc.grammar.tables.build_parser", None)  # reading must not build
    read = fresh()
    assert read is not built
    for text, rule in ((SPEC, "start"), ("always[0, 1] x -> y until z", "expr")):
        assert read.parse(text, start=rule) == built.parse(text, start=rule)


@pytest.mark.parametrize("content", ["", "{", "[]", "[1, 2]", '[{"parser": {}}, {}]', "[{}, {}]", "\x00\xff"])
def test_a_damaged_cache_is_built_anew(folder, content):
    path = folder / "stlc" / cache_name(grammar_text())
    path.parent.mkdir(parents=True)
    path.write_text(content, encoding="latin-1")
    assert fresh().parse("x > 0", start="expr") == load_parser().parse("x > 0", start="expr")
    assert path.stat().st_size > 10_000


def test_no_place_for_a_cache_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert fresh().parse("x > 0", start="expr").data == "compare"


def test_another_grammar_has_another_file():
    assert cache_name("a") != cache_name("b")


def test_there_is_one_parser_in_a_process():
    assert load_parser() is load_parser()
