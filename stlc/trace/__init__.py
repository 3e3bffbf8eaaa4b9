"""Recorded signals: traces, their sampling times, and their file formats."""

from stlc.trace.trace import (
    AS_IT_IS,
    Reading,
    Trace,
    TraceMeta,
    as_fraction,
    read_recording,
    trace_of,
    traces_of,
)

__all__ = [
    "AS_IT_IS",
    "Reading",
    "Trace",
    "TraceMeta",
    "as_fraction",
    "read_recording",
    "trace_of",
    "traces_of",
]
