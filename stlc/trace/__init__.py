"""Recorded signals: what a trace is, its clock, and the files that it comes from."""

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
]
