"""Pictures of training and deployment: learning curves, signals, failures, animations, and one report.

Drawing needs matplotlib and Pillow (extra `plot`). They are imported only when a picture is
drawn, so that training and deployment work without them. The function `available` tells whether both are
installed.
"""

from __future__ import annotations

from importlib.util import find_spec

from stlc.extras import not_installed

_PACKAGES = {"matplotlib": "matplotlib", "PIL": "pillow"}


def available() -> bool:
    """True if matplotlib and Pillow are installed."""
    return not _missing()


def require_drawing() -> None:
    """Raise MissingError (R301) if matplotlib or Pillow is not installed."""
    missing = _missing()
    if missing:
        raise not_installed(*missing, need="pictures need")


def _missing() -> list[str]:
    return [package for module, package in _PACKAGES.items() if find_spec(module) is None]
