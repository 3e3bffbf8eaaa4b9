"""`stlc falsify`: a search for simulations that violate requirements."""

from __future__ import annotations

import json as json_text
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from stlc.cli.framework.assured import FalsifiedRequirement, FalsifiedSystem, ReplayedCounterexample
from stlc.cli.framework.options import (
    RequireOption,
    RunsOption,
    SetOption,
    SystemOption,
    parse_overrides,
    parse_seconds,
)
from stlc.cli.framework.output import PULSE, Answer, emit
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, UsageError, usage
from stlc.escape import visible
from stlc.registry import closest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from stlc.assurance.drive_simulator import DriveSimulator
    from stlc.assurance.falsify import Counterexample, Falsification
    from stlc.assurance.model_simulator import ModelSimulator
    from stlc.assurance.plant_simulator import PlantSimulator
    from stlc.controller.guard.candidates import Mode
    from stlc.trace import Trace

    _Simulator: TypeAlias = ModelSimulator | DriveSimulator | PlantSimulator

FORMAT = "stlc-counterexample/1"
GUARDS: tuple[Mode, ...] = ("none", "paper", "full")


@command(
    "stlc falsify specs/arch/transmission.stl --require AT1",
    "stlc falsify latest --guard paper --simulations 2000",
    "stlc falsify specs/arch/transmission.stl --replay counterexamples/AT1.json",
)
def falsify(
    target: Annotated[
        str,
        typer.Argument(metavar="SPEC|RUN", help="A specification of a system without controls, or a run."),
    ] = "latest",
    system: SystemOption = None,
    plant: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A black box instead of a system (docs/plants.md).")
    ] = None,
    require: RequireOption = None,
    simulations: Annotated[
        int, typer.Option(min=1, metavar="N", help="Simulations per requirement at most.")
    ] = 300,
    time: Annotated[
        str | None, typer.Option("--time", metavar="TIME", help="Time per requirement at most.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    random: Annotated[
        bool, typer.Option("--random", help="Draw from the declared distributions only, as a baseline.")
    ] = False,
    guard: Annotated[str, typer.Option(metavar="none|paper|full", help="Guard of a run's policy.")] = "none",
    agents: Annotated[int | None, typer.Option(min=1, help="Agents in each world of a run.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each drive of a run.")] = None,
    scenario: Annotated[str | None, typer.Option(metavar="NAME", help="Scenario of a run.")] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the counterexamples.")
    ] = Path("counterexamples"),
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Simulate this counterexample again, and compare.")
    ] = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
) -> Answer[FalsifiedSystem | ReplayedCounterexample]:
    """Search for simulations that violate requirements.

    Of a system without controls, the search chooses initial states, parameters and input signals; of a run,
    the random numbers of the world in which its policy drives. Inputs that are constant at the ends of their
    ranges come first. Then random vertices, hill climbing, CMA-ES (if the package `cma` is installed) and
    periodic inputs take turns; the numbers of a world are changed where this has an effect. A violation
    counts only if it remains at half the time step. It is written as a trace, in a simpler form where one
    violates the requirement too, with a file for --replay. If nothing is found, that is no proof. Exit code:
    1 if a requirement is violated, else 0.
    """
    from stlc.assurance.falsify import SearchBudget
    from stlc.assurance.falsify import falsify as search

    made = _Target(target, system, plant, guard, agents, steps, scenario, seed)
    if replay is not None:
        return _replayed(made, replay, parse_overrides(set_), runs)
    limit = None if time is None else parse_seconds(time)
    simulator = made.simulator(parse_overrides(set_), runs)
    found: list[FalsifiedRequirement] = []
    for index in _wanted(simulator.requirements, require):
        name = simulator.requirements[index]
        with PULSE.doing(f"searching for a violation of {name}"):
            result = search(
                simulator, index, budget=SearchBudget(simulations, limit), seed=seed, random=random
            )
        found.append(_written(made, simulator, result, output))
    document: FalsifiedSystem = {
        "target": target,
        "simulations": simulations,
        "seed": seed,
        "coordinates": simulator.space.dim,
        "failures": _failures(simulator),
        "requirements": found,
    }
    violated = any(each["verdict"] == "violated" for each in found) or bool(document["failures"])
    return Answer(document, lambda: emit("\n".join(_lines(document))), int(violated))


@dataclass(frozen=True, slots=True)
class _Target:
    """What is simulated, as given on the command line."""

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
        """Whether the target is a specification, rather than a run."""
        return self.name.endswith((".stl", ".stlc"))

    def simulator(self, overrides: Mapping[str, str], runs: Path) -> _Simulator:
        """Load the simulator.

        Raises:
            UsageError: U101, an option does not suit the target.
        """
        if self.plant is not None:
            return self._black_box(self.plant, overrides)
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
        from stlc.controller.training.run import Run

        if self.system is not None:
            raise usage(
                "`--system` is for a specification: a run has its own", "stlc falsify SPEC --system FILE"
            )
        run = Run.open(self.name, root=runs, overrides=overrides, scenario=self.scenario)
        test = run.task.system.decl.test
        size = self.agents or test.agents, self.steps or test.steps
        setting = Setting((self.seed,), *size, test.replan, limit=None)  # a limit of time cannot be replayed
        return DriveSimulator(run, _mode(self.guard), setting)

    def _black_box(self, plant: Path, overrides: Mapping[str, str]) -> PlantSimulator:
        from stlc.assurance.plant_simulator import PlantSimulator

        if not self.model:
            raise usage("`--plant` needs a specification", "stlc falsify SPEC --plant FILE")
        for option in ("system", "agents", "steps", "scenario"):
            if getattr(self, option) is not None:
                raise usage(f"`--{option}` and `--plant` contradict each other")
        return PlantSimulator.load(self.name, plant, overrides)

    def settings(self) -> dict[str, Any]:
        """Settings of the simulations that a replay needs."""
        return {
            "guard": self.guard,
            "agents": self.agents,
            "steps": self.steps,
            "scenario": self.scenario,
            "seed": self.seed,
        }


def _mode(name: str) -> Mode:
    """Guard called `name`. Raises UsageError (U101) if there is none."""
    for mode in GUARDS:
        if mode == name:
            return mode
    raise usage(f"there is no guard `{name}`", "--guard none, paper or full")


def _wanted(names: Sequence[str], require: list[str] | None) -> list[int]:
    """Indices of the requirements to search.

    Raises:
        UsageError: U101, there is no such requirement.
    """
    for each in require or ():
        if each not in names:
            near = closest(each, names)
            advice = f"did you mean `{near}`?" if near else f"requirements: {', '.join(names)}"
            raise usage(f"there is no requirement `{each}`", advice)
    return [index for index, name in enumerate(names) if not require or name in require]


def _failures(simulator: _Simulator) -> list[str]:
    """Reasons of the failed simulations of a black box, each once."""
    found = getattr(simulator, "findings", ())
    return list(dict.fromkeys(f"{each.reason}: {each.message}" for each in found))


# ------------------------------------------------------------------------ counterexamples


def _written(
    target: _Target, simulator: _Simulator, result: Falsification, folder: Path
) -> FalsifiedRequirement:
    """Write the counterexample of a requirement, if there is one, and return its record."""
    from stlc.escape import file_part
    from stlc.files import write_atomic
    from stlc.jsontext import dumps
    from stlc.trace import save_trace

    best = result.shrunk or result.found
    path = folder / f"{file_part(result.requirement, empty='requirement')}.json"
    if best is not None:
        folder.mkdir(parents=True, exist_ok=True)
        trace = path.with_suffix(".npz")
        save_trace(trace, simulator.trace(best.point[None]))
        stored = {
            "format": FORMAT,
            "requirement": result.requirement,
            "margin": best.margin,
            "trace": trace.name,
            "settings": target.settings(),
            "point": best.point.tolist(),
        }
        write_atomic(path, dumps(stored) + "\n")
    return {
        "name": result.requirement,
        "verdict": "open" if best is None else "violated",
        "simulations": result.simulations,
        "least": result.least,
        "found": None if result.found is None else _violation(result.found),
        "simpler": None if result.shrunk is None else _violation(result.shrunk),
        "spurious": [_violation(each) for each in result.spurious],
        "coverage": result.coverage,
        "rejected": result.rejected,
        "seconds": result.seconds,
        "strategies": result.strategies,
        "file": None if best is None else str(path),
        "replay": None if best is None else _command(target, path),
    }


def _violation(found: Counterexample) -> Any:
    return {
        "margin": found.margin,
        "half_step": found.half_step,
        "strategy": found.strategy,
        "simulation": found.simulation,
    }


def _command(target: _Target, path: Path) -> str:
    """Command that replays a counterexample."""
    words = ["stlc", "falsify", target.name]
    if target.plant is not None:
        words += ["--plant", str(target.plant)]
    if target.system is not None:
        words += ["--system", target.system]
    return shlex.join([*words, "--replay", str(path)])


def _replayed(
    target: _Target, path: Path, overrides: Mapping[str, str], runs: Path
) -> Answer[FalsifiedSystem | ReplayedCounterexample]:
    """Simulate a stored counterexample again, and compare it with its trace, bit for bit."""
    from stlc.trace import load_trace

    stored = _stored(path)
    given = stored["settings"]
    again = _Target(
        *(target.name, target.system, target.plant, str(given.get("guard", "none"))),
        *(_optional(given.get("agents")), _optional(given.get("steps"))),
        None if given.get("scenario") is None else str(given["scenario"]),
        _optional(given.get("seed")) or 0,
    )
    simulator = again.simulator(overrides, runs)
    index = _wanted(simulator.requirements, [stored["requirement"]])[0]
    point = _point(stored, simulator.space.dim, path)
    margin = float(simulator.simulate(point[None]).margins[0, index])
    different = _different(
        load_trace(path.parent / Path(str(stored["trace"])).name), simulator.trace(point[None])
    )
    document: ReplayedCounterexample = {
        "requirement": stored["requirement"],
        "margin": margin,
        "stored_margin": float(stored["margin"]),
        "identical": not different,
        "different": different,
    }

    def show() -> None:
        verdict = "violated" if margin < 0.0 else "satisfied"
        same = "the trace is the same, bit for bit" if not different else f"different: {', '.join(different)}"
        emit(f"{document['requirement']}: {verdict}, robustness {margin:.6g}; {same}")

    return Answer(document, show, int(margin < 0.0))


def _optional(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None


def _stored(path: Path) -> dict[str, Any]:
    """Content of a counterexample's file.

    Raises:
        UsageError: U102, there is no such file; U101, it is not a counterexample.
    """
    try:
        found = json_text.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise UsageError(Diagnostic("U102", f"there is no file `{path}`")) from None
    except ValueError:
        found = None
    keys: dict[str, Any] = {
        "requirement": str,
        "margin": (int, float),
        "trace": str,
        "settings": dict,
        "point": list,
    }
    whole = isinstance(found, dict) and found.get("format") == FORMAT
    if not whole or not all(isinstance(found.get(key), kind) for key, kind in keys.items()):
        raise usage(f"`{path}` is not a counterexample", "a file that `stlc falsify` wrote")
    return dict(found)


def _point(stored: Mapping[str, Any], dim: int, path: Path) -> np.ndarray:
    """The point of a stored counterexample, (dim,).

    Raises:
        UsageError: U101, it does not belong to this system.
    """
    import numpy as np

    try:
        point = np.array(stored["point"], dtype=np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    inside = point.shape == (dim,) and bool(((point >= 0.0) & (point <= 1.0)).all())
    if not inside:
        raise usage(
            f"the counterexample `{path}` does not belong to this system", "the system may have changed"
        )
    return point


def _different(stored: Trace, again: Trace) -> list[str]:
    """Names of the signals that differ between two traces in any bit."""
    import numpy as np

    return [
        name
        for name, values in again.data.items()
        if name not in stored.data or not np.array_equal(stored.data[name], values, equal_nan=True)
    ]


# ------------------------------------------------------------------------------ text


def _lines(document: FalsifiedSystem) -> list[str]:
    lines = []
    for each in document["requirements"]:
        lines.extend(_of_requirement(each))
    return [*lines, *(f"the plant failed: {visible(each)}" for each in document["failures"])]


def _of_requirement(each: FalsifiedRequirement) -> list[str]:
    from stlc.view.words import share

    name, found = each["name"], each["found"]
    lost = len(each["spurious"])
    spurious = f"; {lost} violations vanish at half the time step" if lost else ""
    if found is None:
        return [
            f"{name}: no violation in {each['simulations']:,} simulations, least robustness "
            f"{float(each['least']):.4g}{spurious}",
            f"  pairwise coverage of the search space {share(each['coverage'])}; this is no proof",
        ]
    half = "" if found["half_step"] is None else f", {float(found['half_step']):.4g} at half the time step"
    lines = [
        f"{name}: violated, robustness {float(found['margin']):.4g}{half}; simulation "
        f"{found['simulation']:,}, {found['strategy']}{spurious}"
    ]
    simpler = each["simpler"]
    if simpler is not None and simpler["margin"] != found["margin"]:
        lines.append(f"  simpler: robustness {float(simpler['margin']):.4g}")
    return [*lines, f"  {each['replay']}"]
