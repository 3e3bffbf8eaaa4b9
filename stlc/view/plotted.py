"""Picture of a verdict: signals, and below them the robustness of the requirements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stlc.monitor.judgement import Verdict
from stlc.signature import Signature
from stlc.trace import Trace
from stlc.view import require_drawing
from stlc.view.signals import acted_in, choose_traces, draw_signals
from stlc.view.style import Picture
from stlc.view.verdicts import margins_of, marks_of, trace_names, units_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot(verdict: Verdict) -> Figure:
    """Draw the judged signals, with thresholds and deciding values, and the robustness at each sample.

    Of several traces, the worst and a typical one are drawn. `verdict` is that of `stlc.check` or
    `Monitor.check`.

    Raises:
        MissingError: R301, matplotlib is not installed.
    """
    require_drawing()
    given, columns = verdict.subject.signals, verdict.subject.compiled.signature.columns
    data = {name: np.asarray(values).T for name, values in given.env.items()}
    named = Signature(tuple(column for column in columns if column.name in data))
    trace = given.trace or Trace(named, verdict.about.dt or 1.0, data, given.t0)
    return picture_of(verdict, trace).figure


def picture_of(verdict: Verdict, trace: Trace) -> Picture:
    """Picture of a verdict on a trace; of several, the worst and a typical one are drawn."""
    choices = choose_traces(np.ravel(verdict.robustness), trace_names(trace), acted_in(trace))
    return draw_signals(trace, margins_of(verdict), choices, units_of(verdict), marks_of(verdict, trace))
