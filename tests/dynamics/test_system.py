"""Further parts of a system: controls, observations, objective, health, description."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from stlc.compile.semantics.switch import Tanh
from stlc.diagnostics import SystemFileError
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.dynamics.model.controls import raw_width, squash
from stlc.dynamics.system import PROBED, System
from stlc.source import Source

Make = Callable[..., System]

MIXED = """\
time: {dt: 0.1 s, horizon: 4 steps}
state: {x: {unit: m, range: [0, 9]}, y: {unit: m, role: env}, wet: {bool: true}}
control:
  gas: {range: [0, 4], squash: clip}
  steer: {unit: rad, range: [-3.141592653589793, 3.141592653589793], squash: angle}
  brake: {range: [-1, 3], squash: tanh, levels: [-1, 0, 3]}
flow: {x: gas * 1 m/s}
init: {mixture: [{name: only, draw: {x: 1, y: 2, wet: false}}]}
objective:
  terms:
    - {name: far, weight: 2, expr: x}
    - {name: effort, weight: 0.5, expr: gas^2}
    - {name: late, weight: 1, expr: sat * t + 0 * k + 0 * rho}
    - {name: ignored, weight: 0, expr: log(-x / 1 m)}
policy:
  observe: [y - x, "if wet then 1 else 0", x > 1.5]
"""


def test_squash_maps_onto_the_ranges(make: Make) -> None:
    controls = make(MIXED).decl.controls
    assert raw_width(controls) == 4
    raw = torch.tensor(
        [[0.0, 0.0, 1.0, 0.0], [9.0, -1.0, 0.0, 9.0], [-9.0, 0.0, -2.0, -9.0], [0.5, 1.0, 1.0, 0.0]]
    )
    out = squash(raw, controls)
    want = torch.tensor([[2, math.pi / 2, 1], [4, math.pi, 3], [0, -math.pi / 2, -1], [3, math.pi / 4, 1]])
    assert torch.allclose(out, want, atol=1e-4)
    assert controls[2].levels == (-1.0, 0.0, 3.0)


def test_squash_keeps_shapes_dtypes_and_gradients(make: Make, car: System) -> None:
    for controls in (make(MIXED).decl.controls, car.decl.controls):
        raw = torch.zeros(2, 3, 5, raw_width(controls), dtype=torch.float64, requires_grad=True)
        out = squash(raw, controls)
        assert out.shape == (2, 3, 5, len(controls))
        assert out.dtype == torch.float64
        out.sum().backward()
        assert raw.grad is not None
        assert torch.isfinite(raw.grad).all()


def test_observations_are_expressions(make: Make) -> None:
    system = make(MIXED)
    assert system.observed_count == 3
    x = torch.tensor([[[1.0, 5.0, 1.0], [2.0, 5.0, 0.0]]])
    assert system.observe(x).tolist() == [[[4, 1, 0], [3, 0, 1]]]


def test_without_observations_everything_is_seen(car: System) -> None:
    x = car.sample(3, seed=0)
    assert car.observe(x) is x


def test_terms_are_weighted_means_over_time(make: Make) -> None:
    system = make(MIXED)
    x0 = torch.tensor([[1.0, 2, 0], [2.0, 2, 0]])
    u = torch.ones(2, 4, 3)
    columns = system.rollout_columns(x0, u)
    cost = system.performance(columns, torch.tensor([1.0, 0.0]), u=u)
    far = 2 * (x0[:, 0] + 0.2)
    assert torch.allclose(cost, far + 0.5 + torch.tensor([0.2, 0.0]))
    with pytest.raises(ValueError, match="controls"):
        system.performance(columns, torch.tensor([1.0, 0.0]))


BEGUN = """\
time: {dt: 1 s, horizon: 2 steps}
state: {p: {size: 2, unit: m}, tau: {unit: s}}
control: {u: {unit: m/s, range: [-9, 9]}}
flow: {p: "[u, 0]", tau: -1}
init: {mixture: [{draw: {p: "[0, 0]", tau: 0}}]}
objective: {terms: [{expr: "if tau_start > 0 s then norm(p - p_start) else p[1]"}]}
"""


def test_a_term_may_read_where_a_state_began(make: Make) -> None:
    system = make(BEGUN)
    x0 = torch.tensor([[5.0, 7.0, 1.0], [5.0, 7.0, -1.0]])
    columns = system.rollout_columns(x0, torch.full((2, 2, 1), 3.0))
    cost = system.performance(columns, torch.ones(2))
    assert cost.tolist() == pytest.approx([3.0, 7.0])  # 0, 3 and 6 m from where it began, though tau runs out


def test_performance_has_a_gradient_but_the_verdict_has_none(car: System) -> None:
    x0 = car.sample(64, seed=0)
    u = torch.zeros(64, 25, 1, requires_grad=True)
    sat = torch.ones(64, requires_grad=True)
    car.performance(car.rollout_columns(x0, u), sat).sum().backward()
    assert u.grad is not None
    assert (u.grad.abs().sum((1, 2)) > 0).double().mean() > 0.9
    assert sat.grad is None


def test_dynamics_that_explode_are_reported(make: Make) -> None:
    system = make("""\
time: {dt: 1 s, horizon: 60 steps}
state: {x: {}}
control: {u: {range: [-1, 1]}}
flow: {x: exp(x)}
init: {mixture: [{draw: {x: 1}}]}
""")
    with pytest.raises(SystemFileError, match="S302") as caught:
        system.probe()
    assert caught.value.exit_code == 3
    span = caught.value.diagnostics[0].span
    assert span is not None
    assert span.text == "x"


def test_a_healthy_system_probes_clean(car: System) -> None:
    assert car.probe() == ()


@pytest.mark.parametrize("switch", [None, Tanh()])
def test_rollouts_do_not_write_into_their_inputs(car: System, switch: Tanh | None) -> None:
    x0, u = car.sample(32, seed=0), torch.ones(32, 25, 1)
    copies = x0.clone(), u.clone()
    _ = car.rollout(x0, u, switch) if switch else car.rollout(x0, u)
    assert torch.equal(x0, copies[0])
    assert torch.equal(u, copies[1])


def test_the_hash_follows_text_and_overrides(make: Make) -> None:
    one, same, other = make(MIXED), make(MIXED), make(MIXED + "# changed\n")
    assert one.decl.hash == same.decl.hash != other.decl.hash
    assert len(one.decl.hash) == 64
    assert make(MIXED, train__seed="3").decl.hash != one.decl.hash


def test_the_description_is_a_table(make: Make) -> None:
    windy = "scenario: {calm: {override: {x: 1}}, windy: {doc: A gust., override: {x: 2}}}\n"
    assert make(MIXED + windy).decl.describe().splitlines() == [
        "small",
        "dt = 0.1 s, T = 4 steps = 0.4 s, euler",
        "",
        "states",
        "  x    [m]  [0, 9]  dx/dt = gas * 1 m/s",
        "  y    [m]  any     set from outside",
        "  wet       bool    constant",
        "",
        "controls",
        "  gas           [0, 4]               clip",
        "  steer  [rad]  [-3.14159, 3.14159]  angle",
        "  brake         [-1, 3]              tanh",
        "",
        "initial situations",
        "  only  100 %",
        "",
        "scenarios",
        "  calm",
        "  windy  A gust.",
    ]


def test_a_declaration_needs_no_torch() -> None:
    code = (
        "import sys; from stlc.dynamics.load import load_system_decl;"
        "print(load_system_decl('examples/car.yaml').describe()); assert 'torch' not in sys.modules"
    )
    root = Path(__file__).parent.parent.parent
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=False)
    assert done.returncode == 0, done.stderr
    assert "leave_stop_line  when sign == stop and x > 0" in done.stdout


def test_a_probe_of_a_long_horizon_is_short(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    text = MIXED.replace("horizon: 4 steps", "horizon: 99999 steps")
    seen: list[int] = []
    rollout = System.rollout

    def watched(self: System, x0: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        seen.append(u.shape[1])
        return rollout(self, x0, u)

    monkeypatch.setattr(System, "rollout", watched)
    make(text).probe(4)
    assert seen == [PROBED]


def test_what_is_learnt_does_not_follow_comments_and_deployment() -> None:
    path = Path(__file__).parents[2] / "examples" / "ship_track.yaml"
    text = path.read_text()

    def learnt(old: str = "", new: str = "") -> str:
        assert old in text
        return parse_system(Source("s.yaml", text.replace(old, new, 1) if old else text), path).learnt

    assert learnt("steps: 200", "steps: 100") == learnt("dt: 0.15 s", "dt: 0.150 s") == learnt()
    assert learnt("bins: 3", "bins: 5") == learnt("doc: Ship", "doc: A ship") == learnt()
    changed = [("substeps: 2", "substeps: 1"), ("0.5 * rudder", "0.6 * rudder"), ("y1, r1, tau]", "y1, r1]")]
    changed += [
        ("randint(8, 14)", "randint(8, 15)"),
        ("gamma: 0.5 ", "gamma: 0.4 "),
        ("D:     4", "D:     5"),
    ]
    assert len({learnt(), *(learnt(*change) for change in changed)}) == len(changed) + 1


@pytest.mark.parametrize(
    ("name", "hashed"),
    [
        ("car", "42ca1189f4c1eb78642ba2c93e3fac2f72f05edd3255b11fa8d48328c09c3836"),
        ("maze", "a64209507066dc9ed61a6474c508bae0ba81cfbcf8372375aba16c69a5ba51ff"),
        ("panda", "4153a81654698a7d6226bf10019d3defe860f30eaab3658bcaa507329e57d170"),
        ("rover", "ff3e9e4e7051ab910eff381c70bc51345bc114ab56bac51369c04d3fb67cea83"),
        ("ship_safe", "5d13634a8493039a5ffbaa1dd86286fbff217286d8fad025d1bff86e6640539e"),
        ("ship_track", "8d6b97b2a52937e7b1ea9b0c1d34f5f7fae7263d0f039762a742af6811bdea1f"),
        ("unicycle", "27d4ecf200a01d475c7f474cf4627b9ea2c9b6bca38b6e8adbd761b85aa1b055"),
    ],
)
def test_what_is_learnt_has_the_hash_of_earlier_releases(name: str, hashed: str) -> None:
    path = Path(__file__).parents[2] / "examples" / f"{name}.yaml"
    assert load_system_decl(path).learnt == hashed
    commented = Source(str(path), "# a comment moves all places\n" + path.read_text())
    assert parse_system(commented, path).learnt == hashed
