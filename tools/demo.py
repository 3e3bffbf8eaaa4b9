"""`make demo`: train, check, simulate and report a controller, with the run time of each stage."""

import json
import platform
import subprocess
import sys
import time

import environment

SPEC = "specs/traffic.stl"
SYSTEM = "car.yaml"
VERDICTS = {0: "satisfied", 1: "violated, see above", 4: "inconclusive, see above"}
STAGES = (
    ("train", [SPEC, "--system", SYSTEM, "--budget", "60s"], f"{SPEC} + examples/{SYSTEM}", (0,)),
    ("simulate", ["--backup"], "closed loop with the backup policy", (0,)),
    ("check", ["trace.npz"], "trace.npz", tuple(VERDICTS)),
    ("report", ["latest"], "", (0,)),
)


def stage(name, arguments, answers):
    """Run `stlc NAME ARGUMENTS`; returns exit code and seconds. Exits if the code is not in `answers`."""
    command = [str(environment.BIN / "stlc"), name, *arguments]
    print(f"\n$ stlc {name} {' '.join(arguments)}", flush=True)
    started = time.monotonic()
    code = subprocess.call(command, cwd=str(environment.ROOT))
    if code not in answers:
        print(f"the demo stops here: stlc {name} ended with exit code {code}", file=sys.stderr)
        sys.exit(code)
    return code, time.monotonic() - started


def newest():
    """The folder of the newest run."""
    return (environment.ROOT / "runs" / "latest").resolve()


def drives(run):
    """Results of the closed-loop runs of a run folder, in a sentence."""
    guards = json.loads((run / "eval" / "simulate.json").read_text())["guards"]
    with_guard, without = guards["paper"]["drives"], guards["none"]["drives"]
    sentence = f"{with_guard['obeyed']} of {with_guard['count']} drives obeyed every rule"
    if with_guard["lost"]:
        sentence += f" ({with_guard['lost']} were lost)"
    return f"{sentence}; without the guard {without['obeyed']}"


def main():
    """Run all stages and print the table, then how many drives obeyed every rule."""
    seconds = environment.ensure()
    rows = [("environment", f".venv (Python {platform.python_version()})", seconds)]
    for name, arguments, text, answers in STAGES:
        code, seconds = stage(name, arguments, answers)
        if name == "check":
            text = f"{text}: {VERDICTS[code]} (exit code {code})"
        report = (newest() / "report.html").relative_to(environment.ROOT)
        rows.append((name, text or str(report), seconds))
    print()
    for name, text, seconds in rows:
        print(f"  {name:<13} {text:<58} {seconds:4.0f} s")
    print(f"\n  {drives(newest())}")
    print(f"\n  Next:  open the report · stlc compile {SPEC} · docs/quickstart.md")


if __name__ == "__main__":
    main()
