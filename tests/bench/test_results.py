"""The page of results: sections that are replaced in place, and what the numbers were made with."""

from __future__ import annotations

from pathlib import Path

from stlc.bench.results import markdown, provenance, write_section


def test_a_section_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "results.md"
    for marker, body in (("paper", "one\n"), ("ablation", "two"), ("paper", "three\n\n")):
        write_section(page, marker, body)
    text = page.read_text()
    assert text.endswith(
        "\n\n<!-- paper -->\nthree\n<!-- /paper -->\n\n<!-- ablation -->\ntwo\n<!-- /ablation -->\n"
    )
    page.write_text(text.replace("# Results", "# What was measured") + "\nA last word.\n")
    write_section(page, "ablation", "four")
    assert page.read_text().startswith("# What was measured")
    assert page.read_text().endswith("four\n<!-- /ablation -->\n\nA last word.\n")


def test_a_line_for_every_machine_with_commits_and_dates() -> None:
    made = {
        "hardware": {"processor": "a processor", "cores": 2},
        "versions": {"torch": "2.13.0", "python": "3.11.7"},
        "stlc": "0.1.0",
        "threads": 1,
        "cores": None,
        "git": {"commit": "0123456789abcdef", "dirty": False},
        "finished": "2026-01-02T10:00:00+00:00",
    }
    later = {
        **made,
        "git": {"commit": "fedcba9876543210", "dirty": True},
        "finished": "2026-01-03T10:00:00+00:00",
    }
    lines = provenance([made, later, {**made, "threads": 2, "cores": 1, "git": None}])
    assert max(map(len, lines)) <= 120
    first, second = " ".join(line.strip() for line in lines).removeprefix("- ").split(" - ")
    assert f"- {first}" == (
        "- 2 trainings on a processor, 2 cores; torch 2.13.0, Python 3.11.7, stlc 0.1.0; "
        "1 thread a training; 2026-01-02 to 2026-01-03; commit `0123456789`, `fedcba9876+`"
    )
    assert second.endswith("2 threads, 1 core a training; 2026-01-02; commit `unknown`")


def test_a_bar_in_a_cell_is_no_column() -> None:
    assert markdown(("a", "b"), [("x | y", "1")])[2] == "| x \\| y | 1 |"
