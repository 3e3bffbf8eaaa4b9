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
from typing import Any, ClassVar, Protocol

from stlc.assurance.certificate import (
    FORMAT,
    Assessment,
    Claim,
    Sample,
    assess,
    joined,
    wrong_numbers,
)
from stlc.diagnostics import usage
from stlc.jsontext import plain
from stlc.provenance import hardware, versions
from stlc.rundir import now

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

    def record(self, seeds: Sequence[int]) -> dict[str, Any]:
        """Entries of the certificate on the subject: its name, its inputs, and the conditions.

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
        assessment = assess(replace(joined(parts), left_out=left_out), claim)
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


def certificate(order: Campaign, progress: Progress) -> dict[str, Any]:
    """Content of a certificate file: answer, bounds, assumptions, and everything that they depend on."""
    bounds: Any = plain(progress.assessment)
    document = {
        "certificate": FORMAT,
        "made": now(),
        **order.subject.record(progress.seeds),
        **bounds,
        "width": order.width,
        "finished": progress.done,
        "batches": progress.batches,
        "versions": versions(*order.subject.packages),
        "hardware": hardware(),
    }
    found: Any = plain(document)
    result: dict[str, Any] = found
    return result


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
    """Comparison of the certificate in a file with a run, or with a plant or system, whose file is `run`."""

    JSON: ClassVar = (
        "file run same=found.same inputs=found.inputs numbers=found.numbers software=found.software"
    )

    file: str
    run: str
    found: CertificateVerification


def compared(
    document: Mapping[str, Any], inputs: Mapping[str, Any], packages: Sequence[str] = ()
) -> CertificateVerification:
    """Compare a certificate with the present inputs, and with the present versions of packages.

    Raises:
        KeyError, TypeError, ValueError: the document is no certificate.
    """
    return CertificateVerification(
        _different(document["inputs"], inputs),
        (*wrong_numbers(document), *_wrong_seeds(document)),
        _different(document["versions"], versions(*packages)),
    )


def _wrong_seeds(document: Mapping[str, Any]) -> tuple[str, ...]:
    """The entry of the seeds, if they do not give as many drives as a certificate counts or leaves out."""
    conditions, drives = document["conditions"], int(document["overall"]["drives"])
    seeds = sum(int(last) - int(first) + 1 for first, last in conditions["seeds"])
    expected = seeds if "kind" in document else seeds * int(conditions["agents"])
    left_out = int(document.get("left_out", 0))
    apart = all(int(a[1]) < int(b[0]) for a, b in pairwise([*conditions["seeds"]]))
    if "left_out" not in document and "kind" in document:  # certificates did not count them at first
        left_out = max(expected - drives, 0)
    given = apart and left_out >= 0 and drives + left_out == expected
    return () if given else ("conditions.seeds",)


def _different(then: Mapping[str, Any], present: Mapping[str, Any]) -> tuple[Difference, ...]:
    names = dict.fromkeys((*present, *then))
    pairs = ((str(name), str(then.get(name)), str(present.get(name))) for name in names)
    return tuple(Difference(*each) for each in pairs if each[1] != each[2])
