"""Statements about a training, which are true of a policy at 3 %, at 50 % and at 97 %."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from stlc.rundir import RunDir
from stlc.view.learning import (
    LEAST_ROUNDS,
    MOST_TIMES,
    Commands,
    budget_text,
    forecast,
    learning_of,
    learning_of_run,
)

COMMANDS = Commands.of("7", {"spec_path": "s.stl"}, newest=True)
WHERE = "fails in 63 % of the starts with sign = stop (40 % of its failures)"


def result(accuracy: float, feasible: float, seconds: float = 30.0) -> dict[str, object]:
    shares = {"stop_sign": min(1.0, accuracy + 0.02), "red_light": 1.0}
    return {"accuracy": accuracy, "feasible": feasible, "requirements": shares, "seconds": seconds}


def driven(
    satisfied: int, causes: dict[str, int] | None = None, due: float | None = None
) -> dict[str, object]:
    """Closed-loop results of 20 drives without a guard, of 35 s, with plans of 10 s."""
    violated = [{"requirement": "stop_sign", "drives": 20 - satisfied, "seconds": 30.0, "due": due}]
    share = {"guard": "none", "drives": 20, "satisfied": satisfied, "share": satisfied / 20}
    guard = {**share, "interval": [0.0, 1.0], "broken": violated, "causes": causes or {}}
    return {"closed_loop": {"guards": [guard], "recommended": "none", "seconds": 35.0, "plan_seconds": 10.0}}


def rows(accuracy: float, feasible: float, growth: float, count: int = 20) -> list[dict[str, float]]:
    """A curve that ends at `accuracy`: its log-odds grow by `growth` for twice the steps."""
    part = min(accuracy / feasible, 0.999)
    end = math.log(part / (1.0 - part))
    found = []
    for i in range(1, count + 1):
        odds = end + growth * math.log2(i / count)
        found.append({"step": 50.0 * i, "accuracy": feasible / (1.0 + math.exp(-odds))})
    return found


def test_what_hardly_obeys_is_undertrained_and_training_goes_on_while_the_curve_rises() -> None:
    found = result(0.027, 0.93) | driven(0, {"missed": 5, "start": 1})
    learning = learning_of(found, rows(0.027, 0.93, 2.0), COMMANDS, WHERE)
    assert learning.level == "undertrained"
    assert learning.share == pytest.approx(0.029, abs=1e-3)
    assert learning.sentence.startswith("0 of 20 drives obeyed without a guard; the policy's plan")
    assert "from 2.7 % of the starts" in learning.sentence
    assert "known for 93.0 %" in learning.sentence
    longer, planner = learning.advice
    assert longer.startswith("in 5 of 6 failed drives that were examined, a satisfying plan is known")
    assert "the curve is rising" in longer
    assert learning.worst == f"the worst requirement is stop_sign, 4.7 % satisfied: it {WHERE}"
    assert "`stlc simulate s.stl --method search`" in planner
    assert learning.command.startswith("stlc train --resume 7 --budget ")
    assert learning.command in longer


def test_half_of_the_drives_are_partly_trained_and_may_be_driven() -> None:
    learning = learning_of(result(0.5, 0.9) | driven(10), rows(0.5, 0.9, 1.0), COMMANDS, WHERE)
    assert learning.level == "partly trained"
    assert learning.command == "stlc simulate --backup"
    assert "points to 95 % of what is known to be feasible after 3 min 20 s to" in learning.advice[0]


def test_only_drives_make_a_policy_trained() -> None:
    for satisfied, level in ((20, "trained"), (18, "trained"), (17, "partly trained"), (0, "undertrained")):
        assert learning_of(result(1.0, 1.0) | driven(satisfied), [], COMMANDS).level == level
    learning = learning_of(result(0.97, 0.975) | driven(20), rows(0.97, 0.975, 0.5), COMMANDS, WHERE)
    assert learning.advice == ()
    alone = learning_of(result(1.0, 1.0), [], COMMANDS)
    assert (alone.level, alone.advice) == ("not driven", ())
    late = {"closed_loop": {"guards": [], "recommended": None}}
    assert learning_of(result(1.0, 1.0) | late, [], COMMANDS).level == "not driven"


@pytest.mark.parametrize(
    ("cause", "due", "text", "command"),
    [
        ("later", 30.0, "plans end after 10 s, `stop_sign` is due at 30 s", "search --set time.horizon=35s"),
        ("later", None, "plans end after 10 s, `stop_sign` asks for more", "search --set time.horizon=35s"),
        ("told", None, "the world did what no plan foresees", "stlc train s.stl --falsify"),
        ("start", None, "no satisfying plan is known from the start; ask for less of `stop_sign`", "search"),
        ("near", None, "the best known plans miss by little", "stlc simulate s.stl --method search"),
        ("rules", None, "should ask for `stop_sign` too", "stlc report 7"),
    ],
)
def test_the_advice_follows_from_the_cause_that_was_measured(
    cause: str, due: float | None, text: str, command: str
) -> None:
    learning = learning_of(result(1.0, 1.0) | driven(2, {cause: 4, "missed": 1}, due), [], COMMANDS)
    assert learning.level == "undertrained"
    assert learning.advice[0].startswith("in 4 of 5 failed drives that were examined, ")
    assert text in learning.advice[0]
    assert learning.command.endswith(command)


def test_plans_that_reach_to_the_end_are_not_made_longer() -> None:
    found = result(1.0, 1.0) | driven(2, {"later": 4})
    found["closed_loop"] |= {"plan_seconds": 35.0}  # type: ignore[operator]
    learning = learning_of(found, [], COMMANDS)
    assert "ask for less of `stop_sign`" in learning.advice[0]
    assert learning.command == "stlc simulate s.stl --method search"


def test_where_few_starts_have_a_plan_it_is_said() -> None:
    learning = learning_of(result(0.35, 0.36) | driven(19), rows(0.35, 0.36, 0.1), COMMANDS)
    assert learning.level == "trained"
    (hard,) = learning.advice
    assert hard.startswith("for 64.0 % of the starts search found no satisfying plan either")


def test_an_estimate_is_called_one() -> None:
    few = {**result(0.05, 0.4), "searched": 600, "held_out": 5000}
    learning = learning_of(few, rows(0.05, 0.4, 1.0), COMMANDS)
    assert learning.sentence.endswith("known for 40.0 %, by an estimate from 600 of the 5,000 starts")
    assert any("for about 60.0 % of the starts" in advice for advice in learning.advice)
    full = learning_of({**few, "searched": 5000}, rows(0.05, 0.4, 1.0), COMMANDS)
    assert "estimate" not in full.sentence


def test_where_nothing_is_possible_training_is_not_the_advice() -> None:
    learning = learning_of(result(0.0, 0.0), [], COMMANDS)
    assert (learning.level, learning.share) == ("no plan known", None)
    assert learning.advice[0].startswith("a longer search may find plans")
    assert learning.advice[1].startswith("else a looser specification")
    assert learning.command == "stlc simulate s.stl --method search"
    proved = learning_of({**result(0.0, 0.0), "proved": True}, [], COMMANDS)
    assert proved.level == "infeasible"
    assert "prove it" in proved.sentence
    assert "more training cannot help" in proved.advice[0]


def test_a_flat_curve_is_not_answered_with_more_time() -> None:
    learning = learning_of(result(0.03, 0.9) | driven(1), rows(0.03, 0.9, 0.0), COMMANDS)
    assert "promises little, the curve is flat" in learning.advice[0]
    assert learning.command == "stlc simulate s.stl --method search"


def test_nothing_is_foretold_from_a_short_curve_or_for_ever() -> None:
    assert forecast(rows(0.1, 0.9, 1.0, count=LEAST_ROUNDS - 2), 0.1, 0.9).state == "short"
    far = forecast(rows(0.03, 0.9, 0.4), 0.03, 0.9)
    assert (far.state, far.times) == ("rising", None)
    near = forecast(rows(0.5, 0.9, 1.0), 0.5, 0.9)
    assert near.times is not None
    assert near.times == pytest.approx(2.0 ** (math.log(19.0) - math.log(1.25)), rel=1e-6)
    assert near.times < MOST_TIMES


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3.0, "10s"), (31.0, "30s"), (33.0, "60s"), (100.0, "2min"), (900.0, "15min"), (4000.0, "2h")],
)
def test_budgets_are_round(seconds: float, text: str) -> None:
    assert budget_text(seconds) == text


def test_a_run_that_is_not_finished_has_no_verdict(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path, "traffic", "a")
    run.update({"status": "interrupted"})
    assert learning_of_run(run, COMMANDS) is None
