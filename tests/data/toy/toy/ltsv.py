"""Trace format `ltsv`: lines of labelled values between tabs, such as `t:0.5` and `x:3`."""

import numpy as np

from stlc.trace.formats.registry import Format, damage, opened
from stlc.trace.recording import ALL, ClockGroup, Recording

FORMAT = Format(__name__, (".ltsv",), writes=True)


def read(path, wanted=ALL):
    """Read a file."""
    with opened(path), damage(path):
        lines = path.read_text(encoding="utf-8").split("\n")
        samples = [dict(part.split(":", 1) for part in line.split("\t")) for line in lines if line]
        names = [name for name in samples[0] if wanted.keeps(name)]
        columns = {name: np.array([float(each[name]) for each in samples]) for name in names}
    return Recording(str(path), (ClockGroup(columns, None),))


def write(path, trace):
    """Write the first trace."""
    columns = {"t": trace.times, **{name: array[0] for name, array in trace.data.items()}}
    lines = (
        "\t".join(f"{name}:{value:.17g}" for name, value in zip(columns, row, strict=True))
        for row in zip(*columns.values(), strict=True)
    )
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
