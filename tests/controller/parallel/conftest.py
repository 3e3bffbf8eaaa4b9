"""A project in two folders, as a training elsewhere reads it."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a specification and its system in a folder beside."""
    home = tmp_path / "project"
    (home / "specs").mkdir(parents=True)
    (home / "models").mkdir()
    car = (ROOT / "examples/car.yaml").read_text()
    (home / "models/base.yaml").write_text(car)
    (home / "models/car.yaml").write_text("extends: base.yaml\n")
    text = (ROOT / "specs/traffic.stl").read_text().replace('"../examples/car.yaml"', '"../models/car.yaml"')
    (home / "specs/drive.stl").write_text(text)
    (home / "specs/driving_rules.stl").write_text((ROOT / "specs/driving_rules.stl").read_text())
    monkeypatch.chdir(home)
    return home
