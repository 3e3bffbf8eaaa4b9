"""Meaning probes: one meaning is changed at its one place, and every face that knows it has to follow.

    python tools/probes.py
    python tools/probes.py until "rank of plans"

A probe edits one text in a copy of the package, runs the faces that know the meaning on fixed inputs, and
compares their answers with those of the package itself. A face is anything that answers: a command, a kernel
in C, an exported graph, a function (`tools/faces.py`). One that answers as before lags: it has an
implementation of its own. `APART` names the test that holds such an implementation to the first one;
`LAGGING` lists the others, and may only shrink. Exit code: 0 if exactly these lag, else 1.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True)
class Probe:
    """A meaning, the edit that changes it, and the faces that know it.

    Attributes:
        meaning: its name.
        place: module that holds the meaning, below the package.
        old: text of the module, which occurs once.
        new: text in its place.
        faces: names of faces (`tools/faces.py`).
    """

    meaning: str
    place: str
    old: str
    new: str
    faces: tuple[str, ...]

    def edit(self, folder: Path) -> None:
        """Change the meaning in the copy of the package below `folder`.

        Raises:
            ValueError: the text does not occur once.
        """
        path = folder / "stlc" / self.place
        text = path.read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(f"{self.meaning}: {self.place} has {text.count(self.old)} times {self.old!r}")
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")


RECORDED = ("check", "check as text", "explain", "stream")
PLANNED = ("verdict by torch", "verdict by C", "verdict by ONNX", "verdict by the header")
BACKUPS = ("backup", "backup as a torch program", "backup by the runtime", "backup by the header")
POLICIES = ("policy", "policy as a torch program", "policy by ONNX", "policy by the header")
SMOOTH = ("smooth by NumPy", "smooth by torch")
INDICATORS = tuple(
    f"indicator {by}" for by in ("in check", "in bounds", "by torch", "by ONNX", "by C", "by the header")
)

_LEVELS = "levels of a control in prefixes"
_LENGTHS = "order of the lengths of prefixes"
_LONGEST = "longest safe plan"
ABS = """
        {},
        "{}",
        ("{}",),
        _even,
        numpy="{}",
        torch="{}",
"""

PROBES = (
    Probe(
        "choice of the backup",
        "runtime/decision.py",
        "ops.amax(value) - TOLERANCE",
        "ops.amax(value) - 0.3",
        BACKUPS,
    ),
    Probe(
        "tolerance of a verdict",
        "compile/semantics/tolerance.py",
        "TOLERANCE = Tolerance(1e-6)",
        "TOLERANCE = Tolerance(0.3)",
        (*RECORDED, "stream in C", *BACKUPS, "policy by the header", "gymnasium"),
    ),
    Probe(
        "satisfaction",
        "compile/semantics/tolerance.py",
        "return rho >= -(self.of(rho) if tolerance is None else tolerance)",
        "return rho >= 0.3",
        ("check", "check as text", "stream", *BACKUPS, *POLICIES, "gymnasium", "plan by search"),
    ),
    Probe(
        "rank of plans",
        "runtime/decision.py",
        "poor = ops.where(ops.gt(math.inf, size), rho / (1.0 + size), -1.0) + TIE * cheap",
        "poor = ops.where(ops.gt(math.inf, size), -rho / (1.0 + size), -1.0) + TIE * cheap",
        POLICIES,
    ),
    Probe(
        "cost of a plan",
        "controller/problem/task.py",
        "with_shortfall(self.system.decl.objective.gamma, SHORTFALL)",
        "with_shortfall(self.system.decl.objective.gamma, 2.0 * SHORTFALL)",
        ("cost", "cost by ONNX", "cost by the header"),
    ),
    Probe(
        "squash of a control",
        "dynamics/model/controls.py",
        'SquashKind(lambda ops, x: ops.tanh(x), "tanhf({0})")',
        'SquashKind(lambda ops, x: ops.tanh(x * 2.0), "tanhf({0} * 2.0f)")',
        POLICIES,
    ),
    Probe(
        "weight of a requirement",
        "compile/pipeline.py",
        "return self.weight / self.scale",
        "return 2.0 * self.weight / self.scale",
        ("check", *PLANNED),
    ),
    Probe(
        "weighed robustness",
        "compile/semantics/tolerance.py",
        "(rho + tolerance) * factor - tolerance",
        "(rho + tolerance) * factor * 2.0 - tolerance",
        ("check", *PLANNED),
    ),
    Probe(
        "smooth maximum",
        "compile/backends/array/numpy_ops.py",
        "return top + np.log1p(np.exp(-abs(k) * gap)) / k",
        "return top + np.log1p(np.exp(-abs(k) * gap)) / k + 0.5",
        SMOOTH,
    ),
    Probe(
        "implication",
        "compile/ir/typed.py",
        "return Connective(dual, (((items[0], inverse),), ((items[1], sign),)))",
        "return Connective(dual, (((items[0], sign),), ((items[1], sign),)))",
        (*RECORDED, "stream in C", *PLANNED, "plan by milp", "bounds"),
    ),
    Probe(
        "status of a requirement",
        "compile/semantics/tolerance.py",
        'return "violated" if violated else "satisfied" if satisfied else "inconclusive"',
        'return "inconclusive" if violated else "satisfied" if satisfied else "inconclusive"',
        RECORDED,
    ),
    Probe(
        "until",
        "compile/backends/array/windows.py",
        "                x = self.semantics.pair(held, x, other, self.ops)\n",
        "                x = x[:]\n",
        (*RECORDED, "stream in C", *PLANNED, "plan by milp", "bounds"),
    ),
    Probe(
        "value of a function",
        "compile/ir/functions.py",
        ABS.format("abs", "fabs({0})", "(double)(({0} > 0.0) - ({0} < 0.0))", "abs", "abs"),
        ABS.format("lambda x: -x", "(-{0})", "-1.0", "negative", "neg"),
        ("check", "explain", "stream", "stream in C", *PLANNED, "bounds"),
    ),
    Probe(
        "1 and 0 of an indicator",
        "compile/backends/array/arith.py",
        "return float(mask) if isinstance(mask, bool) else self.tape.number(mask)",
        "return float(mask) if isinstance(mask, bool) else self.tape.mul(self.tape.number(mask), 2.0)",
        INDICATORS,
    ),
    Probe(
        "steps of an integrator",
        "dynamics/model/integrators/rk4.py",
        "weights=(1, 2, 2, 1)",
        "weights=(1, 1, 3, 1)",
        (*PLANNED, "plan by milp"),
    ),
    Probe(
        "first sample of a window",
        "compile/ir/discretize.py",
        "return int(lo) + 1 if excluded else int(lo)",
        "return int(lo) + 1",
        (*RECORDED, "stream in C", *PLANNED, "plan by milp", "bounds"),
    ),
    Probe(
        "last sample of a window",
        "compile/ir/discretize.py",
        "return ir.Window(first, last)",
        "return ir.Window(first, first)",
        (*RECORDED, "stream in C", *PLANNED, "plan by milp", "bounds"),
    ),
    Probe(
        "derivative of a function",
        "compile/ir/functions.py",
        '_smooth("sin", "`sin(x)` of an angle.", "cos({0})"',
        '_smooth("sin", "`sin(x)` of an angle.", "(2.0 * cos({0}))"',
        ("gradient by C", "gradient by torch", "symbolic derivative"),
    ),
    Probe(
        "word of a status",
        "cli/commands/check/text.py",
        '"satisfied": "satisfied",',
        '"satisfied": "OBEYED",',
        ("check as text",),
    ),
    Probe(
        "size of a unit",
        "units.py",
        '"h": (3600, "s")',
        '"h": (4800, "s")',
        ("check", "check as text", "explain", "stream", "stream in C", *PLANNED, "plan by milp", "bounds"),
    ),
    Probe(
        _LEVELS,
        "runtime/prefixes.py",
        "actions = np.array(list(product(*self.values)), dtype=np.float64)",
        "actions = 0.5 * np.array(list(product(*self.values)), dtype=np.float64)",
        BACKUPS,
    ),
    Probe(
        _LENGTHS,
        "runtime/decision.py",
        "    for length in lengths:\n",
        "    for length in lengths[1:]:\n",
        BACKUPS,
    ),
    Probe(
        _LONGEST,
        "runtime/decision.py",
        "samples = ops.sum(ops.number(TOLERANCE.satisfied(falls), falls))[0]",
        "samples = -ops.sum(ops.number(TOLERANCE.satisfied(falls), falls))[0]",
        BACKUPS,
    ),
    Probe(
        "title of a guard",
        "controller/guard/kinds/paper.py",
        'title="paper\'s guard"',
        'title="guard of the paper"',
        ("simulation as text", "simulation in the report", "closed loop of a training"),
    ),
    Probe(
        "help of a guard",
        "controller/guard/kinds/full.py",
        'help="also repairs plans"',
        'help="also mends plans"',
        ("help of simulate",),
    ),
)

_IN_C = "tests/runtime/test_decision.py::test_rank_and_choices_are_the_same_in_every_library_and_in_c"
_WEIGHED = "tests/compile/semantics/test_tolerance.py::test_c_weighs_and_judges_alike"
_FORMULAS = "tests/compile/backends/test_c_formulas.py::test_every_operator_over_every_window"
_NUMBERS = "tests/compile/backends/test_emit_c.py::test_every_function_equals_the_evaluator"
_SLOPES = "tests/compile/backends/test_c_adjoint.py::test_every_function_has_the_gradient_of_torch"
_STREAMS = "tests/monitor/online/test_streams.py::test_a_stream_gives_what_the_whole_trace_gives"
_EXPORT, _BACKENDS = "tests/export", "tests/compile/backends"
_MILP = "tests/controller/search/planners/test_milp.py"
_WRITE, _ONNX, _EXTREMA = (
    f"{_EXPORT}/test_write.py",
    f"{_BACKENDS}/test_ops_onnx.py",
    f"{_BACKENDS}/test_torch_extrema.py",
)
_BACKUP = f"{_WRITE}::test_the_c_controller_decides_as_the_guard"
APART: Mapping[tuple[str, str], str] = {
    ("choice of the backup", "backup by the header"): _IN_C,
    ("rank of plans", "policy by the header"): _IN_C,
    ("satisfaction", "backup by the header"): _WEIGHED,
    ("satisfaction", "policy by the header"): _WEIGHED,
    ("satisfaction", "stream"): _STREAMS,
    ("weighed robustness", "verdict by the header"): _WEIGHED,
    ("smooth maximum", "smooth by torch"): f"{_EXTREMA}::test_smooth_extrema_are_those_of_numpy",
    ("until", "verdict by C"): _FORMULAS,
    ("until", "verdict by the header"): _FORMULAS,
    ("until", "stream"): _STREAMS,
    ("until", "stream in C"): f"{_EXPORT}/test_monitor.py::test_random_formulas_under_sanitizers",
    (
        "until",
        "plan by milp",
    ): f"{_MILP}::test_proofs_and_plans_agree_with_trial",
    ("1 and 0 of an indicator", "indicator by C"): _NUMBERS,
    ("1 and 0 of an indicator", "indicator by the header"): _NUMBERS,
    ("value of a function", "verdict by ONNX"): f"{_ONNX}::test_every_function_equals_the_evaluator",
    ("derivative of a function", "gradient by torch"): _SLOPES,
    ("derivative of a function", "symbolic derivative"): (
        "tests/dynamics/model/test_derivative.py::test_every_function_has_its_derivative"
    ),
    (_LEVELS, "backup by the header"): _BACKUP,
    (_LENGTHS, "backup by the header"): _BACKUP,
    (_LONGEST, "backup by the header"): _IN_C,
}
"""Meaning and face -> the test that holds the face to the meaning."""

LAGGING: frozenset[tuple[str, str]] = frozenset()
"""Meanings and faces without such a test. The list may only shrink."""


# ------------------------------------------------------------------------------------------------ running


def answers(folder: Path, faces: Sequence[str]) -> dict[str, Any]:
    """Answers of faces of the package below `folder`, each `{"says": …}` or `{"fails": …}`."""
    with tempfile.TemporaryDirectory(prefix="probes-") as place:
        paths = os.pathsep.join((str(folder), str(ROOT / "tests")))
        done = subprocess.run(
            [sys.executable, ROOT / "tools" / "faces.py", *faces],
            env={
                **os.environ,
                "PYTHONPATH": paths,
                "PROBES": place,
                "OMP_NUM_THREADS": "1",
                "COLUMNS": "100",
            },
            cwd=place,
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


@dataclass(frozen=True, slots=True)
class Lag:
    """A face that answers as before, or fails, although a meaning has changed."""

    meaning: str
    face: str
    why: str

    def __str__(self) -> str:
        return f"{self.meaning}: {self.face} {self.why}"


def lags(probe: Probe, plain: Mapping[str, Any], folder: Path) -> list[Lag]:
    """Faces that do not follow a change of a meaning, which is made below `folder`."""
    shutil.copytree(ROOT / "stlc", folder / "stlc")
    probe.edit(folder)
    found = []
    for face, answer in answers(folder, probe.faces).items():
        if "fails" in answer:
            found.append(Lag(probe.meaning, face, f"fails: {answer['fails']}"))
        elif answer == plain[face]:
            found.append(Lag(probe.meaning, face, "answers as before"))
    return found


def unaltered() -> dict[str, Any]:
    """Answers of all faces of the package itself.

    Raises:
        RuntimeError: a face fails.
    """
    faces = list(dict.fromkeys(face for probe in PROBES for face in probe.faces))
    found = answers(ROOT, faces)
    broken = {face: answer["fails"] for face, answer in found.items() if "fails" in answer}
    if broken:
        raise RuntimeError(str(broken))
    return found


def main() -> int:
    """Probe the meanings that the arguments name, all by default, and print what lags."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meanings", nargs="*", help="names of meanings")
    given = parser.parse_args()
    if unknown_names := set(given.meanings) - {probe.meaning for probe in PROBES}:
        parser.error(f"no such meaning: {', '.join(sorted(unknown_names))}")
    chosen = [probe for probe in PROBES if not given.meanings or probe.meaning in given.meanings]
    plain, unknown = unaltered(), 0
    for probe in chosen:
        with tempfile.TemporaryDirectory(prefix="probes-") as folder:
            found = lags(probe, plain, Path(folder))
        print(f"{probe.meaning}: {len(probe.faces) - len(found)} of {len(probe.faces)} follow", flush=True)
        for lag in found:
            held = APART.get((lag.meaning, lag.face))
            known = (lag.meaning, lag.face) in LAGGING
            unknown += not (held or known)
            print(f"  {lag.face} {lag.why}{f'; {held} holds it' if held else '; known' if known else ''}")
    return 1 if unknown else 0


if __name__ == "__main__":
    sys.exit(main())
