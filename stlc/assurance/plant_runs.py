"""Simulations of a black box, judged by a specification: at one point, or at random ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stlc.activity import PULSE
from stlc.assurance.plant_judge import JudgedRun, PlantJudge, PlantSimulation
from stlc.diagnostics import notice, usage
from stlc.escape import visible
from stlc.trace import Trace

if TYPE_CHECKING:
    from stlc.assurance.options import SimulateOptions
    from stlc.plants.plant import Plant, PlantVariable


def plant_simulation(spec: str, options: SimulateOptions) -> PlantSimulation:
    """Simulate the plant of `options` at one point or at random ones, and judge each trace.

    Raises:
        StlcError: the plant file, the specification or an option is invalid, or the two files do not fit
            together.
    """
    own = {
        **{"--backup": options.backup, "--guard": options.guard, "--scenario": options.scenario},
        **{"--method": options.method, "--certify": options.certify},
    }
    for name, value in own.items():
        if value is not None:
            raise usage(f"`{name}` is for trained policies and planners, and `--plant` has neither")
    assert options.plant is not None
    if options.record is not None:
        Trace.check_writable(options.record)
    judge = PlantJudge.load(spec, options.plant, options.overrides)
    plant, monitor = judge.plant, judge.monitor
    for warning in monitor.compiled.warnings:
        notice(warning)
    with plant:
        points, seeds = _points(plant, options)
        stream = options.stream or judge.long
        if stream and options.record is not None:
            raise usage("`--record` needs whole traces, and long simulations are judged while they run")
        runs: list[JudgedRun] = []
        traces: list[Trace] = []
        with PULSE.doing(f"simulating {plant.decl.name}"):
            for run in judge.runs(points, seeds, jobs=options.jobs, stream=stream):
                if options.record is not None and run.trace is not None:
                    traces.append(run.trace)
                runs.append(replace(run, trace=None))
                PULSE.now(f"simulating {plant.decl.name}, {len(runs)} of {len(points)}")
    if options.record is not None and traces:
        judge.stored(traces).save(options.record)
    decl, written = plant.decl, None if options.record is None else str(options.record)
    about = (monitor.compiled.name, decl.name, decl.kind, float(decl.dt), decl.steps)
    return PlantSimulation(*about, stream, written, tuple(runs), plant.variables)


def _points(plant: Plant, options: SimulateOptions) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the points to simulate, (batch, dim), and the seed of each.

    Variables that `start` does not name are drawn. If it names all of them, there is one point.
    """
    seeds = tuple(options.seeds)
    fixed = dict(_assignments(plant, options.start)) if options.start else {}
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
            raise usage(f"`{plant.decl.name}` has no variable `{name}`", listed).near(name, known)
        for variable in meant:
            yield variable.name, _value(variable, part.strip(), value)


def _value(variable: PlantVariable, part: str, text: str) -> float:
    """Return the value of a variable in its unit, from a text such as `1 m`. Raises UsageError (U101)."""
    try:
        found = variable.unit.value_of(text)
    except ValueError as error:
        advice = f"write NAME=NUMBER; `{variable.name}` is in [{variable.unit}]"
        raise usage(f"`{part}`: {error}", advice) from None
    if not variable.low <= found <= variable.high:
        span = f"[{variable.low:g}, {variable.high:g}] {visible(variable.unit.text)}".rstrip()
        raise usage(f"`{part}` is outside the range of `{variable.name}`, {span}")
    return found
