"""`stlc export`: a trained controller for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.options import (
    PythonOption,
    RunArgument,
    RunsOption,
    SetOption,
    SystemOption,
    parse_overrides,
)
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.escape import visible
from stlc.foreign import driving

if TYPE_CHECKING:
    from stlc.export.monitor import ExportedMonitor
    from stlc.export.write import Exported


@command(
    "stlc export latest --to c",
    "stlc export latest --to onnx -o controller",
    "stlc export latest --to onnx --precision float64",
    "stlc export latest --to torch",
    "stlc export specs/traffic.stl --to c -o monitor",
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
    single: Annotated[
        bool, typer.Option("--float", help="Numbers of a monitor in C: float, for targets without doubles.")
    ] = False,
    dt: Annotated[
        str | None,
        typer.Option("--dt", metavar="TIME", help="Time step of a monitor.", show_default="the system's"),
    ] = None,
    system: SystemOption = None,
    set_: SetOption = None,
    python: PythonOption = False,
    runs: RunsOption = Path("runs"),
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
    if to == "c" and run.endswith((".stl", ".stlc")):
        return _monitor(run, output or Path("export"), dt, system, parse_overrides(set_), single=single)
    if single or dt or system or set_:
        raise usage(
            "`--float`, `--dt`, `--system` and `--set` belong to a monitor", "stlc export SPEC.stl --to c"
        )
    from stlc.controller.run.run import Run
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


def _monitor(
    spec: str, folder: Path, dt: str | None, system: str | None, overrides: Mapping[str, str], *, single: bool
) -> Answer[ExportedMonitor]:
    from stlc.cli.check.options import time_step
    from stlc.export.monitor import export_monitor
    from stlc.files import find_spec, read_source
    from stlc.grammar.parser import parse
    from stlc.monitor.verdict import Monitor

    step = time_step("--dt", dt)
    parsed = parse(read_source(find_spec(spec)))
    done = export_monitor(Monitor(parsed, step, system=system, overrides=overrides), folder, single=single)

    def show() -> None:
        for name in done.files:
            emit(visible(str(folder / name)))
        say(f"the state takes {done.bytes:,} bytes")

    return Answer(done, show)
