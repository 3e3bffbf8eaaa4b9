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
from stlc.controller.parallel.elsewhere import SeenFile

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
def test_a_node_that_goes_down_costs_nothing(cluster: Any, capsys: pytest.CaptureFixture[str]) -> None:
    here = printed(capsys, "check", "s.stl", "logs/**/*.npz")
    third = cluster.add_node(num_cpus=1)

    def go_down() -> None:
        while len(workers()) < 3 and not over.wait(0.05):
            pass
        cluster.remove_node(third, allow_graceful=False)

    over = threading.Event()
    thread = threading.Thread(target=go_down)
    thread.start()
    there = printed(capsys, "check", "s.stl", "logs/**/*.npz", "--cluster", cluster.address)
    over.set()
    thread.join()
    assert there == here


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


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Input files that no machine recognises as those of the caller, so that copies are sent."""
    monkeypatch.setattr(SeenFile, "of", lambda path: SeenFile(str(path), -1, 0))


@pytest.mark.usefixtures("recordings", "unseen")
def test_files_are_judged_where_nobody_sees_them(cluster: Any, capsys: pytest.CaptureFixture[str]) -> None:
    Path("far").mkdir()
    words = ("check", "s.stl", "logs/**/00*.npz")
    here = printed(capsys, *words, "--out", "near")
    there = printed(capsys, *words, "--out", "far", "--cluster", cluster.address)
    assert there == here
    names = sorted(path.name for path in Path("near").iterdir())
    assert sorted(path.name for path in Path("far").iterdir()) == names
    assert len(names) > 1
    for name in names:
        assert Path("far", name).read_bytes() == Path("near", name).read_bytes()


@pytest.mark.usefixtures("unseen")
def test_searches_where_nobody_sees_the_files(
    cluster: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oscillator.yaml").write_text(SYSTEM)
    Path("oscillator.stl").write_text(CLAIMS)
    words = ["falsify", "oscillator.stl", "--simulations", "40", "--batch", "4", "--require", "bounded"]
    code, here = printed(capsys, *words)
    there = printed(capsys, *words, "--cluster", cluster.address)
    for each in (*here["requirements"], *there[1]["requirements"]):
        del each["seconds"]
    assert there == (code, here)


def test_files_that_are_too_large_are_refused(
    cluster: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ray._private.runtime_env.packaging.GCS_STORAGE_MAX_SIZE", 100)
    Path("oscillator.yaml").write_text(f"{SYSTEM}# not sent before\n")
    Path("oscillator.stl").write_text(CLAIMS)
    assert main(["falsify", "oscillator.stl", "--cluster", cluster.address]) == 5
    said = capsys.readouterr().err
    assert f"error[R302]: the cluster at `{cluster.address}` does not take the input files" in said
    assert "exceeds the maximum size" in said


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
