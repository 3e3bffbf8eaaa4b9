"""A run -> a folder that can be taken away; what is in it has been checked against the run."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import torch

from stlc.compile.c_numbers import Untranslatable
from stlc.diagnostics import Diagnostic, UsageError
from stlc.export import c_weights, emit
from stlc.export.programs import recorded
from stlc.export.verify import Agreement, agreement, by_c, by_torch
from stlc.files import write_atomic
from stlc.jsontext import dumps

if TYPE_CHECKING:
    from stlc.controller.run import Run

Target: TypeAlias = Literal["torch", "c"]
TARGETS: tuple[Target, ...] = get_args(Target)
STATES = 64
"""Random states that an export is checked in."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        folder: where.
        files: names in it.
        agreement: with the run; None where there is no compiler to check with.
    """

    folder: Path
    files: tuple[str, ...]
    agreement: Agreement | None


def target_of(word: str) -> Target:
    """The target that is called `word`. Raises UsageError (U101) where there is none."""
    for target in TARGETS:
        if target == word:
            return target
    raise UsageError(
        Diagnostic("U101", f"there is no target `{word}`", help=(f"one of {', '.join(TARGETS)}",))
    )


def export(run: Run, target: Target, folder: Path) -> Exported:
    """Write a run's controller.

    Args:
        run: with a checkpoint.
        target: for whom.
        folder: where to; files of the same names are replaced.

    Raises:
        RunError: R105, the export does not do what the run does; nothing is written.
        UsageError: U101, the task has no form for the target.
    """
    with tempfile.TemporaryDirectory() as name:
        beside = Path(name)
        found = _torch(run, beside) if target == "torch" else _c(run, beside)
        files = tuple(sorted(path.name for path in beside.iterdir() if path.name != BUILT))
        folder.mkdir(parents=True, exist_ok=True)
        for each in files:
            write_atomic(folder / each, (beside / each).read_bytes())
    return Exported(folder, files, found)


BUILT = "checked"


def _torch(run: Run, folder: Path) -> Agreement:
    """`decide.pt2`, and `controller.json` that says what goes in and comes out."""
    path = folder / "decide.pt2"
    torch.export.save(recorded(run.task, run.policy.network), path)
    (folder / "controller.json").write_text(dumps(_facts(run)) + "\n", encoding="utf-8")
    return agreement(run.policy, by_torch(path), states=STATES)


def _c(run: Run, folder: Path) -> Agreement | None:
    """A header, its weights, an example program and its Makefile."""
    try:
        text = emit.header(run.task, run.policy.network)
    except Untranslatable as error:
        finding = Diagnostic("U101", f"this task has no C form: {error}", help=("take --to torch instead",))
        raise UsageError(finding) from error
    texts = {
        "stlc_controller.h": text,
        "stlc_weights.h": c_weights.weights(run.policy.network),
        "main.c": emit.main_of(run.task),
        "Makefile": emit.makefile(),
    }
    for name, content in texts.items():
        (folder / name).write_text(content, encoding="utf-8")
    decide = by_c(folder, run.task, folder / BUILT)
    return None if decide is None else agreement(run.policy, decide, states=STATES)


def _facts(run: Run) -> dict[str, object]:
    """Names and sizes of what goes in and comes out."""
    task = run.task
    return {
        "spec": task.compiled.name,
        "system": task.system.name,
        "states": list(task.names),
        "controls": [
            {"name": each.name, "low": each.low, "high": each.high} for each in task.system.controls
        ],
        "requirements": [rule.name for rule in task.rules],
        "dt": task.dt,
        "horizon": task.horizon,
        "outputs": ["plan", "rho", "safe", "requirements"],
    }
