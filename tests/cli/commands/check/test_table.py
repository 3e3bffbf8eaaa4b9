"""`stlc check` on many files: patterns of names, lost processes, the table, other machines."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.documents import misfits

from stlc.cli.commands.check.many import Work, safe_outcomes
from stlc.cli.commands.check.table import COLUMNS
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.compile.semantics.tolerance import End
from stlc.controller.parallel.elsewhere import RemoteCall, answer
from stlc.controller.parallel.workers import CallFiles
from stlc.jsontext import plain
from stlc.monitor.check import Question
from stlc.monitor.online.online import How
from stlc.monitor.uncertain import Uncertainty
from stlc.monitor.verdict import Monitor, first_violation, timed
from stlc.trace import Trace

SPEC = """spec small
signal a [m]
signal b [m]
require low: always a < 2 m
require soon: always[0 s, 1 s] (b > 1 m -> eventually[0 s, 0.5 s] b < 0 m)
"""


@pytest.fixture(autouse=True)
def _a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text(SPEC)


def recording(name: str, a: Sequence[float] = (0.0,) * 20, b: Sequence[float] = (0.0,) * 20) -> None:
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{k / 10},{x},{y}" for k, (x, y) in enumerate(zip(a, b, strict=True))]
    Path(name).write_text("\n".join(["t,a,b", *rows]) + "\n")


def some() -> None:
    recording("logs/1/good.csv")
    recording("logs/1/high.csv", a=[0.0] * 7 + [3.0] + [0.0] * 5 + [4.0] * 7)
    recording("logs/2/late.csv", b=[0.0, 0.0, 2.0] + [0.5] * 17)
    recording("logs/2/short.csv", a=[0.0] * 4, b=[0.0] * 4)
    Path("logs/2/broken.csv").write_text("t,a\n0,1\n0.1,1\n")
    Path("logs/.hidden").mkdir()
    recording("logs/.hidden/no.csv")


def check(*words: str) -> int:
    return main(["check", "s.stl", *words])


def rows_of(path: str) -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


EXPECTED = [
    ("logs/1/good.csv", "low", "satisfied", "2.0", ""),
    ("logs/1/good.csv", "soon", "satisfied", "1.0", ""),
    ("logs/1/high.csv", "low", "violated", "-2.0", "0.7"),
    ("logs/1/high.csv", "soon", "satisfied", "1.0", ""),
    ("logs/2/broken.csv", "", "invalid", "", ""),
    ("logs/2/late.csv", "low", "satisfied", "2.0", ""),
    ("logs/2/late.csv", "soon", "violated", "-0.5", "0.7"),
    ("logs/2/short.csv", "low", "satisfied", "2.0", ""),
    ("logs/2/short.csv", "soon", "inconclusive", "", ""),
]


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_row_for_each_file_and_requirement(jobs: str) -> None:
    some()
    assert check("logs/**/*.csv", "--table", "logs/verdicts.csv", "-q", "--jobs", jobs) == 3
    found = rows_of("logs/verdicts.csv")
    for row in found:
        row["violated_at"] = f"{float(row['violated_at']):g}" if row["violated_at"] else ""
    keys = ("file", "requirement", "verdict", "robustness", "violated_at")
    assert [tuple(row[key] for key in keys) for row in found] == EXPECTED
    assert [row["samples"] for row in found] == ["20"] * 4 + [""] + ["20"] * 2 + ["4"] * 2
    assert found[4]["error"].startswith("E601: ")
    assert check("logs/**/*.csv", "--table", "logs/verdicts.csv", "-q") == 3  # does not match itself
    assert len(rows_of("logs/verdicts.csv")) == len(EXPECTED)


def test_the_same_as_parquet() -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    some()
    for name in ("v.csv", "v.parquet"):
        assert check("logs/*/*.csv", "--table", name, "-q") == 3
    table = parquet.read_table("v.parquet")
    assert table.column_names == list(COLUMNS)
    assert [str(field.type).removesuffix("64").rstrip("_") for field in table.schema] == [
        kind.replace("float64", "double").removesuffix("64") for kind in COLUMNS.values()
    ]
    text = [
        {name: "" if cell is None else str(cell) for name, cell in row.items()} for row in table.to_pylist()
    ]
    assert text == rows_of("v.csv")


def test_no_cell_is_a_formula() -> None:
    recording("=1+1.csv")
    Path("odd.stl").write_text("spec odd\nsignal a [m]\nrequire `=HYPERLINK(1)`: always a < 2 m\n")
    assert main(["check", "odd.stl", "=1+1.csv", "--table", "v.csv", "-q"]) == 0
    (row,) = rows_of("v.csv")
    assert (row["file"], row["requirement"]) == ("'=1+1.csv", "'=HYPERLINK(1)")
    recording("plain.csv", a=[3.0] * 20)
    assert check("plain.csv", "--table", "v.csv", "-q") == 1
    assert rows_of("v.csv")[0]["robustness"] == "-1.0"


def test_one_file_and_the_standard_input_have_a_table_too(monkeypatch: pytest.MonkeyPatch) -> None:
    recording("one.csv", a=[3.0] * 20)
    assert check("one.csv", "--table", "one/t.csv", "-q") == 1
    assert [row["violated_at"] for row in rows_of("one/t.csv")] == ["0.0", ""]
    with Path("one.csv").open() as file:
        monkeypatch.setattr("sys.stdin", file)
        assert check("-", "--table", "in.csv", "-q") == 1
    assert rows_of("in.csv")[0]["file"] == "standard input"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["none/**/*.csv"], 2, "error[U102]: no file matches `none/**/*.csv`"),
        (["s*"], 2, "error[U102]: no trace matches `s*`"),
        (["good.csv", "--table", "t.txt"], 2, "name it .parquet or .csv"),
        (["good.csv", "--table", "folder.csv"], 2, "is a folder"),
        (["good.csv", "--table", "good.csv"], 2, "`--table good.csv` is a file that this command reads"),
        (["good.csv", "--out", "./good.csv"], 2, "is a file that this command reads"),
        (["good.csv", "--junit", "s.stl"], 2, "is a file that this command reads"),
        (["good.csv", "--table", "t.csv", "--junit", "t.csv"], 2, "also the file of `--table`"),
        (["good.csv", "--cluster", "local", "--jobs", "2"], 2, "contradict each other"),
        (["-", "--cluster", "local"], 2, "the standard input is judged here"),
    ],
)
def test_what_is_refused(words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("folder.csv").mkdir()
    recording("good.csv")
    before = sorted(Path().iterdir())
    assert check(*words) == code
    assert said in capsys.readouterr().err
    assert sorted(Path().iterdir()) == before


def test_a_file_that_is_called_like_a_pattern() -> None:
    recording("[1].csv", a=[3.0] * 20)
    recording("1.csv")
    assert check("[1].csv", "-q") == 1


@pytest.mark.apart
def test_torch_is_not_imported() -> None:
    some()
    code = (
        "import sys\n"
        "from stlc.cli.framework.app import main\n"
        "import stlc.controller.parallel.ray_cluster\n"
        "assert main(['check', 's.stl', 'logs/1/*.csv', '--jobs', '2', '--table', 't.csv']) == 1\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


# ------------------------------------------------------------------- lost processes


def killing(name: str, times: int) -> Any:
    """`outcomes_of`, which ends its process the first times that a file is judged."""
    from stlc.cli.commands.check.many import outcomes_of

    def judged(work: Work) -> Any:
        marks = Path("tried")
        tried = len(list(marks.iterdir()))
        if work.name == name and tried < times:
            (marks / str(tried)).touch()
            os._exit(9)
        return outcomes_of(work)

    return judged


@pytest.mark.parametrize("times", [2, 3])
def test_a_lost_process_costs_only_its_file(
    times: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some()
    Path("logs/2/broken.csv").unlink()
    assert check("logs/**/*.csv", "--json") == 1
    whole = json.loads(capsys.readouterr().out)["result"]
    Path("tried").mkdir()
    monkeypatch.setattr("stlc.cli.commands.check.many.outcomes_of", killing("logs/1/high.csv", times))
    words = ["logs/**/*.csv", "--jobs", "2", "--json", "--table", "t.csv", "--junit", "j.xml"]
    code = check(*words)
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("check/1")) == []
    if times < 3:
        assert (code, document["result"]) == (1, whole)
        return
    assert code == document["exit_code"] == 5
    lost = whole["files"].index(next(f for f in whole["files"] if f["trace"] == "logs/1/high.csv"))
    whole["files"][lost] = {"trace": "logs/1/high.csv", "verdict": "not judged"}
    assert document["result"]["files"] == whole["files"]
    assert [finding["code"] for finding in document["diagnostics"]] == ["R406"]
    row = next(row for row in rows_of("t.csv") if row["verdict"] == "not judged")
    assert row["error"].endswith("its worker was lost 3 times; its process ended with exit code 9")
    assert 'type="R406"' in Path("j.xml").read_text()
    Path("tried").rename("tried before")
    Path("tried").mkdir()
    assert check("logs/**/*.csv", "--jobs", "2", "--certify", ".5") == 5
    said = capsys.readouterr()
    assert "1 not judged" in said.out
    assert "error[R406]: `logs/1/high.csv` is not judged" in said.err


# -------------------------------------------------------------------- other machines


def test_a_machine_that_does_not_see_the_files_gives_the_same(tmp_path: Path) -> None:
    some()
    question = Question(spec=tmp_path / "s.stl")
    for name in ("logs/1/high.csv", str(tmp_path / "logs/2/broken.csv")):
        work = Work(name, question, Path("runs"), Path("out") / f"{Path(name).stem}.npz", table=True)
        here = safe_outcomes(work)[0]
        files = CallFiles((tmp_path / "s.stl", Path(name)), (work.out,))
        far = answer(_unseen(RemoteCall.of(safe_outcomes, work, files, {}).with_files()))
        there = far.delivered()[0]
        assert plain(there.verdict) == plain(here.verdict)
        assert (there.errors, there.exit_code) == (here.errors, here.exit_code)
        assert (far.outputs == {}) == bool(here.errors)
    assert Trace.load("out/high.npz").data["low"].min() == -2.0


def _unseen(call: RemoteCall) -> RemoteCall:
    """The call with files that no machine has."""
    return replace(call, inputs=tuple(replace(each, changed=0) for each in call.inputs))


# ------------------------------------------------------------------ the first violation


@pytest.mark.parametrize("seed", range(12))
def test_the_first_violation_is_the_one_that_an_online_monitor_reports(seed: int) -> None:
    generator = np.random.default_rng(seed)
    monitor = Monitor(SPEC, dt=0.1)
    a, b = generator.uniform(-1.0, 2.05, 40), generator.uniform(-0.1, 1.5, 40)
    trace = Trace(monitor.compiled.signature, 0.1, {"a": a[None], "b": b[None]})
    at = "all" if seed % 2 else None
    require = ["soon"] if at else []
    verdict = monitor.check(trace, at=at, require=require)
    online = monitor.online(How(at=at), dt=0.1, require=require)
    first: dict[str, int] = {}
    for k in range(40):
        online.push({"a": a[k], "b": b[k]})
        for decision in online.verdicts():
            counted = decision.start < verdict[decision.requirement].instants
            if decision.status == "violated" and counted:
                first.setdefault(decision.requirement, decision.sample)
    found = {j.name: first_violation(j) for j in verdict if j.overall == "violated"}
    assert found == first


@pytest.mark.parametrize("end", ["open", "truncate"])
@pytest.mark.parametrize(
    ("written", "first"),
    [
        ("eventually x > 0", 3),
        ("x < 0 until x > 0", 3),
        ("always (x < -1 -> eventually x > 0)", 3),
        ("always x > -1.5", 1),
        ("eventually[0, 1] x > 0", 1),
    ],
)
def test_a_violation_that_the_end_decides_is_certain_at_the_end(written: str, first: int, end: End) -> None:
    monitor = Monitor(f"signal x\nrequire r: {written}", dt=1)
    x = np.array([-1.0, -2, -1, -1])
    uncertain = {"x": Uncertainty(0.0)}
    assert first_violation(monitor.check({"x": x}, end=end)["r"]) == first
    assert timed(monitor.check({"x": x}, end=end, uncertain=uncertain))["r"].violated_at == first


def test_an_uncertain_violation_is_certain_where_no_error_hides_it() -> None:
    monitor = Monitor("signal x\nrequire r: always x > 0", dt=1)
    verdict = monitor.check({"x": np.array([1.0, -1, -3])}, uncertain={"x": Uncertainty(2.0)})
    assert timed(verdict)["r"].violated_at == 2.0


@pytest.mark.parametrize(("written", "at"), [("always x > 0", "1.5"), ("eventually x > 9", "3.0")])
def test_a_violation_within_a_step_is_not_certain_before_it(written: str, at: str) -> None:
    Path("within.csv").write_text("t,x\n0,1\n1,1\n1.5,-1\n2,1\n3,1\n")
    Path("within.stl").write_text(f"signal x\nrequire r: {written}\n")
    assert main(["check", "within.stl", "within.csv", "--resample", "1s", "--table", "t.csv", "-q"]) == 1
    assert [row["violated_at"] for row in rows_of("t.csv")] == [at]


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_names_that_utf_8_cannot_encode_are_written_without_what_it_cannot(name: str) -> None:
    if name.endswith(".parquet"):
        pytest.importorskip("pyarrow")
    recording("odd/a.csv")
    recording("odd/b\udcff.csv")
    Path("odd/c\udcfe.csv").write_text("t,a\n0,1\n0.1,oops\n")
    assert check("odd/*.csv", "--table", name) == 3
    if name == "t.csv":
        assert {row["file"] for row in rows_of(name)} == {"odd/a.csv", "odd/b\ufffd.csv", "odd/c\ufffd.csv"}


def test_a_huge_piece_is_the_whole_file() -> None:
    recording("a.csv")
    assert check("a.csv", "--chunk", str(2**63)) == 0
