"""`stlc lint`: what it says with the system that a file names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stlc.cli.framework.app import main

SYSTEM = """\
stlc: 1
name: cart
time: {dt: 0.2 s, horizon: 20 steps}
const: {limit: 2 m/s}
state:
  x: {unit: m, range: [-5, 5]}
  v: {unit: m/s, range: [-2, 2], clamp: true}
control:
  a: {unit: m/s^2, range: [-1, 1]}
flow: {x: v, v: a}
init: {mixture: [{draw: {x: "uniform(-4, 4)", v: 0}}]}
"""


def codes(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    main([*words, "--json"])
    return [finding["code"] for finding in json.loads(capsys.readouterr().out)["diagnostics"]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart.yaml").write_text(SYSTEM)
    return tmp_path


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("state signal y [m]\nrequire r: always[0, T] y < 1 m", "E103"),
        ("const limit = 3 m/s\nstate signal v [m/s]\nrequire r: always[0, T] v < limit", "E104"),
        ("state signal x [m]\nrequire r: eventually[0, T] always[0 s, 1 s] x < 1 m", "E306"),
        ("state signal x [m]\nrequire r: always[0 s, 9 s] x < 1 m", "E306"),
        ("state signal x [m]\nstate signal v [m/s]\nrequire r: always[0, T] (v > 0 -> x / v > 4 s)", "W402"),
        ("state signal v [m/s]\nrequire r: v > 3 m/s -> always[0, T] v < 1 m/s", "W503"),
        ("state signal x [m]\nrequire r: x < 3 m", None),
    ],
)
def test_what_the_compiler_says_of_it(folder, capsys, body, code):
    (folder / "r.stl").write_text(f'system "cart.yaml"\n{body}\n')
    wanted = [] if code is None else [code]
    assert codes(capsys, "lint", "r.stl") == wanted
    assert codes(capsys, "compile", "r.stl") == wanted


def test_a_system_that_is_wrong_or_not_there(folder, capsys):
    (folder / "r.stl").write_text(
        'system "tram.yaml"\nstate signal x [m]\nrequire r: always[0 s, 1 s] z < 1 m\n'
    )
    assert codes(capsys, "lint", "r.stl") == ["U102", "E101"]
    (folder / "tram.yaml").write_text(SYSTEM.replace("flow:", "flaw:"))
    assert "S101" in codes(capsys, "lint", "r.stl")
    assert codes(capsys, "lint", "r.stl", "--system", "cart.yaml") == ["E101"]


def test_the_option_comes_before_the_file(folder, capsys):
    (folder / "r.stl").write_text('system "tram.yaml"\nstate signal x [m]\nrequire r: always[0, T] x < 1 m\n')
    assert codes(capsys, "lint", "r.stl", "--system", "cart.yaml") == []


def test_a_repair_keeps_what_it_would_change(folder, capsys):
    path = folder / "r.stl"
    path.write_text("signal x\nrequire r: !x < 3\n")
    assert codes(capsys, "lint", "r.stl", "--fix") == ["W311"]
    assert path.read_text() == "signal x\nrequire r: not x < 3\n"
    main(["lint", "r.stl"])
    assert "can be repaired" not in "".join(capsys.readouterr())
