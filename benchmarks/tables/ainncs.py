"""Closed loops with networks of the ARCH-COMP category AINNCS: proofs and counterexamples, and their times.

The networks are not part of this repository. They are in the repeatability packages of JuliaReach
(github.com/JuliaReach/ARCH2023_AINNCS_RE, folder `models`), in the formats of MATLAB, NNet, YAML and ONNX.
Beside the results are those that other tools have published, from `benchmarks/results/ainncs_published.json`,
or instead those of a file `results.csv` that such a program writes: benchmark, instance, result, time.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any

import numpy as np
import typer
import yaml

from benchmarks.options import OnlyOption, Output, ResultsOption
from benchmarks.store import Key, Result, ResultStore, inputs_of
from benchmarks.table import WIDTH, Columns, listed, provenance, publish
from benchmarks.timing import one_thread
from stlc.assurance.verification.loop import NetworkLoop
from stlc.assurance.verification.network import NetworkLayer
from stlc.assurance.verification.onnx_layers import read_onnx
from stlc.assurance.verification.verify import Verifier
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.training.budget import clock_of
from stlc.diagnostics import usage
from stlc.files import File
from stlc.options import parse_seconds
from stlc.provenance import sha256

_OUTPUT = Output(Path("docs/assurance.md"))
TEXT = """\
Written by `python -m benchmarks ainncs FOLDER` from `benchmarks/results/ainncs.json`: networks of the
ARCH-COMP category AINNCS, for the exact solutions of the differential equations (`--continuous`) at the
samples. `proved` and `refuted`: shares of the initial set. The result is `verified` if all of it is proved,
`falsified` if a counterexample was found, which ends the search. `violations`: random points of proved boxes
whose simulation violates the specification. Time is processor time of one thread. `published`: results and
times of other tools, read from the sources below; each is from the machine of its authors, whose processor is
not named there. No entry: nothing was found for the same instance.
"""
PUBLISHED = "ainncs_published.json"


@dataclass(frozen=True, slots=True)
class Case:
    """Closed loop of the competition.

    Attributes:
        name: name of the instance.
        spec: name of the specification in `examples/ainncs`.
        network: file of the network below the folder of the models.
        steps: control period in time steps.
        other: names of the benchmark and the instance in `results.csv`.
    """

    name: str
    spec: str
    network: str
    steps: int = 1
    other: tuple[str, str] = ("", "")


_TORA = "Sherlock-Benchmark-9-TORA"
CASES = (
    Case("ACC, ReLU", "acc", "ACC/controller_5_20.mat", 1, ("ACC", "relu")),
    Case("ACC, tanh", "acc", "ACC/tanh.yml", 1, ("ACC", "tanh")),
    Case("TORA, ReLU", "tora", f"{_TORA}/controllerTora.mat", 10, ("TORA", "relu")),
    Case("TORA, ReLU and tanh", "tora_reach", f"{_TORA}/nn_tora_relu_tanh.mat", 5, ("TORA", "relutanh")),
    Case("TORA, sigmoid", "tora_reach", f"{_TORA}/nn_tora_sigmoid.mat", 5, ("TORA", "sigmoid")),
    Case(
        "unicycle",
        "unicycle",
        "Sherlock-Benchmark-10-Unicycle/controllerB_nnv.mat",
        1,
        ("Unicycle", "constant w"),
    ),
    Case(
        "attitude control",
        "attitude",
        "AttitudeControl/attitude_control_3_64_torch.onnx",
        1,
        ("AttitudeControl", ""),
    ),
    Case(
        "single pendulum",
        "single_pendulum",
        "Single-Pendulum/controller_single_pendulum.nnet",
        1,
        ("SinglePendulum", ""),
    ),
    *(
        Case(
            f"double pendulum, {kind} robust",
            f"double_pendulum_{kind}",
            f"Double-Pendulum/controller_double_pendulum_{kind}_robust.nnet",
            1,
            ("DoublePendulum", f"{kind} robust"),
        )
        for kind in ("less", "more")
    ),
)


@dataclass(frozen=True, slots=True)
class AinncsRow:
    """Result for one closed loop.

    Attributes:
        name: name of the instance.
        proved: share of proved boxes.
        refuted: share of boxes with a counterexample.
        violated: whether a counterexample was found.
        seconds: processor time.
        boxes: number of examined boxes.
        violations: number of violations among random points of proved boxes.
        points: number of these points.
        published: results and times of other tools; "" if there are none.
    """

    name: str
    proved: float
    refuted: float
    violated: bool
    seconds: float
    boxes: int
    violations: int
    points: int
    published: str = ""

    @property
    def result(self) -> str:
        """Result in the words of the competition."""
        return "falsified" if self.violated else "verified" if self.proved >= 1.0 - 1e-9 else "unknown"


COLUMNS: Columns[AinncsRow] = {
    "instance": "{name}",
    "result": "{result}",
    "proved": "{proved:.1%}",
    "refuted": "{refuted:.1%}",
    "boxes": "{boxes:,}",
    "time": "{seconds:.1f} s",
    "violations": "{violations} / {points:,}",
    "published": "{published}",
}


@command(
    "python -m benchmarks ainncs ARCH2023_AINNCS_RE/models",
    "python -m benchmarks ainncs models --only acc,tora --published results/results.csv",
)
def ainncs(
    models: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the models with their networks.")
    ],
    budget: Annotated[
        str, typer.Option("--budget", metavar="TIME", help="Processor time of each instance at most.")
    ] = "5min",
    published: Annotated[
        Path | None,
        typer.Option(
            "--published",
            metavar="FILE",
            help="Shown instead of the published results: benchmark,instance,result,time.",
        ),
    ] = None,
    only: OnlyOption = None,
    out: ResultsOption = Path("benchmarks/results"),
    output: Output = _OUTPUT,
) -> None:
    """Verify closed loops of the ARCH-COMP category AINNCS, and write the table.

    Results are stored, and not computed again while specification, system and network are the same.
    """
    store = ResultStore("ainncs", out)
    wanted = None if only is None else set(only.split(","))
    chosen = [case for case in CASES if wanted is None or case.spec in wanted]
    tools = published_in(out) if published is None else []
    known = _texts(tools) if published is None else _others(published)
    results = [_verified(case, models, parse_seconds(budget), store) for case in chosen]

    def rows(every: Sequence[Result]) -> list[AinncsRow]:
        return [AinncsRow(**each["row"], published=known.get(each["row"]["name"], "")) for each in every]

    def section() -> list[str]:
        every = [*store.all().values()]
        return [
            TEXT,
            *listed("ainncs", rows(every), COLUMNS).markdown(),
            "",
            *provenance(every, "closed loops"),
            *(line for tool in tools for line in _source(tool)),
        ]

    publish("ainncs", output, section, {"rows": listed("ainncs", rows(results), COLUMNS)})


def _verified(case: Case, models: Path, seconds: float, store: ResultStore) -> Result:
    """Result of a case, from the store or computed."""
    path = models / case.network
    if not path.is_file():
        raise usage(
            f"there is no network `{path}`", "git clone https://github.com/JuliaReach/ARCH2023_AINNCS_RE"
        )
    task = Task.load(File.SYSTEMS / "ainncs" / f"{case.spec}.stl")
    values = {**inputs_of(task), "network": sha256(path.read_bytes()), "seconds": seconds}

    def compute() -> Result:
        one_thread()
        say(f"verifying {case.name}")
        subject = NetworkLoop(task, layers_of(path), case.steps, continuous=True)
        found = Verifier(subject, clock=clock_of("processor")).run(seconds, until_refuted=True)
        (result,) = found.modes
        rng, violations, points = np.random.default_rng(11), 0, 0
        each = max(1, 10_000 // max(1, len(result.boxes)))
        for box in result.boxes:
            at = box.centre + rng.uniform(-1.0, 1.0, (each, len(box.half))) * box.half
            violations += int(TOLERANCE.violated(subject.robustness(subject.states(result.mode, at))).sum())
            points += each
        row = {
            "name": case.name,
            "proved": result.proved,
            "refuted": result.refuted,
            "violated": result.witness is not None,
            "seconds": found.seconds,
            "boxes": result.examined,
            "violations": violations,
            "points": points,
        }
        return {"row": row}

    return store.get(Key(case.name, values), compute)


def published_in(folder: Path) -> list[dict[str, Any]]:
    """Return the published results of other tools in a folder of results, tool by tool."""
    path = folder / PUBLISHED
    return list(json.loads(path.read_text(encoding="utf-8"))["tools"]) if path.is_file() else []


def _texts(tools: Sequence[Mapping[str, Any]]) -> Mapping[str, str]:
    """Published results as text: name of the instance -> tools with result and time."""
    texts: dict[str, list[str]] = {}
    for tool in tools:
        for each in tool["results"]:
            told = ", ".join(filter(None, (each.get("result"), _duration(each.get("seconds")))))
            texts.setdefault(each["instance"], []).append(f"{tool['tool']}: {told}")
    return {name: "; ".join(parts) for name, parts in texts.items()}


def _source(tool: Mapping[str, Any]) -> list[str]:
    """Markdown bullet on where the results of a tool were read, line by line."""
    at = f"github.com/{tool['repository']} at `{tool['commit'][:10]}`, `{tool['path']}`"
    line = f"- {tool['tool']}, {tool['year']}: {tool['about']}; {at}"
    return wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _duration(seconds: float | None) -> str:
    """Time as text: two digits of seconds, from 99 s on whole minutes."""
    if seconds is None:
        return ""
    return f"{seconds:.2g} s" if seconds < 99 else f"{seconds / 60:.0f} min"


def _others(path: Path) -> Mapping[str, str]:
    """Results in a file of another program as text: name of the instance -> result and time."""
    with path.open(encoding="utf-8", newline="") as file:
        found = {
            (row["benchmark"], row["instance"]): f"{row['result']}, {float(row['time']):.1f} s"
            for row in csv.DictReader(file)
        }
    return {case.name: found[case.other] for case in CASES if case.other in found}


# --------------------------------------------------------------------------------- networks


def layers_of(path: Path) -> list[NetworkLayer]:
    """Read a network in one of the formats of the models.

    Raises:
        UsageError: U101, the file has another format.
    """
    match path.suffix:
        case ".onnx":
            return read_onnx(path)
        case ".mat":
            return _matlab(path)
        case ".yml":
            return _yaml(path)
        case ".nnet":
            return _nnet(path)
        case _:
            raise usage(f"`{path}` is not a network in a known format")


def _matlab(path: Path) -> list[NetworkLayer]:
    """Read a file of MATLAB with the weights W, the biases b and the names of the activations."""
    from scipy.io import loadmat

    found = loadmat(str(path))
    names = [str(name).strip() for name in np.asarray(found["act_fcns"]).ravel()]
    weights = [np.asarray(each, dtype=float) for each in found["W"].ravel()]
    biases = [np.asarray(each, dtype=float).ravel() for each in found["b"].ravel()]
    return [
        NetworkLayer(weight.reshape(weight.shape[:2]), bias, name)
        for weight, bias, name in zip(weights, biases, names[: len(weights)], strict=True)
    ]


def _yaml(path: Path) -> list[NetworkLayer]:
    """Read a file with weights, offsets and activations by the number of the layer."""
    found: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        NetworkLayer(
            np.array(found["weights"][number], dtype=float),
            np.array(found["offsets"][number], dtype=float),
            str(found["activations"][number]).lower(),
        )
        for number in sorted(found["weights"])
    ]


def _nnet(path: Path) -> list[NetworkLayer]:
    """Read a file in the format NNet (Julian 2016): ReLU layers and a linear one, without its scaling."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("//")]
    rows = [[float(each) for each in re.findall(r"[^,\s]+", line)] for line in lines]
    count, sizes, at = int(rows[0][0]), [int(size) for size in rows[1]], 7
    layers = []
    for number in range(count):
        width = sizes[number + 1]
        weight, bias = np.array(rows[at : at + width]), np.array(rows[at + width : at + 2 * width]).ravel()
        layers.append(NetworkLayer(weight, bias, "relu" if number < count - 1 else "linear"))
        at += 2 * width
    return layers
