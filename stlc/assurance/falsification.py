"""Searches for violations by a system, a plant or a run; files of what is found, and its repetition."""

from __future__ import annotations

import math
import shlex
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from stlc.activity import PULSE
from stlc.assurance.falsified import (
    FalsifiedFinding,
    FalsifiedRequirement,
    FalsifiedSystem,
    ReplayedCounterexample,
    ReplayedFinding,
    StoredCounterexample,
    StoredFinding,
    StoredSettings,
)
from stlc.assurance.falsify import SearchBudget, SearchOrder, falsify_each
from stlc.assurance.options import FalsifyOptions
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import SpecError, usage
from stlc.escape import file_part
from stlc.files import File
from stlc.jsontext import data_of, dumps
from stlc.monitor.judgement import require_known
from stlc.options import Options
from stlc.plants.plant import PlantFinding
from stlc.records import read
from stlc.registry import GUARDS
from stlc.rundir import RunDir
from stlc.trace import Trace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.assurance.drive_simulator import DriveSimulator
    from stlc.assurance.falsify import Falsification
    from stlc.assurance.model_simulator import ModelSimulator
    from stlc.assurance.plant_simulator import FailedSimulation, PlantSimulator
    from stlc.assurance.sharing import SimulatorWorkers
    from stlc.controller.parallel.workers import CallFiles
    from stlc.controller.run.run import Run

    _Simulator: TypeAlias = ModelSimulator | DriveSimulator | PlantSimulator

MOST_WRITTEN = 10
"""Kinds of failures, by reason and message, that are written to files; the first of each kind."""


@Options.taking(FalsifyOptions)
def falsify(
    target: Run | Path | str, options: FalsifyOptions
) -> FalsifiedSystem | ReplayedCounterexample | ReplayedFinding:
    """Search for simulations that violate requirements, or repeat one.

    Of a system without controls, the search chooses initial states, parameters and input signals; of a run,
    the random numbers of the world in which its policy drives. A violation counts only if it remains at half
    the time step. If nothing is found, that is no proof.

    Args:
        target: a specification of a system without controls, or of a plant; or a run, or its folder, number
            or words, or `latest`.
        options: fields of `stlc.assurance.options.FalsifyOptions`; times are in seconds. With `replay`, the
            counterexample in that file is simulated again, and compared with its trace, bit for bit.

    Raises:
        UsageError: U101, an option does not suit the target, or all points are excluded by an assumption.
        StlcError: a file is invalid.
    """
    name = str(target if isinstance(target, str | Path) else target.dir.path)
    source = _Source(name, options)
    if options.plant is None and options.system is None and not source.model:
        source = replace(source, name=RunDir.open(name, options.runs).shown)  # `latest` may be another later
    if options.replay is not None:
        return _replayed(source, options.replay)
    File(options.out).require_folder()
    Options.require_no_jobs(options.cluster, options.jobs)
    simulator = source.load()
    names = simulator.requirements
    require_known(options.require, names)
    wanted = [index for index, name in enumerate(names) if not options.require or name in options.require]
    budget = SearchBudget(options.simulations, options.budget)
    order = SearchOrder(budget, options.seed, options.random, batch=options.batch)
    found: list[FalsifiedRequirement] = []
    with source.workers() as workers:
        results = falsify_each(simulator, wanted, order, workers)
        for index in wanted:
            with PULSE.doing(f"searching for a violation of {names[index]}"):
                result = next(results)
            found.append(_written(source, simulator, result))
    failed = [*getattr(simulator, "findings", ()), *(() if workers is None else workers.findings)]
    rejected = sum(each.search.rejected for each in found)
    if rejected and not failed and not any(each.search.simulations for each in found):
        raise usage(f"`assume` or `where` excludes all of {rejected:,} points", "weaken these conditions")
    return FalsifiedSystem(
        *(name, options.simulations, options.seed, simulator.space.dim),
        tuple(dict.fromkeys(f"{each.finding.reason}: {each.finding.message}" for each in failed)),
        tuple(_failures(failed, source)),
        tuple(found),
        *((0, ()) if workers is None else (workers.lost, tuple(workers.reasons))),
    )


@dataclass(frozen=True, slots=True)
class _Source:
    """Simulator of a target, for this process and others."""

    name: str
    options: FalsifyOptions

    @property
    def model(self) -> bool:
        """True if the target is a specification, rather than a run."""
        return File(self.name).is_spec

    def load(self) -> _Simulator:
        """Load the simulator; a black box simulates in as many processes as there are jobs.

        Raises:
            UsageError: U101, an option does not suit the target.
        """
        given = self.options
        if given.plant is not None:
            from stlc.assurance.plant_simulator import PlantSimulator

            if not self.model:
                raise usage("`--plant` needs a specification", "stlc falsify SPEC --plant FILE")
            for option in ("system", "agents", "steps", "scenario"):
                if getattr(given, option) is not None:
                    raise usage(f"`--{option}` and `--plant` contradict each other")
            return PlantSimulator.load(self.name, given.plant, given.overrides, given.jobs)
        if self.model:
            from stlc.assurance.model_simulator import ModelSimulator

            for option in ("agents", "steps", "scenario"):
                if getattr(given, option) is not None:
                    raise usage(f"`--{option}` is for a run", "stlc falsify RUN")
            return ModelSimulator.load(self.name, given.system, given.overrides)
        from stlc.assurance.drive_simulator import DriveSimulator
        from stlc.controller.deployment.batched import Setting
        from stlc.controller.run.run import Run

        if given.system is not None:
            advice = "stlc falsify SPEC --system FILE"
            raise usage("`--system` is for a specification: a run has its own", advice)
        run = Run.open(self.name, root=given.runs, overrides=given.overrides, scenario=given.scenario)
        test = run.task.system.decl.test
        size = given.agents or test.agents, given.steps or test.steps
        setting = Setting((given.seed,), *size, test.replan, limit=None)  # a limit of time cannot be replayed
        return DriveSimulator(run, GUARDS.get(given.guard).name, setting)

    def settings(self) -> StoredSettings:
        """Settings of the simulations that a replay needs."""
        given = self.options
        own = (given.guard, given.agents, given.steps, given.scenario, given.seed)
        return StoredSettings(*own, dict(given.overrides))

    def command(self, path: Path) -> str:
        """Command that replays a counterexample."""
        words = ["stlc", "falsify", self.name]
        for option, value in (("--plant", self.options.plant), ("--system", self.options.system)):
            words += [] if value is None else [option, str(value)]
        return shlex.join([*words, "--replay", str(path)])

    def workers(self) -> AbstractContextManager[SimulatorWorkers | None]:
        """Processes that simulate; None if this one does, or a black box, which has its own."""
        from stlc.assurance.sharing import SimulatorWorkers
        from stlc.controller.parallel import workers_of

        given = self.options
        if given.cluster is None and (given.jobs == 1 or given.plant is not None):
            return nullcontext()
        name = self.name if self.model else str(Path(self.name).resolve())  # elsewhere are other folders
        sent = _Source(name, replace(given, jobs=1, cluster=None))
        files = sent.files()
        calls = workers_of(given.jobs, given.cluster, fresh=True, files=files.inputs)
        return SimulatorWorkers(sent, calls, files)

    def files(self) -> CallFiles:
        """Files that the simulator reads, those of a black box among them."""
        from stlc.controller.parallel.workers import CallFiles
        from stlc.controller.problem.inputs import input_files

        given = self.options
        if not self.model:
            return CallFiles((Path(self.name),))
        plant: tuple[Path, ...] = ()
        if given.plant is not None:
            from stlc.plants.declaration import load_plant_decl

            named = (given.plant.parent / name for name in load_plant_decl(given.plant).files)
            plant = (given.plant, *(path for path in named if path.is_file()))
        return CallFiles((*input_files(Path(self.name), given.system, given.overrides), *plant))


def _written(source: _Source, simulator: _Simulator, result: Falsification) -> FalsifiedRequirement:
    """Write the counterexample of a requirement, if there is one, and return its record."""
    best = FalsifiedRequirement(result).counterexample
    if best is None:
        return FalsifiedRequirement(result)
    folder, name = source.options.out, result.requirement
    path = folder / f"{file_part(name, empty='requirement')}.json"
    margin, trace = best.margin, path.with_suffix(".npz")
    folder.mkdir(parents=True, exist_ok=True)
    if source.options.plant is None:
        simulator.trace(best.point[None]).save(trace)
    else:
        repeated = _plant_of(simulator, path).repeated(best.point, simulator.requirements.index(name))
        repeated.trace.save(trace)
        margin = repeated.margin
    stored = StoredCounterexample(name, margin, trace.name, source.settings(), best.point.tolist())
    File(path).write(dumps(stored) + "\n")
    return FalsifiedRequirement(result, str(path), source.command(path), margin)


def _failures(failures: Sequence[FailedSimulation], source: _Source) -> list[FalsifiedFinding]:
    """Write the first failed simulation of each kind to a file, and return the records."""
    kinds: dict[tuple[str, str], list[FailedSimulation]] = {}
    for each in failures:
        kinds.setdefault((each.finding.reason, each.finding.message), []).append(each)
    records: list[FalsifiedFinding] = []
    for index, alike in enumerate(list(kinds.values())[:MOST_WRITTEN]):
        finding = alike[0].finding
        part = file_part(finding.reason.replace(" ", "-"), empty="failure")
        path = source.options.out / f"finding-{index + 1}-{part}.json"
        stored = StoredFinding(
            *(finding.reason, finding.message, source.settings(), alike[0].point.tolist()),
            *(finding.time, finding.stderr, dict(finding.point)),
        )
        source.options.out.mkdir(parents=True, exist_ok=True)
        File(path).write(dumps(stored) + "\n")
        records.append(FalsifiedFinding(finding, len(alike), str(path), source.command(path)))
    return records


def _replayed(source: _Source, path: Path) -> ReplayedCounterexample | ReplayedFinding:
    """Simulate a stored counterexample again, and compare it with its trace, bit for bit."""
    stored = _stored(path)
    kept = stored.settings
    again = replace(
        source.options,
        guard=kept.guard,
        agents=kept.agents,
        steps=kept.steps,
        scenario=kept.scenario,
        seed=kept.seed,
        jobs=1,
        overrides={**kept.overrides, **source.options.overrides},
    )
    simulator = replace(source, options=again).load()
    point = np.array(stored.point, dtype=np.float64)
    if point.shape != (simulator.space.dim,) or not bool(((point >= 0.0) & (point <= 1.0)).all()):
        message = f"the counterexample `{path}` does not belong to this system"
        raise usage(message, "the system may have changed")
    if isinstance(stored, StoredFinding):
        return _failed_again(_plant_of(simulator, path), point, stored)
    require_known([stored.requirement], simulator.requirements)
    outcome = simulator.simulate(point[None], simulator.requirements.index(stored.requirement))
    margin, inside = float(outcome.margins[0]), bool(outcome.admissible[0])
    verdict: Any = "inconclusive"
    if not inside:
        verdict = "out of scope"
    elif TOLERANCE.violated(margin):
        verdict = "violated"
    elif outcome.judged[0]:
        verdict = "satisfied"
    if getattr(simulator, "findings", ()):
        before = StoredFinding(f"a violation of {stored.requirement}", "", kept, stored.point)
        return _failed_again(_plant_of(simulator, path), point, before)
    different = _different(Trace.load(path.parent / Path(stored.trace).name), simulator.trace(point[None]))
    return ReplayedCounterexample(
        stored.requirement, verdict, margin, stored.margin, not different, different
    )


def _failed_again(simulator: PlantSimulator, point: np.ndarray, stored: StoredFinding) -> ReplayedFinding:
    """Simulate a failed simulation again, at a point of the unit cube, (dim,)."""
    found = simulator.outcome(point)
    if not isinstance(found, PlantFinding):
        return ReplayedFinding(None, None, None, stored.reason, identical=False)
    same = (found.reason, found.message, found.time) == (stored.reason, stored.message, stored.time)
    return ReplayedFinding(
        found.reason, found.message, found.time, stored.reason, identical=same, stderr=found.stderr
    )


def _plant_of(simulator: _Simulator, path: Path) -> PlantSimulator:
    """The simulator of the plant whose failure the file `path` holds. Raises UsageError (U101) for others."""
    from stlc.assurance.plant_simulator import PlantSimulator

    if not isinstance(simulator, PlantSimulator):
        raise usage(
            f"`{path}` is a failed simulation of a plant", "stlc falsify SPEC --plant FILE --replay FILE"
        )
    return simulator


def _stored(path: Path) -> StoredCounterexample | StoredFinding:
    """Content of a counterexample's file.

    Raises:
        UsageError: U102, there is no such file; U101, it is not a counterexample.
    """
    try:
        found = data_of(File(path).read().text)
        kind = found.get("format") if isinstance(found, dict) else None
        stored: StoredCounterexample | StoredFinding
        stored = read(StoredFinding if kind == "stlc-finding/1" else StoredCounterexample, found)
        if isinstance(stored, StoredCounterexample) and (
            math.isnan(stored.margin)
            or Path(stored.trace).name != (stored.trace or None)
            or "\0" in stored.trace
        ):
            raise ValueError("`margin` or `trace` is not what stlc writes")
        if stored.settings.seed > Options.MOST_SEED:
            raise ValueError("`settings.seed` is too large")
    except (SpecError, ValueError, RecursionError) as error:
        help_, why = ("a file that `stlc falsify` wrote",), str(error)[:200]
        message = f"`{path}` is not a counterexample"
        raise usage(message, *help_, note=(why,)) from None
    return stored


def _different(stored: Trace, again: Trace) -> list[str]:
    """Names of the signals that differ between two traces in any bit, or that only one of them has."""
    return [
        name
        for name in dict.fromkeys((*again.data, *stored.data))
        if name not in stored.data
        or name not in again.data
        or not np.array_equal(stored.data[name], again.data[name], equal_nan=True)
    ]
