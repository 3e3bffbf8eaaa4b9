"""The paper's comparison as tables: one line per method and time budget, one column per benchmark.

An entry that is not measured stays empty. The last column of its line shows the command that measures it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from benchmarks.claims import OURS, Standing, Upset
from benchmarks.drives import WITH_BACKUP, DriveRow, budget_text
from benchmarks.options import Comparing, Training
from benchmarks.plannings import LONG, SECONDS, PlanRow
from benchmarks.roster import Contender
from benchmarks.store import BENCHMARKS
from benchmarks.table import Columns, bullet, listed
from benchmarks.training import Length
from stlc.options import parse_seconds, parse_seeds
from stlc.registry import GUARDS

HOUR = 3600.0
SEEDS = parse_seeds(Training().seeds)
"""Seeds of the trainings of each method and length; a training of an hour has the first only."""
PROGRAM = "python -m benchmarks paper"


@dataclass(frozen=True, slots=True)
class Learned:
    """Plan accuracy of policies trained by one method, on held-out initial states (never used in training).

    Attributes:
        benchmark: name of the specification.
        method: name of the training method.
        budget: length of the training as text, such as `60 s of processor time`.
        accuracy: plan accuracy, mean over seeds.
        interval: 95 % confidence interval of the accuracy.
        seconds: training time, mean over seeds.
        seeds: seeds of the trainings.
        outdated: whether an input, such as the specification, has changed since the measurement.
        fewer: number of judged states as text, such as ` (of 80 states)`; "" if all were judged.
    """

    benchmark: str
    method: str
    budget: str
    accuracy: float
    interval: tuple[float, float]
    seconds: float
    seeds: tuple[int, ...] = SEEDS
    outdated: bool = False
    fewer: str = ""

    def lacks(self, seeds: Iterable[int]) -> bool:
        """True if one of `seeds` has not been trained with the present inputs."""
        return self.outdated or not {*seeds} <= {*self.seeds}


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a table.

    Attributes:
        method: name of the method.
        budget: time budget as text.
        cells: benchmark -> text of the entry; "" if not measured.
        command: command that measures the empty entries; "" if there are none.
    """

    method: str
    budget: str
    cells: Mapping[str, str]
    command: str = ""


def markdown(lines: Iterable[Line], *, filled: bool = True) -> list[str]:
    """Return a Markdown table of `lines`; `filled` says whether it has the column of commands."""
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
    """Return the table of plan accuracies: one line per method and time budget, even if nothing is measured.

    Args:
        learners: methods that train a policy.
        planners: methods that plan without training.
        learned: measured accuracies of trained policies.
        plans: measured accuracies of planners.
        budgets: training times in seconds.
    """
    found = {(each.method, each.budget, each.benchmark): each for each in learned}
    rows = {(row.method, row.seconds, row.benchmark): row for row in plans if not row.label}
    lines = []
    for each in learners:
        for seconds in (*budgets, *((HOUR,) if each.hour else ())):
            budget = Length(seconds, clock="processor").text
            own = {name: found.get((each.name, budget, name)) for name in BENCHMARKS}
            hour = seconds == HOUR
            seeds, length = (SEEDS[:1], "--hour") if hour else (SEEDS, f"--budget {seconds:g}s")
            texts = {name: _learned_text(cell, seeds) for name, cell in own.items()}
            missing = [name for name, cell in own.items() if cell is None or cell.lacks(seeds)]
            lines.append(Line(each.name, budget, texts, _command(each, missing, length)))
    for each in planners:
        for limit in (None,) if each.evaluations else SECONDS:
            own_rows = {name: rows.get((each.name, limit, name)) for name in BENCHMARKS}
            spared = {name: _spared(rows, each.name, limit, name) for name in BENCHMARKS}
            texts = {name: spared[name] or _planned_text(row) for name, row in own_rows.items()}
            missing = [name for name, row in own_rows.items() if row is None and not spared[name]]
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
) -> str:
    """Text of the entry of a planner that is not measured with the time budget `limit` on purpose, else "".

    A long budget is skipped if, between two shorter budgets, ten times the time did not raise the accuracy
    (`no gain`), or if the planner cannot solve the task (`refused`).

    Args:
        rows: (planner, time budget, benchmark) -> measured result.
        method: name of the planner.
        limit: time budget per plan in seconds; None for the planner's own settings.
        name: name of the benchmark.
    """
    if limit is None or limit < LONG or (method, limit, name) in rows:
        return ""
    few, many = rows.get((method, SECONDS[1], name)), rows.get((method, SECONDS[2], name))
    if few is None or many is None:
        return ""
    if few.accuracy is None or many.accuracy is None:
        return "refused"
    return "no gain" if many.accuracy <= few.accuracy else ""


def _learned_text(cell: Learned | None, seeds: Sequence[int]) -> str:
    """Text of an entry; it names the trained seeds if some of `seeds` are missing."""
    if cell is None:
        return ""
    partly = not {*seeds} <= {*cell.seeds}
    own = f" (seed{'s' * (len(cell.seeds) > 1)} {', '.join(map(str, cell.seeds))})" if partly else ""
    old = " (outdated)" if cell.outdated else ""
    return f"{_interval(cell.accuracy, cell.interval)}{cell.fewer}{own}{old}"


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
    """Return the reasons for which planners cannot solve some benchmarks: lines of Markdown bullets."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in plans:
        if row.refused:
            found.setdefault((row.method, row.refused), []).append(row.benchmark)
    bullets = [
        bullet(f"{method} refuses {', '.join(dict.fromkeys(names))}: {why}")
        for (method, why), names in found.items()
    ]
    return [line for lines in bullets for line in lines]


def latencies(plans: Iterable[PlanRow]) -> list[Line]:
    """Return lines with the processor time of a decision in milliseconds: median / 99th percentile.

    Each decision is for a single initial state.
    """
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for row in plans:
        if row.median_ms is not None and row.p99_ms is not None:
            own = (row.label or row.method, "" if row.label else budget_text(row.seconds))
            groups.setdefault(own, {})[row.benchmark] = f"{row.median_ms:.3g} / {row.p99_ms:.3g}"
    return [Line(*own, cells) for own, cells in groups.items()]


def deployments(
    drives: Iterable[DriveRow], trained: Mapping[tuple[str, str], float], contenders: Iterable[Contender]
) -> list[Line]:
    """Return lines with accuracy and safety in closed loop, one line per method and guard.

    Of the policies of one training method on one benchmark, the most accurate is shown.

    Args:
        drives: measured results.
        trained: (benchmark, label of a trained policy) -> plan accuracy on held-out states.
        contenders: methods in the order of their lines; those that are not measured have empty lines.
    """
    known = {each.name: each for each in contenders}
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for each in known.values():
        seconds = None if each.evaluations else parse_seconds(Comparing().decision)
        for guard in WITH_BACKUP:
            cells[each.name, _loop_text(guard, seconds if each.plans else math.inf)] = {}
    for row in sorted(drives, key=lambda row: trained.get((row.benchmark, row.label), 0.0)):
        budget = _loop_text(row.guard, math.inf if row.label else row.seconds)
        cells.setdefault((row.method, budget), {})[row.benchmark] = _deployed_text(row)
    lines = []
    for (name, budget), own in cells.items():
        missing = [benchmark for benchmark in BENCHMARKS if benchmark not in own]
        command = _command(known[name], missing, "--parts drives") if name in known else ""
        lines.append(Line(name, budget, own, command))
    return lines


def _loop_text(guard: str, seconds: float | None) -> str:
    """Text for the guard, and for the time budget of a planner; `seconds` is inf for a trained policy."""
    backup = "with backup" if GUARDS.get(guard).intervenes else "no guard"
    return backup if seconds == math.inf else f"{budget_text(seconds)}, {backup}"


def _deployed_text(row: DriveRow) -> str:
    """Text of an entry: accuracy / safety, the trained policy, and the size if it is not the usual one."""
    if row.refused:
        return "refused"
    parts = [_with_half(row.accuracy, row.accuracy_half), _with_half(row.safety, row.safety_half)]
    run = row.label.removeprefix(f"{row.method.replace(':', '-')}-")
    notes = [note for note in (run, row.fewer) if note]
    return " / ".join(parts) + (f" ({'; '.join(notes)})" if notes else "")


def _with_half(value: float | None, half: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if half is None else f"{value:.3f} ± {half:.3f}"


def standings(
    learned: Iterable[Learned], plans: Sequence[PlanRow], drives: Iterable[DriveRow]
) -> list[Standing]:
    """Return the results by which the paper's claims are judged: one per method and benchmark.

    Each is the result with the longest training, or with the largest time budget per plan. Outdated results
    are left out.
    """
    found: dict[tuple[str, str], Standing] = {}
    policies = [row for row in plans if row.label and not row.outdated]
    guarded = {
        (row.benchmark, row.method): row.median_ms
        for row in drives
        if row.label and GUARDS.get(row.guard).intervenes and not row.outdated
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
    """Return the benchmarks on which search without training beats the best policy trained by `guided`.

    Both are measured on the same initial states. The reported time budget is the least with which search is
    better.
    """
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
