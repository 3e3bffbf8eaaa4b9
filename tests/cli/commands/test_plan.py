"""`stlc plan`: what makes no sense is refused, and what was found before a signal is kept."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch

from stlc.cli.framework.app import main
from stlc.controller.search.planner import PlanSearch
from stlc.trace import Trace

ROOT = Path(__file__).parents[3]
SPEC, SYSTEM = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")
OTHER, SHIP = str(ROOT / "specs/ship_safe.stl"), str(ROOT / "examples/ship_safe.yaml")


def planned(*options: str) -> int:
    return main(["plan", SPEC, "--system", SYSTEM, *options])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--target", "nan"), "`--target nan` is no robustness"),
        (("--target", "-inf"), "`--target -inf` is no robustness"),
        (("--seed", str(2**63)), "should be less than or equal to 9223372036854775807"),
        (("--from", ""), "there is no file `` with initial states"),
        (("--method", "schedule", "--option", "tries=0"), "a whole number from 1 to 1,000,000,000, not `0`"),
    ],
)
def test_what_makes_no_sense(
    options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert planned(*options, "--out", str(tmp_path / "plan.npz")) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_plans_do_not_replace_the_trace_that_they_start_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plan.npz").write_text("plans")
    assert planned("--from", str(tmp_path / "plan.npz"), "-o", str(tmp_path / "plan.npz")) == 2
    assert "is a file that this command reads" in capsys.readouterr().err
    assert (tmp_path / "plan.npz").read_text() == "plans"


@pytest.mark.parametrize("signals", [1, 2])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_plans_found_before_a_signal_are_kept_and_counted(
    number: int,
    code: int,
    signals: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    offer = PlanSearch.offer

    def interrupted(
        search: PlanSearch, rows: torch.Tensor, plans: torch.Tensor, **counted: int
    ) -> torch.Tensor:
        found = offer(search, rows[:1], plans[:1], **counted)
        for _ in range(signals):
            signal.raise_signal(number)
        return found

    before = signal.getsignal(number)
    monkeypatch.setattr(PlanSearch, "offer", interrupted)
    trace = tmp_path / "plan.npz"
    options = ["--starts", "5", "--out", str(trace)]
    assert planned(*options, "--json") == code
    captured = capsys.readouterr()
    assert "interrupted: 1 of 5 initial states were planned for" in captured.err
    found = json.loads(captured.out)["result"]
    assert found["starts"] == Trace.load(trace).traces == 1
    assert found["robustness"]["least"] > -100.0
    assert signal.getsignal(number) is before


def test_without_any_plan_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "stlc.controller.search.planner.prepared",
        lambda *_: lambda _search: signal.raise_signal(signal.SIGTERM),
    )
    trace = tmp_path / "plan.npz"
    assert planned("--starts", "5", "--out", str(trace), "--json") == 143
    captured = capsys.readouterr()
    assert "interrupted: 0 of 5 initial states were planned for" in captured.err
    assert json.loads(captured.out)["exit_code"] == 143
    assert not trace.exists()


def test_the_policy_of_another_specification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--steps", "1", "--batch", "8", "--held-out", "5", "--drives", "0", "--no-pictures"]
    main(["train", OTHER, "--system", SHIP, "--method", "gradient", *options])
    assert planned("--method", "policy") == 2
    assert "is a policy for ship_safe and ship_safe, not for traffic" in capsys.readouterr().err
    assert not Path("plan.npz").exists()


def test_the_requirement_that_fails_is_named_and_no_bound_is_infinite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("point.yaml").write_text(
        "stlc: 1\nname: point\ntime: {dt: 1 s, horizon: 8 steps}\nstate: {x: {unit: m, range: [0, 10]}}\n"
        "control: {v: {unit: m/s, range: [-1, 1]}}\nflow: {x: v}\n"
        'init: {mixture: [{draw: {x: "uniform(4, 5)"}}]}\n'
    )
    rules = "require near: always[0, T] x < 20 m\nrequire far: eventually[0, T] x > 14 m\n"
    Path("s.stl").write_text(f'spec s\nsystem "point.yaml"\nstate signal x [m]\n{rules}')
    options = ["plan", "s.stl", "--evaluations", "50"]
    assert main([*options, "--starts", "3"]) == 1
    said = capsys.readouterr().out
    assert "`far` is violated, in 3 of 3 best plans: by " in said
    assert "`near`" not in said
    assert main([*options, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)["result"]
    assert [each["requirement"] for each in found["missed"]] == ["far"]
    assert found["better"] is None
    over = "require a: eventually@[0 s, 4 s] ((always[0 s, 2 s] x > 0.8 m) and x < 2 m)\n"
    Path("s.stl").write_text(f'spec s\nsystem "point.yaml"\nstate signal x [m]\n{over}')
    assert main([*options, "--from", "x=4 m, clock=5"]) == 1
    said = capsys.readouterr().out
    assert "`a` is violated: no plan can satisfy it any more" in said
    assert "inf" not in said
