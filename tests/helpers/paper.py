"""Shared parts of the tests of the paper's benchmarks: our files against hand-written references."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.stats import ks_2samp

from stlc.controller.problem.task import Task
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parents[2]
COUNT = 1500
Array = np.ndarray
Changes = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Benchmark:
    """A benchmark as the facts have it, in plain NumPy.

    Attributes:
        spec: file name of the specification, without its ending.
        system: file name of the system, without its ending.
        columns: of a state, in order.
        low, high: bounds of the controls.
        steps: of a plan.
        states: any states, (n, columns), from a generator and n.
        step: one step, (n, columns) and (n, controls) to (n, columns).
        rules: robustness by requirement, from (n, steps + 1, columns).
        safe: requirements that make up phi_safe.
        starts: n initial states, (n, columns).
        features: numbers whose distribution over initial states says more than that of the columns.
    """

    spec: str
    system: str
    columns: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    steps: int
    states: Callable[[np.random.Generator, int], Array]
    step: Callable[[Array, Array], Array]
    rules: Callable[[Array], Mapping[str, Array]]
    safe: frozenset[str]
    starts: Callable[[np.random.Generator, int], Array]
    features: Callable[[Array], Mapping[str, Array]]

    def task(self, spec: Changes = (), system: Changes = ()) -> Task:
        """Our files, some of their text changed."""
        path = ROOT / "examples" / f"{self.system}.yaml"
        text = _changed(path.read_text(), system)
        loaded = System(parse_system(Source(str(path), text), path))
        written = ROOT / "specs" / f"{self.spec}.stl"
        return Task.of(Spec.parse(Source(written.name, _changed(written.read_text(), spec))), loaded)

    def cases(self, seed: int, count: int = COUNT) -> tuple[Array, Array]:
        """Any states and plans, (count, columns) and (count, steps, controls)."""
        rng = np.random.default_rng(seed)
        x0 = self.states(rng, count)
        u = rng.uniform(self.low, self.high, (count, self.steps, len(self.low)))
        steady = rng.random(count) < 0.5
        u[steady] = u[steady, :1]
        return x0, u

    def rollout(self, x0: Array, u: Array) -> Array:
        """Step after step, (count, steps + 1, columns)."""
        states = [x0]
        for k in range(self.steps):
            states.append(self.step(states[-1], u[:, k]))
        return np.stack(states, 1)


def _changed(text: str, changes: Changes) -> str:
    for old, new in changes:
        assert text.count(old) >= 1, f"`{old}` is not in the file"
        text = text.replace(old, new)
    return text


def apart(benchmark: Benchmark, task: Task, count: int = COUNT) -> tuple[float, float, float]:
    """Largest differences of states, robustness and robustness of phi_safe from the reference."""
    assert task.system.names == benchmark.columns
    x0, u = benchmark.cases(1, count)
    wanted = benchmark.rollout(x0, u)
    got = task.rollout(torch.tensor(x0), torch.tensor(u)).numpy()
    rules = benchmark.rules(wanted)
    assert [rule.name for rule in task.rules] == list(rules)
    assert {rule.name for rule in task.compiled.safety} == benchmark.safe
    each = np.stack(list(rules.values()), 1)
    assert set(np.sign(each.min(1))) == {-1.0, 1.0}, "no plan, or every plan, satisfies"
    safe = np.min([rules[name] for name in benchmark.safe], 0)
    states = torch.tensor(wanted)
    rho = np.abs(task.requirement_robustness(states).numpy() - each).max()
    whole = np.abs(task.robustness(states).numpy() - each.min(1)).max()
    margin = np.abs(task.safety.robustness(states).numpy() - safe).max()
    return float(np.abs(got - wanted).max()), float(max(rho, whole)), float(margin)


def kernel_apart(benchmark: Benchmark, task: Task) -> tuple[float, float]:
    """Largest differences of the native kernel from the torch graph: states and robustness."""
    x0, u = (torch.tensor(part) for part in benchmark.cases(2))
    assert task.native is not None
    rho, columns = task.native.judge(x0, u, columns=True)
    wanted = task.rollout(x0, u)
    states = torch.stack([columns[name].t() for name in task.system.names], 2)
    each = task.requirement_robustness(wanted)
    return float((states - wanted).abs().max()), float((rho - each).abs().max())


def unlike(benchmark: Benchmark, task: Task, count: int = 20_000) -> dict[str, float]:
    """Columns and features whose distribution over initial states is not the reference's, with p-values."""
    ours = task.sample(count, seed=1007, dtype=torch.float64).numpy()
    theirs = benchmark.starts(np.random.default_rng(7), count)
    assert theirs.shape == ours.shape
    named = {name: (ours[:, i], theirs[:, i]) for i, name in enumerate(benchmark.columns)}
    more = zip(benchmark.features(ours).items(), benchmark.features(theirs).values(), strict=True)
    named |= {name: (left, right) for (name, left), right in more}
    rounded = {name: (np.round(left, 9), np.round(right, 9)) for name, (left, right) in named.items()}
    levels = {name: ks_2samp(*pair, method="asymp").pvalue for name, pair in rounded.items()}
    return {name: level for name, level in levels.items() if level < 1e-5}


def kept(draw: Callable[[int], Array], good: Callable[[Array], Array], count: int) -> Array:
    """States of `draw` that are `good`, `count` of them."""
    found, total = [], 0
    while total < count:
        proposed = draw(count)
        found.append(proposed[good(proposed)])
        total += len(found[-1])
    return np.concatenate(found)[:count]


def ball_distance(x: Array, y: Array, cx: Array, cy: Array) -> Array:
    """Euclidean distance in the plane."""
    return np.sqrt((x - cx) ** 2 + (y - cy) ** 2)
