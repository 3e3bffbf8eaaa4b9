"""Contenders of the paper's comparison: each learner and planner of the registries is a row.

A contender is named as its method: `guided`, `sac:task` (a learner with an option), `plan:search` (a
planner), `plan:cem:paper` (with the paper's settings). A new method appears here by its file alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stlc.registry import METHODS, PLANNERS

Options = Mapping[str, str]
PLAN, PAPER = "plan", "paper"
REPLAYED = "policy"
"""The planner that replays a trained policy: it is no contender of its own."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A method with its options.

    Attributes:
        name: of the row.
        method: name in `METHODS`, or in `PLANNERS` if `plans`.
        options: of the method, as on a command line.
        plans: whether it plans without training.
        evaluations: benchmark -> plans after which its own settings end; empty if its budget is a time.
        special: benchmark -> options that differ there.
        hour: whether it is also trained for an hour.
    """

    name: str
    method: str
    options: Options = field(default_factory=dict)
    plans: bool = False
    evaluations: Mapping[str, int] = field(default_factory=dict)
    special: Mapping[str, Options] = field(default_factory=dict)
    hour: bool = False

    def options_on(self, benchmark: str) -> dict[str, str]:
        """All options on a benchmark."""
        return {**self.options, **self.special.get(benchmark, {})}


def _usual(count: int, **others: int) -> dict[str, int]:
    names = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")
    return {name: others.get(name, count) for name in names}


REWARDS = ("task", "robustness", "accuracy")
"""RL_R, RL_S and RL_A of the paper."""
LEARNERS: dict[str, tuple[Contender, ...]] = {
    "sac": tuple(
        Contender(f"sac:{reward}", "sac", {"reward": reward}, hour=reward == "robustness")
        for reward in REWARDS
    ),
}
"""Learners with several rows instead of one."""
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
"""Settings of the authors' scripts, rows beside those with a time budget."""


def learners() -> tuple[Contender, ...]:
    """All learners."""
    trained = [name for name in METHODS.names if METHODS.get(name).trains]
    return tuple(each for name in trained for each in LEARNERS.get(name, (Contender(name, name),)))


def planners() -> tuple[Contender, ...]:
    """All planners, those with the paper's settings behind the others."""
    names = [name for name in PLANNERS.names if name != REPLAYED]
    usual = [Contender(f"{PLAN}:{name}", name, plans=True) for name in names]
    return (*usual, *(each for name, each in PLANNERS_OF_PAPER.items() if name in names))


def roster() -> dict[str, Contender]:
    """All contenders by name."""
    return {each.name: each for each in (*learners(), *planners())}
