"""Train a policy with Stable-Baselines3 on a benchmark, and count satisfied episodes.

    pip install -e ".[train,gym]" stable-baselines3
    python examples/gym_sb3.py traffic --method ppo --steps 200000
    python examples/gym_sb3.py traffic --method sac --reward task --envs 8 --steps 20000

The weights are saved as plain tensors (`--out policy.safetensors`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from safetensors.torch import save_file
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from stlc.gym import BENCHMARKS, make_vec
from stlc.gym.sb3 import SB3VecEnv


def learner(method: str, env: SB3VecEnv, seed: int) -> BaseAlgorithm:
    """A learner; every update of PPO sees whole episodes."""
    if method == "sac":
        return SAC("MlpPolicy", env, gamma=1.0, learning_starts=1000, seed=seed, device="cpu")
    length = env.get_attr("steps", 0)[0]
    net = {"net_arch": [64, 64]}
    batch = max(env.num_envs * length // 4, 2)
    return PPO(
        "MlpPolicy",
        env,
        n_steps=length,
        batch_size=batch,
        gamma=1.0,
        policy_kwargs=net,
        seed=seed,
        device="cpu",
    )


def share_satisfied(model: BaseAlgorithm, env: SB3VecEnv, seed: int) -> float:
    """Share of satisfied episodes under the most likely actions."""
    env.seed(seed)
    seen, done = env.reset(), np.zeros(env.num_envs, dtype=bool)
    while not done.all():
        seen, _, done, infos = env.step(model.predict(seen, deterministic=True)[0])
    return float(np.mean([info["satisfied"] for info in infos]))


def main() -> None:
    """Train, and print the share of satisfied episodes before and after."""
    parser = argparse.ArgumentParser(description="Train with Stable-Baselines3.")
    parser.add_argument("spec", choices=BENCHMARKS)
    parser.add_argument("--method", choices=("ppo", "sac"), default="ppo")
    parser.add_argument("--reward", choices=("robustness", "accuracy", "task"), default="robustness")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200_000, help="of all environments together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    spec = f"{given.spec}.stl"
    env = SB3VecEnv(make_vec(spec, given.envs, reward=given.reward, normalised=True))
    test = SB3VecEnv(make_vec(spec, 512, normalised=True))
    model = learner(given.method, env, given.seed)
    before = share_satisfied(model, test, seed=1)
    model.learn(given.steps)
    after = share_satisfied(model, test, seed=1)
    print(f"satisfied: {before:.3f} before, {after:.3f} after {given.steps} steps")
    if given.out:
        save_file(dict(model.policy.state_dict()), given.out)


if __name__ == "__main__":
    main()
