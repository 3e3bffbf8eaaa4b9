"""Simulations of a black box, judged by a specification: the option `--plant` of `stlc simulate`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.cli.check.outcome import WORDS
from stlc.cli.check.text import in_unit, robustness_text
from stlc.cli.framework.options import parse_seeds
from stlc.cli.framework.output import PULSE, Answer, emit, say, show_diagnostics, table
from stlc.cli.framework.plant_documents import (
    PlantFailure,
    PlantRequirement,
    PlantRunRecord,
    PlantSimulation,
)
from stlc.diagnostics import usage
from stlc.escape import operand, shell, visible
from stlc.registry import did_you_mean
from stlc.units import parse_unit

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.monitor.judgement import Status
    from stlc.monitor.verdict import Monitor
    from stlc.plants.plant import Plant, PlantFinding, PlantRun, PlantVariable
    from stlc.trace import Trace

STREAMED = 1_000_000
"""Steps from which simulations are judged while they run, in constant memory."""
MOST_SHOWN = 5
"""Findings that are printed in full."""
_VALUE = re.compile(r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)\s*(?P<unit>\D.*)?")


@dataclass(frozen=True, slots=True)
class PlantOrder:
    """Options of `stlc simulate --plant`.

    Attributes:
        spec: the specification.
        plant: the plant file.
        point: values of variables, as text; None if all are drawn.
        seeds: seeds of the simulations, as text.
        record: file for the traces.
        jobs: number of processes.
        stream: whether simulations are judged while they run.
        overrides: constants of the specification with new values.
        fail_under: least share of satisfying simulations for exit code 0.
    """

    spec: str
    plant: Path
    point: str | None
    seeds: str
    record: Path | None
    jobs: int
    stream: bool
    overrides: Mapping[str, str]
    fail_under: float | None


@dataclass(frozen=True, slots=True)
class RequirementResult:
    """Result of one requirement on one simulation.

    Attributes:
        rule: the requirement.
        status: its verdict.
        low: least robustness over all continuations.
        high: greatest robustness over all continuations.
        robustness: the robustness; NaN if it is not known.
    """

    rule: CompiledRequirement
    status: Status
    low: float
    high: float
    robustness: float

    @property
    def share(self) -> float:
        """Robustness in units of the requirement's scale, by which requirements are compared."""
        return self.low * self.rule.weight / self.rule.scale


@dataclass(frozen=True, slots=True)
class JudgedRun:
    """One judged simulation.

    Attributes:
        seed: seed of the simulation.
        point: value of each variable.
        samples: number of samples; 0 for a finding.
        status: verdict over all requirements; None for a finding.
        requirements: results of the requirements.
        finding: why there is no trace, or None.
    """

    seed: int
    point: Mapping[str, float]
    samples: int
    status: Status | None
    requirements: tuple[RequirementResult, ...] = ()
    finding: PlantFinding | None = None


def simulate_plant(order: PlantOrder) -> Answer[PlantSimulation]:
    """Simulate a plant at one point or at random ones, and judge each trace.

    Raises:
        StlcError: the plant file, the specification or an option is invalid, or the two files do not fit
            together.
    """
    from stlc.files import find_spec, read_source
    from stlc.grammar.parse.parser import parse
    from stlc.monitor.verdict import Monitor
    from stlc.plants.plant import load_plant
    from stlc.trace import check_writable

    if order.record is not None:
        check_writable(order.record)
    with load_plant(order.plant) as plant:
        monitor = Monitor(
            parse(read_source(find_spec(order.spec))), dt=plant.decl.dt, overrides=order.overrides
        )
        show_diagnostics(monitor.compiled.warnings)
        _require_signals(monitor, plant)
        points, seeds = _points(plant, order)
        stream = order.stream or plant.decl.steps >= STREAMED
        if stream and order.record is not None:
            raise usage("`--record` needs whole traces, and long simulations are judged while they run")
        runner = _streamed if stream else _simulated
        with PULSE.doing(f"simulating {plant.decl.name}"):
            traces: list[Trace] = []
            runs = list(runner(plant, monitor, points, seeds, order, traces))
    if order.record is not None and traces:
        _save(order.record, traces, monitor)
    document = _document(plant, monitor, runs, order, stream=stream)
    return Answer(document, lambda: _show(plant, monitor, runs, order), _code(runs, order.fail_under))


def _require_signals(monitor: Monitor, plant: Plant) -> None:
    """Check, before any simulation, that the traces have the signals that the requirements read.

    Raises TraceError (E601, E605).
    """
    from stlc.monitor.signals import arrange, needs_of
    from stlc.trace import Trace

    compiled, signature = monitor.compiled, plant.signature
    sample = Trace(
        signature,
        float(plant.decl.dt),
        {name: np.zeros((1, 1)) for name in signature.names},
        name=plant.decl.name,
    )
    arrange(sample, needs_of(compiled, [*compiled.requirements, *compiled.assumptions]), plain=True)


# ---------------------------------------------------------------------------------- points


def _points(plant: Plant, order: PlantOrder) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the points to simulate, (batch, dim), and the seed of each.

    Variables that `--from` does not name are drawn. If it names all of them, there is one point.
    """
    seeds = parse_seeds(order.seeds)
    fixed = dict(_assignments(plant, order.point)) if order.point else {}
    if plant.variables and len(fixed) == len(plant.variables):
        seeds = seeds[:1]
    points = np.array([plant.random_point(seed) for seed in seeds]).reshape(len(seeds), -1)
    for index, variable in enumerate(plant.variables):
        if variable.name in fixed:
            points[:, index] = fixed[variable.name]
    return points, seeds


def _assignments(plant: Plant, text: str) -> Iterator[tuple[str, float]]:
    """Yield variables and their values from a text such as `h=1 m, force=0.5`.

    The name of an input signal stands for all its values. Raises UsageError (U101).
    """
    for part in text.split(","):
        name, sign, value = (each.strip() for each in part.partition("="))
        meant = [each for each in plant.variables if name in (each.name, each.name.partition("_values[")[0])]
        if not (name and sign and value):
            raise usage(f"`{part.strip()}` is not of the form NAME=NUMBER", 'write --from "h=1 m, e=0.7"')
        if not meant:
            known = [each.name for each in plant.variables]
            listed = f"variables: {', '.join(known)}" if known else "all its values are fixed"
            raise usage(f"`{plant.decl.name}` has no variable `{name}`", *did_you_mean(name, known), listed)
        for variable in meant:
            yield variable.name, _value(variable, part.strip(), value)


def _value(variable: PlantVariable, part: str, text: str) -> float:
    """Return the value of a variable in its unit, from a text such as `1 m`. Raises UsageError (U101)."""
    match = _VALUE.fullmatch(text)
    try:
        unit = parse_unit(match["unit"].strip()) if match is not None and match["unit"] else variable.unit
    except ValueError as error:
        raise usage(f"`{part}`: {error}") from None
    if match is None or unit.dims != variable.unit.dims:
        raise usage(f"`{part}` is not of the form NAME=NUMBER", f"`{variable.name}` is in [{variable.unit}]")
    found = float(match["number"])
    if unit != variable.unit:
        in_si = found * unit.scale + float(unit.offset)
        found = (in_si - float(variable.unit.offset)) / variable.unit.scale
    if not variable.low <= found <= variable.high:
        span = in_unit(f"[{variable.low:g}, {variable.high:g}]", variable.unit.text)
        raise usage(f"`{part}` is outside the range of `{variable.name}`, {span}")
    return found


# ----------------------------------------------------------------------------- simulations


def _simulated(
    plant: Plant,
    monitor: Monitor,
    points: np.ndarray,
    seeds: Sequence[int],
    order: PlantOrder,
    traces: list[Trace],
) -> Iterator[JudgedRun]:
    """Simulate and judge in batches, one simulation per process; keep the traces to be recorded."""
    for first in range(0, len(points), order.jobs):
        PULSE.now(f"simulating {plant.decl.name}, {first} of {len(points)}")
        chosen = range(first, min(first + order.jobs, len(points)))
        for run in plant.simulate(points[chosen], seeds=[seeds[row] for row in chosen], jobs=order.jobs):
            yield _judged(plant, monitor, run)
            if order.record is not None and not _failed(run):
                traces.append(run.outcome)  # type: ignore[arg-type]


def _failed(run: PlantRun) -> bool:
    from stlc.plants.plant import PlantFinding

    return isinstance(run.outcome, PlantFinding)


def _judged(plant: Plant, monitor: Monitor, run: PlantRun) -> JudgedRun:
    from stlc.plants.plant import PlantFinding

    point = _named(plant, run.point)
    if isinstance(run.outcome, PlantFinding):
        return JudgedRun(run.seed, point, 0, None, finding=run.outcome)
    verdict = monitor.check(run.outcome)
    rows = []
    for each in verdict:
        low, high = (float(end.min()) for end in each.margins)
        rows.append(RequirementResult(each.rule, each.statuses[0], low, high, float(each.least[0])))
    return JudgedRun(run.seed, point, run.outcome.samples, verdict.statuses[0], tuple(rows))


def _streamed(
    plant: Plant,
    monitor: Monitor,
    points: np.ndarray,
    seeds: Sequence[int],
    order: PlantOrder,  # noqa: ARG001
    traces: list[Trace],  # noqa: ARG001
) -> Iterator[JudgedRun]:
    """Simulate one after the other, and judge while a simulation runs; nothing of a trace is kept."""
    for index, (point, seed) in enumerate(zip(points, seeds, strict=True)):
        PULSE.now(f"simulating {plant.decl.name}, {index} of {len(points)}")
        online = monitor.online(dt=plant.decl.dt)
        finding = plant.watch(point, online, seed=seed)
        named = _named(plant, point)
        if finding is not None:
            yield JudgedRun(seed, named, 0, None, finding=finding)
            continue
        rows = [
            RequirementResult(online.rule(name), tally.status, tally.low, tally.high, tally.robustness)
            for name, tally in online.finish().items()
        ]
        found = {each.status for each in rows}
        status: Status = "violated" if "violated" in found else "inconclusive"
        status = "satisfied" if found == {"satisfied"} else status
        if online.in_scope is False:
            status, rows = "out of scope", [replace(each, status="out of scope") for each in rows]
        yield JudgedRun(seed, named, online.samples, status, tuple(rows))


def _named(plant: Plant, point: np.ndarray) -> dict[str, float]:
    return {each.name: float(value) for each, value in zip(plant.variables, point, strict=True)}


def _save(path: Path, traces: Sequence[Trace], monitor: Monitor) -> None:
    """Write the traces to one file, with the specification; shorter ones end in unknown samples (NaN)."""
    from stlc.compile.frontend.modules import library_of, spec_sha256
    from stlc.trace import save_trace
    from stlc.version import __version__

    longest = max(trace.samples for trace in traces)
    data = {}
    for name in traces[0].signature.names:
        data[name] = np.full((len(traces), longest), np.nan)
        for row, trace in enumerate(traces):
            data[name][row, : trace.samples] = trace.data[name][0]
    spec = monitor.spec
    library = library_of(spec)
    meta = replace(
        traces[0].meta,
        spec_name=monitor.compiled.name,
        spec_path=spec.source.name,
        spec_text=spec.source.text,
        spec_library=library,
        spec_hash=spec_sha256(spec.source.text, library),
        seed=None,
        stlc_version=__version__,
    )
    save_trace(path, replace(traces[0], data=data, meta=meta))


# --------------------------------------------------------------------------------- results


def _code(runs: Sequence[JudgedRun], fail_under: float | None) -> int:
    """Exit code: 0 all satisfied, 1 a violation or a finding, 4 inconclusive."""
    found = [run.status for run in runs]
    if fail_under is not None:
        return int(found.count("satisfied") / len(found) < fail_under)
    if None in found or "violated" in found:
        return 1
    return 0 if set(found) <= {"satisfied", "out of scope"} and "satisfied" in found else 4


def _document(
    plant: Plant, monitor: Monitor, runs: Sequence[JudgedRun], order: PlantOrder, *, stream: bool
) -> PlantSimulation:
    found = [run.status for run in runs]
    return {
        "spec": monitor.compiled.name,
        "plant": plant.decl.name,
        "kind": plant.decl.kind,
        "dt": float(plant.decl.dt),
        "steps": plant.decl.steps,
        "streamed": stream,
        "satisfied": found.count("satisfied"),
        "violated": found.count("violated"),
        "inconclusive": found.count("inconclusive"),
        "out_of_scope": found.count("out of scope"),
        "findings": found.count(None),
        "trace": None if order.record is None else str(order.record),
        "runs": [_run_record(run) for run in runs],
    }


def _run_record(run: JudgedRun) -> PlantRunRecord:
    requirements: list[PlantRequirement] = [
        {
            "name": each.rule.name,
            "verdict": each.status,
            "robustness": each.robustness,
            "low": each.low,
            "high": each.high,
            "unit": each.rule.unit,
        }
        for each in run.requirements
    ]
    failure: PlantFailure | None = None
    if run.finding is not None:
        finding = run.finding
        failure = {
            "reason": finding.reason,
            "message": finding.message,
            "time": finding.time,
            "stderr": finding.stderr,
        }
    return {
        "seed": run.seed,
        "point": dict(run.point),
        "samples": run.samples,
        "verdict": "finding" if run.status is None else run.status,
        "requirements": requirements,
        "finding": failure,
    }


def _show(plant: Plant, monitor: Monitor, runs: Sequence[JudgedRun], order: PlantOrder) -> None:
    decl = plant.decl
    count = f"{len(runs)} simulation{'s' if len(runs) != 1 else ''}"
    emit(
        f"{visible(monitor.compiled.name)} on {visible(decl.name)}    "
        f"{count} of {float(decl.duration):g} s, dt {float(decl.dt):g} s"
    )
    emit("")
    emit(table(list(_rows(plant, runs)), header=("seed", "verdict", "requirement", "robustness", "point")))
    for run in [run for run in runs if run.finding is not None][:MOST_SHOWN]:
        for line in _finding_lines(run):
            emit(line)
    emit("")
    emit(_summary(runs))
    if order.record is not None:
        say(f"the traces are in {order.record}")
        emit(f"next: {shell(('stlc', 'check', operand(str(order.record))))}")


def _rows(plant: Plant, runs: Sequence[JudgedRun]) -> Iterator[tuple[str, ...]]:
    """Rows of the table: per simulation its verdict, and the requirement with the least robustness."""
    for run in runs:
        point = ", ".join(
            f"{each.name}={in_unit(f'{run.point[each.name]:.4g}', each.unit.text)}"
            for each in plant.variables[:4]
        )
        point += ", …" if len(plant.variables) > 4 else ""
        if run.status is None:
            yield str(run.seed), "FINDING", "", run.finding.reason if run.finding else "", point
            continue
        worst = min(run.requirements, key=lambda each: each.share)
        value = robustness_text(worst.status, worst.low, worst.high, worst.robustness, worst.rule.unit)
        yield str(run.seed), WORDS[run.status], worst.rule.name, value, point


def _finding_lines(run: JudgedRun) -> Iterator[str]:
    finding = run.finding
    assert finding is not None
    at = "" if finding.time is None else f" at t = {finding.time:.10g} s"
    yield ""
    yield f"seed {run.seed}: {finding.reason}{at}: {visible(finding.message)}"
    values = ", ".join(f"{visible(name)}={value:.17g}" for name, value in run.point.items())
    if values:
        yield f"  point: {values}"
    for line in finding.stderr.splitlines()[-MOST_SHOWN:]:
        yield f"  | {visible(line)}"


def _summary(runs: Sequence[JudgedRun]) -> str:
    found = [run.status for run in runs]
    text = f"{found.count('satisfied')} of {len(runs)} simulations satisfy every requirement"
    others: dict[Status | None, str] = {
        "violated": "violated",
        "inconclusive": "inconclusive",
        "out of scope": "out of scope",
        None: "without a trace",
    }
    for status, words in others.items():
        if number := found.count(status):
            text += f"; {number} {words}"
    return text
