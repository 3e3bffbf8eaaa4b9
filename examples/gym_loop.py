"""Run an exported controller in the environment of a specification.

    stlc export latest --to onnx -o controller
    python examples/gym_loop.py controller specs/traffic.stl --episodes 3 --guard paper

The environment (`stlc.gym`, which needs torch) is the world; the controller (`stlc.runtime`, which does not)
receives only the state.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from stlc.gym import SpecEnv, make
from stlc.runtime import Controller


@dataclass(frozen=True)
class Episode:
    """Result of an episode: robustness of its last horizon, return, and counts of decision sources."""

    satisfied: bool
    robustness: float
    earned: float
    rules: Mapping[str, int]


def drive(controller: Controller, env: SpecEnv, *, seed: int) -> Episode:
    """Run one episode, with a decision in every step."""
    controller.reset()
    _, info = env.reset(seed=seed)
    over, earned, rules = False, 0.0, Counter[str]()
    while not over:
        decision = controller.decide(info["state"])
        rules[str(decision.rule)] += 1
        _, reward, terminated, truncated, info = env.step(decision.control)
        earned += reward
        over = terminated or truncated
    return Episode(info["satisfied"], info["rho"], earned, rules)


def main() -> None:
    """Run episodes with seeds 0, 1, 2, …, and print a line each."""
    parser = argparse.ArgumentParser(description="Drive an environment with an exported controller.")
    parser.add_argument("controller", help="folder of `stlc export RUN --to onnx`")
    parser.add_argument("spec", help="file of the specification")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--steps", type=int, default=None, help="of an episode; by default one horizon")
    parser.add_argument("--guard", choices=("none", "paper"), default="none")
    given = parser.parse_args()
    controller = Controller.load(given.controller, given.guard)
    env = make(given.spec, steps=given.steps, world=True)
    for seed in range(given.episodes):
        episode = drive(controller, env, seed=seed)
        word = "satisfied" if episode.satisfied else "violated"
        print(f"seed {seed}: {word}, robustness {episode.robustness:+.3f}, {dict(episode.rules)}")


if __name__ == "__main__":
    main()
