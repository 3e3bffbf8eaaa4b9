"""Failed simulations of a plant: files from which they are simulated again, and their text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stlc.cli.framework.output import Answer, emit
from stlc.escape import file_part, visible
from stlc.files import write_atomic
from stlc.jsontext import dumps

if TYPE_CHECKING:
    import numpy as np

    from stlc.assurance.plant_simulator import FailedSimulation, PlantSimulator
    from stlc.cli.framework.assured import FalsifiedFinding, ReplayedFinding
    from stlc.plants.plant import PlantFinding

FORMAT = "stlc-finding/1"
KEYS: Mapping[str, Any] = {"reason": str, "message": str, "settings": dict, "point": list}
"""Keys of the file of a finding, and their types."""
MOST_WRITTEN = 10
"""Kinds of failures, by reason and message, that are written to files; the first of each kind."""
MOST_LINES = 5
"""Lines that a plant printed, and that are shown."""


def written(
    failures: Sequence[FailedSimulation],
    folder: Path,
    settings: Mapping[str, Any],
    command: Callable[[Path], str],
) -> list[FalsifiedFinding]:
    """Write the first failed simulation of each kind to a file, and return the records.

    Args:
        failures: the failed simulations.
        folder: folder of the files.
        settings: settings of the simulations.
        command: function that returns the command that replays a file.
    """
    kinds: dict[tuple[str, str], list[FailedSimulation]] = {}
    for each in failures:
        kinds.setdefault((each.finding.reason, each.finding.message), []).append(each)
    records: list[FalsifiedFinding] = []
    for index, alike in enumerate(list(kinds.values())[:MOST_WRITTEN]):
        finding = alike[0].finding
        part = file_part(finding.reason.replace(" ", "-"), empty="failure")
        path = folder / f"finding-{index + 1}-{part}.json"
        stored = {
            "format": FORMAT,
            **_described(finding),
            "settings": dict(settings),
            "values": dict(finding.point),
            "point": alike[0].point.tolist(),
        }
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, dumps(stored) + "\n")
        records.append(
            {
                "reason": finding.reason,
                "message": finding.message,
                "time": finding.time,
                "stderr": finding.stderr,
                "simulations": len(alike),
                "point": dict(finding.point),
                "file": str(path),
                "replay": command(path),
            }
        )
    return records


def _described(finding: PlantFinding) -> dict[str, Any]:
    return {
        "reason": finding.reason,
        "message": finding.message,
        "time": finding.time,
        "stderr": finding.stderr,
    }


def lines(records: Sequence[FalsifiedFinding]) -> Iterator[str]:
    """Lines of text that show failed simulations."""
    for each in records:
        count = each["simulations"]
        times = f"{count:,} simulations failed" if count > 1 else "a simulation failed"
        yield f"{times}, {_told(each['reason'], each['time'], each['message'])}"
        values = ", ".join(f"{visible(name)}={value:.6g}" for name, value in each["point"].items())
        if values:
            yield f"  at {values}"
        yield from (f"  | {visible(line)}" for line in each["stderr"].splitlines()[-MOST_LINES:])
        yield f"  {each['replay']}"


def _told(reason: str, time: float | None, message: str) -> str:
    at = "" if time is None else f" at t = {time:.10g} s"
    return f"{reason}{at}: {visible(message)}"


def replayed(
    simulator: PlantSimulator, point: np.ndarray, stored: Mapping[str, Any]
) -> Answer[ReplayedFinding]:
    """Simulate a failed simulation again, at a point of the unit cube, (dim,)."""
    from stlc.plants.plant import PlantFinding

    found = simulator.outcome(point)
    failed = found if isinstance(found, PlantFinding) else None
    before = {key: stored.get(key) for key in ("reason", "message", "time")}
    again = None if failed is None else {key: _described(failed)[key] for key in before}
    document: ReplayedFinding = {
        "reason": None if failed is None else failed.reason,
        "message": None if failed is None else failed.message,
        "time": None if failed is None else failed.time,
        "stored_reason": str(stored["reason"]),
        "identical": again == before,
    }

    def show() -> None:
        if failed is None:
            emit(f"the simulation gives a trace; before: {visible(str(stored['reason']))}")
            return
        same = "as before" if again == before else f"before: {visible(str(stored['reason']))}"
        emit(f"the simulation fails, {same}; {_told(failed.reason, failed.time, failed.message)}")
        for line in failed.stderr.splitlines()[-MOST_LINES:]:
            emit(f"  | {visible(line)}")

    return Answer(document, show, int(failed is not None))
