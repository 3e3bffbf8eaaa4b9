"""`stlc bench robustness`: how fast this machine computes robustness, as ratios."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table

if TYPE_CHECKING:
    from stlc.bench.robustness import Timing

_HEADER = ("formula", "samples", "traces", "w", "", "time", "passes", "plain torch")


def robustness(
    samples: Annotated[
        list[int] | None,
        typer.Option("--samples", metavar="N", min=2, help="Length of a trace; 20, 100, 1000 and 10000."),
    ] = None,
    traces: Annotated[
        list[int] | None, typer.Option("--traces", metavar="N", min=1, help="How many; 1 and 1000.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.0, help="Seconds of measurement for a row.")
    ] = 0.3,
    as_json: JsonOption = False,
) -> None:
    """Print a row for every formula and size."""
    from stlc.bench.robustness import BATCHES, SAMPLES, robustness_timings

    timings = []
    for timing in robustness_timings(samples or SAMPLES, traces or BATCHES, seconds=seconds):
        timings.append(timing)
        if not as_json:
            say(f"{timing.case}, {timing.samples} samples x {timing.batch} traces")
    if as_json:
        result = {"what": "robustness", "timings": [_json(timing) for timing in timings]}
        emit_json("bench/1", ok=True, exit_code=0, result=result)
        return
    emit(table([_row(timing) for timing in timings], header=_HEADER, indent=""))


def _row(timing: Timing) -> tuple[str, ...]:
    return (
        timing.case,
        str(timing.samples),
        str(timing.batch),
        str(timing.width),
        "with gradient" if timing.gradient else "",
        _in_words(timing.seconds),
        f"{timing.passes:.1f}x",
        "" if timing.plain is None else f"{timing.plain:.1f}x",
    )


def _in_words(seconds: float) -> str:
    return f"{seconds * 1e3:.2f} ms" if seconds >= 1e-3 else f"{seconds * 1e6:.0f} us"


def _json(timing: Timing) -> dict[str, Any]:
    return {
        "formula": timing.case,
        "samples": timing.samples,
        "traces": timing.batch,
        "width": timing.width,
        "gradient": timing.gradient,
        "seconds": timing.seconds,
        "passes": timing.passes,
        "plain": timing.plain,
    }
