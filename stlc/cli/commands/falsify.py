"""`stlc falsify`: a search for simulations that violate requirements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.assurance.options import FalsifyOptions
from stlc.cli.commands.check.many import INCONCLUSIVE
from stlc.cli.framework.output import Answer, emit, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, MissingError
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.assurance.falsified import (
        FalsifiedFinding,
        FalsifiedRequirement,
        FalsifiedSystem,
        ReplayedCounterexample,
        ReplayedFinding,
    )

OPTIONS = FalsifyOptions()
MOST_LINES = 5
"""Lines that a plant printed, and that are shown."""


@command(
    "stlc falsify specs/arch/transmission.stl --require AT1",
    "stlc falsify latest --guard paper --simulations 2000",
    "stlc falsify specs/arch/transmission.stl --replay counterexamples/AT1.json",
    drives=True,
)
def falsify(
    target: Annotated[
        str,
        typer.Argument(metavar="SPEC|RUN", help="A specification of a system without controls, or a run."),
    ] = "latest",
    options: FalsifyOptions = OPTIONS,
) -> Answer[FalsifiedSystem | ReplayedCounterexample | ReplayedFinding]:
    """Search for simulations that violate requirements.

    Of a system without controls, the search chooses initial states, parameters and input signals; of a run,
    the random numbers of the world in which its policy drives. Inputs that alternate between the ends of
    their ranges, or stay there, come first. Then models of the robustness choose most of the points, and
    random ones, gradients and periodic inputs take turns; the numbers of a world are changed where this has
    an effect. A violation counts only if it remains at half the time step. It is written as a trace,
    simplified as far as it still violates the requirement, with a file for --replay. If nothing is found,
    that is no proof. The same --seed and --batch give the same simulations, whatever processes there are. Of
    a plant, simulations that fail are written, too. A simulation that ends before a requirement can be judged
    is no evidence. Exit code: 1 if a requirement is violated or a simulation fails; else 5 if simulations
    were lost with their processes, three times each; else 4 if simulations ended before a verdict; else 0.
    """
    from stlc.assurance.falsification import falsify as search
    from stlc.assurance.falsified import FalsifiedSystem, ReplayedFinding

    found = search(target, **options.given())
    if isinstance(found, ReplayedFinding):
        return Answer(found, lambda: emit("\n".join(_again(found))), int(found.reason is not None))
    if not isinstance(found, FalsifiedSystem):
        excluded = " (`assume` or `where` excludes it)" if found.verdict == "out of scope" else ""
        same = "the trace is the same, bit for bit"
        if found.different:
            same = f"different: {', '.join(found.different)}"
        text = f"{found.requirement}: {found.verdict}{excluded}, robustness {found.margin:.6g}; {same}"
        codes = {"violated": 1, "inconclusive": INCONCLUSIVE}
        return Answer(found, lambda: emit(text), codes.get(found.verdict, 0))
    lost: tuple[Diagnostic, ...] = ()
    if found.lost:
        count = f"{found.lost:,} simulation{'s were' if found.lost != 1 else ' was'}"
        message = f"{count} lost with the processes that made them"
        lost = (Diagnostic("R406", message, note=found.reasons),)
    code = INCONCLUSIVE if any(each.search.inconclusive for each in found.requirements) else 0
    code = MissingError.exit_code if lost else code
    if found.failures or found.violated:
        code = 1

    def show() -> None:
        show_diagnostics(lost)
        failed = bool(found.failures)
        lines = (line for each in found.requirements for line in _of_requirement(each, failed=failed))
        emit("\n".join((*lines, *_finding_lines(found.findings))))

    return Answer(found, show, code, lost)


def _again(found: ReplayedFinding) -> Iterator[str]:
    if found.reason is None:
        yield f"the simulation gives a trace; before: {visible(found.stored_reason)}"
        return
    before = "as before" if found.identical else f"before: {visible(found.stored_reason)}"
    yield f"the simulation fails, {before}; {_told(found.reason, found.time, found.message or '')}"
    yield from (f"  | {visible(line)}" for line in found.stderr.splitlines()[-MOST_LINES:])


def _of_requirement(each: FalsifiedRequirement, *, failed: bool) -> list[str]:
    """Lines about a requirement; `failed`: whether there are simulations without a trace."""
    from stlc.view.words import share

    search = each.search
    name, found, lost = search.requirement, search.found, len(search.spurious)
    spurious = f"; {lost} violations vanish at half the time step" if lost else ""
    if found is None:
        judged, least = search.simulations - search.inconclusive, search.least
        ended = "failed, or ended before a verdict" if failed else "ended before a verdict"
        told = [f"  {search.inconclusive:,} simulations {ended}: no evidence"] if search.inconclusive else []
        if not judged:
            return [f"{name}: inconclusive{spurious}", *told]
        return [
            f"{name}: no violation in {judged:,} simulations, least robustness {least:.4g}{spurious}",
            f"  pairwise coverage of the search space {share(search.coverage)}; this is no proof",
            *told,
        ]
    half = "" if found.half_step is None else f", {found.half_step:.4g} at half the time step"
    half = half.replace("nan at", "but no verdict at")
    lines = [
        f"{name}: violated, robustness {found.margin:.4g}{half}; simulation "
        f"{found.simulation:,}, {found.strategy}{spurious}"
    ]
    simpler = search.shrunk
    if simpler is not None and simpler.margin != found.margin:
        lines.append(f"  simpler: robustness {simpler.margin:.4g}")
    kept = each.trace_margin
    if kept is not None and kept != (simpler or found).margin:
        lines += [
            f"  the plant does not repeat itself: simulated again for the trace, {kept:.4g}",
            "  (`limit: {fresh: true}` starts a process per simulation; seed random numbers in `reset`)",
        ]
    return [*lines, f"  {each.replay}"]


def _finding_lines(records: Sequence[FalsifiedFinding]) -> Iterator[str]:
    """Lines of text that show failed simulations."""
    for each in records:
        count, finding = each.simulations, each.finding
        times = f"{count:,} simulations failed" if count > 1 else "a simulation failed"
        yield f"{times}, {_told(finding.reason, finding.time, finding.message)}"
        values = ", ".join(f"{visible(name)}={value:.6g}" for name, value in finding.point.items())
        if values:
            yield f"  at {values}"
        yield from (f"  | {visible(line)}" for line in finding.stderr.splitlines()[-MOST_LINES:])
        yield f"  {each.replay}"


def _told(reason: str, time: float | None, message: str) -> str:
    at = "" if time is None else f" at t = {time:.10g} s"
    return f"{reason}{at}: {visible(message)}"
