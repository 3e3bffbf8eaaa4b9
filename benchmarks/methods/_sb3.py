"""Soft actor-critic of stable-baselines3 over batched episodes, trained step by step.

The library's own `save` writes pickles. Here networks, optimisers, entropy coefficient, replay buffer and the
states of the random generators are stored as tensors in the run's checkpoint.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from benchmarks.methods._actor import (
    ActorLearner,
    ActorPolicy,
    finite_weights,
    optimizer_tensors,
    restore_optimizer,
)
from benchmarks.methods._sac import SacActor, SacConfig
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.environments import Environments, Reward
from stlc.controller.run.checkpoint import below
from stlc.diagnostics import usage

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

SAMPLED = 4096
"""Initial states for the scale of the observations."""
NARROW = 1e-4
"""Spread below which observations are not scaled."""
SEEDS = 2**32
"""Number of different seeds that NumPy accepts."""
CRITICS = [256, 256]
"""Widths of the critics, the library's default."""
STORED = ("observations", "next_observations", "actions", "rewards", "dones")
"""Arrays of the replay buffer, (capacity / N, N, …)."""


class EpisodesEnv(VecEnv):  # type: ignore[misc]
    """Batched episodes as a vectorised environment of stable-baselines3.

    Observations are normalised; controls are scaled to [-1, 1].

    Args:
        environments: the episodes.
        actor: actor whose methods normalise the observations and scale the controls.
    """

    render_mode = None

    def __init__(self, environments: Environments, actor: SacActor) -> None:
        self.environments, self._actor = environments, actor
        controls = len(environments.task.system.control_names)
        seen = Box(-np.inf, np.inf, (environments.width,), np.float32)
        super().__init__(environments.count, seen, Box(-1.0, 1.0, (controls,), np.float32))

    def reset(self) -> np.ndarray[Any, Any]:
        """Begin all episodes at new initial states; return the normalised observations, (N, k)."""
        self.environments.reset()
        return self.observed()

    def observed(self) -> np.ndarray[Any, Any]:
        """Normalised observations of the present states at the beginning of the episodes, (N, k).

        Later they would be wrong, since an observation contains the elapsed share of the episode, which is
        taken as 0 here.
        """
        return self._seen(self.environments.observe(self.environments.states, 0))

    def step_async(self, actions: np.ndarray[Any, Any]) -> None:
        """Store the controls (N, m), from -1 to 1, that `step_wait` applies."""
        self._actions = torch.from_numpy(np.asarray(actions, np.float32))

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Advance all episodes by one step under the stored controls.

        Returns:
            Normalised observations (N, k); rewards (N,); flags (N,), True for episodes that ended; and one
            dictionary per episode. The dictionary of an episode that ended has the entry
            `terminal_observation`, (k,): the last observation before the restart. The others are empty.
        """
        result = self.environments.step(self._actor.controls(self._actions))
        done = result.done.numpy()
        records: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            records = [{"terminal_observation": final} for final in self._seen(result.final)]
        return self._seen(result.observation), result.reward.float().numpy(), done, records

    def _seen(self, observation: Tensor) -> np.ndarray[Any, Any]:
        with torch.no_grad():
            scaled: np.ndarray[Any, Any] = self._actor.normalised(observation.float()).numpy()
        return scaled

    def close(self) -> None:
        """Do nothing: the environment holds no resources."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Value of an attribute, repeated for every environment, since one object simulates all of them."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: ARG002
        """Set an attribute of this object, and so of all environments, whatever `indices`."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of this object once per environment in `indices`; return the results."""
        return [getattr(self, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        """False for each environment, since none is wrapped."""
        return [False for _ in self._get_indices(indices)]


class RandomState:
    """Random numbers of stable-baselines3, kept apart from those of other code.

    The library draws from the global generators of torch and NumPy.

    Attributes:
        torch: state of torch's generator.
        numpy: state of NumPy's generator.
    """

    def __init__(self, seed: int) -> None:
        self.torch = torch.Generator().manual_seed(seed).get_state()
        self.numpy: Any = np.random.RandomState(seed % SEEDS).get_state()

    @contextmanager
    def used(self) -> Iterator[None]:
        """Context in which the global generators continue from the states that this object stores.

        At the end of the context, the object stores the new states of the generators, and the generators get
        back the states that they had before the context.
        """
        others = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002 - the library's
        torch.set_rng_state(self.torch)
        np.random.set_state(self.numpy)  # noqa: NPY002
        try:
            yield
        finally:
            self.torch, self.numpy = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
            torch.set_rng_state(others[0])
            np.random.set_state(others[1])  # noqa: NPY002
            random.setstate(others[2])

    def tensors(self) -> dict[str, Tensor]:
        """States of both generators as tensors by name."""
        _, keys, position, *_ = self.numpy
        return {"torch": self.torch, "numpy": torch.tensor([*keys.tolist(), position])}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore both states from `tensors`, which the method of this name returned."""
        *keys, position = tensors["numpy"].tolist()
        self.torch = tensors["torch"]
        self.numpy = ("MT19937", np.array(keys, np.uint32), position, 0, 0.0)


class SacLearner(ActorLearner):
    """Training of an actor by soft actor-critic (SAC), with stable-baselines3.

    On one machine the same seed and number of steps give the same weights.
    """

    config: SacConfig

    def __init__(
        self, task: Task, config: SacConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        if ranks.size > 1:
            raise usage("method `sac` trains in one process", "stlc train SPEC --method sac")
        super().__init__(task, config, steps=steps, device=device, ranks=ranks)
        reward: Reward = config.reward  # type: ignore[assignment]
        self.actor = SacActor(task, config.hidden)
        self.environments = Environments(task, config.environments, reward=reward, generator=self.generator)
        seen = self.environments.observe(task.sample(SAMPLED, generator=self.generator), 0).float()
        spread = seen.std(0)
        seen[:, -1], spread[-1] = 0.5, 0.3  # the elapsed share: mean and spread of an episode
        self.actor.centre.copy_(seen.mean(0))
        self.actor.spread.copy_(torch.where(spread > NARROW, spread, torch.ones_like(spread)))
        self._random = RandomState(config.seed)
        with self._random.used():
            self.model = self._made()
            self.model.set_logger(Logger(None, []))  # the default one leaves a folder in the temporary ones
            # a step is an episode, so that none is under way between two steps
            _, self._callback = self.model._setup_learn(total_timesteps=1, callback=None)

    def _made(self) -> Any:
        config = self.config
        return SAC(
            "MlpPolicy",
            EpisodesEnv(self.environments, self.actor),
            learning_rate=config.lr,
            buffer_size=max(config.capacity, config.environments),
            learning_starts=config.warmup_transitions,
            batch_size=config.batch,
            tau=config.smoothing,
            gamma=config.discount,
            gradient_steps=config.updates,
            policy_kwargs={"net_arch": {"pi": list(config.hidden), "qf": CRITICS}},
            seed=config.seed % SEEDS,
            device=self.device,
        )

    @property
    def policy(self) -> ActorPolicy:
        """Policy that applies the actor's most probable controls, without exploration noise."""
        theirs = {name: value.detach().cpu() for name, value in self.model.actor.state_dict().items()}
        own = {name: theirs[name] for name in self.actor.state_dict() if name in theirs}
        self.actor.load_state_dict(own, strict=False)
        return ActorPolicy(self.task, self.actor)

    def advance(self) -> float:
        """Play one episode in every environment; after each step of the episodes, make gradient steps.

        Returns:
            The mean loss of the critics; NaN if it, or a weight of the actor, is not finite.
        """
        try:
            loss = self._played()
        except ValueError:  # torch refuses to draw from a distribution with NaN
            if finite_weights(self.model.actor):
                raise
            return math.nan
        if not math.isfinite(loss) or not finite_weights(self.model.actor):
            return math.nan
        self.step += 1
        self.loss = loss
        return loss

    def _played(self) -> float:
        """Play and train as `advance` does; return the mean loss of the critics, 0 before the first."""
        model, losses = self.model, []
        with self._random.used():
            for _ in range(self.environments.steps):
                model.collect_rollouts(
                    model.env,
                    train_freq=model.train_freq,
                    callback=self._callback,
                    learning_starts=model.learning_starts,
                    replay_buffer=model.replay_buffer,
                )
                if model.num_timesteps > model.learning_starts and self.config.updates:
                    model.train(gradient_steps=self.config.updates, batch_size=self.config.batch)
                    losses.append(float(model.logger.name_to_value["train/critic_loss"]))
                    model.logger.name_to_value.clear()
        return sum(losses) / len(losses) if losses else 0.0

    # ------------------------------------------------------------- checkpoints

    def _modules(self) -> dict[str, torch.nn.Module]:
        model = self.model
        return {"actor": model.actor, "critic": model.critic, "target": model.critic_target}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        model = self.model
        found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        return {**found, "entropy": model.ent_coef_optimizer}

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly.

        They contain networks, optimisers, entropy coefficient, replay buffer, the states of the episodes, and
        the states of the random number generators; the one of `warmup` draws the first actions.
        """
        found = super().tensors()
        found |= {f"policy.{name}": value for name, value in self.policy.network.actor.state_dict().items()}
        for prefix, module in self._modules().items():
            found |= {f"{prefix}.{name}": value for name, value in module.state_dict().items()}
        for prefix, optimizer in self._optimizers().items():
            found |= optimizer_tensors(optimizer, f"adam.{prefix}")
        buffer = self.model.replay_buffer
        filled = buffer.buffer_size if buffer.full else buffer.pos
        found |= {f"replay.{name}": torch.from_numpy(getattr(buffer, name)[:filled]) for name in STORED}
        found["entropy"] = self.model.log_ent_coef.detach()
        found["starts"] = self.environments.states
        drawn = json.dumps(self.model.action_space.np_random.bit_generator.state)
        found["warmup"] = torch.tensor(list(drawn.encode()), dtype=torch.uint8)
        return found | {f"random.{name}": value for name, value in self._random.tensors().items()}

    def facts(self) -> dict[str, float | int]:
        model = self.model
        return super().facts() | {
            "transitions": model.num_timesteps,
            "updates": model._n_updates,
            "position": model.replay_buffer.pos,
        }

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        super().restore(tensors, facts)
        model, buffer = self.model, self.model.replay_buffer
        self.actor.load_state_dict(below(tensors, "policy"))
        for prefix, module in self._modules().items():
            module.load_state_dict(below(tensors, prefix))
        for prefix, optimizer in self._optimizers().items():
            restore_optimizer(optimizer, below(tensors, f"adam.{prefix}"))
        with torch.no_grad():
            model.log_ent_coef.copy_(tensors["entropy"])
        for name in STORED:
            stored = tensors[f"replay.{name}"].numpy()
            getattr(buffer, name)[: len(stored)] = stored
        buffer.pos = int(facts["position"])
        buffer.full = len(stored) == buffer.buffer_size
        model.num_timesteps, model._n_updates = int(facts["transitions"]), int(facts["updates"])
        self.environments.reset(tensors["starts"])
        model._last_obs = model.env.observed()
        self._random.restore(below(tensors, "random"))
        if "warmup" in tensors:  # checkpoints of older versions lack it
            drawn = json.loads(bytes(tensors["warmup"].tolist()))
            model.action_space.np_random.bit_generator.state = drawn
