"""Control tasks as written: plans, the planner as a controller, and policies, by the tasks' own judges."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from benchmarks.judged import ControlTask, NoAnswerError, asked, end_of, judged, tasks_in
from benchmarks.measured import measured
from benchmarks.options import OnlyOption, Output, ResultsOption, SeedsOption, TrainedOption, chosen
from benchmarks.store import Key, Result, ResultStore
from benchmarks.table import Columns, Table, listed, provenance, publish
from stlc.cli.framework.program import command
from stlc.controller.search.planner import planning_version
from stlc.controller.training.config import ENGINE_VERSION
from stlc.options import parse_seeds
from stlc.registry import GUARDS as KINDS

PARTS = ("plans", "controller", "policy")
GUARDS = ("none", "paper", "full")
AGENTS = 10
"""Agents in one world, at most."""
TEXT = """### Plans, drives and policies

Written by `python -m benchmarks tasks` from `benchmarks/results/tasks.json`: tasks as written, one
command each. `plans`: `stlc plan` from {starts} random starts, {seconds:g} s of search each. `controller`:
`stlc simulate --method search` with {decision:g} ms a decision. `policy`: `stlc train` for
{train_seconds:g} s of processor time, then `stlc simulate` with each guard. `obey` counts the plans or drives
that the task's own judge accepts, seed by seed. Milliseconds: processor time of a plan (`99 %`: the longest),
elapsed time of a decision. The last column names the rules that were violated and how many obeyed them, or
the reason for which there is no figure.
"""
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class Size:
    """Size of all measurements.

    Attributes:
        starts: initial states that plans are searched from.
        seconds: processor time of the search of one plan in seconds.
        decision: processor time of a decision of the planner as a controller in milliseconds.
        train_seconds: processor time of a training in seconds.
        drives: drives of a controller.
        limit: seconds that one command may take.
    """

    starts: int
    seconds: float
    decision: float
    train_seconds: float
    drives: int
    limit: float

    def worlds(self, seed: int) -> tuple[str, ...]:
        """Options of `stlc simulate` for the drives of a seed: at most `AGENTS` in a world."""
        agents = min(AGENTS, self.drives)
        worlds = -(-self.drives // agents)
        return "--agents", str(agents), "--seeds", f"{seed * worlds}..{(seed + 1) * worlds - 1}"


@dataclass(frozen=True, slots=True)
class TaskCell:
    """One part of the measurements of a task, with one seed.

    Attributes:
        task: the task.
        part: `plans`, `controller` or `policy`.
        seed: seed of starts, searches, training and drives.
        size: size of the measurement.
    """

    task: ControlTask
    part: str
    seed: int
    size: Size

    @property
    def name(self) -> str:
        """Name under which the result is stored, such as `crane-plans-seed0`."""
        return f"{self.task.name.replace('/', '-')}-{self.part}-seed{self.seed}"

    @property
    def key(self) -> Key:
        """Key under which the result is stored: hashes of all files, sizes and versions."""
        sizes = {
            "plans": ("starts", "seconds"),
            "controller": ("decision", "drives"),
            "policy": ("train_seconds", "drives"),
        }[self.part]
        versions: dict[str, Any] = {"planner_version": planning_version("search")}
        if self.part == "policy":
            guards = [KINDS.get(name).version for name in GUARDS]
            versions |= {"engine_version": ENGINE_VERSION, "guard_versions": guards}
        return Key(
            self.name,
            {
                **{"task": self.task.name, "part": self.part, "seed": self.seed},
                **{"files": self.task.hashes, **versions},
                **{name: getattr(self.size, name) for name in sizes},
            },
        )


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """TaskOutcome of one command: judged plans or drives, with times.

    Attributes:
        what: `plans`, `controller`, or `policy` and its guard.
        obeyed: number of plans or drives that obey all rules; None if there is no verdict.
        count: number of plans or drives; 0 if there are none.
        median_ms: median processor time of a plan, or elapsed time of a decision.
        p99_ms: 99th percentile of the times of decisions, or the longest time of a plan.
        said: what stlc itself said.
        cause: rules that were violated, or the reason why there is no verdict.
    """

    what: str
    obeyed: int | None = None
    count: int = 0
    median_ms: float | None = None
    p99_ms: float | None = None
    said: str = ""
    cause: str = ""


def measure(cell: TaskCell, runs: Path) -> Result:
    """Measure a cell; what fails is an outcome with its cause. Trained policies are kept in `runs`."""
    with TemporaryDirectory() as name:
        trace = Path(name) / "trace.npz"
        if cell.part == "plans":
            found = [_outcome("plans", cell, trace, partial(_plans, cell, trace))]
        elif cell.part == "controller":
            search = ("--method", "search", "--budget", f"{cell.size.decision:g}ms", "--runs", name)
            drive = partial(_drives, cell, trace, str(cell.task.spec), *search)
            found = [_outcome("controller", cell, trace, drive)]
        else:
            found = list(_policy(cell, trace, runs))
    return {"outcomes": [asdict(each) for each in found]}


def _outcome(what: str, cell: TaskCell, trace: Path, making: Callable[[], TaskOutcome]) -> TaskOutcome:
    """Return the outcome of `making`, which writes `trace`, with the verdicts of the judge."""
    trace.unlink(missing_ok=True)
    made = TaskOutcome(what)
    try:
        made = replace(making(), what=what)
        verdicts = judged(cell.task, trace)
        return replace(made, obeyed=verdicts.obeyed, count=verdicts.count, cause=verdicts.lacking)
    except NoAnswerError as error:
        return replace(made, cause=str(error))


def _plans(cell: TaskCell, trace: Path) -> TaskOutcome:
    size = cell.size
    result = asked(
        *("plan", str(cell.task.spec), "--starts", str(size.starts), "--budget", f"{size.seconds:g}s"),
        *("--seed", str(cell.seed), "--out", str(trace)),
        limit=size.limit,
    )
    times = result["seconds"]
    said = f"{result['satisfied']} of {result['starts']} satisfied, to {end_of(trace):g} s"
    return TaskOutcome("", median_ms=1e3 * times["median"], p99_ms=1e3 * times["most"], said=said)


def _drives(cell: TaskCell, trace: Path, subject: str, *options: str, guard: str = "none") -> TaskOutcome:
    result = asked(
        *("simulate", subject, *options, *cell.size.worlds(cell.seed), "--guard", guard),
        *("--record", str(trace), "--no-pictures"),
        limit=cell.size.limit,
    )
    driven = result["guards"][guard]
    times, drives = driven["latency"], driven.get("drives")
    said = "" if drives is None else f"{drives['obeyed']} of {drives['count']} obeyed"
    return TaskOutcome("", median_ms=1e3 * times["median"], p99_ms=1e3 * times["p99"], said=said)


def _policy(cell: TaskCell, trace: Path, runs: Path) -> Iterator[TaskOutcome]:
    """Train a policy, then drive with each guard."""
    try:
        trained = asked(
            *("train", str(cell.task.spec), "--budget", f"{cell.size.train_seconds:g}s"),
            *("--budget-clock", "processor", "--seed", str(cell.seed), "--runs", str(runs), "--no-pictures"),
            limit=cell.size.limit,
        )
    except NoAnswerError as error:
        yield TaskOutcome("policy", cause=str(error))
        return
    told = _told(trained)
    for guard in GUARDS:
        drive = partial(_drives, cell, trace, trained["run"], guard=guard)
        yield replace(
            _outcome(f"policy, {guard}", cell, trace, drive), said=told if guard == GUARDS[0] else ""
        )


def _told(trained: Mapping[str, Any]) -> str:
    """Account that `stlc train` gives of its policy: drives by guard, and the verdict."""
    driven = [
        f"{each['guard']} {each['satisfied']} of {each['drives']}"
        for each in trained.get("closed_loop", {}).get("guards", ())
    ]
    verdict = trained.get("verdict", {})
    return "; ".join(filter(None, (", ".join(driven), verdict.get("level", ""))))


@dataclass(frozen=True, slots=True)
class TaskRow:
    """Outcomes of one part of a task, seed by seed.

    Attributes:
        task: name of the task.
        what: `plans`, `controller`, or `policy` and its guard.
        seeds: the seeds.
        obeyed: for each seed, the number of plans or drives that obey; None without a verdict.
        count: number of plans or drives of a seed.
        median_ms: median over the seeds of the median times.
        p99_ms: greatest over the seeds of the 99th percentiles.
        said: what stlc itself said, without repetitions.
        causes: violated rules or reasons why there is no verdict, without repetitions.
    """

    task: str
    what: str
    seeds: tuple[int, ...]
    obeyed: tuple[int | None, ...]
    count: int
    median_ms: float | None
    p99_ms: float | None
    said: tuple[str, ...]
    causes: tuple[str, ...]

    @classmethod
    def of(cls, task: str, what: str, outcomes: Mapping[int, TaskOutcome]) -> TaskRow:
        """Return the row of the outcomes by seed."""
        own = [*outcomes.values()]
        medians = [each.median_ms for each in own if each.median_ms is not None]
        return cls(
            *(task, what, tuple(outcomes), tuple(each.obeyed for each in own)),
            max(each.count for each in own),
            median(medians) if medians else None,
            max((each.p99_ms for each in own if each.p99_ms is not None), default=None),
            *(_distinct(each.said for each in own), _distinct(each.cause for each in own)),
        )

    @property
    def counts(self) -> str:
        """Numbers that obey, such as `20, 19, 20 of 20`; `-` without a verdict."""
        counts = ", ".join("-" if each is None else str(each) for each in self.obeyed)
        return f"{counts} of {self.count}" if self.count else counts


def _distinct(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(filter(None, texts)))


COLUMNS: Columns[TaskRow] = {
    **{"task": "{task}", "": "{what}", "obey": "{counts}"},
    **{"median": "{median_ms:.3g}", "99 %": "{p99_ms:.3g}"},
    "stlc says": lambda row: "; ".join(row.said),
    "violated, or why not": lambda row: "; ".join(row.causes),
}


def rows_of(results: Iterable[Result]) -> list[TaskRow]:
    """Return the rows of stored results, in the order in which tasks and parts come first."""
    groups: dict[tuple[str, str], dict[int, TaskOutcome]] = {}
    for each in results:
        key = each["key"]
        for outcome in (TaskOutcome(**one) for one in each["outcomes"]):
            groups.setdefault((key["task"], outcome.what), {})[key["seed"]] = outcome
    return [TaskRow.of(*names, outcomes) for names, outcomes in groups.items()]


@command(
    "python -m benchmarks tasks --parts plans",
    "python -m benchmarks tasks --only swingup,rotors --seeds 0 --parts plans,controller",
)
def tasks(
    folder: Annotated[
        Path, typer.Option("--folder", metavar="DIR", help="Folder with a folder for each task.")
    ] = Path("benchmarks/tasks"),
    only: OnlyOption = None,
    parts: Annotated[
        str | None,
        typer.Option("--parts", metavar="NAMES", help="Of plans,controller,policy; all if not given."),
    ] = None,
    seeds: SeedsOption = "0..2",
    starts: Annotated[int, typer.Option("--starts", metavar="N", min=1, help="Starts of plans.")] = 20,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of search a start.")
    ] = 1.0,
    decision: Annotated[
        float,
        typer.Option("--decision", metavar="MS", min=0.0, help="Milliseconds of a planner's decision."),
    ] = 100.0,
    train_seconds: Annotated[
        float,
        typer.Option(
            "--train-seconds", metavar="S", min=0.0, help="Processor time of a training, in seconds."
        ),
    ] = 60.0,
    drives: Annotated[int, typer.Option("--drives", metavar="N", min=1, help="Drives of a controller.")] = 20,
    limit: Annotated[
        float, typer.Option("--limit", metavar="S", min=1.0, help="Seconds that one command may take.")
    ] = 3600.0,
    out: ResultsOption = Path("benchmarks/results"),
    runs: TrainedOption = Path("runs/benchmarks"),
    output: Output = _OUTPUT,
) -> None:
    """Plan, drive and train for control tasks in folders, and judge by the tasks' own programs.

    Stored results are reused if the files of the task, sizes and versions are unchanged.
    """
    size = Size(starts, seconds, decision, train_seconds, drives, limit)
    found = {each.name: each for each in tasks_in(folder)}
    names, asked_for = chosen(only, [*found], "task"), chosen(parts, PARTS, "part")
    cells = (
        TaskCell(found[name], part, seed, size)
        for name, part, seed in product(names, asked_for, parse_seeds(seeds))
    )
    measuring = partial(measure, runs=runs)
    results = measured(cells, ResultStore("tasks", out), measuring, doing="measuring", told=_summary).results
    table = listed("tasks", rows_of(results), COLUMNS)
    publish("tasks", output, lambda: _section(table, results, size), {"rows": table}, results=len(results))


def _summary(result: Result) -> str:
    return ";  ".join(
        f"{each['what']}: {each['obeyed']} of {each['count']}  {each['cause']}" for each in result["outcomes"]
    )


def _section(table: Table[TaskRow, TaskRow], results: Sequence[Result], size: Size) -> list[str]:
    return [TEXT.format(**asdict(size)), *table.markdown(), "", *provenance(results, "measurements")]
