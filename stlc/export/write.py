"""Export of a run to a self-contained folder; the export is verified against the run."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias, get_args

import torch

from stlc.compile.backends.numbers import Untranslatable
from stlc.controller.run.run import Run
from stlc.diagnostics import usage
from stlc.export import c_header
from stlc.export.c_header import public, weights
from stlc.export.onnx_write import PRECISIONS, Latency, Precision, timed, write_onnx
from stlc.export.programs import recorded, recorded_guard
from stlc.export.verify import (
    EXACT,
    SINGLE,
    Agreement,
    Unchecked,
    agreement,
    backup_agreement,
    backup_by_onnx,
    backup_by_torch,
    by_c,
    by_onnx,
    by_torch,
    previous_plan_agreement,
    same_verdicts,
)
from stlc.files import File, place
from stlc.jsontext import dumps
from stlc.runtime.facts import read_facts
from stlc.runtime.graphs import Graphs

Target: TypeAlias = Literal["torch", "c", "onnx"]
TARGETS: tuple[Target, ...] = get_args(Target)
STATES = 64
"""Number of random states for the verification of an export."""
GUARDED = 16
"""Number of random states in which its backup policy is verified."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        run: the run.
        target: the form of the export.
        folder: folder of the written files.
        files: names of the files.
        kept: names of example files that were there already and differ, so that they were left as they are.
        agreement: comparison with the run; None if the export could not be verified.
        latency: decision time of the Python runtime; None if it was not measured.
        unchecked: reason why the export could not be verified; "" if it was verified.
        precision: numbers of the export.
    """

    JSON: ClassVar = "run target folder files kept checked=agreement latency"

    run: str
    target: Target
    folder: Path
    files: tuple[str, ...]
    agreement: Agreement | None
    latency: Latency | None = None
    unchecked: str = ""
    kept: tuple[str, ...] = ()
    precision: Precision = "float64"

    def __repr__(self) -> str:
        return f"Exported({self.run} as {self.target}: {len(self.files)} files in {self.folder})"

    @property
    def remarks(self) -> Iterator[str]:
        """Sentences on the comparison with the run, on the decision time, and on files that were kept."""
        found, taken = self.agreement, self.latency
        if found is None:
            yield f"not checked: {self.unchecked}"
        else:
            yield (
                f"checked in {found.states} random states, the backup policy in {found.guarded}: "
                f"plans within {found.plan:.1e} of a range, robustness within {found.rho:.1e}"
                f"{'' if self.precision == 'float64' else ', in float32'}"
            )
        if taken is not None:
            yield (
                f"decides in {taken.median:.2f} ms, 99 % within {taken.p99:.2f} ms: "
                "one agent, one thread, stlc.runtime"
            )
        for name in self.kept:
            yield f"kept {self.folder / name}, which was there and differs"


def target_of(word: str) -> Target:
    """Return the export target called `word`. Raises UsageError (U101) for an unknown name."""
    for target in TARGETS:
        if target == word:
            return target
    raise usage(f"there is no target `{word}`", f"one of {', '.join(TARGETS)}")


def precision_of(word: str, target: Target) -> Precision:
    """Return the element type called `word`.

    Raises UsageError (U101) for an unknown name, or for float32 with a target other than onnx.
    """
    for precision in PRECISIONS:
        if precision == word:
            if precision == "float32" and target != "onnx":
                raise usage(f"`--to {target}` computes in float64", "take --to onnx for float32")
            return precision
    raise usage(f"there is no precision `{word}`", f"one of {', '.join(PRECISIONS)}")


def export(run: Run, target: Target, folder: Path, precision: Precision = "float64") -> Exported:
    """Export the controller of a run, and verify it by a comparison with the run.

    An export that cannot be verified, such as C without a compiler, is written all the same; the result says
    why.

    Args:
        run: a run with a checkpoint.
        target: the form of the export.
        folder: destination; existing files of the same names are replaced, except for those in `EXAMPLES`.
        precision: element type of all numbers of ONNX graphs. The verification of float32 is less strict.

    Raises:
        RunError: R105, the export disagrees with the run; nothing is written.
        MissingError: R301, the target needs packages that are not installed.
        UsageError: U101, the task cannot be expressed in the form of the target.
    """
    with tempfile.TemporaryDirectory() as name:
        beside = Path(name)
        try:
            write = partial(_onnx, precision=precision) if target == "onnx" else _WRITERS[target]
            (found, latency), unchecked = write(run, beside), ""
        except Unchecked as why:
            found, latency, unchecked = None, None, why.why
        texts = {path.name: path.read_bytes() for path in sorted(beside.iterdir()) if path.name != BUILT}
        folder.mkdir(parents=True, exist_ok=True)
        kept = tuple(name for name in EXAMPLES if name in texts and _differs(folder / name, texts[name]))
        files = tuple(name for name in texts if name not in kept)
        for name in files:
            File(place(folder, name)).write(texts[name])
    return Exported(run.dir.shown, target, folder, files, found, latency, unchecked, kept, precision)


def _differs(path: Path, content: bytes) -> bool:
    """True if there is something else than `content` at `path`."""
    if path.is_symlink() or not path.is_file():
        return os.path.lexists(path)
    return path.read_bytes() != content


BUILT = "checked"
EXAMPLES = ("main.c", "Makefile")
"""Files that show how the others are used, and that a user changes."""
Checked: TypeAlias = tuple[Agreement | None, Latency | None]


def _torch(run: Run, folder: Path) -> Checked:
    """Write `decide.pt2`, `backup.pt2` and `controller.json`; compare the programs with the run.

    `controller.json` describes the inputs and outputs of the programs.

    Raises:
        RunError: R105, a program disagrees with the run.
    """
    path, backup = folder / "decide.pt2", folder / "backup.pt2"
    torch.export.save(recorded(run.task, run.network), path)
    torch.export.save(recorded_guard(run.task, run.network), backup)
    (folder / "controller.json").write_text(dumps(_facts(run)) + "\n", encoding="utf-8", newline="\n")
    fresh = agreement(run.policy, by_torch(path), states=STATES)
    guarded = backup_agreement(run.policy, backup_by_torch(backup, run.policy), states=GUARDED)
    return fresh.worst(guarded), None


def _onnx(run: Run, folder: Path, precision: Precision) -> Checked:
    """Write the ONNX graphs of `stlc.export.onnx_graphs`, and `controller.json`.

    The graphs are then compared with the run, and the decision times of the runtime are measured.

    Raises:
        RunError: R105, the graphs disagree with the run.
    """
    write_onnx(run, folder, precision)
    graphs = Graphs(read_facts(folder))
    within = SINGLE if precision == "float32" else EXACT
    fresh = agreement(run.policy, by_onnx(graphs), states=STATES, within=within)
    kept = previous_plan_agreement(run.policy, graphs, states=STATES, within=within)
    guarded = backup_agreement(run.policy, backup_by_onnx(graphs), states=GUARDED, within=within)
    off = same_verdicts(run.task, graphs, states=STATES // 4, within=within)
    return fresh.worst(kept, off).worst(guarded), timed(run.task, folder)


def _c(run: Run, folder: Path) -> Checked:
    """Write the C header, its weights, an example program and its Makefile.

    The example program is then compiled and compared with the run.

    Raises:
        UsageError: U101, the task has no C form.
        Unchecked: there is no working compiler.
        RunError: R105, the program cannot be compiled or disagrees with the run.
    """
    try:
        text = c_header.header(run.task, run.network)
    except Untranslatable as error:
        raise usage(f"this task has no C form: {error}", "take --to torch instead") from error
    headers = {"stlc_controller.h": text, "stlc_weights.h": weights(run.network)}
    texts = {
        **public(headers, "STLC_CONTROLLER_H"),
        "main.c": c_header.main_of(run.task),
        "Makefile": c_header.makefile(),
    }
    for name, content in texts.items():
        (folder / name).write_text(content, encoding="utf-8", newline="\n")
    program = by_c(folder, run.task, folder / BUILT)
    guarded = backup_agreement(run.policy, program("backup"), states=GUARDED)
    return agreement(run.policy, program("policy"), states=STATES).worst(guarded), None


_WRITERS: Mapping[Target, Callable[[Run, Path], Checked]] = {"torch": _torch, "c": _c}


def _facts(run: Run) -> dict[str, object]:
    """Content of `controller.json`: names and sizes of inputs and outputs."""
    task = run.task
    feedback = task.system.decl.feedback
    return {
        "spec": task.compiled.name,
        "system": task.system.decl.name,
        "states": list(task.system.names),
        "controls": [
            {"name": each.name, "low": each.low, "high": each.high} for each in task.system.decl.controls
        ],
        "feedback": None if feedback is None else asdict(feedback),
        "requirements": [rule.name for rule in task.rules],
        "dt": task.system.dt,
        "horizon": task.horizon,
        "outputs": ["plan", "rho", "safe", "requirements"],
        "backup_outputs": ["plan", "rho", "safe", "requirements", "source", "t0"],
    }
