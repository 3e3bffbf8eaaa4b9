"""Native code of a task, from its dynamics and requirements: verdicts, local search, gradients, steps.

Verdicts equal those computed in torch, and are tens of times faster: a training step needs about a thousand
small array operations in torch, but only two calls of native code. torch is used if there is no compiler, on
a GPU, and for formulas that cannot be written in C; `Task.torch_reasons` then gives the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.advance import emit_advance
from stlc.compile.backends.c.emit import Motion, emit
from stlc.compile.backends.numbers import Untranslatable
from stlc.controller.problem.kernel import Adjoint, Advance, Kernel, ObjectiveSlopes, SearchOptions, Sizes
from stlc.diagnostics import usage
from stlc.native import Stop, load, never, why_none
from stlc.toolchain import compiler

if TYPE_CHECKING:
    from stlc.compile.backends.schedule import End
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.dynamics.system import System


@dataclass(frozen=True, slots=True)
class Effort:
    """Options of a native local search for plans from several initial states.

    Attributes:
        generations: number of generations of changed plans per initial state.
        target: robustness at which the search for an initial state ends.
        seed: seed of the random changes.
        cycle: generations after which the comparison of violating plans changes; 0 if it never does.
        threads: number of threads; the result does not depend on it.
        stop: condition that ends the whole search early.
    """

    generations: int
    target: float
    seed: int
    cycle: int = 0
    threads: int = 1
    stop: Stop = never


def motion_of(system: System) -> Motion:
    """The exact (not smoothed) step of a system, in the form from which C code is generated."""
    step = system.exact_step
    return Motion(system.names, system.control_names, step.lets, step.next, system.horizon, system.dt)


def sizes_of(system: System, rules: Sequence[CompiledRequirement]) -> Sizes:
    """Return the sizes of the arrays for a system and requirements."""
    return Sizes(len(system.names), len(system.control_names), system.horizon, len(rules))


class NativeJudge:
    """Native kernel that computes the robustness of plans of one task, on the CPU.

    Attributes:
        kernel: library built from the task's dynamics and requirements.
        names: names of the states.
    """

    def __init__(self, kernel: Kernel, system: System, rules: Sequence[CompiledRequirement]) -> None:
        self.kernel = kernel
        self.names = system.names
        self.rules = len(rules)
        controls = system.decl.controls
        turns = torch.tensor([control.squash == "angle" for control in controls])
        low, high = system.control_low, system.control_high
        self._bounds = torch.stack((low, high, turns.to(low.dtype))).double().numpy()
        self._factors = np.array(
            [[rule.factor for rule in rules], ["safety" in rule.tags for rule in rules]], dtype=np.float64
        )

    @classmethod
    def of(
        cls, system: System, rules: Sequence[CompiledRequirement], end: End = "strict"
    ) -> NativeJudge | None:
        """Build the kernel for a system and requirements; None without a compiler or a C form of them."""
        try:
            library = load(emit(motion_of(system), [rule.formula for rule in rules], end))
        except Untranslatable:
            return None
        if library is None:
            return None
        kernel = Kernel(library, sizes_of(system, rules))
        return cls(kernel, system, rules)

    def judge(self, x0: Tensor, u: Tensor, *, columns: bool) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Robustness of plans per requirement (before weight and scale), and the predicted states.

        Args:
            x0: initial states, (B, n).
            u: plans in physical units, (B, T, m).
            columns: whether to return the states.

        Returns:
            Robustness, (B, R); and states, name -> (T+1, B), an empty mapping if `columns` is False. The
            kernel computes in float64; the results have the dtype of `x0`.
        """
        rho, seen = self.kernel.judge(
            x0.detach().double().numpy(),
            u.detach().double().numpy(),
            threads=torch.get_num_threads(),
            columns=columns,
        )
        each = torch.from_numpy(rho).to(x0.dtype)
        if seen is None:
            return each, {}
        return each, dict(zip(self.names, torch.from_numpy(seen).to(x0.dtype).unbind(0), strict=True))

    def local_search(
        self,
        x0: Tensor,
        plans: Tensor,
        library: Tensor,
        effort: Effort,
    ) -> tuple[Tensor, Tensor]:
        """Improve plans by local search on the exact robustness.

        Args:
            x0: initial states, (B, n).
            plans: initial plans, (B, T, m).
            library: plans that satisfy the specification from other states, (k, T, m); may be empty.
            effort: options of the search.

        Returns:
            Plans (B, T, m) and their robustness (B,), in the dtype of `x0`.
        """
        arrays = [tensor.detach().double().contiguous().numpy() for tensor in (x0, plans, library)]
        how = SearchOptions(
            self._bounds,
            self._factors,
            arrays[2],
            effort.generations,
            effort.target,
            effort.seed,
            effort.cycle,
            effort.stop,
        )
        best, rho = self.kernel.local_search(arrays[0], arrays[1], how, threads=effort.threads)
        return torch.from_numpy(best).to(x0.dtype), torch.from_numpy(rho).to(x0.dtype)


class NativeGradient:
    """Native kernel for robustness and states of a task's plans, differentiable with respect to the plans.

    Attributes:
        judge: kernel that computes the values.
        adjoint: kernel that computes the gradient.
    """

    def __init__(self, judge: NativeJudge, adjoint: Adjoint) -> None:
        self.judge = judge
        self.adjoint = adjoint

    @classmethod
    def of(
        cls,
        system: System,
        rules: Sequence[CompiledRequirement],
        judge: NativeJudge | None,
        end: End = "strict",
    ) -> NativeGradient | None:
        """Build the kernel for a system and requirements; None without a compiler or a C form of them."""
        if judge is None:
            return None
        fixed = [timer.name for timer in system.timers]
        try:
            formulas = [rule.formula for rule in rules]
            library = load(emit_adjoint(motion_of(system), formulas, fixed=fixed, end=end))
        except Untranslatable:
            return None
        return None if library is None else cls(judge, Adjoint(library, sizes_of(system, rules)))

    def __call__(self, x0: Tensor, u: Tensor, *, slope: float) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Robustness per requirement (B, R), and states name -> (T+1, B), differentiable with respect to `u`.

        Args:
            x0: initial states, (B, n), not differentiated.
            u: plans in physical units, (B, T, m).
            slope: k in the smooth step (1 + tanh(k x)) / 2. Jumps and conditions are true steps, with
                derivative 0 almost everywhere. Gradients use the derivative of the smooth step instead.
        """
        each, columns = _NativeRobustness.apply(self, x0, u, slope)  # type: ignore[no-untyped-call]
        return each, dict(zip(self.judge.names, columns.unbind(0), strict=True))


class _NativeRobustness(torch.autograd.Function):
    """Autograd function: values by `NativeJudge.judge`, gradients by the kernel `NativeGradient.adjoint`."""

    @staticmethod
    def forward(
        ctx: Any, native: NativeGradient, x0: Tensor, u: Tensor, slope: float
    ) -> tuple[Tensor, Tensor]:
        each, columns = native.judge.judge(x0, u, columns=True)
        ctx.native, ctx.slope = native, slope
        ctx.save_for_backward(x0, u)
        ctx.set_materialize_grads(False)
        return each, torch.stack(list(columns.values()))

    @staticmethod
    def backward(
        ctx: Any, by_each: Tensor | None, by_columns: Tensor | None
    ) -> tuple[None, None, Tensor, None]:
        x0, u = ctx.saved_tensors
        if by_each is None:
            by_each = u.new_zeros(len(u), ctx.native.judge.rules)
        gradient = ctx.native.adjoint.pull(
            *(part.detach().double().numpy() for part in (x0, u)),
            ObjectiveSlopes(
                by_each.double().numpy(),
                None if by_columns is None else by_columns.double().numpy(),
                ctx.slope,
            ),
            threads=torch.get_num_threads(),
        )
        return None, None, _Once.apply(torch.from_numpy(gradient).to(u.dtype), u), None  # type: ignore[no-untyped-call]


class _Once(torch.autograd.Function):
    """Autograd function: the gradient of `_NativeRobustness` by plans `u`, which has no gradient in turn."""

    @staticmethod
    def forward(_ctx: Any, gradient: Tensor, _u: Tensor) -> Tensor:
        return gradient

    @staticmethod
    def backward(_ctx: Any, _by_gradient: Tensor) -> tuple[Tensor, Tensor]:
        raise usage(
            "compiled code gives no second derivatives", "take them in torch: `task.graph.robustness`"
        )


class NativeStep:
    """Native functions for one exact step of a system, its observation and its declared reward, on the CPU.

    Copies share the compiled functions; pickles build or load them anew.

    Attributes:
        compiled: library of the compiled functions.
    """

    def __init__(self, compiled: Advance, system: System, *, rewarded: bool) -> None:
        self.compiled = compiled
        self._system, self._rewarded = system, rewarded

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(NativeStep.of, rewarded=self._rewarded), (self._system,)

    @classmethod
    def of(cls, system: System, *, rewarded: bool) -> NativeStep | None:
        """Build the functions for a system; None without a compiler or a C form of the system.

        Raises:
            UsageError: U101, `rewarded` is True, but the system file declares no reward.
        """
        reward = system.require_reward() if rewarded else None
        given = system.decl.commands
        try:
            text = emit_advance(motion_of(system), observed=system.observed, reward=reward, commands=given)
        except Untranslatable:
            return None
        library = load(text)
        if library is None:
            return None
        advance = Advance(library, seen=system.observed_count, rewarded=rewarded)
        return cls(advance, system, rewarded=rewarded)

    def advance(self, x: Tensor, u: Tensor, share: float) -> tuple[Tensor, Tensor, Tensor | None]:
        """Advance states by one step, and return the new states, observations and rewards.

        Args:
            x: states, (B, n) float64.
            u: controls, (B, m) float64.
            share: elapsed share of the episode after the step, the last entry of each observation.

        Returns:
            States, (B, n); observations, (B, k + 1) float32; and rewards, (B,), or None if this object was
            built with `rewarded=False`.
        """
        after, seen, reward = self.compiled.advance(x.contiguous().numpy(), u.contiguous().numpy(), share)
        earned = None if reward is None else torch.from_numpy(reward)
        return torch.from_numpy(after), torch.from_numpy(seen), earned

    def look(self, x: Tensor, share: float) -> Tensor:
        """Observations of states (B, n) float64, with `share` as the last entry: (B, k + 1) float32."""
        return torch.from_numpy(self.compiled.look(x.contiguous().numpy(), share))


def reason(text: Callable[[], str]) -> str:
    """Reason why the C code that `text` returns could not be compiled or loaded."""
    if compiler() is None:
        return "there is no C compiler"
    try:
        return why_none(text())
    except Untranslatable as why:
        return f"{why} has no C form"
