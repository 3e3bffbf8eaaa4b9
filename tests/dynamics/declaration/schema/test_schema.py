"""Meaning of well-formed system files, and of `--set` for them."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic, StlcError, SystemFileError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.source import Source
from stlc.units import Unit
from tests.dynamics.declaration.schema.test_schema_diagnostics import GOOD

Make = Callable[..., System]


def parsed(text: str = GOOD, **overrides: str):  # type: ignore[no-untyped-def]
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    return parse_system(Source("cart.yaml", text), Path("cart.yaml"), changes)


def test_the_declaration_holds_what_was_written() -> None:
    decl = parsed()
    assert (decl.name, decl.dt, decl.horizon, decl.integrator, decl.substeps) == (
        "cart",
        Fraction(1, 10),
        20,
        "euler",
        1,
    )
    assert decl.constants["vmax"] == (4.0, Unit.parse("m/s"))
    assert [column.kind for column in decl.signature.columns] == ["real", "real", "enum", "bool"]
    assert [column.role for column in decl.signature.columns] == ["state", "state", "env", "env"]
    v = decl.signature["v"]
    assert (v.low, v.high, v.fact) == (-4.0, 4.0, True)
    assert decl.clamps == {"v": (-4.0, 4.0)}
    assert decl.signature["gear"].labels == (("low", 0.0), ("high", 1.0))
    assert decl.train.budget == 60
    assert decl.train.lr == 1e-3
    assert decl.policy.hidden == (64, 64)
    assert decl.backup.lengths == (1, 2)
    assert decl.test.events[0].every == 20
    assert decl.test.events[0].sets[0].value == ir.Const(1.0)
    assert decl.jumps[0].sharpness == 100
    interface = decl.interface()
    assert interface.signature is decl.signature
    assert interface.places["v"].text == "v"
    assert decl.grid.horizon == 20


@pytest.mark.parametrize(
    ("written", "steps"),
    [("20 steps", 20), ("20", 20), ("2 s", 20), ("2000 ms", 20), ("0.1 s", 1), ("1.3 s", 13)],
)
def test_horizons_are_steps_or_times(written: str, steps: int) -> None:
    assert parsed(GOOD.replace("20 steps", written).replace("T0: [1, 2]", "T0: 1")).horizon == steps


@pytest.mark.parametrize(
    ("written", "dt"),
    [("0.1 s", Fraction(1, 10)), ("100 ms", Fraction(1, 10)), ("1 s / 30", Fraction(1, 30))],
)
def test_steps_are_exact(written: str, dt: Fraction) -> None:
    text = GOOD.replace("0.1 s", written).replace("every: 2 s", "every: 3 steps")
    assert parsed(text).dt == dt


def test_events_may_wait_for_edges_states_and_times() -> None:
    events = """\
  events:
    - {when: rise(x > 1 and wet), set: {x: "uniform(0, 1)"}}
    - {when: fall(near_wall), set: {gear: "choice(low, high)"}}
    - {at: 0, set: {v: 0.1 m/s^2 * t}}
    - {at: 1.5 s, set: {wet: x > 2}}
"""
    test = parsed(GOOD[: GOOD.index("  events:")] + events).test
    assert [(event.name, event.edge, event.at) for event in test.events] == [
        ("event 1", "rise", None),
        ("event 2", "fall", None),
        ("event 3", None, 0),
        ("event 4", None, 15),
    ]


def test_overrides_are_read_like_written_fields() -> None:
    decl = parsed(
        wall="7 m", train__lr="3e-4", policy__hidden="[32]", init__mixture__0__weight="3", name="fast"
    )
    assert decl.constants["wall"][0] == 7.0
    assert (decl.train.lr, decl.policy.hidden, decl.init.mixture[0].weight, decl.name) == (
        3e-4,
        (32,),
        3.0,
        "fast",
    )
    assert parsed(objective__gamma="0.1").objective.gamma == 0.1


def test_names_of_the_specification_are_left_to_it() -> None:
    assert parsed(T_red="3 s").constants == parsed().constants


@pytest.mark.parametrize(
    ("key", "value", "code", "help_"),
    [
        ("train.lrr", "1", "S101", "did you mean `lr`"),
        ("trian.lr", "1", "S101", "did you mean `train`"),
        ("train.lr", "fast", "S103", ""),
        ("wall", "7 s", "E203", ""),
        ("wall", "[", "S100", ""),
        ("name.first", "x", "S101", ""),
    ],
)
def test_overrides_that_make_no_sense_point_at_themselves(
    key: str, value: str, code: str, help_: str
) -> None:
    with pytest.raises(SystemFileError) as caught:
        parse_system(Source("cart.yaml", GOOD), Path("cart.yaml"), {key: value})
    finding = caught.value.diagnostics[0] if code != "E203" else caught.value.diagnostics[-1]
    assert code in {each.code for each in caught.value.diagnostics}
    assert help_ in " ".join(finding.help)


def test_the_world_can_be_switched_off(car: System) -> None:
    assert System.load(car.decl.path, {"test.world": "null"}).decl.test.world is None


def test_a_system_is_found_by_name(monkeypatch: pytest.MonkeyPatch, car: System) -> None:
    monkeypatch.chdir(car.decl.path.parent.parent)
    assert System.load("car.yaml").decl.hash == car.decl.hash


@settings(max_examples=36)
@given(st.data())
def test_damaged_files_give_diagnostics_and_nothing_else(data: st.DataObject) -> None:
    text = GOOD
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(text)))
        stop = min(len(text), start + data.draw(st.integers(0, 12)))
        text = (
            text[:start]
            + data.draw(st.text(alphabet="ab01 :,-[]{}&*!|>\"'#\n\t()^/@%`=<\x00é", max_size=6))
            + text[stop:]
        )
    for finding in findings(text):
        assert finding.span is None or 0 <= finding.span.start <= finding.span.end
        assert finding.span is None or finding.span.end <= len(finding.span.source.text)


def findings(text: str) -> tuple[Diagnostic, ...]:
    try:
        parse_system(Source("cart.yaml", text), Path("cart.yaml"))
    except StlcError as error:
        return error.diagnostics
    return ()
