"""`stlc export`: a trained controller for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.options import JsonOption, RunArgument, RunsOption
from stlc.cli.framework.output import emit, emit_json, say
from stlc.cli.framework.program import command
from stlc.escape import visible


@command(
    "stlc export latest --to c", "stlc export latest --to onnx -o controller", "stlc export latest --to torch"
)
def export(
    run: RunArgument = "latest",
    to: Annotated[str, typer.Option("--to", metavar="TARGET", help="torch, c or onnx.")] = "torch",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", "--out", metavar="DIR", help="By default in the run's folder."),
    ] = None,
    runs: RunsOption = Path("runs"),
    as_json: JsonOption = False,
) -> None:
    """Export a trained controller, monitor included.

    `torch` is a torch.export program: states in, plans and their robustness out. `c` is a C99 header that
    depends only on libm and includes the backup policy, with an example program. `onnx` are graphs for
    onnxruntime, run by `stlc.runtime` without torch, the backup policy included. Every export is checked
    against the run on random states.
    """
    from stlc.controller.training.run import Run
    from stlc.export.write import export as write
    from stlc.export.write import target_of

    target = target_of(to)
    opened = Run.open(run, root=runs)
    shown = output or Path(opened.dir.shown) / "export" / target
    done = write(opened, target, shown)
    found = done.agreement
    if as_json:
        checked = None if found is None else {"states": found.states, "plan": found.plan, "rho": found.rho}
        taken = done.latency
        latency = None if taken is None else {"median_ms": taken.median, "p99_ms": taken.p99}
        result = {"run": opened.dir.shown, "target": target, "folder": str(shown), "files": list(done.files)}
        emit_json("export/1", ok=True, exit_code=0, result={**result, "checked": checked, "latency": latency})
        return
    if found is None:
        say(f"not checked: {done.unchecked}")
    else:
        say(
            f"checked in {found.states} random states: plans within {found.plan:.1e} of a range, "
            f"robustness within {found.rho:.1e}"
        )
    if done.latency is not None:
        say(
            f"decides in {done.latency.median:.2f} ms, 99 % within {done.latency.p99:.2f} ms: "
            "one agent, one thread, stlc.runtime"
        )
    for name in done.files:
        emit(visible(str(shown / name)))
