"""`tools/proofs.py` counts cases and mismatches, says where they are, and goes on where it was stopped."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import typer
from helpers.formula_strategies import formulas
from helpers.tools import load_tool
from hypothesis import strategies as st
from proof.cases import Case

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def proofs() -> ModuleType:
    return load_tool("proofs")


def told(proofs: ModuleType, capsys: pytest.CaptureFixture[str], **options: object) -> tuple[int, list[str]]:
    with pytest.raises(typer.Exit) as left:
        proofs.main(**{"count": 5, "seed": 0, "jobs": 1, "log": None, "every": 1000, **options})
    return left.value.exit_code, capsys.readouterr().out.splitlines()


def test_what_came_out_is_printed(proofs: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    same = Case.same
    code, lines = told(proofs, capsys, names=["gradients-agm", "laws", "past"])
    assert code == 0
    assert Case.same is same
    assert lines[0] == "gradients-agm, laws, past: 5 cases each from 0 on"
    assert [line.split()[0] for line in lines[2:]] == ["gradients-agm", "laws", "past", "all"]
    assert all(line.split()[2] == "0" for line in lines[2:])


def test_every_mismatch_is_counted_and_told(
    proofs: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(number: int) -> None:
        if number in (7, 8, 103):
            Case(number).same(1.0, 1.5, "half a step")

    monkeypatch.setitem(proofs.PROOFS, "wrong", lambda block: proofs.one_by_one(wrong, block))
    code, lines = told(proofs, capsys, names=["wrong"], count=150, every=100)
    assert code == 1
    text = "\n".join(lines)
    assert text.count("half a step\ncase ") == 3
    assert "MISMATCH wrong 103: AssertionError" in text
    assert "      100 cases  2 mismatches" in lines
    assert lines[-2].split()[:4] == ["wrong", "150", "3", "5.0e-01"]


def test_a_mismatch_that_hypothesis_draws_is_shrunk(proofs: ModuleType) -> None:
    def wrong(formula: object, number: int) -> None:  # noqa: ARG001
        assert number < 10, f"{number} is too large"

    given = {"formula": formulas(), "number": st.integers(0, 1000)}
    cases, mismatches = proofs.by_hypothesis(wrong, given, proofs.Block("drawn", 3, 50))
    assert cases == 50
    assert "10 is too large" in mismatches[0]


def test_a_run_goes_on_where_it_was_stopped(
    proofs: ModuleType,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    seen: list[int] = []

    def noted(number: int) -> None:
        if number == 120 and 120 not in seen:
            seen.append(number)
            raise KeyboardInterrupt
        seen.append(number)

    monkeypatch.setitem(proofs.PROOFS, "noted", lambda block: proofs.one_by_one(noted, block))
    log = tmp_path / "proofs.jsonl"
    with pytest.raises(KeyboardInterrupt):
        proofs.main(["noted"], count=250, seed=0, jobs=1, log=log, every=1000)
    with log.open("a", encoding="utf-8") as file:
        file.write('{"block": {"proof": "no')  # what was being written when all ended
    del seen[:-1]
    code, lines = told(proofs, capsys, names=["noted"], count=250, log=log)
    assert code == 0
    assert sorted(set(seen)) == [*range(100, 250)]
    assert lines[-1].split()[1] == "250"


@pytest.mark.apart
def test_it_needs_neither_pytest_nor_what_the_command_line_needs() -> None:
    absent = ("pytest", "pydantic", "safetensors", "rtamt")
    hidden = "; ".join(f"sys.modules[{name!r}] = None" for name in absent)
    tool = str(ROOT / "tools" / "proofs.py")
    asked = f"sys.argv = ['proofs.py', '--help']; runpy.run_path({tool!r}, run_name='__main__')"
    script = f"import runpy, sys; {hidden}; {asked}"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr


def test_the_page_names_every_proof(proofs: ModuleType) -> None:
    page = (ROOT / "docs" / "proofs.md").read_text(encoding="utf-8")
    assert all(f"| `{name}` |" in page for name in proofs.PROOFS)
