"""The ONNX graphs of an exported controller, run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import RunError
from stlc.extras import needed
from stlc.runtime.facts import Facts, GraphFile

Numbers: TypeAlias = NDArray[np.float64]
_KINDS: Mapping[str, type] = {"tensor(double)": np.float64, "tensor(float)": np.float32}
"""Element type of an input, as onnxruntime writes it -> that of NumPy."""


@dataclass(frozen=True, slots=True)
class JudgedPlans:
    """Plans and their verdicts, one per row.

    Attributes:
        plan: controls, (rows, T, m), in physical units.
        rho: robustness of the specification, (rows,); -inf if the plan is not a number.
        safe: robustness of the safety requirements alone, (rows,); +inf if there are none.
        cost: performance cost of the plan, (rows,).
        each: robustness of each requirement, (rows, R).
    """

    plan: Numbers
    rho: Numbers
    safe: Numbers
    cost: Numbers
    each: Numbers

    def of(self, rows: Any) -> JudgedPlans:
        """Return the rows that the index or mask `rows` selects."""
        return JudgedPlans(*(getattr(self, each.name)[rows] for each in fields(self)))


def joined(parts: list[JudgedPlans]) -> JudgedPlans:
    """Concatenate the rows of all parts."""
    return JudgedPlans(
        *(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(JudgedPlans))
    )


class Graphs:
    """The ONNX graphs of a controller; states (rows, n) and plans (rows, T, m) are float64.

    Args:
        facts: description of the controller.
        threads: number of threads for one call.

    Raises:
        MissingError: R301, `onnxruntime` is not installed.
    """

    def __init__(self, facts: Facts, *, threads: int = 1) -> None:
        self.facts = facts
        self.threads = threads
        self._decide, self._follow = self._session(GraphFile.DECIDE), self._session(GraphFile.FOLLOW)

    def prepare(self) -> None:
        """Load the graphs of the backup policy now, so that its first decision does not wait for them."""
        _ = self._judge, self._fall, self._continue

    def decided(self, x: Numbers) -> tuple[JudgedPlans, Mapping[str, Numbers]]:
        """Return the best of the policy's plans in each state of `x`, and all outputs of the graph.

        The plans are returned with their verdicts, one per row.
        """
        found = self._run(self._decide, state=x)
        return _judged(found["plan"], found), found

    def continued(self, x: Numbers) -> Numbers:
        """The policy's plans from the states `x` in which a prefix ends: (rows, n) -> (rows, T, m).

        A prefix is a sequence of first actions that the backup policy tries. The plans are the best ones of
        the network itself. Changed copies, as `decided` may try, are not among them.
        """
        return self._run(self._continue, state=x)["plan"]

    def followed(self, x: Numbers, previous: Numbers) -> tuple[JudgedPlans, Mapping[str, Numbers]]:
        """Choose, in each state of `x`, between the policy's plan and the rest of the `previous` plan.

        Returns:
            The chosen plans with their verdicts, and all outputs of the graph. The output `kept`, (rows,), is
                true where the previous plan was chosen.
        """
        found = self._run(self._follow, state=x, begun=previous)
        return _judged(found["plan"], found), found

    def judged(self, x: Numbers, plans: Numbers) -> tuple[JudgedPlans, Mapping[str, Numbers]]:
        """Return the verdicts on plans that start in the states `x`, and all outputs of the graph.

        The output `states`, (rows, T + 1, n), contains the predicted states.
        """
        found = self._run(self._judge, state=x, plan=plans)
        return _judged(plans, found), found

    def falls(self, x: Numbers, plans: Numbers) -> Numbers:
        """Robustness that the safety requirements can still reach after the first samples of each plan.

        Returns:
            (rows, T + 1). Entry k is an upper bound on their robustness, given the predicted states at the
            samples 0 to k; it holds for all continuations. All entries are +inf if there are no safety
            requirements.
        """
        if self._fall is None:
            return np.full((len(x), self.facts.horizon + 1), np.inf)
        return self._run(self._fall, state=x, plan=plans)["falls"]

    @cached_property
    def _judge(self) -> Any:
        return self._session(GraphFile.JUDGE)

    @cached_property
    def _continue(self) -> Any:
        return self._session(GraphFile.CONTINUE) if GraphFile.CONTINUE in self.facts.graphs else self._decide

    @cached_property
    def _fall(self) -> Any:
        return self._session(GraphFile.FALL) if GraphFile.FALL in self.facts.graphs else None

    def _session(self, name: str) -> Any:
        onnxruntime = needed("onnxruntime")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.graph_optimization_level = (
            onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        )  # nothing is left to optimize
        options.log_severity_level = 3
        try:
            return onnxruntime.InferenceSession(
                self.facts.graphs[name], options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its errors have no common class
            raise _misfit(name, str(error)) from error

    def _run(self, session: Any, **feeds: Numbers) -> dict[str, Numbers]:
        """Outputs of a graph by name, checked against the description. Raises RunError, R106.

        Numbers are float64 here, and what the graph declares inside.
        """
        try:
            kinds = {each.name: _KINDS[each.type] for each in session.get_inputs()}
            given: dict[str, Any] = {
                name: values.astype(kinds[name], copy=False) for name, values in feeds.items()
            }
            names = [each.name for each in session.get_outputs()]
            outputs = zip(names, session.run(names, given), strict=True)
            found = {name: x.astype(np.float64) if x.dtype == np.float32 else x for name, x in outputs}
        except Exception as error:
            raise _misfit("a graph", str(error)) from error
        facts, rows = self.facts, len(feeds["state"])
        states, controls, steps = len(facts.states), len(facts.controls), facts.horizon
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("rho", "safe", "cost", "kept", "policy_rho"), (rows,)
        )
        shapes |= dict.fromkeys(("plan", "policy_plan"), (rows, steps, controls))
        shapes |= {"requirements": (rows, len(facts.requirements)), "added": (rows, len(facts.added))}
        shapes |= {"falls": (rows, steps + 1), "states": (rows, steps + 1, states)}
        for key, value in found.items():
            if value.shape != shapes.get(key, value.shape):
                raise _misfit("a graph", f"`{key}` has the shape {value.shape}, not {shapes[key]}")
        return found


def _misfit(what: str, why: str) -> RunError:
    note = (" ".join(why.split())[:300],)
    help_ = ("take all files of one `stlc export RUN --to onnx`",)
    return RunError.of("R106", f"{what} does not fit its description", note=note, help=help_)


def _judged(plan: Numbers, found: Mapping[str, Numbers]) -> JudgedPlans:
    try:
        return JudgedPlans(plan, found["rho"], found["safe"], found["cost"], found["requirements"])
    except KeyError as error:
        raise _misfit("a graph", f"it has no output {error}") from error
