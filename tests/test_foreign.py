"""Python that files name: who runs it, and what it leaves."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.diagnostics import RunError
from stlc.foreign import driving, module_at, require_driving
from stlc.source import Source

OWN, OF_A_RUN = Source("a.yaml", "f.py").span(0, 4), Source("a.yaml", "f.py", root="/runs/1").span(0, 4)


def test_python_of_a_run_is_run_only_while_driving(tmp_path: Path) -> None:
    path = tmp_path / "f.py"
    path.write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\nK = 3\n")
    with driving(False):
        with pytest.raises(RunError) as caught:
            module_at(path, "stlc_test_foreign", OF_A_RUN)
        assert (caught.value.diagnostics[0].code, caught.value.diagnostics[0].span) == ("R111", OF_A_RUN)
        assert not (tmp_path / "ran").exists()
        require_driving(OWN)
        require_driving(None)
        with driving(True):
            assert module_at(path, "stlc_test_foreign", OF_A_RUN).K == 3
    assert (tmp_path / "ran").exists()
    require_driving(OF_A_RUN)  # a program that uses the library decides itself


def test_nothing_is_written_beside_a_file_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text("K = 3\n")
    module_at(tmp_path / "f.py", "stlc_test_foreign", OF_A_RUN)
    assert [path.name for path in tmp_path.iterdir()] == ["f.py"]


def test_a_module_that_fails_is_forgotten(tmp_path: Path) -> None:
    import sys

    (tmp_path / "f.py").write_text("raise RuntimeError('broken')\n")
    with pytest.raises(RuntimeError, match="broken"):
        module_at(tmp_path / "f.py", "stlc_test_broken")
    assert "stlc_test_broken" not in sys.modules
    with pytest.raises(FileNotFoundError, match="there is no file"):
        module_at(tmp_path / "g.py", "stlc_test_broken")
