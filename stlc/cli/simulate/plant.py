"""Simulations of a black box, judged by a specification: the option `--plant` of `stlc simulate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.activity import PULSE
from stlc.cli.check.text import WORDS, in_unit, robustness_text
from stlc.cli.framework.options import parse_seeds
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics, table
from stlc.diagnostics import usage
from stlc.escape import operand, shell, visible
from stlc.monitor.judgement import worst_of
from stlc.registry import did_you_mean
from stlc.units import parse_quantity, time_text

if TYPE_CHECKING:
    from stlc.monitor.verdict import Monitor
    from stlc.plants.judge import JudgedRun, PlantSimulation
    from stlc.plants.plant import Plant, PlantVariable
    from stlc.trace import Trace

CARRYING = (".npz", ".mcap")
"""Suffixes of recorded traces that carry their specification."""
MOST_SHOWN = 5
"""Findings that are printed in full."""


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


def simulate_plant(order: PlantOrder) -> Answer[PlantSimulation]:
    """Simulate a plant at one point or at random ones, and judge each trace.

    Raises:
        StlcError: the plant file, the specification or an option is invalid, or the two files do not fit
            together.
    """
    from stlc.plants.judge import PlantJudge, PlantSimulation
    from stlc.trace import check_writable, save_trace

    if order.record is not None:
        check_writable(order.record)
    judge = PlantJudge.load(order.spec, order.plant, order.overrides)
    plant, monitor = judge.plant, judge.monitor
    show_diagnostics(monitor.compiled.warnings)
    with plant:
        points, seeds = _points(plant, order)
        stream = order.stream or judge.long
        if stream and order.record is not None:
            raise usage("`--record` needs whole traces, and long simulations are judged while they run")
        runs: list[JudgedRun] = []
        traces: list[Trace] = []
        with PULSE.doing(f"simulating {plant.decl.name}"):
            for run in judge.runs(points, seeds, jobs=order.jobs, stream=stream):
                if order.record is not None and run.trace is not None:
                    traces.append(run.trace)
                runs.append(replace(run, trace=None))
                PULSE.now(f"simulating {plant.decl.name}, {len(runs)} of {len(points)}")
    if order.record is not None and traces:
        save_trace(order.record, judge.stored(traces))
    decl, written = plant.decl, None if order.record is None else str(order.record)
    about = (monitor.compiled.name, decl.name, decl.kind, float(decl.dt), decl.steps)
    found = PlantSimulation(*about, stream, written, tuple(runs))
    return Answer(found, lambda: _show(plant, monitor, found, order), _code(found, order.fail_under))


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
    try:
        found = parse_quantity(text, variable.unit)
    except ValueError as error:
        advice = f"write NAME=NUMBER; `{variable.name}` is in [{variable.unit}]"
        raise usage(f"`{part}`: {error}", advice) from None
    if not variable.low <= found <= variable.high:
        span = in_unit(f"[{variable.low:g}, {variable.high:g}]", variable.unit.text)
        raise usage(f"`{part}` is outside the range of `{variable.name}`, {span}")
    return found


# --------------------------------------------------------------------------------- results


def _code(found: PlantSimulation, fail_under: float | None) -> int:
    """Exit code: 1 if the share of satisfying simulations is too small, or if one has no trace; else 0."""
    few = fail_under is not None and found.satisfied / len(found.runs) < fail_under
    return int(few or (fail_under is None and found.findings > 0))


def _show(plant: Plant, monitor: Monitor, found: PlantSimulation, order: PlantOrder) -> None:
    decl, runs = plant.decl, found.runs
    count = f"{len(runs)} simulation{'s' if len(runs) != 1 else ''}"
    emit(
        f"{visible(monitor.compiled.name)} on {visible(decl.name)}    "
        f"{count} of {time_text(decl.duration)}, dt {float(decl.dt):g} s"
    )
    emit("")
    emit(table(list(_rows(plant, runs)), header=("seed", "verdict", "requirement", "robustness", "point")))
    for run in [run for run in runs if run.finding is not None][:MOST_SHOWN]:
        for line in _finding_lines(run):
            emit(line)
    emit("")
    emit(_summary(found))
    if order.record is not None:
        say(f"the traces are in {order.record}")
        emit(f"next: {shell(('stlc', 'check', *_judging(order), operand(str(order.record))))}")


def _judging(order: PlantOrder) -> tuple[str, ...]:
    """Words that name the specification for `stlc check`; none if the file of `--record` carries it."""
    if order.record is not None and order.record.suffix in CARRYING:
        return ()
    changed = (word for name, value in order.overrides.items() for word in ("--set", f"{name}={value}"))
    return (*changed, operand(order.spec))


def _rows(plant: Plant, runs: Sequence[JudgedRun]) -> Iterator[tuple[str, ...]]:
    """Rows of the table: per simulation its verdict, and the requirement with the least robustness."""
    for run in runs:
        point = ", ".join(
            f"{each.name}={in_unit(f'{run.point[each.name]:.4g}', each.unit.text)}"
            for each in plant.variables[:4]
        )
        point += ", …" if len(plant.variables) > 4 else ""
        if run.verdict is None:
            yield str(run.seed), "FINDING", "", run.finding.reason if run.finding else "", point
            continue
        word, worst = run.verdict.scoped, worst_of(run.verdict)
        low, high = (float(end.min()) for end in worst.margins)
        value = robustness_text(worst.statuses[0], low, high, float(worst.least[0]), worst.unit)
        yield str(run.seed), WORDS[word], worst.name, value, point


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


def _summary(found: PlantSimulation) -> str:
    text = f"{found.satisfied} of {len(found.runs)} simulations satisfy every requirement"
    others = {
        "violated": found.violated,
        "inconclusive": found.inconclusive,
        "out of scope": found.out_of_scope,
        "without a trace": found.findings,
    }
    return text + "".join(f"; {number} {words}" for words, number in others.items() if number)
