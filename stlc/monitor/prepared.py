"""Signals laid out together with the requirements to evaluate."""

from __future__ import annotations

from dataclasses import dataclass

from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.escape import visible
from stlc.monitor.signals import Gap, Signals, gaps_of
from stlc.monitor.values import Record


@dataclass(frozen=True, slots=True)
class Prepared:
    """Signals laid out for a specification that was compiled for their time step.

    Attributes:
        compiled: the specification.
        rules: the requirements to evaluate.
        signals: source of the columns.
        record: the columns, and their array library.
    """

    compiled: Compiled
    rules: tuple[CompiledRequirement, ...]
    signals: Signals
    record: Record

    @property
    def horizon(self) -> int | None:
        """Value of `T` in steps; None where unknown."""
        return self.compiled.grid.horizon

    @property
    def dt(self) -> float | None:
        """Time step in seconds; None where unknown."""
        return None if self.compiled.grid.dt is None else float(self.compiled.grid.dt)

    @property
    def gaps(self) -> dict[str, Gap]:
        """Gaps in the needed signals."""
        return gaps_of(self.signals)

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; its number where the time step is unknown."""
        return float(sample) if self.dt is None else self.signals.t0 + sample * self.dt

    def moment(self, sample: int) -> str:
        """Time of a sample in words: `t = 4.6 s`."""
        return f"sample {sample}" if self.dt is None else f"t = {self.time(sample):.10g} s"


def gap_text(name: str, gap: Gap, samples: int, moments: tuple[str, str]) -> str:
    """Samples at which a signal is unknown: ``rpm` is unknown at 120 of 6,000 samples (t = 8 s to 20 s)`."""
    first, last = moments
    where = first if gap.samples == 1 else f"{first} to {last.removeprefix('t = ')}"
    return f"`{visible(name)}` is unknown at {gap.samples:,} of {samples:,} samples ({where})"


def beside(moment: str, start: str) -> str:
    """An instant, and the start of its window where they differ: `t = 4.6 s (window from 2 s)`."""
    return moment if moment == start else f"{moment} (window from {start.removeprefix('t = ')})"
