"""`tools/proofs.py` counts cases and mismatches, and says where they are."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import typer
from proof.cases import Case

ROOT = Path(__file__).parents[2]


@pytest.fixture
def proofs() -> ModuleType:
    spec = importlib.util.spec_from_file_location("proofs", ROOT / "tools" / "proofs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_came_out_is_printed(proofs: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    same = Case.same
    with pytest.raises(typer.Exit) as left:
        proofs.main("gradients-agm", count=5, first=0)
    assert left.value.exit_code == 0
    assert Case.same is same
    first, last = capsys.readouterr().out.splitlines()
    assert first == "gradients-agm: cases from 0 on"
    assert last.startswith("     5 cases  0 blocks with a mismatch  greatest difference ")


def test_a_mismatch_is_counted_and_told(proofs: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    def wrong(numbers: range) -> None:
        if 7 in numbers:
            Case(7).same(1.0, 1.5, "half a step")

    proofs.PROOFS["wrong"] = wrong
    with pytest.raises(typer.Exit) as left:
        proofs.main("wrong", count=150, first=0, every=100)
    assert left.value.exit_code == 1
    told = capsys.readouterr().out
    assert "half a step\ncase 7: require r:" in told
    assert told.splitlines()[-1].startswith(
        "   150 cases  1 blocks with a mismatch  greatest difference 5.0e-01"
    )


def test_the_page_names_every_proof(proofs: ModuleType) -> None:
    page = (ROOT / "docs" / "proofs.md").read_text(encoding="utf-8")
    assert all(f"| `{name}` |" in page for name in proofs.PROOFS)
