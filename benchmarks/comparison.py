"""The paper's comparison as tables: a line for each method and budget, a column for each benchmark.

A cell that is not measured is empty, and its line names the command that fills it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from benchmarks.claims import OURS, Standing, Upset
from benchmarks.drives import DriveRow, budget_text
from benchmarks.plannings import LONG, SECONDS, PlanRow
from benchmarks.roster import Contender
from benchmarks.store import BENCHMARKS
from benchmarks.table import Columns, listed
from benchmarks.training import Length

HOUR = 3600.0
PROGRAM = "python -m benchmarks paper"


@dataclass(frozen=True, slots=True)
class Learned:
    """Accuracy of a learner on held-out starts.

    Attributes:
        benchmark: name of the specification.
        method: name of the contender.
        budget: such as `60 s of processor time`.
        accuracy: mean over seeds.
        interval: its 95 % interval.
        seconds: of training, mean over seeds.
        outdated: whether an input has changed since.
    """

    benchmark: str
    method: str
    budget: str
    accuracy: float
    interval: tuple[float, float]
    seconds: float
    outdated: bool = False


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a table.

    Attributes:
        method: name of the contender.
        budget: in words.
        cells: benchmark -> text; "" where not measured.
        command: that fills the empty cells; "" if there is none.
    """

    method: str
    budget: str
    cells: Mapping[str, str]
    command: str = ""


def markdown(lines: Iterable[Line], *, filled: bool = True) -> list[str]:
    """Lines as Markdown; `filled`: with the column of commands."""
    columns: Columns[Line] = {
        **{"method": "{method}", "budget": "{budget}"},
        **{name: _cell(name) for name in BENCHMARKS},
    }
    last: Columns[Line] = {"fills it": lambda line: f"`{line.command}`" if line.command else ""}
    return listed("comparison", list(lines), {**columns, **(last if filled else {})}).markdown()


def _cell(name: str) -> Callable[[Line], str]:
    return lambda line: line.cells.get(name, "")


def accuracies(
    learners: Sequence[Contender], planners: Sequence[Contender], learned: Iterable[Learned],
    plans: Iterable[PlanRow], budgets: Sequence[float],
) -> list[Line]:  # fmt: skip
    """Plan accuracy of every contender at every budget, measured or not."""
    found = {(each.method, each.budget, each.benchmark): each for each in learned}
    rows = {(row.method, row.seconds, row.benchmark): row for row in plans if not row.label}
    lines = []
    for each in learners:
        for seconds in (*budgets, *((HOUR,) if each.hour else ())):
            budget = Length(seconds, clock="processor").text
            own = {name: found.get((each.name, budget, name)) for name in BENCHMARKS}
            missing = [name for name, cell in own.items() if cell is None or cell.outdated]
            length = "--hour" if seconds == HOUR else f"--budget {seconds:g}s"
            lines.append(
                Line(
                    *(each.name, budget, {name: _learned_text(cell) for name, cell in own.items()}),
                    _command(each, missing, length),
                )
            )
    for each in planners:
        for limit in (None,) if each.evaluations else SECONDS:
            own_rows = {name: rows.get((each.name, limit, name)) for name in BENCHMARKS}
            spared = {name for name in BENCHMARKS if _spared(rows, each.name, limit, name)}
            texts = {
                name: "no gain" if name in spared else _planned_text(row) for name, row in own_rows.items()
            }
            missing = [name for name, row in own_rows.items() if row is None and name not in spared]
            time = "" if limit is None else f"--plan-time {budget_text(limit).replace(' ', '')}"
            lines.append(
                Line(each.name, budget_text(limit), texts, _command(each, missing, f"{time} --parts plans"))
            )
    return lines


def _command(contender: Contender, missing: Sequence[str], options: str) -> str:
    if not missing:
        return ""
    only = "" if len(missing) == len(BENCHMARKS) else f" --only {','.join(missing)}"
    return f"{PROGRAM} --methods {contender.name}{only} {options.strip()}"


def _spared(
    rows: Mapping[tuple[str, float | None, str], PlanRow], method: str, limit: float | None, name: str
) -> bool:
    """True if a long budget is not measured because ten times the time found no more plans before."""
    if limit is None or limit < LONG or (method, limit, name) in rows:
        return False
    few, many = rows.get((method, SECONDS[1], name)), rows.get((method, SECONDS[2], name))
    if few is None or many is None or few.accuracy is None or many.accuracy is None:
        return False
    return many.accuracy <= few.accuracy


def _learned_text(cell: Learned | None) -> str:
    if cell is None:
        return ""
    return f"{_interval(cell.accuracy, cell.interval)}{' (outdated)' if cell.outdated else ''}"


def _planned_text(row: PlanRow | None) -> str:
    if row is None:
        return ""
    old = " (outdated)" if row.outdated else ""
    if row.accuracy is None or row.interval is None:
        return f"refused{old}"
    return _interval(row.accuracy, row.interval) + old


def _interval(value: float, interval: tuple[float, float]) -> str:
    return f"{value:.3f} [{interval[0]:.3f}, {interval[1]:.3f}]"


def refusals(plans: Iterable[PlanRow]) -> list[str]:
    """Reasons for which planners refuse tasks, as bullets."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in plans:
        if row.refused:
            found.setdefault((row.method, row.refused), []).append(row.benchmark)
    return [
        f"- {method} refuses {', '.join(dict.fromkeys(names))}: {why}"
        for (method, why), names in found.items()
    ]


def latencies(plans: Iterable[PlanRow]) -> list[Line]:
    """Median and 99 % of the processor time of a decision, one start at a time, in milliseconds."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for row in plans:
        if row.median_ms is not None and row.p99_ms is not None:
            own = (row.label or row.method, "" if row.label else budget_text(row.seconds))
            groups.setdefault(own, {})[row.benchmark] = f"{row.median_ms:.3g} / {row.p99_ms:.3g}"
    return [Line(*own, cells) for own, cells in groups.items()]


def deployments(drives: Iterable[DriveRow]) -> list[Line]:
    """Accuracy and safety in closed loop, without a guard and with the paper's backup."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for row in drives:
        backup = "with backup" if row.guard == "paper" else "no guard"
        budget = backup if row.label else f"{budget_text(row.seconds)}, {backup}"
        parts = [_with_half(row.accuracy, row.accuracy_half), _with_half(row.safety, row.safety_half)]
        text = "refused" if row.refused else " / ".join(parts)
        groups.setdefault((row.label or row.method, budget), {})[row.benchmark] = text
    return [Line(*own, cells) for own, cells in groups.items()]


def _with_half(value: float | None, half: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if half is None else f"{value:.3f} ± {half:.3f}"


def standings(
    learned: Iterable[Learned], plans: Sequence[PlanRow], drives: Iterable[DriveRow]
) -> list[Standing]:
    """The current standing of every contender: at its longest training or largest budget."""
    found: dict[tuple[str, str], Standing] = {}
    policies = [row for row in plans if row.label and not row.outdated]
    guarded = {
        (row.benchmark, row.method): row.median_ms
        for row in drives
        if row.label and row.guard == "paper" and not row.outdated
    }
    for each in sorted(learned, key=lambda each: each.seconds):
        if not each.outdated:
            own = (each.benchmark, each.method)
            times = [
                row.median_ms
                for row in policies
                if (row.benchmark, row.method) == own and row.median_ms is not None
            ]
            found[own] = Standing(*own, each.accuracy, fmean(times) if times else None, guarded.get(own))
    for row in sorted(plans, key=lambda row: row.seconds or 0.0):
        if row.accuracy is not None and not row.label and not row.outdated:
            found[row.benchmark, row.method] = Standing(
                row.benchmark, row.method, row.accuracy, row.median_ms
            )
    return list(found.values())


def upsets(plans: Sequence[PlanRow]) -> list[Upset]:
    """Benchmarks where search beats the best `guided` policy on the same starts, at its least budget."""
    found = []
    current = [row for row in plans if not row.outdated]
    for name in BENCHMARKS:
        policies = [row for row in current if row.benchmark == name and row.label and row.method == OURS]
        best = max(policies, key=lambda row: row.accuracy or 0.0, default=None)
        if best is None or best.accuracy is None:
            continue
        better = [
            row
            for row in current
            if row.benchmark == name and row.method == "plan:search" and not row.label
            and row.starts == best.starts and (row.accuracy or 0.0) > best.accuracy
        ]  # fmt: skip
        found += [
            Upset(
                *(name, row.method, budget_text(row.seconds), row.accuracy or 0.0),
                *(best.label, best.accuracy, row.median_ms, best.median_ms),
                overlap=row.interval is None or best.interval is None or row.interval[0] <= best.interval[1],
            )
            for row in sorted(better, key=lambda row: row.seconds or 0.0)[:1]
        ]
    return found
