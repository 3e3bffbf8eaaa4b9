"""Checkpoints: tensors as safetensors, scalars as JSON, and a pointer to the latest checkpoint.

The pointer `ckpt/last.json` is replaced only once `ckpt/step-NNNNNN-HASH.safetensors` and its `.json` are
complete, so a kill or a full disk at any moment leaves the last good checkpoint in place. The hash of the
tensors in the name keeps two checkpoints of one step apart. No pickle is used.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from stlc.diagnostics import Diagnostic, RunError
from stlc.provenance import sha256
from stlc.rundir import RunDir

FOLDER = "ckpt"
POINTER = "last.json"
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RuntimeError)
"""Errors raised by damaged JSON or tensor files."""
_HASH = 8
"""Number of digits of the hash in the name of a file."""
_NAME = re.compile(rf"step-\d{{6,}}(-[0-9a-f]{{{_HASH}}})?\.safetensors")
"""Names of tensor files; older ones have no hash."""


@dataclass(frozen=True, slots=True)
class CheckpointHead:
    """File of the tensors of a checkpoint, its hash, and those of what it was trained for."""

    file: str
    sha256: str
    spec_hash: str | None = None
    system_hash: str | None = None


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Saved state of a training run: tensors by name, and scalars."""

    tensors: dict[str, Tensor]
    facts: dict[str, Any]


def save_checkpoint(
    run: RunDir, tensors: Mapping[str, Tensor], facts: Mapping[str, object], *, step: int
) -> Path:
    """Write a checkpoint, make it the latest, remove older ones, and return the path of its tensors.

    Raises:
        MissingError: R201, the disk is full or not writable; the last good checkpoint stays.
    """
    data = save_tensors({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
    digest = sha256(data)
    path = run.path / FOLDER / f"step-{step:06d}-{digest[:_HASH]}.safetensors"
    run.write(f"{FOLDER}/{path.name}", data)
    text = json.dumps({**facts, "file": path.name, "sha256": digest}, indent=1)
    run.write(f"{FOLDER}/{path.stem}.json", text)
    run.write(f"{FOLDER}/{POINTER}", text)
    for pattern in ("step-*", ".step-*", ".last.*"):  # the hidden ones are of a save that was killed
        for old in path.parent.glob(pattern):
            if old.stem != path.stem:
                with suppress(OSError):
                    old.unlink()
    return path


def never_saved(run: RunDir) -> bool:
    """True if no checkpoint of the run was ever written, except for a part of the first one."""
    return not run.has(f"{FOLDER}/{POINTER}") and not any((run.path / FOLDER).glob("step-*.json"))


def newest_tensors(run: RunDir) -> Iterator[bytes]:
    """Bytes of the tensors of the latest checkpoint, unchecked; none if there is no checkpoint."""
    if run.has(f"{FOLDER}/{POINTER}"):
        name = run.read_json(f"{FOLDER}/{POINTER}", CheckpointHead)["file"]
        yield run.read(f"{FOLDER}/{name}", RunDir.MOST_ARRAYS)


def load_checkpoint(run: RunDir, *, spec_hash: str, system_hash: str) -> Checkpoint:
    """Load the latest checkpoint of a run.

    Args:
        run: folder of the run.
        spec_hash: SHA-256 of the specification.
        system_hash: SHA-256 of the system file.

    Raises:
        RunError: R101, there is no checkpoint or it is damaged; R102, it belongs to another specification or
            system.
    """
    facts, data = _read(run)
    for key, wanted, word in (
        ("spec_hash", spec_hash, "specification"),
        ("system_hash", system_hash, "system"),
    ):
        if facts.get(key) != wanted:
            raise RunError.of(
                "R102",
                f"the checkpoint in `{run.shown}/{FOLDER}` was trained for another {word}",
                help=(f"train again, or put the {word} back that the checkpoint was made with",),
                note=(f"{word} now {wanted[:12]}, of the checkpoint {str(facts.get(key))[:12]}",),
            )
    try:
        return Checkpoint(load_tensors(data), facts)
    except (SafetensorError, *_DAMAGE) as error:
        raise RunError(_damaged(run, str(error)[:100])) from error


@contextmanager
def restoring(run: RunDir) -> Iterator[None]:
    """Context manager for restoring objects: if the checkpoint is damaged, RunError (R101) is raised."""
    try:
        yield
    except _DAMAGE as error:
        raise RunError(_damaged(run, f"{type(error).__name__}: {error}"[:200])) from error


def _read(run: RunDir) -> tuple[dict[str, Any], bytes]:
    """Read the scalars and the bytes of the tensor file of the latest checkpoint.

    Raises:
        RunError: R101, there is no checkpoint, it cannot be read, or the bytes are not those that were
            written with the scalars.
    """
    if not run.has(f"{FOLDER}/{POINTER}"):
        raise RunError.of(
            "R101",
            f"there is no checkpoint in `{run.shown}/{FOLDER}`",
            help=("train: stlc train SPEC", "an earlier run is named by its number: stlc simulate 7"),
            note=("nothing has been saved yet, or the run ended before that",),
        )
    facts = run.read_json(f"{FOLDER}/{POINTER}", CheckpointHead)
    name = facts["file"]
    if not _NAME.fullmatch(name):
        raise RunError(_damaged(run, f"`{name:.100}` is not the name of a checkpoint"))
    data = run.read(f"{FOLDER}/{name}", RunDir.MOST_ARRAYS)
    if sha256(data) != facts["sha256"]:
        raise RunError(_damaged(run, f"`{name}` is not what was written"))
    return facts, data


def _damaged(run: RunDir, why: str) -> Diagnostic:
    message = f"the checkpoint in `{run.shown}/{FOLDER}` is damaged: {why}"
    return Diagnostic("R101", message, help=("train again",))


def weights(checkpoint: Checkpoint, prefix: str) -> dict[str, torch.Tensor]:
    """Weights of one module: the tensors named `prefix.NAME`, each under the key `NAME`."""
    return below(checkpoint.tensors, prefix)


def below(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Tensors whose names begin with `prefix.`; this prefix is removed from the names."""
    start = prefix + "."
    return {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}
