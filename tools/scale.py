"""Files and simulations per second: one process, two processes, a Ray cluster of two nodes on this machine.

    python tools/scale.py --files 60 --samples 20000 --simulations 400

starts the nodes with one CPU each (extra `cluster`), writes recordings to a temporary folder,
judges them by `stlc check`, and searches a system by `stlc falsify`. It prints elapsed and processor time of
each way. The processor time of a cluster is that of its workers and of the command. Results must be the same.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

SPEC = """spec small
signal a [m]
signal v [m/s]
require low: always a < 2 m
require slow: always[0 s, 1 s] (v > 3 m/s -> eventually[0 s, 0.5 s] v < 2 m/s)
"""
SYSTEM = """stlc: 1
name: oscillator
time: {dt: 0.001 s, horizon: 10000 steps, integrator: rk4}
inputs: {f: {range: [-1, 1], pieces: 10, duration: 10 s}}
state: {x: {range: [-9, 9]}, v: {range: [-9, 9]}}
flow: {x: v, v: "f - x - 0.2 * v"}
init: {mixture: [{draw: {x: "uniform(-0.1, 0.1)", v: 0}}]}
"""
CLAIM = """system "oscillator.yaml"
signal x, v, f
require bounded: always[0 s, 10 s] x < 50
"""


WORKER = (b"ray::answer", b"ray::IDLE")
"""Titles of the processes of workers."""


def write(files: int, samples: int) -> None:
    """Write recordings and specifications into the current folder."""
    Path("s.stl").write_text(SPEC, encoding="utf-8")
    Path("oscillator.yaml").write_text(SYSTEM, encoding="utf-8")
    Path("oscillator.stl").write_text(CLAIM, encoding="utf-8")
    for index in range(files):
        generator, t = np.random.default_rng(index), np.arange(samples) * 0.1
        a = np.sin(t + index) + (1.5 if index % 7 == 0 else 0.9) * (t > 30)
        path = Path(f"logs/{index % 4}/{index:05d}.npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, t=t, a=a, v=generator.uniform(0.0, 2.9, samples))


@contextmanager
def workers_watched():
    """Context that yields a mapping: process of a Ray worker -> its processor time in seconds until now."""
    times: dict[int, float] = {}
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            for entry in Path("/proc").iterdir():
                with suppress(OSError, ValueError):
                    if entry.name.isdigit() and (entry / "cmdline").read_bytes().startswith(WORKER):
                        fields = (entry / "stat").read_text().rpartition(")")[2].split()
                        ticks = int(fields[11]) + int(fields[12])
                        times[int(entry.name)] = ticks / os.sysconf("SC_CLK_TCK")

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield times
    finally:
        over.set()
        thread.join()


def measured(words: list[str]) -> tuple[object, float, float]:
    """Result of a command, its elapsed time, and the processor time of all its processes."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with workers_watched() as workers:
        command = [sys.executable, "-m", "stlc", *words, "--json"]
        done = subprocess.run(command, capture_output=True, check=False)
    after, elapsed = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    result = json.loads(done.stdout)["result"]
    for each in result.get("requirements", ()):
        each.pop("seconds", None)
    return result, elapsed, own + sum(workers.values())


def compare(name: str, count: int, words: list[str], address: str) -> None:
    """Print a row of the table for each way to run a command."""
    first = None
    for way, more in (
        ("one process", []),
        ("two processes", ["--jobs", "2"]),
        ("two nodes", ["--cluster", address]),
    ):
        result, elapsed, processor = measured([*words, *more])
        first = first or result
        same = "" if result == first else "  DIFFERENT RESULT"
        print(
            f"{name:12} {way:14} {elapsed:7.1f} s {count / elapsed:9.1f} /s   processor {processor:6.1f} s "
            f"{1000 * processor / count:7.1f} ms each{same}",
            flush=True,
        )


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", type=int, default=60)
    parser.add_argument("--samples", type=int, default=20000)
    parser.add_argument("--simulations", type=int, default=400)
    given = parser.parse_args()
    from ray.cluster_utils import Cluster

    os.environ["OMP_NUM_THREADS"] = "1"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1}, connect=False)
    cluster.add_node(num_cpus=1)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        write(given.files, given.samples)
        compare("check", given.files, ["check", "s.stl", "logs/**/*.npz"], cluster.address)
        words = ["falsify", "oscillator.stl", "--simulations", str(given.simulations), "--batch", "8"]
        compare("falsify", given.simulations, words, cluster.address)
        os.chdir("/")
    cluster.shutdown()


if __name__ == "__main__":
    main()
