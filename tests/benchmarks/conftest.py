"""The methods and planners of the comparison are known by their names."""

from __future__ import annotations

import pytest

from benchmarks.__main__ import RIVALS
from stlc.plugins import variable


@pytest.fixture(autouse=True)
def _rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    for group, folder in RIVALS.items():
        monkeypatch.setenv(variable(group), str(folder))
