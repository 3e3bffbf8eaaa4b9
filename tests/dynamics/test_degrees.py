"""Systems with states in degrees Celsius: they move, are drawn and disturbed as in kelvin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.text import show_number
from stlc.diagnostics import StlcError
from stlc.dynamics.system import System

Make = Callable[..., System]

ROOM = """\
time: {{dt: 60 s, horizon: 30 steps, integrator: rk4{discrete}}}
const: {{loss: 1 / (2000 s), hot: 24 degC}}
param:
  cold: {{unit: {unit}, draw: "normal(5 degC, 1 K)"}}
  other: {{unit: {unit}, range: [0 degC, 5 degC]}}
state:
  temp: {{unit: {unit}, range: [0 degC, 313.15 K]}}
  outside: {{unit: {unit}, range: [-20 degC, 40 degC]}}
  wall: {{unit: K, range: [10 degC, 30 degC]}}
control:
  power: {{range: [0, 1]}}
  wanted: {{unit: {unit}, range: [15 degC, 25 degC]}}
flow:
  temp: {temp}
  wall: {wall}
jump:
  - {{guard: temp > hot, reset: {{temp: "hot - 5 K"}}}}
init:
  mixture:
    - draw: {{temp: "normal(20 degC, 0.5 K)", outside: "uniform(0 degC, 10 degC)", wall: "temp - 1 K"}}
policy: {{observe: [temp > wanted, "(temp - wall) / 1 K"]}}
scenario:
  noisy: {{noise: {{temp: "normal(0, 0.1 K)"}}, disturb: {{temp: {disturb}}}}}
  winter: {{override: {{outside: -10 degC}}, const: {{hot: 20 degC}}}}
"""
RATES = {
    "temp": "loss * (outside - temp) + 0.01 K/s * power + loss * (wanted - temp)",
    "wall": "loss * (temp - wall)",
    "disturb": "-0.001 K/s",
    "discrete": "",
}
STEPS = {
    "temp": "temp + 60 s * loss * (outside - temp) + 0.6 K * power + 60 s * loss * (wanted - temp)",
    "wall": "wall + 60 s * loss * (temp - wall)",
    "disturb": "-0.06 K",
    "discrete": ", discrete: true",
}
SHIFT = 273.15


@pytest.mark.parametrize("flow", [RATES, STEPS], ids=["rates", "steps"])
def test_a_room_moves_as_in_kelvin(make: Make, flow: dict[str, str]) -> None:
    celsius, kelvin = (make(ROOM.format(unit=unit, **flow)) for unit in ("degC", "K"))
    shift = torch.tensor([SHIFT if name != "wall" else 0.0 for name in celsius.names], dtype=torch.float64)
    starts = [system.sample(50, seed=1, dtype=torch.float64) for system in (celsius, kelvin)]
    torch.testing.assert_close(starts[0] + shift, starts[1])
    u = torch.rand(50, 30, 2, dtype=torch.float64) * torch.tensor([1.0, 10.0]) + torch.tensor([0.0, 15.0])
    moved = [
        celsius.rollout(starts[0], u),
        kelvin.rollout(starts[1], u + torch.tensor([0.0, SHIFT])),
    ]
    torch.testing.assert_close(moved[0] + shift, moved[1])
    assert float(moved[0][:, :, celsius.names.index("temp")].max()) <= 25
    for one, other in zip(celsius.signature.columns, kelvin.signature.columns, strict=True):
        offset = 0.0 if one.name == "wall" else SHIFT
        assert (one.low + offset, one.high + offset) == pytest.approx((other.low, other.high))


@pytest.mark.parametrize("flow", [RATES, STEPS], ids=["rates", "steps"])
def test_what_is_added_is_a_difference(make: Make, flow: dict[str, str]) -> None:
    noisy, winter = make(ROOM.format(unit="degC", **flow)).decl.scenarios
    assert [show_number(each.value) for each in noisy.noise] == ["normal(0, 0.1)"]
    assert [each.value for each in noisy.disturb] == [ir.Const(float(flow["disturb"].split()[0]))]
    assert [each.value for each in winter.override] == [ir.Const(-10.0)]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("normal(0, 0.1 K)", "normal(0, 0.1 degC)", "deviation"),
        ("normal(0, 0.1 K)", "0.1 degC", "`0.1 K`"),
        ("-0.06 K", "-0.06 degC", "`-0.06 K`"),
        ("normal(20 degC, 0.5 K)", "normal(20, 0.5 K)", "no temperature in [degC]"),
        ("normal(20 degC, 0.5 K)", "normal(20 degC, 0.5 degC)", "`0.5 K`"),
        ("hot - 5 K", "hot - temp", "no temperature in [degC]"),
        ("0.6 K * power", "0.6 degC * outside", "cannot add"),
        ("wanted: {unit: degC", "wanted: {unit: degC/s", "write `K/s`"),
        ("wanted: {unit: degC", "wanted: {unit: celsius", "are written `degC`"),
    ],
)
def test_what_is_none_of_them(make: Make, before: str, after: str, words: str) -> None:
    text = ROOM.format(unit="degC", **STEPS)
    assert before in text
    with pytest.raises(StlcError) as caught:
        make(text.replace(before, after))
    findings = caught.value.diagnostics
    assert any(words in " ".join((finding.message, *finding.help)) for finding in findings)


def test_a_share_of_a_temperature_is_not_wrong(make: Make) -> None:
    from stlc.dynamics.declaration.perturbable import perturbable

    found = perturbable(make(ROOM.format(unit="degC", **RATES)).decl)
    assert {each.text for each in found.numbers} == {"loss", "0.01 K/s", "5 K"}
