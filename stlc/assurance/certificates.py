"""Certificates of runs, plants and systems: records, files, and comparison with the present state."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from stlc.activity import PULSE
from stlc.assurance.bounds import floored, raised
from stlc.assurance.campaign import (
    Campaign,
    CertificateCheck,
    CertifiedDrives,
    Progress,
    StoredCertificate,
    campaign,
)
from stlc.assurance.certificate import FORMAT, Assessment, Claim
from stlc.assurance.draws import CertifiedDraws, ModelDraws, PlantDraws, verify_draws
from stlc.assurance.options import CertifyOptions
from stlc.diagnostics import RunError, notice, usage
from stlc.escape import file_part
from stlc.files import File
from stlc.foreign import driving
from stlc.jsontext import data_of, dumps, keys_below
from stlc.options import Options
from stlc.provenance import hardware, versions
from stlc.records import read
from stlc.registry import GUARDS
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from stlc.assurance.campaign import Subject
    from stlc.assurance.drives import PolicyDrives
    from stlc.controller.run.run import Run

FILE = "eval/certificate.json"
DRAWN_FOLDER = Path("certificates")
SHARE = 0.99
"""Share that is certified where neither one nor a width is asked for."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Certificate:
    """Bounds on future drives or simulations, and everything that they depend on.

    Attributes:
        subject: what was observed, and under which conditions.
        assessment: the bounds.
        width: width at which the observations were to end; None: they ended with an answer.
        finished: whether no further observations were to follow.
        batches: number of batches of observations.
        path: its file; None before it is written.
        shown: the file, as it is shown.
    """

    subject: Any
    assessment: Assessment
    width: float | None
    finished: bool
    batches: int
    path: Path | None = None
    shown: str = ""
    certificate: Literal["stlc-certificate/1"] = FORMAT
    made: str = field(default_factory=RunDir.now)
    versions: dict[str, str]
    hardware: dict[str, Any] = field(default_factory=hardware)

    def __repr__(self) -> str:
        found = self.assessment.overall
        low, high = found.interval
        return (
            f"{type(self).__name__}({self.assessment.answer}: {found.satisfied:,} of {found.drives:,}, "
            f"share from {low:.4g} to {high:.4g})"
        )

    @property
    def wide(self) -> bool:
        """True if the interval of the share is wider than asked for."""
        low, high = self.assessment.overall.interval
        return self.width is not None and high - low > self.width


_TAIL = f"{keys_below('assessment', Assessment)} width finished batches versions hardware"


@dataclass(frozen=True, kw_only=True, repr=False)
class BoundedDrives(Certificate):
    """Certificate of a trained, guarded policy."""

    JSON: ClassVar = f"certificate made {keys_below('subject', CertifiedDrives)} {_TAIL}"

    subject: CertifiedDrives


@dataclass(frozen=True, kw_only=True, repr=False)
class BoundedDraws(Certificate):
    """Certificate of a plant, or of a system without controls."""

    JSON: ClassVar = f"certificate made {keys_below('subject', CertifiedDraws)} {_TAIL}"

    subject: CertifiedDraws


@Options.taking(CertifyOptions)
def certify(run: Run | Path | str | None, options: CertifyOptions) -> Certificate | CertificateCheck:
    """Certify that a share of all drives, or simulations, satisfies the requirements.

    The policy is deployed world by world until the share is certified or refuted with the given confidence;
    the certificate is written after each batch. Without `seeds`, the bounds hold at any stopping time; with
    them, all are driven, and the bounds are exact where each observation is satisfied or not.

    Args:
        run: the run, or its folder, number, words, or `latest`; with `plant` or `system` a specification.
        options: fields of `stlc.assurance.options.CertifyOptions`; times are in seconds. With `verify`, the
            certificate in that file is compared with what it names, or with what is given.

    Raises:
        UsageError: U101, an option does not fit, or the assumptions hold in no observation.
        RunError: R108, the file of `verify` is no certificate.
        StlcError: a file is invalid.
    """
    name = None if run is None else str(run if isinstance(run, str | Path) else run.dir.path)
    if options.verify is not None:
        with driving(False):
            return _verified(options.verify, name, options)
    share, shift = options.share, options.shift or 0.0
    if share is None and options.width is None:
        share = SHARE
    for option, value in {"share": share, "confidence": options.confidence, "width": options.width}.items():
        if value is not None:
            Options.checked_share(f"--{option}", value)
    claim = Claim(share, options.confidence, shift, online=True)
    subject, home, shown = _subject(name, options)
    seeds = None if options.seeds is None else tuple(options.seeds)
    order = Campaign(subject, claim, options.width, options.drives, seeds)
    path, shown = (home, shown) if options.out is None else (options.out, str(options.out))
    with closing(subject), PULSE.doing(subject.doing):
        for progress in campaign(order):
            found = certificate(order, progress)
            File(path).write(dumps(found, indent=2) + "\n")
            if not progress.done:
                overall, noun = progress.assessment.overall, progress.assessment.noun
                low, high = overall.shares.lower, overall.shares.upper
                PULSE.tell(f"{overall.units:,} {noun}s: share from {floored(low)} to {raised(high)}")
    return replace(found, path=path, shown=shown)


def certificate(order: Campaign, progress: Progress) -> Certificate:
    """Certificate of the observations so far: answer, bounds, assumptions, and what they depend on."""
    subject = order.subject.record(progress.seeds)
    return (BoundedDraws if isinstance(subject, CertifiedDraws) else BoundedDrives)(
        subject=subject,
        assessment=progress.assessment,
        width=order.width,
        finished=progress.done,
        batches=progress.batches,
        versions=versions(*order.subject.packages),
    )


def _subject(name: str | None, options: CertifyOptions) -> tuple[Subject, Path, str]:
    """Return what is observed, the path of its certificate, and this path as it is shown.

    Raises:
        UsageError: U101, an option does not suit what is certified.
    """
    if options.plant is None and options.jobs != 1:
        raise usage("`--jobs` is for plants", "stlc certify SPEC --plant FILE --jobs 2")
    if options.plant is None and options.system is None:
        drives = _policy(name or "latest", options)
        return drives, drives.run.dir.place(FILE), f"{drives.run.dir.shown}/{FILE}"
    option = "--plant" if options.plant is not None else "--system"
    if options.plant is not None and options.system is not None:
        raise usage("`--plant` and `--system` contradict each other")
    if name is None:
        raise usage(f"`{option}` needs a specification", f"stlc certify SPEC {option} FILE")
    for unfit in ("guard", "time_limit", "margin", "scenario", "steps", "agents"):
        if getattr(options, unfit) != getattr(CertifyOptions(), unfit):
            raise usage(f"`--{unfit.replace('_', '-')}` is for a policy, and `{option}` has none")
    drawn: PlantDraws | ModelDraws
    require = tuple(options.require)
    if options.plant is not None:
        from stlc.assurance.plant_judge import PlantJudge

        judge = PlantJudge.load(name, options.plant, options.overrides)
        for warning in judge.monitor.compiled.warnings:
            notice(warning)
        drawn = PlantDraws(judge, File(name).spec(), require, options.overrides, options.jobs)
    else:
        from stlc.assurance.model_simulator import ModelSimulator

        simulator = ModelSimulator.load(name, options.system, options.overrides)
        drawn = ModelDraws(simulator, File(name).spec(), require, options.overrides)
    record = drawn.record(())
    parts = (file_part(part, empty="certificate") for part in (record.spec, record.system))
    path = DRAWN_FOLDER / f"{'-on-'.join(parts)}.json"
    return drawn, path, str(path)


def _policy(name: str, options: CertifyOptions) -> PolicyDrives:
    """Drives of the policy of a run."""
    from stlc.assurance.drives import PolicyDrives
    from stlc.controller.deployment.batched import Setting
    from stlc.controller.evaluation.rules import Rules
    from stlc.controller.guard.margins import parse_margins
    from stlc.controller.run.run import Run

    mode = GUARDS.get(options.guard).name
    opened = Run.open(name, root=options.runs, overrides=options.overrides, scenario=options.scenario)
    test = opened.task.system.decl.test
    setting = Setting((), options.agents or test.agents, options.steps or test.steps, test.replan)
    margin = parse_margins(options.margin).of(opened.task, opened.policy, mode, test.replan)
    setting = replace(setting.limited(options.time_limit), margin=margin)
    rules, require = Rules.of(opened), tuple(options.require)
    return PolicyDrives(opened, rules, mode, setting, require, options.overrides)


# ------------------------------------------------------------------------- comparison


def _verified(path: Path, name: str | None, options: CertifyOptions) -> CertificateCheck:
    """Compare the certificate in a file with what it names, or with what is given instead.

    Raises:
        UsageError: U102, the file does not exist.
        RunError: R108, it is no certificate; R110, it is in the folder of a run, and a link leads there.
    """
    text = File(File(path).of_run()).read().text
    try:
        stored: StoredCertificate = read(StoredCertificate, data_of(text))
        if stored.kind is None:
            from stlc.assurance.drives import verify

            folder = RunDir.open(name or stored.run, options.runs)
            return CertificateCheck(str(path), folder.shown, verify(stored, folder), stored)
        given = options.system if options.plant is None else str(options.plant)
        found = verify_draws(stored, name, given)
        return CertificateCheck(str(path), given or stored.system_file, found, stored)
    except (ValueError, ArithmeticError, RecursionError) as error:
        advice = "stlc certify RUN  writes one"
        why = str(error)[:200] or type(error).__name__
        raise RunError.of("R108", f"`{path}` is no certificate", note=(why,), help=(advice,)) from error
