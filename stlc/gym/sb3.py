"""Environments of a task for Stable-Baselines3, which has its own class of vector environments.

The module needs the package stable-baselines3.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from stlc.diagnostics import usage
from stlc.extras import explained
from stlc.gym.pictures import Picture
from stlc.gym.spaces import Floats
from stlc.gym.vector import SpecVectorEnv

with explained():
    from stable_baselines3.common.vec_env import VecEnv

Indices: TypeAlias = Iterable[int] | int | None


class SB3VecEnv(VecEnv):  # type: ignore[misc]
    """Adapter from `SpecVectorEnv` to the class `VecEnv` of Stable-Baselines3.

    At the end of an episode the info of an environment holds `terminal_observation`; `episode`, the return
    and length of the episode, which the logs of learners show; `rho`, the robustness of the specification;
    `satisfied`; and `state`.

    Args:
        env: environments that are reset in the step that ends an episode (`AutoresetMode.SAME_STEP`).

    Raises UsageError (U101) if the environments have another autoreset mode.
    """

    def __init__(self, env: SpecVectorEnv) -> None:
        if env.autoreset is not AutoresetMode.SAME_STEP:
            raise usage("learners of Stable-Baselines3 read `terminal_observation`", "take SAME_STEP")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(env.action_space.shape or (), dtype=np.float32)
        self._earned = np.zeros(env.num_envs)

    def reset(self) -> Floats:
        """Begin all episodes and return the observations, (N, k).

        The seed is the one that the method `seed` of `VecEnv` received last.
        """
        seen, info = self.env.reset(seed=self._seeds[0], options=self._options[0])
        self.reset_infos = [{"state": state} for state in info["state"]]
        self._reset_seeds()
        self._reset_options()
        self._earned[:] = 0.0
        return seen

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the actions (N, m) that `step_wait` applies."""
        self._actions = actions

    def step_wait(self) -> tuple[Floats, Floats, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all environments by one step under the stored actions.

        Returns:
            Observations (N, k), rewards (N,), whether episodes ended (N,), and one info dictionary per
            environment.
        """
        seen, reward, done, _, info = self.env.step(self._actions)
        self._earned += reward
        told: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if "final_info" in info:
            told = self._told(info)
            self._earned[:] = 0.0
        return seen, reward.astype(np.float32), done, told

    def _told(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """One info dictionary per environment, at the end of all episodes.

        `info`: the single dictionary that the vector environment returned for all environments.
        """
        end = info["final_info"]
        rows = zip(info["final_obs"], self._earned, end["rho"], end["satisfied"], end["state"], strict=True)
        return [
            {
                "terminal_observation": seen,
                "TimeLimit.truncated": False,
                "episode": {"r": float(earned), "l": self.env.steps, "t": 0.0},
                "rho": float(rho),
                "satisfied": bool(satisfied),
                "is_success": bool(satisfied),
                "state": state,
            }
            for seen, earned, rho, satisfied, state in rows
        ]

    def get_images(self) -> Sequence[Picture]:
        """Pictures of all environments, which must have been made with `render_mode="rgb_array"`."""
        return self.env.render()

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Value of an attribute, repeated for every environment, since all share it."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of all environments. Raises UsageError (U101) if `indices` omits some."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise usage("all environments share their attributes", "leave `indices` out")
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **options: Any) -> list[Any]:
        """Call a method once for all environments; return its result, repeated for every environment."""
        found = getattr(self.env, method_name)(*args, **options)
        return [found for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> Sequence[bool]:  # noqa: ARG002
        """False for each environment, since none is wrapped."""
        return [False for _ in self._get_indices(indices)]
