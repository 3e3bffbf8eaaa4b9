"""Answers of the faces of the package on fixed inputs, for the meaning probes (`tools/probes.py`).

    PROBES=/tmp python tools/faces.py "check as text" policy

prints one line of JSON: name of a face -> `{"says": …}` or `{"fails": …}`. The environment variable PROBES is
the folder of the inputs; the tests' helpers have to be importable.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

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
WALL = """spec cart
state signal x [m]
state signal v [m/s]
@safety
require inside: always[0 s, 0.4 s] x < 0.5
"""
STATES, RECORDINGS = 16, 6


@cache
def work() -> Path:
    """Folder of the inputs: system, specifications and recordings."""
    import numpy as np

    folder = Path(tempfile.mkdtemp(dir=os.environ["PROBES"]))
    (folder / "cart.yaml").write_text(CART, encoding="utf-8")
    for name, text in (("cart", SPEC), ("mission", MISSION), ("indicator", INDICATOR), ("wall", WALL)):
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


def before_a_wall() -> dict[str, Any]:
    """Specification -> states; before the wall no plan is safe for long, some for longer than others."""
    return {"cart": states(), "wall": 0.1 * states("wall") + states("wall").new_tensor((0.28, 1.8))}


def backup() -> list[Any]:
    """Decisions of the guard `paper`."""
    from stlc.controller.guard.kinds.paper import GUARD
    from stlc.controller.guard.search import StagedSearch

    said = []
    for spec, x in before_a_wall().items():
        found = StagedSearch(run(spec).task, run(spec).policy, GUARD).search(x, run(spec).policy.plan(x))
        said.append([part.tolist() for part in (found.plans, found.source, found.prefix_length)])
    return said


def backup_program() -> list[Any]:
    """The same as a torch program."""
    from stlc.export.programs import Guarding

    said = []
    for spec, x in before_a_wall().items():
        found = Guarding(run(spec).task, run(spec).network)(x, run(spec).policy.plan(x))
        said.append([part.tolist() for part in found])
    return said


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

    return [of_answer(backup_by_onnx(graphs(spec))(x)) for spec, x in before_a_wall().items()]


def backup_of_header() -> list[Any]:
    """Decisions of the backup policy in C."""
    return [of_answer(header(spec)("backup")(x)) for spec, x in before_a_wall().items()]


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
    "backup by the header": backup_of_header,
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


def answer_all(faces: Sequence[str]) -> None:
    """Print the answers of faces as one line of JSON."""
    told = {}
    for face in faces:
        try:
            told[face] = {"says": FACES[face]()}
        except Exception as error:
            told[face] = {"fails": f"{type(error).__name__}: {error}"}
    print(json.dumps(told))


if __name__ == "__main__":
    answer_all(sys.argv[1:])
