"""`stlc certify`: statistical certificates of trained, guarded policies, and of plants and systems."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.assurance.options import CertifyOptions
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.output import Answer, emit
from stlc.cli.framework.program import command
from stlc.escape import operand, shell, visible
from stlc.jsontext import plain

if TYPE_CHECKING:
    from stlc.assurance.campaign import CertificateCheck, Difference
    from stlc.assurance.certificates import BoundedDraws, BoundedDrives

OPTIONS = CertifyOptions()
MOST_SHOWN = 5
"""Failed simulations that are printed."""


@command(
    "stlc certify latest --guard full",
    "stlc certify latest --guard full --share .999 --confidence .99 --drives 20000",
    "stlc certify latest --scenario mismatch-10 --width .02 --agents 1",
    "stlc certify fall.stl --plant ball.yaml --share .9",
    "stlc certify --verify runs/latest/eval/certificate.json",
    drives=True,
)
def certify(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN|SPEC",
            help="A run's folder, number, words, spec (its name or file), or latest; a specification with "
            "--plant or --system.",
            autocompletion=run_names,
        ),
    ] = None,
    options: CertifyOptions = OPTIONS,
) -> Answer[BoundedDrives | BoundedDraws | CertificateCheck]:
    """Certify that a share of all drives satisfies the requirements.

    The policy is deployed world by world until the share is certified or refuted with the given confidence,
    and a certificate is written. A drive is the closed-loop run of one agent in one simulated world. Drives
    of a world count as one observation, unless the world says that its agents are independent. Without
    --seeds, the bounds are betting bounds, which hold at any stopping time. With --seeds, all of them are
    driven, and the bounds are exact (Clopper-Pearson) where each observation is satisfied or not. With
    --plant or --system, the share is that of simulations whose start values, parameters and input signals are
    drawn as the file declares. A simulation that fails is not satisfied. Exit code: 0 certified, 1 refuted, 4
    undecided; with --verify 1 if something differs.
    """
    from stlc.assurance.campaign import CertificateCheck
    from stlc.assurance.certificates import certify as bounded

    found: Any = bounded(run, **options.given())
    if isinstance(found, CertificateCheck):
        lines, code = _compared_lines(found), int(not found.found.same)
    else:
        record: Any = plain(found)
        lines = _lines(record, found.shown)
        code = found.assessment.exit_code or (4 if found.wide else 0)
    return Answer(found, lambda: emit("\n".join(lines)), code)


def _lines(result: Mapping[str, Any], path: str) -> Iterator[str]:
    from stlc.cli.commands.certify.text import bounds_lines

    yield visible(_title(result))
    yield ""
    yield from bounds_lines(result)
    if "kind" in result:
        yield from _finding_lines(result)
    yield ""
    yield f"  certificate  {visible(path)}"
    yield f"  next         {shell(('stlc', 'certify', '--verify', operand(path)))}"


def _title(result: Mapping[str, Any]) -> str:
    from stlc.controller.guard.kind import named_guard

    overall = result["overall"]
    if "kind" in result:
        return f"{result['spec']} on {result['system']} · {overall['drives']:,} simulations"
    conditions = result["conditions"]
    scenario = [f"scenario {conditions['scenario']}"] if conditions["scenario"] else []
    agents, steps = conditions["agents"], conditions["steps"]
    per_seed = agents if result["unit"] == "world" else 1
    size = f"{overall['drives'] // per_seed} worlds x {agents} agent{'s' * (agents > 1)} x {steps} steps"
    if result["unit"] == "drive":
        size = f"{overall['drives']} drives x {steps} steps"
    title = named_guard(conditions["guard"]).title
    return " · ".join((result["spec"], f"run {Path(result['run']).name}", title, *scenario, size))


def _finding_lines(result: Mapping[str, Any]) -> Iterator[str]:
    findings = result["findings"]
    shown = findings["first"][:MOST_SHOWN]
    if not shown:
        return
    yield f"  {findings['count']:,} simulation{'s' * (findings['count'] > 1)} failed:"
    for each in shown:
        at = "" if each["time"] is None else f" at t = {each['time']:.10g} s"
        yield f"    - seed {each['seed']}: {each['reason']}{at}: {visible(each['message'])}"
    if findings["count"] > len(shown):
        yield f"    - and {findings['count'] - len(shown):,} more"
    where = ("--plant", operand(result["system_file"]), "--seeds", str(shown[0]["seed"]))
    yield f"  again        {shell(('stlc', 'simulate', operand(result['spec_file']), *where))}"


def _compared_lines(result: CertificateCheck) -> Iterator[str]:
    found, stored = result.found, result.stored
    noun = stored.kind or "run"
    for each in found.inputs:
        yield f"  {_difference(each)}"
    for name in found.numbers:
        yield f"  {visible(name)} does not follow from the counts"
    for each in found.software:
        yield f"  {_difference(each)} (software, only a remark)"
    changed = f"is not about this {noun} as it is now" if found.inputs else "has been changed"
    told = f"is about this {noun}" if found.same else changed
    yield f"the certificate of {visible(stored.made)} {told}: {visible(result.run)}"


def _difference(each: Difference) -> str:
    return f"{visible(each.name)} differs: {_short(each.certificate)}, now {_short(each.present)}"


def _short(text: str) -> str:
    return visible(text if len(text) < 20 else text[:12])
