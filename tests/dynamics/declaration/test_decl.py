"""Messages of a system file to specifications: names that they cannot use, and units that are missing."""

from __future__ import annotations

import pytest

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import SpecError
from stlc.dynamics.load import load_system_decl
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 10 steps}
def: {twice: x * 2}
table:
  pull: {of: {x: m}, unit: m/s, at: [0, 1], values: [0, 1]}
state: {x: {unit: m, range: [-2 m, 2 m]}}
control: {u: {size: 2, unit: m/s, range: [-1, 1]}}
flow: {x: "u[0] + u[1]"}
init: {mixture: [{draw: {x: 0 m}}]}
"""


@pytest.fixture(name="decl")
def _decl(tmp_path):
    path = tmp_path / "cart.yaml"
    path.write_text(SYSTEM)
    return load_system_decl(path)


@pytest.mark.parametrize(
    ("text", "code", "advice"),
    [
        ("signal u: real[2] [m/s]\nrequire r: always u[0] > 0 m/s", "E103", "`u` is a control of "),
        ("signal x [m]\nrequire r: always u[0] > 0 m/s", "E101", "`u` is a control of "),
        ("signal x [m]\nrequire r: always twice > 0 m", "E101", "`def twice = …`"),
        ("signal x [m]\nrequire r: always pull(x) > 0 m/s", "E101", "`pull` is a table of "),
    ],
)
def test_names_that_no_requirement_can_use_are_explained(decl, text, code, advice):
    with pytest.raises(SpecError) as caught:
        compile_spec(
            Spec.parse(Source("s.stl", text)), grid=Grid(decl.dt, decl.horizon), interface=decl.interface()
        )
    (finding,) = caught.value.diagnostics
    assert finding.code == code
    assert advice in finding.help[0]


def test_a_state_without_a_unit_whose_flow_has_one_is_a_warning(tmp_path, decl):
    assert decl.warnings == ()
    path = tmp_path / "bare.yaml"
    lines = [line for line in SYSTEM.splitlines() if not line.startswith(("def", "table", "  pull"))]
    path.write_text(
        "\n".join(lines).replace("unit: m, range: [-2 m, 2 m]", "range: [-2, 2]").replace("0 m}", "0}")
    )
    (finding,) = load_system_decl(path).warnings
    assert finding.code == "W108"
    assert "derivative of `x`" in finding.message
