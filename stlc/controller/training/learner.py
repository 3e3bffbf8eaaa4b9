"""Training state of a plan network: gradient steps, searches for plans, validation, checkpoint contents.

Every few dozen steps the policy's plans from newly drawn states are judged. In the method `guided`, a search
starts from the plans that fail, and tries to repair them. The network imitates a repaired plan for as long as
its own plans from the same state fail. Each gradient step uses newly drawn (fresh) states, and states at
which the policy failed before (hard states). The network proposes several plans per state. Mainly the best of
them is trained (winner takes all). The mean loss of all plans has a small weight, so that no plan stays
untrained.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import below
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.run.run import load_weights
from stlc.controller.search.local_search import TAILS, THOROUGH, Search, Searcher, SearchResult, remainders
from stlc.controller.search.planner import PlanBudget, plan
from stlc.controller.training.adam import Adam
from stlc.controller.training.diagnose import TrainingStep, diagnose
from stlc.controller.training.failures import FailureStates
from stlc.controller.training.method import Learner, Method, Validation
from stlc.controller.training.mission_plans import mission_plans
from stlc.controller.training.objective import Objective, loss
from stlc.controller.training.samplers import Draws, FixedSet, Missions, ReplayBuffer, Supply
from stlc.diagnostics import StlcError
from stlc.native import Stop, never
from stlc.registry import METHODS
from stlc.rundir import RunDir

MARGIN_STATES = 128
"""Number of states from which the search looks for the largest robustness, to choose the margin."""
MARGIN_SHARE = 0.8
"""Margin of the loss, as a share of the median of the largest robustness that the search finds."""
MARGIN_RANGE = (0.04, 2.0)
"""Least and greatest margin of the loss."""
TARGET_SHARE = 0.05
"""Robustness at which the search for a satisfying plan stops, as a share of the margin."""
TORCH_MARGIN_STATES, TORCH_MOST, TORCH_TRIES = 32, 64, 2048
"""Limits for searches in torch, which are some hundred times slower than native ones.

They are: states for the margin, states per search round, and plans tried per state.
"""
BARREN = 0.05
"""Share of failing states solved by local search below which whole plans are searched for too."""
LEARNT = 0.5
"""Accuracy on fresh states at and above which they are not."""
NEAREST = 0.75
"""Share of the states of a search round that are chosen because their plans fail by the least amount."""
COUNTS = ("accuracy", "solved", "barren", "effort", "failing")
"""Facts of which every rank (process) has its own, in the order in which a checkpoint stores them."""
DRIVEN = 8
"""States of failing drives in a search round: one for so many fresh ones, beside them."""
EXPLORED = 4
"""Number of initial states from which the planner `search` searches before a validation."""
EFFORTS = 20_000, 80_000, 320_000
"""Plans that it judges for each of them at first, and after each search that found none."""
HUGE, STEEPEST = 1e15, 4.0
"""Entries of a gradient that count as infinite; greatest norm of a plan's gradient, in medians."""
RISE = 30
"""Steps over which the learning rate rises if its peak is held; independent of the total number of steps."""


def _margin(reached: Tensor) -> float:
    """Margin of the loss for plans that reach the robustness `reached`, (k,)."""
    return min(max(MARGIN_SHARE * float(reached.median()), MARGIN_RANGE[0]), MARGIN_RANGE[1])


def _finite_mean(losses: Tensor) -> Tensor:
    """Mean of the losses that are finite, (); NaN if none is.

    Along a mission, a plan under which a state overflows does not end the training.
    """
    return losses[torch.isfinite(losses.detach())].mean()


def _bounded_slopes(slopes: Tensor) -> Tensor:
    """Gradient by plans, (B, plans, T, m), in which no plan outweighs the others.

    Along a mission the gradient of some plans grows beyond bounds. If one is not finite, it becomes 0; its
    norm is limited to `STEEPEST` times the median of the others.
    """
    slopes = torch.where(slopes.abs() < HUGE, slopes, 0.0)
    norms = slopes.flatten(2).norm(dim=2)
    pulled = norms[norms > 0.0]
    if not len(pulled):
        return slopes
    limit = STEEPEST * pulled.median()
    bounded: Tensor = slopes * (limit / norms.clamp(min=limit))[:, :, None, None]
    return bounded


class Trainer(Learner):
    """Training of a network that proposes plans, by gradient steps on their robustness.

    On one machine, equal seeds and numbers of steps give equal weights.
    """

    def __init__(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        super().__init__(task, config, steps=steps, device=device, ranks=ranks)
        self.method: NetworkMethod = METHODS.get(config.method)
        self.network = self._network()
        self.supply: Supply = Draws(task, self.generator, self.device)
        if task.compiled.timers:  # states that simulated missions visit
            policy = BestOfKPolicy(task, self.network)
            self.supply = Missions(task, self.generator, self.device, lambda x0: policy.plan_judged(x0)[1])
        self.average = self._network()
        self.network.normalise(self.supply.take(4096))
        ranks.agree_on(self.network)
        self.training = (
            FixedSet(self.supply, config.samples, self.generator) if config.samples else self.supply
        )
        self.average.load_state_dict(self.network.state_dict())
        self.optimizer = Adam(self.network.parameters())
        self.buffer = ReplayBuffer.empty(
            len(task.system.names), task.horizon, len(task.system.control_names), device
        )
        self.searches = self.method.searches
        if self.searches:
            whole = task.compiled.grid.end is not None
            self.margin = ranks.agree(self._begin_at_plans() if whole else self._feasible_margin())
        self.objective = self.method.objective(self)
        self.searcher = self._searcher(TARGET_SHARE * self.margin)
        self.repairing: Search | None = None
        self.barren, self.effort, self.explored = False, 0, 0
        self.accuracy, self.failing = 0.0, 0
        self.learnt = torch.empty(0, len(task.system.names), device=device)
        self.safety: Task | None = None
        if config.falsify:
            self.failures = FailureStates(torch.empty(0, len(task.system.names), device=device))
            self.safety = task.safety_task if task.compiled.safety else None

    def advance(self) -> float:
        """Make one gradient step and return its loss.

        If the loss or its gradient is not finite, the weights stay as they are and NaN is returned.
        """
        value = self._loss()
        self.optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        value = self.ranks.learn(self.network.parameters(), value.detach())
        length = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if not bool(torch.isfinite(value + length)):
            return math.nan
        self.optimizer.step(self.rate)
        self.step += 1
        decay = min(self.config.average, self.step / (self.step + 10.0))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.network.parameters(), strict=True)
            for averaged, current in pairs:
                averaged.lerp_(current, 1.0 - decay)
        self.loss = float(value)
        if self.repairing is not None:
            self.repairing.advance()
        return self.loss

    @property
    def rate(self) -> float:
        """Learning rate of the next step: it rises linearly, stays constant, and falls to 0 like a cosine."""
        config, hold = self.config, self.config.hold
        rise = min(1.0, (self.step + 1) / (RISE if hold else max(1.0, config.warmup * self.steps)))
        fallen = max(0.0, self.step / self.steps - hold) / (1.0 - hold)
        return config.lr * rise * 0.5 * (1.0 + math.cos(math.pi * fallen))

    @property
    def policy(self) -> BestOfKPolicy:
        """Policy with the moving average of the network's weights, on the CPU."""
        on_processor = self.device.type == "cpu"
        return BestOfKPolicy(self.task, self.average if on_processor else deepcopy(self.average).cpu())

    @property
    def searching(self) -> bool:  # type: ignore[override]
        """True while a search for better plans runs concurrently with the steps."""
        return self.repairing is not None and not self.repairing.done()

    @property
    def solved(self) -> bool:  # type: ignore[override]
        """True once a search has found a satisfying plan."""
        return self.buffer.count > 0

    def torch_reasons(self) -> Mapping[str, str]:
        smooth = self.objective.smoothing is not None
        return self.task.torch_reasons(self.device.type, searches=self.searches, smooth=smooth)

    def wait(self, stop: Stop = never) -> bool:
        return self.repairing is None or self.repairing.result(stop) is not None

    def diagnose(self) -> tuple[StlcError, bool]:
        theirs = [part["x0"].to(self.device) for part in self.ranks.gather({"x0": self.learnt})]
        x0 = torch.cat((self.learnt, *theirs))
        step = TrainingStep.of(self.network, self.objective, x0, self.step, self.task)
        good = not self.ranks.any(not bool(torch.isfinite(step.u).all()))
        return diagnose(step), good

    @torch.no_grad()
    def explore(self, stop: Stop = never) -> bool:
        """Search for plans by the planner `search`, if the last local search solved hardly any state.

        The planner looks at the order of the goals too. The plans found are imitated from then on; if there
        are none, the next search is longer.

        Returns:
            False if `stop` ended the search early, which then has no effect; else True.
        """
        if not self.barren:
            return True
        before = self.generator.get_state()
        starts = self.task.sample(EXPLORED, generator=self.generator)
        seed = int(torch.randint(2**62, (), generator=self.generator))
        budget = PlanBudget(torch.inf, EFFORTS[self.effort], self.searcher.target, stop)
        searched = plan(self.task, starts, budget=budget, seed=seed)
        if stop():
            self.generator.set_state(before)
            return False
        plans = SearchResult(starts, searched.plans.to(starts.dtype), searched.rho).of(searched.satisfied)
        count = TAILS if self.task.compiled.timers else 1
        found = remainders(self.task, plans, count).to(self.device)
        self.buffer.add(found.states, found.plans)
        self.supply.follow(found.states, found.plans)
        self.barren, self.explored = False, len(found.rho)
        self.effort += self.explored == 0
        return True

    @property
    def exhausted(self) -> bool:  # type: ignore[override]
        """True once the longest search by the planner `search` has found no plan."""
        return self.effort >= len(EFFORTS)

    @torch.no_grad()
    def validate(self) -> Validation:
        """Judge the policy's plans from newly drawn states, and start a search where they fail.

        The search, which only some methods make, runs concurrently with the training steps. Its results are
        collected by the next validation.
        """
        x0 = self.supply.take(self.config.pool)
        plans, judged = BestOfKPolicy(self.task, self.network).plan_judged(x0)
        good = judged.satisfied
        fresh = Validation.of(judged)
        accuracy = fresh.accuracy
        self.next_validation = self.step + self.config.every
        if not self.searches:
            return fresh.mean(self.ranks)
        failing, repaired, before = self._take_repaired()
        feasible = None if before is None else max(before, accuracy)
        bad = self._to_repair(judged.rho, ~good)
        x0, plans = self._with_failures(x0[bad], plans[bad])
        self.repairing = self._begin(x0, plans)
        self.failing = int((~good).sum())
        self.accuracy = accuracy
        self.barren = repaired < BARREN * failing and accuracy < LEARNT and not self.exhausted
        explored, self.explored = self.explored, 0
        found = replace(fresh, feasible=feasible, failing=failing, repaired=repaired, explored=explored)
        return found.mean(self.ranks)

    def _to_repair(self, rho: Tensor, failing: Tensor) -> Tensor:
        """Choose the failing states of a search round: those nearest to success, and some of the others.

        A search is far more likely to repair a plan that nearly satisfies the specification. Plans that
        violate the specification by much often start from states without any satisfying plan.

        Args:
            rho: robustness of the policy's plans, (B,).
            failing: mask of the states whose plan violates the specification, (B,).

        Returns:
            Indices of the chosen states, (k,): `NEAREST` of them by decreasing robustness, then the rest in
            the order in which they were drawn; all failing states if they fit into a round.
        """
        rows, most = failing.nonzero()[:, 0], self._effort[0]
        near = self._nearest(len(rows))
        chosen = torch.zeros_like(failing)
        first = rows[rho[rows].argsort(descending=True, stable=True)[:near]]
        chosen[first] = True
        return torch.cat((first, rows[~chosen[rows]]))[:most]

    def _with_failures(self, x0: Tensor, plans: Tensor) -> tuple[Tensor, Tensor]:
        """Append states of failing drives from which the policy still fails, and its plans from there.

        Args:
            x0: states of a search round, (k, n).
            plans: the policy's plans, (k, T, m).
        """
        if self.failures is None or not len(self.failures.states):
            return x0, plans
        kept = self.failures.drawn(self.config.pool // DRIVEN, self.generator)
        tried, judged = BestOfKPolicy(self.task, self.network).plan_judged(kept)
        rows = (~judged.satisfied).nonzero()[:, 0][: max(self._effort[0] // DRIVEN, 1)]
        self.failures.repairing = len(rows)
        return torch.cat((x0, kept[rows])), torch.cat((plans, tried[rows].to(plans)))

    def _nearest(self, failing: int) -> int:
        """Number of states that a search round chooses by their robustness, out of `failing` states."""
        most = self._effort[0]
        return failing if failing <= most else math.ceil(NEAREST * most)

    def _begin(self, x0: Tensor, plans: Tensor, seed: int | None = None) -> Search:
        """Start a search for better plans than `plans` from states `x0`; it runs until the next validation.

        `seed`: seed of its random numbers.
        """
        tries, steps = self._effort[1], self.config.every
        return self.searcher.begin(x0, plans, self.buffer.library, tries=tries, steps=steps, seed=seed)

    @property
    def _effort(self) -> tuple[int, int]:
        """Maximum number of failing states in a search round, and of plans judged for each of them."""
        most = math.ceil(self.config.most * self.task.window / self.task.horizon)
        return (most, THOROUGH) if self.task.native is not None else (min(most, TORCH_MOST), TORCH_TRIES)

    def close(self) -> None:
        """Cancel the running search."""
        if self.repairing is not None:
            self.repairing.cancel()

    def _take_repaired(self) -> tuple[int, int, float | None]:
        """Wait for the last search, and add its plans to the replay buffer and the source of training states.

        Returns:
            Number of states searched, number of states for which a satisfying plan was found, and the
            estimated share of states with a known satisfying plan; 0, 0 and None without a search.
        """
        if self.repairing is None:
            return 0, 0, None
        repaired_by_then = self.repairing.result()
        assert repaired_by_then is not None
        found = repaired_by_then.to(self.device)
        solved = found.solved
        good = found.of(solved)
        self.supply.follow(good.states, good.plans)
        if self.task.compiled.grid.end is not None and len(good.rho):
            good = remainders(self.task, good, TAILS)
        self.buffer.add(good.states, good.plans)
        if self.failures is not None:  # the estimate is that of the fresh states
            solved = solved[: len(solved) - self.failures.repairing]
            self.failures.repairing = 0
        near = min(self._nearest(self.failing), len(solved))
        nearest, others = solved[:near], solved[near:]
        of_others = float(others.double().mean()) if len(others) else 0.0
        rate = (int(nearest.sum()) + of_others * max(self.failing - near, 0)) / max(1, self.failing)
        return len(solved), int(solved.sum()), self.accuracy + (1.0 - self.accuracy) * rate

    # ------------------------------------------------------------------ loss and supply

    def _loss(self) -> Tensor:
        config = self.config
        fresh = self.training.take(config.batch)
        if self.failures is not None:
            fresh = self.failures.mixed(fresh, self.generator)
        hard = config.hard if len(self.buffer) else 0
        x0, targets = fresh, fresh.new_zeros(0)
        if hard:
            states, targets = self.buffer.draw(hard, self.generator)
            x0 = torch.cat((fresh, states))
        self.learnt = x0
        plans: Tensor = self.network(x0)
        if self.task.compiled.grid.end is not None:
            plans.register_hook(_bounded_slopes)  # type: ignore[no-untyped-call]
        winner, good = self._winner(x0, plans)
        rows = torch.arange(len(x0), device=self.device)
        chosen = plans[rows, winner]
        mean = torch.mean if self.task.compiled.grid.end is None else _finite_mean
        value = mean(loss(self.task, self.objective, x0, chosen))
        if config.share:
            some = rows[:: config.plans]
            other = torch.randint(config.plans, (len(some),), generator=self.generator).to(self.device)
            others = loss(self.task, self.objective, x0[some], plans[some, other])
            value = value + config.share * mean(others)
        if self.failures is not None and self.safety is not None:
            value = value + self._unsafe(self.safety, x0[: config.batch], plans[: config.batch])
        if hard:
            value = value + self._imitation(plans[-hard:], targets, good[-hard:])
        return value

    def _unsafe(self, safety: Task, x0: Tensor, plans: Tensor) -> Tensor:
        """Safety loss of every proposed plan from the states of failing drives, ().

        From many of these states no plan satisfies the whole specification, but one is safe. The robustness
        of the whole specification does not say which: it is that of the requirement that cannot be satisfied.

        Args:
            safety: the task with the requirements tagged `@safety` only.
            x0: fresh states of a step, the last of which are from failing drives, (B, n).
            plans: proposed plans, (B, plans, T, m).
        """
        assert self.failures is not None
        count = self.failures.count(len(x0))
        if not count:
            return plans.new_zeros(())
        states = x0[-count:].repeat_interleave(plans.shape[1], 0)
        objective = replace(self.objective, performance_weight=0.0)
        return loss(safety, objective, states, plans[-count:].flatten(0, 1)).mean()

    @torch.no_grad()
    def _winner(self, x0: Tensor, plans: Tensor) -> tuple[Tensor, Tensor]:
        """Find the best of the proposed plans (B, plans, T, m) of each state.

        Returns:
            Index of the best plan, (B,); and whether any of the plans satisfies the specification, (B,). If
            there is one plan per state and `config.hard` is 0, nothing is judged: all are 0 and False.
        """
        batch, count = plans.shape[:2]
        if count == 1 and self.config.hard == 0:
            first = torch.zeros(batch, dtype=torch.int64, device=self.device)
            return first, torch.zeros_like(first, dtype=torch.bool)
        judged = self.task.judge(x0.repeat_interleave(count, 0), plans.flatten(0, 1))
        score = self.task.rank(judged, safety=False).view(batch, count)
        return score.argmax(1), judged.satisfied.view(batch, count).any(1)

    def _imitation(self, plans: Tensor, targets: Tensor, solved: Tensor) -> Tensor:
        """Imitation loss of the states for which a search has found a plan, ().

        The loss of a state is the squared distance from the plan found, (k, T, m), to the nearest plan of
        `plans`, (k, plans, T, m); it is 0 where a proposed plan is `solved`, (k,).
        """
        half = (0.5 * (self.task.system.control_high - self.task.system.control_low)).to(plans.device)
        distance = ((plans - targets[:, None]) / half).square().mean((2, 3)).amin(1)
        return self.config.imitation * torch.where(solved, torch.zeros_like(distance), distance).mean()

    def _feasible_margin(self) -> float:
        """Margin gamma for the loss: a robustness that plans can reach.

        A search from random states maximises the robustness of plans. The margin is a share of the median
        robustness of the plans that satisfy the specification, clipped to `MARGIN_RANGE`. If there are none,
        it is the lower end of this range.
        """
        native = self.task.native is not None
        count, tries = (MARGIN_STATES, THOROUGH) if native else (TORCH_MARGIN_STATES, TORCH_TRIES)
        x0 = self.supply.take(count)
        middle = 0.5 * (self.task.system.control_low + self.task.system.control_high)
        start = middle.to(self.device).expand(len(x0), self.task.horizon, -1)
        rho = self._searcher(math.inf).repair(x0, start, self.buffer.library, tries=tries).rho
        reached = rho[TOLERANCE.satisfied(rho)]
        return _margin(reached) if reached.numel() else MARGIN_RANGE[0]

    def _begin_at_plans(self) -> float:
        """Let the network begin at plans for whole missions; return the margin that these plans reach."""
        known = mission_plans(self.task, self.config.plans, self.generator)
        found = known.found.to(self.device)
        if not len(found.rho):
            return MARGIN_RANGE[0]
        for network in (self.network, self.average):
            network.begin_at(known.best.to(self.device))
        found = remainders(self.task, found, TAILS)
        self.buffer.add(found.states, found.plans)
        return _margin(known.found.rho)

    def _searcher(self, target: float) -> Searcher:
        return Searcher(self.task, self.generator, target=target, device=self.device)

    def _network(self) -> PlanNetwork:
        """Make a network whose initial weights depend only on `config.seed`."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            return self.method.network(self.task, self.config).to(self.device)

    # ------------------------------------------------------------- checkpoints

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly, bit for bit.

        All ranks (processes that train together) must call this at the same time. The first rank returns the
        tensors of all ranks; these form the checkpoint. The other ranks return only their own.
        """
        found: dict[str, Tensor] = self._own()
        for index, theirs in enumerate(self.ranks.gather(found), start=1):
            found.update({f"rank{index}.{name}": value for name, value in theirs.items()})
        for prefix, module in (("network", self.network), ("average", self.average)):
            found.update({f"{prefix}.{name}": value for name, value in module.state_dict().items()})
        found.update({f"adam.{name}": value for name, value in self.optimizer.tensors().items()})
        return found

    def _own(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint that differ between the ranks (processes), for this rank."""
        found: dict[str, Tensor] = {"generator": self.generator.get_state()}
        if not self.ranks.first:
            facts = self.facts()
            found["counts"] = torch.tensor([facts[name] for name in COUNTS], dtype=torch.float64)
        count = len(self.buffer)
        if isinstance(self.training, FixedSet):
            found.update({f"training.{name}": value for name, value in self.training.tensors().items()})
        found.update({f"supply.{name}": value for name, value in self.supply.tensors().items()})
        known = self.repairing.result(stop=lambda: True) if self.repairing is not None else None
        if known is not None:
            found.update({f"repairing.{name}": getattr(known, name) for name in ("states", "plans", "rho")})
        elif self.repairing is not None:
            pending = {"states": self.repairing.states, "plans": self.repairing.plans}
            found.update({f"searching.{name}": value for name, value in pending.items()})
            found["searching.seed"] = torch.tensor(self.repairing.seed)
        found["buffer.states"], found["buffer.plans"] = self.buffer.states[:count], self.buffer.plans[:count]
        if self.failures is not None:
            found.update({f"failures.{name}": value for name, value in self.failures.tensors().items()})
        return found

    def facts(self) -> dict[str, float | int]:
        return super().facts() | {
            "solved": self.buffer.count,
            "accuracy": self.accuracy,
            "failing": self.failing,
            "barren": int(self.barren),
            "effort": self.effort,
        }

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        tensors, facts = self._restored(tensors, facts)
        super().restore(tensors, facts)
        self.accuracy, self.failing = float(facts["accuracy"]), int(facts.get("failing", 0))
        self.effort = max(int(facts.get("effort", 0)), 0)
        self.barren = bool(facts.get("barren", 0)) and not self.exhausted
        self.objective = self.method.objective(self)
        self.searcher = self._searcher(TARGET_SHARE * self.margin)
        for prefix, module in (("network", self.network), ("average", self.average)):
            module.load_state_dict(below(tensors, prefix))
        self.optimizer.restore(below(tensors, "adam"))
        count = tensors["buffer.states"].shape[0]
        self.buffer.states[:count] = tensors["buffer.states"]
        self.buffer.plans[:count] = tensors["buffer.plans"]
        self.buffer.count = int(facts["solved"])
        self.supply.restore(below(tensors, "supply"))
        if self.failures is not None:
            self.failures.restore(below(tensors, "failures"))
        if isinstance(self.training, FixedSet):
            self.training.restore(below(tensors, "training"))
        if known := below(tensors, "repairing"):
            self.repairing = Search.of(SearchResult(**known))
        elif pending := below(tensors, "searching"):
            states, plans = pending["states"].to(self.device), pending["plans"].to(self.device)
            self.repairing = self._begin(states, plans, int(pending["seed"]))

    def _restored(
        self, tensors: dict[str, Tensor], facts: dict[str, float | int]
    ) -> tuple[dict[str, Tensor], dict[str, float | int]]:
        """Tensors and numbers of a checkpoint for this rank (process).

        Some entries differ between the ranks. For these, the entries of this rank are returned.
        """
        if self.ranks.first:
            return tensors, facts
        shared = ("network.", "average.", "adam.")
        common = {name: value for name, value in tensors.items() if name.startswith(shared)}
        own = below(tensors, f"rank{self.ranks.rank}")
        counts = dict(zip(COUNTS, own.pop("counts").tolist(), strict=False))  # fewer in old checkpoints
        return common | own, {**facts, **counts}


# ------------------------------------------------------------------ methods with a plan network


class NetworkMethod(Method):
    """Interface of the methods that train a network which proposes `config.plans` plans per state.

    Attributes:
        searches: whether a local search for better plans, from states at which the policy fails, runs
            concurrently with the steps.
        mirrored: whether the network uses the mirror symmetry that the system file declares.
    """

    learns = Trainer
    falsifies = True
    searches = False
    mirrored = False

    @abstractmethod
    def objective(self, learner: Trainer) -> Objective:
        """Parameters of the method's loss, which may depend on the adapted margin `learner.margin`."""

    def network(self, task: Task, config: ResolvedConfig) -> PlanNetwork:
        """Make a network with random weights, drawn from torch's global generator."""
        return PlanNetwork(
            task, hidden=config.hidden, plans=config.plans, mirrored=self.mirrored, varied=config.varied
        )

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str = "cpu") -> BestOfKPolicy:
        """Load the policy of a run, with the moving average of the network's weights.

        Raises:
            RunError: R101 or R102, see `Method.load`.
        """
        network = load_weights(run, self.network(task, config), "average")
        return BestOfKPolicy(task, network.to(torch.device(device)).eval())
