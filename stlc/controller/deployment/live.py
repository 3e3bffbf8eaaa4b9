"""Live monitor of a deployment: robustness margins of the requirements, and origins of the plans."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.controller.guard.candidates import SOURCES
from stlc.jsontext import Count, Num
from stlc.monitor.online.online import Margin, Online

if TYPE_CHECKING:
    from stlc.controller.deployment.batched import Setting
    from stlc.controller.deployment.simulator import SimulationStep
    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class RobustnessLine:
    """Line that `stlc simulate --robustness` writes for an agent at a step.

    Attributes:
        step, t: step of the deployment, and its time in seconds.
        seed, agent: seed of the run, and number of the agent.
        decided: what made its plan; None after the last step, as are the following.
        plan_rho: robustness of the plan that is followed.
        policy_rho: robustness of the plan of the policy.
        plan_safe: whether the plan that is followed satisfies the requirements tagged `@safety`.
        margins: name of a requirement -> its margin.
    """

    step: Count
    t: float
    seed: int
    agent: Count
    decided: str | None
    plan_rho: Num | None
    policy_rho: Num | None
    plan_safe: bool | None
    margins: Mapping[str, Margin]


class LiveMonitor:
    """Online monitor of all agents of a deployment; it evaluates the same requirements as `stlc check`.

    `push` only stores the states; the robustness margins are computed when `margins` is called.

    Args:
        task: specification and system.
        setting: options of the deployment.
    """

    def __init__(self, task: Task, setting: Setting) -> None:
        self.task, self.setting = task, setting
        self.moment: SimulationStep | None = None
        self.counts: NDArray[np.int64] = np.zeros(len(SOURCES), dtype=np.int64)
        self._monitors: list[Online] = []
        self._states: list[NDArray[np.float64]] = []
        self._found: dict[str, list[Margin]] = {}

    def push(self, moment: SimulationStep) -> None:
        """Append the next step of the deployment."""
        self.moment = moment
        self._states.append(moment.x.numpy(force=True))
        if moment.decision is not None:
            self.counts += np.bincount(moment.decision.source.numpy(force=True), minlength=len(SOURCES))

    @property
    def margins(self) -> dict[str, list[Margin]]:
        """Name of a requirement -> its margin for each agent at the latest step; {} before the first step."""
        if self._states:
            states = np.stack(self._states, axis=1, dtype=np.float64)  # (agents, samples, states)
            self._states.clear()
            compiled = self.task.compiled
            self._monitors = self._monitors or [Online(compiled, compiled.recorded) for _ in states]
            columns = [self.task.system.names.index(name) for name in self._monitors[0].signals]
            for online, rows in zip(self._monitors, states, strict=True):
                online.push_block(rows[:, columns])
            for name in self._monitors[0].requirements:
                self._found[name] = [online.margin(name) for online in self._monitors]
        return self._found

    @property
    def time(self) -> float:
        """Time of the latest sample in seconds."""
        return (self.moment.step if self.moment else 0) * self.task.system.dt

    def decided(self, row: int) -> str | None:
        """Name of the method that made the plan of the agent in row `row`; None after the last step.

        Examples: `policy`; `backup T0=2`, a plan of the backup policy with a prefix of 2 actions.
        """
        decision = self.moment.decision if self.moment else None
        if decision is None:
            return None
        name, t0 = SOURCES[int(decision.source[row])], int(decision.t0[row])
        return f"{name} T0={t0}" if name == "backup" else name

    def lines(self) -> Iterator[RobustnessLine]:
        """Yield, for the latest step, the line of each agent."""
        assert self.moment is not None
        margins, decision = self.margins, self.moment.decision
        for row in range(len(self.moment.x)):
            seed, agent = divmod(row, self.setting.agents)
            yield RobustnessLine(
                step=self.moment.step,
                t=round(self.time, 9),
                seed=self.setting.seeds[seed],
                agent=agent,
                decided=self.decided(row),
                plan_rho=None if decision is None else float(decision.rho[row]),
                policy_rho=None if decision is None else float(decision.policy_rho[row]),
                plan_safe=None if decision is None else bool(decision.safe[row]),
                margins={name: found[row] for name, found in margins.items()},
            )
