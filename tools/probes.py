"""Meaning probes: one meaning is changed at its one place, and every face that knows it has to follow.

    python tools/probes.py
    python tools/probes.py until "rank of plans"

A probe edits one text in a copy of the package, runs the faces that know the meaning on fixed inputs, and
compares their answers with those of the package itself. A face is anything that answers: a command, a kernel
in C, an exported graph, a function. One that answers as before lags: it has an implementation of its own.
`APART` names the test that holds such an implementation to the first one; `LAGGING` lists the others, and
may only shrink. Exit code: 0 if exactly these lag, else 1.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
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
        faces: names of faces in `FACES`.
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
        "\nTOLERANCE = 1e-6\n",
        "\nTOLERANCE = 0.3\n",
        (*RECORDED, "stream in C", *BACKUPS, "policy by the header", "gymnasium"),
    ),
    Probe(
        "satisfaction",
        "compile/semantics/tolerance.py",
        "return rho >= -(tolerance_of(rho) if tolerance is None else tolerance)",
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
        "compile/ir/normal_form.py",
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
}
"""Meaning and face -> the test that holds the face to the meaning."""

LAGGING: frozenset[tuple[str, str]] = frozenset()
"""Meanings and faces without such a test. The list may only shrink."""

# ------------------------------------------------------------------------------------------- fixed inputs

CART = """stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 6 steps, integrator: rk4}
state:
  x: {unit: m, range: [-2, 2]}
  v: {unit: m/s, range: [-2, 2]}
control:
  u: {unit: m/s^2, range: [-8, 8]}
flow: {x: v, v: u - 0.5 * v / 1 s}
objective:
  gamma: 0.2
  terms: [{name: calm, weight: 0.3, expr: abs(x - x_start)}, {name: work, weight: 0.1, expr: abs(u)}]
backup: {bins: 3, T0: [1, 2]}
init:
  mixture:
    - draw: {x: "uniform(-0.1, 0.4)", v: "uniform(-0.5, 0.9)"}
"""
SPEC = """spec cart
state signal x [m]
state signal v [m/s]
@liveness
require there: eventually[0 s, 0.5 s] x > 0.3
require goes: v > -0.2 until[0.1 s, 0.4 s] x > 0.1
@weight(3)
require calm: always[0 s, 0.3 s] (x > 0.2 -> v < 0.9)
@safety
require slow: always[0 s, 0.4 s] abs(v) <= 3.6 km/h
"""
MISSION = """spec cart
state signal x [m]
state signal v [m/s]
@liveness
require there: eventually@[0 s, 1 s] x > 0.3
@safety
require slow: always[0, T] abs(v) <= 1
"""
INDICATOR = """spec cart
state signal x [m]
state signal v [m/s]
require marked: always[0 s, 0.3 s] x / 1 m - 0.3 * ind(v > 0.2) > -0.5
"""
STATES, RECORDINGS = 16, 6


@cache
def work() -> Path:
    """Folder of the inputs: system, specifications and recordings."""
    import numpy as np

    folder = Path(tempfile.mkdtemp(dir=os.environ["PROBES"]))
    (folder / "cart.yaml").write_text(CART, encoding="utf-8")
    for name, text in (("cart", SPEC), ("mission", MISSION), ("indicator", INDICATOR)):
        (folder / f"{name}.stl").write_text(text, encoding="utf-8")
    for i in range(RECORDINGS):
        rows = recordings()[i]
        lines = ["time,x,v", *(f"{0.1 * k:.1f},{x!r},{v!r}" for k, (x, v) in enumerate(rows.tolist()))]
        (folder / f"{i}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    np.save(folder / "recordings.npy", recordings())
    return folder


@cache
def recordings() -> Any:
    """Random recordings (recording, sample, signal), some near the thresholds."""
    import numpy as np

    rng = np.random.default_rng(1)
    return np.round(rng.uniform(-0.4, 1.1, (RECORDINGS, 9, 2)), 2)


@cache
def run(spec: str = "cart") -> Any:
    """A run whose network has learnt nothing."""
    from helpers.exported import untrained

    return untrained(work() / f"{spec}.stl", work() / "cart.yaml", work() / "runs", varied=False)


@cache
def states(spec: str = "cart") -> Any:
    """Random initial states (STATES, n) float64."""
    import torch

    return run(spec).task.sample(STATES, seed=5, dtype=torch.float64)


@cache
def plans(spec: str = "cart") -> Any:
    """Random plans (STATES, T, m) float64."""
    import torch

    shape = (STATES, run(spec).task.horizon, 1)
    return 8.0 * torch.rand(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 4.0


@cache
def graphs(spec: str = "cart") -> Any:
    """The graphs of a run in ONNX, not compared with it."""
    from stlc.export.onnx_write import write_onnx
    from stlc.runtime.facts import read_facts
    from stlc.runtime.graphs import Graphs

    folder = Path(tempfile.mkdtemp(dir=work()))
    write_onnx(run(spec), folder)
    return Graphs(read_facts(folder))


@cache
def header(spec: str = "cart") -> Callable[[str], Any]:
    """The decisions of the C header of a run, by the mode of its example program.

    For a mission, the robustness of the safety requirements is replaced by the cost.
    """
    from stlc.export import c_header
    from stlc.export.verify import by_c

    task, network, folder = run(spec).task, run(spec).network, Path(tempfile.mkdtemp(dir=work()))
    texts = {"stlc_controller.h": c_header.header(task, network), "stlc_weights.h": c_header.weights(network)}
    example = c_header.main_of(task)
    if spec == "mission":
        example = example.replace("verdict.rho, verdict.safe", "verdict.rho, verdict.cost")
    texts = {**c_header.public(texts, "STLC_CONTROLLER_H"), "main.c": example}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return by_c(folder, task, folder / "built")


def stlc(words: str) -> list[Any]:
    """Exit codes and output of a command, for each recording if `{}` stands for its name."""
    from stlc.cli.framework.app import main

    said: list[Any] = []
    for i in range(RECORDINGS if "{}" in words else 1):
        out, code = io.StringIO(), 0
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), contextlib.chdir(work()):
            try:
                code = main(words.format(f"{i}.csv").split())
            except SystemExit as left:
                code = left.code
        if code not in (0, 1, 4):
            raise RuntimeError(out.getvalue())
        said.append([code, out.getvalue()])
    return said


# -------------------------------------------------------------------------------------------------- faces


def documented(words: str) -> list[Any]:
    """Results of a command for each recording, without how they came about."""
    results = [json.loads(text)["result"] for _, text in stlc(words)]
    return [{name: each for name, each in result.items() if name != "evidence"} for result in results]


def of_answer(answer: Any) -> list[Any]:
    """Plans, verdicts and sources of an export's decisions."""
    parts = (answer.plan, answer.rho, answer.safe, answer.each, answer.source, answer.t0)
    return [part.tolist() for part in parts if part is not None]


def streamed() -> list[Any]:
    """Verdicts of streams."""
    from stlc import Monitor

    monitor, found = Monitor(SPEC, dt=0.1), []
    for rows in recordings():
        online = monitor.online()
        online.push_block(rows)
        found.append([[each.low, each.high, str(each.status)] for each in online.finish().values()])
    return found


def streamed_in_c() -> list[Any]:
    """Output of the exported monitor."""
    from stlc import Monitor
    from stlc.export.monitor import export_monitor

    folder = work() / "monitor"
    export_monitor(Monitor(SPEC, dt=0.1), folder)
    program, sources = folder / "program", sorted(str(path) for path in folder.glob("*.c"))
    subprocess.run(["cc", "-O1", *sources, "-o", str(program), "-lm"], check=True)
    found = []
    for rows in recordings():
        given = "\n".join(["x,v", *(f"{x!r},{v!r}" for x, v in rows.tolist())])
        done = subprocess.run([program], input=given + "\n", capture_output=True, text=True, check=False)
        found.append([done.returncode, done.stdout])
    return found


def torch_verdicts(spec: str = "cart") -> list[Any]:
    """Verdicts on plans, by torch alone."""
    from stlc.export.programs import judged_by_torch

    found = judged_by_torch(run(spec).task, states(spec), plans(spec))
    return [found.rho.tolist(), found.requirements.tolist()]


def native_verdicts(spec: str = "cart") -> list[Any]:
    """Verdicts on plans, by the kernel in C."""
    found = run(spec).task.judge(states(spec), plans(spec))
    assert run(spec).task.native is not None
    return [found.rho.tolist(), found.requirements.tolist()]


def onnx_verdicts(spec: str = "cart") -> Any:
    """Verdicts on plans, by ONNX."""
    return graphs(spec).judged(states(spec).numpy(), plans(spec).numpy())[0]


def backup() -> list[Any]:
    """Decisions of the guard `paper`."""
    from stlc.controller.guard.kinds.paper import GUARD
    from stlc.controller.guard.search import StagedSearch

    found = StagedSearch(run().task, run().policy, GUARD).search(states(), run().policy.plan(states()))
    return [part.tolist() for part in (found.plans, found.source, found.prefix_length)]


def backup_program() -> list[Any]:
    """The same as a torch program."""
    from stlc.export.programs import Guarding

    found = Guarding(run().task, run().network)(states(), run().policy.plan(states()))
    return [part.tolist() for part in found]


def policy() -> list[Any]:
    """Plans of the policy."""
    return run().policy.plan(states()).tolist()


def policy_program() -> list[Any]:
    """The same as a torch program."""
    from stlc.export.programs import Deciding

    return [part.tolist() for part in Deciding(run().task, run().network)(states())]


def policy_graph() -> list[Any]:
    """The same as a graph in ONNX."""
    from stlc.export.verify import by_onnx

    return of_answer(by_onnx(graphs())(states()))


def backup_of_runtime() -> list[Any]:
    """Decisions of the runtime's backup policy."""
    from stlc.export.verify import backup_by_onnx

    return of_answer(backup_by_onnx(graphs())(states()))


def cost() -> list[float]:
    """Costs of plans of a mission."""
    task = run("mission").task
    return task.cost(task.judge(states("mission"), plans("mission"))).tolist()


def smooth(ops: Any, values: Any) -> list[float]:
    """Smooth maximum of two arrays."""
    return ops.softmax2(values, 1.0 - values, 3.0).tolist()


def smooth_numpy() -> list[float]:
    """Smooth maximum of NumPy arrays."""
    import numpy as np

    from stlc.compile.backends.array.numpy_ops import NUMPY

    return smooth(NUMPY, np.linspace(0.0, 1.0, 7))


def smooth_torch() -> list[float]:
    """Smooth maximum of tensors."""
    import torch

    from stlc.compile.backends.torch.ops import TORCH

    return smooth(TORCH, torch.linspace(0.0, 1.0, 7, dtype=torch.float64))


def gymnasium() -> list[Any]:
    """Rewards and outcomes of episodes."""
    import stlc.gym

    env, found = stlc.gym.make(work() / "cart.stl", system=work() / "cart.yaml"), []
    for seed in range(8):
        env.reset(seed=seed)
        over = False
        while not over:
            _, reward, ended, cut, info = env.step(env.action_space.low * 0.1 * (seed - 4))
            over = ended or cut
        found.append([reward, bool(info.get("satisfied", False))])
    return found


def planned(words: str) -> str:
    """Robustness of plans that a search finds."""
    words = f"plan cart.stl --system cart.yaml --starts 6 --seed 1 --evaluations 40 {words} --json"
    result = json.loads(stlc(words)[0][1])["result"]
    return json.dumps([result[name] for name in ("satisfied", "infeasible", "robustness")])


def sine() -> Any:
    """The expression `sin(x)`."""
    from stlc.compile.ir import nodes as ir

    return ir.Op("sin", (ir.Signal("x"),))


def gradient_in_c() -> list[float]:
    """Slope of `sin(x)`, by the kernel."""
    import numpy as np
    from helpers.emitted import adjoint_of

    from stlc.compile.backends.c.emit import Motion
    from stlc.compile.ir import nodes as ir
    from stlc.controller.problem.kernel import ObjectiveSlopes

    motion = Motion(("y",), ("x",), (), {"y": sine()}, 1, 0.1)
    at = np.linspace(-3.0, 3.0, 7)
    outcome = ObjectiveSlopes(np.ones((len(at), 1)), None, 5.0)
    adjoint = adjoint_of(motion, [ir.Temporal("always", ir.Window(1, 1), ir.Predicate(ir.Signal("y")))])
    return adjoint.pull(np.zeros((len(at), 1)), at.reshape(-1, 1, 1).copy(), outcome).ravel().tolist()


def gradient_in_torch() -> list[float]:
    """Slope of `sin(x)`, by torch."""
    import torch

    from stlc.compile.backends.array.arith import ArrayProgram
    from stlc.compile.backends.torch.ops import TORCH

    x = torch.linspace(-3.0, 3.0, 7, dtype=torch.float64, requires_grad=True)
    value = ArrayProgram({"out": sine()})({"x": x}, TORCH)["out"]
    return torch.autograd.grad(value.sum(), x)[0].tolist()


def symbolic_derivative() -> list[float]:
    """Slope of `sin(x)`, as an expression."""
    import numpy as np

    from stlc.compile.backends.array.arith import ArrayProgram
    from stlc.compile.backends.array.numpy_ops import NUMPY
    from stlc.dynamics.model.derivative import derivative

    found = derivative(sine(), "x")
    assert found is not None
    return ArrayProgram({"out": found})({"x": np.linspace(-3.0, 3.0, 7)}, NUMPY)["out"].tolist()


@cache
def trained() -> Path:
    """Folder of a run that was trained for two steps."""
    words = "--method gradient --steps 2 --held-out 20 --drives 0 --no-pictures --threads 1 --seed 1"
    stlc(f"train cart.stl --system cart.yaml {words} --name guarded --runs trained")
    return next((work() / "trained").glob("**/config.resolved.yaml")).parent


@cache
def simulated() -> str:
    """Text about a simulation with the guard `paper`."""
    return stlc(f"simulate {trained()} --guard paper --seeds 0..1 --steps 4 --no-pictures")[0][1]


def reported() -> str:
    """The report of a simulated run."""
    stlc(f"report {trained()}")
    return (trained() / "report.html").read_text(encoding="utf-8")


def about_guard(text: str) -> list[str]:
    """The parts of a text that name the guard `paper`; other parts hold times."""
    return [part for part in re.split(r"[<>\n]", text) if "paper" in part]


def closed_loop() -> list[str]:
    """Lines about the simulations that end a training."""
    from stlc.view.learning import driven_lines

    guards = [
        {
            "guard": name,
            "drives": 9,
            "satisfied": 5,
            "share": 0.5,
            "interval": (0.2, 0.8),
            "gained": 2,
            "lost": 1,
        }
        for name in ("none", "paper")
    ]
    return driven_lines({"closed_loop": {"guards": guards, "recommended": "paper"}})


FACES: Mapping[str, Callable[[], Any]] = {
    "check": lambda: documented("check cart.stl {} --json"),
    "check as text": lambda: stlc("check cart.stl {}"),
    "explain": lambda: documented("explain {} --spec cart.stl --json"),
    "stream": streamed,
    "stream in C": streamed_in_c,
    "verdict by torch": torch_verdicts,
    "verdict by C": native_verdicts,
    "verdict by ONNX": lambda: [part.tolist() for part in (onnx_verdicts().rho, onnx_verdicts().each)],
    "verdict by the header": lambda: of_answer(header()("policy")(states()))[1:4],
    "bounds": lambda: documented("check cart.stl {} --uncertain x=0.01 --json"),
    "backup": backup,
    "backup as a torch program": backup_program,
    "backup by the runtime": backup_of_runtime,
    "backup by the header": lambda: of_answer(header()("backup")(states())),
    "indicator in check": lambda: documented("check indicator.stl {} --json"),
    "indicator in bounds": lambda: documented("check indicator.stl {} --uncertain x=0.01 --json"),
    "indicator by torch": lambda: torch_verdicts("indicator"),
    "indicator by ONNX": lambda: onnx_verdicts("indicator").rho.tolist(),
    "indicator by C": lambda: native_verdicts("indicator"),
    "indicator by the header": lambda: of_answer(header("indicator")("policy")(states("indicator")))[1:4],
    "policy": policy,
    "policy as a torch program": policy_program,
    "policy by ONNX": policy_graph,
    "policy by the header": lambda: of_answer(header()("policy")(states())),
    "plan by milp": lambda: planned("--method milp --target max"),
    "plan by search": lambda: planned("--method search"),
    "cost": cost,
    "cost by the header": lambda: header("mission")("policy")(states("mission")).safe.tolist(),
    "cost by ONNX": lambda: onnx_verdicts("mission").cost.tolist(),
    "smooth by NumPy": smooth_numpy,
    "smooth by torch": smooth_torch,
    "gradient by C": gradient_in_c,
    "gradient by torch": gradient_in_torch,
    "symbolic derivative": symbolic_derivative,
    "gymnasium": gymnasium,
    "simulation as text": lambda: about_guard(simulated()),
    "simulation in the report": lambda: about_guard((simulated(), reported())[1]),
    "closed loop of a training": closed_loop,
    "help of simulate": lambda: stlc("simulate --help"),
}


# ------------------------------------------------------------------------------------------------ running


def answers(folder: Path, faces: Sequence[str]) -> dict[str, Any]:
    """Answers of faces of the package below `folder`, each `{"says": …}` or `{"fails": …}`."""
    with tempfile.TemporaryDirectory(prefix="probes-") as place:
        paths = os.pathsep.join((str(folder), str(ROOT / "tests")))
        done = subprocess.run(
            [sys.executable, __file__, "--faces", *faces],
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


def answer_all(faces: Sequence[str]) -> None:
    """Print the answers of faces as one line of JSON."""
    told = {}
    for face in faces:
        try:
            told[face] = {"says": FACES[face]()}
        except Exception as error:
            told[face] = {"fails": f"{type(error).__name__}: {error}"}
    print(json.dumps(told))


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
    parser.add_argument("--faces", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.faces:
        answer_all(given.faces)
        return 0
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
