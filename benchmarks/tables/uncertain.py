"""Time of bounds over uncertain signals, compared with the same evaluation of exact signals.

Every sample of every signal is an interval. Formulas are those of `benchmarks.formulas`, evaluated at every
sample; the specifications are judged by the monitor on random signals, all instants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Annotated

import numpy as np
import typer

from benchmarks.formulas import CASES, Case, width_of
from benchmarks.options import Output
from benchmarks.store import BENCHMARKS, spec_path
from benchmarks.table import Columns, Table, measured_here, publish
from benchmarks.timing import interleaved, one_thread, ratio
from stlc.cli.framework.program import command
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.monitor.uncertain import Uncertainty
from stlc.monitor.verdict import Monitor

_SHARE = 10
"""Traces of specifications are shorter and fewer than those of formulas by this factor."""

_ERROR = 0.01


@dataclass(frozen=True, slots=True)
class Overhead:
    """Measured overhead of intervals for one formula or specification.

    Attributes:
        subject: name of the formula or specification.
        samples: number of samples per trace.
        traces: number of traces.
        exact: processor time for exact signals in seconds.
        ratio: processor time for intervals divided by `exact`, the median over rounds.
    """

    subject: str
    samples: int
    traces: int
    exact: float
    ratio: float

    @property
    def time(self) -> str:
        """Processor time of exact signals as text."""
        return f"{self.exact * 1e3:.2f} ms"


COLUMNS: Columns[Overhead] = {
    **{"formula": "{subject}", "samples": "{samples}", "traces": "{traces}"},
    **{"exact": "{time}", "intervals": "{ratio:.1f}x"},
}


TEXT = """## Bounds over uncertain signals

Written by `python -m benchmarks uncertain`. Processor time of robustness at every sample on one thread: of
exact signals, and of signals in which every sample is an interval, as a multiple. Formulas are evaluated by
the array back end, specifications are judged by the monitor, instant by instant.
"""
_OUTPUT = Output()


@command(
    "python -m benchmarks uncertain --samples 1000 --traces 100",
    "python -m benchmarks uncertain --page docs/benchmarks.md",
)
def uncertain(
    samples: Annotated[int, typer.Option("--samples", metavar="N", min=2, help="Samples of a trace.")] = 1000,
    traces: Annotated[int, typer.Option("--traces", metavar="N", min=1, help="How many.")] = 100,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of measurement for a row.")
    ] = 0.3,
    output: Output = _OUTPUT,
) -> None:
    """Time bounds over uncertain signals, as a multiple of the time for exact ones."""
    table = overheads(samples, traces, seconds)
    with one_thread():
        publish("uncertain", output, lambda: [TEXT, *table.markdown(), "", measured_here()], {"rows": table})


def overheads(samples: int = 1000, traces: int = 100, seconds: float = 0.3) -> Table[Case | str, Overhead]:
    """Return the table of all formulas and specifications on traces of one size.

    Args:
        samples: number of samples per trace.
        traces: number of traces.
        seconds: approximate measurement time per row.
    """
    cells: list[Case | str] = [*CASES, *BENCHMARKS]
    measure = partial(overhead_of, samples=samples, traces=traces, seconds=seconds)
    return Table("uncertain", cells, measure, COLUMNS, "{subject}")


def overhead_of(cell: Case | str, *, samples: int, traces: int, seconds: float) -> Overhead:
    """Measure the overhead for a formula, or for a specification of the benchmarks by name."""
    if isinstance(cell, str):
        samples, traces = max(samples // _SHARE, 2), max(traces // _SHARE, 1)
        name, todo = cell, _specification(cell, samples, traces)
    else:
        name, todo = cell.name, _formula(cell, samples, traces)
    exact, bounded = interleaved(todo, seconds)
    return Overhead(name, samples, traces, median(exact), ratio(bounded, exact))


def _formula(case: Case, samples: int, traces: int) -> list[Callable[[], object]]:
    rng = np.random.default_rng(0)
    formula = case.formula(width_of(samples))
    env = {name: rng.normal(size=(samples, traces)) for name in "xy"}
    box = {name: Intervals(x - _ERROR, x + _ERROR) for name, x in env.items()}
    return [
        lambda: robustness_signal(formula, env, end="truncate"),
        lambda: robustness_signal(formula, box, ops=INTERVALS, end="truncate"),
    ]


def _specification(name: str, samples: int, traces: int) -> list[Callable[[], object]]:
    rng = np.random.default_rng(0)
    spec = Spec.parse(File(spec_path(name)).read())
    monitor = Monitor(spec, system=spec.system)
    columns = monitor.compiled.signature.columns
    signals = {}
    for column in columns:
        low, high = column.low or 0.0, column.high or 1.0
        drawn = rng.uniform(low, high, (traces, samples))
        signals[column.name] = drawn if column.kind == "real" else np.round(drawn)
    errors = {column.name: Uncertainty(_ERROR) for column in columns if column.kind == "real"}
    return [lambda: monitor.check(signals), lambda: monitor.check(signals, uncertain=errors)]
