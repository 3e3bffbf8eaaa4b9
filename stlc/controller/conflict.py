"""Which requirements no plan satisfies together, as far as a search finds."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from stlc.controller.search import Repaired, Searcher
from stlc.controller.task import Task
from stlc.diagnostics import Diagnostic, Label
from stlc.native import never

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.compile.pipeline import Rule
    from stlc.native import Stop

STARTS = 64
TRIES = 4000
ENOUGH = 1e-4


def conflict(task: Task, enough: Stop = never) -> Diagnostic:
    """What to say of a task that no plan was found for: R404, with the requirements that are to blame.

    Requirements are left out one after the other as long as the rest still has no plan, and until `enough`
    says that the time for it is over.
    """
    core = list(task.rules)
    nearest = _searched(task, core, enough)
    for rule in task.rules:
        if enough():
            break
        rest = [other for other in core if other is not rule]
        found = _searched(task, rest, enough) if rest else None
        if found is not None and not bool(found.solved.any()) and not enough():
            core, nearest = rest, found
    return _told(task, core, nearest)


def _searched(task: Task, rules: Sequence[Rule], enough: Stop) -> Repaired:
    """The best plans for these requirements alone, from starts that are always the same."""
    alone = Task(replace(task.compiled, requirements=tuple(rules)), task.plain)
    generator = torch.Generator().manual_seed(0)
    x0 = alone.sample(STARTS, generator=generator)
    middle = 0.5 * (alone.system.control_low + alone.system.control_high)
    start = middle.expand(STARTS, alone.horizon, -1)
    searcher = Searcher(alone, generator, enough=ENOUGH)
    return searcher.repair(x0, start, start[:0], tries=TRIES, stop=enough)


def _told(task: Task, core: Sequence[Rule], nearest: Repaired) -> Diagnostic:
    names = [f"`{rule.name}`" for rule in core]
    row = int(nearest.rho.argmax())
    columns = zip(task.system.signature.columns, nearest.states[row].tolist(), strict=True)
    start = ", ".join(f"{column.name} = {value:.4g}" for column, value in columns)
    if len(core) == 1:
        message, label = f"no plan satisfies {names[0]}", "nothing that was tried satisfies this"
    else:
        message, label = f"no plan satisfies {_listed(names)} together", "not together with the others"
    return Diagnostic(
        "R404",
        message,
        core[0].span,
        label=label,
        labels=tuple(Label(rule.span, "with this") for rule in core[1:] if rule.span is not None),
        help=(
            "ask for less, give it more time (`horizon`) or wider ranges of control, or other initial states",
            "`stlc compile` shows what is asked for in steps",
        ),
        note=(
            f"a search tried {TRIES:,} plans for each of {STARTS} starts"
            + ("" if len(core) == 1 else "; without one of these requirements it found some"),
            f"the nearest misses by {-float(nearest.rho[row]):.4g}, from {start}",
        ),
    )


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
