"""Hostile names through what every command writes: none changes what that is, and each comes back."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import unicodedata
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.hostile import CANARY, NAMES, OF_FILES, REFUSED, sample

from stlc import escape
from stlc.cli.framework.app import main
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import Motion, emit
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import TraceError
from stlc.grammar.printer import show
from stlc.grammar.spec import Spec
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.trace import Trace, TraceMeta, read_recording

RECORDED = [name for name in OF_FILES if name not in ("x[0]", "meta", "t")]
"""Names of signals of a recorded trace: no component, no array that a file has anyway."""
REQUIRED = [name for name in RECORDED if name in NAMES]
"""Those that a requirement of such a trace may have."""
MARK = "\N{WHITE SQUARE}"


def text_of(names: list[str], spec: str = "plain") -> str:
    """A specification with a signal and a requirement for each name; every other one is violated by zeros."""
    lines = [f"spec `{spec}`", *(f"signal `s{name}` [m]" for name in names)]
    for number, name in enumerate(names):
        limit = 1 if number % 2 else -1
        doc = " ".join(name.split())
        lines += [f"## {doc}", f"require `{name}`: always[0, 1 s] `s{name}` <= {limit} m  # {doc}"]
    return "\n".join(lines) + "\n"


def zeros(names: list[str], traces: int = 2, text: str = "") -> Trace:
    data = {f"s{name}": np.zeros((traces, 20)) for name in names}
    return Trace(Signature(tuple(map(Column, data))), 0.1, data, meta=TraceMeta(spec_text=text))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    left = [path for path in tmp_path.rglob("*") if path.name == CANARY]
    assert not left
    assert not Path("/tmp", CANARY).exists()


@pytest.fixture
def judged(folder: Path) -> list[str]:
    (folder / "h.stl").write_text(text_of(REQUIRED), encoding="utf-8", newline="")
    zeros(REQUIRED).save("h.npz")
    return REQUIRED


Said = Callable[..., tuple[int, str]]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """A command's exit code and what it prints; whatever that is, it does not steer a terminal."""

    def run(*words: str) -> tuple[int, str]:
        code = main(list(words))
        out, err = capsys.readouterr()
        for text in (out, err):
            assert not steering(text), words
        return code, out or err

    return run


def steering(text: str) -> set[str]:
    return {c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")} - {"\n", "\t"}


def document(said: Said, *words: str) -> tuple[int, Any]:
    code, text = said(*words)
    return code, json.loads(text)


def seen(name: str) -> str:
    return escape.visible(name)


# --------------------------------------------------------------- a text and its trees


@pytest.mark.apart
def test_a_tree_has_as_many_nodes_and_every_name(judged: list[str], said: Said) -> None:
    _, tree = said("compile", "h.stl", "--show", "ast")
    assert len(re.findall(r"^ *Require ", tree, re.M)) == len(judged)
    assert len(re.findall(r"^ *\w+\b.*$", tree, re.M)) == tree.count("\n")
    _, found = document(said, "compile", "h.stl", "--show", "ast", "--json")
    items = found["result"]["tree"]["items"]
    assert [item["name"] for item in items if item["node"] == "Require"] == judged
    _, dot = said("compile", "h.stl", "--show", "dot")
    nodes = re.findall(r'^  n\d+ \[label="(?:[^"\\]|\\["\\])*"\];$', dot, re.M)
    edges = re.findall(r"^  n\d+ -> n\d+;$", dot, re.M)
    assert dot.count("\n") == len(nodes) + len(edges) + 3
    assert len(edges) == len(nodes) - 1


@pytest.mark.apart
@pytest.mark.usefixtures("judged")
def test_printed_and_formatted_texts_mean_the_same(said: Said) -> None:
    before = Spec.parse(Source("h", Path("h.stl").read_bytes().decode()))
    assert [item.name for item in Spec.parse(Source("h", show(before))).items] == [
        i.name for i in before.items
    ]
    assert said("fmt", "h.stl")[0] == 0
    after = Spec.parse(Source("h", Path("h.stl").read_bytes().decode()))
    assert [(i.name, i.doc) for i in after.items] == [(i.name, i.doc) for i in before.items]
    assert said("fmt", "h.stl", "--check")[0] == 0


def test_english_has_a_paragraph_for_each(judged: list[str], said: Said) -> None:
    _, text = said("explain", "h.stl")
    assert text.count("At all times in the next 1 s") == len(judged)
    _, found = document(said, "explain", "h.stl", "--json")
    assert [each["name"] for each in found["result"]["requirements"]] == judged


@pytest.mark.parametrize("layout", ["text", "json", "github", "sarif"])
def test_findings_are_as_many_as_there_are(layout: str, folder: Path, said: Said) -> None:
    names = [name for name in NAMES if "[" not in name]
    lines = [f"signal x [m]\nrequire `{name}`: `{name}` <= 1 m" for name in names[:20]]
    (folder / "bad.stl").write_text("\n".join(dict.fromkeys("\n".join(lines).split("\n"))), encoding="utf-8")
    _, text = said("lint", "bad.stl", "--format", layout)
    if layout == "json":
        assert len(json.loads(text)["diagnostics"]) == 20
    elif layout == "sarif":
        assert len(json.loads(text)["runs"][0]["results"]) == 20
    elif layout == "github":
        assert len(re.findall(r"^::error title=E\d+,file=bad\.stl,line=\d+", text, re.M)) == 20
        assert len(text.strip().split("\n")) == 20
    else:
        assert len(re.findall(r"^error\[E\d+\]", text, re.M)) == 20


@pytest.mark.usefixtures("judged")
def test_hover_shows_names_and_comments_as_text() -> None:
    from markdown_it import MarkdownIt

    from stlc.editor.document import Systems, analyse
    from stlc.editor.hover import hover

    document_ = analyse(Source("h.stl", Path("h.stl").read_bytes().decode()), Systems())
    reader = MarkdownIt("gfm-like", {"html": True, "linkify": False})
    for item in document_.spec.items:
        found = hover(document_, item.name_span.start + 1)
        assert found is not None
        shown = reader.render(found[1])
        assert set(re.findall(r"<(\w+)", re.sub(r"&lt;", "", shown))) <= {"pre", "code", "p"}, shown


@pytest.mark.parametrize("name", REFUSED, ids=ascii)
def test_a_name_with_control_characters_is_refused(name: str, folder: Path, said: Said) -> None:
    (folder / "h.stl").write_text(text_of([name]), encoding="utf-8", newline="")
    code, text = said("compile", "h.stl", "--show", "ast")
    assert code == 3
    assert "error[E001]: unexpected character U+" in text


# -------------------------------------------------------------------------- verdicts


@pytest.mark.apart
def test_a_verdict_has_a_line_for_each(judged: list[str], said: Said) -> None:
    code, text = said("check", "h.stl", "h.npz")
    assert code == 1
    head, table = text.split("\n\n")[:2]
    assert head == "h.stl on h.npz    2 traces x 20 samples, dt 0.1 s"
    lines = table.split("\n")[1:]
    rows, facts = lines[: len(judged)], lines[len(judged) :]
    for name, row in zip(judged, rows, strict=True):
        assert seen(name).rstrip() in row
    assert len(facts) == len(judged)
    assert all(fact.endswith(" is 0 m throughout in 2 of 2 traces") for fact in facts)
    assert text.count("replay:") == len(judged) // 2 + len(judged) % 2


@pytest.mark.apart
@pytest.mark.usefixtures("judged")
def test_colours_are_those_of_the_program(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (("check", "h.stl", "h.npz"), ("explain", "h.npz", "--spec", "h.stl")):
        main([*words, "--color", "always"])
        out, _ = capsys.readouterr()
        main([*words, "--color", "never"])
        plain, _ = capsys.readouterr()
        assert "\x1b[" in out
        assert re.sub(r"\x1b\[(?:0|1|34|1;3[1346])m", "", out) == plain
        assert not steering(plain)


def test_documents_hold_every_name(judged: list[str], said: Said) -> None:
    code, found = document(said, "check", "h.stl", "h.npz", "--json", "--junit", "j.xml", "--out", "o.npz")
    assert code == 1
    assert [each["name"] for each in found["result"]["requirements"]] == judged
    suite = ElementTree.parse("j.xml").getroot()[0]
    *cases, facts = suite
    assert [case.get("name") for case in cases] == [seen_in_markup(name) for name in judged]
    assert {child.tag for case in cases for child in case} == {"failure", "system-out"}
    assert (facts.tag, str(facts.text).count("\n") + 1) == ("system-out", len(judged))
    assert sorted(read_recording(Path("o.npz")).columns) == sorted(judged)


def seen_in_markup(name: str) -> str:
    return escape.lawful(name)


def test_a_csv_gives_names_back_or_refuses_them() -> None:
    kept, codes = 0, set()
    for name in RECORDED:
        trace = zeros([name], traces=1)
        try:
            trace.save("one.csv")
        except TraceError as error:
            codes.add(error.diagnostics[0].code)
            continue
        kept += 1
        with Path("one.csv").open(encoding="utf-8", newline="") as file:
            assert len(next(csv.reader(file))) == 2
        assert list(read_recording(Path("one.csv")).groups[0].arrays) == ["t", f"s{name}"]
    assert kept > len(RECORDED) // 2
    assert codes == {"E605"}


def test_formulas_of_a_spreadsheet_do_not_run_and_come_back() -> None:
    names = ["=1+1", "+a", "-a", "@SUM", "'=1", "=cmd|' /C calc'!A0", "a,b", 'say "x"']
    data = {name: np.zeros((1, 3)) for name in names}
    Trace(Signature(tuple(map(Column, data))), 0.1, data).save("f.csv")
    first = next(csv.reader(Path("f.csv").read_text(encoding="utf-8").split("\n")[:1]))
    assert not [cell for cell in first if cell[0] in "=+-@"]
    assert list(read_recording(Path("f.csv")).groups[0].arrays) == ["t", *names]


def test_a_stream_has_the_names_of_a_file(folder: Path, said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    names = ["=1+1", "a,b", 'say "x"', "[2J\u200b", "<b>"]
    (folder / "s.stl").write_text(text_of_signals(names), encoding="utf-8")
    row = dict.fromkeys(names, 0.0)
    lines = "".join(json.dumps({"t": 0.1 * k, **row}) + "\n" for k in range(5))
    data = {name: np.zeros((1, 5)) for name in names[:3]}
    Trace(Signature(tuple(map(Column, data))), 0.1, data).save("s.csv")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(lines.encode())))
    assert said("check", "s.stl", "-")[0] == 1
    (folder / "c.stl").write_text(text_of_signals(names[:3]), encoding="utf-8")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(Path("s.csv").read_bytes())))
    assert said("check", "c.stl", "-")[0] == 1


def text_of_signals(names: list[str]) -> str:
    lines = [f"signal `{name}` [m]" for name in names]
    return "\n".join([*lines, *(f"require `r{name}`: `{name}` <= -1 m" for name in names)]) + "\n"


def test_a_trace_that_carries_half_a_character_is_judged(said: Said) -> None:
    trace = zeros(["<b>"], text=text_of(["<b>"]).replace("spec `plain`", "spec `a\ud800`"))
    trace.save("half.npz")
    assert said("check", "half.npz")[0] == 1
    assert document(said, "check", "half.npz", "--json")[0] == 1


# --------------------------------------------------------------------- files and shells


@pytest.mark.parametrize(
    "name", [name for name in sample(20, OF_FILES) if "/" not in name and len(name.encode()) < 200]
)
def test_files_of_any_name_are_named_in_one_line(name: str, folder: Path, said: Said) -> None:
    spec, trace = f"{name}.stl", f"{name}.npz"
    (folder / spec).write_text(text_of(["a"]), encoding="utf-8")
    zeros(["a"]).save(folder / trace)
    code, text = said("check", "--", spec, trace)
    assert code == 1
    assert text.split("\n")[0].startswith(f"{seen(spec)} on {seen(trace)}    2 traces")
    (replay,) = re.findall(r"replay: (stlc check .*)", text)
    words = in_bash(replay)
    assert words[:2] == ["stlc", "check"]
    assert [Path(word).name for word in words[2:4]] == [spec, trace]
    assert main(words[1:]) in (0, 1, 4)
    for command in (("lint", "--format", "github"), ("fmt", "--check"), ("explain",)):
        said(*command, "--", spec)


def in_bash(line: str) -> list[str]:
    done = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], check=True, capture_output=True)
    return done.stdout.decode().split("\0")[:-1]


SHAPES = {
    "bash": ("bash", {"COMP_WORDS": "stlc check h.stl --require ", "COMP_CWORD": "4"}),
    "zsh": ("zsh", {"_TYPER_COMPLETE_ARGS": "stlc check h.stl --require "}),
}


@pytest.mark.parametrize("shell", SHAPES)
def test_completion_offers_only_what_a_shell_takes_as_it_is(
    shell: str, judged: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from stlc.cli.framework.completion import _fitting

    for name in _fitting(judged, ""):
        assert re.fullmatch(r"[\w@%+=:,./][\w@%+=:,./-]*", name, re.A)
    asked, more = SHAPES[shell]
    monkeypatch.setenv("_STLC_COMPLETE", f"complete_{asked}")
    for key, value in more.items():
        monkeypatch.setenv(key, value)
    main([])
    out, _ = capsys.readouterr()
    assert CANARY not in out.replace("../../../../tmp/" + CANARY, "")
    assert "<script>" not in out


# -------------------------------------------------------------------------------- C


def compiled_c(names: list[str]) -> tuple[str, str]:
    """Kernel and adjoint of a specification with these names."""
    lines = [f"signal `{name}` [m]" for name in names]
    lines += [f"def `d{name}`(`f{name}`) = 2 * `f{name}`" for name in names]
    lines += [
        f"require `r{name}`: always[0, 1 s] (`{name}` <= 1 m and "
        f"freeze `h{name}` = `{name}` in eventually[0, 2 s] `d{name}`(`{name}`) > `h{name}`)"
        for name in names
    ]
    spec = Spec.parse(Source("h.stl", "\n".join(lines) + "\n"))
    compiled = compile_spec(spec, grid=Grid(Fraction(1, 10), 30))
    formulas = [rule.formula for rule in compiled.requirements]
    motion = Motion(tuple(names), (), (), {}, 30, 0.1)
    return emit(motion, formulas), emit_adjoint(motion, formulas, fixed=[])


def test_kernels_are_the_same_whatever_things_are_called() -> None:
    names = [name for name in NAMES if "[" not in name][::6]
    assert compiled_c(names) == compiled_c([f"plain_{number}" for number in range(len(names))])


# ----------------------------------------------------- projects, installations, margins


@pytest.mark.parametrize(
    "name",
    [name for name in sample(30, OF_FILES) if len(name.encode()) < 200 and not name.startswith(("/", "."))],
)
def test_a_project_of_any_name_is_one_folder_that_works(name: str, folder: Path, said: Said) -> None:
    code, text = said("init", "--", name)
    assert code in (0, 2), text
    if code == 2:
        assert not list(folder.iterdir())
        return
    specs = sorted(Path(name).rglob("*.stl"))
    assert specs
    code, text = said("lint", "--", *map(str, specs))
    assert code == 0, text


@pytest.mark.parametrize(
    "name", [name for name in sample(30) if "\0" not in name and not escape.unseen(name)]
)
def test_new_specifications_and_systems_have_names_that_mean_themselves(
    name: str, folder: Path, said: Said
) -> None:
    for kind in ("spec", "system"):
        code, text = said("init", f"--{kind}", name)
        assert code in (0, 2), text
    written = [path for path in folder.rglob("*") if path.is_file()]
    specs = [str(path) for path in written if path.suffix == ".stl"]
    if specs:
        code, text = said("lint", "--", *specs)
        assert code in (0, 1), text


@pytest.mark.parametrize(
    "name", ["\x1b[2J\x1b[31m", "a\nb", "$(touch canary_ran)", "`touch canary_ran`; #", "\u202eabc"]
)
def test_an_installation_is_looked_at_whatever_its_folders_are_called(
    name: str, folder: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / name).mkdir()
    for variable in ("HOME", "XDG_CACHE_HOME", "STLC_CACHE", "CC", "TMPDIR"):
        monkeypatch.setenv(variable, str(folder / name))
    code, text = said("doctor", "--quick")
    assert code in (0, 5), text
    assert document(said, "doctor", "--quick", "--json")[0] == code


@pytest.mark.apart
def test_margins_for_a_viewer_give_every_name_back(judged: list[str], said: Said) -> None:
    pytest.importorskip("mcap")
    zeros(REQUIRED, traces=1).save("one.npz")
    assert said("check", "h.stl", "one.npz", "--out", "o.mcap")[0] == 1
    assert sorted(read_recording(Path("o.mcap")).columns) == sorted(judged)
