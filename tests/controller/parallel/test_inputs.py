"""The files that a training reads, as they are sent to other machines."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.controller.parallel.inputs import input_files

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


def test_what_a_training_reads(project: Path) -> None:
    read = {
        path.resolve().relative_to(project.resolve()).as_posix()
        for path in input_files(Path("specs/drive.stl"))
    }
    assert {"specs/drive.stl", "specs/driving_rules.stl", "models/car.yaml", "models/base.yaml"} <= read
    (project / "specs/broken.stl").write_text("require a: always[0, ")
    assert input_files(Path("specs/broken.stl")) == (Path("specs/broken.stl"),)
    assert input_files(Path("specs/none.stl")) == ()
