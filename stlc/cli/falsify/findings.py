"""Failed simulations of a plant: files from which they are simulated again, and their text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.framework.output import Answer, emit
from stlc.escape import file_part, visible
from stlc.files import write_atomic
from stlc.jsontext import dumps

if TYPE_CHECKING:
    import numpy as np

    from stlc.assurance.falsified import FalsifiedFinding, ReplayedFinding, StoredFinding, StoredSettings
    from stlc.assurance.plant_simulator import FailedSimulation, PlantSimulator

FORMAT = "stlc-finding/1"
MOST_WRITTEN = 10
"""Kinds of failures, by reason and message, that are written to files; the first of each kind."""
MOST_LINES = 5
"""Lines that a plant printed, and that are shown."""


def written(
    failures: Sequence[FailedSimulation],
    folder: Path,
    settings: StoredSettings,
    command: Callable[[Path], str],
) -> list[FalsifiedFinding]:
    """Write the first failed simulation of each kind to a file, and return the records.

    Args:
        failures: the failed simulations.
        folder: folder of the files.
        settings: settings of the simulations.
        command: function that returns the command that replays a file.
    """
    from stlc.assurance.falsified import FalsifiedFinding, StoredFinding

    kinds: dict[tuple[str, str], list[FailedSimulation]] = {}
    for each in failures:
        kinds.setdefault((each.finding.reason, each.finding.message), []).append(each)
    records: list[FalsifiedFinding] = []
    for index, alike in enumerate(list(kinds.values())[:MOST_WRITTEN]):
        finding = alike[0].finding
        part = file_part(finding.reason.replace(" ", "-"), empty="failure")
        path = folder / f"finding-{index + 1}-{part}.json"
        stored = StoredFinding(
            *(finding.reason, finding.message, settings, alike[0].point.tolist()),
            *(finding.time, finding.stderr, dict(finding.point)),
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, dumps(stored) + "\n")
        records.append(FalsifiedFinding(finding, len(alike), str(path), command(path)))
    return records


def lines(records: Sequence[FalsifiedFinding]) -> Iterator[str]:
    """Lines of text that show failed simulations."""
    for each in records:
        count, finding = each.simulations, each.finding
        times = f"{count:,} simulations failed" if count > 1 else "a simulation failed"
        yield f"{times}, {_told(finding.reason, finding.time, finding.message)}"
        values = ", ".join(f"{visible(name)}={value:.6g}" for name, value in finding.point.items())
        if values:
            yield f"  at {values}"
        yield from (f"  | {visible(line)}" for line in finding.stderr.splitlines()[-MOST_LINES:])
        yield f"  {each.replay}"


def _told(reason: str, time: float | None, message: str) -> str:
    at = "" if time is None else f" at t = {time:.10g} s"
    return f"{reason}{at}: {visible(message)}"


def replayed(simulator: PlantSimulator, point: np.ndarray, stored: StoredFinding) -> Answer[ReplayedFinding]:
    """Simulate a failed simulation again, at a point of the unit cube, (dim,)."""
    from stlc.assurance.falsified import ReplayedFinding
    from stlc.plants.plant import PlantFinding

    found = simulator.outcome(point)
    failed = found if isinstance(found, PlantFinding) else None
    reason, message, time = (
        (None, None, None) if failed is None else (failed.reason, failed.message, failed.time)
    )
    same = (reason, message, time) == (stored.reason, stored.message, stored.time)

    def show() -> None:
        if failed is None:
            emit(f"the simulation gives a trace; before: {visible(stored.reason)}")
            return
        before = "as before" if same else f"before: {visible(stored.reason)}"
        emit(f"the simulation fails, {before}; {_told(failed.reason, failed.time, failed.message)}")
        for line in failed.stderr.splitlines()[-MOST_LINES:]:
            emit(f"  | {visible(line)}")

    return Answer(ReplayedFinding(reason, message, time, stored.reason, same), show, int(failed is not None))
