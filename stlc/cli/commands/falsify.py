"""`stlc falsify`: a search for simulations that violate requirements."""

from __future__ import annotations

import math
import shlex
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from stlc.activity import PULSE
from stlc.cli.certify.text import GuardOption
from stlc.cli.check.many import INCONCLUSIVE
from stlc.cli.falsify import findings
from stlc.cli.framework.options import (
    MOST_SEED,
    ClusterOption,
    JobsOption,
    PlantOption,
    RequireOption,
    RunsOption,
    SeedOption,
    SetOption,
    SystemOption,
    parse_overrides,
    parse_seconds,
    require_no_jobs,
)
from stlc.cli.framework.output import Answer, emit, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, MissingError, SpecError, UsageError, usage
from stlc.files import read_source
from stlc.registry import GUARDS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from stlc.assurance.drive_simulator import DriveSimulator
    from stlc.assurance.falsified import (
        FalsifiedRequirement,
        FalsifiedSystem,
        ReplayedCounterexample,
        ReplayedFinding,
        StoredCounterexample,
        StoredFinding,
        StoredSettings,
    )
    from stlc.assurance.falsify import Falsification
    from stlc.assurance.model_simulator import ModelSimulator
    from stlc.assurance.plant_simulator import PlantSimulator
    from stlc.assurance.sharing import SimulatorWorkers
    from stlc.controller.parallel.workers import CallFiles
    from stlc.trace import Trace

    _Simulator: TypeAlias = ModelSimulator | DriveSimulator | PlantSimulator

RUNS = Path("runs")
"""Folder of runs, unless another one is given."""


@command(
    "stlc falsify specs/arch/transmission.stl --require AT1",
    "stlc falsify latest --guard paper --simulations 2000",
    "stlc falsify specs/arch/transmission.stl --replay counterexamples/AT1.json",
    drives=True,
)
def falsify(
    target: Annotated[
        str,
        typer.Argument(metavar="SPEC|RUN", help="A specification of a system without controls, or a run."),
    ] = "latest",
    system: SystemOption = None,
    plant: PlantOption = None,
    require: RequireOption = None,
    simulations: Annotated[
        int, typer.Option(min=1, metavar="N", help="Simulations per requirement at most.")
    ] = 300,
    budget: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Time per requirement at most.", show_default="no limit"),
    ] = None,
    seed: SeedOption = 0,
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    batch: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Points that a search proposes at a time.",
            show_default="number of processes",
        ),
    ] = None,
    random: Annotated[
        bool, typer.Option("--random", help="Draw from the declared distributions only, as a baseline.")
    ] = False,
    guard: GuardOption = GUARDS.default,
    agents: Annotated[int | None, typer.Option(min=1, help="Agents in each world of a run.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each drive of a run.")] = None,
    scenario: Annotated[str | None, typer.Option(metavar="NAME", help="Scenario of a run.")] = None,
    output: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the counterexamples.")
    ] = Path("counterexamples"),
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Simulate this counterexample again, and compare.")
    ] = None,
    set_: SetOption = None,
    runs: RunsOption = RUNS,
) -> Answer[FalsifiedSystem | ReplayedCounterexample | ReplayedFinding]:
    """Search for simulations that violate requirements.

    Of a system without controls, the search chooses initial states, parameters and input signals; of a run,
    the random numbers of the world in which its policy drives. Inputs that alternate between the ends of
    their ranges, or stay there, come first. Then models of the robustness choose most of the points, and
    random ones, gradients and periodic inputs take turns; the numbers of a world are changed where this has
    an effect. A violation counts only if it remains at half the time step. It is written as a trace,
    simplified as far as it still violates the requirement, with a file for --replay. If nothing is found,
    that is no proof. The same --seed and --batch give the same simulations, whatever processes there are. Of
    a plant, simulations that fail are written, too. A simulation that ends before a requirement can be judged
    is no evidence. Exit code: 1 if a requirement is violated or a simulation fails; else 5 if simulations
    were lost with their processes, three times each; else 4 if simulations ended before a verdict; else 0.
    """
    from stlc.assurance.falsified import FalsifiedSystem
    from stlc.assurance.falsify import SearchBudget, SearchOrder, falsify_each
    from stlc.files import require_folder
    from stlc.monitor.judgement import require_known
    from stlc.rundir import RunDir

    made = _Target(target, system, plant, guard, agents, steps, scenario, seed)
    if plant is None and system is None and not made.model:  # `latest` may be another run later
        made = replace(made, name=RunDir.open(target, runs).shown)
    overrides = parse_overrides(set_)
    if replay is not None:
        return _replayed(made, replay, overrides, runs)
    require_folder(output)
    limit = None if budget is None else parse_seconds(budget)
    require_no_jobs(cluster, jobs)
    source = _Source(made, overrides, runs, jobs, cluster)
    simulator = source.load()
    names = simulator.requirements
    require_known(require or (), names)
    wanted = [index for index, name in enumerate(names) if not require or name in require]
    order = SearchOrder(SearchBudget(simulations, limit), seed, random, batch=batch)
    found: list[FalsifiedRequirement] = []
    with source.workers() as workers:
        results = falsify_each(simulator, wanted, order, workers)
        for index in wanted:
            with PULSE.doing(f"searching for a violation of {simulator.requirements[index]}"):
                result = next(results)
            found.append(_written(source, simulator, result, output))
    failed = [*getattr(simulator, "findings", ()), *(() if workers is None else workers.findings)]
    _require_simulations(found, failures=len(failed))
    document = FalsifiedSystem(
        *(target, simulations, seed, simulator.space.dim),
        tuple(dict.fromkeys(f"{each.finding.reason}: {each.finding.message}" for each in failed)),
        tuple(findings.written(failed, output, source.settings(), partial(_command, source))),
        tuple(found),
        0 if workers is None else workers.lost,
    )
    lost = () if workers is None or not workers.lost else (_lost(workers),)
    code = INCONCLUSIVE if any(each.search.inconclusive for each in found) else 0
    code = MissingError.exit_code if lost else code
    if document.failures or document.violated:
        code = 1

    def show() -> None:
        show_diagnostics(lost)
        emit("\n".join(_lines(document)))

    return Answer(document, show, code, lost)


@dataclass(frozen=True, slots=True)
class _Target:
    """Subject of the simulations, as given on the command line."""

    name: str
    system: str | None
    plant: Path | None
    guard: str
    agents: int | None
    steps: int | None
    scenario: str | None
    seed: int

    @property
    def model(self) -> bool:
        """True if the target is a specification, rather than a run."""
        return self.name.endswith((".stl", ".stlc"))

    def simulator(self, overrides: Mapping[str, str], runs: Path, jobs: int = 1) -> _Simulator:
        """Load the simulator; a black box simulates in `jobs` processes.

        Raises:
            UsageError: U101, an option does not suit the target.
        """
        if self.plant is not None:
            return self._black_box(self.plant, overrides, jobs)
        if self.model:
            from stlc.assurance.model_simulator import ModelSimulator

            for option, value in {
                "agents": self.agents,
                "steps": self.steps,
                "scenario": self.scenario,
            }.items():
                if value is not None:
                    raise usage(f"`--{option}` is for a run", "stlc falsify RUN")
            return ModelSimulator.load(self.name, self.system, overrides)
        from stlc.assurance.drive_simulator import DriveSimulator
        from stlc.controller.deployment.batched import Setting
        from stlc.controller.run.run import Run

        if self.system is not None:
            raise usage(
                "`--system` is for a specification: a run has its own", "stlc falsify SPEC --system FILE"
            )
        run = Run.open(self.name, root=runs, overrides=overrides, scenario=self.scenario)
        test = run.task.system.decl.test
        size = self.agents or test.agents, self.steps or test.steps
        setting = Setting((self.seed,), *size, test.replan, limit=None)  # a limit of time cannot be replayed
        return DriveSimulator(run, GUARDS.get(self.guard).name, setting)

    def _black_box(self, plant: Path, overrides: Mapping[str, str], jobs: int) -> PlantSimulator:
        from stlc.assurance.plant_simulator import PlantSimulator

        if not self.model:
            raise usage("`--plant` needs a specification", "stlc falsify SPEC --plant FILE")
        for option in ("system", "agents", "steps", "scenario"):
            if getattr(self, option) is not None:
                raise usage(f"`--{option}` and `--plant` contradict each other")
        return PlantSimulator.load(self.name, plant, overrides, jobs)


@dataclass(frozen=True, slots=True)
class _Source:
    """Simulator of a target, for this process and others.

    Attributes:
        target: the target.
        overrides: values of `--set`.
        runs: folder of runs.
        jobs: number of processes of this machine.
        cluster: address of a Ray cluster; None without one.
    """

    target: _Target
    overrides: Mapping[str, str]
    runs: Path
    jobs: int = 1
    cluster: str | None = None

    def settings(self) -> StoredSettings:
        """Settings of the simulations that a replay needs."""
        from stlc.assurance.falsified import StoredSettings

        target = self.target
        given = (target.guard, target.agents, target.steps, target.scenario, target.seed)
        return StoredSettings(*given, dict(self.overrides))

    def load(self) -> _Simulator:
        """Load the simulator."""
        return self.target.simulator(self.overrides, self.runs, self.jobs)

    def workers(self) -> AbstractContextManager[SimulatorWorkers | None]:
        """Processes that simulate; None if this one does, or a black box, which has its own."""
        from stlc.assurance.sharing import SimulatorWorkers
        from stlc.controller.parallel import workers_of

        if self.cluster is None and (self.jobs == 1 or self.target.plant is not None):
            return nullcontext()
        target = self.target
        if not target.model:  # processes elsewhere have other folders
            target = replace(target, name=str(Path(target.name).resolve()))
        sent = replace(self, target=target, jobs=1, cluster=None)
        files = sent.files()
        calls = workers_of(self.jobs, self.cluster, fresh=True, files=files.inputs)
        return SimulatorWorkers(sent, calls, files)

    def files(self) -> CallFiles:
        """Files that the simulator reads, those of a black box among them."""
        from stlc.controller.parallel.inputs import input_files
        from stlc.controller.parallel.workers import CallFiles

        target = self.target
        if not target.model:
            return CallFiles((Path(target.name),))
        plant: tuple[Path, ...] = ()
        if target.plant is not None:
            from stlc.plants.declaration import load_plant_decl

            named = (target.plant.parent / name for name in load_plant_decl(target.plant).files)
            plant = (target.plant, *(path for path in named if path.is_file()))
        return CallFiles((*input_files(Path(target.name), target.system, self.overrides), *plant))


def _lost(workers: SimulatorWorkers) -> Diagnostic:
    """The finding R406 about simulations that were lost with their workers."""
    count = f"{workers.lost:,} simulation{'s were' if workers.lost != 1 else ' was'}"
    message = f"{count} lost with the processes that made them"
    return Diagnostic("R406", message, note=tuple(workers.reasons))


# ------------------------------------------------------------------------ counterexamples


def _require_simulations(found: Sequence[FalsifiedRequirement], *, failures: int) -> None:
    """Check that something was simulated.

    Raises:
        UsageError: U101, the conditions of the specification hold in no simulation.
    """
    rejected = sum(each.search.rejected for each in found)
    if rejected and not failures and not any(each.search.simulations for each in found):
        raise usage(f"`assume` or `where` excludes all of {rejected:,} points", "weaken these conditions")


def _written(
    source: _Source, simulator: _Simulator, result: Falsification, folder: Path
) -> FalsifiedRequirement:
    """Write the counterexample of a requirement, if there is one, and return its record."""
    from stlc.assurance.falsified import FalsifiedRequirement, StoredCounterexample
    from stlc.escape import file_part
    from stlc.files import write_atomic
    from stlc.jsontext import dumps
    from stlc.trace import save_trace

    best = FalsifiedRequirement(result).counterexample
    if best is None:
        return FalsifiedRequirement(result)
    path, name = folder / f"{file_part(result.requirement, empty='requirement')}.json", result.requirement
    margin, trace = best.margin, path.with_suffix(".npz")
    folder.mkdir(parents=True, exist_ok=True)
    if source.target.plant is None:
        save_trace(trace, simulator.trace(best.point[None]))
    else:
        repeated = _plant_of(simulator, path).repeated(best.point, simulator.requirements.index(name))
        save_trace(trace, repeated.trace)
        margin = repeated.margin
    stored = StoredCounterexample(name, margin, trace.name, source.settings(), best.point.tolist())
    write_atomic(path, dumps(stored) + "\n")
    return FalsifiedRequirement(result, str(path), _command(source, path), margin)


def _command(source: _Source, path: Path) -> str:
    """Command that replays a counterexample."""
    target = source.target
    words = ["stlc", "falsify", target.name]
    if target.plant is not None:
        words += ["--plant", str(target.plant)]
    if target.system is not None:
        words += ["--system", target.system]
    return shlex.join([*words, "--replay", str(path)])


def _replayed(
    target: _Target, path: Path, overrides: Mapping[str, str], runs: Path
) -> Answer[FalsifiedSystem | ReplayedCounterexample | ReplayedFinding]:
    """Simulate a stored counterexample again, and compare it with its trace, bit for bit."""
    from stlc.assurance.falsified import ReplayedCounterexample, StoredFinding
    from stlc.compile.semantics.tolerance import status_of, violated
    from stlc.monitor.judgement import require_known
    from stlc.trace import load_trace

    stored = _stored(path)
    given = stored.settings
    again = _Target(
        *(target.name, target.system, target.plant, given.guard, given.agents, given.steps),
        *(given.scenario, given.seed),
    )
    simulator = again.simulator({**given.overrides, **overrides}, runs)
    point = _point(stored.point, simulator.space.dim, path)
    if isinstance(stored, StoredFinding):
        return findings.replayed(_plant_of(simulator, path), point, stored)
    require_known([stored.requirement], simulator.requirements)
    index = simulator.requirements.index(stored.requirement)
    outcome = simulator.simulate(point[None], index)
    margin, inside = float(outcome.margins[0]), bool(outcome.admissible[0])
    broken, judged = inside and violated(margin), not inside or bool(outcome.judged[0])
    verdict: Any = status_of(broken, judged)
    if getattr(simulator, "findings", ()):
        before = StoredFinding(f"a violation of {stored.requirement}", "", given, stored.point)
        return findings.replayed(_plant_of(simulator, path), point, before)
    different = _different(load_trace(path.parent / Path(stored.trace).name), simulator.trace(point[None]))
    said: Any = verdict if inside else "out of scope"
    document = ReplayedCounterexample(
        stored.requirement, said, margin, stored.margin, not different, different
    )

    def show() -> None:
        shown = said if inside else f"{said} (`assume` or `where` excludes it)"
        same = "the trace is the same, bit for bit" if not different else f"different: {', '.join(different)}"
        emit(f"{stored.requirement}: {shown}, robustness {margin:.6g}; {same}")

    return Answer(document, show, int(broken) if judged else INCONCLUSIVE)


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
    from stlc.assurance.falsified import StoredCounterexample, StoredFinding
    from stlc.jsontext import data_of
    from stlc.records import read

    try:
        found = data_of(read_source(path).text)
        kind = found.get("format") if isinstance(found, dict) else None
        stored: StoredCounterexample | StoredFinding
        stored = read(StoredFinding if kind == findings.FORMAT else StoredCounterexample, found)
        if isinstance(stored, StoredCounterexample) and (
            math.isnan(stored.margin)
            or Path(stored.trace).name != (stored.trace or None)
            or "\0" in stored.trace
        ):
            raise ValueError("`margin` or `trace` is not what stlc writes")
        if stored.settings.seed > MOST_SEED:
            raise ValueError("`settings.seed` is too large")
    except (SpecError, ValueError, RecursionError) as error:
        help_, why = ("a file that `stlc falsify` wrote",), str(error)[:200]
        message = f"`{path}` is not a counterexample"
        raise UsageError(Diagnostic("U101", message, help=help_, note=(why,))) from None
    return stored


def _point(values: Sequence[float], dim: int, path: Path) -> np.ndarray:
    """The point of a stored counterexample, (dim,). Raises UsageError (U101) if it is not of this system."""
    import numpy as np

    point = np.array(values, dtype=np.float64)
    if point.shape != (dim,) or not bool(((point >= 0.0) & (point <= 1.0)).all()):
        raise usage(
            f"the counterexample `{path}` does not belong to this system", "the system may have changed"
        )
    return point


def _different(stored: Trace, again: Trace) -> list[str]:
    """Names of the signals that differ between two traces in any bit, or that only one of them has."""
    import numpy as np

    return [
        name
        for name in dict.fromkeys((*again.data, *stored.data))
        if name not in stored.data
        or name not in again.data
        or not np.array_equal(stored.data[name], again.data[name], equal_nan=True)
    ]


# ------------------------------------------------------------------------------ text


def _lines(document: FalsifiedSystem) -> list[str]:
    lines = []
    for each in document.requirements:
        lines.extend(_of_requirement(each, failed=bool(document.failures)))
    return [*lines, *findings.lines(document.findings)]


def _of_requirement(each: FalsifiedRequirement, *, failed: bool) -> list[str]:
    """Lines about a requirement; `failed`: whether there are simulations without a trace."""
    from stlc.view.words import share

    search = each.search
    name, found, lost = search.requirement, search.found, len(search.spurious)
    spurious = f"; {lost} violations vanish at half the time step" if lost else ""
    if found is None:
        judged, least = search.simulations - search.inconclusive, search.least
        ended = "failed, or ended before a verdict" if failed else "ended before a verdict"
        told = [f"  {search.inconclusive:,} simulations {ended}: no evidence"] if search.inconclusive else []
        if not judged:
            return [f"{name}: inconclusive{spurious}", *told]
        return [
            f"{name}: no violation in {judged:,} simulations, least robustness {least:.4g}{spurious}",
            f"  pairwise coverage of the search space {share(search.coverage)}; this is no proof",
            *told,
        ]
    half = "" if found.half_step is None else f", {found.half_step:.4g} at half the time step"
    half = half.replace("nan at", "but no verdict at")
    lines = [
        f"{name}: violated, robustness {found.margin:.4g}{half}; simulation "
        f"{found.simulation:,}, {found.strategy}{spurious}"
    ]
    simpler = search.shrunk
    if simpler is not None and simpler.margin != found.margin:
        lines.append(f"  simpler: robustness {simpler.margin:.4g}")
    kept = each.trace_margin
    if kept is not None and kept != (simpler or found).margin:
        lines += [
            f"  the plant does not repeat itself: simulated again for the trace, {kept:.4g}",
            "  (`limit: {fresh: true}` starts a process per simulation; seed random numbers in `reset`)",
        ]
    return [*lines, f"  {each.replay}"]
