"""Guard as a registered object: its words, needs and stages, and the search that it builds.

Guards are listed without torch: what a search needs is imported when the search is built.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from stlc.registry import GUARDS

if TYPE_CHECKING:
    from stlc.controller.guard.candidates import Limits
    from stlc.controller.guard.search import GuardSearch
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid

GUARD_VERSION = 1
"""Version of the decisions that all guards share; benchmarks rerun results of older versions."""


@dataclass(frozen=True, slots=True)
class GuardInputs:
    """Inputs from which a guard builds its search.

    Attributes:
        task: specification and system.
        strict: the task with the requested robustness margins; `task` itself if there are none.
        policy: policy that proposes plans.
        grid: control values and lengths of prefixes; None for those of the system file.
        limits: computational limits of a decision.
    """

    task: Task
    strict: Task
    policy: Policy
    grid: PrefixGrid | None
    limits: Limits


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardKind:
    """Kind of guard: the object `GUARD` of a module that is called as the guard (`stlc.registry.GUARDS`).

    Attributes:
        name: name of the module, and value of `--guard`.
        title: name in texts and headings of tables, such as "full guard".
        cost: place among all guards, listed by increasing cost of a decision.
        help: predicate for the help of `--guard`, such as "also repairs plans"; "" for none.
        flag: option of `stlc simulate` that also selects the guard, such as "--backup"; "" for none.
        stages: names of the stages (search methods, `stlc.controller.guard.stages`) in order.
        intervenes: whether rejected plans are replaced; else plans are only judged.
        monitors: whether the rest of a plan is judged at every step, and replaced if it is predicted to
            become unsafe.
        relaxes: whether the safe plan with the largest margin is taken where no plan keeps the requested one.
        timed: whether a decision has a time limit by default, `Limits.seconds`; else `Limits.paper` counts.
        compared: whether trained policies are simulated with the guard at the end of a training.
        exported: whether exported controllers contain the guard.
        needs: what a task must have that others lack, in words; "" if the guard suits every task.
        revision: number of changes of the guard's own decisions.
    """

    name: str
    title: str
    cost: float
    help: str = ""
    flag: str = ""
    stages: tuple[str, ...] = ()
    intervenes: bool = True
    monitors: bool = True
    relaxes: bool = True
    timed: bool = True
    compared: bool = False
    exported: bool = False
    needs: str = ""
    revision: int = 0

    def search(self, given: GuardInputs) -> GuardSearch:
        """Build the search for better plans: it runs the stages in order.

        Raises:
            UsageError: U101, the task lacks what the guard needs.
        """
        from stlc.controller.guard.search import RelaxedSearch, StagedSearch

        task, strict, grid, limits = given.task, given.strict, given.grid, given.limits
        policy = given.policy.for_task(strict)  # it selects among its plans with the margin
        if self.relaxes and strict is not task:
            return RelaxedSearch(task, strict, policy, self, grid=grid, limits=limits)
        return StagedSearch(strict, policy, self, grid=grid, limits=limits)

    @property
    def version(self) -> int:
        """Version of the guard's decisions, raised with every change of them."""
        return GUARD_VERSION + self.revision

    @property
    def option(self) -> str:
        """Option of `stlc simulate` that selects the guard; "" for the default one."""
        return (self.flag or f"--guard {self.name}") if self.intervenes else ""

    @property
    def noun(self) -> str:
        """Name of the guard with its article: `the full guard`, `no guard`."""
        return f"the {self.title}" if self.intervenes else self.title

    @property
    def beside(self) -> str:
        """Name of the guard with its preposition: `with the full guard`, `without a guard`."""
        return f"with {self.noun}" if self.intervenes else "without a guard"


def named_guard(name: object) -> GuardKind:
    """Guard that a record names; for one that is not installed, an object with words made from the name."""
    return GUARDS.loaded().get(str(name)) or GuardKind(name=str(name), title=f"guard {name}", cost=0)


def compared_guards() -> tuple[str, ...]:
    """Names of the guards with which trained policies are simulated, by increasing cost of a decision."""
    return tuple(name for name, guard in GUARDS.loaded().items() if guard.compared)
