"""Golden results of the program's behaviour, for comparison before and after a change.

    python tools/pins.py write before
    python tools/pins.py check before
    python tools/pins.py check before --only guards --only verdicts --tolerance 1e-9

`write` stores golden results (pins): JSON with all digits of floats, and text. `check` computes them again,
and prints each difference. Use it on one machine: elsewhere the last digits of floats differ. Exit code: 0 no
difference, 1 differences, 2 a usage error. `tests/test_pins.py` pins portable results.

The parts:

- `documents`: `--json` documents and texts about specifications, systems, codes and schemas.
- `verdicts`: `stlc check` and `stlc explain` on traces, for all shipped specifications, semantics and ends.
- `formulas`: robustness, bounds and online decisions of random formulas, from the generator of the proofs.
- `emitted`: the C text of the kernels of each task.
- `training`: checkpoints, tensor by tensor, and documents of short trainings.
- `plans`: verdicts, costs and gradients of fixed plans.
- `guards`: decisions of every guard on fixed states, without a time limit.
- `runs`: simulations, exports, reports and lists of runs.

`plans`, `guards` and `runs` use the policies that `write` stored; with `--anew`, those that `check` trains.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import io
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.update(COLUMNS="100", NO_COLOR="1", MPLBACKEND="Agg")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

# ruff: noqa: E402 (threads are set, and the tests' generator found, before anything is imported)
import numpy as np
import torch
import typer

# ------------------------------------------------ imports from the project
from proof.cases import Case
from proof.draw import DT, HORIZON, Taste

from stlc import Monitor, Run, System, Task, load
from stlc.cli.framework.app import main as stlc_main
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import emit
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.problem.native import motion_of

NO_LIMIT = Limits(seconds=None, paper=None)
"""Limits of a guard's decision without time limits, for reproducible results."""
SMALL = Limits(seconds=None, tries=200, prefixes=50, drawn=16, guesses=2, again=200)
"""The same for a cheap decision."""


def with_margin(task: Task) -> Limits:
    """Limits of a guard that requests a margin of 0.05 for the first safety requirement."""
    return Limits(seconds=None, paper=None, margin={task.compiled.safety[0].name: 0.05})


def kernels(task: Task) -> Mapping[str, str]:
    """The C texts of a task: robustness of plans with local search, and the gradient."""
    motion, formulas = motion_of(task.system), [rule.formula for rule in task.rules]
    return {"kernel": emit(motion, formulas), "adjoint": emit_adjoint(motion, formulas)}


# ------------------------------------------------------------------------------------------- masked values

VOLATILE: Mapping[str, str] = {
    "*.stlc": "the version of the program",
    "train/*.help*": "lists the methods",
    "train/*.result.seconds": "processor time",
    "train.jsonl.*.seconds": "processor time",
    "train.jsonl.*.s_per_step": "processor time",
    "ckpt.seconds": "processor time",
    "ckpt.sha256": "pinned as that of the file",
    "simulate/*.latency*": "processor time",
    "runs*.seconds": "processor time",
    "runs*.started": "a date",
    "runs*.finished": "a date",
    "runs*.size*": "texts with dates and times have no fixed length",
    "runs*.versions.*": "of the installation",
    "runs*.hardware.*": "of the machine",
    "runs*.git*": "of the checkout",
    "*.evidence.trace.sha256": "of a file with processor times",
}
"""Patterns of places that differ between runs, each with the reason.

A place is the document's schema (or file) and the keys below it, joined by dots.
"""

# ----------------------------------------------------------------------------------------- pinned inputs

SPECS = (
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("specs/**/*.stl")),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("examples/tasks/*.stl")),
)
SYSTEMS = (
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("examples/*.yaml")),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("examples/tasks/*.yaml")),
)
MORE = {"manipulation": " --system panda", "manipulation_rules": " --system panda"}
"""Further arguments of `check` besides specification and trace."""
PARAMETERS = {"ship_radius": ("radius", 0.9), "stop_time": ("stop_time", 1.0)}
"""Trace columns of the parameters of specifications."""
SEMANTICS = ("exact", "smooth", "agm", "dgmsr")
FORMULAS = 300
STATES = 6
"""Starts of each system for guards' decisions; as many states from each of the later `LEGS`."""
LEGS = 2


@dataclass(frozen=True)
class Training:
    """A short training: the name of its run, its specification, steps and method."""

    name: str
    spec: str
    steps: int = 60
    method: str = "guided"


TRAININGS = (
    Training("traffic", "specs/traffic.stl", 150),
    Training("ship_safe", "specs/ship_safe.stl", 150),
    Training("traffic_gradient", "specs/traffic.stl", 60, "gradient"),
    Training("ship_track", "specs/ship_track.stl"),
    Training("navigation", "specs/navigation.stl"),
    Training("patrol", "specs/patrol.stl"),
    Training("quadrotor_rotors", "examples/tasks/quadrotor_rotors.stl"),
)
GUARDED = tuple(training.name for training in TRAININGS if training.method == "guided")


class Place:
    """The working folder of one set of pins: a copy of specifications and systems, and the runs.

    Args:
        work: an empty folder.
        kept: folder of stored runs, by the training's name, or None to train.
    """

    def __init__(self, work: Path, kept: Path | None) -> None:
        self.work, self.kept = work, kept
        self.trained: dict[str, dict[str, Any]] = {}
        for name in ("specs", "examples"):
            shutil.copytree(ROOT / name, work / name, ignore=shutil.ignore_patterns("__pycache__", "runs"))

    def train(self, training: Training) -> dict[str, Any]:
        """Train once, in a separate process; return the outcome of the command."""
        if training.name not in self.trained:
            folder = f"trained/{training.name}"
            words = (
                f"train {training.spec} --seed 0 --steps {training.steps} --method {training.method}"
                f" --threads 1 --held-out 200 --drives 0 --no-pictures --name pinned --runs {folder} --json"
            )
            self.trained[training.name] = self.apart(words)
        return self.trained[training.name]

    def fresh(self, training: Training) -> Path:
        """The folder of a run trained here."""
        outcome = self.train(training)
        folders = sorted((self.work / "trained" / training.name).glob("*/0001-*"))
        if not folders:
            raise RuntimeError(f"{outcome['command']}\n{json.dumps(outcome['document'], indent=1)}")
        return folders[0]

    def run(self, name: str) -> Path:
        """The folder, relative to `work`, of a run to use: a stored one's copy, else one trained here."""
        target = Path("runs") / name / "0001-pinned"
        if not (self.work / target).is_dir():
            kept = None if self.kept is None else self.kept / name
            if kept is None or not kept.is_dir():
                kept = self.fresh(next(each for each in TRAININGS if each.name == name))
            shutil.copytree(kept, self.work / target)
        return target

    # ---------------------------------------------------------------------- commands

    def apart(self, words: str) -> dict[str, Any]:
        """The outcome of `stlc …` in a separate process."""
        found = subprocess.run(
            [sys.executable, "-m", "stlc", *words.split()],
            cwd=self.work,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        return self._outcome(words, found.returncode, found.stdout, found.stderr)

    def stlc(self, words: str, given: str | None = None) -> dict[str, Any]:
        """The outcome of `stlc …` with `given` on the standard input: exit code and document or text."""
        out, err, before = io.StringIO(), io.StringIO(), sys.stdin
        sys.stdin = io.TextIOWrapper(io.BytesIO((given or "").encode()), encoding="utf-8")
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code = stlc_main(words.split())
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else 1
        finally:
            sys.stdin = before
            torch.set_num_threads(1)
        return self._outcome(words, code, out.getvalue(), err.getvalue())

    def _outcome(self, words: str, code: int, text: str, talk: str) -> dict[str, Any]:
        text, talk = (
            each.replace(str(self.work), "<work>").replace(str(ROOT), "<root>") for each in (text, talk)
        )
        found: dict[str, Any] = {"command": f"stlc {words}", "exit_code": code}
        try:
            document = json.loads(text)
        except ValueError:
            return {**found, "text": text.splitlines(), "stderr": talk.splitlines()}
        schema = document.get("schema", "") if isinstance(document, dict) else ""
        return {**found, "document": masked(document, schema)}


def masked(value: Any, place: str) -> Any:
    """The JSON value with volatile places replaced by their reasons."""
    for pattern, reason in VOLATILE.items():
        if value is not None and fnmatch.fnmatchcase(place, pattern):
            return f"<{reason}>"
    if isinstance(value, dict):
        return {name: masked(each, f"{place}.{name}") for name, each in value.items()}
    if isinstance(value, list):
        return [masked(each, f"{place}.{index}") for index, each in enumerate(value)]
    return value


Pins = Iterator[tuple[str, Any]]
"""Pairs of a pin's name, such as `traffic/compile`, and its value: JSON or text."""


def stem(path: str) -> str:
    """The name of a file without suffix; with its folder, `tasks-either_or`, if another is called alike."""
    file = Path(path)
    alike = [each for each in (*SPECS, *SYSTEMS) if Path(each).name == file.name]
    return f"{file.parent.name}-{file.stem}" if len(alike) > 1 else file.stem


# ---------------------------------------------------------------------------------------------- documents


def documents(place: Place) -> Pins:
    """Pins of documents about specifications, systems, codes and schemas."""
    for spec in SPECS:
        for name, words in {
            "compile": "compile {} --json",
            "dump": "compile {}",
            "lint": "lint {} --select ALL --json",
            "explain": "explain {} --json",
            "parse": "compile {} --show ast --json",
            "fmt": "fmt {} --check --json",
        }.items():
            yield f"{stem(spec)}/{name}", place.stlc(words.format(spec))
    for system in SYSTEMS:
        yield f"system-{stem(system)}/show", place.stlc(f"system show {system} --json")
        yield f"system-{stem(system)}/check", place.stlc(f"system check {system} --json")
    codes = place.stlc("explain --json")
    yield "codes/all", codes
    for code in sorted(set(re.findall(r'"([EWSRU]\d{3})"', json.dumps(codes)))):
        yield f"codes/{code}", place.stlc(f"explain {code} --json")
    yield "codes/precedence", place.stlc("explain precedence --json")
    schemas = place.stlc("schema")
    yield "schemas/all", schemas
    for schema in sorted(set(re.findall(r"[a-z][a-z-]*/\d+", json.dumps(schemas)))):
        yield f"schemas/{schema.replace('/', '-')}", place.stlc(f"schema {schema}")
    for number, words in enumerate(WRONG):
        yield f"wrong/{number:02d}", place.stlc(words)


WRONG = tuple(
    line.strip()
    for line in """
    compile specs/nowhere.stl --json
    compile specs/traffic.stl --set T_red=3m --json
    compile specs/traffic.stl --set nothing=3 --json
    check specs/traffic.stl nowhere.csv --json
    lint examples/car.yaml --json
    system show nowhere --json
    explain E999 --json
    runs show nothing --json
    train specs/traffic.stl --method none --json
    """.strip().splitlines()
)
"""Command lines that are rejected."""

# ----------------------------------------------------------------------------------------------- verdicts


def table(columns: Mapping[str, Sequence[float]], dt: float, keep: Callable[[int], bool] = bool) -> str:
    """A CSV table with a clock `t` of the selected samples; sample 0 is always included."""
    clock = [round(k * dt, 9) for k in range(len(next(iter(columns.values()))))]
    rows = zip(clock, *columns.values(), strict=True)
    lines = [",".join(("t", *columns))]
    lines += [",".join(repr(float(v)) for v in row) for k, row in enumerate(rows) if k == 0 or keep(k)]
    return "\n".join(lines) + "\n"


def wander(system: System, seed: int, legs: int = 3) -> tuple[dict[str, list[float]], float]:
    """Columns of a nominal rollout under piecewise constant random controls, and the time step."""
    generator = torch.Generator().manual_seed(seed)
    x = system.sample(1, generator=generator, dtype=torch.float64)
    parts = []
    for _ in range(legs):
        u = controls(system, 1, generator)
        states = system.rollout(x, u)
        parts.append(states[0, :-1])
        x = states[:, -1]
    path = torch.cat((*parts, x))
    return {name: path[:, i].tolist() for i, name in enumerate(system.names)}, float(system.dt)


def controls(system: System, count: int, generator: torch.Generator) -> torch.Tensor:
    """Random plans within the bounds of the controls, each value held for five steps: (count, T, m)."""
    low, high = system.control_low.double(), system.control_high.double()
    held = torch.rand(count, system.horizon // 5 + 1, len(low), generator=generator, dtype=torch.float64)
    u: torch.Tensor = low + (high - low) * held.repeat_interleave(5, 1)[:, : system.horizon]
    return u


def transmission() -> dict[str, list[float]]:
    """A recorded trace of the one specification without a system."""
    rng = random.Random(5)
    speed, rpm, throttle, gear = [0.0], [900.0], [40.0], [1.0]
    for k in range(1, 400):
        throttle.append(float(rng.choice((20, 60, 100))) if k % 50 == 0 else throttle[-1])
        speed.append(max(0.0, speed[-1] + 0.012 * throttle[-1] - 0.001 * speed[-1] - 0.2))
        gear.append(float(min(4, 1 + int(speed[-1] // 30))))
        rpm.append(900 + 130 * speed[-1] / gear[-1])
    return {"speed": speed, "rpm": rpm, "throttle": throttle, "gear": gear}


def verdicts(place: Place) -> Pins:
    """Pins of verdicts on traces of every shipped specification, with all options."""
    for number, spec in enumerate(SPECS):
        name = stem(spec)
        if spec.endswith("/transmission.stl"):
            columns, dt = transmission(), 0.05
        elif spec.startswith("specs/arch/"):  # closed loops of many thousand steps
            continue
        else:
            columns, dt = wander(system_of(place, spec), number)
        if name in PARAMETERS:
            parameter, value = PARAMETERS[name]
            columns[parameter] = [value] * len(next(iter(columns.values())))
        (place.work / f"{name}.csv").write_text(table(columns, dt), encoding="utf-8")
        holes = table(columns, dt, lambda k: k % 11 not in (4, 5, 6))
        (place.work / f"{name}_holes.csv").write_text(holes, encoding="utf-8")
        short = {signal: values[: max(4, len(values) // 8)] for signal, values in columns.items()}
        (place.work / f"{name}_short.csv").write_text(table(short, dt), encoding="utf-8")
        yield from judged(place, spec, dt)


def system_of(place: Place, spec: str) -> System:
    """The system that a specification names."""
    named = re.search(r'^system "(.*)"', (place.work / spec).read_text(encoding="utf-8"), re.MULTILINE)
    assert named is not None, spec
    return System.load((place.work / spec).parent / named[1])


def judged(place: Place, spec: str, dt: float) -> Pins:
    """Output of `check` and `explain` on the traces of one specification."""
    name = stem(spec)
    start, more = f"check {spec} {name}", MORE.get(name, "")
    for semantics in SEMANTICS:
        yield f"{name}/{semantics}", place.stlc(f"{start}.csv --semantics {semantics} --json{more}")
    for label, words in {
        "text": f"{start}.csv",
        "all": f"{start}.csv --at all --json",
        "at-0": f"{start}.csv --at 0 --tolerance 0 --json",
        "truncate": f"{start}.csv --at all --end truncate --json",
        "short-open": f"{start}_short.csv --json",
        "short-all": f"{start}_short.csv --at all --json",
        "short-strict": f"{start}_short.csv --end strict --json",
        "short-truncate": f"{start}_short.csv --end truncate --json",
        "holes-refused": f"{start}_holes.csv --json",
        "holes-held": f"{start}_holes.csv --resample {dt}s --max-gap {10 * dt}s --json",
        "holes-unknown": f"{start}_holes.csv --resample {dt}s --max-gap {2 * dt}s --at all --json",
        "chunks": f"{start}.csv --chunk 16 --json",
        "both": f"{start}.csv {name}_short.csv --json",
        "explain": f"explain {name}.csv --spec {spec} --json",
    }.items():
        yield f"{name}/{label}", place.stlc(words + more)
    text = (place.work / f"{name}.csv").read_text(encoding="utf-8")
    yield f"{name}/stream", place.stlc(f"check {spec} - --json{more}", text)
    beginning = "\n".join(text.splitlines()[:9]) + "\n"
    yield f"{name}/stream-short", place.stlc(f"check {spec} - --at all{more}", beginning)
    place.stlc(f"{start}.csv --out {name}_out.npz --json{more}")
    yield f"{name}/signals", arrays(place.work / f"{name}_out.npz")
    place.stlc(f"{start}.csv --out {name}_out.csv --json{more}")
    out = place.work / f"{name}_out.csv"
    yield f"{name}/signals-csv", out.read_text(encoding="utf-8") if out.is_file() else "<none>"


def arrays(path: Path) -> Any:
    """Arrays of an npz by name, in full precision; None if there is no file."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as found:
        numbers = {key: found[key] for key in sorted(found.files)}
    return {key: value.tolist() for key, value in numbers.items() if value.dtype.kind in "biuf"}


# ----------------------------------------------------------------------------------------------- formulas


def formulas(place: Place) -> Pins:
    """Pins of random formulas on random traces, 50 per file."""
    del place
    for block in range(0, FORMULAS, 50):
        yield f"{block:04d}", {f"{seed:04d}": formula(*drawn(seed)) for seed in range(block, block + 50)}


def drawn(seed: int) -> tuple[str, dict[str, Any]]:
    """A random specification and its signals."""
    case = Case(seed, Taste(bools=seed % 3 == 0))
    return case.text, case.signals


def formula(text: str, signals: Mapping[str, Any]) -> dict[str, Any]:
    """All results of a monitor for one formula on one trace."""
    monitor = Monitor(text, dt=DT, horizon=HORIZON * DT)
    low, high = monitor.bounds(signals)
    return {
        "text": text,
        "signals": {name: np.asarray(values).tolist() for name, values in signals.items()},
        "bounds": [low.tolist(), high.tolist()],
        "strict": monitor.robustness(signals).tolist(),
        "truncate": {
            name: monitor.robustness(signals, end="truncate", semantics=name).tolist() for name in SEMANTICS
        },
        "horizon": monitor.horizon,
        "statuses": statuses(monitor, signals),
        "online": online(monitor, signals),
    }


def statuses(monitor: Monitor, signals: Mapping[str, Any]) -> Any:
    """Verdicts at all starts, by requirement."""
    found = monitor.check(signals, at="all")
    return {
        each.name: {"status": str(each.status), "holds": each.holds.tolist(), "fails": each.fails.tolist()}
        for each in found
    }


def online(monitor: Monitor, signals: Mapping[str, Any]) -> list[list[Any]]:
    """Decisions of the online monitor, with the deciding sample of each."""
    run, found = monitor.online(), []
    for k in range(len(signals["x"])):
        run.push({name: values[k] for name, values in signals.items()})
        for each in run.verdicts():
            bounds = run.bounds(each.requirement, each.start)
            found.append([k, each.requirement, each.start, str(each.status), *bounds, each.sample])
    return found


# --------------------------------------------------------------------------------- C, training, and runs


def emitted(place: Place) -> Pins:
    """Pins of the C texts of every specification with a system, with their sha256."""
    for spec in SPECS:
        if spec.endswith("/transmission.stl"):
            continue
        try:
            texts = kernels(Task.of(load(place.work / spec), system_of(place, spec)))
        except Exception as error:  # tasks without a kernel are pinned too
            yield f"{stem(spec)}/none", {"error": type(error).__name__, "says": str(error)}
            continue
        yield f"{stem(spec)}/sha256", {name: sha256(text.encode()) for name, text in texts.items()}
        for name, text in texts.items():
            yield f"{stem(spec)}/{name}", text


def sha256(content: bytes) -> str:
    """The hexadecimal digest."""
    return hashlib.sha256(content).hexdigest()


def training(place: Place) -> Pins:
    """Pins of trainings: checkpoints by tensor and by file, and the training log."""
    from safetensors.numpy import load_file

    for each in TRAININGS:
        yield f"{each.name}/document", place.train(each)
        folder = place.fresh(each)
        state = json.loads((folder / "ckpt/last.json").read_text(encoding="utf-8"))
        path = folder / "ckpt" / state["file"]
        tensors = {
            name: {"shape": list(t.shape), "dtype": str(t.dtype), "sha256": sha256(t.tobytes())}
            for name, t in sorted(load_file(path).items())
        }
        yield f"{each.name}/tensors", tensors
        yield f"{each.name}/file", {"bytes": path.stat().st_size, "sha256": sha256(path.read_bytes())}
        yield f"{each.name}/state", masked(state, "ckpt")
        lines = (folder / "train.jsonl").read_text(encoding="utf-8").splitlines()
        yield f"{each.name}/curve", masked([json.loads(line) for line in lines], "train.jsonl")
        yield f"{each.name}/config", (folder / "config.resolved.yaml").read_text(encoding="utf-8")
        yield f"{each.name}/compiled", (folder / "compiled.txt").read_text(encoding="utf-8")
        yield f"{each.name}/held-out", arrays(folder / "eval/held_out.npz")


def plans(place: Place) -> Pins:
    """Pins of verdicts, costs and gradients of random plans from fixed states."""
    for name in GUARDED:
        task = Run.open(place.work / place.run(name)).task
        generator = torch.Generator().manual_seed(3)
        x = task.sample(8, generator=generator, dtype=torch.float64)
        u = controls(task.system, 8, generator)
        judged = task.judge(x, u)
        found = {
            "names": list(task.system.names),
            "states": x.tolist(),
            "rho": judged.rho.tolist(),
            "safe": judged.safe.tolist(),
            "requirements": judged.requirements.tolist(),
            "cost": task.cost(judged).tolist(),
            "alive": task.alive(x).tolist(),
            "reached": task.rollout(x, u)[:, -1].tolist(),
        }
        for label, smoothing in (("exact", None), ("smooth", 10.0)):
            leaf = u.clone().requires_grad_()
            rho = task.robustness(task.rollout(x, leaf), smoothing)
            (slope,) = torch.autograd.grad(rho.sum(), leaf)
            found[label] = {"rho": rho.tolist(), "gradient": slope.tolist()}
        yield name, found


def guards(place: Place) -> Pins:
    """Pins of decisions of all guards for starts and later states, with and without a previous plan."""
    for name in GUARDED:
        run = Run.open(place.work / place.run(name))
        modes = [("none", "none", NO_LIMIT), ("paper", "paper", NO_LIMIT), ("full", "full", NO_LIMIT)]
        if run.task.compiled.safety:
            modes += [(f"{mode}-margin", mode, with_margin(run.task)) for mode in ("paper", "full")]
        x = on_the_way(run.task, run.policy, STATES, LEGS)
        for label, mode, limits in modes:
            yield f"{name}/{label}", decided(Guard(run.task, run.policy, mode, limits=limits), x)


def on_the_way(task: Task, policy: Any, count: int, legs: int) -> torch.Tensor:
    """Starts, and states reached by the policy's plans after each third of a horizon."""
    x = task.sample(count, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    found = [x]
    for _ in range(legs):
        x = task.rollout(x, policy.plan(x))[:, max(task.horizon // 3, 1)]
        found.append(x)
    return torch.cat(found)


def decided(guard: Guard, x: torch.Tensor) -> dict[str, Any]:
    """A decision for states, and one for the next states with the previous plan."""
    first = guard.decide(x)
    later = guard.task.rollout(x, first.plan)[:, 1]
    rest = first.later()
    left = guard.task.horizon - 2
    return {
        "states": x.tolist(),
        "first": said(first),
        "endangered": guard.endangered(later, rest, left).tolist(),
        "second": said(guard.decide(later, rest)),
        "preferred": guard.prefer(torch.stack((later, x), 1), rest).tolist(),
    }


def said(decision: Any) -> dict[str, Any]:
    """A decision as JSON values, agent by agent."""
    names = ("action", "source", "t0", "rho", "safe", "policy_rho", "plan")
    return {name: getattr(decision, name).tolist() for name in names}


def runs(place: Place) -> Pins:
    """Pins of simulations, exports, reports and lists of finished runs."""
    for name in GUARDED:
        run = place.run(name).as_posix()
        world = f"simulate {run} --seeds 0..1 --steps 12 --agents 2 --no-pictures --json"
        for guard, limit in (("none", ""), ("paper", ""), ("full", " --time-limit none")):
            record = f"--record {name}_{guard}.npz"
            yield f"{name}/simulate-{guard}", place.stlc(f"{world} --guard {guard}{limit} {record}")
            yield f"{name}/trace-{guard}", arrays(place.work / f"{name}_{guard}.npz")
        yield f"{name}/disturbed", place.stlc(f"{world} --guard paper --scenario disturb --record {name}.csv")
        csv = place.work / f"{name}.csv"
        yield f"{name}/trace-csv", csv.read_text(encoding="utf-8") if csv.is_file() else "<none>"
        trace = f"{name}_full.npz"
        for semantics in SEMANTICS:
            words = f"check {trace} --at all --semantics {semantics} --json"
            yield f"{name}/check-{semantics}", place.stlc(words)
        yield f"{name}/check-csv", place.stlc(f"check {run}/spec.stl {name}.csv --json")
        yield f"{name}/explain", place.stlc(f"explain {name}_none.npz --json")
        yield f"{name}/plot", place.stlc(f"plot {trace} -o {name}.svg --json")
        yield f"{name}/show", place.stlc(f"runs show {run} --json")
        yield f"{name}/export", place.stlc(f"export {run} --to c -o c_{name} --json")
        for path in sorted((place.work / f"c_{name}").glob("*.[ch]")):
            yield f"{name}/{path.name}", {"sha256": sha256(path.read_bytes()), "bytes": path.stat().st_size}
    yield "list", place.stlc("runs list --runs runs --json")
    yield "report", place.stlc(f"report {place.run('traffic').as_posix()} --json")


TRAINED = "trained"
"""Folder of the trained policies, beside those of the parts."""

PARTS: Mapping[str, Callable[[Place], Pins]] = {
    "documents": documents,
    "verdicts": verdicts,
    "formulas": formulas,
    "emitted": emitted,
    "training": training,
    "plans": plans,
    "guards": guards,
    "runs": runs,
}

# --------------------------------------------------------------------------------------------- comparison


@dataclass(frozen=True)
class Difference:
    """A changed value: its pin and the place within, the old and the new value."""

    where: str
    old: Any
    new: Any

    def __str__(self) -> str:
        return f"{self.where}\n  old  {_short(self.old)}\n  new  {_short(self.new)}"


ABSENT = "<absent>"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 300 else f"{text[:300]}… ({len(text)} characters)"


def differences(where: str, old: Any, new: Any, tolerance: float = 0.0) -> Iterator[Difference]:
    """Differences of two values; floats may differ by `tolerance`, relative to the larger one or 1e-3."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from differences(f"{where}.{key}", old.get(key, ABSENT), new.get(key, ABSENT), tolerance)
    elif isinstance(old, list) and isinstance(new, list):
        for index, (a, b) in enumerate(zip_longest(old, new, fillvalue=ABSENT)):
            yield from differences(f"{where}[{index}]", a, b, tolerance)
    elif isinstance(old, str) and isinstance(new, str) and "\n" in old + new:
        if old != new:
            a, b = old.splitlines(), new.splitlines()
            at = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
            yield Difference(
                f"{where}:{at + 1}", "\n       ".join(a[at : at + 3]), "\n       ".join(b[at : at + 3])
            )
    elif not _same(old, new, tolerance):
        yield Difference(where, old, new)


def _same(old: Any, new: Any, tolerance: float) -> bool:
    if isinstance(old, bool) or isinstance(new, bool) or type(old) is not type(new):
        numbers = (int, float)
        mixed = type(old) in numbers and type(new) in numbers and tolerance > 0
        if not mixed:
            return type(old) is type(new) and old == new
    if isinstance(old, float | int) and isinstance(new, float | int):
        if old == new or (math.isnan(old) and math.isnan(new)):
            return old != 0 or math.copysign(1, old) == math.copysign(1, new) or tolerance > 0
        return math.isfinite(old) and abs(old - new) <= tolerance * max(abs(old), abs(new), 1e-3)
    return bool(old == new)


def text_of(value: Any) -> tuple[str, str]:
    """Suffix and content of the file of a pin."""
    if isinstance(value, str):
        return ".txt", value
    return ".json", json.dumps(value, indent=1, ensure_ascii=False) + "\n"


def read(path: Path) -> Any:
    """A pin from its file."""
    text = path.read_text(encoding="utf-8")
    return json.loads(text) if path.suffix == ".json" else text


def compared(folder: Path, pins: Pins, tolerance: float) -> Iterator[Difference]:
    """Differences of a part: changed, missing and new pins."""
    before = {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.*"))
    }
    part = folder.name
    for name, value in pins:
        name = name.replace(".", "_")
        path = before.pop(name, None)
        if path is None:
            yield Difference(f"{part}/{name}", ABSENT, "<new>")
        else:
            suffix, text = text_of(value)
            new = json.loads(text) if suffix == ".json" else text
            yield from differences(f"{part}/{name}", read(path), new, tolerance)
    for name in before:
        yield Difference(f"{part}/{name}", "<pinned>", ABSENT)


# --------------------------------------------------------------------------------------------- the command

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)
Only = Annotated[list[str] | None, typer.Option(help=f"Some of {', '.join(PARTS)}; all if not given.")]


def _chosen(only: Sequence[str] | None) -> list[str]:
    wrong = set(only or ()) - set(PARTS)
    if wrong:
        raise typer.BadParameter(f"no part `{sorted(wrong)[0]}`; there are {', '.join(PARTS)}")
    return [name for name in PARTS if not only or name in only]


@contextlib.contextmanager
def working(kept: Path | None) -> Iterator[Place]:
    """A place in a temporary folder, which is the working directory within the block."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="pins-") as folder, contextlib.chdir(folder):
        yield Place(Path(folder).resolve(), kept)


@app.command()
def write(where: Annotated[Path, typer.Argument(metavar="DIR")], only: Only = None) -> None:
    """Write the pins below DIR; existing parts are replaced."""
    where = where.resolve()
    for part in _chosen(only):
        began = time.process_time()
        with working(where / TRAINED if part != "training" else None) as place:
            made = where / f"{part}.new"
            shutil.rmtree(made, ignore_errors=True)
            count = 0
            for name, value in PARTS[part](place):
                suffix, text = text_of(value)
                path = made / (name.replace(".", "_") + suffix)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
                count += 1
            for each in (each for each in TRAININGS if each.name in place.trained):
                shutil.rmtree(where / TRAINED / each.name, ignore_errors=True)
                shutil.copytree(place.fresh(each), where / TRAINED / each.name)
        shutil.rmtree(where / part, ignore_errors=True)
        made.rename(where / part)
        print(f"{part}: {count} pins, {time.process_time() - began:.0f} s", flush=True)


@app.command()
def check(
    where: Annotated[Path, typer.Argument(metavar="DIR", exists=True, file_okay=False)],
    only: Only = None,
    tolerance: Annotated[float, typer.Option(help="Relative difference of floats that is none.")] = 0.0,
    anew: Annotated[bool, typer.Option("--anew", help="Use policies that are trained now.")] = False,
    most: Annotated[int, typer.Option(help="Differences of a part that are printed.")] = 40,
) -> None:
    """Compute the pins again and print every difference from those below DIR."""
    where, total = where.resolve(), 0
    with working(None if anew else where / TRAINED) as place:
        for part in _chosen(only):
            began, found = time.process_time(), 0
            if not (where / part).is_dir():
                print(f"{part}: not pinned in {where}")
                total += 1
                continue
            try:
                for found, difference in enumerate(compared(where / part, PARTS[part](place), tolerance), 1):
                    if found <= most:
                        print(difference, flush=True)
            except Exception as error:
                found += 1
                print(f"{part}: broke off\n  {type(error).__name__}: {error}")
            total += found
            more = f" ({found - most} more)" if found > most else ""
            print(f"{part}: {found} differences{more}, {time.process_time() - began:.0f} s", flush=True)
    raise typer.Exit(1 if total else 0)


if __name__ == "__main__":
    app()
