"""A Ray cluster of two nodes on this machine, whose workers are killed while they work."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stlc.cli.framework.app import main

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]

SPEC = """spec small
signal a [m]
signal v [m/s]
require low: always a < 2 m
require slow: always[0 s, 1 s] (v > 3 m/s -> eventually[0 s, 0.5 s] v < 2 m/s)
"""
FILES, SAMPLES = 60, 4000


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 1}, connect=False)
    found.add_node(num_cpus=1)
    yield found
    found.shutdown()


def workers() -> list[int]:
    """Processes in which a call is being made, by the titles that Ray gives them."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if entry.name.isdigit() and (entry / "cmdline").read_bytes().startswith(b"ray::answer"):
                found.append(int(entry.name))
    return found


@contextmanager
def killing(times: int) -> Iterator[list[int]]:
    """Context in which workers are killed while they make a call, one after the other."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while len(killed) < times and not over.wait(0.05):
            for process in workers():
                if process not in killed:
                    with suppress(OSError):
                        os.kill(process, signal.SIGKILL)
                        killed.append(process)
                    break

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text(SPEC)
    for index in range(FILES):
        generator, t = np.random.default_rng(index), np.arange(SAMPLES) * 0.1
        a = np.sin(t + index) + (1.5 if index % 7 == 0 else 0.9) * (t > 30)
        path = Path(f"logs/{index % 4}/{index:03d}.npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, t=t, a=a, v=generator.uniform(0.0, 2.9, SAMPLES))


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, Any]:
    code = main([*words, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return code, document["result"]


@pytest.mark.usefixtures("recordings")
def test_files_are_judged_although_workers_are_killed(
    cluster: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("check", "s.stl", "logs/**/*.npz", "--certify", ".5", "--table")
    here = printed(capsys, *words, "here.csv")
    assert here[0] in (0, 4)
    assert len(here[1]["files"]) == FILES
    with killing(2) as killed:
        there = printed(capsys, *words, "there.csv", "--cluster", cluster.address)
    assert len(killed) == 2
    assert there == here
    assert Path("there.csv").read_text() == Path("here.csv").read_text()
    assert main(["check", "s.stl", "logs/0/000.npz", "--cluster", cluster.address, "-q"]) == 1


@pytest.mark.usefixtures("recordings")
def test_a_file_whose_workers_are_always_killed_is_not_judged(
    cluster: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = np.load("logs/0/000.npz")
    np.savez("long.npz", **{name: np.tile(recorded[name], 200) for name in ("a", "v")})
    with killing(3) as killed:
        words = ("check", "s.stl", "long.npz", "--dt", "100ms", "--cluster", cluster.address)
        code, result = printed(capsys, *words)
    assert len(killed) == 3
    assert (code, result) == (5, {"trace": "long.npz", "verdict": "not judged"})


SYSTEM = """
stlc: 1
name: oscillator
time: {dt: 0.001 s, horizon: 10000 steps, integrator: rk4}
inputs: {f: {range: [-1, 1], pieces: 10, duration: 10 s}}
state: {x: {range: [-9, 9]}, v: {range: [-9, 9]}}
flow: {x: v, v: "f - x - 0.2 * v"}
init: {mixture: [{draw: {x: "uniform(-0.1, 0.1)", v: 0}}]}
"""
CLAIMS = """
system "oscillator.yaml"
signal x, v, f
require resonance: always[0 s, 10 s] x < 2.2
require bounded: always[0 s, 10 s] x < 50
require mixed: always[0 s, 5 s] (x < 1.5 or 1000 * v < 500)
"""


@pytest.mark.parametrize("requirements", [["bounded"], ["resonance", "bounded", "mixed"]])
def test_searches_although_workers_are_killed(
    requirements: list[str],
    cluster: Any,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oscillator.yaml").write_text(SYSTEM)
    Path("oscillator.stl").write_text(CLAIMS)
    words = ["falsify", "oscillator.stl", "--simulations", "200", "--batch", "4"]
    words += [word for name in requirements for word in ("--require", name)]
    code, here = printed(capsys, *words)
    with killing(2) as killed:
        there = printed(capsys, *words, "--cluster", cluster.address)
    assert len(killed) == 2
    for each in (*here["requirements"], *there[1]["requirements"]):
        del each["seconds"]
    assert there == (code, here)
    assert there[1]["lost"] == 0
