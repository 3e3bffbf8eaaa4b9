"""JSON lines: names of nested values, missing ones, and lines that are refused."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import TraceError
from stlc.trace.formats.jsonl import chunks, read
from stlc.trace.recording import ALL, Wanted

LINES = (
    '{"t": 0, "v": 1.5, "pose": {"x": 1, "q": [1, 2]}, "on": true, "mode": "go", "n": "1e3"}',
    "",
    '{"t": 1, "v": null, "pose": {"x": "NaN"}, "on": false, "n": "5", "unread": {"a": [{}, {"b": "x"}]}}',
    '{"t": 2, "pose": {"x": Infinity, "q": [3]}, "mode": "stop"}',
)


def lines(path: Path, *each: str) -> Path:
    path.write_text("\n".join(each))
    return path


def test_values(tmp_path: Path) -> None:
    found = read(lines(tmp_path / "a.jsonl", *LINES))
    arrays = {name: values.tolist() for name, values in found.groups[0].arrays.items()}
    nan = np.nan
    np.testing.assert_equal(
        arrays,
        {
            "t": [0, 1, 2],
            "v": [1.5, nan, nan],
            "pose.x": [1, nan, np.inf],
            "pose.q[0]": [1, nan, 3],
            "pose.q[1]": [2, nan, nan],
            "on": [1, 0, nan],
            "mode": ["go", "", "stop"],
            "n": [1000, 5, nan],
            "unread.a[1].b": ["", "x", ""],
        },
    )


def test_pieces_and_packed_files(tmp_path: Path) -> None:
    rows = [json.dumps({"t": k, "v": k / 7, "word": "gö"}) for k in range(10)]
    (tmp_path / "a.jsonl.gz").write_bytes(gzip.compress("\r\n".join(rows).encode()))
    parts = [part.groups[0].arrays for part in chunks(tmp_path / "a.jsonl.gz", 4)]
    whole = read(tmp_path / "a.jsonl.gz").groups[0].arrays
    assert [len(part["t"]) for part in parts] == [4, 4, 2]
    assert all(np.array_equal(np.concatenate([p[name] for p in parts]), whole[name]) for name in whole)


def test_a_list_that_is_read_as_a_whole_is_a_vector(tmp_path: Path) -> None:
    long = json.dumps({"t": 0, "scan": {"ranges": [1.0] * 5000}, "q": [1, 2]})
    short = json.dumps({"t": 1, "scan": {"ranges": [None] * 5000}, "q": [1]})
    path = lines(tmp_path / "a.jsonl", long, '{"t": 0.5}', short)
    found = read(path, Wanted(frozenset({"scan.ranges", "q"})))
    assert found.groups[0].arrays["scan.ranges"].shape == (3, 5000)
    assert np.isnan(found.groups[0].arrays["scan.ranges"][1:]).all()
    assert "changing length" in found.refused["q"]
    assert "scan.ranges" in read(path).others


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ('{"t": 0}\n[1, 2]\n{"t": 1}\n', 2, "not a JSON object"),
        ('\n{"t": 0\n{"t": 1}', 2, "not a JSON object"),
        ('{"t": 0, "v": ' + "[" * 100_000 + "\n", 1, "not a JSON object"),
        ('{"t": 0, "v": ' + '{"a": ' * 900 + "1" + "}" * 900 + "}\n[]\n", 2, "not a JSON object"),
        ('{"v": 0}\n{"v": "x"}\n', 2, "`v` is not a number: `x`"),
        ("\n\n", None, "no samples"),
    ],
)
def test_refused(tmp_path: Path, text: str, line: int | None, words: str) -> None:
    with pytest.raises(TraceError) as caught:
        read(lines(tmp_path / "a.jsonl", text))
    (finding,) = caught.value.diagnostics
    assert words in finding.message
    assert (finding.span and finding.span.line) == line


def test_what_is_not_read_refuses_nothing(tmp_path: Path) -> None:
    path = lines(
        tmp_path / "a.jsonl", '{"t": 0, "v": 1, "id": 7, "w": 1}', '{"t": 1, "v": 2, "id": "a", "w": "x"}'
    )
    found = read(path, Wanted(frozenset({"v"})))
    assert found.groups[0].arrays["id"].tolist() == ["7", "a"]
    assert found.others == ("w",)
    with pytest.raises(TraceError):
        read(path, ALL)


def test_a_key_that_occurs_twice(tmp_path: Path) -> None:
    found = read(lines(tmp_path / "a.jsonl", '{"t": 0, "v": 1, "v": 2, "a.b": 1, "a": {"b": 2}}'))
    assert list(found.groups[0].arrays) == ["t"]
    assert set(found.refused) == {"v", "a.b"}


def test_a_last_line_that_was_cut_short_is_left_out_and_said(tmp_path: Path) -> None:
    path = lines(tmp_path / "a.jsonl", '{"t": 0}', '{"t": 1}', '{"t":')
    found = read(path)
    assert found.groups[0].arrays["t"].tolist() == [0, 1]
    assert [remark.code for remark in found.remarks] == ["W305"]
    assert [remark.code for part in chunks(path, 2) for remark in part.remarks] == []
