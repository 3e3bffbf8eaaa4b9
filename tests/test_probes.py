"""A meaning that is changed at its one place changes in every face: `tools/probes.py`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from helpers.tools import ROOT, load_tool

from stlc.toolchain import compiler

probes, faces = load_tool("probes"), load_tool("faces")
LAGGING = 0


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    found: dict[str, Any] = probes.unaltered()
    return found


@pytest.mark.apart
@pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
@pytest.mark.parametrize("probe", probes.PROBES, ids=str)
def test_every_face_follows(probe: Any, plain: dict[str, Any], tmp_path: Path) -> None:
    found = {(lag.meaning, lag.face): str(lag) for lag in probes.lags(probe, plain, tmp_path)}
    known = {pair for pair in (*probes.APART, *probes.LAGGING) if pair[0] == probe.meaning}
    assert set(found) == known, "\n".join(found.values())


@pytest.mark.parametrize("probe", probes.PROBES, ids=str)
def test_each_meaning_has_one_place(probe: Any) -> None:
    assert (ROOT / "stlc" / probe.place).read_text(encoding="utf-8").count(probe.old) == 1
    assert probe.new != probe.old
    assert set(probe.faces) <= faces.FACES.keys()


def test_what_lags_is_held_by_a_test() -> None:
    assert len(probes.LAGGING) <= LAGGING
    for (meaning, face), test in probes.APART.items():
        path, _, name = test.partition("::")
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), test
        assert face in next(probe.faces for probe in probes.PROBES if probe.meaning == meaning)
    assert max(Counter(probe.meaning for probe in probes.PROBES).values()) == 1


def test_an_edit_that_finds_no_text_fails(tmp_path: Path) -> None:
    probe = probes.Probe("nothing", "version.py", "nothing like this", "", ())
    (tmp_path / "stlc").mkdir()
    (tmp_path / "stlc" / "version.py").write_text("x = 1\n")
    with pytest.raises(ValueError, match="0 times"):
        probe.edit(tmp_path)
