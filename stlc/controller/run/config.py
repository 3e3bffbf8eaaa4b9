"""Options of a run, as a training method resolved them and as its folder keeps them."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import Self, get_args

from stlc.controller.options import MOST, Bounds, bounds_of
from stlc.options import Clock
from stlc.registry import METHODS, PLANNERS

DRIVES = 400
"""Default maximum number of closed-loop runs after training, for each kind of guard."""
HELD_OUT = 5000
HELD_OUT_SEED = 981_273
"""Seed of the held-out states: used for the final evaluation only, never during training or tuning."""


@dataclass(frozen=True, slots=True)
class ResolvedConfig:
    """Resolved options of a run.

    Fresh states are newly drawn initial states; hard states are those from which the policy's plans failed. A
    search round (validation) judges the policy's plans from fresh states, and starts a search for plans where
    they fail.

    Attributes:
        method: name of the method.
        seed: seed of all random numbers.
        hidden: widths of the network's hidden layers.
        plans: number of plans that the network proposes per state.
        varied: True if changed copies of the best plan are tried where no proposed plan satisfies the
            specification.
        batch: number of fresh states per step.
        hard: number of hard states per step. A hard state is used once the search has found a plan for it,
            so the first steps have none.
        lr: peak learning rate.
        warmup: share of the steps over which the learning rate rises if `hold` is 0.
        hold: share of the steps at the peak learning rate. If it is positive, the learning rate rises to the
            peak in a fixed number of steps.
        clip: bound on the norm of the gradient.
        average: decay of the moving average of the weights.
        pool: number of fresh states judged per search round.
        every: steps between search rounds.
        most: maximum number of hard states from which a search round searches.
        slope: k in the smooth switch (1 + tanh(k x)) / 2, where x is the distance to a switching condition
            of the dynamics. In gradients, the smooth switch takes the place of the exact one.
        imitation: weight of the imitation loss, the distance to the plan that the search found.
        share: weight with which the mean loss of all plans of a state is added to the loss of its best plan.
        performance: weight of the performance terms in the loss.
        held_out: number of initial states of the final evaluation, on which no policy is trained.
        threads: number of threads of torch, on which the rounding of sums depends; 0: not changed.
        samples: size of a fixed training set; 0: fresh states in every step.
        clock: clock of budgets and recorded times: `wall` or `processor`.
        ranks: number of processes that train together, each with its own batch.
        drives: maximum number of closed-loop simulations after the training, for each kind of guard (a guard
            checks plans at run time).
        falsify: whether states of failing closed-loop drives are mixed into the training; see
            `stlc.controller.training.failures`.
    """

    method: str
    seed: int
    hidden: tuple[int, ...]
    plans: int
    batch: int
    hard: int
    lr: float
    warmup: float = 0.03
    hold: float = 0.0
    clip: float = 1.0
    average: float = 0.99
    pool: int = 2048
    every: int = 50
    most: int = 768
    slope: float = 5.0
    imitation: float = 1.0
    share: float = 0.05
    performance: float = 0.3
    varied: bool = False
    held_out: int = HELD_OUT
    threads: int = 0
    samples: int = 0
    clock: Clock = "wall"
    ranks: int = 1
    drives: int = DRIVES
    falsify: bool = False
    whole: bool = False

    def checked(self) -> Self:
        """Return the options unchanged if all are valid.

        Raises:
            ValueError: an option has the wrong type, is out of its bounds, or names something unknown.
        """
        words = {
            "method": METHODS.names,
            "clock": get_args(Clock),
            "planner": PLANNERS.names,
        }
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name in words:
                if value not in words[option.name]:
                    known = ", ".join(words[option.name])
                    raise ValueError(f"`{option.name}` is {value!r:.40}, none of {known}")
                continue
            if option.type in ("str", str):
                if not isinstance(value, str) or len(value) > MOST_TEXT:
                    raise ValueError(f"`{option.name}` is {value!r:.40}")
                continue
            if option.type in ("bool", bool):
                if not isinstance(value, bool):
                    raise ValueError(f"`{option.name}` is {value!r:.40}, neither true nor false")
                continue
            kinds = (int, float) if option.type in ("float", float) else (int,)
            general = Bounds(float(option.name in _POSITIVE), _MOST.get(option.name, MOST))
            bounds = bounds_of(option, general)
            each = value if option.name == "hidden" else (value,)
            fits = (isinstance(x, kinds) and not isinstance(x, bool) and x in bounds for x in each)
            if not all(fits):
                raise ValueError(f"`{option.name}` is {value!r:.40}, not {bounds}")
        return self


_MOST = {
    **dict.fromkeys(("hidden", "plans", "threads", "ranks"), 65_536),
    **dict.fromkeys(("batch", "hard", "pool", "most", "held_out", "samples", "drives"), 10**8),
    **dict.fromkeys(("warmup", "average"), 1.0),
    "hold": 0.999,
    "lr": sys.float_info.max,
    "seed": 2**63 - 1,
}
"""Upper bounds other than `MOST`: on shares, on options that determine memory use, and larger ones."""
MOST_TEXT = 1000


_POSITIVE = ("hidden", "plans", "batch", "pool", "every", "ranks")
