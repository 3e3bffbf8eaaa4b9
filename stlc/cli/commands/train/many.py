"""Training for several specifications and seeds, each run in its own process, and a summary table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.commands.train.trained import JudgedTraining, TrainedJob, TrainedRun, TrainedRuns
from stlc.cli.framework.output import Answer, emit, say, table
from stlc.escape import operand
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.controller.parallel.jobs import Job, JobResult
    from stlc.controller.training.launch import Launch
    from stlc.controller.training.options import TrainOptions

HEADER = ("seed", "drives", "accuracy", "95 % interval", "known feasible", "worst requirement", "time", "run")
ENDED = 70
"""Exit code of a process killed by a signal."""


@dataclass(frozen=True, slots=True)
class Part:
    """One training run of several: its specification and its seed.

    Attributes:
        spec: file of the specification.
        seed: seed of the run; None: the seed in the system file.
    """

    spec: Path
    seed: int | None


@dataclass(frozen=True, slots=True)
class Many:
    """Training runs that differ only in specification and seed.

    Attributes:
        specs: files of the specifications.
        system: system file of `--system`, or None; allowed for a single specification only.
        options: training options that all runs share.
        launch: folder, name and overrides of the runs.
        seeds: seeds with which each specification is trained for; None is the seed in the system file.
        jobs: number of runs at a time, each in its own process.
        cluster: address of the Ray cluster to train on; None for this machine.
        log: value of `--log`.
        pictures: whether a report with pictures is written for each run.
    """

    specs: Sequence[Path]
    system: str | None
    options: TrainOptions
    launch: Launch
    seeds: Sequence[int | None]
    jobs: int
    cluster: str | None
    log: str | None
    pictures: bool

    @property
    def parts(self) -> list[Part]:
        """The runs in order: all seeds of the first specification, then those of the next."""
        return [Part(spec, seed) for spec in self.specs for seed in self.seeds]

    def name(self, part: Part) -> str:
        """Name of a run in messages: its specification, its seed, or both.

        The name contains only the parts in which the run differs from the other runs.
        """
        words = [] if len(self.specs) == 1 and part.seed is not None else [str(part.spec)]
        return " ".join(words + ([] if part.seed is None else [f"seed {part.seed}"]))

    def job(self, part: Part) -> Job:
        """Return the job of one run: the arguments of `stlc train`.

        If the run is trained on a cluster, the job also lists its input files.
        """
        from stlc.controller.parallel.jobs import Job

        options, launch = self.options, self.launch
        threads = options.threads or (1 if self.jobs > 1 or self.cluster is not None else None)
        seeded = "" if part.seed is None else f"-seed{part.seed}"
        name = None if launch.name is None else f"{launch.name}{seeded}"
        words = replace(options, seed=part.seed, threads=threads).words()
        own = {"--system": self.system, "--name": name, "--log": self.log, "--runs": launch.root}
        words |= {flag: (str(value),) for flag, value in own.items() if value is not None}
        words["--set"] = tuple(f"{key}={value}" for key, value in launch.overrides.items())
        drawn = () if self.pictures else ("--no-pictures",)
        arguments = (operand(str(part.spec)), *Options.command_line(words), *drawn)
        if self.cluster is None:
            return Job(self.name(part), arguments)
        from stlc.controller.problem.inputs import input_files

        read = input_files(part.spec, self.system, launch.overrides)
        return Job(self.name(part), arguments, read, launch.root)


def train_many(many: Many) -> Answer[TrainedRuns]:
    """Train all runs in processes of their own and return their records.

    The answer is printed as a table. Its exit code is the greatest exit code of all runs.
    """
    from stlc.controller.parallel import executor

    cores, gpus = many.options.threads or 1, int(many.options.device != "cpu")
    started = "begins" if many.cluster is None else "is sent"
    processes = executor(many.jobs, many.cluster, cores=cores, gpus=gpus)
    found: dict[str, JobResult] = {}
    try:
        jobs = [many.job(part) for part in many.parts]
        for ended in processes.run(jobs, lambda job: say(f"{job.name} {started}")):
            found[ended.job.name] = ended
            accuracy = ended.result.get("accuracy")
            if accuracy is None:
                text = f"{ended.job.name} broke off with exit code {ended.code}\n{ended.why}".rstrip()
            else:
                text = f"{ended.job.name} done: accuracy {accuracy:.4f}  {ended.result['run']}"
            for line in text.splitlines():
                say(line)
    except (KeyboardInterrupt, SystemExit):
        say(f"interrupted; runs that were going are saved: stlc runs list --runs {many.launch.root}")
        raise
    records = [_record(part, found[many.name(part)]) for part in many.parts]
    code = max(each.exit_code if each.exit_code >= 0 else ENDED for each in records)

    def show() -> None:
        several = len(many.specs) > 1
        rows: list[tuple[str, ...]] = []
        for spec, group in groupby(records, key=lambda record: record.spec):
            own = list(group)
            lines = [*map(_cells, own), *_mean(own)]
            rows += [(spec, *line) if several else line for line in lines]
        emit(table(rows, header=("specification", *HEADER) if several else HEADER, indent=""))

    return Answer(TrainedRuns(records), show, code)


def _record(part: Part, ended: JobResult) -> TrainedJob:
    facts = dict(ended.result)
    run = TrainedRun(facts.pop("run"), facts.pop("seconds")) if facts else None
    if run is None or not facts:
        return TrainedJob(str(part.spec), part.seed, ended.code, ended.why, run)
    return TrainedJob(
        str(part.spec), part.seed, ended.code, trained=replace(run, judged=JudgedTraining(**facts))
    )


def _cells(record: TrainedJob) -> tuple[str, ...]:
    from stlc.view.learning import best_drives

    seed = "" if record.seed is None else str(record.seed)
    run = record.trained
    if run is None or run.judged is None:
        return (seed, "", f"exit code {record.exit_code}")
    found, best = run.judged, best_drives({"closed_loop": run.judged.closed_loop})
    drives = "" if best is None else f"{best['satisfied']:,} of {best['drives']:,}, {best['guard']}"
    low, high = found.interval
    worst = min(found.requirements, key=found.requirements.__getitem__)
    return (
        *(seed, drives, f"{found.accuracy:.4f}", f"[{low:.4f}, {high:.4f}]"),
        *(f"{found.feasible:.4f}", f"{worst} {found.requirements[worst]:.4f}"),
        *(f"{run.seconds:.0f} s", run.run),
    )


def _mean(records: Sequence[TrainedJob]) -> list[tuple[str, ...]]:
    """Row with the means over the runs that succeeded, as a list; empty if fewer than two succeeded."""
    finished = [each.trained.judged for each in records if each.trained and each.trained.judged]
    if len(finished) < 2:
        return []
    from statistics import fmean

    accuracies = [found.accuracy for found in finished]
    spread = f"{min(accuracies):.4f} to {max(accuracies):.4f}"
    accuracy, feasible = fmean(accuracies), fmean(found.feasible for found in finished)
    return [("mean", "", f"{accuracy:.4f}", spread, f"{feasible:.4f}")]
