"""Methods (contenders) in the paper's comparison: every training method and planner that stlc registers.

Their names show method and options: `guided`; `sac:task` (training with an option); `plan:search` (a
planner); `plan:cem:paper` (a planner with the paper's settings). To add a method to the comparison, only its
own file is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stlc.registry import METHODS, PLANNERS

Options = Mapping[str, str]
PLAN, PAPER = "plan", "paper"
REPLAYED = "policy"
"""The planner that replays a trained policy. It has no row of its own in the comparison."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A method with its options, one row of the comparison.

    Attributes:
        name: name of the row, such as `sac:task`.
        method: name of the training method, or of the planner if `plans` is True.
        options: options of the method, as on a command line.
        plans: whether the method plans without training.
        evaluations: benchmark -> number of plans after which the planner's own settings end its search. Empty
            if the planner has a time budget instead.
        special: benchmark -> options that differ for this benchmark.
        hour: whether the method is also trained for an hour.
    """

    name: str
    method: str
    options: Options = field(default_factory=dict)
    plans: bool = False
    evaluations: Mapping[str, int] = field(default_factory=dict)
    special: Mapping[str, Options] = field(default_factory=dict)
    hour: bool = False

    def options_on(self, benchmark: str) -> dict[str, str]:
        """Return all options of the method for a benchmark."""
        return {**self.options, **self.special.get(benchmark, {})}


def _usual(count: int, **others: int) -> dict[str, int]:
    names = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
    return {name: others.get(name, count) for name in names}


REWARDS = ("task", "robustness", "accuracy")
"""Rewards of the methods that the paper calls RL_R, RL_S and RL_A."""
LEARNERS: dict[str, tuple[Contender, ...]] = {
    "sac": tuple(
        Contender(f"sac:{reward}", "sac", {"reward": reward}, hour=reward == "robustness")
        for reward in REWARDS
    ),
}
"""Training methods that have several rows in the comparison."""
PLANNERS_OF_PAPER: dict[str, Contender] = {
    "cem": Contender(
        "plan:cem:paper",
        "cem",
        {"population": "10000", "elites": "100", "deviation": "1", "physical": "true", "rounds": "10"},
        plans=True,
        evaluations=_usual(100_000, manipulation=10_000),
        special={"navigation": {"over": "policy"}, "manipulation": {"population": "1000"}},
    ),
    "gradient": Contender(
        "plan:gradient:paper",
        "gradient",
        {"objective": "paper", "starts": "1", "steps": "50"},
        plans=True,
        evaluations=_usual(51, ship_safe=201, manipulation=201),
        special={"ship_safe": {"steps": "200"}, "manipulation": {"steps": "200"}},
    ),
}
"""Planners with the settings of the authors' scripts; they have rows besides those with a time budget."""


def learners() -> tuple[Contender, ...]:
    """Return all training methods."""
    trained = [name for name in METHODS.names if METHODS.get(name).trains]
    return tuple(each for name in trained for each in LEARNERS.get(name, (Contender(name, name),)))


def planners() -> tuple[Contender, ...]:
    """Return all planners; those with the paper's settings come last."""
    names = [name for name in PLANNERS.names if name != REPLAYED]
    usual = [Contender(f"{PLAN}:{name}", name, plans=True) for name in names]
    return (*usual, *(each for name, each in PLANNERS_OF_PAPER.items() if name in names))


def roster() -> dict[str, Contender]:
    """Return all methods of the comparison: name -> method."""
    return {each.name: each for each in (*learners(), *planners())}
