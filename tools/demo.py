"""`make demo`: train, check, simulate and report a controller, with the run time of each stage."""

import json
import platform
import subprocess
import sys
import time

import environment

SPEC = "specs/traffic.stl"
SYSTEM = "car.yaml"
STAGES = (
    ("train", [SPEC, "--system", SYSTEM, "--budget", "60s"], "a policy, in a minute", (0,)),
    ("simulate", ["--backup"], "200 drives without a guard, and with the backup policy", (0,)),
    ("check", ["trace.npz"], "the monitor judges the guarded drives", (0, 1, 4)),
    ("report", ["latest", "--python"], "a page with the drives in motion", (0,)),
)


def stage(name, arguments, answers):
    """Run `stlc NAME ARGUMENTS`; returns the seconds. Exits if the exit code is not in `answers`."""
    command = [str(environment.BIN / "stlc"), name, *arguments]
    started = time.monotonic()
    code = subprocess.call(command, cwd=str(environment.ROOT))
    if code not in answers:
        print(f"the demo stops here: stlc {name} ended with exit code {code}", file=sys.stderr)
        sys.exit(code)
    return time.monotonic() - started


def satisfied(run):
    """Sentences on the drives of the newest simulation of `run`, one for each guard."""
    guards = json.loads((run / "eval" / "simulate.json").read_text(encoding="utf-8"))["guards"]
    words = {"none": "without a guard", "paper": "with the paper's backup policy"}
    for name, guard in guards.items():
        drives = guard["drives"]
        yield f"{drives['obeyed']} of {drives['count']} drives satisfy every rule {words.get(name, name)}"


def main():
    """Run all stages; print what each is for, then what the drives satisfy and how long each stage took."""
    seconds = environment.ensure("train,plot")
    rows = [("environment", f".venv (Python {platform.python_version()})", seconds)]
    for number, (name, arguments, purpose, answers) in enumerate(STAGES, 1):
        print(f"\n{number} of {len(STAGES)}: {purpose}\n$ stlc {name} {' '.join(arguments)}", flush=True)
        rows.append((name, purpose, stage(name, arguments, answers)))
    run = (environment.ROOT / "runs" / "latest").resolve()
    print()
    for sentence in satisfied(run):
        print(f"  {sentence}")
    print()
    for name, text, seconds in rows:
        print(f"  {name:<13} {text:<58} {seconds:4.0f} s")
    report = (run / "report.html").relative_to(environment.ROOT)
    print(f"\n  Next:  open {report} · stlc compile {SPEC} · docs/quickstart.md")


if __name__ == "__main__":
    main()
