"""MBPO: model-based policy optimisation (Janner, Fu, Zhang and Levine, NeurIPS 2019).

An ensemble of networks learns the system from episodes of the policy. Short imagined episodes, which the
ensemble predicts, begin at states that were observed in these episodes. Soft actor-critic learns from the
imagined transitions, and from a few observed ones. The rewards of imagined steps are computed from the task,
not learnt. The rewards `robustness` and `accuracy` need a whole trajectory. They are given if an imagined
episode reaches the last step of a plan. The trajectory then consists of the observed states before the
imagined episode, followed by the imagined states.

Meng and Fan (2023) compare with MBPO under these settings: `environments=1 growth=0 imagined=400 longest=15
growing_from=20 growing_to=150 until=1 updates=10 critic_width=512 model_lr=1e-3 model_batch=256
temperature=0.2`, and `--lr 3e-4`. Unlike here, they also learn the reward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from benchmarks.methods._actor import ActorPolicy, finite_weights
from benchmarks.methods._imagined import ModelConfig, ModelLearner, final_reward, step_rewards
from benchmarks.methods._soft_actor_critic import BOUND, SacOptions, SoftActorCritic, TransitionBatch
from stlc.controller.options import bounded
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.policies.policy import ActorNetwork, DenseLayers
from stlc.controller.run.run import load_weights
from stlc.controller.training.config import base_config
from stlc.controller.training.method import Method

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.run.config import ResolvedConfig
    from stlc.controller.training.config import TrainConfig
    from stlc.rundir import RunDir

BATCH, RATE, HIDDEN = 256, 1e-3, (128, 128)
EVERY, POOL = 5, 500
"""Steps between validations, and the states judged by one."""


@dataclass(frozen=True, slots=True)
class MbpoConfig(ModelConfig):
    """Options of MBPO.

    Attributes:
        imagined: number of imagined episodes per observed step.
        shortest: length of imagined episodes at the beginning of training, in steps.
        longest: length of imagined episodes at the end of training, in steps.
        growing_from: training step from which the length grows linearly from `shortest`.
        growing_to: training step at which the length reaches `longest`.
        until: share of the planned steps after which the networks are not trained any more, see
            `ModelConfig`.
        observed: share of observed transitions in a batch; the others are imagined.
        updates: number of gradient steps of actor and critics for every observed step.
        critic_width: number of units per hidden layer of actor and critics.
        discount: discount factor of the return.
        follow: share by which the target critics move towards the critics in a gradient step.
        temperature: weight of the entropy; 0: the weight is learnt.
    """

    imagined: float = 10.0
    shortest: int = bounded(1, 1, 10**6)
    longest: int = bounded(5, 1, 10**6)
    growing_from: int = 5
    growing_to: int = 40
    until: float = bounded(0.5, 0, 1)
    observed: float = bounded(0.05, 0, 1)
    updates: float = 0.5
    critic_width: int = bounded(128, 1, 8192)
    discount: float = bounded(0.99, 0, 1)
    follow: float = bounded(0.005, 0, 1)
    temperature: float = 0.0


class Acting(ActorNetwork):
    """Network from observations to controls in physical units: the actor of a soft actor-critic.

    Args:
        task: the task, whose control ranges scale the actions from [-1, 1].
        learner: soft actor-critic, whose actor is used.
    """

    squash = "tanh"

    def __init__(self, task: Task, learner: SoftActorCritic) -> None:
        super().__init__()
        self._learner = learner
        low, high = task.system.control_low, task.system.control_high
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)

    @property
    def layers(self) -> DenseLayers:
        """Weights of the actor; of its last layer, only those of the means."""
        learner, count = self._learner, len(self._half)
        weights = [weight[0].T for weight in learner.actor.weights]
        biases = [bias[0, 0] for bias in learner.actor.biases]
        return DenseLayers(
            *(learner.centre, learner.spread, BOUND),
            (*weights[:-1], weights[-1][:count]),
            (*biases[:-1], biases[-1][:count]),
            "relu",
        )

    def forward(self, observation: Tensor) -> Tensor:
        """The most probable controls in physical units, for observations: (B, k) -> (B, m)."""
        return self.physical(self._learner(observation))

    def physical(self, actions: Tensor) -> Tensor:
        """Scale actions from [-1, 1] to controls in physical units: (…, m) -> (…, m)."""
        return self._middle + self._half * actions

    def shares(self, controls: Tensor) -> Tensor:
        """Scale controls in physical units to actions in [-1, 1]: (…, m) -> (…, m)."""
        return (controls - self._middle) / self._half.clamp(min=1e-12)


class MbpoLearner(ModelLearner):
    """Training by MBPO: the ensemble learns from observed episodes, actor and critics from imagined ones."""

    config: MbpoConfig

    def __init__(
        self, task: Task, config: MbpoConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        super().__init__(task, config, steps=steps, device=device, ranks=ranks)
        self.actor_critic = actor_critic_of(task, config)
        self.acting = Acting(task, self.actor_critic)

    @property
    def policy(self) -> ActorPolicy:
        """Policy that applies the actor's most probable controls, without exploration noise."""
        return ActorPolicy(self.task, self.acting)

    @property
    def length(self) -> int:
        """Present length of imagined episodes, in steps."""
        config = self.config
        share = (self.step - config.growing_from) / max(1, config.growing_to - config.growing_from)
        share = min(max(share, 0.0), 1.0)
        return max(1, round(config.shortest + share * (config.longest - config.shortest)))

    def advance(self) -> float:
        """Simulate one episode per environment; then train actor and critics.

        Returns:
            The mean loss of the critics; NaN if it, a weight of the actor, or every imagined transition is
            not finite, or if the first training of the ensemble diverged.
        """
        before = self.environment_steps

        def act(states: Tensor, step: int) -> Tensor:
            seen = self._seen(states, torch.full((len(states),), step))
            return self.acting.physical(self.actor_critic.explore(seen, self.generator))

        if not self.observed(act):
            return math.nan
        if not before:
            self._normalise()
        fresh = self.config.environments * self.task.horizon
        imagined = self._imagined(max(1, round(self.config.imagined * fresh)))
        if not len(imagined.rewards):
            return math.nan
        total = torch.zeros(())
        updates = max(1, round(self.config.updates * fresh))
        for _ in range(updates):
            total += self.actor_critic.learn(self._mixed(imagined), self.generator)
        loss = float(total) / updates
        if not math.isfinite(loss) or not finite_weights(self.actor_critic.actor):
            return math.nan
        self.step, self.loss = self.step + 1, loss
        return loss

    def _seen(self, states: Tensor, steps: Tensor) -> Tensor:
        """Observations of states (B, n) at the steps `steps` (B,) of an episode: (B, k).

        The last entry is the elapsed share of the episode.
        """
        seen = self.task.system.observe(states)
        return torch.cat((seen, (steps / self.task.horizon)[:, None].to(seen)), 1)

    def _normalise(self) -> None:
        """Set the normalisation of observations and rewards from the episodes stored at present."""
        kept = self.episodes
        states = kept.states[: kept.count]
        steps = torch.arange(states.shape[1]).repeat(len(states))
        self.actor_critic.normalise(
            self._seen(states.flatten(0, 1), steps), kept.rewards[: kept.count].sum(1)
        )

    def _drawn(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw random observed steps; return the indices of their episodes and the steps, (count,) each."""
        episodes = torch.randint(self.episodes.count, (count,), generator=self.generator)
        return episodes, torch.randint(self.task.horizon, (count,), generator=self.generator)

    def _mixed(self, imagined: TransitionBatch) -> TransitionBatch:
        """Draw a batch: the share `config.observed` from observed transitions, the rest from `imagined`."""
        size = self.config.batch
        real = min(size, round(self.config.observed * size))
        rows = torch.randint(len(imagined.rewards), (size - real,), generator=self.generator)
        return imagined.of(rows).joined(self._observed_batch(real)) if real else imagined.of(rows)

    def _observed_batch(self, count: int) -> TransitionBatch:
        """Draw `count` random observed transitions."""
        episodes, steps = self._drawn(count)
        kept, after = self.episodes, steps + 1
        return TransitionBatch(
            self._seen(kept.states[episodes, steps], steps),
            self.acting.shares(kept.actions[episodes, steps]),
            kept.rewards[episodes, steps],
            self._seen(kept.states[episodes, after], after),
            (after == self.task.horizon).float(),
        )

    @torch.no_grad()
    def _imagined(self, count: int) -> TransitionBatch:
        """Imagine at least `count` episodes of up to `length` steps, from random observed states.

        `count` is rounded up to a multiple of the number of networks that predict.

        Returns:
            The transitions of all steps, without those whose states or rewards are not finite.
        """
        model, horizon, length = self.model, self.task.horizon, self.length
        members = model.predictor.elites
        count = -(-count // members) * members
        episodes, steps = self._drawn(count)
        paths = self.episodes.states[episodes]  # (count, T+1, n): observed up to `steps`, then imagined
        rows, found = torch.arange(count), []
        for _ in range(length):
            x = paths[rows, steps]
            seen = self._seen(x, steps)
            actions = self.actor_critic.explore(seen, self.generator)
            controls = self.acting.physical(actions)
            split = (members, -1)
            moved = model.step(
                x.view(*split, x.shape[1]), controls.view(*split, controls.shape[1]), self.generator
            ).flatten(0, 1)
            going = steps < horizon
            after = (steps + 1).clamp(max=horizon)
            paths[rows[going], after[going]] = moved[going]
            earned = self._earned(paths, x, moved, controls, going & (after == horizon))
            ended = (after == horizon).float()
            parts = (seen, actions, earned, self._seen(moved, after), ended)
            finite = going & torch.isfinite(moved).all(1) & torch.isfinite(earned)
            found.append(TransitionBatch(*parts).of(finite.nonzero()[:, 0]))
            steps = after
        whole = found[0]
        for part in found[1:]:
            whole = whole.joined(part)
        return whole

    def _earned(self, paths: Tensor, x: Tensor, moved: Tensor, controls: Tensor, ends: Tensor) -> Tensor:
        """Rewards of one imagined step of B episodes: (B,).

        Args:
            paths: states of the whole episodes, filled up to the state after the step, (B, T+1, n).
            x: states before the step, (B, n).
            moved: states after the step, (B, n).
            controls: controls of the step, (B, m).
            ends: True for the episodes that end with this step, (B,).
        """
        if self.reward == "task":
            return step_rewards(self.task, x, moved, controls)
        earned = x.new_zeros(len(x))
        at = ends.nonzero()[:, 0]
        if len(at):
            earned[at] = final_reward(self.task, self.reward, paths[at])
        return earned

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly.

        Imagined transitions are not among them, because every training step imagines new ones.
        """
        return super().tensors() | self.actor_critic.tensors()

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        super().restore(tensors, facts)
        self.actor_critic.restore(tensors)


class Mbpo(Method):
    """Soft actor-critic that learns from short episodes imagined by a learnt ensemble."""

    options = MbpoConfig
    learns = MbpoLearner
    version = 1

    def resolve(self, task: Task, config: TrainConfig) -> MbpoConfig:
        """Determine the options; `--batch` and `--lr` apply to actor and critics, not to the ensemble."""
        found = base_config(task, config, kind=MbpoConfig, rate=RATE)
        return replace(found, hidden=HIDDEN, plans=1, batch=config.batch or BATCH, every=EVERY, pool=POOL)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> ActorPolicy:  # noqa: ARG002
        """Load the actor of a run as a policy."""
        assert isinstance(config, MbpoConfig)
        found = load_weights(run, actor_critic_of(task, config), "sac.weights")
        return ActorPolicy(task, Acting(task, found).eval())


def actor_critic_of(task: Task, config: MbpoConfig) -> SoftActorCritic:
    """Make actor and critics whose initial weights depend only on `config.seed`."""
    return SoftActorCritic(
        task.system.observed_count + 1,
        len(task.system.control_names),
        width=config.critic_width,
        options=SacOptions(config.lr, config.discount, config.follow, config.temperature),
        generator=torch.Generator().manual_seed(config.seed),
    )


METHOD = Mbpo()
