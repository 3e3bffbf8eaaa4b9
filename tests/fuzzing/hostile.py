"""Run folders of strangers: links, pipes, devices, foreign Python, names that lead out, and damaged files.

Beside the runs lies the folder `outside`, which no command may read, write or run.
"""

import json
import os
import random
import stat
import sys
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from fuzzing.mutation import mutated
from fuzzing.runs import RUN, run_files, said
from fuzzing.specs import TRAINED
from fuzzing.valid import battered

OUTSIDE = "outside"
SECRET = "f5a1-secret-of-another"
_PYTHON = f"open('{OUTSIDE}/ran', 'w').close()\nclass W: pass\ndef f(x): return x\n"
_OTHER = "runs/small/0002-other"
_ODD_NUMBERS = (
    "1e999",
    "-1e999",
    "NaN",
    "9" * 400,
    "9" * 5000,
    '"nan"',
    "[" * 60_000,
    '{"a":' * 60_000,
    "1e308",
)

COMMANDS = {
    "report": ("report latest", "report latest --json"),
    "simulate": ("simulate latest --backup --seeds 0 --steps 2 --agents 2 --no-pictures",),
    "drawn": ("simulate latest --seeds 0 --steps 2 --agents 1",),
    "export": ("export latest --to c",),
    "verify": (
        f"certify --verify {RUN}/eval/certificate.json",
        f"certify 1 --verify {RUN}/eval/certificate.json",
    ),
    "compare": ("runs diff 1 2", "runs diff latest 2 --json"),
    "resume": ("train --resume 1 --steps 8 --no-pictures",),
    "runs": (
        "runs list",
        "runs show latest --json",
        "runs list --json --sort acc",
        "runs rm 1",
        "runs rm 1 --force",
    ),
    "read": ("plot latest -o p.svg", "explain latest --guarantee", "check latest", f"check {RUN}/trace.npz"),
}
WEIGHTS = {
    "report": 14,
    "simulate": 8,
    "drawn": 1,
    "export": 1,
    "verify": 20,
    "compare": 14,
    "resume": 5,
    "runs": 20,
}
WEIGHTS |= {"read": 8}
DRIVING = ("simulate", "drawn", "resume")
"""Commands that run the Python of a run's own folder."""

_WRITTEN = (
    *("report.html", "driven.png", "map.png", "failures.png", "scene.png", "small.gif"),
    *(
        "eval/scenarios.json",
        "export/c/stlc_controller.h",
        "export/c/main.c",
        "ev.py",
        "lib/a.stl",
        "lib/index.json",
    ),
)
_ROW = {"loss": 0.3, "requirements": {"stay": 0.7, "reach": 1.0}, "feasible": 0.9, "lr": 0.002, "failing": 1}
_FOLDERS = ("eval", "ckpt", "judge", "lib", "export", "export/c", "tensorboard", "__pycache__")


@dataclass
class Hostile:
    """A run folder and the command line that meets it.

    Attributes:
        arguments: the command line.
        files: path -> content.
        odd: path -> what lies there instead of a file: `link TARGET`, `hard TARGET`, `fifo`, `folder`, or
            `sparse BYTES`.
        drives: whether the command may run Python of the run's own folder.
    """

    arguments: list[str]
    files: dict[str, bytes]
    odd: dict[str, str] = field(default_factory=dict)
    drives: bool = False


@cache
def _runs() -> dict[str, bytes]:
    """The files of a run, and those of another run that the first is compared with."""
    rows = [{**_ROW, "step": 50 * k, "seconds": 2.0 * k, "accuracy": 0.1 * k} for k in range(1, 8)]
    files = {**run_files(), f"{RUN}/train.jsonl": "".join(f"{json.dumps(row)}\n" for row in rows).encode()}
    kept = ("run.json", "spec.stl", "system.yaml", "train.jsonl")
    return files | {f"{_OTHER}/{name}": files[f"{RUN}/{name}"] for name in kept}


def hostile(rng: random.Random) -> Hostile:
    """Draw one."""
    (kind,) = rng.choices(list(WEIGHTS), weights=list(WEIGHTS.values()))
    files = dict(_runs())
    found = Hostile(
        rng.choice(COMMANDS[kind]).split(), files, {"runs/latest": "link small/0001-seed"}, kind in DRIVING
    )
    files["a.stl"] = TRAINED.encode()
    files |= {
        f"{OUTSIDE}/run/{path.removeprefix(RUN + '/')}": data for path, data in files.items() if RUN in path
    }
    files |= {
        f"{OUTSIDE}/{name}": SECRET.encode()
        for name in ("secret", "authorized_keys", "step-000006.safetensors")
    }
    files[f"{OUTSIDE}/ev.py"] = _PYTHON.encode()
    files[f"{OUTSIDE}/judge.stl"] = TRAINED.encode()
    changes = (_python, _named, _linked, _linked, _piped, _huge, _damaged, _damaged, _numbers)
    chosen = rng.choices(range(len(changes)), k=rng.choice([1, 1, 1, 2, 4]))
    for change in sorted(chosen):  # the first ones read whole files
        changes[change](found, rng)
    return found


def _places(found: Hostile) -> list[str]:
    own = [path.removeprefix(RUN + "/") for path in found.files if path.startswith(RUN + "/")]
    return sorted({*own, *_WRITTEN})


def _up(name: str) -> str:
    return os.path.relpath(".", Path(name).parent)


def _linked(found: Hostile, rng: random.Random) -> None:
    if rng.random() < 0.08:
        found.odd["runs/latest"] = f"link ../{OUTSIDE}/run"
        return
    folder = rng.random() < 0.3
    name = f"{RUN}/{rng.choice(_FOLDERS if folder else _places(found))}"
    near = name.removeprefix(RUN + "/")
    targets = [f"{OUTSIDE}/run/{near}", f"{OUTSIDE}/new", f"{OUTSIDE}/authorized_keys", OUTSIDE]
    target = (
        f"{_up(name)}/{rng.choice(targets)}"
        if rng.random() < 0.8
        else rng.choice(["/dev/zero", "/etc/passwd", ".", near])
    )
    found.odd[name] = f"link {target}"


def _piped(found: Hostile, rng: random.Random) -> None:
    found.odd[f"{RUN}/{rng.choice(_places(found))}"] = "fifo"


def _python(found: Hostile, rng: random.Random) -> None:
    far = rng.choice(["ev.py", f"../../../{OUTSIDE}/ev.py", str(Path(OUTSIDE, "ev.py").absolute())])
    text = rng.choice(
        [
            f"test: {{world: '{far}:W'}}\n",
            f"test: {{judge: '../../../{OUTSIDE}/judge.stl'}}\n",
            f"scenario: {{s: {{test: {{world: '{far}:W'}}}}}}\n",
            f"functions: {{f: {{kind: python, target: '{far}:f'}}}}\n",
            f"functions: {{f: {{kind: kinematics, file: '../../../{OUTSIDE}/ev.py', tip: x}}}}\n",
            f"extends: ../../../{OUTSIDE}/run/system.yaml\n",
        ]
    )
    found.files[f"{RUN}/system.yaml"] += text.encode()
    if rng.random() < 0.8:
        found.files[f"{RUN}/ev.py"] = _PYTHON.replace(OUTSIDE, RUN).encode()
    if rng.random() < 0.5:
        found.files[f"{RUN}/spec.stl"] += b"extern f(a) : real\n"


def _named(found: Hostile, rng: random.Random) -> None:
    """Names in stored files that lead out of the run."""
    far = f"../../../../{OUTSIDE}/{rng.choice(['secret', 'judge.stl', 'step-000006.safetensors'])}"
    match rng.randrange(5):
        case 0:
            found.files[f"{RUN}/lib/index.json"] = json.dumps({"m.stl": far}).encode()
            found.files[f"{RUN}/spec.stl"] = b'import "m.stl" as m\n' + found.files[f"{RUN}/spec.stl"]
        case 1:
            found.files[f"{RUN}/judge/index.json"] = json.dumps({"j.stl": {"file": far}}).encode()
            found.files[f"{RUN}/system.yaml"] += b"test: {judge: j.stl}\n"
        case 2:
            facts = json.loads(found.files[f"{RUN}/ckpt/last.json"])
            found.files[f"{RUN}/ckpt/last.json"] = json.dumps({**facts, "file": far}).encode()
        case 3:
            spec = found.files[f"{RUN}/spec.stl"]
            found.files[f"{RUN}/spec.stl"] = f'import "{far}" as m\n'.encode() + spec
        case _:
            record = json.loads(found.files[f"{RUN}/run.json"])
            odd = {"spec": rng.choice([far, "..", "/", "\0"]), "system_path": far, "spec_path": far}
            found.files[f"{RUN}/run.json"] = json.dumps({**record, **odd}).encode()


def _damaged(found: Hostile, rng: random.Random) -> None:
    names = [path for path in found.files if path.startswith(RUN) and not path.endswith(".safetensors")]
    texts = [path for path in names if path.endswith((".json", ".jsonl"))]
    name = rng.choice(texts if rng.random() < 0.7 else names)
    data = found.files[name]
    if name in texts and rng.random() < 0.8:
        lines = data.split(b"\n") if name.endswith(".jsonl") else [data]
        at = rng.randrange(max(len(lines) - 1, 1))
        lines[at] = said(lines[at], rng) if lines[at] else b""
        found.files[name] = b"\n".join(lines)
    elif rng.random() < 0.1:
        del found.files[name]
    else:
        found.files[name] = (battered if rng.random() < 0.5 else mutated)(data, rng)


def _numbers(found: Hostile, rng: random.Random) -> None:
    """A number of stored JSON that is huge, not finite, or a deep nest."""
    name = rng.choice(
        [path for path in found.files if path.startswith(RUN) and path.endswith((".json", ".jsonl", "yaml"))]
    )
    parts = found.files[name].decode("utf-8", "replace").split(": ")
    at = rng.randrange(len(parts))
    parts[at] = rng.choice(_ODD_NUMBERS) + parts[at].lstrip("0123456789.-e")
    found.files[name] = ": ".join(parts).encode()


def _huge(found: Hostile, rng: random.Random) -> None:
    size = rng.choice([60_000_000, 3_000_000_000, 10**12])
    found.odd[f"{RUN}/{rng.choice(_places(found))}"] = f"sparse {size}"


# --------------------------------------------------------------------- laying and watching


def lay_odd(odd: dict[str, str]) -> None:
    """Lay links, pipes, folders and sparse files in the current folder, in place of what is there."""
    import shutil

    for name, what in odd.items():
        path, (kind, _, rest) = Path(name), what.partition(" ")
        if any(parent.is_symlink() for parent in path.parents):
            continue  # it would lie elsewhere
        for parent in reversed(path.parents):
            if parent.exists() and not parent.is_dir():
                parent.unlink()
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        match kind:
            case "link":
                path.symlink_to(rest)
            case "hard" if Path(rest).is_file():
                path.hardlink_to(rest)
            case "fifo":
                os.mkfifo(path)
            case "folder":
                path.mkdir()
            case "sparse":
                path.touch()
                os.truncate(path, int(rest))


class _Watch:
    """An audit hook that notes what is opened or run outside, while it is on; a hook cannot be removed.

    Attributes:
        seen: what was noted; None while the hook is off.
        drives: whether files of a run may be run.
        home: the current folder.
    """

    def __init__(self):
        self.seen, self.drives, self.home = None, False, ""

    def __call__(self, event, arguments):
        if self.seen is None or event not in ("open", "exec"):
            return
        name = arguments[0] if event == "open" else getattr(arguments[0], "co_filename", "")
        if not isinstance(name, str) or (event == "exec" and not Path(name).is_absolute()):
            return
        real = os.path.realpath(name)
        outside = real.startswith(f"{self.home}/{OUTSIDE}") or real in ("/etc/passwd", "/dev/zero")
        if outside or (event == "exec" and real.startswith(self.home) and not self.drives):
            self.seen.append(f"{event} {name}")


@cache
def _hook() -> _Watch:
    found = _Watch()
    sys.addaudithook(found)
    return found


@contextmanager
def watched(drives: bool):
    """Context that yields a list of what was read, written or run outside of the runs."""
    watch, wrong, before = _hook(), [], _outside()
    watch.home, watch.drives, watch.seen = os.path.realpath("."), drives, wrong
    try:
        yield wrong
    finally:
        watch.seen = None
    if _outside() != before:
        wrong.append("the folder outside has changed")
    for folder, _, names in os.walk("runs"):
        for name in names:
            path = Path(folder, name)
            found = path.lstat()
            if (
                stat.S_ISREG(found.st_mode)
                and found.st_size < 20_000_000
                and SECRET.encode() in path.read_bytes()
            ):
                wrong.append(f"a secret is in {path}")


def _outside() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path(OUTSIDE).rglob("*") if path.is_file()}
