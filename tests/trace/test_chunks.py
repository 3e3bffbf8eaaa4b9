"""Traces that are read in pieces: the same as they are as a whole, or a diagnostic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import StlcError, TraceError
from stlc.trace import Reading, Trace
from stlc.trace.chunks import pieces

TIMES = {
    "seconds": [repr(k / 10) for k in range(23)],
    "dates": [str(np.datetime64("2026-01-31T23:59:59", "ns") + np.timedelta64(k, "s")) for k in range(23)],
}


@pytest.mark.parametrize("kind", TIMES)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_pieces_are_the_whole(tmp_path: Path, kind: str, end: str) -> None:
    rows = [f"{t},{k % 5},gö" for k, t in enumerate(TIMES[kind])]
    (tmp_path / "a.csv").write_bytes(end.join(["\ufefft,x,wörd", *rows]).encode())
    whole = Trace.load(tmp_path / "a.csv")
    parts = list(pieces(tmp_path / "a.csv", 7, Reading()))
    assert [part.samples for part in parts] == [7, 7, 7, 2]
    assert list(parts[1].extras) == ["wörd"]
    assert np.array_equal(np.concatenate([part.data["x"][0] for part in parts]), whole.data["x"][0])
    np.testing.assert_allclose(np.concatenate([part.times for part in parts]), whole.times, atol=1e-9)


@pytest.mark.parametrize("row", ["x,1,go", "5,1,go", "2026-01-31T23:59:59,1,go", "2026-02-01,1,go"])
@pytest.mark.parametrize("kind", TIMES)
def test_a_clock_that_changes_between_pieces(tmp_path: Path, kind: str, row: str) -> None:
    rows = [f"{t},{k % 5},go" for k, t in enumerate(TIMES[kind][:14])]
    (tmp_path / "a.csv").write_text("\n".join(["t,x,word", *rows, row]))
    with pytest.raises(TraceError) as caught:
        list(pieces(tmp_path / "a.csv", 7, Reading()))
    assert caught.value.diagnostics[0].code in ("E602", "E603")


def test_a_step_that_rounded_times_of_the_first_piece_do_not_tell(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,x\n" + "".join(f"{k / 30:.3f},{k}\n" for k in range(9_000)))
    whole = Trace.load(path)
    with pytest.raises(TraceError) as caught:
        list(pieces(path, 5, Reading()))
    (found,) = caught.value.diagnostics
    assert found.code == "E602"
    assert found.help[0].startswith("a larger --chunk ")
    parts = list(pieces(path, 3_000, Reading()))
    assert np.array_equal(np.concatenate([part.data["x"][0] for part in parts]), whole.data["x"][0])


@pytest.mark.parametrize("text", ["", "\n", "\n\n \n"])
def test_pieces_of_blank_lines(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(TraceError, match="it holds no samples"):
        list(pieces(tmp_path / "a.csv", 7, Reading()))


def test_pieces_of_what_cannot_be_cut(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(b"")
    with pytest.raises(StlcError, match="cannot be read in pieces"):
        list(pieces(tmp_path / "a.mat", 7, Reading()))


@pytest.mark.parametrize("group", ["trace", "agent"])
@pytest.mark.parametrize("keys", ["0011", "0001", "aabb", "0 1 "])
def test_pieces_of_several_traces_are_not_taken_for_one(tmp_path: Path, group: str, keys: str) -> None:
    rows = [f"{key.strip()},{k}" for k, key in enumerate(keys)]
    (tmp_path / "a.csv").write_text("\n".join([f"{group},x", *rows]))
    for samples in (1, 2, 3, 9):
        with pytest.raises(TraceError, match="holds the traces") as caught:
            list(pieces(tmp_path / "a.csv", samples, Reading(dt=1.0)))
        assert caught.value.diagnostics[0].code == "E605"


def test_pieces_of_traces_whose_names_are_cut(tmp_path: Path) -> None:
    rows = [f"{'a' * 64}{k // 2},{k}" for k in range(4)]
    (tmp_path / "a.csv").write_text("\n".join(["trace,x", *rows]))
    with pytest.raises(TraceError, match="names of 64 letters"):
        list(pieces(tmp_path / "a.csv", 2, Reading(dt=1.0)))


def test_pieces_of_one_trace_that_has_a_name(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("trace,x\n7,0\n7,1\n7.0,2\n")
    parts = list(pieces(tmp_path / "a.csv", 2, Reading(dt=1.0)))
    assert [part.data["x"].tolist() for part in parts] == [[[0.0, 1.0]], [[2.0]]]


def test_pieces_of_several_traces_in_parquet(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = arrow.table({"agent": [0, 0, 1, 1], "x": [1.0, 9.0, 1.0, 1.0]})
    parquet.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(TraceError, match="the traces 0 and 1"):
        list(pieces(tmp_path / "a.parquet", 2, Reading(dt=1.0)))


@pytest.mark.parametrize("shape", [(5,), (1, 5), (5, 1), (5, 2), (5, 3), (1, 5, 2)])
@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_pieces_of_vectors(tmp_path: Path, shape: tuple[int, ...], size: int) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(5.0), x=np.arange(np.prod(shape)).reshape(shape), y=np.zeros(5))
    whole = Trace.load(tmp_path / "a.npz")
    parts = list(pieces(tmp_path / "a.npz", size, Reading(dt=1.0)))
    assert all(part.data.keys() == whole.data.keys() for part in parts)
    for name, values in whole.data.items():
        assert np.concatenate([part.data[name][0] for part in parts]).tolist() == values[0].tolist()


@pytest.mark.parametrize("shape", [(), (5, 5), (2, 5), (1, 5, 5, 1), (5, 0, 5)])
def test_arrays_that_have_no_pieces(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(5.0), x=np.zeros(shape))
    with pytest.raises(TraceError, match="cannot be read in pieces"):
        list(pieces(tmp_path / "a.npz", 3, Reading()))


@pytest.mark.parametrize("name", ["wide", "meta"])
def test_a_piece_that_unpacks_to_much(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stlc.trace.formats.registry._ROOM", 1_000_000)
    wide = np.zeros((4, 100_000)) if name == "wide" else np.array("a" * 400_000)
    np.savez_compressed(tmp_path / "a.npz", t=np.arange(4.0), x=np.ones(4), **{name: wide})
    for read in (lambda path: Trace.load(path), lambda path: list(pieces(path, 2, Reading()))):
        with pytest.raises(TraceError, match="unpacks to"):
            read(tmp_path / "a.npz")


def test_a_vector_of_too_many_components(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(4.0), x=np.ones(4), wide=np.zeros((4, 5000)))
    with pytest.raises(TraceError, match="4 x 5000"):
        Trace.load(tmp_path / "a.npz")


@pytest.mark.parametrize("late", ["1", "go"])
def test_a_column_holds_words_or_numbers_in_all_pieces(tmp_path: Path, late: str) -> None:
    early = {"1": "go", "go": "1"}[late]
    rows = [f"{k},{early if k < 15 else late}" for k in range(40)]
    (tmp_path / "a.csv").write_text("\n".join(["t,mode", *rows]))
    found = []
    for read in (
        lambda reading: [Trace.load(tmp_path / "a.csv", reading)],
        lambda reading: list(pieces(tmp_path / "a.csv", 10, reading)),
    ):
        if late == "1":  # among words, numbers are words for themselves
            parts = read(Reading(words={"mode": {"go": 1.0}}))
            assert {float(x) for part in parts for x in part.data["mode"][0]} == {1.0}
            continue
        with pytest.raises(TraceError) as caught:
            read(Reading(words={"mode": {"go": 1.0}}))
        found.append(caught.value.diagnostics[0].code)
    assert found == ["E603"] * (0 if late == "1" else 2)


@pytest.mark.parametrize("before", ["", "\n\n"])
def test_a_wrong_cell_of_a_piece_has_the_line_of_the_file(tmp_path: Path, before: str) -> None:
    rows = [f"{k},{k}" for k in range(40)]
    rows[33] = "33,oops"
    (tmp_path / "a.csv").write_text(before + "\n".join(["t,x", *rows]))
    found = []
    for read in (
        lambda: Trace.load(tmp_path / "a.csv"),
        lambda: list(pieces(tmp_path / "a.csv", 10, Reading())),
    ):
        with pytest.raises(TraceError) as caught:
            read()
        span = caught.value.diagnostics[0].span
        assert span is not None
        found.append((span.line, span.column))
    assert found == [(35 + len(before), 4)] * 2
