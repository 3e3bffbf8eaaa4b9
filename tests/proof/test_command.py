"""The same proof through `stlc check --json`: a specification and a table in, one document out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from proof.amounts import seeds
from proof.cases import Case
from proof.levels import robustness, truth

from stlc.cli.framework.app import main

CODES = {"satisfied": 0, "violated": 1, "inconclusive": 4}


@pytest.mark.parametrize("numbers", seeds(500, 10))
def test_check_says_the_definition(
    numbers: range, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in numbers:
        case = Case(seed)
        if case.samples < 2:  # a table of one row does not say how far samples are apart
            continue
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
    """Answer of the command about the requirement; its exit code says the same."""
    code = main(["check", *words, "--json"])
    document = json.loads(capsys.readouterr().out)
    (rule,) = document["result"]["requirements"]
    assert code == document["exit_code"] == CODES[rule["verdict"]]
    return rule


def margins(rule: Any) -> tuple[float, float]:
    return float(rule["robustness"]["low"]), float(rule["robustness"]["high"])


def test_another_semantics_is_told_and_the_verdict_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "case.stl").write_text("signal x\nrequire r: always[0 s, 2 s] x > 0\nrequire s: x > 5\n")
    (tmp_path / "trace.csv").write_text("t,x\n0,1\n1,2\n2,4\n")
    files = [str(tmp_path / "case.stl"), str(tmp_path / "trace.csv")]
    found = {}
    for name in ("exact", "smooth", "agm", "dgmsr"):
        assert main(["check", *files, "--semantics", name, "--json"]) == 1
        result = json.loads(capsys.readouterr().out)["result"]
        rule, other = result["requirements"]
        found[name] = rule["robustness"]["min"]
        assert (rule["verdict"], other["verdict"]) == ("satisfied", "violated")
        assert other["robustness"]["min"] == -4
        if name in ("exact", "agm"):
            assert result["robustness"] == (-4 if name == "exact" else -2)
    wanted = {"exact": 1, "smooth": 1, "agm": 30 ** (1 / 3) - 1, "dgmsr": 1.9999}
    assert found == pytest.approx(wanted, abs=1e-6)
    for words in ([*files, "--semantics", "mean"], [files[0], "-", "--semantics", "agm"]):
        assert main(["check", *words, "--json"]) == 2
        assert json.loads(capsys.readouterr().out)["diagnostics"][0]["code"] == "U101"
