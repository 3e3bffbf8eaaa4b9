"""Tables and their pages: sections that are replaced in place, and what the numbers were made with."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.store import Key, ResultStore
from benchmarks.table import Table, markdown, provenance, show, write_section
from stlc.diagnostics import UsageError


def test_a_section_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "results.md"
    for marker, body in (("paper", "one\n"), ("ablation", "two"), ("paper", "three\n\n")):
        write_section(page, marker, [body])
    text = page.read_text()
    assert text.endswith(
        "\n\n<!-- paper -->\nthree\n<!-- /paper -->\n\n<!-- ablation -->\ntwo\n<!-- /ablation -->\n"
    )
    page.write_text(text.replace("# Results", "# What was measured") + "\nA last word.\n")
    write_section(page, "ablation", ["four"])
    assert page.read_text().startswith("# What was measured")
    assert page.read_text().endswith("four\n<!-- /ablation -->\n\nA last word.\n")


def test_a_line_for_every_machine_with_commits_and_dates() -> None:
    made = {
        "hardware": {"processor": "a processor", "cores": 2},
        "versions": {"torch": "2.13.0", "python": "3.11.7"},
        "threads": 1,
        "cores": None,
        "git": {"commit": "0123456789abcdef", "dirty": False},
        "date": "2026-01-02T10:00:00+00:00",
    }
    later = {
        **made,
        "git": {"commit": "fedcba9876543210", "dirty": True},
        "date": "2026-01-03T10:00:00+00:00",
    }
    others = [made, later, {**made, "threads": 2, "cores": 1, "git": None}]
    lines = provenance([{"made": each} for each in others], "trainings")
    assert max(map(len, lines)) <= 120
    first, second = " ".join(line.strip() for line in lines).removeprefix("- ").split(" - ")
    assert f"- {first}" == (
        "- 2 trainings on a processor, 2 cores; torch 2.13.0, Python 3.11.7; "
        "1 thread each; 2026-01-02 to 2026-01-03; commit `0123456789`, `fedcba9876+`"
    )
    assert second.endswith("2 threads, 1 core each; 2026-01-02; commit `unknown`")


def test_a_bar_in_a_cell_is_no_column() -> None:
    assert markdown(("a", "b"), [("x | y", "1")])[2] == "| x \\| y | 1 |"


@dataclass(frozen=True)
class Square:
    side: float

    @property
    def area(self) -> float:
        return self.side**2


def test_a_table_is_measured_once_and_shown_three_ways(capsys: pytest.CaptureFixture[str]) -> None:
    measured: list[float] = []

    def measure(side: float) -> Square:
        measured.append(side)
        return Square(side)

    columns = {"side": lambda row: f"{row.side:g}", "area": lambda row: f"{row.area:g}"}
    table = Table("squares", [1.0, 2.0], measure, columns, lambda row: f"measured {row.side:g}")
    assert table.markdown() == ["| side | area |", "| --- | --- |", "| 1 | 1 |", "| 2 | 4 |"]
    assert table.markdown(table.rows[1:])[2:] == ["| 2 | 4 |"]
    show("squares", {"rows": table}, as_json=False)
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["side", "area"],
        ["1", "1"],
        ["2", "4"],
    ]
    show("squares", {"rows": table}, as_json=True, page="a.md")
    result = json.loads(capsys.readouterr().out)["result"]
    assert result == {
        "what": "squares",
        "page": "a.md",
        "rows": [{"side": 1.0, "area": 1.0}, {"side": 2.0, "area": 4.0}],
    }
    assert measured == [1.0, 2.0]


def test_a_result_is_computed_once_for_its_inputs(tmp_path: Path) -> None:
    computed: list[int] = []

    def compute() -> dict[str, int]:
        computed.append(1)
        return {"number": len(computed)}

    store = ResultStore("some", tmp_path)
    key = Key("a", {"spec": "x", "seeds": (0, 1)})
    assert [store.get(key, compute)["number"] for _ in range(3)] == [1, 1, 1]
    other = Key("a", {"spec": "x", "seeds": (0, 2)})
    assert store.get(other, compute)["number"] == 2
    assert store.find(key) is None
    assert store.get(Key("b", key.values), compute)["made"]["versions"]["python"]
    assert list(store.all()) == ["a", "b"]
    assert len(store.path.read_text().splitlines()) == 4
    assert ResultStore("none", tmp_path).all() == {}


@pytest.mark.parametrize(
    "text", ["{}", '<<<<<<< ours\n{"format": "benchmark-results/1"}', '{"format": "other/1"}']
)
def test_results_that_cannot_be_read_are_not_overwritten(text: str, tmp_path: Path) -> None:
    store = ResultStore("some", tmp_path)
    store.path.write_text(text)
    with pytest.raises(UsageError, match="cannot be read"):
        store.put(Key("a", {}), {"number": 1})
    assert store.path.read_text() == text


@pytest.mark.apart
def test_processes_that_store_at_the_same_time_keep_all_results(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from benchmarks.store import Key, ResultStore\n"
        "store = ResultStore('some', Path(sys.argv[1]))\n"
        "for i in range(8): store.put(Key(f'{sys.argv[2]}{i}', {}), {'number': i})"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    processes = [subprocess.Popen([*words, name]) for name in "ab"]
    assert [process.wait() for process in processes] == [0, 0]
    assert len(ResultStore("some", tmp_path).all()) == 16
