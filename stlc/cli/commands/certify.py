"""`stlc certify`: statistical certificates of trained, guarded policies."""

from __future__ import annotations

import json as json_library
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.certify.text import bounds_lines, checked_share, floored, raised
from stlc.cli.framework.assured import Certificate, CertificateCheck, DifferentEntry
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import (
    DriveStepsOption,
    MarginOption,
    RequireOption,
    RunsOption,
    SetOption,
    TimeLimitOption,
    parse_limit,
    parse_overrides,
    parse_seeds,
)
from stlc.cli.framework.output import PULSE, Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, RunError, usage
from stlc.escape import operand, shell, visible
from stlc.files import read_source, write_atomic

if TYPE_CHECKING:
    from stlc.assurance.drives import Campaign, Progress
    from stlc.controller.guard.candidates import Mode

GUARDS: tuple[Mode, ...] = ("none", "paper", "full")
FILE = "eval/certificate.json"
DEFAULT_SHARE = 0.99


@dataclass(frozen=True, slots=True)
class Driving:
    """Options on how the policy is deployed."""

    guard: Annotated[str, typer.Option(metavar="none|paper|full", help="Guard of the policy.")] = "none"
    time_limit: TimeLimitOption = None
    margin: MarginOption = None
    scenario: Annotated[str | None, typer.Option(metavar="NAME", help="A scenario of the system.")] = None
    steps: DriveStepsOption = None
    agents: Annotated[
        int | None, typer.Option(min=1, help="Agents in each world; by default the system's.")
    ] = None


DRIVING = Driving()


@command(
    "stlc certify latest --guard full",
    "stlc certify latest --guard full --share .999 --confidence .99 --max-drives 20000",
    "stlc certify latest --scenario mismatch-10 --width .02 --agents 1",
    "stlc certify --verify runs/latest/eval/certificate.json",
)
def certify(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN",
            help="A run's folder, number, words, spec (its name or file), or latest.",
            autocompletion=run_names,
        ),
    ] = None,
    share: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Share of drives to certify; .99 unless --width is given."),
    ] = None,
    confidence: Annotated[float, typer.Option(metavar="P", help="Confidence of each bound.")] = 0.95,
    width: Annotated[
        float | None,
        typer.Option(metavar="W", help="Drive until the interval of the share is as narrow as this."),
    ] = None,
    shift: Annotated[
        str | None,
        typer.Option(
            metavar="[tv|kl|chi2=]D",
            help="Distance of the distribution of future drives from that of these; total variation.",
        ),
    ] = None,
    how: Driving = DRIVING,
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="SEEDS",
            help="Drive these seeds, such as 0..99, whatever they show; fresh ones as needed if not given.",
        ),
    ] = None,
    max_drives: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Independent drives at most: worlds, where agents share one."),
    ] = 1000,
    require: RequireOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File of the certificate; eval/certificate.json of the run."),
    ] = None,
    verify: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Compare a certificate with the run it names, or with RUN."),
    ] = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
) -> Answer[Certificate | CertificateCheck]:
    """Certify that a share of all drives satisfies the requirements.

    The policy is deployed world by world until the share is certified or refuted with the given confidence,
    and a certificate is written. A drive is the closed-loop run of one agent in one simulated world. Drives
    of a world count as one observation, unless the world says that its agents are independent. Without
    --seeds, the bounds are betting bounds, which hold at any stopping time. With --seeds, all of them are
    driven, and the bounds are exact (Clopper-Pearson) where each observation is satisfied or not. Exit code:
    0 certified, 1 refuted, 4 undecided; with --verify 1 if something differs.
    """
    if verify is not None:
        return _verified(verify, run, runs)
    from stlc.assurance.certificate import Claim
    from stlc.assurance.conformal import SAME, DistributionShift

    wanted = share if share is not None or width is not None else DEFAULT_SHARE
    claim = Claim(
        None if wanted is None else checked_share("--share", wanted),
        checked_share("--confidence", confidence),
        SAME if shift is None else DistributionShift.parse(shift),
        online=True,
    )
    if width is not None:
        checked_share("--width", width)
    overrides = parse_overrides(set_)
    order = _campaign(run or "latest", how, overrides, runs)
    fixed = None if seeds is None else parse_seeds(seeds)
    order = replace(
        order, claim=claim, require=tuple(require or ()), width=width, most=max_drives, seeds=fixed
    )
    path = out or order.run.dir.path / FILE
    result = _driven(order, path)
    shown = f"{order.run.dir.shown}/{FILE}" if out is None else str(out)

    def show() -> None:
        for line in _lines(result, shown):
            emit(line)

    return Answer(result, show, _exit_code(result))


def _campaign(name: str, how: Driving, overrides: Mapping[str, str], runs: Path) -> Campaign:
    """Deployment of the run called `name` below the folder `runs`; `overrides` are the values of `--set`."""
    from stlc.assurance.certificate import Claim
    from stlc.assurance.drives import Campaign
    from stlc.controller.deployment.simulator import Setting
    from stlc.controller.evaluation.rules import rules_of
    from stlc.controller.guard.margins import parse_margins
    from stlc.controller.training.run import Run

    modes = [mode for mode in GUARDS if mode == how.guard]
    if not modes:
        raise usage(f"there is no guard `{how.guard}`", "--guard none, paper or full")
    opened = Run.open(name, root=runs, overrides=overrides, scenario=how.scenario)
    test = opened.task.system.decl.test
    setting = Setting((), how.agents or test.agents, how.steps or test.steps, test.replan)
    if how.time_limit is not None:
        seconds = parse_limit(how.time_limit)
        setting = replace(setting, limit=seconds, paper_limit=seconds)
    margin = parse_margins(how.margin or ()).of(opened.task, opened.policy, modes[0], test.replan)
    setting = replace(setting, margin=margin)
    return Campaign(opened, rules_of(opened), modes[0], setting, Claim(), overrides=overrides)


def _driven(order: Campaign, path: Path) -> Certificate:
    """Deploy, write the certificate after each batch, and return the last one."""
    from stlc.assurance.drives import campaign, certificate
    from stlc.jsontext import dumps

    document: Any = None
    with PULSE.doing(f"driving, {order.guard}"):
        for progress in campaign(order):
            document = certificate(order, progress)
            write_atomic(path, dumps(document, indent=2) + "\n")
            if not progress.done:
                say(_progress_text(progress))
    made: Certificate = document
    return made


def _progress_text(progress: Progress) -> str:
    found = progress.assessment.overall
    low, high = found.shares.lower, found.shares.upper
    return f"{found.units:,} {progress.assessment.noun}s: share from {floored(low)} to {raised(high)}"


def _exit_code(result: Certificate) -> int:
    """0 certified or as narrow as asked, 1 refuted, 4 undecided or too wide."""
    codes = {"certified": 0, "refuted": 1, "undecided": 4, "measured": 0}
    low, high = result["overall"]["interval"]
    wide = result["width"] is not None and float(high) - float(low) > result["width"]
    return codes[result["answer"]] or (4 if wide else 0)


def _lines(result: Certificate, path: str) -> Iterator[str]:
    from stlc.view.words import guard_words

    conditions, overall = result["conditions"], result["overall"]
    scenario = [f"scenario {conditions['scenario']}"] if conditions["scenario"] else []
    agents, steps = conditions["agents"], conditions["steps"]
    per_seed = agents if result["unit"] == "world" else 1
    size = f"{overall['drives'] // per_seed} worlds x {agents} agent{'s' * (agents > 1)} x {steps} steps"
    if result["unit"] == "drive":
        size = f"{overall['drives']} drives x {steps} steps"
    title = guard_words(conditions["guard"]).title
    yield visible(" · ".join((result["spec"], f"run {Path(result['run']).name}", title, *scenario, size)))
    yield ""
    yield from bounds_lines(result)
    yield ""
    yield f"  certificate  {visible(path)}"
    yield f"  next         {shell(('stlc', 'certify', '--verify', operand(path)))}"


# ------------------------------------------------------------------------- verification


def _verified(path: Path, run: str | None, runs: Path) -> Answer[Certificate | CertificateCheck]:
    """Compare the certificate in a file with the run that it names, or with `run`."""
    from stlc.assurance.drives import verify
    from stlc.jsontext import plain
    from stlc.rundir import RunDir

    document = _read(path)
    try:
        folder = RunDir.open(run or str(document["run"]), runs)
        found = verify(document, folder)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, ArithmeticError) as error:
        raise _damaged(path, str(error) or type(error).__name__) from error
    fields: Any = plain(found)
    made: Any = {"file": str(path), "run": folder.shown, "same": found.same, **fields}
    result: CertificateCheck = made

    def show() -> None:
        for line in _compared(result, str(document.get("made", ""))):
            emit(line)

    return Answer(result, show, int(not found.same))


def _compared(result: CertificateCheck, made: str) -> Iterator[str]:
    for each in result["inputs"]:
        yield f"  {_difference(each)}"
    for name in result["numbers"]:
        yield f"  {visible(name)} does not follow from the counts"
    for each in result["software"]:
        yield f"  {_difference(each)} (software, only a remark)"
    changed = "is not about this run as it is now" if result["inputs"] else "has been changed"
    told = "is about this run" if result["same"] else changed
    yield f"the certificate of {visible(made)} {told}: {visible(result['run'])}"


def _difference(each: DifferentEntry) -> str:
    return f"{visible(each['name'])} differs: {_short(each['certificate'])}, now {_short(each['present'])}"


def _short(text: str) -> str:
    return visible(text if len(text) < 20 else text[:12])


def _read(path: Path) -> dict[str, Any]:
    """Content of a certificate file.

    Raises:
        UsageError: U102, the file does not exist.
        RunError: R108, it is no certificate.
    """
    from stlc.assurance.certificate import FORMAT

    source = read_source(path)
    try:
        document = json_library.loads(source.text)
    except (ValueError, RecursionError) as error:
        raise _damaged(path, str(error)) from error
    if not isinstance(document, dict) or document.get("certificate") != FORMAT:
        raise _damaged(path, f"it has no entry `certificate` with the value {FORMAT}")
    return document


def _damaged(path: Path, why: str) -> RunError:
    advice = "stlc certify RUN  writes one"
    return RunError(Diagnostic("R108", f"`{path}` is no certificate", note=(why[:200],), help=(advice,)))
