"""`stlc export`: a trained controller for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.options import PythonOption, RunArgument, RunsOption
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.escape import visible
from stlc.foreign import driving

if TYPE_CHECKING:
    from stlc.export.write import Exported


@command(
    "stlc export latest --to c",
    "stlc export latest --to onnx -o controller",
    "stlc export latest --to onnx --precision float64",
    "stlc export latest --to torch",
)
def export(
    run: RunArgument = "latest",
    to: Annotated[str, typer.Option("--to", metavar="TARGET", help="torch, c or onnx.")] = "torch",
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Folder of the files.", show_default="export/ of the run"
        ),
    ] = None,
    precision: Annotated[
        str | None,
        typer.Option(
            metavar="TYPE",
            help="Numbers of ONNX graphs: float32, which every runtime has, or float64, exact.",
            show_default="float32",
        ),
    ] = None,
    python: PythonOption = False,
    runs: RunsOption = Path("runs"),
) -> Answer[Exported]:
    """Export a trained controller, monitor included.

    `torch` is a torch.export program that maps states to plans and their robustness. `c` is a C99 header with
    an example program. It depends only on libm, and includes the backup policy. `onnx` is a set of graphs for
    onnxruntime, which `stlc.runtime` runs without torch. It includes the backup policy, too. For random
    states, the results of every export are compared with those of the run. Files of an earlier export are
    replaced, but a different `main.c` or `Makefile` is kept.
    """
    from stlc.controller.training.run import Run
    from stlc.export.write import export as write
    from stlc.export.write import precision_of, target_of

    target = target_of(to)
    real = precision_of(precision or ("float32" if target == "onnx" else "float64"), target)
    with driving(python):
        opened = Run.open(run, root=runs)
        if output is None:
            opened.dir.place(f"export/{target}/controller.json")  # no folder on the way is a link
        shown = output or Path(opened.dir.shown) / "export" / target
        done = write(opened, target, shown, real)
    found, taken = done.agreement, done.latency

    def show() -> None:
        if found is None:
            say(f"not checked: {done.unchecked}")
        else:
            say(
                f"checked in {found.states} random states, the backup policy in {found.guarded}: "
                f"plans within {found.plan:.1e} of a range, robustness within {found.rho:.1e}"
                f"{'' if real == 'float64' else ', in float32'}"
            )
        if taken is not None:
            say(
                f"decides in {taken.median:.2f} ms, 99 % within {taken.p99:.2f} ms: "
                "one agent, one thread, stlc.runtime"
            )
        for name in done.files:
            emit(visible(str(shown / name)))
        for name in done.kept:
            say(f"kept {visible(str(shown / name))}, which was there and differs")

    return Answer(done, show)
