"""`stlc export`: a trained controller for other programs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.cli.framework.options import RunArgument
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.escape import visible
from stlc.export.targets import ExportOptions
from stlc.export.targets import export as write

if TYPE_CHECKING:
    from stlc.export.monitor import ExportedMonitor
    from stlc.export.write import Exported

OPTIONS = ExportOptions()


@command(
    "stlc export latest --to c",
    "stlc export latest --to onnx -o controller",
    "stlc export latest --to onnx --precision float64",
    "stlc export latest --to torch",
    "stlc export specs/traffic.stl --to c -o monitor",
)
def export(
    run: RunArgument = "latest",
    options: ExportOptions = OPTIONS,
) -> Answer[Exported | ExportedMonitor]:
    """Export a trained controller, monitor included, or the monitor of a specification.

    `torch` is a torch.export program that maps states to plans and their robustness. `c` is a C99 header with
    an example program. It depends only on libm, and includes the backup policy. `onnx` is a set of graphs for
    onnxruntime, which `stlc.runtime` runs without torch. It includes the backup policy, too. For random
    states, the results of every export are compared with those of the run. Files of an earlier export are
    replaced, but a different `main.c` or `Makefile` is kept.

    A file `SPEC.stl` with `--to c` is exported without a run: the monitor of streams in C99, with an example
    that reads CSV.
    """
    done = write(run, **options.given())

    def show() -> None:
        for line in done.remarks:
            say(visible(line))
        for name in done.files:
            emit(visible(str(done.folder / name)))

    return Answer(done, show)
