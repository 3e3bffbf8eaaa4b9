"""`stlc plot`: what was recorded, and the robustness of each requirement beneath it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.options import JsonOption, SystemOption, describe
from stlc.cli.output import emit, emit_json, say
from stlc.diagnostics import Diagnostic, StlcError, UsageError

if TYPE_CHECKING:
    from stlc.monitor.verdict import Monitor
    from stlc.trace import Trace
    from stlc.view.signals import Choice, Margins

_FORMATS = (".svg", ".png", ".pdf")


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Draw the signals of a trace, and the robustness of each requirement beneath them.",
            "stlc plot trace.npz",
            "stlc plot latest --require give_way -o give_way.svg",
            note="A run stands for the trace in its folder. The worst and a typical trace are shown unless "
            "--trace names one. The suffix of -o says what is written: .svg, .png or .pdf.",
        )
    )(plot)


def plot(
    what: Annotated[str, typer.Argument(metavar="TRACE|RUN", help="A trace, or a run with one.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="By default beside the trace, .svg.")
    ] = None,
    require: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="This requirement only; repeatable.")
    ] = None,
    trace: Annotated[int | None, typer.Option(min=0, metavar="K", help="Trace number K of the file.")] = None,
    spec: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The specification, instead of the trace's own.")
    ] = None,
    system: SystemOption = None,
    runs: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("runs"),
    as_json: JsonOption = False,
) -> None:
    """Draw a trace and print where the picture is."""
    from stlc.trace import load_trace
    from stlc.view import require_drawing
    from stlc.view.signals import draw_signals

    require_drawing()
    path = _find(what, runs)
    target = _target(output, path)
    recorded = load_trace(path)
    monitor = _monitor(recorded, spec, system)
    margins = _margins(monitor, recorded, require or [])
    choices = _choices(recorded, margins, trace)
    picture = draw_signals(recorded, margins, choices)
    _save(picture, target)
    if as_json:
        result = {"trace": str(path), "picture": str(target), "shown": [choice.index for choice in choices]}
        emit_json("plot/1", ok=True, exit_code=0, result=result)
        return
    say(f"trace {path}")
    emit(str(target))


def _find(what: str, runs: Path) -> Path:
    """The trace called `what`, or that of the run called `what`."""
    from stlc.files import find_trace
    from stlc.rundir import RunDir

    try:
        if not Path(what).is_dir():
            return find_trace(what, runs)
    except UsageError as missing:
        try:
            folder = RunDir.open(what, runs)
        except StlcError:
            raise missing from None
    else:
        folder = RunDir.open(what, runs)
    path = folder.path / "trace.npz"
    if not path.is_file():
        advice = (f"record one: stlc simulate {folder.name}",)
        raise UsageError(Diagnostic("U102", f"`{folder.shown}` has no trace", help=advice))
    return Path(folder.shown) / "trace.npz"


def _target(output: Path | None, trace: Path) -> Path:
    target = output or trace.with_suffix(".svg")
    if target.suffix not in _FORMATS:
        raise UsageError(
            Diagnostic(
                "U101", f"`{target}` is no picture", help=(f"its suffix is one of {' '.join(_FORMATS)}",)
            )
        )
    return target


def _monitor(trace: Trace, spec: Path | None, system: str | None) -> Monitor:
    from stlc.files import read_source
    from stlc.grammar.parser import parse
    from stlc.monitor.verdict import Monitor
    from stlc.source import Source

    meta = trace.meta
    if spec is not None:
        return Monitor(parse(read_source(spec)), system=system)
    if not meta.spec_text:
        advice = (f"stlc plot {trace.name} --spec SPEC",)
        raise UsageError(Diagnostic("U101", f"`{trace.name}` carries no specification", help=advice))
    name = meta.spec_path or f"{meta.spec_name or 'specification'} in {trace.name}"
    return Monitor(
        replace(parse(Source(name, meta.spec_text)), library=meta.spec_library or None), system=system
    )


def _margins(monitor: Monitor, trace: Trace, wanted: list[str]) -> Margins:
    """Requirement -> robustness at every sample, (traces, samples)."""
    import numpy as np

    from stlc.monitor.judgement import unknown_requirement

    for name in wanted:
        if name not in monitor.requirements:
            raise unknown_requirement(name, list(monitor.requirements))
    found = monitor.requirement_robustness(trace)
    return {name: np.atleast_2d(rho) for name, rho in found.items() if not wanted or name in wanted}


def _choices(trace: Trace, margins: Margins, wanted: int | None) -> tuple[Choice, ...]:
    import numpy as np

    from stlc.view.driven import trace_names
    from stlc.view.signals import Choice, choose_traces

    names = trace_names(trace)
    if wanted is not None:
        if wanted >= len(names):
            last = len(names) - 1
            raise UsageError(
                Diagnostic("U101", f"there is no trace {wanted}", help=(f"they go from 0 to {last}",))
            )
        return (Choice(wanted, names[wanted]),)
    per_trace = [np.nanmin(np.where(np.isnan(rho), np.inf, rho), axis=1) for rho in margins.values()]
    least = np.min(per_trace, axis=0) if per_trace else np.zeros(len(names))
    return choose_traces(np.where(np.isfinite(least), least, np.nan), names)


def _save(picture: object, target: Path) -> None:
    from stlc.files import atomic_path, write_atomic
    from stlc.view.style import Picture, look

    assert isinstance(picture, Picture)
    match target.suffix:
        case ".svg":
            write_atomic(target, picture.svg())
        case ".png":
            picture.save_png(target)
        case _:
            with look(), atomic_path(target) as beside:
                picture.figure.savefig(beside, format="pdf")
