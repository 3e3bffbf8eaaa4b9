"""Campaigns: observations in batches until a claim is decided, and the certificate of the answer.

The subject of a campaign is a trained policy in its world (`stlc.assurance.drives`), or a plant or system
that is simulated as its file declares (`stlc.assurance.draws`). The certificate names everything that the
observations depend on by hashes and versions, so that it can be compared with the present state later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Protocol

from stlc.assurance.certificate import Assessment, Claim, Sample, StoredStatement, joined, wrong_numbers
from stlc.assurance.conformal import parse_shift
from stlc.diagnostics import usage
from stlc.jsontext import Count
from stlc.provenance import versions
from stlc.registry import GUARDS

SEED = 1 << 41
"""First seed of certificates; those of `simulate` begin at 0, those after a training at 2^40."""
FIRST = 100
"""Number of units in the first batch; the first one with units in scope calibrates the conformal bounds."""
BATCH = 50
"""Number of units in each further batch."""


class Subject(Protocol):
    """Subject of a certificate: what is observed, and what the observations depend on."""

    @property
    def doing(self) -> str:
        """Verb of an observation in progress, such as `simulating`."""

    @property
    def per_seed(self) -> int:
        """Number of independent units that a seed gives, at most."""

    @property
    def packages(self) -> Sequence[str]:
        """Packages that observations depend on, beside those of `stlc.provenance.versions`."""

    @property
    def assumptions(self) -> Sequence[str]:
        """Conditions in words under which the bounds hold, beside those of every certificate."""

    def observed(self, seeds: Sequence[int]) -> Iterable[Sample]:
        """Observe the units of `seeds`, and yield the judged ones."""

    def record(self, seeds: Sequence[int]) -> Any:
        """Record of the subject in the certificate: its name, its inputs, and the conditions.

        `seeds` are those observed so far.
        """

    def close(self) -> None:
        """End the processes of the subject."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """Sequential observation of a subject, as requested.

    Attributes:
        subject: what is observed.
        claim: the share to certify, and the confidence.
        width: the campaign stops once the confidence interval of the share is no wider than this; None: it
            stops once the claim is decided.
        most: largest number of independent observations (drives, worlds or simulations).
        seeds: seeds fixed in advance, which are all observed; None: seeds from `SEED` on, as many as needed.
    """

    subject: Subject
    claim: Claim
    width: float | None = None
    most: int = 1000
    seeds: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a campaign after a batch.

    Attributes:
        assessment: what the observations so far say.
        seeds: seeds so far.
        batches: number of batches so far.
        done: whether no further batch follows.
    """

    assessment: Assessment
    seeds: tuple[int, ...]
    batches: int
    done: bool


def campaign(order: Campaign) -> Iterator[Progress]:
    """Observe batch by batch, and yield what is known after each.

    Without fixed seeds, the campaign stops once the claim is answered, or the interval is as narrow as asked,
    or there are `order.most` units; only bounds that are valid at any stopping time are then used.

    Raises:
        UsageError: U101, the assumptions of the specification hold in no observation.
        StlcError: the errors of the subject.
    """
    fixed, each = order.seeds is not None, order.subject.per_seed
    first = min(FIRST, order.most)
    claim = replace(
        order.claim,
        any_time=not fixed,
        calibration=None,
        further=tuple(order.subject.assumptions),
    )
    every = order.seeds or tuple(range(SEED, SEED + max(1, order.most // each)))
    parts: list[Sample] = []
    known, batches, left_out = 0, 0, 0
    while known < len(every):
        count = len(every) if fixed else math.ceil((BATCH if known else first) / each)
        seeds = every[known : known + count]
        for part in order.subject.observed(seeds):
            left_out += part.left_out
            parts += [part] if part.drives else []
        known, batches = known + len(seeds), batches + 1
        if not parts:
            continue
        if not fixed and claim.calibration is None:  # the same units, however many follow
            claim = replace(claim, calibration=min(first, sum(part.count for part in parts)))
        assessment = replace(joined(parts), left_out=left_out).assess(claim)
        if order.width is None:
            answered = assessment.answer in ("certified", "refuted")
        else:
            answered = assessment.width <= order.width
        done = known == len(every) or answered
        yield Progress(assessment, every[:known], batches, done)
        if done:
            return
    raise usage(f"the assumptions of the specification hold in none of {known:,} simulations")


# ---------------------------------------------------------------------- certificates


@dataclass(frozen=True, slots=True)
class CertifiedInputs:
    """Hashes and versions of everything that the drives of a run depend on, beside their conditions.

    Attributes:
        spec: the specification, with imports and the changes of the training.
        system: the system file, with these changes.
        functions: files that the system file names.
        rules: the specification of drives with its imports and changes; None if there is none.
        world: the file of the world; None for the model.
        policy: the checkpoint and the options of the method.
        guard_version: raised with every change of the guard's decisions.
    """

    spec: str
    system: str
    functions: str
    rules: str | None
    world: str | None
    policy: str
    guard_version: int


@dataclass(frozen=True, slots=True)
class CertifiedConditions:
    """Options of the deployment; seeds are ranges [first, last]."""

    guard: Annotated[str, lambda: GUARDS.installed]
    scenario: str | None
    overrides: Mapping[str, str]
    require: Sequence[str]
    margin: Mapping[str, float]
    time_limit: float | None
    agents: Count
    steps: Count
    replan: Count
    seeds: Sequence[Sequence[int]]


@dataclass(frozen=True, slots=True)
class CertifiedDrives:
    """Run of a certificate, and how its policy was deployed."""

    run: str
    spec: str
    system: str
    inputs: CertifiedInputs
    conditions: CertifiedConditions


@dataclass(frozen=True, slots=True)
class StoredConditions:
    """Conditions in a certificate, as far as they are read; those of a policy have a guard."""

    seeds: list[tuple[int, int]]
    overrides: dict[str, str]
    guard: str = ""
    scenario: str | None = None
    agents: Annotated[int, 1] = 1


@dataclass(frozen=True, slots=True)
class StoredCertificate:
    """File of a certificate, as far as it is read."""

    certificate: Literal["stlc-certificate/1"]
    answer: str
    confidence: float
    sequential: bool
    overall: StoredStatement
    requirements: list[StoredStatement]
    inputs: dict[str, str | int | None]
    versions: dict[str, str]
    conditions: StoredConditions
    made: str = ""
    kind: Literal["plant", "system"] | None = None
    run: str = ""
    spec_file: str = ""
    system_file: str = ""
    share: float | None = None
    shift: str | None = None
    left_out: Annotated[int, 0] | None = None


def seed_ranges(seeds: Sequence[int]) -> list[list[int]]:
    """Seeds as ranges [first, last], in order."""
    found: list[list[int]] = []
    for seed in seeds:
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return found


@dataclass(frozen=True, slots=True)
class Difference:
    """An entry of a certificate that differs now."""

    name: str
    certificate: str
    present: str


@dataclass(frozen=True, slots=True)
class CertificateVerification:
    """Comparison of a certificate with the present state of what it is about.

    Attributes:
        inputs: hashes and versions of inputs that differ; the certificate is then not about the present ones.
        numbers: bounds that do not follow from the counts in the certificate.
        software: versions of packages that differ.
    """

    inputs: tuple[Difference, ...]
    numbers: tuple[str, ...]
    software: tuple[Difference, ...]

    @property
    def same(self) -> bool:
        """True if the certificate is about the present inputs, and its numbers are consistent."""
        return not self.inputs and not self.numbers


@dataclass(frozen=True, slots=True)
class CertificateCheck:
    """Comparison of a stored certificate with a run, or with a plant or system, whose file is `run`."""

    JSON: ClassVar = (
        "file run same=found.same inputs=found.inputs numbers=found.numbers software=found.software"
    )

    file: str
    run: str
    found: CertificateVerification
    stored: StoredCertificate

    def __repr__(self) -> str:
        return f"CertificateCheck({self.file}: {'the same' if self.found.same else 'differs'}, {self.run})"


def compared(
    stored: StoredCertificate, inputs: Mapping[str, Any], packages: Sequence[str] = ()
) -> CertificateVerification:
    """Compare a certificate with the present inputs, and with the present versions of packages.

    Raises:
        ValueError: its numbers are no counts of drives.
    """
    claim = Claim(
        stored.share,
        stored.confidence,
        0.0 if stored.shift is None else parse_shift(stored.shift),
        stored.sequential,
    )
    return CertificateVerification(
        _different(stored.inputs, inputs),
        (*wrong_numbers(stored.overall, stored.requirements, claim, stored.answer), *_wrong_seeds(stored)),
        _different(stored.versions, versions(*packages)),
    )


def _wrong_seeds(stored: StoredCertificate) -> tuple[str, ...]:
    """The entry of the seeds, if they do not give as many drives as a certificate counts or leaves out."""
    ranges, drives = stored.conditions.seeds, stored.overall.drives
    expected = sum(last - first + 1 for first, last in ranges) * stored.conditions.agents
    left_out = stored.left_out or 0
    if stored.left_out is None and stored.kind is not None:  # certificates did not count them at first
        left_out = max(expected - drives, 0)
    apart = all(one[1] < other[0] for one, other in pairwise(ranges))
    return () if apart and drives + left_out == expected else ("conditions.seeds",)


def _different(then: Mapping[str, Any], present: Mapping[str, Any]) -> tuple[Difference, ...]:
    names = dict.fromkeys((*present, *then))
    pairs = ((str(name), str(then.get(name)), str(present.get(name))) for name in names)
    return tuple(Difference(*each) for each in pairs if each[1] != each[2])
