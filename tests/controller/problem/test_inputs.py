"""The files that a training reads, as they are sent to other machines."""

from __future__ import annotations

from pathlib import Path

from stlc.controller.problem.inputs import input_files


def test_what_a_training_reads(project: Path) -> None:
    read = {
        path.resolve().relative_to(project.resolve()).as_posix()
        for path in input_files(Path("specs/drive.stl"))
    }
    assert {"specs/drive.stl", "specs/driving_rules.stl", "models/car.yaml", "models/base.yaml"} <= read
    (project / "specs/broken.stl").write_text("require a: always[0, ")
    assert input_files(Path("specs/broken.stl")) == (Path("specs/broken.stl"),)
    assert input_files(Path("specs/none.stl")) == ()
