"""Lines of a stream: the same samples as those of a file with these lines, or a diagnostic."""

from __future__ import annotations

import pytest

from stlc.diagnostics import TraceError
from stlc.trace import Reading
from stlc.trace.live import Sample, SampleStream, on_grid


def samples_of(text: str, reading: Reading) -> list[Sample]:
    lines = text.encode().splitlines(keepends=True)
    return list(on_grid(SampleStream("standard input", reading).moments(lines), reading, "input").samples)


def code_of(text: str, reading: Reading) -> str:
    with pytest.raises(TraceError) as caught:
        samples_of(text, reading)
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


def test_lines_of_empty_cells_are_skipped() -> None:
    found = samples_of("t,x\n0,1\n,\n , \n1,2\n", Reading())
    assert found == [{"x": 1.0}, {"x": 2.0}]
