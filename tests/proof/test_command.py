"""The same proof through `stlc check --json`: a specification and a table in, one document out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from proof.cases import Case, seeds
from proof.levels import robustness, truth

from stlc.cli.app import main

CODES = {"satisfied": 0, "violated": 1, "inconclusive": 4}


@pytest.mark.parametrize("numbers", seeds(500, 10))
def test_check_says_the_definition(
    numbers: range, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in numbers:
        case = Case(seed)
        files = written(case, tmp_path)
        cut, least, most = (
            robustness(case.formula, case.record(e))[0] for e in ("truncate", "lower", "upper")
        )
        found = asked(capsys, [*files, "--end", "truncate", "--tolerance", "0"])
        case.same(margins(found), (cut, cut), "truncate")
        holds = truth(case.formula, case.record("truncate"))[0]
        assert found["verdict"] == ("satisfied" if holds else "violated"), case
        found = asked(capsys, files)
        if not case.folds:
            case.same(margins(found), (least, most), "bounds")


def written(case: Case, folder: Path) -> list[str]:
    """The files of a case."""
    columns = {name: values for name, values in case.signals.items() if name != "q"}
    columns |= {f"q[{i}]": case.signals["q"][:, i] for i in range(3)}
    table = np.column_stack([np.arange(case.samples) * 0.1, *columns.values()])
    lines = [",".join(["t", *columns]), *(",".join(map(repr, row)) for row in table.tolist())]
    (folder / "trace.csv").write_text("\n".join(lines) + "\n")
    (folder / "case.stl").write_text(case.text)
    return [str(folder / "case.stl"), str(folder / "trace.csv")]


def asked(capsys: pytest.CaptureFixture[str], words: list[str]) -> Any:
    """What the command answers about the requirement; its exit code says the same."""
    code = main(["check", *words, "--json"])
    document = json.loads(capsys.readouterr().out)
    (rule,) = document["result"]["requirements"]
    assert code == document["exit_code"] == CODES[rule["verdict"]]
    return rule


def margins(rule: Any) -> tuple[float, float]:
    return float(rule["robustness"]["low"]), float(rule["robustness"]["high"])
