"""Tasks that cannot be trained end in a diagnosis of what and where; the last good weights are kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.controller.run.run import Run
from stlc.rundir import RunDir

CART = """
stlc: 1
name: cart
time: {{dt: 0.1 s, horizon: 10 steps}}
state:
  x: {{unit: m, range: [-2, 2]}}
  v: {{unit: m/s, range: [-2, 2], clamp: {clamp}}}
control:
  u: {{unit: m/s^2, range: [-3, 3]}}
flow: {{x: v, v: "{push}"}}
init:
  where: [v < 5 m/s, {where}]
  mixture:
    - draw: {{x: "uniform(0, 1)", v: 0}}
objective: {{terms: {terms}}}
policy: {{hidden: [8]}}
"""
PLAIN = {"clamp": "false", "push": "u", "where": "x < 5 m", "terms": "[]"}
SPEC = "spec s\nstate signal x [m]\nstate signal v [m/s]\n"
NEAR = "require near: eventually[0, T] abs(x) < 0.5\n"
STUCK = {"push": "0.1 * u - 30", "clamp": "true"}  # at the clamp's lower end at once
TERM = '[{name: soft, weight: 0.1, expr: "((v + 2) / 1 m/s)^0.25"}]'
ENDLESS = "require hot: always[0, T] exp(v * v * 1000 / 1 m^2/s^2) < 2\n"
LOW = "require low: eventually[0, T] ((v + 2 m/s) / 1 m/s)^0.25 <= -0.1\n"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("stlc.controller.training.learner.MARGIN_STATES", 8)


def _trained(
    capsys: pytest.CaptureFixture[str], changed: dict[str, str], rules: str, *options: str
) -> tuple[int, str]:
    """The exit code, and the one finding as it is printed."""
    Path("cart.yaml").write_text(CART.format(**{**PLAIN, **changed}))
    Path("s.stl").write_text(SPEC + rules)
    quick = ["--steps", "12", "--batch", "8", "--held-out", "20", "--threads", "1", "--no-pictures"]
    code = main(["train", "s.stl", "--system", "cart.yaml", *quick, *options])
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("where", "shares"),
    [
        ("x > 0.997 m", ["`x > 0.997 m` holds for 0.", "`v < 5 m/s` holds for 100.00%"]),
        ("x > 1.5 m", ["0 meet every condition", "`x > 1.5 m` holds for 0.00%"]),
    ],
)
def test_initial_states_that_hardly_exist(
    where: str, shares: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = _trained(capsys, {"where": where}, NEAR)
    assert code == 3
    assert "error[S301]" in said
    assert "--> cart.yaml:12:10" in said
    assert all(share in said for share in shares)


@pytest.mark.apart
@pytest.mark.parametrize(
    ("push", "what", "method"),
    [
        ("u * exp(100 * x / 1 m)", "infinity in `v`", "guided"),
        ("u * exp(100 * x / 1 m)", "infinity in `v`", "gradient"),
        ("u - 0.01 * log(-x / 1 m)", "NaN in `v`", "guided"),
    ],
)
def test_states_that_explode(push: str, what: str, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = _trained(capsys, {"push": push}, NEAR, "--method", method)
    assert code == 3
    assert f"error[S302]: the dynamics of cart give {what}" in said
    assert "--> cart.yaml:7:3" in said
    assert "after a start" in said
    assert "note: from x = " in said
    assert "note: with u = " in said


@pytest.mark.apart
@pytest.mark.parametrize(
    ("changed", "rules"), [({}, LOW + NEAR), ({"terms": TERM}, NEAR)], ids=["requirement", "term"]
)
def test_a_root_of_zero_does_not_end_a_training(
    changed: dict[str, str], rules: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = _trained(capsys, {**STUCK, **changed}, rules)
    assert code in (0, 1, 3)
    assert "R401" not in said  # no plan may satisfy it, but every number is one


def test_a_robustness_that_is_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = _trained(capsys, STUCK, NEAR + ENDLESS)
    assert code == 3
    assert "error[R401]: the robustness of `hot` is minus infinity" in said
    assert "--> s.stl:5:1" in said
    assert "the run keeps the weights before that step" in said
    run = Run.open(RunDir.newest().path)
    assert run.dir.status == "failed"
    x0 = run.task.sample(3, seed=0)
    assert bool(run.policy(x0).isfinite().all())
    assert main(["train", "--resume", "latest", "--no-pictures"]) == 3


def test_weights_that_are_no_numbers_are_not_kept(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = _trained(capsys, {}, NEAR, "--lr", "1e38")
    assert code == 3
    assert "error[R401]" in said
    assert "try a smaller --lr" in said
    assert "the last checkpoint of the run is kept" in said
    assert not (RunDir.newest().path / "ckpt").exists()


@pytest.mark.apart
@pytest.mark.parametrize(
    ("rules", "message", "places"),
    [
        ("require far: eventually[0, T] x > 100\n", "no plan satisfies `far`", ["--> s.stl:5:1"]),
        (
            "require left: always[0, T] x < 0.5\nrequire right: always[0, T] x > 0.5\n",
            "no plan was found that satisfies `left` and `right` together",
            ["--> s.stl:5:1", "6 | require right"],
        ),
    ],
)
def test_requirements_that_nothing_satisfies(
    rules: str, message: str, places: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = _trained(capsys, {}, "require slow: always[0, T] abs(v) < 4\n" + rules, "--steps", "3")
    assert code == 1
    assert f"error[R404]: {message}" in said
    assert all(place in said for place in places)
    record = RunDir.newest().record()
    assert (record["status"], record["result"]["why"]) == ("finished", message)
    assert record["result"]["proved"] is message.startswith("no plan satisfies")
    assert (RunDir.newest().path / "ckpt" / "last.json").is_file()


def test_a_search_that_never_finds_a_plan_ends_early(capsys: pytest.CaptureFixture[str]) -> None:
    rules = "require far: eventually[0, T] x > 100\n"
    code, _ = _trained(capsys, {}, rules, "--steps", "400", "--json")
    assert code == 1
    rows = RunDir.newest().rows()
    assert [row["step"] for row in rows] == [50]  # where it is proved that there is none, no other is tried


def test_the_document_has_the_diagnosis(capsys: pytest.CaptureFixture[str]) -> None:
    Path("cart.yaml").write_text(CART.format(**PLAIN))
    Path("s.stl").write_text(SPEC + "require far: eventually[0, T] x > 100\n")
    words = ["--steps", "1", "--batch", "8", "--held-out", "20", "--no-pictures", "--json"]
    assert main(["train", "s.stl", "--system", "cart.yaml", *words]) == 1
    document = json.loads(capsys.readouterr().out)
    assert (document["ok"], [finding["code"] for finding in document["diagnostics"]]) == (False, ["R404"])
    assert document["result"]["feasible"] == 0.0


def test_a_file_where_a_folder_is_needed_is_told_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("mine", encoding="utf-8")
    Path("s.stl").write_text("spec s\nsignal x [m]\nrequire r: always[0 s, 1 s] x > 0\n", encoding="utf-8")
    for name in ("a.csv", "b.csv"):
        Path(name).write_text("t,x\n0,1\n1,1\n", encoding="utf-8")
    assert main(["check", "s.stl", "a.csv", "b.csv", "--out", "taken"]) == 5
    assert "error[R201]: cannot use `taken`" in capsys.readouterr().err
    spec = str(Path(__file__).parents[2] / "specs/arch/chasing_cars.stl")
    assert main(["falsify", spec, "--simulations", "1", "--out", "taken"]) == 5
    assert "error[R201]: cannot use `taken`" in capsys.readouterr().err
    assert Path("taken").read_text(encoding="utf-8") == "mine"


def test_a_folder_of_traces_is_told_how_to_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("logs").mkdir()
    Path("s.stl").write_text(SPEC + NEAR, encoding="utf-8")
    assert main(["check", "s.stl", "logs"]) == 2
    assert "`logs` is a folder, not a trace\n  = help: name its traces: 'logs/*'" in capsys.readouterr().err
