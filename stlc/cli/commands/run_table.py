"""Runs in a table: what each was, how far it came, and in what two of them differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stlc.diagnostics import StlcError
from stlc.rundir import RunDir, every_run

_VOLATILE = ("started", "finished", "command", "result.seconds", "seconds")


@dataclass(frozen=True, slots=True)
class Row:
    """One run.

    Attributes:
        run: `spec/number-words`.
        path: of its folder.
        record: of `run.json`; empty where it is damaged.
        status: of the run, or "damaged".
    """

    run: str
    path: str
    record: Mapping[str, Any]
    status: str

    @property
    def accuracy(self) -> float | None:
        """Share of held-out starts whose plan satisfies the specification."""
        result = self.record.get("result")
        value = result.get("accuracy") if isinstance(result, Mapping) else None
        return float(value) if isinstance(value, int | float) else None

    def cells(self) -> tuple[str, ...]:
        """As text."""
        record, accuracy = self.record, self.accuracy
        result = record.get("result")
        seconds = result.get("seconds") if isinstance(result, Mapping) else None
        return (
            self.run,
            Path(str(record.get("system_path", ""))).name,
            self.status,
            "" if accuracy is None else f"{accuracy:.4f}",
            str(record.get("steps") or ""),
            f"{seconds:.0f} s" if isinstance(seconds, int | float) else "",
            str(record.get("started", "")),
        )

    def values(self) -> dict[str, Any]:
        """For JSON."""
        kept = {key: self.record.get(key) for key in ("spec", "system_path", "steps", "seed", "started")}
        return {"run": self.run, "path": self.path, "status": self.status, "accuracy": self.accuracy, **kept}


def overview(root: Path, sort: str) -> list[Row]:
    """All runs below a folder; a damaged one is listed, not raised."""
    rows = [_row(run) for run in every_run(root)]
    if sort == "acc":
        return sorted(rows, key=lambda row: -1.0 if row.accuracy is None else row.accuracy)
    return sorted(rows, key=lambda row: str(row.record.get("started", ""))) if sort == "time" else rows


def _row(run: RunDir) -> Row:
    name = f"{run.path.parent.name}/{run.name}"
    try:
        record = run.record()
    except StlcError:
        return Row(name, run.shown, {}, "damaged")
    return Row(name, run.shown, record, str(record.get("status", "running")))


def differences(one: Mapping[str, str], other: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """(key, value, other value) where two flat records differ; times of day are left out."""
    keys = [key for key in {**one, **other} if key not in _VOLATILE]
    return [(key, one.get(key, ""), other.get(key, "")) for key in keys if one.get(key) != other.get(key)]
