"""`make demo`: train, check, simulate and report a controller, with the run time of each stage."""

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


def main():
    """Run all stages and print the table of their run times."""
    seconds = environment.ensure("train,plot")
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
    print(f"\n  Next:  open the report · stlc compile {SPEC} · docs/quickstart.md")


if __name__ == "__main__":
    main()
