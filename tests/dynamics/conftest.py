"""Small systems for tests, written as YAML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.source import Source

HEAD = "stlc: 1\nname: small\n"
ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="session")
def make() -> Callable[..., System]:
    """A system from the text of its sections; `set` changes fields."""

    def build(text: str, **changes: str) -> System:
        overrides = {key.replace("__", "."): value for key, value in changes.items()}
        return System(parse_system(Source("small.yaml", HEAD + text), Path("small.yaml"), overrides))

    return build


@pytest.fixture(scope="session")
def car() -> System:
    """The system of the traffic benchmark."""
    return System.load(ROOT / "examples" / "car.yaml")
