"""The six specifications of the paper: each names its system, resolves on it, and is as the tools want it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.compile.pipeline import compile_spec
from stlc.dynamics.load import load_system_decl
from stlc.grammar.format.format import format_text
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source

ROOT = Path(__file__).parent.parent
SYSTEMS = {
    "traffic": "car",
    "reach_n_avoid": "maze",
    "ship_safe": "ship_safe",
    "ship_track": "ship_track",
    "navigation": "rover",
    "manipulation": "panda",
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_benchmark_is_whole(name: str) -> None:
    path = ROOT / "specs" / f"{name}.stl"
    source = Source(f"specs/{name}.stl", path.read_text())
    spec = Spec.parse(source)
    assert spec.name == name
    assert spec.system == f"../examples/{SYSTEMS[name]}.yaml"
    decl = load_system_decl(ROOT / "examples" / f"{SYSTEMS[name]}.yaml")
    assert (decl.name, decl.spec) == (SYSTEMS[name], path)
    assert decl.warnings == ()
    assert len(decl.source.text.splitlines()) <= 150
    assert (decl.train.lr, decl.train.batch, decl.train.samples, decl.train.method) == (None,) * 4
    compiled = compile_spec(spec, grid=decl.grid, interface=decl.interface())
    assert compiled.warnings == ()
    assert compiled.safety
    assert format_text(source) == source.text


def test_a_leader_that_turns_off_is_no_collision() -> None:
    monitor = Monitor(ROOT / "specs/traffic.stl")
    signals = {name: np.zeros(60) for name in ("x", "v", "sign", "tau", "v_lead", "yielding")}
    dx = np.linspace(5.0, 2.0, 60)
    dx[20:] = -1.0  # the sentinel: from here on there is no leading car
    assert monitor.check(signals | {"dx": dx})["no_collision"].satisfied
    dx[15] = 0.9
    assert not monitor.check(signals | {"dx": dx})["no_collision"].satisfied
