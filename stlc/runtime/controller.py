"""Decisions of an exported controller in closed loop, the same as in `stlc simulate`, but without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import RunError, usage
from stlc.registry import GUARDS
from stlc.runtime.backup import POLICY, Found, search
from stlc.runtime.facts import Facts, read_facts
from stlc.runtime.graphs import Graphs, JudgedPlans, Numbers

RULES = ("policy", "backup", "safest")
KEPT = "kept"


@dataclass(frozen=True, slots=True)
class ControlDecision:
    """The decision for one agent, or for several with a leading axis of agents.

    Attributes:
        control: control to apply now, (m,), in physical units.
        rule: rule that chose the plan: "policy", "kept" (the previous plan is continued), "backup" or
            "safest".
        plan: plan, (T, m), whose first step gives the control.
        rho: robustness of the plan; the specification is satisfied if it is at least -1e-6.
        safe: robustness of the safety requirements alone.
        robustness: robustness of each requirement, by name.
        source: rule that first chose the plan; for a plan that is kept from an earlier step, it differs from
            `rule`.
        t0: number of first steps of the plan that are a prefix tried by the backup policy; 0 for the policy's
            own plan.
        policy_rho: robustness of the policy's plan; -inf if it is not a number.
    """

    control: Numbers
    rule: str | NDArray[np.str_]
    plan: Numbers
    rho: float | Numbers
    safe: float | Numbers
    robustness: Mapping[str, float | Numbers]
    source: str | NDArray[np.str_]
    t0: int | NDArray[np.int64]
    policy_rho: float | Numbers


@dataclass(slots=True)
class _ChosenPlans:
    """Chosen plans: verdicts, sources, prefix lengths, and whether each is a continued previous plan."""

    judged: JudgedPlans
    source: NDArray[np.int64]
    t0: NDArray[np.int64]
    kept: NDArray[np.bool_]

    def put(self, row: int, found: Found) -> None:
        """Replace the plan of agent `row` by the plan that the search found."""
        for name in ("plan", "rho", "safe", "cost", "each"):
            getattr(self.judged, name)[row] = getattr(found.judged, name)[0]
        self.source[row], self.t0[row], self.kept[row] = found.source, found.t0, False


class Controller:
    """Policy, model, monitor and backup policy of a run, exported with `stlc export RUN --to onnx`.

    The controller stores the previous plans, and the states that the specification adds; `reset` clears both.

    Attributes:
        facts: description of the controller: names, units, ranges, hashes.
        guard: name of the guard; "paper" searches for another plan if the policy's plan violates the
            specification, "none" always returns the policy's plan.
    """

    def __init__(
        self,
        facts: Facts,
        guard: str = GUARDS.default,
        *,
        parameters: Mapping[str, float] | None = None,
        threads: int = 1,
    ) -> None:
        kind = GUARDS.get(guard)
        if not kind.exported:
            names = [name for name, each in GUARDS.loaded().items() if each.exported]
            raise usage(f"exported controllers do not contain the guard `{guard}`", " or ".join(names))
        self.facts, self.guard, self._guarded = facts, guard, bool(kind.intervenes)
        self._graphs = Graphs(facts, threads=threads)
        if self._guarded:
            self._graphs.prepare()
        self._parameters = dict(parameters or {})
        self._previous: _ChosenPlans | None = None
        self._added: Numbers | None = None

    @classmethod
    def load(
        cls,
        where: Path | str,
        guard: str = GUARDS.default,
        *,
        parameters: Mapping[str, float] | None = None,
        threads: int = 1,
    ) -> Controller:
        """Load a controller from its folder, or from a file in it.

        Args:
            where: folder that `stlc export RUN --to onnx` wrote.
            guard: name of a guard that exported controllers contain: "none" or "paper".
            parameters: values of the specification's parameters, if the states are given without them.
            threads: number of threads for one decision.

        Raises:
            UsageError: U102, the folder does not exist; U101, there is no such guard, or exported controllers
                do not contain it.
            RunError: R106, a file is missing, damaged, or of another export.
            MissingError: R301, `onnxruntime` is not installed.
        """
        return cls(read_facts(where), guard, parameters=parameters, threads=threads)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states in order; those that the specification adds come last and may be left out."""
        return tuple(each.name for each in self.facts.states)

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls in order."""
        return tuple(each.name for each in self.facts.controls)

    def reset(self) -> None:
        """Prepare for a new mission.

        The previous plans are dropped. The states that the specification adds to the system, such as timers,
        return to their initial values.
        """
        self._previous = self._added = None

    def __call__(self, state: ArrayLike | Mapping[str, ArrayLike]) -> Numbers:
        """Return the command to apply until the next call, (m,) or (agents, m): that of `decide`."""
        return self.decide(state).control

    def decide(self, state: ArrayLike | Mapping[str, ArrayLike], *, elapsed: int = 1) -> ControlDecision:
        """Return the decision for a state.

        Args:
            state: (n,), or (agents, n) for several agents, or values by state name; in the units of `facts`.
                Ranges of states are nominal: states beyond them are accepted.
            elapsed: number of steps since the previous decision.

        Returns:
            The decision; it is stored for the next call. A previous plan that still satisfies the
            specification is continued unless the new plan is better.

        Raises:
            RunError: R107, the state has a wrong shape or is not a number; R402, without a guard, the
                policy's plan is not a number.
        """
        x, single = self._read(state, elapsed)
        if self._previous is not None and len(self._previous.source) != len(x):
            raise _invalid(f"{len(x)} agents where {len(self._previous.source)} were", "`reset` begins anew")
        previous = self._previous
        followed, outputs = self._followed(x, elapsed)
        fresh = outputs.get("policy_plan", outputs["plan"])
        policy_rho = outputs.get("policy_rho", outputs["rho"]).copy()
        if self._guarded:
            rest = None if previous is None else _continued(previous.judged.plan, elapsed)
            for row in np.flatnonzero(~TOLERANCE.satisfied(followed.judged.rho)):
                left = None if rest is None else rest[row]
                found = search(self._graphs, x[row], fresh[row], left)
                followed.put(int(row), found)
        if not np.isfinite(followed.judged.plan[:, 0]).all():
            raise RunError.of("R402", "the policy's plan is not a number")
        self._previous = followed
        self._added = outputs.get("added")
        command = followed.judged.plan[:, 0].copy()
        if self.facts.feedback is not None:
            command = self.facts.feedback(x, command)
        return self._decision(followed, command, policy_rho, single=single)

    # ---------------------------------------------------------------------- states

    def _read(self, state: ArrayLike | Mapping[str, ArrayLike], elapsed: int) -> tuple[Numbers, bool]:
        """Return the states as an array (agents, n), and True if `state` is that of a single agent.

        The array includes the states that the specification adds.

        `elapsed`: number of steps since the previous decision.

        Raises:
            RunError: R107, the state has a wrong shape, names or types, is not finite, or lacks a parameter.
        """
        if elapsed < 0:
            raise _invalid(f"{elapsed} steps since the decision before", "`elapsed` counts from it onwards")
        named = self._named(state) if isinstance(state, Mapping) else None
        try:
            stacked = state if named is None else np.stack(np.broadcast_arrays(*named), -1)
            given = np.asarray(stacked, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise _invalid(
                f"the state is no array of numbers: {error}",
                "numbers in the units of the system, one row an agent",
            ) from None
        single, x = given.ndim == 1, np.atleast_2d(given)
        known = len(self.facts.states) - len(self.facts.added)
        if x.ndim != 2 or x.shape[1] not in (known, len(self.facts.states)):
            raise _invalid(f"a state of shape {given.shape}", f"the columns are {', '.join(self.states)}")
        if x.shape[1] == known and self.facts.added:
            x = np.concatenate((x, self._added_states(len(x), elapsed)), 1)
        if not np.isfinite(x).all():
            names = [
                name for name, column in zip(self.states, x.T, strict=True) if not np.isfinite(column).all()
            ]
            raise _invalid(f"{', '.join(names)} is not a finite number", "hold the last control, or stop")
        return np.ascontiguousarray(x), single

    def _named(self, state: Mapping[str, ArrayLike]) -> list[ArrayLike]:
        added = {each.name for each in self.facts.added}
        names = [name for name in self.states if name not in added or name in state]
        wrong = (set(names) ^ set(state)) or (added - set(names) if added & set(state) else set())
        if wrong:
            raise _invalid(
                f"states by name: {', '.join(sorted(wrong))}", f"they are {', '.join(self.states)}"
            )
        return [state[name] for name in names]

    def _added_states(self, agents: int, elapsed: int) -> Numbers:
        """States that the specification adds, if the caller does not pass them: (agents, added).

        The states are those that the model predicted at the previous decision. Before the first decision,
        they are those of a new mission.

        Raises:
            RunError: R107, `elapsed` is not 1, the number of agents has changed, or a parameter has no value.
        """
        if self._added is not None:
            if elapsed != 1 or len(self._added) != agents:
                raise _invalid("timers follow from every step", "give them as the last columns of the state")
            return self._added
        row = []
        for each in self.facts.added:
            value = self._parameters.get(each.name, each.initial)
            if value is None:
                raise _invalid(
                    f"the parameter `{each.name}` has no value", "give it to `load`, or in the state"
                )
            row.append(float(value))
        return np.tile(np.array(row), (agents, 1))

    # ------------------------------------------------------------------------ plans

    def _followed(self, x: Numbers, elapsed: int) -> tuple[_ChosenPlans, Mapping[str, Numbers]]:
        """Choose, for each agent, between the policy's plan and the rest of the agent's previous plan.

        Args:
            x: states, (agents, n).
            elapsed: number of steps since the previous decision.

        Returns:
            The chosen plans, and all outputs of the ONNX graph that chose them.
        """
        previous = self._previous
        if previous is None:
            judged, outputs = self._graphs.decided(x)
            zero = np.zeros(len(x), dtype=np.int64)
            return _ChosenPlans(judged, zero + POLICY, zero, zero > 0), outputs
        judged, outputs = self._graphs.followed(x, _continued(previous.judged.plan, elapsed))
        kept = outputs["kept"].astype(bool)
        source, t0 = np.where(kept, previous.source, POLICY), np.where(kept, previous.t0, 0)
        return _ChosenPlans(judged, source, t0, kept), outputs

    def _decision(
        self, followed: _ChosenPlans, control: Numbers, policy_rho: Numbers, *, single: bool
    ) -> ControlDecision:
        judged = followed.judged
        source = np.array(RULES)[followed.source]
        rule = np.where(followed.kept, KEPT, source)
        each = dict(zip(self.facts.requirements, judged.each.T, strict=True))
        if not single:
            plan, t0 = judged.plan.copy(), followed.t0.copy()
            return ControlDecision(control, rule, plan, judged.rho, judged.safe, each, source, t0, policy_rho)
        return ControlDecision(
            control[0],
            str(rule[0]),
            judged.plan[0].copy(),
            float(judged.rho[0]),
            float(judged.safe[0]),
            {name: float(value[0]) for name, value in each.items()},
            str(source[0]),
            int(followed.t0[0]),
            float(policy_rho[0]),
        )


def _continued(plans: Numbers, steps: int) -> Numbers:
    """Rest of each plan after `steps` steps, extended to the full length by repeating the last control."""
    last = plans.shape[1] - 1
    return np.ascontiguousarray(plans[:, np.minimum(np.arange(last + 1) + steps, last)])


def _invalid(message: str, advice: str) -> RunError:
    return RunError.of("R107", f"no decision: {message}", help=(advice,))
