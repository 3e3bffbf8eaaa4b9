"""Run folders with damaged files: records, checkpoints, traces; links and folders in place of files."""

import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from fuzzing.mutation import ROOT, mutated
from fuzzing.specs import SYSTEM, TRAINED
from fuzzing.valid import battered

RUN = "runs/small/0001-seed"
_TRAIN = "train a.stl --system b.yaml --steps 6 --batch 8 --held-out 10 --no-pictures --name seed"
_DRIVE = "simulate --backup --seeds 0 --steps 4 --agents 2 --no-pictures"
_CERTIFY = "certify latest --drives 4 --steps 2 --agents 2"
_FALSIFY = "falsify latest --agents 1 --steps 3 --simulations 8 --batch 4 --out found"

COMMANDS = (
    *("runs show latest", "runs show latest --json", "runs list", "runs list --json", "runs diff latest 1"),
    *("check trace.npz", "check a.stl trace.npz", "explain trace.npz", "system show {run}/system.yaml"),
    *("simulate --backup --seeds 0 --steps 2 --agents 2 --no-pictures", "explain latest --guarantee"),
    *(
        "simulate --seeds 0 --steps 2 --agents 2 --no-pictures",
        "train --resume latest --steps 6 --no-pictures",
    ),
    *("report latest", "export latest --to c -o out"),
    *("certify --verify {run}/eval/certificate.json", "certify --verify {run}/eval/certificate.json --json"),
    *(_CERTIFY, _FALSIFY, "verify latest --budget 1s"),
)
"""Commands that read a run; those that read checkpoints are repeated."""


@cache
def run_files() -> dict[str, bytes]:
    """Path -> content of all files of a small trained and simulated run.

    Raises:
        ModuleNotFoundError: torch is not installed.
    """
    import torch  # noqa: F401

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.stl").write_text(TRAINED)
        (folder / "b.yaml").write_text(SYSTEM)
        lines = [line.split() for line in (_TRAIN, _DRIVE, _CERTIFY)]
        code = f"from stlc.cli.framework.app import main\nprint([main(line) for line in {lines}])"
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, cwd=folder, env=_surroundings(), check=False, capture_output=True)
        if not (folder / RUN / "eval/certificate.json").is_file():
            raise RuntimeError(done.stderr.decode("utf-8", "replace"))
        paths = [path for path in sorted((folder / RUN).rglob("*")) if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _surroundings() -> dict[str, str]:
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), "OMP_NUM_THREADS": "1"}


def a_run(rng: random.Random) -> tuple[list[str], dict[str, bytes], dict[str, str]]:
    """A command line, the damaged run folder that it reads, and what lies there instead of files."""
    files, odd = dict(run_files()), {}
    for _ in range(rng.choice([1, 1, 1, 2])):
        name = rng.choice(sorted(files))
        if rng.random() < 0.15:
            odd[name] = _instead(name, files, rng)
        elif name.endswith(".safetensors"):
            files |= _with_weights(files, name, rng)
        elif name.endswith((".json", ".yaml", ".jsonl")) and rng.random() < 0.5:
            files[name] = said(files[name], rng)
        elif rng.random() < 0.08:
            del files[name]
        else:
            damage = battered if name.endswith(".npz") or rng.random() < 0.3 else mutated
            files[name] = damage(files[name], rng)
    words = rng.choice(COMMANDS).format(run=RUN).split()
    return words, {**files, "a.stl": TRAINED.encode()}, odd


def _instead(name: str, files: dict[str, bytes], rng: random.Random) -> str:
    """Kind of thing that stands in place of a file; see `fuzzing.hostile.lay_odd`."""
    other = rng.choice(sorted({*files} - {name}))
    links = (os.path.relpath(other, Path(name).parent), "nowhere", ".", Path(name).name, "/dev/zero")
    others = (f"hard {other}", "fifo", "folder", "sparse 0", "sparse 60000000")
    return rng.choice((*(f"link {target}" for target in links), *others))


def _with_weights(files: dict[str, bytes], name: str, rng: random.Random) -> dict[str, bytes]:
    """Files with damaged weights, mostly with a matching checksum."""
    data = files[name]
    (size,) = (int.from_bytes(data[:8], "little"),)
    if rng.random() < 0.6:
        head = battered(data[8 : 8 + size], rng)
        kept = size if rng.random() < 0.3 else len(head)
        data = kept.to_bytes(8, "little") + head + data[8 + size :]
    else:
        data = battered(data, rng)
    changed = {name: data}
    if rng.random() < 0.8:
        pointer = next(path for path in files if path.endswith("ckpt/last.json"))
        try:
            facts = json.loads(files[pointer])
            facts["sha256"] = hashlib.sha256(data).hexdigest()
            changed[pointer] = json.dumps(facts).encode()
        except (ValueError, TypeError):
            pass
    return changed


_ODD = (
    None,
    True,
    -1,
    0,
    1e308,
    10**30,
    float("inf"),
    float("-inf"),
    float("nan"),
    "inf",
    2**63,
    0.5,
    "",
    "x" * 300,
    "../../x",
    [],
    {},
    [[]],
    "é\x00",
    1e-300,
    "NaN",
    [1, 2, 3],
)


def said(data: bytes, rng: random.Random) -> bytes:
    """JSON with one value replaced; other texts with words replaced."""
    try:
        value = json.loads(data)
    except ValueError:
        return mutated(data, rng)
    if not isinstance(value, (dict, list)) or rng.random() < 0.05:
        return json.dumps(rng.choice(_ODD)).encode()
    inside = value
    while True:
        keys = list(inside) if isinstance(inside, dict) else list(range(len(inside)))
        if not keys:
            break
        key = rng.choice(keys)
        if isinstance(inside[key], (dict, list)) and inside[key] and rng.random() < 0.7:
            inside = inside[key]
            continue
        if rng.random() < 0.2 and isinstance(inside, dict):
            del inside[key]
        else:
            inside[key] = rng.choice(_ODD)
        break
    return json.dumps(value).encode()


def prepare() -> list[str]:
    """Train the run and import the simulator; return missing packages."""
    import importlib

    try:
        run_files()
    except ModuleNotFoundError as error:
        return [f"run ({error.name} is not installed)"]
    for name in (
        "stlc.controller.run.run",
        "stlc.controller.deployment.simulator",
        "stlc.controller.training.loop",
    ):
        try:
            importlib.import_module(name)
        except ModuleNotFoundError:
            continue
    return []
