"""Training runs of the tables: results are stored, interrupted runs are resumed, and new runs are started.

Several runs can proceed in parallel.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.store import BENCHMARKS, Key, Result, ResultStore, inputs_of, load, spec_path
from stlc.cli.framework.output import say
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.evaluation.stats import MeanInterval
from stlc.controller.parallel import executor
from stlc.controller.parallel.jobs import Job
from stlc.controller.problem.inputs import input_files
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.run.config import HELD_OUT, HELD_OUT_SEED
from stlc.controller.run.run import Run
from stlc.controller.training.config import ENGINE_VERSION, TrainConfig
from stlc.diagnostics import StlcError
from stlc.options import Clock
from stlc.provenance import sha256
from stlc.registry import METHODS
from stlc.rundir import RunDir
from stlc.view.held_out import load_held_out

CURVE_POINTS = 80
ROUNDING = 0.01
"""Seconds by which the planned time of a run may be less than that of its cell."""


@dataclass(frozen=True, slots=True)
class Length:
    """Length of a training run: a time budget in seconds of `clock`, or a number of steps."""

    seconds: float | None = None
    steps: int | None = None
    clock: Clock = "wall"

    @property
    def name(self) -> str:
        """Length in file names, such as `60s` or `200steps`."""
        return f"{self.steps}steps" if self.steps is not None else f"{self.seconds:g}s"

    @property
    def text(self) -> str:
        """Length as text for readers, such as `60 s`."""
        if self.steps is not None:
            return f"{self.steps:,} steps"
        return f"{self.seconds:g} s" + (" of processor time" if self.clock == "processor" else "")

    @property
    def options(self) -> tuple[str, ...]:
        """Options of `stlc train` that set this length."""
        if self.steps is not None:
            return ("--steps", str(self.steps))
        return ("--budget", f"{self.seconds:g}s", "--budget-clock", self.clock)


@dataclass(frozen=True, slots=True)
class Cell:
    """Description of one training run for a benchmark.

    Attributes:
        benchmark: name of the specification.
        method: name of the training method.
        seed: seed of the run.
        length: length of the run.
        held_out: number of held-out states (never used in training) on which the policy is judged.
        axis: hyperparameter that an ablation varies in this run; "" outside of ablations.
        value: value of that hyperparameter.
        overrides: name of a field in the system file -> new value.
        options: options of the method, as on a command line. `falsify` becomes `--falsify`, and any other
            becomes `--option`.
    """

    benchmark: str
    method: str
    seed: int
    length: Length
    held_out: int = HELD_OUT
    axis: str = ""
    value: str = ""
    overrides: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)

    @property
    def contender(self) -> str:
        """Name of the method with its options, such as `guided` or `sac:task`."""
        return ":".join((self.method, *self.options.values()))

    @property
    def name(self) -> str:
        """Name under which the result is stored, such as `traffic-guided-60s-seed0`."""
        own = self.contender.replace(":", "-")
        first = ("ablation", self.axis, self.value) if self.axis else (self.benchmark, own)
        return "-".join([*filter(None, first), self.length.name, f"seed{self.seed}"])

    @property
    def label(self) -> str:
        """Name without the benchmark, such as `guided-60s-seed0`."""
        return self.name.removeprefix(f"{self.benchmark}-")

    @property
    def key(self) -> Key:
        """Key under which the result is stored: its name and all its inputs.

        Raises:
            UsageError, SpecError, SystemFileError: an input file is missing or invalid.
        """
        task = load(self.benchmark, tuple(self.overrides.items()))
        return Key(
            self.name,
            {
                **{**inputs_of(task), **self._declared(task)},
                **{"benchmark": self.benchmark, "method": self.method},
                **{"method_version": ENGINE_VERSION + METHODS.get(self.method).version},
                **{"seed": self.seed, "budget": self.length.seconds, "steps": self.length.steps},
                **{"clock": self.length.clock, "held_out": self.held_out, "held_out_seed": HELD_OUT_SEED},
                **{"axis": self.axis, "value": self.value, "overrides": dict(self.overrides)},
                **({"options": dict(self.options)} if self.options else {}),
            },
        )

    def _declared(self, task: Task) -> dict[str, Any]:
        """Training settings that the system file declares, besides `overrides`, and the result depends on."""
        train = task.system.decl.train
        names = [name for name in ("lr", "batch", "samples") if f"train.{name}" not in self.overrides]
        found = {name: value for name in names if (value := getattr(train, name)) is not None}
        if self.options.get("reward") == "task":
            found["reward_sha256"] = sha256(repr(train.reward))
        return found

    @classmethod
    def of(cls, result: Result) -> Cell:
        """Return the description of the training run that produced a stored result."""
        key = result["key"]
        length = Length(key["budget"], key["steps"], key["clock"])
        return cls(
            *(key["benchmark"], key["method"], key["seed"], length, key["held_out"]),
            *(key["axis"], key["value"], key["overrides"], key.get("options", {})),
        )

    def config(self) -> TrainConfig:
        """Return the options of the training run as a `TrainConfig`."""
        return TrainConfig(
            method=self.method,
            budget=self.length.seconds,
            steps=self.length.steps,
            seed=self.seed,
            held_out=self.held_out,
            clock=self.length.clock,
            drives=0,
        )


@dataclass(frozen=True, slots=True)
class Place:
    """Place of training runs: the file of their results, their folders, and the computers that train.

    Attributes:
        store: file of the results.
        runs: folder in which the run folders are created.
        jobs: number of runs at a time, each in its own process.
        threads: number of torch threads per process.
        cluster: address of a Ray cluster to train on; None for this machine.
    """

    store: ResultStore
    runs: Path = Path("runs/benchmarks")
    jobs: int = 1
    threads: int = 1
    cluster: str | None = None

    def runs_of(self, key: Key) -> Path:
        """Return the folder for runs with the inputs `key`; other inputs have another folder."""
        return self.runs / f"{key.name}-{key.digest}"

    def newest_run(self, key: Key) -> RunDir | None:
        """Return the newest run with the inputs `key`, whose result can be read or which can be resumed.

        The result is None if there is no run, or if the newest run failed or has no checkpoint.
        """
        runs = RunDir.every(self.runs_of(key))
        if not runs or not (runs[-1].path / "ckpt" / "last.json").is_file():
            return None
        try:
            return None if runs[-1].status == "failed" else runs[-1]
        except StlcError:
            return None

    def best_run(self, results: Sequence[Result]) -> RunDir | None:
        """Return the most accurate run among `results`, or None if that run no longer exists.

        Compared are the lower ends of the 95 % intervals, since some runs are judged on few states.
        """
        best = max(results, key=lambda result: wilson(float(result["accuracy"]), judged_states(result))[0])
        return self.newest_run(Cell.of(best).key)

    def valid(self) -> list[Result]:
        """Return the stored results whose specification, system and method are unchanged."""
        return [each for each in self.store.all().values() if not outdated(each)]

    def all(self) -> list[Result]:
        """Return all stored results; those with unchanged inputs come first."""
        return sorted(self.store.all().values(), key=lambda each: bool(outdated(each)))


INPUTS = {
    **{"spec_sha256": "specification", "system_sha256": "system", "method_version": "method"},
    **{"reward_sha256": "reward", "samples": "training set"},
}
"""Name of an input of a training run that can change while the result is stored -> the input in words."""


def outdated(result: Result) -> tuple[str, ...]:
    """Return the inputs of a stored training result that have changed since; empty if there are none."""
    now, then = Cell.of(result).key.values, result["key"]
    return tuple(INPUTS.get(name, name) for name in now if now[name] != then.get(name))


def inputs_text(changed: Sequence[str]) -> str:
    """Return the text of a table's column on inputs: `current`, or `outdated` with the changed inputs."""
    return f"outdated: {', '.join(changed)}" if changed else "current"


OUTDATED_TEXT = """\
Rows whose `inputs` are outdated were measured before a change of the specification, the system or the method,
and are shown until they are measured again.
"""


@dataclass(frozen=True, slots=True)
class Filling:
    """Results of the training runs of a table.

    Attributes:
        results: stored and new results, in the order of the cells (requested runs).
        trained: number of new results.
        kept: number of results that were already stored.
        failed: name and reason of each run that failed.
    """

    results: tuple[Result, ...]
    trained: int
    kept: int
    failed: tuple[dict[str, str], ...]

    def facts(self, valid: int, failed: Sequence[dict[str, str]] = ()) -> dict[str, Any]:
        """Return entries for the JSON document: counts of results, and all failures.

        Args:
            valid: number of stored results with unchanged inputs.
            failed: failures in addition to those of the training runs.
        """
        counts = {"results": valid, "trained": self.trained, "kept": self.kept}
        return {**counts, "failed": [*self.failed, *failed]}


def filled(cells: Sequence[Cell], place: Place) -> Filling:
    """Return the results of the training runs `cells`; runs without a stored result are trained now.

    Progress is printed.
    """
    found: dict[str, Result] = {}
    failed: list[dict[str, str]] = []
    kept = 0
    for number, (cell, result, note) in enumerate(_fill(cells, place), start=1):
        counted = f"[{number}/{len(cells)}] {cell.name}"
        if result is None:
            failed.append({"name": cell.name, "why": note})
            say(f"{counted}  broke off: {note}")
            continue
        found[cell.name] = result
        kept += note == "kept"
        done = (*found, *(each["name"] for each in failed))
        told = note or ("" if place.cluster is not None else remaining(cells, done, place.jobs))
        say(f"{counted}  accuracy {result['accuracy']:.4f}  {result['seconds']:.0f} s  {told}".rstrip())
    results = tuple(found[cell.name] for cell in cells if cell.name in found)
    return Filling(results, len(results) - kept, kept, tuple(failed))


def remaining(cells: Sequence[Cell], done: Sequence[str], jobs: int) -> str:
    """Return a text with the number of remaining runs and an estimate of their time.

    The text is "" if nothing remains, or if a remaining run has no time budget.

    Args:
        cells: all training runs.
        done: names of the runs that have ended.
        jobs: number of runs at a time.
    """
    lengths = [cell.length.seconds for cell in cells if cell.name not in done]
    if not lengths or None in lengths:
        return ""
    minutes = sum(length or 0.0 for length in lengths) / jobs / 60.0
    return f"{len(lengths)} left, about {minutes:.0f} min"


def _fill(cells: Sequence[Cell], place: Place) -> Iterator[tuple[Cell, Result | None, str]]:
    """Yield a triple for each training run in `cells` when it has ended.

    It is (cell, result, "kept") for a stored result, (cell, result, "") for a new one, and (cell, None,
    reason) if the run failed.
    """
    wanted: dict[str, Cell] = {}
    for cell in cells:
        kept = place.store.find(cell.key)
        if kept is not None:
            yield cell, kept, "kept"
        else:
            wanted[cell.name] = cell
    jobs = []
    for cell in wanted.values():
        run = place.newest_run(cell.key)
        if run is not None and is_complete(run, cell):
            yield cell, place.store.put(cell.key, collect(run)), ""
        else:
            jobs.append(_job(cell, place, run))
    workers = executor(place.jobs, place.cluster if jobs else None, cores=place.threads)
    for back in workers.run(jobs, lambda job: say(f"training {job.name}")):
        cell = wanted[back.job.name]
        run = place.newest_run(cell.key)
        if back.code not in (0, 1) or run is None or not is_complete(run, cell):
            yield cell, None, f"exit code {back.code}\n{back.why}".strip()
        else:
            yield cell, place.store.put(cell.key, collect(run, cores=back.cores)), ""


def _job(cell: Cell, place: Place, run: RunDir | None) -> Job:
    """Return the job of a training run: the arguments of `stlc train`, and input files for another machine.

    If the interrupted run `run` is given, the job resumes it. Otherwise it extends a shorter run if it can.
    """
    runs = place.runs_of(cell.key)
    run = run or _shorter(cell, place)
    if run is not None:
        arguments: tuple[str, ...] = ("--resume", str(run.path), "--no-pictures", *_extension(cell, run))
    else:
        overrides = [word for key, value in cell.overrides.items() for word in ("--set", f"{key}={value}")]
        own = [word for key, value in cell.options.items() for word in _option(key, value)]
        arguments = (
            str(spec_path(cell.benchmark)),
            *("--method", cell.method, "--seed", str(cell.seed), *cell.length.options),
            *("--threads", str(place.threads), "--held-out", str(cell.held_out), "--drives", "0"),
            *("--runs", str(runs), "--no-pictures", *own, *overrides),
        )
    if place.cluster is None:
        return Job(cell.name, arguments)
    read = input_files(spec_path(cell.benchmark), overrides=cell.overrides)
    return Job(cell.name, arguments, read if run is None else (run.path,), runs)


def is_complete(run: RunDir, cell: Cell) -> bool:
    """True if a run has finished and was planned with all the time of the cell, so is not to be extended."""
    return run.status == "finished" and not _extension(cell, run)


def _extension(cell: Cell, run: RunDir) -> tuple[str, ...]:
    """Options of `stlc train --resume` if a run was planned with less time than the cell has; else empty."""
    planned = float(run.record().get("seconds_allowed") or math.inf)
    if cell.length.seconds is None or planned >= cell.length.seconds - ROUNDING:
        return ()
    return ("--budget", f"{cell.length.seconds - _spent(run):.3f}s")


def _spent(run: RunDir) -> float:
    """Training time of a run in seconds, on its clock."""
    return float(run.read_json("ckpt/last.json")["seconds"])


def _shorter(cell: Cell, place: Place) -> RunDir | None:
    """Copy of the longest finished run that differs from the cell in its length only; None if there is none.

    Only the runs of methods whose steps do not depend on the length are copied: those that are `extendable`.
    """
    extendable = getattr(METHODS.get(cell.method), "extendable", False)
    if not extendable or cell.length.seconds is None or place.cluster is not None:
        return None
    cells = [Cell.of(result) for result in place.valid()]
    cells = [each for each in cells if each.length.seconds and each.length.seconds < cell.length.seconds]
    same = [each for each in cells if replace(cell, length=each.length).key == each.key]
    for each in sorted(same, key=lambda each: -(each.length.seconds or 0.0)):
        run = place.newest_run(each.key)
        if run is not None and is_complete(run, each) and _spent(run) < cell.length.seconds:
            target = place.runs_of(cell.key) / run.path.parent.name / run.path.name
            shutil.rmtree(target, ignore_errors=True)  # what is there has failed, or it would be resumed
            beside = target.with_name(f".{target.name}")
            shutil.rmtree(beside, ignore_errors=True)
            shutil.copytree(run.path, beside)
            beside.rename(target)
            return RunDir(target)
    return None


def _option(key: str, value: str) -> tuple[str, ...]:
    """Words of the command line for an option of a cell."""
    return ("--falsify",) if key == "falsify" else ("--option", f"{key}={value}")


def _portable(word: str) -> str:
    """Word of a command without folders of this machine: relative to the current one, or the last name."""
    path = Path(word)
    if not path.is_absolute():
        return word
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name


def collect(run: RunDir, *, cores: int | None = None) -> Result:
    """Return the result of a finished training run, with its learning curve and its provenance.

    `cores` is the number of cores that the run used, if known.
    """
    record = run.record()
    held = load_held_out(run)
    solved = [] if held is None else [TOLERANCE.satisfied(rho) for rho in held.rho.tolist()]
    made = {key: record[key] for key in ("versions", "git", "hardware", "threads")}
    return {
        **record["result"],
        **{key: record[key] for key in ("spec_path", "system_path", "engine", "steps", "margin")},
        "training_accuracy": training_accuracy(run),
        "solved": pack(solved),
        "curve": _curve(run),
        "command": ["stlc", *map(_portable, record["command"])],
        "made": {**made, "cores": cores, "started": record["started"], "date": record["finished"]},
    }


def training_accuracy(folder: RunDir) -> float | None:
    """Return the share of the training states from which the policy's plan satisfies the specification.

    The result is None if training drew new states in every step.
    """
    saved = load_checkpoint(folder, **folder.hashes)
    states = saved.tensors.get("training.states")
    if states is None:
        return None
    _, judged = Run.open(folder.path).plan_judged(states.double())
    return float(TOLERANCE.satisfied(judged.rho).double().mean())


def _curve(run: RunDir) -> list[dict[str, float | None]]:
    """Return at most `CURVE_POINTS` points of the learning curve: accuracy on new random states over time."""
    rows = [row for row in run.rows() if row.get("accuracy") is not None]
    every = max(1, -(-len(rows) // CURVE_POINTS))
    kept = rows[::-1][::every][::-1]
    return [{key: row.get(key) for key in ("seconds", "step", "accuracy", "feasible")} for row in kept]


@dataclass(frozen=True, slots=True)
class SeedGroup:
    """Results of training runs that differ only in the seed.

    Attributes:
        results: results in the order of their seeds.
        outdated: inputs that have changed since; the same for all results.
    """

    results: tuple[Result, ...]
    outdated: tuple[str, ...] = ()

    @property
    def cell(self) -> Cell:
        """Description of the training run with the first seed."""
        return Cell.of(self.results[0])

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the training runs."""
        return tuple(int(each["key"]["seed"]) for each in self.results)

    @property
    def accuracies(self) -> tuple[float, ...]:
        """Accuracy on the held-out states, one number per seed."""
        return tuple(float(each["accuracy"]) for each in self.results)

    @property
    def judged(self) -> tuple[int, ...]:
        """Number of held-out states on which each result's policy was judged."""
        return tuple(map(judged_states, self.results))

    def mean(self, name: str) -> float:
        """Return the mean over the seeds of the number that the results store under `name`."""
        return fmean(float(each[name]) for each in self.results)


def interval_over_seeds(accuracies: Sequence[float], judged: Sequence[int]) -> tuple[float, float]:
    """Return the 95 % interval of the mean accuracy over seeds, for other seeds and other held-out states.

    The scatter of the seeds (Student's t) and the error of a share of states (Wilson) are added in
    quadrature. All seeds are judged on the same states, so more seeds do not reduce the second. A single seed
    has no scatter: its interval is that of the states alone.

    Args:
        accuracies: accuracy of each seed.
        judged: number of held-out states on which each seed was judged.
    """
    mean, scatter = fmean(accuracies), MeanInterval.of(accuracies).half or 0.0
    low, high = wilson(mean, round(fmean(judged)))
    return max(mean - math.hypot(mean - low, scatter), 0.0), min(mean + math.hypot(high - mean, scatter), 1.0)


def judged_states(result: Result) -> int:
    """Return the number of held-out states that the accuracy of a stored training result is a share of.

    These are the first of the requested states: the evaluation of a slow policy ends before the last of them.
    """
    return int(result.get("held_out", result["key"]["held_out"]))


def fewer_text(judged: Sequence[int], held_out: int) -> str:
    """Return the number of judged states as text, such as ` (of 80 states)`; "" if all were judged.

    Args:
        judged: number of judged states, one per seed.
        held_out: number of requested states.
    """
    if min(judged) == held_out:
        return ""
    return f" (of {', '.join(map(str, dict.fromkeys(judged)))} states)"


def grouped(results: Iterable[Result]) -> list[SeedGroup]:
    """Group results that differ only in the seed; current and outdated results form separate groups."""
    groups: dict[tuple[Any, ...], list[Result]] = {}
    for result in sorted(results, key=lambda each: int(each["key"]["seed"])):
        cell = Cell.of(result)
        key = (cell.benchmark, cell.contender, cell.length, cell.axis, cell.value, outdated(result))
        groups.setdefault(key, []).append(result)
    return [SeedGroup(tuple(own), key[-1]) for key, own in groups.items()]


def benchmark_order(name: str) -> tuple[int, str]:
    """Return the sort key of a benchmark: the paper's benchmarks first, in its order, then others by name."""
    return BENCHMARKS.index(name) if name in BENCHMARKS else len(BENCHMARKS), name


def pack(flags: Sequence[bool]) -> str:
    """Pack truth values into a text of hexadecimal digits; the first value is the highest bit."""
    bits = "".join("1" if flag else "0" for flag in flags)
    return f"{int(bits or '0', 2):0{-(-len(flags) // 4)}x}"


def unpack(digits: str, count: int) -> list[bool]:
    """Return the `count` truth values that `pack` wrote into `digits`."""
    return [bit == "1" for bit in f"{int(digits or '0', 16):0{count}b}"]
