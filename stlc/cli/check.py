"""`stlc check`: recorded traces in, a verdict per requirement and its reasons out."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stlc.cli.options import JsonOption, SystemOption, describe
from stlc.cli.output import emit, emit_json, say, show_diagnostics, wants_color
from stlc.diagnostics import Diagnostic, UsageError
from stlc.files import read_source
from stlc.source import Source

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from stlc.cli.checked import Checked
    from stlc.monitor.instants import At
    from stlc.trace import Trace

_SPECS = (".stl", ".stlc")
_AT = re.compile(r"(?P<number>\d+(?:\.\d*)?|\.\d+)\s*(?P<unit>[a-zµ]*)")

End = Literal["open", "strict", "truncate"]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        "check",
        help=describe(
            "Judge recorded traces: a verdict per requirement, and the reason where one is violated.",
            "stlc check trace.npz",
            "stlc check specs/traffic.stl drive.csv --require give_way",
            note="A trace is looked up as given, then in the newest run. It carries its specification; a "
            "specification before it, or --spec, is taken instead. Exit code: 0 all satisfied, 1 violated, 4 "
            "a trace is too short to say.",
        ),
    )(check)


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked of every trace.

    Attributes:
        spec: path of a specification; None takes the one in the trace.
        system: of a system file.
        names: specification's name of a signal -> its name in the trace.
        require: names of the requirements; none means all.
        at: `0`, `all`, a sample or a time; None leaves it to the requirements.
        end: what to do where a trace is too short.
        tolerance: a robustness of at least minus this is satisfied.
    """

    spec: Path | None
    system: str | None
    names: dict[str, str]
    require: tuple[str, ...]
    at: str | None
    end: End
    tolerance: float


def check(
    files: Annotated[
        list[str], typer.Argument(metavar="[SPEC] TRACE…", help="Traces (.npz, .csv), after a specification.")
    ],
    spec: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The specification, instead of the trace's own.")
    ] = None,
    system: SystemOption = None,
    require: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Judge this requirement only; repeatable.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="0|all|K|TIME", help="Judge at this sample or time, or at all starts."),
    ] = None,
    end: Annotated[End, typer.Option(help="Too short a trace: bounds, an error, cut windows.")] = "open",
    tolerance: Annotated[
        float, typer.Option(help="Robustness from minus this on is satisfied; 0: `>` is not `>=`.")
    ] = 1e-6,
    map_: Annotated[
        list[str] | None, typer.Option("--map", metavar="SIGNAL=NAME", help="A signal's name in the trace.")
    ] = None,
    fail_under: Annotated[
        float | None, typer.Option(min=0, max=1, help="Exit 0 if this share of starts satisfies all.")
    ] = None,
    runs: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("runs"),
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing; the exit code answers.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Judge every trace, print the results and exit with the answer."""
    from stlc.cli.check_json import document
    from stlc.cli.check_text import describe_result
    from stlc.cli.checked import exit_code

    spec, traces = _split_files(files, spec)
    question = Question(spec, system, _names(map_), tuple(require or ()), at, end, _tolerance(tolerance))
    results = [_judge(name, question, runs, talk=not (quiet or json)) for name in traces]
    code = exit_code(results, fail_under)
    if json:
        warnings = [warning for result in results for warning in result.warnings]
        emit_json(
            "check/1", ok=code == 0, exit_code=code, diagnostics=warnings, result=document(results, end)
        )
    elif not quiet:
        emit("\n\n".join(describe_result(result, color=wants_color(sys.stdout)) for result in results))
    raise typer.Exit(code)


# ------------------------------------------------------------------------ arguments


def _split_files(files: Sequence[str], spec: Path | None) -> tuple[Path | None, list[str]]:
    """The specification, if one stands in front, and the traces."""
    specs = [name for name in files if Path(name).suffix in _SPECS]
    traces = [name for name in files if name not in specs]
    if len(specs) > 1 or (specs and spec is not None):
        raise _usage(f"more than one specification: {', '.join([*specs, *([str(spec)] if spec else [])])}")
    if not traces:
        raise _usage("which trace?", "stlc check SPEC TRACE")
    return (Path(specs[0]) if specs else spec), traces


def _usage(message: str, *advice: str) -> UsageError:
    return UsageError(Diagnostic("U101", message, help=advice))


def _names(pairs: Iterable[str] | None) -> dict[str, str]:
    names: dict[str, str] = {}
    for pair in pairs or ():
        signal, sign, name = (part.strip() for part in pair.partition("="))
        if not (signal and sign and name):
            raise _usage(f"`--map {pair}` is not of the form SIGNAL=NAME", "write it as --map v_lead=vlead")
        if signal in names:
            raise _usage(f"`--map {signal}=…` is given twice")
        names[signal] = name
    return names


def _tolerance(value: float) -> float:
    if not 0 <= value < math.inf:
        raise _usage(f"`--tolerance {value}` is not a number from 0 on")
    return value


def _at(text: str | None, trace: Trace) -> At:
    """A sample of `trace`; "all" and None as they are."""
    from stlc.units import parse_unit

    if text is None or text == "all":
        return "all" if text else None
    match = _AT.fullmatch(text.strip())
    help_ = "a sample (0, 46), a time (4.6s) or all"
    if match is None:
        raise _usage(f"`--at {text}` is not an instant", help_)
    if not match["unit"]:
        if not match["number"].isdigit():
            raise _usage(f"`--at {text}` is not a whole number of samples", help_)
        return int(match["number"])
    try:
        unit = parse_unit(match["unit"])
    except ValueError as error:
        raise _usage(f"`--at {text}`: {error}", help_) from None
    if unit.dims != parse_unit("s").dims:
        raise _usage(f"`--at {text}` is not a time", help_)
    steps = (float(match["number"]) * unit.scale - trace.t0) / trace.dt
    sample = round(steps)
    if abs(steps - sample) > 0.01 or not 0 <= sample < trace.samples:
        first, last = trace.t0, trace.t0 + (trace.samples - 1) * trace.dt
        raise _usage(
            f"`{trace.name}` has no sample at {text}",
            f"it runs from {first:g} s to {last:g} s every {trace.dt:g} s",
        )
    return sample


# -------------------------------------------------------------------------- judging


def _judge(name: str, question: Question, runs: Path, *, talk: bool) -> Checked:
    """Load, judge and explain one trace."""
    from stlc.cli.checked import Checked
    from stlc.files import find_trace
    from stlc.grammar.parser import parse
    from stlc.monitor.explain import explain
    from stlc.monitor.verdict import Monitor
    from stlc.trace import load_trace

    path = find_trace(name, runs)
    if path != Path(name):
        path = _below(path.resolve())
        if talk:
            say(f"taking {path}, of the newest run")
    trace = load_trace(path).renamed(question.names)
    source, note = _specification(trace, question.spec)
    monitor = Monitor(parse(source), system=question.system)
    if talk and note:
        say(note)
    verdict = monitor.check(
        trace,
        at=_at(question.at, trace),
        end=question.end,
        tolerance=question.tolerance,
        require=question.require,
    )
    causes = {judged.name: explain(verdict, judged.name) for judged in verdict}
    result = Checked(trace, source, verdict, {name: cause for name, cause in causes.items() if cause})
    if talk:
        show_diagnostics(result.warnings)
    return result


def _below(path: Path) -> Path:
    """Relative to the working folder where it is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _specification(trace: Trace, spec: Path | None) -> tuple[Source, str]:
    """The specification to judge by, and what is to be said about it."""
    if spec is not None:
        return read_source(spec), ""
    meta = trace.meta
    if not meta.spec_text:
        advice = (f"stlc check SPEC {trace.name}", f"stlc check {trace.name} --spec SPEC")
        raise _usage(f"`{trace.name}` carries no specification", *advice)
    source = Source(meta.spec_path or f"{meta.spec_name or 'specification'} in {trace.name}", meta.spec_text)
    if meta.spec_path and Path(meta.spec_path).is_file() and read_source(meta.spec_path).text != source.text:
        return source, (
            f"{meta.spec_path} has changed since; judging by the text in {trace.name} "
            f"(--spec {meta.spec_path} takes the new one)"
        )
    return source, ""
