"""Numbers of the dynamics that may be wrong: which they are, and what a factor at one does."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc.diagnostics import SystemFileError, UsageError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.perturbable import perturbable
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.perturbed import PerturbedSystem
from stlc.source import Source

EXAMPLES = Path(__file__).parents[3] / "examples"
SYSTEM = """\
stlc: 1
name: spring
time: {dt: 0.1 s, horizon: 4 steps, integrator: rk4, substeps: 2}
const: {m: 2 kg, k: 3 N/m, wall: 1 m, dead: 0.1 m, pull: "[1 N, 2 N]", lost: 0.8, n: 2, idle: 7 m, late: 3 s}
state:
  p: {size: 2, unit: m, range: [-2, 2]}
  w: {size: 2, unit: m/s, range: [-2, 2]}
  mode: {enum: {free: 0, held: 1}}
  beats: {unit: s, timer: up, reset_when: "beats > late"}
control: {f: {unit: N, range: [-1, 1]}}
def:
  far: p[0] > wall
  spring: k * p[0]
flow:
  p: w
  w: ["(f - spring + pull[0]) / m - 0.3 s^-1 * w[0] * ind(far)", "if p[1] > dead then -2 * pull[1] / m else cos(3 * w[1] * 1 s/m) * 0 m/s^2 + n * 1 m/s^2 * (w[1] * 1 s/m)^2"]
jump:
  - {name: bounce, guard: far, reset: {p: "[wall, p[1]]", w: "[-lost * w[0], w[1]]", mode: 1}}
init: {mixture: [{draw: {p: 0, w: 0, mode: free, beats: 0}}]}
"""  # noqa: E501


def spring(text: str = SYSTEM) -> SystemDecl:
    return parse_system(Source("spring.yaml", text), Path("spring.yaml"))


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("car", []),
        ("maze", ["vy (of dy)"]),
        ("ship_safe", ["0.01 m/rad (of v)", "0.5 (of r)"]),
        ("ship_track", ["0.01 m/rad (of v)", "0.5 (of r)"]),
        ("rover", ["charge (of tau_b)", "1 (of tau_b)"]),
        ("panda", []),
        ("unicycle", []),
    ],
)
def test_what_the_page_says_of_the_benchmarks(name: str, numbers: list[str]) -> None:
    found = [str(each) for each in perturbable(load_system_decl(EXAMPLES / f"{name}.yaml")).numbers]
    assert found == numbers
    page = (EXAMPLES.parent / "docs" / "worlds.md").read_text(encoding="utf-8")
    for number in perturbable(load_system_decl(EXAMPLES / f"{name}.yaml")).numbers:
        assert f"`{number.text}`" in page


def test_conditions_exponents_calls_and_zeros_are_no_numbers_of_the_dynamics() -> None:
    found = {each.text: each.states for each in perturbable(spring()).numbers}
    assert found == {
        "k": ("w",),
        "lost": ("w",),
        "m": ("w",),
        "n": ("w",),
        "pull": ("w",),
        "0.3 s^-1": ("w",),
        "2": ("w",),
        "1 m/s^2": ("w",),
        "1 s/m": ("w",),
    }


def test_a_factor_of_one_changes_nothing() -> None:
    for name in ("maze", "ship_safe", "ship_track", "rover"):
        decl = load_system_decl(EXAMPLES / f"{name}.yaml")
        loose, model = perturbable(decl), System(decl)
        x = model.sample(200, seed=0, dtype=torch.float64)
        low, high = model.control_low.double(), model.control_high.double()
        unit = torch.rand((200, len(low)), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        u = low + (high - low) * unit
        right = PerturbedSystem(loose, torch.ones(200, len(loose.numbers), dtype=torch.float64))
        torch.testing.assert_close(right.step(x, u), model.step(x, u), rtol=1e-13, atol=1e-13)


def test_jumps_with_one_name_stay_apart() -> None:
    second = """\
  - {name: bounce, guard: "p[0] < -wall", reset: {w: "[-lost * w[0] / 2, w[1]]"}}
init:"""
    decl = spring(SYSTEM.replace("init:", second))
    loose, model = perturbable(decl), System(decl)
    x, u = states(model, 200)
    right = PerturbedSystem(loose, torch.ones(200, len(loose.numbers), dtype=torch.float64))
    torch.testing.assert_close(right.step(x, u), model.step(x, u), rtol=1e-13, atol=1e-13)


def states(system: System, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    x = 4 * torch.rand((count, len(system.names)), generator=generator, dtype=torch.float64) - 2
    x[:, 4] = 0.0
    return x, torch.rand((count, 1), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("k", "k: 3 N/m", "k: 3.6 N/m"),
        ("m", "m: 2 kg", "m: 2.4 kg"),
        ("lost", "lost: 0.8", "lost: 0.96"),
        ("pull", "[1 N, 2 N]", "[1.2 N, 2.4 N]"),
        ("0.3 s^-1", "0.3 s^-1", "0.36 s^-1"),
        ("2", "-2 * pull", "-2.4 * pull"),
    ],
)
def test_a_factor_is_another_number_in_the_file(name: str, before: str, after: str) -> None:
    loose = perturbable(spring())
    factors = torch.ones(50, len(loose.numbers), dtype=torch.float64)
    factors[:, [each.text for each in loose.numbers].index(name)] = 1.2
    factors[25:] = 1.0
    wrong, other, model = (
        PerturbedSystem(loose, factors),
        System(spring(SYSTEM.replace(before, after))),
        System(spring()),
    )
    x, u = states(model, 50)
    moved = wrong.step(x, u)
    torch.testing.assert_close(moved[:25], other.step(x, u)[:25], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(moved[25:], model.step(x, u)[25:], rtol=1e-13, atol=1e-13)
    assert not torch.allclose(moved[:25], model.step(x, u)[:25])


def test_a_file_may_say_which_constants_are_uncertain() -> None:
    text = SYSTEM + "test: {uncertain: [wall, k]}\n"
    loose = perturbable(spring(text))
    assert {each.text: each.states for each in loose.numbers} == {"wall": ("w", "p", "mode"), "k": ("w",)}
    other = System(spring(SYSTEM.replace("wall: 1 m", "wall: 1.5 m")))
    x, u = states(other, 50)
    wall = [each.text for each in loose.numbers].index("wall")
    factors = torch.ones(50, 2, dtype=torch.float64)
    factors[:, wall] = 1.5
    torch.testing.assert_close(
        PerturbedSystem(loose, factors).step(x, u), other.step(x, u), rtol=1e-12, atol=1e-12
    )
    assert perturbable(spring(SYSTEM + "test: {uncertain: []}\n")).numbers == ()


ROOM = """\
stlc: 1
name: room
time: {dt: 0.1 s, horizon: 4 steps}
const: {gain: 0.5, cold: 2, more: 2 * gain, idle: 4, none: 0, wall: 2, mild: 20 degC}
state: {x: {range: [-wall, wall]}, y: {range: [-5, 5], clamp: true}, warm: {bool: true}}
table: {heat: {of: [z], at: [0, 1, wall], values: [1.5, gain, 0]}}
held:
  sum: {value: "clip(prev(sum) + 0.25 * x, -1, 1)", before: cold}
  on: {bool: true, value: x > 0.5 * wall}
delay: {late: {of: 3 * x, by: 5 steps}, pipe: {of: y, by: 0.2 s * gain, at_most: 4 steps, before: 7}}
flow: {x: "heat(y) - sum", y: "late + pipe * more + none * x"}
init: {mixture: [{draw: {x: "uniform(-1, 1)", y: 0, warm: true}}]}
"""


def room(end: str = "") -> SystemDecl:
    return parse_system(Source("room.yaml", ROOM + end), Path("room.yaml"))


def test_numbers_of_tables_held_values_and_delays_are_uncertain() -> None:
    loose = perturbable(room())
    assert [each.text for each in loose.numbers] == ["cold", "gain", "more", "none", "1.5", "3", "7", "0.2 s"]
    assert loose.exact == ("wall",)
    assert [each.name for each in loose.started if "?cold" in each.value.columns] == ["sum"]


def test_constants_that_are_computed_from_an_uncertain_one_change_with_it() -> None:
    loose = perturbable(room("test: {uncertain: [gain]}\n"))
    (gain,) = loose.numbers
    assert {"x", "y"} <= set(gain.states)
    factors = torch.full((50, 1), 1.1, dtype=torch.float64)
    other = parse_system(Source("room.yaml", ROOM.replace("gain: 0.5", "gain: 0.55")), Path("room.yaml"))
    x, u = System(other).sample(50, seed=0, dtype=torch.float64), torch.zeros(50, 0, dtype=torch.float64)
    right, wrong = System(other).step(x, u), PerturbedSystem(loose, factors).step(x, u)
    torch.testing.assert_close(wrong, right, rtol=1e-12, atol=1e-12)


def test_the_start_of_held_values_has_the_errors_of_the_agents() -> None:
    loose = perturbable(room("test: {uncertain: [cold]}\n"))
    factors = torch.tensor([[1.0], [0.3]], dtype=torch.float64)
    system = PerturbedSystem(loose, factors)
    x = system.sample(2, seed=0, dtype=torch.float64)
    column = system.names.index("sum")
    torch.testing.assert_close(x[:, column], (2 * factors[:, 0] + 0.25 * x[:, 0]).clamp(-1, 1))
    second = system.of_agents(torch.tensor([1])).sample(1, seed=0, dtype=torch.float64)
    assert float(second[0, column]) == pytest.approx(0.6 + 0.25 * float(second[0, 0]))
    with pytest.raises(UsageError, match="the errors of the 2 agents, and the world draws 3 states"):
        system.sample(3, seed=0)


@pytest.mark.parametrize(
    ("name", "why"),
    [("idle", "nothing that moves reads"), ("none", "is 0"), ("mild", "temperature on a scale")],
)
def test_a_listed_constant_that_changes_nothing_is_refused(name: str, why: str) -> None:
    with pytest.raises(SystemFileError) as caught:
        perturbable(room(f"test: {{uncertain: [gain, {name}]}}\n"))
    (found,) = caught.value.diagnostics
    assert found.code == "S213"
    assert f"`{name}`" in found.message
    assert why in found.message
    assert found.span is not None
    assert found.span.text == name


@pytest.mark.parametrize(("share", "refused"), [(0.1, False), (0.2, True)])
def test_a_fixed_delay_is_refused_if_it_may_be_a_step_longer(share: float, refused: bool) -> None:
    decl = under(room(f"scenario: {{off: {{errors: {{parameters: {share}}}}}}}\n"), "off")
    if not refused:
        assert perturbable(decl).numbers
        return
    with pytest.raises(SystemFileError, match="the delay `late` of 5 steps") as caught:
        perturbable(decl)
    (found,) = caught.value.diagnostics
    assert (found.code, found.span and found.span.text) == ("S212", "5 steps")


def test_who_is_no_constant_is_not_uncertain() -> None:
    with pytest.raises(SystemFileError) as caught:
        spring(SYSTEM + "test: {uncertain: [kk]}\n")
    (found,) = caught.value.diagnostics
    assert found.code == "S101"
    assert "did you mean `k`" in found.help[0]
