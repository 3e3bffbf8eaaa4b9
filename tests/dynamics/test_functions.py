"""Functions from outside: declared in a specification, named in a system, loaded when they are needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.controller.problem.task import Task
from stlc.diagnostics import SpecError, StlcError, SystemFileError, UsageError
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source

DATA = Path(__file__).parent.parent / "data"
ARM = DATA / "arm.yaml"

HEAD = """
extern fn hand(q: real[2]) -> real[2] [m]
extern fn span(a: real, b: real) -> real
extern fn wrong(q: real[2]) -> real[2] [m]
extern fn broken(q: real[2]) -> real
signal a, b [rad]
def q = [a, b]
region post = circle([1, 1], 0.5)
"""


def task(text: str) -> Task:
    return Task.of(Spec.parse(Source("arm.stl", HEAD + text)), System.load(ARM))


def expected(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    hand = [2 * x - x**3 / 6 for x in (a, b)]
    return (torch.hypot(hand[0] - 1, hand[1] - 1) - 0.5).amin(1)


def test_a_plan_is_judged_with_them_and_gradients_pass_through() -> None:
    arm = task("require clear: always[0, T] hand(q) not in post")
    x = torch.randn(16, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x.requires_grad_()
    rho = arm.robustness(x)
    torch.testing.assert_close(rho, expected(x[..., 0], x[..., 1]))
    (grad,) = torch.autograd.grad(rho.sum(), x)
    (wanted,) = torch.autograd.grad(expected(x[..., 0], x[..., 1]).sum(), x)
    torch.testing.assert_close(grad, wanted)


def test_numbers_pass_one_by_one() -> None:
    arm = task("require r: always[0, T] span(a, b) < 4")
    x = torch.randn(8, 6, 2)
    torch.testing.assert_close(arm.robustness(x), (4 - x[..., 0] ** 2 - x[..., 1]).amin(1))
    constant = task("require r: always[0, T] span(2, 1) + a < 9")
    torch.testing.assert_close(constant.robustness(x), (4 - x[..., 0]).amin(1))


@pytest.mark.parametrize(
    "text", ["hand(q) not in post", "span(a, b) < 4", "freeze h = hand(q) in dist(h, hand(q)) < 3"]
)
def test_a_trace_is_judged_by_the_system_that_is_given(text: str) -> None:
    spec = Spec.parse(Source("arm.stl", f"{HEAD}require r: always[0, T] {text}"))
    rng = np.random.default_rng(1)
    signals = {name: rng.normal(size=(3, 6)) for name in "ab"}
    found = Monitor(spec, system=ARM).robustness(signals, at=0)
    x = torch.from_numpy(np.stack([signals["a"], signals["b"]], -1))
    np.testing.assert_allclose(found, Task.of(spec, System.load(ARM)).robustness(x).numpy())


def test_nothing_is_loaded_to_compile_or_lint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.spec_from_file_location", lambda *_: pytest.fail("loaded"))
    decl = load_system_decl(ARM)
    spec = Spec.parse(Source("arm.stl", f"{HEAD}require r: hand(q) not in post"))
    compiled = compile_spec(spec, grid=Grid(decl.dt, decl.horizon), interface=decl.interface())
    assert compiled.requirements
    with pytest.raises(UsageError) as caught:
        Monitor(spec, dt=0.1).check({"a": [0.0], "b": [0.0]})
    assert [finding.code for finding in caught.value.diagnostics] == ["E107"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("require r: wrong(q) not in post", "gives an array (1, 4, 1), declared is (1, 4, 2)"),
        ("require r: broken(q) > 0", "ZeroDivisionError: torch.Size([1, 4, 2])"),
    ],
)
def test_what_fails_inside_is_told(text: str, words: str) -> None:
    arm = task(text)
    with pytest.raises(SystemFileError) as caught:
        arm.robustness(torch.zeros(4, 6, 2))
    (finding,) = caught.value.diagnostics
    assert finding.code == "S208"
    assert words in " ".join((finding.message, *finding.note))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("extern fn other(q: real[2]) -> real\nrequire r: other([1, 2]) > 0", "E107"),
        ("require r: hand(a) not in post", "E205"),
        ("require r: hand([a, b, a]) not in post", "E205"),
        ("require r: hand(q, q) not in post", "E105"),
        ("require r: hand(q = q) not in post", "E105"),
        ("require r: hand not in post", "E105"),
        ("require r: norm(hand(q)) > 1 s", "E203"),
        ("extern fn f(m: Mode) -> real\nrequire r: f(a) > 1", "E101"),
    ],
)
def test_misuse_is_found_when_both_are_joined(text: str, code: str) -> None:
    with pytest.raises(SpecError) as caught:
        task(text)
    assert code in [finding.code for finding in caught.value.diagnostics]


def changed(old: str, new: str, folder: Path) -> Path:
    (folder / "arm_kinematics.py").write_text((DATA / "arm_kinematics.py").read_text(encoding="utf-8"))
    path = folder / "arm.yaml"
    path.write_text(ARM.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("arm_kinematics.py:hnd", "did you mean `hand`?"),
        ("missing.py:hand", "there is no file"),
        ("no.such.module:hand", "No module named"),
    ],
)
def test_what_cannot_be_loaded(new: str, words: str, tmp_path: Path) -> None:
    path = changed("arm_kinematics.py:hand", new, tmp_path)
    with pytest.raises(SystemFileError) as caught:
        Task.of(Spec.parse(Source("arm.stl", f"{HEAD}require r: a > 0")), System.load(path))
    (finding,) = caught.value.diagnostics
    assert finding.code == "S208"
    assert words in " ".join((*finding.help, *finding.note))


@pytest.mark.parametrize("new", ["hand", "a b:c", "x.py:1", ""])
def test_a_target_that_is_none(new: str, tmp_path: Path) -> None:
    with pytest.raises(StlcError) as caught:
        load_system_decl(changed("arm_kinematics.py:hand", new, tmp_path))
    assert "S103" in [finding.code for finding in caught.value.diagnostics]


def test_a_module_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = changed("arm_kinematics.py:hand", "arm_kinematics:hand", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    spec = Spec.parse(Source("arm.stl", f"{HEAD}require r: norm(hand(q)) < 3"))
    assert torch.isfinite(Task.of(spec, System.load(path)).robustness(torch.zeros(1, 6, 2))).all()
    sys.modules.pop("arm_kinematics")
