"""Recorded signals: traces, their sampling times, and their file formats."""

from stlc.trace.trace import (
    AS_IT_IS,
    Reading,
    Trace,
    TraceMeta,
    as_fraction,
    check_writable,
    load_trace,
    read_recording,
    save_trace,
    trace_of,
    traces_of,
)

__all__ = [
    "AS_IT_IS",
    "Reading",
    "Trace",
    "TraceMeta",
    "as_fraction",
    "check_writable",
    "load_trace",
    "read_recording",
    "save_trace",
    "trace_of",
    "traces_of",
]
