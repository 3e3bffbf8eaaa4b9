"""A guard that does not ship, `braking`: its own file, and the file of its stage."""

from __future__ import annotations

import shutil
from pathlib import Path

TOY = Path(__file__).parents[1] / "data/toy/toy"
PACKAGES = {"kinds": "stlc.controller.guard.kinds", "stages": "stlc.controller.guard.stages"}
"""Folder -> package that it extends."""


def write_guard(folder: Path) -> str:
    """Write both files below `folder`, and return the name of the guard."""
    for kind, name in (("kinds", "braking.py"), ("stages", "full_braking.py")):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        shutil.copy(TOY / name, folder / kind)
    return "braking"
