"""The base installation: every command either runs without torch, or names the extra that it needs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from stlc.cli.framework import app
from stlc.extras import CPU_BUILD, installation

ROOT = Path(__file__).resolve().parent.parent
FILES = {
    "low.stl": "signal x\nrequire low: always[0 s, 2 s] x < 5\n",
    "low.csv": "t,x\n0,1\n1,2\n2,9\n",
    "sum.py": """class Sum:
    def reset(self, initial, params):
        self.x = initial["x"]
        return {"x": self.x}

    def step(self, inputs):
        self.x += 1
        return {"x": self.x}
""",
    "sum.yaml": "plant: 1\nname: sum\npython: 'sum.py:Sum'\ntime: {dt: 1 s, duration: 2 s}\n"
    "initial: {x: {range: [0, 1]}}\noutput: {x: }\n",
}
TRAFFIC = ["specs/traffic.stl", "--system", "car.yaml"]
SUM = ["low.stl", "--plant", "sum.yaml"]
RUN = {
    "--version": 0,
    "--help": 0,
    "help train": 0,
    "doctor": 0,
    "schema check/1": 0,
    "check low.stl low.csv": 1,
    "explain E203": 0,
    "explain low.csv --spec low.stl --require low": 1,
    "explain low.stl": 0,
    "lint low.stl": 0,
    "fmt --check low.stl": 0,
    "compile specs/traffic.stl": 0,
    "system show car.yaml": 0,
    "system list": 0,
    "init project": 0,
    "runs": 0,
    "simulate low.stl --plant sum.yaml --seeds 0..2": 0,
    "falsify low.stl --plant sum.yaml": 0,
    "certify low.stl --plant sum.yaml --share 0.5": 0,
}
"""Commands that run, and their exit codes."""
NEED = (
    "train specs/traffic.stl --system car.yaml",
    "plan specs/traffic.stl",
    "simulate latest",
    "falsify specs/traffic.stl --system car.yaml",
    "certify latest",
    "verify latest",
    "export latest",
    "report latest",
    "system check car.yaml",
)
"""Commands that need the extra `train`."""
PROGRAM = """
import contextlib, io, json, sys
sys.modules["torch"] = sys.modules["safetensors"] = None
from stlc.cli.framework.app import main
results = {}
for line in sys.argv[1:]:
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        code = main(line.split())
    results[line] = [code, err.getvalue()]
print(json.dumps(results))
"""


@dataclass(frozen=True)
class Said:
    """Result of a command."""

    code: int
    err: str


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("light")
    for name, text in FILES.items():
        (path / name).write_text(text, encoding="utf-8")
    return path


def python(folder: Path, program: str, *arguments: str) -> str:
    """Output of a program, where torch is not installed and the tree is."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{program}", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def said(folder) -> dict[str, Said]:
    return {line: Said(*each) for line, each in json.loads(python(folder, PROGRAM, *RUN, *NEED)).items()}


@pytest.mark.parametrize("line", RUN)
def test_a_command_that_runs(line, said):
    assert said[line].code == RUN[line], said[line].err
    assert "error[" not in said[line].err


@pytest.mark.parametrize("line", NEED)
def test_a_command_that_names_the_extra(line, said):
    assert said[line].code == 5
    assert "error[R301]: this needs `torch` of the extra `train`, which is not installed" in said[line].err
    assert CPU_BUILD in said[line].err
    assert installation("train") in said[line].err


def test_every_command_is_tried():
    tried = {line.split()[0] for line in (*RUN, *NEED)}
    assert set(app.PROGRAM.names()) - {"plot", "lsp"} == tried - {"--version", "--help"}


NAMES = """
sys.modules["torch"] = None
import stlc
names = {}
for name in stlc.__all__:
    try:
        getattr(stlc, name)
    except ImportError as error:
        names[name] = str(error)
try:
    stlc.compile(stlc.load("specs/traffic.stl"), None)
except ImportError as error:
    names["compile()"] = str(error)
try:
    import stlc.gym
except ImportError as error:
    names["gym"] = str(error)
assert stlc.Monitor("signal x\\nrequire r: always x > 0", dt=1.0).check({"x": [1.0, 2.0]}).satisfied
import json
print(json.dumps(names))
"""


def test_names_of_the_library(folder):
    names = json.loads(python(folder, NAMES))
    known = {"PlanResult", "Run", "System", "Task", "compile()", "gym"}
    assert set(names) == known | {"plan", "report", "train", "tube", "verify"}
    assert all("R301" in why for why in names.values())
