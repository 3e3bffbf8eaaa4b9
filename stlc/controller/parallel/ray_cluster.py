"""Training runs as tasks of a Ray cluster (`pip install 'stlc[cluster]'`): sent, awaited, brought back."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from stlc.controller.parallel.bundle import JobBundle, bring_home, carry, wrap
from stlc.controller.parallel.jobs import Job, JobResult
from stlc.diagnostics import Diagnostic, MissingError

LOST = -signal.SIGKILL
"""Code of an errand whose worker is gone."""

_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
_PATIENCE = 60.0
"""Seconds that interrupted trainings have to save."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where errands are sent, and what each asks for.

    Attributes:
        address: of a cluster; `auto` for the one that this machine belongs to, `local` for this machine.
        cores: processors of an errand.
        gpus: graphics processors of an errand.
    """

    address: str
    cores: int = 1
    gpus: int = 0


def on_cluster(
    errands: Sequence[Job], cluster: Cluster, *, begun: Callable[[Job], None] = lambda _: None
) -> Iterator[JobResult]:
    """Run errands on a cluster, as many at a time as it has processors for, and give each as it ends.

    When the caller is interrupted, or wants no more, every errand is asked to save and stop, and what it
    saved is brought back.

    Args:
        errands: what to run; each must name the folder of its runs.
        cluster: where.
        begun: called as each is sent.

    Raises:
        MissingError: R301, Ray is not installed; R302, there is no such cluster.
    """
    ray = _connected(cluster.address)
    going: dict[Any, tuple[Job, JobBundle]] = {}
    try:
        task = ray.remote(carry).options(num_cpus=cluster.cores, num_gpus=cluster.gpus, max_retries=0)
        for errand in errands:
            parcel = wrap(errand, cluster.cores)
            going[task.remote(parcel)] = (errand, parcel)
            begun(errand)
        while going:
            (done, *_), _ = ray.wait(list(going))
            yield _received(ray, done, *going.pop(done))
    except BaseException:
        _call_back(ray, going)
        raise
    finally:
        for _, parcel in going.values():
            parcel.close()
        ray.shutdown()


def _connected(address: str) -> Any:
    """The module `ray`, connected."""
    os.environ.update({key: value for key, value in _QUIET.items() if key not in os.environ})
    try:
        ray = import_module("ray")
    except ModuleNotFoundError:
        message = "`--cluster` needs ray, which is not installed"
        raise MissingError(Diagnostic("R301", message, help=("pip install 'stlc[cluster]'",))) from None
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error", ignore_reinit_error=True)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        reason = str(error).strip().splitlines()[:1]
        raise MissingError(
            Diagnostic(
                "R302",
                f"there is no cluster at `{address}`",
                note=tuple(reason),
                help=("`ray start --head` begins one", "`--cluster local` is one of this machine alone"),
            )
        ) from error
    return ray


def _received(ray: Any, done: Any, errand: Job, parcel: JobBundle) -> JobResult:
    """What came of an errand, with its run among those of the caller."""
    try:
        delivery = ray.get(done)
    except ray.exceptions.RayError as error:
        said = str(error).strip().splitlines()[-1:]
        return JobResult(errand, LOST, None, "".join(said), 0)
    finally:
        parcel.close()
    return bring_home(errand, parcel, delivery)


def _call_back(ray: Any, going: dict[Any, tuple[Job, JobBundle]]) -> None:
    """Ask every errand to save and stop, and bring back what it saved."""
    for each, (_, parcel) in going.items():
        parcel.close()
        with suppress(Exception):
            ray.cancel(each, force=False)
    ended, _ = ray.wait(list(going), num_returns=len(going), timeout=_PATIENCE) if going else ([], [])
    for each in ended:
        with suppress(Exception):
            _received(ray, each, *going.pop(each))
