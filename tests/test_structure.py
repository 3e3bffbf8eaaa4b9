"""`tools/structure.py` on small packages; limits of this package, which may be lowered, not raised."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from helpers.tools import ROOT, load_tool

structure = load_tool("structure")

NODES = 461415
CROSSINGS = 2033
"""Names that modules take from other rooms; their ratio to the nodes rises when the package shrinks."""
CIRCLES: set[tuple[str, str]] = set()
IMPLEMENTATIONS = {
    "numbers of one step": 5,
    "verdict on a requirement": 7,
    "online evaluator": 3,
    "arithmetic of bounds": 2,
    "choice among plans": 1,
    "rank of plans": 2,
    "improvement of a plan": 7,
    "name of a guard": 2,
    "verdict by the tolerance": 2,
    "until": 13,
    "smooth maximum of two": 3,
    "overall robustness": 2,
    "squash of a control": 2,
}


@pytest.fixture(scope="module")
def ours():
    return structure.Package(ROOT)


def package(folder: Path, **texts: str):
    """Package `stlc` with the given modules; `__` in a name separates folders."""
    for name, text in texts.items():
        path = folder / "stlc" / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return structure.Package(folder)


# --------------------------------------------------------------------------------------------- this package


def test_the_package_does_not_grow(ours):
    assert 100_000 < ours.size.nodes <= NODES


def test_borders_are_not_crossed_more_often(ours):
    assert 1_000 < sum(map(len, ours.crossings.values())) <= CROSSINGS
    assert ours.crossings_per_1000 < 4.5


def test_rooms_that_import_each_other_become_fewer(ours):
    found = {(border.taker, border.giver) for border in ours.circles()}
    assert found == CIRCLES, "take out of CIRCLES what is no circle any more"


@pytest.mark.parametrize("meaning", structure.MEANINGS, ids=lambda meaning: meaning.name)
def test_a_meaning_is_not_implemented_once_more(ours, meaning):
    found = list(meaning.probe(ours))
    assert 0 < len(found) <= IMPLEMENTATIONS[meaning.name], found
    assert (ROOT / "stlc" / meaning.place).exists()


# --------------------------------------------------------------------------------------------- the measures


def test_docstrings_annotations_and_layout_do_not_count(tmp_path):
    bare = "def f(x, *y):\n    return x + 1\n\n\nclass A:\n    pass\n"
    told = '"""A module."""\n\n\ndef f(x: int, *y: str) -> int:\n    """Return it."""\n'
    told += '    return (\n        x + 1\n    )\n\n\nclass A:\n    """A class."""\n'
    sizes = package(tmp_path, a__bare=bare, b__told=told).rooms
    assert sizes["a"].nodes == sizes["b"].nodes == 11
    assert (sizes["a"].lines, sizes["b"].lines, sizes["b"].files) == (6, 12, 1)


def test_a_text_that_is_no_docstring_counts(tmp_path):
    sizes = package(tmp_path, a__x="x = 1\n", b__x='x = 1\n"a"\n').rooms
    assert sizes["b"].nodes - sizes["a"].nodes == 2


def test_rooms_are_packages_at_two_levels(tmp_path):
    found = package(tmp_path, top="x = 1\n", a__x="x = 1\n", a__b__x="x = 1\n", a__b__c__x="x = 1\n")
    assert {room: size.files for room, size in found.rooms.items()} == {".": 1, "a": 1, "a/b": 2}
    assert found.size == structure.Size(4 * found.rooms["a"].nodes, 4, 4)


def test_imported_names_and_attributes_of_imported_modules_cross(tmp_path):
    taker = "import numpy\nfrom numpy import array\nfrom stlc.a import other\nfrom stlc.b import x as names\n"
    taker += "from stlc.b.x import one, two\nfrom stlc.b.x import one\n"
    taker += "print(names.three, names.three, other.four)\n"
    found = package(tmp_path, a__taker=taker, a__other="four = 4\n", b__x="one = two = three = 3\n")
    ((border, names),) = found.crossings.items()
    assert (border.taker, border.giver) == ("a", "b")
    assert names == {"stlc.b.x:one", "stlc.b.x:two", "b.x.three"}
    assert found.crossings_per_1000 == pytest.approx(3000.0 / found.size.nodes)


def test_a_circle_is_two_rooms_neither_of_which_contains_the_other(tmp_path):
    found = package(
        tmp_path,
        a__x="from stlc.b.x import p\nfrom stlc.a.c.x import q\np, q = 1, 2\n",
        b__x="from stlc.a.x import p\nfrom stlc.top import q\nfrom stlc.a.c.x import q\n",
        a__c__x="from stlc.a.x import q\n",
        top="from stlc.b.x import p\nq = 1\n",
    )
    assert [(each.taker, each.giver) for each in found.circles()] == [("a", "b")]


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("holds = rho >= -TOLERANCE", 1),
        ("fails = np.min(rho, axis=1)[0] < -TOLERANCE", 1),
        ("good = OPS.ge(rho, -TOLERANCE)", 1),
        ("near = abs(rho) <= TOLERANCE", 0),
        ("good = OPS.ge(rho, -TOLERANCE, 1)", 0),
        ('"""rho >= -TOLERANCE"""', 0),
    ],
)
def test_a_probe_finds_code_of_its_form(tmp_path, text, count):
    (meaning,) = [each for each in structure.MEANINGS if each.name == "verdict by the tolerance"]
    assert len(list(meaning.probe(package(tmp_path, a__x=f"{text}\n")))) == count


def test_a_comparison_shows_rooms_that_changed(tmp_path):
    before = package(tmp_path / "before", a__x="x = 1\n", b__x="x = 1\n", gone__x="x = 1\n")
    after = package(tmp_path / "after", a__x="x = 1\n", b__x="x = 1\ny = 2\n", new__x="x = 1\n")
    _, *rows = structure.comparison(before, after)
    assert [row.split()[0] for row in rows] == ["b", "gone", "new", "total"]
    nodes = len(list(ast.walk(ast.parse("y = 2"))))
    assert rows[0].split()[3] == f"+{nodes - 2}"  # without the module and the context of the name
    assert rows[1].split()[3::3] == [f"-{nodes - 1}", "-1", "-1"]
    assert rows[-1].split()[3::3] == [f"+{nodes - 2}", "+1", "+0"]


def test_the_report_has_every_measure(ours):
    out = "\n".join(structure.report(ours))
    assert f"\ntotal{ours.size.nodes:34,}" in out
    for line in ("names that cross rooms", "pairs of rooms that import", "  until: ", "  planner: 1"):
        assert f"\n{line}" in out


@pytest.mark.parametrize(
    ("options", "lines"),
    [
        ([], ["total                                 6        1      1"]),
        (["--against", "FOLDER"], ["total                                 6        6"]),
        (["--meaning", "until"], ["compile/backends/x.py:1 until"]),
    ],
)
def test_the_command_measures_a_folder(tmp_path, capsys, monkeypatch, options, lines):
    package(tmp_path, compile__backends__x="def until(x): return x\n")
    words = ["structure.py", "--folder", "FOLDER", *options]
    monkeypatch.setattr("sys.argv", [word.replace("FOLDER", str(tmp_path)) for word in words])
    structure.main()
    out = capsys.readouterr().out
    assert all(line in out for line in lines)
