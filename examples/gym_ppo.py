"""Proximal policy optimisation in one file, on the vector environment of a benchmark.

    pip install -e ".[train,gym]"
    python examples/gym_ppo.py traffic --envs 512 --updates 100

In the manner of CleanRL's `ppo_continuous_action.py`, to read and to change. A batch is one episode of every
environment, so no value has to be estimated beyond its end.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from time import process_time

import gymnasium
import torch
from torch import Tensor, nn
from torch.distributions import Normal

import stlc.gym


class Agent(nn.Module):
    """Gaussian policy and value, each a network of two layers."""

    def __init__(self, seen: int, acts: int, width: int = 64) -> None:
        super().__init__()
        self.value = self._network(seen, 1, width)
        self.mean = self._network(seen, acts, width)
        self.log_deviation = nn.Parameter(torch.full((acts,), -0.5))
        with torch.no_grad():
            self.mean[-1].weight.mul_(0.01)

    @staticmethod
    def _network(seen: int, out: int, width: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(seen, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, out)
        )

    def policy(self, seen: Tensor) -> Normal:
        """Distribution of actions, (…, k) -> (…, m)."""
        return Normal(self.mean(seen), self.log_deviation.exp())


@dataclass(frozen=True)
class Batch:
    """Steps of all environments, (T, N, …)."""

    seen: Tensor
    acts: Tensor
    chances: Tensor
    advantages: Tensor
    returns: Tensor


@dataclass(frozen=True)
class Rollout:
    """A batch, and how its episodes ended."""

    batch: Batch
    satisfied: float
    earned: float


@torch.no_grad()
def rollout(
    agent: Agent, env: stlc.gym.SpecVectorEnv, seen: Tensor, decay: float = 0.95
) -> tuple[Rollout, Tensor]:
    """One episode of every environment from `seen` on; also the first observations of the next."""
    rows, rewards = [], []
    end = {}
    for _ in range(env.steps):
        policy = agent.policy(seen)
        act = policy.sample()
        rows.append((seen, act, policy.log_prob(act).sum(-1), agent.value(seen)[:, 0]))
        observation, reward, _, _, info = env.step(act.clamp(-1.0, 1.0).numpy())
        seen, end = torch.from_numpy(observation), info.get("final_info", end)
        rewards.append(torch.from_numpy(reward).float())
    before, acts, chances, values = (torch.stack(each) for each in zip(*rows, strict=True))
    earned, advantage, found = torch.stack(rewards), torch.zeros(env.num_envs), []
    later = torch.cat((values[1:], torch.zeros(1, env.num_envs)))  # nothing follows the last step
    for error in (earned + later - values).flip(0):  # generalised advantage, discount 1
        advantage = error + decay * advantage
        found.append(advantage)
    advantages = torch.stack(found).flip(0)
    batch = Batch(before, acts, chances, advantages, advantages + values)
    return Rollout(batch, float(end["satisfied"].mean()), float(earned.sum(0).mean())), seen


def update(agent: Agent, optimiser: torch.optim.Optimizer, batch: Batch, *, epochs: int, parts: int) -> None:
    """Clipped policy gradient (Schulman et al. 2017, Eq. 7) with a squared error of the value."""
    flat = [
        getattr(batch, name).flatten(0, 1) for name in ("seen", "acts", "chances", "advantages", "returns")
    ]
    for _ in range(epochs):
        for rows in torch.randperm(len(flat[0])).chunk(parts):
            seen, acts, chances, advantages, returns = (each[rows] for each in flat)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(acts).sum(-1) - chances).exp()
            weight = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            gain = torch.minimum(ratio * weight, ratio.clamp(0.8, 1.2) * weight).mean()
            error = (agent.value(seen)[:, 0] - returns).square().mean()
            optimiser.zero_grad()
            (0.5 * error - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()


def main() -> None:
    """Train, and print the share of satisfied episodes as it grows."""
    parser = argparse.ArgumentParser(description="Train with proximal policy optimisation.")
    parser.add_argument("spec", choices=stlc.gym.BENCHMARKS)
    parser.add_argument("--reward", choices=("robustness", "accuracy", "task"), default="robustness")
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.manual_seed(given.seed)
    env = gymnasium.make_vec(f"stlc/{given.spec}-v0", given.envs, reward=given.reward, normalised=True)
    agent = Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    seen = torch.from_numpy(env.reset(seed=given.seed)[0])
    for number in range(1, given.updates + 1):
        optimiser.param_groups[0]["lr"] = 1e-3 * (1.0 - (number - 1) / given.updates)
        found, seen = rollout(agent, env, seen)
        update(agent, optimiser, found.batch, epochs=4, parts=8)
        if number in (1, given.updates) or number % 10 == 0:
            shown = f"satisfied {found.satisfied:.3f}, return {found.earned:+.3f}"
            print(f"update {number}: {shown}, {process_time():.0f} s")


if __name__ == "__main__":
    main()
