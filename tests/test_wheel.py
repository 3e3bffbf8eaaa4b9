"""The wheel: what is in it, and that it works where nothing else is installed, extras or not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_bytes
from email.message import Message
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="builds the wheel")
from helpers.installed import ROOT, Installed, Said, build_wheel, findings, install

SPECS = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "specs").rglob("*.stl"))
SYSTEMS = sorted(path.name for path in (ROOT / "examples").glob("*.yaml"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory) -> Installed:
    return install(wheel, tmp_path_factory.mktemp("bare") / "env")


@pytest.fixture(scope="module")
def training(wheel, tmp_path_factory) -> Installed:
    return install(wheel, tmp_path_factory.mktemp("training") / "env", "train")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_is_in_it(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    tracked = subprocess.run(
        ["git", "ls-files", "stlc", "examples", "specs"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    wanted = {name if name.startswith("stlc/") else f"stlc/library/{name}" for name in tracked}
    packed = {name for name in names if ".dist-info/" not in name}
    new = {name for name in packed - wanted if not (ROOT / name.replace("stlc/library/", "", 1)).is_file()}
    assert not wanted - packed
    assert not new  # what is not committed yet may be there
    assert not [name for name in names if "__pycache__" in name]
    assert sum(info.file_size for info in zipfile.ZipFile(wheel).infolist()) < 12_000_000


@pytest.mark.apart
def test_nothing_of_the_tree_is_seen(bare, folder):
    said = bare.python(folder, "import stlc, sys; print(stlc.__file__); print(sys.path)")
    assert said.out.startswith(str(bare.packages)), said.err
    assert str(ROOT) not in said.out
    assert bare.python(folder, "import pytest").code == 1
    assert bare.python(folder, "import matplotlib").code == 1


def named(pattern: str, system: Path) -> list[str]:
    """Names in the lines of a system file, such as its specification."""
    return re.findall(rf"^ *{pattern}: *([^\s#]+)", system.read_text(encoding="utf-8"), re.MULTILINE)


JUDGES = {Path(name).name for path in (ROOT / "examples").glob("*.yaml") for name in named("judge", path)}
"""Specifications that only judge drives: they may look back farther than a policy remembers."""


@pytest.mark.apart
def test_every_shipped_specification_compiles_and_names_what_is_there(bare, folder):
    lines = [["lint", str(bare.library / spec), "--json"] for spec in SPECS]
    lines += [
        ["compile", str(bare.library / spec), "--json"] for spec in SPECS if Path(spec).name not in JUDGES
    ]
    lines += [["system", "check", name, "--steps", "0", "--json"] for name in SYSTEMS]
    for line, said in zip(lines, bare.run(folder, *lines), strict=True):
        assert said.code == 0, (line, said.out)
    for system in (bare.library / "examples").glob("*.yaml"):
        specs = named("spec", system)
        assert specs, system
        for name in (*specs, *named("judge", system)):
            assert (system.parent / name).is_file()


@pytest.mark.apart
def test_a_specification_of_the_library_is_found_by_name(bare, folder):
    for said in bare.run(
        folder, ["compile", "specs/traffic.stl", "--json"], ["lint", "traffic.stl", "--json"]
    ):
        assert said.code == 0, said.out
    (said,) = bare.run(folder, ["compile", "specs/trafic.stl", "--json"])
    assert [finding["code"] for finding in findings(said)] == ["U102"]


@pytest.mark.apart
def test_every_example_begins_a_project(bare, folder):
    examples = [name.removesuffix(".yaml") for name in SYSTEMS]
    begun = bare.run(folder, *(["init", name, "--example", name] for name in examples))
    assert [said.code for said in begun] == [0] * len(examples)
    specs = sorted(folder.glob("*/specs/*.stl"))
    assert len(specs) >= len(examples)
    tasks = [str(spec) for spec in specs if spec.name not in JUDGES]
    for said in bare.run(folder, *(["compile", spec, "--json"] for spec in tasks)):
        assert said.code == 0, said.out
    for system in folder.glob("*/systems/*.yaml"):
        for name in named("judge", system):
            assert (system.parent / name).is_file()


THREE = (
    [
        *("train", "specs/traffic.stl", "--system", "car.yaml", "--steps", "3", "--held-out", "100"),
        *("--no-pictures", "--json"),
    ],
    ["simulate", "--backup", "--seeds", "0", "--steps", "3", "--agents", "4", "--no-pictures", "--json"],
    ["check", "trace.npz", "--json"],
    ["doctor", "--quick", "--json"],
)


@pytest.mark.apart
def test_the_three_commands_from_an_empty_folder(training, folder):
    train, simulate, check, doctor = training.run(folder, *THREE)
    assert train.code == 0, train.err
    assert simulate.code == 0, simulate.err
    assert check.code in (0, 1, 4), check.err
    assert doctor.code == 0, doctor.out


# ---------------------------------------------------------------------- extras

PARQUET = """
import pyarrow
from pyarrow.parquet import write_table
write_table(pyarrow.table({'t': [0., 1.], 'x': [1., 2.]}), 'a.parquet')
"""
MAT = """
import h5py
with h5py.File('a.mat', 'w', userblock_size=512) as f:
    for name, values in {'t': [[0., 1.]], 'x': [[1., 2.]]}.items():
        f.create_dataset(name, data=values).attrs['MATLAB_class'] = b'double'
with open('a.mat', 'r+b') as f:
    f.write(b'MATLAB 7.3 MAT-file'.ljust(116) + bytes(8) + bytes([0, 2]) + b'IM')
"""
MCAP = """
from mcap_ros2.writer import Writer
with open('a.mcap', 'wb') as f:
    writer = Writer(f)
    schema = writer.register_msgdef('std_msgs/msg/Float64', 'float64 data')
    for k in range(2):
        writer.write_message('/x', schema, {'data': 1.0}, log_time=k * 10**9, publish_time=k * 10**9)
    writer.finish()
"""
BAG = """
import bz2, lz4.frame
from helpers import robot_logs
bz2.compress = lz4.frame.compress
open("a.bag", "wb").write(robot_logs.bag([0.0, 1.0]).replace(b"compression=bz2", b"compression=lz4"))
"""
ULG = """
import struct
def message(kind, data):
    return struct.pack('<HB', len(data), ord(kind)) + data
raw = b'ULog' + bytes([1, 0x12, 0x35, 1]) + bytes(8) + message('B', bytes(40))
raw += message('F', b'p:uint64_t timestamp;double x;') + message('A', bytes(3) + b'p')
for k in range(2):
    raw += message('D', struct.pack('<HQd', 0, k * 10**6, 1.0))
open('a.ulg', 'wb').write(raw)
"""
MF4 = """
import numpy as np
from asammdf import MDF, Signal
with MDF(version='4.10') as file:
    file.append([Signal(np.array([1., 2.]), np.array([0., 1.]), name='x')])
    file.save('a.mf4')
"""
SPEC = "signal x\nrequire low: x < 5\n"
QUICK = {
    "ulg": (ULG, ["check", "low.stl", "a.ulg", "--map", "x=p.x"]),
    "mf4": (MF4, ["check", "low.stl", "a.mf4"]),
    "parquet": (PARQUET, ["check", "low.stl", "a.parquet"]),
    "mat": (MAT, ["check", "low.stl", "a.mat"]),
    "mcap": (MCAP, ["check", "low.stl", "a.mcap", "--resample", "1s"]),
    "bag": (BAG, ["check", "low.stl", "a.bag", "--map", "x=robot.state.position.x"]),
    "plot": (
        "open('a.csv', 'w').write('t,x\\n0,1\\n1,2\\n')",
        ["plot", "a.csv", "--spec", "low.stl", "-o", "a.svg"],
    ),
}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> Path:
    """A folder with a recording of every kind that can be written here."""
    folder = tmp_path_factory.mktemp("recordings")
    (folder / "low.stl").write_text(SPEC)
    helpers = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), *sys.path])}
    needs = {"parquet": "pyarrow", "mat": "h5py", "mcap": "mcap_ros2", "bag": "lz4"}
    programs = [text for extra, (text, _) in QUICK.items() if extra not in needs or find_spec(needs[extra])]
    subprocess.run([sys.executable, "-c", "\n".join(programs)], cwd=folder, env=helpers, check=True)
    return folder


@pytest.fixture(scope="module")
def without(bare, recordings) -> dict[str, Said]:
    """Messages where no extra is installed."""
    return dict(zip(QUICK, bare.run(recordings, *(line for _, line in QUICK.values())), strict=True))


@pytest.mark.apart
@pytest.mark.parametrize("extra", QUICK)
def test_an_extra(extra, wheel, without, recordings, tmp_path):
    ready = install(wheel, tmp_path / "env", extra)
    assert without[extra].code == 5, without[extra]
    assert f"pip install 'stlc[{extra}]'" in without[extra].err
    (with_it,) = ready.run(recordings, QUICK[extra][1])
    assert with_it.code == 0, with_it


PROGRAMS = {
    "gym": """
import stlc.gym
env = stlc.gym.make("specs/traffic.stl", "car.yaml")
env.reset(seed=0)
env.step(env.action_space.sample())
""",
    "panda": """
import os
os.environ["DISPLAY"] = ":0"
from stlc.view.bullet import require_window
require_window()
import pytorch_kinematics
""",
    "fmu": """
from pathlib import Path
from stlc.diagnostics import SystemFileError
from stlc.plants.plant import load_plant
Path("ball.yaml").write_text(
    "plant: 1\\nname: ball\\nfmu: ball.fmu\\ntime: {dt: 1 s, duration: 1 s}\\noutput: {h: }\\n"
)
try:
    load_plant("ball.yaml").simulate([[]])
except SystemFileError as error:
    assert "there is no file" in str(error)
""",
}


@pytest.mark.apart
def test_the_language_server(wheel, bare, folder):
    (said,) = bare.run(folder, ["lsp"])
    assert (said.code, "pip install 'stlc[lsp]'" in said.err) == (5, True)
    program = "from stlc.editor.server import make_server; make_server()"
    assert install(wheel, folder / "env", "lsp").python(folder, program) == Said(0, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("extra", PROGRAMS)
def test_an_extra_of_the_library(extra, wheel, folder):
    ready = install(wheel, folder / "ready")
    without = ready.python(folder, PROGRAMS[extra])
    assert without.code == 1
    assert "is not installed" in without.err, without.err
    with_it = install(wheel, folder / "env", extra, "train").python(folder, PROGRAMS[extra])
    assert with_it.code == 0, with_it.err


TRAIN = THREE[0]
COMMANDS = {
    "log": ([*TRAIN, "--log", "tensorboard"],),
    "onnx": (TRAIN, ["export", "latest", "--to", "onnx"]),
    "plan": (["plan", "specs/traffic.stl", "--method", "milp", "--budget", "5s"],),
}


@pytest.mark.slow
@pytest.mark.parametrize("extra", COMMANDS)
def test_an_extra_of_a_training(extra, wheel, training, folder):
    lines = COMMANDS[extra]
    without = training.run(folder, *lines)[-1]
    assert without.code == 5, without
    assert f"stlc[{extra}]" in without.out + without.err
    for said in install(wheel, folder / "env", extra, "train").run(folder, *lines):
        assert said.code == 0, said


def test_every_extra_is_tried():
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    others = {"train", "lsp", "peers", "cluster", "docs", "bench", "all", "dev"}  # train: tests/test_light.py
    assert extras == {*QUICK, *PROGRAMS, *COMMANDS} | others


@pytest.mark.slow
def test_a_real_installation(wheel, folder):
    """Installation of the wheel by `pip install`, the base dependencies taken from the package index."""
    subprocess.run([sys.executable, "-m", "venv", "env"], check=True)
    pip = [str(folder / "env/bin/python"), "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, f"{wheel}[train]"], check=True)
    train, simulate, check, _ = Installed(folder / "env").run(folder, *THREE)
    assert (train.code, simulate.code) == (0, 0)
    assert check.code in (0, 1, 4)
    done = subprocess.run(["env/bin/stlc", "--version"], check=True, capture_output=True, text=True)
    assert done.stdout.startswith("stlc ")


# ---------------------------------------------------------------------- what it says of itself


@pytest.fixture(scope="module")
def metadata(wheel) -> Message:
    with zipfile.ZipFile(wheel) as file:
        (name,) = [name for name in file.namelist() if name.endswith(".dist-info/METADATA")]
        return message_from_bytes(file.read(name))


def test_the_long_description_needs_nothing_of_the_tree(metadata):
    text = metadata.get_payload()
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert text.startswith("# stlc\n")
    assert "stlc train specs/traffic.stl" in text
    assert "](" not in re.sub(r"\]\(https?://", "", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    assert "<!--" not in text
    assert "<img" not in text


def test_what_it_is(metadata):
    from trove_classifiers import classifiers

    assert set(metadata.get_all("Classifier")) <= classifiers
    assert metadata["License-Expression"] == "MIT"
    assert metadata.get_all("License-File") == ["LICENSE"]
    for url in metadata.get_all("Project-URL"):
        assert url.split(", ")[1].startswith("https://")
    needed = [entry for entry in metadata.get_all("Requires-Dist") if "extra ==" not in entry]
    assert {re.split(r"[<>=!~ ]", entry)[0] for entry in needed} == IMPORTED


IMPORTED = {"lark", "typer", "rich", "pyyaml", "numpy"}
