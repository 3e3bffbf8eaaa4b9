"""Lines of a stream: the same samples as those of a file with these lines, or a diagnostic."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.diagnostics import TraceError
from stlc.trace import Reading, live
from stlc.trace.formats import cells
from stlc.trace.live import SampleStream, on_grid


def samples_of(text: str, reading: Reading) -> list[dict[str, float]]:
    return read([text.encode()], reading)[0]


def read(pieces: list[bytes], reading: Reading) -> tuple[list[dict[str, float]], str]:
    """Samples of a stream that comes in pieces, and what is wrong with the first line that has none."""
    found: list[dict[str, float]] = []
    try:
        for some in on_grid(
            SampleStream("standard input", reading).samples(pieces), reading, "input"
        ).samples:
            rows = zip(*(values.tolist() for values in some.columns.values()), strict=True)
            found += [dict(zip(some.columns, row, strict=True)) for row in rows]
    except TraceError as error:
        return found, str(error)
    return found, ""


def code_of(text: str, reading: Reading) -> str:
    with pytest.raises(TraceError) as caught:
        for _ in on_grid(SampleStream("input", reading).samples([text.encode()]), reading, "input").samples:
            pass
    return caught.value.diagnostics[0].code


TRACES = {
    "numbers": "trace,x\n0,1\n0,9\n1,1\n",
    "words": "agent;x\na;1\nb;9\n",
    "an empty cell": "agent,x\n0,1\n,9\n",
    "objects": '{"trace": 0, "x": 1}\n{"trace": "b", "x": 2}\n',
    "a later name": '{"x": 0}\n{"agent": 0, "x": 1}\n{"agent": 1, "x": 2}\n',
}


@pytest.mark.parametrize("name", TRACES)
def test_several_traces_are_not_taken_for_one(name: str) -> None:
    assert code_of(TRACES[name], Reading(dt=1.0)) == "E605"


@pytest.mark.parametrize("text", ["trace,x\n1,1\n1.0,9\n", '{"trace": null, "x": 1}\n{"trace": 1, "x": 9}\n'])
def test_the_name_of_the_one_trace_is_no_signal(text: str) -> None:
    assert samples_of(text, Reading(dt=1.0)) == [{"x": 1.0}, {"x": 9.0}]


GRIDS = [Reading(), Reading(dt=1.0), Reading(resample=1.0), Reading(max_gap=1.0)]


@pytest.mark.parametrize("reading", GRIDS)
@pytest.mark.parametrize("times", [("NaT", "NaT", "2026-01-01"), ("2026-01-01", "NaT", "2026-01-03")])
def test_a_time_that_is_none_is_refused(times: tuple[str, ...], reading: Reading) -> None:
    rows = [f"{time},{k}" for k, time in enumerate(times)]
    assert code_of("\n".join(["t,x", *rows]), reading) == "E603"


@pytest.mark.parametrize("reading", GRIDS)
@pytest.mark.parametrize("times", [(-1e308, 1e308), (-1e308, -1e308, 1e308)])
def test_times_that_are_too_far_apart(times: tuple[float, ...], reading: Reading) -> None:
    assert code_of("\n".join(["t,x", *(f"{time!r},1" for time in times)]), reading) == "E602"


@pytest.mark.parametrize("reading", [Reading(), Reading(max_gap=1.0)])
def test_times_that_are_too_close(reading: Reading) -> None:
    assert code_of("t,x\n0,1\n1e-20,1\n2e-20,1\n", reading) == "E602"


def test_a_grid_that_is_too_fine() -> None:
    assert code_of("t,x\n0,1\n1e300,1\n", Reading(resample=1e-15)) == "E605"


def test_a_time_that_is_infinite_in_seconds() -> None:
    assert code_of("t [h],x\n0,1\n1e308,1\n", Reading()) == "E603"


def test_a_stream_without_a_header_is_read_by_the_names_that_are_given() -> None:
    reading = Reading(columns=("t", "x [m]"))
    assert samples_of("0,1\n1,2\n2,3\n", reading) == [{"x": 1.0}, {"x": 2.0}, {"x": 3.0}]
    assert code_of("0,1,2\n", reading) == "E605"


def test_a_clock_is_named_once() -> None:
    assert code_of("t,t,x\n0,0,1\n1,1,2\n", Reading()) == "E605"


def test_lines_of_empty_cells_are_skipped() -> None:
    found = samples_of("t,x\n0,1\n,\n , \n1,2\n", Reading())
    assert found == [{"x": 1.0}, {"x": 2.0}]


def test_the_last_cells_of_a_line_may_be_empty() -> None:
    assert str(samples_of("t\tx\ty\n0\t1\t2\n1\t3\t\n", Reading())[1]["y"]) == "nan"


ODD = ("", "NA", "word", '"4"', " 5 ", "1,5", "1_000", "12345678901234567890.5", "inf", "\x1c", "\xa06", "é")
NUMBERS = st.integers(-99, 99).map(str) | st.floats(-9, 9).map(repr)
SETTINGS = st.builds(
    Reading,
    dt=st.sampled_from([None, 1.0]),
    resample=st.sampled_from([None, 0.4]),
    max_gap=st.sampled_from([None, 2.0]),
    words=st.sampled_from([None, {"x": {"word": 1.0}, "y": {}}]),
    read=st.sampled_from([None, {"x": True}, {"t": True, "x": True}]),
)


@st.composite
def tables(draw: st.DrawFn) -> bytes:
    """Lines of numbers, mostly at equal times, with odd lines among them."""
    mark, end = draw(st.sampled_from(",;\t")), draw(st.sampled_from(["\n", "\r\n"]))
    names = draw(st.permutations(["t", "x", "y"]))
    lines = [mark.join(names)]
    for k in range(draw(st.integers(0, 25))):
        cells = [str(k) if name == "t" else draw(NUMBERS) for name in names]
        lines.append(mark.join(cells))
        if not draw(st.integers(0, 9)):
            cells[draw(st.integers(0, 2))] = draw(st.sampled_from(ODD))
            odd = [mark.join(cells), mark.join(cells) + mark, "", mark * 2, "# 1", "\x1c", "1\r2", "9" * 200]
            lines[-1] = draw(st.sampled_from(odd))
    text = end.join(lines) + draw(st.sampled_from(["", end]))
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8", "latin-1"])))


@given(tables(), SETTINGS, st.integers(1, 300), st.booleans())
def test_lines_that_are_read_together(text: bytes, reading: Reading, size: int, native: bool) -> None:
    """Samples and messages are those of lines that are read one by one, however the pieces are cut."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "MAX_LINE", 150)
        patch.setattr(SampleStream, "_table", lambda *_: None)
        expected = read([text], reading)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "MAX_LINE", 150)
        patch.setattr(live, "_SHORT", 30)
        if not native:
            patch.setattr(cells, "_library", lambda: None)
        assert repr(read([text[at : at + size] for at in range(0, len(text), size)], reading)) == repr(
            expected
        )


def test_plain_lines_are_read_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the short stretch around each odd line: 10 kB with two of them."""
    lines = ["t,x", *(f"{k},{k / 7}" for k in range(1000))]
    lines[300], lines[700] = '299,"1"', "699,word"
    seen = 0
    monkeypatch.setattr(live, "_SHORT", 100)
    one = SampleStream._line

    def counted(self: SampleStream, raw: bytes) -> object:
        nonlocal seen
        seen += 1
        return one(self, raw)

    monkeypatch.setattr(SampleStream, "_line", counted)
    found, wrong = read(["\n".join(lines).encode()], Reading(words={"x": {}}))
    assert (len(found), "line 701" in wrong) == (699, True)
    assert 2 < seen < 30
