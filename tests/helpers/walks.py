"""A mission in the plane, recorded by hand: two who keep it, one who swims and one who comes too late."""

import numpy as np

from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.trace import Trace, TraceMeta
from stlc.units import Unit

SPEC = """spec walk
state signal x, y [m]
state signal v [m/s]

region gate  = circle([4 m, 0 m], 1 m)
region yard  = box([3 m, 3 m], [5 m, 5 m])
region marsh = union(circle([0 m, 2 m], 1 m), polygon([1, 1], [2, 1], [2, 3]))

@safety
require dry: always ([x, y] not in marsh)
require pass_gate: eventually@[1 s, 3 s] [x, y] in gate
require rest: always@[5 s, 6 s] [x, y] in yard
require calm: not ([x, y] in circle([-3 m, -3 m], 1 m) and v > 1 m/s)
"""
CORNERS = {
    "keeps": [(0, 0), (4, 0), (4, 4), (4, 4)],
    "keeps too": [(0, -1), (4, 0.5), (3.5, 4), (3.5, 4)],
    "swims": [(0, 0), (4, 0), (0, 2), (4, 4)],
    "late": [(0, 0), (0, 0), (4, 4), (4, 4)],
}
"""Positions at 0, 2, 4 and 6 seconds; straight lines between."""


def walk(names=tuple(CORNERS), text=SPEC):
    times = np.arange(0.0, 6.01, 0.1)
    paths = np.array(
        [[np.interp(times, [0, 2, 4, 6], axis) for axis in np.array(CORNERS[n]).T] for n in names]
    )
    columns = tuple(Column(name, Unit.parse(unit)) for name, unit in (("x", "m"), ("y", "m"), ("v", "m/s")))
    data = {"x": paths[:, 0], "y": paths[:, 1], "v": np.zeros_like(paths[:, 0])}
    meta = TraceMeta(spec_name="walk", spec_text=text, dt=0.1)
    return Trace(Signature(columns), 0.1, data, meta=meta)


def judged(trace):
    """(spec, verdict) of a trace."""
    monitor = Monitor(Spec.parse(Source("walk.stl", trace.meta.spec_text)))
    return monitor.spec, monitor.check(trace)
