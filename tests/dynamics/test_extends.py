"""A system file that begins as another one."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.diagnostics import StlcError
from stlc.dynamics.load import load_system_decl

BASE = """\
stlc: 1
name: cart
spec: cart.stl
time: {dt: 0.1 s, horizon: 20 steps}
const: {vmax: 4 m/s, wall: 5 m}
state: {x: {unit: m}, v: {unit: m/s, range: [-vmax, vmax]}}
control: {u: {unit: m/s^2, range: [-3, 3]}}
flow: {x: v, v: u}
jump: [{guard: x > wall, reset: {v: 0}}]
init: {mixture: [{draw: {x: 0, v: 0}}]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "deep").mkdir()
    (tmp_path / "cart.yaml").write_text(BASE)
    return tmp_path


def test_what_it_says_itself_wins_entry_by_entry(folder: Path) -> None:
    own = "extends: ../cart.yaml\nname: fast\nconst: {vmax: 9 m/s}\nflow: {v: 2 * u}\njump: []\n"
    (folder / "deep" / "fast.yaml").write_text(own)
    decl = load_system_decl(folder / "deep" / "fast.yaml", {"wall": "6 m"})
    assert decl.name == "fast"
    assert {name: value for name, (value, _) in decl.constants.items()} == {"vmax": 9.0, "wall": 6.0}
    assert (decl.signature["v"].low, decl.signature["v"].high) == (-9.0, 9.0)
    assert [assign.text for assign in decl.flow] == ["v", "2 * u"]
    assert decl.jumps == ()
    assert decl.spec == folder / "cart.stl"
    assert decl.places["x"].source.name.endswith("cart.yaml")
    assert decl.places["vmax"].source.name.endswith("cart.yaml") is False
    before = decl.hash
    (folder / "cart.yaml").write_text(BASE.replace("20 steps", "30 steps"))
    assert load_system_decl(folder / "deep" / "fast.yaml", {"wall": "6 m"}).hash != before


def test_a_run_keeps_the_files_beside_each_other(folder: Path, tmp_path: Path) -> None:
    (folder / "deep" / "fast.yaml").write_text("extends: ../cart.yaml\nname: fast\n")
    decl = load_system_decl(folder / "deep" / "fast.yaml")
    run = tmp_path / "run"
    run.mkdir()
    (run / "system.yaml").write_text(decl.source.text)
    for name, path in decl.files.items():
        (run / name).write_bytes(path.read_bytes())
    (folder / "cart.yaml").unlink()
    assert load_system_decl(run / "system.yaml").hash == decl.hash


def test_an_error_is_shown_where_it_is_written(folder: Path) -> None:
    (folder / "cart.yaml").write_text(BASE.replace("x: v,", "x: w,"))
    (folder / "fast.yaml").write_text("extends: cart.yaml\nname: fast\n")
    with pytest.raises(StlcError) as caught:
        load_system_decl(folder / "fast.yaml")
    (finding,) = caught.value.diagnostics
    assert finding.span is not None
    assert finding.span.source.name.endswith("cart.yaml")
    assert finding.span.text == "w"


@pytest.mark.parametrize("target", ["fast.yaml", "nowhere.yaml", "list.yaml", "back.yaml", "loop.yaml"])
def test_a_chain_that_leads_nowhere_is_said(folder: Path, target: str) -> None:
    (folder / "list.yaml").write_text("- 1\n")
    (folder / "back.yaml").write_text("extends: fast.yaml\n")
    (folder / "loop.yaml").symlink_to("loop.yaml")
    (folder / "fast.yaml").write_text(f"extends: {target}\n" + BASE)
    with pytest.raises(StlcError) as caught:
        load_system_decl(folder / "fast.yaml")
    assert [finding.code for finding in caught.value.diagnostics] == ["S209"]


def test_a_judge_may_be_a_link_back_to_itself(folder: Path) -> None:
    (folder / "loop.stl").symlink_to("loop.stl")
    (folder / "judged.yaml").write_text(BASE + "test: {judge: loop.stl}\n")
    assert not load_system_decl(folder / "judged.yaml").judges_by(folder / "cart.stl")


def test_an_entry_that_is_nothing_takes_one_away(folder: Path) -> None:
    (folder / "cart.yaml").write_text(BASE.replace("control: {", "control: {brake: {range: [0, 1]}, "))
    whole = load_system_decl(folder / "cart.yaml")
    assert [control.name for control in whole.controls] == ["brake", "u"]
    assert [(w.code, w.message) for w in whole.warnings] == [
        ("W603", "the control `brake` has no effect: no flow and no jump reads it")
    ]
    (folder / "plain.yaml").write_text("extends: cart.yaml\nname: plain\ncontrol: {brake: ~}\njump: ~\n")
    plain = load_system_decl(folder / "plain.yaml")
    assert [control.name for control in plain.controls] == ["u"]
    assert (plain.jumps, plain.warnings) == ((), ())
