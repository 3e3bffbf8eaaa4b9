"""Streams beside other monitors: formulas of the past, equal values, late verdicts, the table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import monitors
from benchmarks.__main__ import main as measure
from benchmarks.monitors import (
    ALWAYS,
    NESTED,
    PEERS,
    Peer,
    drawn,
    lookahead,
    monitor_of,
    of_past,
    read_by,
    response,
)
from benchmarks.requirements import Atom, Formula, Joined, Over, robustness
from benchmarks.table import listed
from benchmarks.tables.schema import document_schema
from benchmarks.tables.streams import AGREEMENT, COLUMNS, TARGETS, Reached, StreamRow, late, wedge_bytes

WINDOW = st.tuples(st.integers(0, 3), st.integers(0, 3)).map(
    lambda ends: (float(min(ends)), float(max(ends)))
)
FUTURE: st.SearchStrategy[Formula] = st.recursive(
    st.builds(
        lambda name, op, value: Atom(name, op, float(value), str(value)),
        st.sampled_from("xy"),
        st.sampled_from(("<", ">")),
        st.integers(0, 9),
    ),
    lambda part: st.one_of(
        st.builds(Joined, st.sampled_from(("and", "or", "->")), part, part),
        st.builds(Over, st.sampled_from(("always", "eventually")), WINDOW, part),
    ),
    max_leaves=5,
)


@given(FUTURE)
def test_a_formula_of_the_past_has_the_values_of_the_future_late(formula: Formula):
    data, ahead = drawn(40), lookahead(formula)
    early, later = (robustness(each, data, 1.0) for each in (formula, of_past(formula)))
    assert later[ahead:].tolist() == early[: 40 - ahead].tolist()


@pytest.mark.parametrize("formula", [NESTED, ALWAYS, response()], ids=["nested", "always", "response"])
@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_other_monitors_say_the_same(peer: Peer, formula: Formula):
    if not peer.installed:
        pytest.skip(f"pip install {peer.package}")
    data = read_by(drawn(1100), [formula])
    feed = peer.feed([formula], data, "row")
    said, wanted = feed.outputs(1100), monitor_of([formula]).robustness(data, end="truncate")
    assert len(said) == 1100 - lookahead(formula)
    assert said.tolist() == wanted[: len(said)].tolist()


def test_no_verdict_is_late():
    assert late(200).stlc == 0


def test_wedges_hold_a_value_and_an_index():
    assert wedge_bytes(NESTED) == 16 * (101 + 11)


def test_targets_are_met_by_all_of_their_figures(monkeypatch):
    def row(figure: float | None) -> StreamRow:
        return StreamRow("row", "row", "x > 5", 10, "µs a sample", figure)

    reached = [Reached(TARGETS["row"], tuple(map(row, each))) for each in ([0.4, 1.0], [0.4, 1.1], [None])]
    assert [each.verdict for each in reached] == ["met", "**missed**", "not measured here"]
    assert reached[1].measured == "0.4, 1.1 µs a sample"
    monkeypatch.setattr(monitors, "find_spec", lambda _: None)
    cells = dict(zip(COLUMNS, listed("rows", [row(0.5)], COLUMNS).texts()[0], strict=True))
    assert cells["Reelay"] == "`pip install reelay`"


@pytest.mark.apart
def test_the_table_is_measured_and_its_page_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    page = tmp_path / "page.md"
    words = ["--samples", "1200", "--rounds", "1", "--out", str(tmp_path), "--page", str(page), "--json"]
    assert measure(["streams", "--only", "blocks,exported,offline,agreement,lines", *words]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    result = document["result"]
    assert {"block", "c", "offline", "start", "lines"} <= {row["target"] for row in result["rows"]}
    ours = [row for row in result["agreement"] if "mstlo" not in row["what"] and "pastify" not in row["what"]]
    assert all(row["equal"] == row["compared"] > 0 for row in ours)
    text = page.read_text()
    assert TARGETS["block"].text in text
    assert all(header in text for header in AGREEMENT)
