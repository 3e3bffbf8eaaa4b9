"""Export by target: of the controller of a run, or of the monitor of a specification."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from stlc.diagnostics import usage
from stlc.files import File
from stlc.foreign import driving
from stlc.options import Option, Options
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from stlc.controller.run.run import Run
    from stlc.export.monitor import ExportedMonitor
    from stlc.export.write import Exported
    from stlc.grammar.spec import Spec


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions(Options):
    """Options of the export of a controller or of a monitor.

    Attributes:
        to (TARGET): torch, c or onnx.
        out (DIR): Folder of the files; by default export/ of the run.
        precision (TYPE): Numbers of ONNX graphs: float32, which every runtime has, or float64, exact; by
            default float32.
        single: Numbers of a monitor in C: float, for targets without doubles.
        dt: Time step of a monitor; by default the system's.
        at: Samples at which a monitor judges: all, or the number of one; by default those that requirements
            prescribe.
    """

    to: str = "torch"
    out: Annotated[Path | None, Option(flags=("--out", "-o"))] = None
    precision: str | None = None
    single: Annotated[bool, Option(flags=("--float",))] = False
    dt: Options.Seconds | None = None
    at: str | None = None
    system: Options.System = None
    overrides: Options.Overrides = field(default_factory=dict)
    python: Options.Python = False
    runs: Options.Runs = RunDir.RUNS


@Options.taking(ExportOptions)
def export(what: Run | Spec | Path | str, options: ExportOptions) -> Exported | ExportedMonitor:
    """Export the controller of a run, with its monitor, or the monitor of a specification as C.

    Args:
        what: a run, or its folder, number, words, or `latest`; with `to="c"` also a specification.
        options: fields of `ExportOptions`; `dt` is in seconds.

    Raises:
        UsageError: U101, an option does not fit the target, or what is exported has no such form.
        RunError: R105, the export disagrees with the run; nothing is written.
        MissingError: R301, the target needs packages that are not installed.
    """
    from stlc.grammar.spec import Spec

    to, out = options.to, options.out
    is_spec = isinstance(what, Spec) or File(str(what)).is_spec
    if to == "c" and is_spec:
        from stlc.export.monitor import export_monitor
        from stlc.monitor.verdict import Monitor

        spec = what if isinstance(what, Spec) else File(str(what)).spec()
        monitor = Monitor(spec, options.dt, system=options.system, overrides=options.overrides)
        at: Any = options.at
        if at is not None and at.isdecimal():
            at = int(at)
        elif at not in (None, "all"):
            raise usage(f"`--at {at}` is neither `all` nor the number of a sample")
        return export_monitor(monitor, out or Path("export"), at=at, single=options.single)
    if (
        options.single
        or options.dt
        or options.at
        or options.system
        or options.overrides
        or isinstance(what, Spec)
    ):
        advice = "stlc export SPEC.stl --to c"
        raise usage("`--float`, `--dt`, `--at`, `--system` and `--set` belong to a monitor", advice)
    from stlc.controller.run.run import Run
    from stlc.export.write import export as write
    from stlc.export.write import precision_of, target_of

    target = target_of(to)
    real = precision_of(options.precision or ("float32" if target == "onnx" else "float64"), target)
    with driving(options.python):
        run = what if isinstance(what, Run) else Run.open(what, root=options.runs)
        if out is None:
            run.dir.place(f"export/{target}/controller.json")  # no folder on the way is a link
        return write(run, target, out or Path(run.dir.shown) / "export" / target, real)
