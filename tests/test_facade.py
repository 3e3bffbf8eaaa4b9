"""The names of the library, as notebooks use them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stlc

ROOT = Path(__file__).resolve().parent.parent
SPEC = ROOT / "specs/traffic.stl"
SYSTEM = ROOT / "examples/car.yaml"


def modules_after(statement: str) -> set[str]:
    program = f"{statement}; import sys; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return set(done.stdout.split())


def test_importing_the_library_costs_nothing():
    loaded = modules_after("import stlc")
    assert not {"torch", "numpy", "lark", "rich", "typer", "pydantic"} & loaded


def test_loading_and_checking_does_not_need_torch():
    loaded = modules_after("import stlc; stlc.load('specs/traffic.stl'); stlc.Monitor; stlc.Trace")
    assert "torch" not in loaded


@pytest.mark.parametrize("name", stlc.__all__)
def test_every_name_is_there_and_documented(name):
    assert name in dir(stlc)
    value = getattr(stlc, name)
    assert name == "__version__" or value.__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'Moniter'"):
        stlc.Moniter  # noqa: B018


@pytest.mark.parametrize(
    "statement",
    [
        "import stlc",
        "import stlc.compile.ir.nodes, stlc",
        "from stlc.compile.ir import nodes as ir; import stlc",
        "import stlc; stlc.SpecError; import stlc.compile.ir.typed",
        "import stlc.lint.lint, stlc",
    ],
)
def test_the_package_compile_can_be_called_whatever_came_first(statement):
    check = "assert callable(stlc.compile) and callable(stlc.lint) and stlc.compile.__path__"
    check += "; from stlc.compile.ir import nodes"
    modules_after(f"{statement}; {check}; nodes.Const(1.0)")


def test_a_loaded_spec_knows_its_path():
    spec = stlc.load(SPEC)
    assert spec.source.name == str(SPEC)
    assert spec.name == "traffic"
    assert stlc.parse(SPEC.read_text()) == spec


def test_errors_carry_their_diagnostics():
    with pytest.raises(stlc.SpecError) as caught:
        stlc.parse("require a: x >\nrequire b: (x > 0")
    assert all(finding.span is not None for finding in caught.value.diagnostics)
    assert issubclass(stlc.SpecError, stlc.StlcError)


def test_the_monitor_takes_dt_and_horizon_from_the_system_of_the_spec():
    monitor = stlc.Monitor(stlc.load(SPEC))
    assert monitor.horizon == pytest.approx(2.5)


def test_the_library_as_the_documents_show_it():
    torch = pytest.importorskip("torch")
    system = stlc.System.load(SYSTEM)
    x0 = system.sample(6, seed=0)
    u = torch.zeros(6, system.horizon, len(system.control_names))
    x = system.rollout(x0, u)
    assert x.shape == (6, system.horizon + 1, len(system.names))

    task = stlc.compile(stlc.load(SPEC), system)
    assert isinstance(task, stlc.Task)
    rho = task.robustness(x)
    assert rho.shape == (6,)
    assert (task.safety.robustness(x) >= rho).all()
    assert (task.robustness(x, smoothing=500) <= rho + 0.1).all()

    signals = {name: x[..., i].double().numpy() for i, name in enumerate(system.names)}
    verdict = stlc.Monitor(stlc.load(SPEC)).check(signals)
    np.testing.assert_allclose(verdict.robustness, rho.double().numpy(), atol=1e-4)
    assert verdict["give_way"].robustness.shape == (6,)


def test_a_spec_that_does_not_fit_the_system_is_refused():
    with pytest.raises(stlc.SpecError, match="E1"):
        stlc.compile(
            stlc.parse("signal altitude [m]\nrequire up: always[0, T] altitude > 0"), stlc.System.load(SYSTEM)
        )


def test_a_refused_training_makes_no_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = stlc.compile(stlc.load(SPEC), stlc.System.load(SYSTEM))
    with pytest.raises(stlc.StlcError):
        stlc.train(task, method="sac", steps=3)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"budget": -1}, {"budget": float("nan")}, {"steps": 0}, {"seed": -1}])
def test_a_training_that_makes_no_sense_is_refused(options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = stlc.compile(stlc.load(SPEC), stlc.System.load(SYSTEM))
    with pytest.raises(stlc.StlcError, match="U101"):
        stlc.train(task, **options)
    assert list(tmp_path.iterdir()) == []


def test_systems_tasks_and_plans_are_shown_in_notebooks():
    pytest.importorskip("torch")
    system = stlc.System.load(SYSTEM)
    task = stlc.compile(stlc.load(SPEC), system)
    assert system._repr_html_().count("<tr>") == 1 + len(system.names) + len(system.control_names)
    assert "give_way" in task._repr_html_()
    found = stlc.plan(task, system.sample(2, seed=0), budget=0.5)
    assert repr(found).startswith("PlanResult(2 of 2 plans satisfy it, least robustness ")
