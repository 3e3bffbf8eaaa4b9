"""Fuzzing of `stlc`: no input may cause a traceback, a hang, or memory exhaustion.

    python tools/fuzz.py --count 40000 --seed 0 --jobs 16 --seconds 10 --memory 2048 --log fuzz.jsonl

Runs `stlc` in process on random, mutated and malicious inputs (`tests/fuzzing/inputs.py`) and prints the
outcomes. An input fails if `stlc` crashes (exit code 70, a traceback, a Python warning, a dead process),
leaves a half-written file, needs more than `--seconds` of processor time, or asks for more than `--memory` MB
beyond what the program needs. Failing inputs are stored in `--keep`, with a README on how to run them again.
With `--log` an interrupted run is resumed; `--kind csv --kind run` restricts the kinds of inputs. Formats
whose library is not installed are skipped with a message. Exit code: 1 if anything failed.
"""

import argparse
import collections
import concurrent.futures
import contextlib
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import stat
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / "tests")]

from fuzzing import foreign as fuzz_foreign  # noqa: E402
from fuzzing import hostile as fuzz_hostile  # noqa: E402
from fuzzing import inputs as fuzz_inputs  # noqa: E402
from fuzzing import runs as fuzz_runs  # noqa: E402
from fuzzing import valid as fuzz_valid  # noqa: E402
from fuzzing.laws import laws, stage  # noqa: E402
from fuzzing.specs import SMALL, SYSTEM  # noqa: E402
from fuzzing.traces import small_trace  # noqa: E402
from fuzzing.valid import FORMATS  # noqa: E402

BATCH = 250
EVERY = 5000
"""Number of inputs between intermediate tables."""
PATIENCE = 180
"""Wall-clock seconds without an outcome after which a worker counts as hung in foreign code."""

WAIT = 170
"""Wall-clock seconds after which a command counts as waiting for ever."""

ANSWERS = frozenset(range(6))
SKIPPED = -2
"""Exit code of an input that is skipped for a missing package."""
MISSING = 5
"""Exit code for a missing resource of the machine, such as memory."""


@dataclass
class Outcome:
    """Outcome of one input."""

    index: int
    kind: str
    code: int
    seconds: float
    fault: str = ""
    missing: str = ""


@dataclass
class Limits:
    """Resource limits of an input."""

    seconds: float
    memory: int


@dataclass
class Plan:
    """Selection of random inputs.

    Attributes:
        seed: of all.
        kinds: restriction to these; all if empty.
    """

    seed: int
    kinds: tuple = ()

    def draw(self, index):
        """The input of that number."""
        return fuzz_inputs.draw(random.Random(f"{self.seed}:{index}"), self.kinds)


def lay(folder, given):
    """Write the files of an input."""
    for name, data in given.files.items():
        path = Path(folder) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    with contextlib.chdir(folder):
        fuzz_hostile.lay_odd(given.odd)


def run_one(plan, index, limits):
    """Run one input in the current, empty folder."""
    given = plan.draw(index)
    if given.missing:
        return Outcome(index, given.kind, SKIPPED, 0.0, missing=given.missing)
    lay(".", given)
    started = time.process_time()
    watch = contextlib.nullcontext([]) if given.drives is None else fuzz_hostile.watched(given.drives)
    with watch as wrong, stage("the command waits and", WAIT, real=True):
        code, text, noise = _call(given.arguments, limits, given.typed) if given.arguments else _read(limits)
    seconds = time.process_time() - started
    fault = "; ".join(dict.fromkeys(wrong)) or _fault(code, text, noise) or _unfinished(given)
    if given.drives is not None and fuzz_hostile.SECRET in text:
        fault = "a secret is printed"
    if not fault and given.arguments and seconds > limits.seconds:
        fault = f"took {seconds:.1f} s"
    return Outcome(index, given.kind, code, seconds, fault)


def _call(arguments, limits, typed=b""):
    """Exit code, output and Python's warnings of a command line."""
    from stlc.cli.framework.app import main

    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="backslashreplace")
    noise, before = [], sys.stdin
    try:
        sys.stdin = io.TextIOWrapper(io.BytesIO(typed), encoding="utf-8")
        with _captured(out, noise), stage("the command", limits.seconds):
            code = main(arguments)
    except BaseException:  # an exception passed the error boundary
        code, text = -1, traceback.format_exc()
        return code, text, noise
    finally:
        sys.stdin = before
    out.flush()
    return code, out.buffer.getvalue().decode("utf-8", "replace"), noise


@contextlib.contextmanager
def _captured(out, noise):
    """Capture output and Python's warnings."""
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *place, **_: noise.append(f"{message} {place[1:]}")
        yield


def _read(limits):
    """Exit code, output and warnings of the library on `a.stl`."""
    from stlc.diagnostics import StlcError
    from stlc.files import File

    noise = []
    try:
        with _captured(io.StringIO(), noise):
            return laws(File(Path("a.stl")).read(), limits.seconds, one_in=4), "", noise
    except StlcError as error:
        return error.exit_code, "", noise
    except BaseException:
        return -1, traceback.format_exc(), noise


def _fault(code, text, noise):
    if "HangError" in text:
        return "hang: " + text.strip().splitlines()[-1][:300]
    if code not in ANSWERS or "Traceback (most recent call last)" in text:
        lines = [line for line in text.splitlines() if "B001" in line] or text.splitlines()[-1:] or [""]
        return f"exit code {code}: {lines[0][:300]}"
    if code == MISSING and "R202" in text:
        return "out of memory"
    return f"a Python warning: {noise[0][:300]}" if noise else ""


def _unfinished(given):
    """Faults of files that a command left half-written: temporary ones, and JSON that cannot be read."""
    for path in Path().rglob("*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\..*", path.name):
            return f"a temporary file is left: {path}"
        if path.suffix == ".json" and stat.S_ISREG(path.lstat().st_mode) and path.as_posix() not in given.odd:
            data = path.read_bytes()
            try:
                json.loads(data)
            except (ValueError, RecursionError):
                if data != given.files.get(path.as_posix()):
                    return f"half-written: {path}"
    return ""


def worker(plan, indices, limits, results):
    """Run a batch of inputs, each in the same folder, and send the outcomes one by one."""
    folder = Path(tempfile.mkdtemp(prefix="stlc-fuzz-"))
    os.chdir(folder)
    tempfile.tempdir = str(folder)  # crash reports
    limit_address_space(4 * limits.memory)
    base = peak()
    try:
        for index in indices:
            results.send(index)
            before = peak()
            outcome = run_one(plan, index, limits)
            if peak() > before and peak() - base > limits.memory << 10:
                outcome.fault = outcome.fault or f"took {(peak() - base) >> 10} MB"
            results.send(outcome)
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    finally:
        results.send(peak())
        os.chdir("/")
        shutil.rmtree(folder, ignore_errors=True)


def peak():
    """Peak memory of this process, in kB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def limit_address_space(megabytes):
    """Limit the address space of this process to its present size plus `megabytes`."""
    used = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (megabytes << 20),) * 2)


def import_everything(kinds=()):
    """Import all modules before workers are forked, so that imports do not count as run time of an input.

    Returns the formats that are skipped because a package is missing.
    """
    limits = Limits(60.0, 0)
    missing = [*fuzz_foreign.prepare(), *fuzz_valid.prepare(tuple(set(FORMATS) & set(kinds or FORMATS)))]
    if not kinds or {"run", "hostile"} & {*kinds}:
        missing += fuzz_runs.prepare()
    Path("a.stl").write_text(SMALL, encoding="utf-8")
    Path("t.npz").write_bytes(small_trace())
    for suffix in ("csv", "mat", "mcap", "parquet"):
        Path(f"t.{suffix}").write_bytes(b"t,x\n0,1\n1,2\n")
        _call(["check", "a.stl", f"t.{suffix}"], limits)
    Path("b.yaml").write_text(SYSTEM, encoding="utf-8")
    _call(["system", "check", "b.yaml"], limits)
    for arguments in (["compile", "a.stl"], ["check", "a.stl", "t.npz"], ["lint", "a.stl"], ["fmt", "a.stl"]):
        _call(arguments, limits)
    return missing


def batch(plan, indices, limits):
    """The outcomes of a batch, and the peak memory of the process that ran it in kB.

    If a worker dies or hangs, its present input fails, and a new worker continues with the next one.
    """
    outcomes, most = [], 0
    left = list(indices)
    while left:
        ours, theirs = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.Process(target=worker, args=(plan, left, limits, theirs))
        process.start()
        theirs.close()
        at, why = left[0], "the process died"
        try:
            while True:
                if not ours.poll(PATIENCE):
                    why = "hang in foreign code"
                    process.kill()
                    break
                match ours.recv():
                    case Outcome() as outcome:
                        outcomes.append(outcome)
                        left.remove(outcome.index)
                    case int() as number if number in left:
                        at = number
                    case number:
                        most = max(most, number)
        except EOFError:
            pass
        process.join()
        if left:
            outcomes.append(Outcome(at, "unknown", process.exitcode or 0, 0.0, why))
            left.remove(at)
    return outcomes, most


def keep(folder, plan, failed):
    """Write the inputs that failed, each in a folder of its own."""
    for outcome in failed:
        given = plan.draw(outcome.index)
        place = Path(folder) / f"{plan.seed}-{outcome.index}"
        place.mkdir(parents=True, exist_ok=True)
        lay(place, given)
        if given.typed:
            (place / "stdin").write_bytes(given.typed)
        (place / "README").write_text(
            f"{outcome.fault}\nstlc {given.arguments!r}\n", errors="backslashreplace"
        )


def fuzz(count, seed, limits, *, first=0, jobs=1, kinds=(), done=(), tell=lambda *_: None):
    """All outcomes not yet `done`, and the peak memory in kB."""
    plan = Plan(seed, tuple(kinds))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for missing in import_everything(plan.kinds):
            print(f"left out: {missing}", flush=True)
    outcomes, most = [], 0
    left = [index for index in range(first, first + count) if index not in done]
    size = max(min(BATCH, len(left) // (4 * jobs)), 50)
    ranges = [left[low : low + size] for low in range(0, len(left), size)]
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(batch, plan, indices, limits) for indices in ranges]
        for future in concurrent.futures.as_completed(waiting):
            found, its_most = future.result()
            outcomes += found
            most = max(most, its_most)
            tell(outcomes, most, len(found))
    return outcomes, most


def table(outcomes, most):
    """The outcomes as a text table."""
    lines = [f"{'kind':<8} {'inputs':>7} {'faults':>7} {'worst s':>8} {'mean ms':>8}  exit codes"]
    for kind in sorted({outcome.kind for outcome in outcomes}):
        ours = [outcome for outcome in outcomes if outcome.kind == kind]
        skipped = sum(outcome.code == SKIPPED for outcome in ours)
        codes = collections.Counter(outcome.code for outcome in ours if outcome.code != SKIPPED)
        shown = "  ".join(f"{code}: {number}" for code, number in sorted(codes.items()))
        shown += f"  skipped: {skipped} ({_packages(ours)})" if skipped else ""
        faults = sum(bool(outcome.fault) for outcome in ours)
        worst = max(outcome.seconds for outcome in ours)
        mean = 1000 * sum(outcome.seconds for outcome in ours) / len(ours)
        lines.append(f"{kind:<8} {len(ours):>7} {faults:>7} {worst:>8.2f} {mean:>8.1f}  {shown}")
    return "\n".join([*lines, f"peak memory {most / 1024:.0f} MB"])


def _packages(outcomes):
    return ", ".join(sorted({outcome.missing for outcome in outcomes if outcome.missing})) + " missing"


def logged(path, asked):
    """The outcomes of an interrupted run; the first line of its log holds the options."""
    told = {"seed": asked.seed, "kinds": asked.kind, "seconds": asked.seconds, "memory": asked.memory}
    if path is None:
        return []
    if not path.exists():
        path.write_text(json.dumps(told) + "\n")
    first, *lines = path.read_text().splitlines()
    if json.loads(first) != told:
        sys.exit(f"{path} is the log of another run: {first}")
    whole = [line for line in lines if line.endswith("}")]
    return list(
        {outcome.index: outcome for outcome in (Outcome(**json.loads(line)) for line in whole)}.values()
    )


def main():
    """Fuzz, print the table and the faults."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first input")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--memory", type=int, default=1024, help="MB beyond what the program needs")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--kind", action="append", default=[], choices=list(fuzz_inputs.KINDS))
    parser.add_argument("--log", type=Path, help="outcomes, a line each; what is in it is not run again")
    parser.add_argument("--keep", default="fuzz-failures")
    asked = parser.parse_args()
    started = time.monotonic()

    def tell(outcomes, most, new):
        """Print faults at once and intermediate tables, so that an interrupted run has results too."""
        faults = [
            f"  {outcome.index} ({outcome.kind}): {outcome.fault}"
            for outcome in outcomes[-new:]
            if outcome.fault
        ]
        print(*faults, sep="\n", end="\n" * bool(faults), flush=True)
        if asked.log is not None:
            with asked.log.open("a") as lines:
                lines.writelines(json.dumps(asdict(outcome)) + "\n" for outcome in outcomes[-new:])
        if len(outcomes) // EVERY > (len(outcomes) - new) // EVERY:
            spent = f"{time.monotonic() - started:.0f} s, {sum(os.times()[:4]):.0f} s of processor time"
            print(f"{len(outcomes)} inputs from {asked.first} on, seed {asked.seed}, {spent}")
            print(table(outcomes, most), flush=True)

    limits, wanted = Limits(asked.seconds, asked.memory), range(asked.first, asked.first + asked.count)
    before = [outcome for outcome in logged(asked.log, asked) if outcome.index in wanted]
    done = frozenset(outcome.index for outcome in before)
    how = {"first": asked.first, "jobs": asked.jobs, "kinds": asked.kind, "done": done, "tell": tell}
    outcomes, most = fuzz(asked.count, asked.seed, limits, **how)
    outcomes = [*before, *outcomes]
    failed = [outcome for outcome in outcomes if outcome.fault]
    keep(asked.keep, Plan(asked.seed, tuple(asked.kind)), failed)
    print(f"in all {len(outcomes)} inputs, {len(failed)} faults, seed {asked.seed}")
    print(table(outcomes, most))
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
