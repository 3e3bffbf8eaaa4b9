"""`stlc certify`: statistical certificates of trained, guarded policies, and of plants and systems."""

from __future__ import annotations

import json as json_library
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.activity import PULSE
from stlc.cli.certify.text import GuardOption, bounds_lines, checked_share, floored, raised
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import (
    AgentsOption,
    DriveStepsOption,
    JobsOption,
    MarginOption,
    PlantOption,
    RequireOption,
    RunsOption,
    SetOption,
    TimeLimitOption,
    parse_limit,
    parse_overrides,
    parse_seeds,
)
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, RunError, usage
from stlc.escape import file_part, operand, shell, visible
from stlc.files import find_spec, of_run, read_source, write_atomic
from stlc.foreign import driving
from stlc.registry import GUARDS

if TYPE_CHECKING:
    from stlc.assurance.campaign import (
        Campaign,
        CertificateCheck,
        CertificateVerification,
        Difference,
        Progress,
        Subject,
    )
    from stlc.assurance.drives import PolicyDrives
    from stlc.cli.framework.assured import BoundedDraws, BoundedDrives

FILE = "eval/certificate.json"
DRAWN_FOLDER = "certificates"
DEFAULT_SHARE = 0.99
MOST_SHOWN = 5
"""Failed simulations that are printed."""


@dataclass(frozen=True, slots=True)
class Driving:
    """Options on how the policy is deployed."""

    guard: GuardOption = GUARDS.default
    time_limit: TimeLimitOption = None
    margin: MarginOption = None
    scenario: Annotated[str | None, typer.Option(metavar="NAME", help="A scenario of the system.")] = None
    steps: DriveStepsOption = None
    agents: AgentsOption = None


DRIVING = Driving()


@dataclass(frozen=True, slots=True)
class DrawnSubject:
    """Options on what is simulated instead of a policy."""

    plant: PlantOption = None
    system: Annotated[
        str | None,
        typer.Option(
            "--system", "-s", metavar="FILE", help="A system without controls, for a specification."
        ),
    ] = None
    jobs: JobsOption = 1


DRAWING = DrawnSubject()


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
    share: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", help="Share of drives to certify.", show_default=".99, unless --width is given"
        ),
    ] = None,
    confidence: Annotated[float, typer.Option(metavar="P", help="Confidence of each bound.")] = 0.95,
    width: Annotated[
        float | None,
        typer.Option(metavar="W", help="Drive until the interval of the share is as narrow as this."),
    ] = None,
    shift: Annotated[
        str | None,
        typer.Option(
            metavar="D",
            help="Total variation between the distribution of future drives and that of these.",
        ),
    ] = None,
    how: Driving = DRIVING,
    what: DrawnSubject = DRAWING,
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="SEEDS",
            help="Drive these seeds, such as 0..99, whatever they show.",
            show_default="fresh ones, as needed",
        ),
    ] = None,
    drives: Annotated[
        int,
        typer.Option(
            min=1,
            metavar="N",
            help="Independent drives or simulations at most; worlds, where agents share one.",
        ),
    ] = 1000,
    require: RequireOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File of the certificate.",
            show_default="eval/certificate.json of the run, or certificates/NAME.json",
        ),
    ] = None,
    verify: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Compare a certificate with what it names, or with what is given."),
    ] = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
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
    if verify is not None:
        with driving(False):
            return _verified(verify, run, what, runs)
    from stlc.assurance.campaign import Campaign
    from stlc.assurance.certificate import Claim
    from stlc.assurance.conformal import parse_shift

    wanted = share if share is not None or width is not None else DEFAULT_SHARE
    claim = Claim(
        None if wanted is None else checked_share("--share", wanted),
        checked_share("--confidence", confidence),
        0.0 if shift is None else parse_shift(shift),
        online=True,
    )
    if width is not None:
        checked_share("--width", width)
    fixed = None if seeds is None else parse_seeds(seeds)
    chosen = _Chosen(run, how, what, tuple(require or ()), parse_overrides(set_), runs)
    subject, home, shown = chosen.subject()
    order = Campaign(subject, claim, width, drives, fixed)
    result: Any = _observed(order, out or home)
    name = shown if out is None else str(out)

    def show() -> None:
        for line in _lines(result, name):
            emit(line)

    return Answer(result, show, _exit_code(result))


@dataclass(frozen=True, slots=True)
class _Chosen:
    """Subject of a certificate, as given on the command line."""

    name: str | None
    how: Driving
    what: DrawnSubject
    require: tuple[str, ...]
    overrides: Mapping[str, str]
    runs: Path

    def subject(self) -> tuple[Subject, Path, str]:
        """Return the subject, the path of its certificate, and this path as it is shown.

        Raises:
            UsageError: U101, an option does not suit what is certified.
        """
        what = self.what
        if what.plant is None and what.system is None:
            if what.jobs != 1:
                raise usage("`--jobs` is for plants", "stlc certify SPEC --plant FILE --jobs 2")
            drives = self._policy()
            return drives, drives.run.dir.place(FILE), f"{drives.run.dir.shown}/{FILE}"
        require_drawn(self.name, self.how, what)
        subject = self._plant() if what.plant is not None else self._system()
        record = subject.record(())
        parts = (file_part(str(record[key]), empty="certificate") for key in ("spec", "system"))
        path = Path(DRAWN_FOLDER, f"{'-on-'.join(parts)}.json")
        return subject, path, str(path)

    def _policy(self) -> PolicyDrives:
        """Drives of the policy of a run below the folder of runs."""
        from stlc.assurance.drives import PolicyDrives
        from stlc.controller.deployment.simulator import Setting
        from stlc.controller.evaluation.rules import rules_of
        from stlc.controller.guard.margins import parse_margins
        from stlc.controller.run.run import Run

        how = self.how
        mode = GUARDS.get(how.guard).name
        opened = Run.open(
            self.name or "latest", root=self.runs, overrides=self.overrides, scenario=how.scenario
        )
        test = opened.task.system.decl.test
        setting = Setting((), how.agents or test.agents, how.steps or test.steps, test.replan)
        if how.time_limit is not None:
            seconds = parse_limit(how.time_limit)
            setting = replace(setting, limit=seconds, paper_limit=seconds)
        margin = parse_margins(how.margin or ()).of(opened.task, opened.policy, mode, test.replan)
        setting = replace(setting, margin=margin)
        return PolicyDrives(opened, rules_of(opened), mode, setting, self.require, self.overrides)

    def _plant(self) -> Subject:
        from stlc.assurance.draws import PlantDraws
        from stlc.plants.judge import PlantJudge

        assert self.name is not None
        assert self.what.plant is not None
        judge = PlantJudge.load(self.name, self.what.plant, self.overrides)
        show_diagnostics(judge.monitor.compiled.warnings)
        return PlantDraws(judge, find_spec(self.name), self.require, self.overrides, self.what.jobs)

    def _system(self) -> Subject:
        from stlc.assurance.draws import ModelDraws
        from stlc.assurance.model_simulator import ModelSimulator

        assert self.name is not None
        simulator = ModelSimulator.load(self.name, self.what.system, self.overrides)
        return ModelDraws(simulator, find_spec(self.name), self.require, self.overrides)


def require_drawn(name: str | None, how: Driving, what: DrawnSubject) -> None:
    """Raise UsageError (U101) if an option does not suit the certificate of a plant or system."""
    option = "--plant" if what.plant is not None else "--system"
    if what.plant is not None and what.system is not None:
        raise usage("`--plant` and `--system` contradict each other")
    if name is None:
        raise usage(f"`{option}` needs a specification", f"stlc certify SPEC {option} FILE")
    if what.plant is None and what.jobs != 1:
        raise usage("`--jobs` is for plants", "stlc certify SPEC --plant FILE --jobs 2")
    for each in fields(Driving):
        if getattr(how, each.name) != each.default:
            raise usage(f"`--{each.name.replace('_', '-')}` is for a policy, and `{option}` has none")


def _observed(order: Campaign, path: Path) -> Mapping[str, Any]:
    """Observe, write the certificate after each batch, and return the last one."""
    from stlc.assurance.campaign import campaign, certificate
    from stlc.jsontext import dumps

    document: Any = None
    with closing(order.subject), PULSE.doing(order.subject.doing):
        for progress in campaign(order):
            document = certificate(order, progress)
            write_atomic(path, dumps(document, indent=2) + "\n")
            if not progress.done:
                say(_progress_text(progress))
    found: Mapping[str, Any] = document
    return found


def _progress_text(progress: Progress) -> str:
    found = progress.assessment.overall
    low, high = found.shares.lower, found.shares.upper
    return f"{found.units:,} {progress.assessment.noun}s: share from {floored(low)} to {raised(high)}"


def _exit_code(result: Mapping[str, Any]) -> int:
    """0 certified or as narrow as asked, 1 refuted, 4 undecided or too wide."""
    codes = {"certified": 0, "refuted": 1, "undecided": 4, "measured": 0}
    low, high = result["overall"]["interval"]
    wide = result["width"] is not None and float(high) - float(low) > result["width"]
    return codes[result["answer"]] or (4 if wide else 0)


def _lines(result: Mapping[str, Any], path: str) -> Iterator[str]:
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
    yield from (f"    - {_finding_text(each)}" for each in shown)
    if findings["count"] > len(shown):
        yield f"    - and {findings['count'] - len(shown):,} more"
    where = ("--plant", operand(result["system_file"]), "--seeds", str(shown[0]["seed"]))
    yield f"  again        {shell(('stlc', 'simulate', operand(result['spec_file']), *where))}"


def _finding_text(each: Mapping[str, Any]) -> str:
    at = "" if each["time"] is None else f" at t = {each['time']:.10g} s"
    return f"seed {each['seed']}: {each['reason']}{at}: {visible(each['message'])}"


# ------------------------------------------------------------------------- verification


def _verified(path: Path, name: str | None, what: DrawnSubject, runs: Path) -> Answer[CertificateCheck]:
    """Compare the certificate in a file with what it names, or with what is given instead."""
    from stlc.assurance.campaign import CertificateCheck

    document = _read(path)
    try:
        shown, found = _compared(document, name, what, runs)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, ArithmeticError) as error:
        raise _damaged(path, str(error) or type(error).__name__) from error
    result = CertificateCheck(str(path), shown, found)
    noun = str(document.get("kind", "run"))

    def show() -> None:
        for line in _compared_lines(result, str(document.get("made", "")), noun):
            emit(line)

    return Answer(result, show, int(not found.same))


def _compared(
    document: Mapping[str, Any], name: str | None, what: DrawnSubject, runs: Path
) -> tuple[str, CertificateVerification]:
    """Return what a certificate is compared with, as it is shown, and the comparison."""
    if "kind" in document:
        from stlc.assurance.draws import verify_draws

        given = str(what.plant) if what.plant is not None else what.system
        return given or str(document["system_file"]), verify_draws(document, name, given)
    from stlc.assurance.drives import verify
    from stlc.rundir import RunDir

    folder = RunDir.open(name or str(document["run"]), runs)
    return folder.shown, verify(document, folder)


def _compared_lines(result: CertificateCheck, made: str, noun: str) -> Iterator[str]:
    found = result.found
    for each in found.inputs:
        yield f"  {_difference(each)}"
    for name in found.numbers:
        yield f"  {visible(name)} does not follow from the counts"
    for each in found.software:
        yield f"  {_difference(each)} (software, only a remark)"
    changed = f"is not about this {noun} as it is now" if found.inputs else "has been changed"
    told = f"is about this {noun}" if found.same else changed
    yield f"the certificate of {visible(made)} {told}: {visible(result.run)}"


def _difference(each: Difference) -> str:
    return f"{visible(each.name)} differs: {_short(each.certificate)}, now {_short(each.present)}"


def _short(text: str) -> str:
    return visible(text if len(text) < 20 else text[:12])


def _read(path: Path) -> dict[str, Any]:
    """Content of a certificate file.

    Raises:
        UsageError: U102, the file does not exist.
        RunError: R108, it is no certificate; R110, it is in the folder of a run, and a link leads there.
    """
    from stlc.assurance.certificate import FORMAT

    source = read_source(of_run(path))
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
