"""`--out` of `stlc check`: the robustness of every requirement at every sample, as a trace of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from stlc.cli.check.checked import Checked
    from stlc.cli.check.judge import Question


def write_robustness(path: Path, result: Checked, question: Question) -> None:
    """Write one signal per requirement, (traces, samples); NaN where it has no value.

    Raises:
        MissingError: R201, no room or no permission.
    """
    from dataclasses import replace

    from stlc.cli.check.judge import monitor_of
    from stlc.signature import Column, Signature
    from stlc.trace import Trace, save_trace
    from stlc.units import written_unit

    trace = result.trace
    monitor = monitor_of(result.source, question, result.trace.meta.carried)
    end: Literal["strict", "truncate"] = "truncate" if question.end == "truncate" else "strict"
    values = monitor.requirement_robustness(trace, end=end, semantics=question.semantics)
    chosen = {judgement.name for judgement in result.verdict}
    data = {
        name: np.asarray(rows, dtype=np.float64).reshape(trace.traces, trace.samples)
        for name, rows in values.items()
        if name in chosen
    }
    units = {judged.name: written_unit(judged.unit) for judged in result.verdict}
    signature = Signature(tuple(Column(name, units[name]) for name in data))
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = replace(trace.meta, spec_text="", spec_path="", judge_text="", judge_path="")
    save_trace(path, Trace(signature, trace.dt, data, trace.t0, meta=meta, name=str(path)))
