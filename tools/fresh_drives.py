"""Comparison of a training's closed-loop shares with 200 fresh drives under its recommended guard.

`python tools/fresh_drives.py RUN... --seconds 15` simulates each trained run for 15 s of processor time, as
`stlc train` does at its end, then over the first seeds of `stlc simulate`, and prints both shares.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.closed_loop import closed_loop
from stlc.controller.evaluation.deployment import deploy
from stlc.controller.evaluation.rules import Rules
from stlc.controller.run.run import Run


def fresh_drives(run: Run, guard: str, drives: int) -> tuple[int, int]:
    """Satisfied drives, and all, of at least `drives` from the first seeds, without a time limit."""
    test = run.task.system.decl.test
    seeds = tuple(range(-(-drives // test.agents)))
    setting = Setting(seeds, test.agents, test.steps, test.replan, limit=None)
    obeyed = deploy(run.task, run.policy, setting, guard, rules=Rules.of(run)).runs.obeyed
    return int(obeyed.sum()), len(obeyed)


def main() -> None:
    """Simulate the runs and print both shares."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--drives", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for path in options.runs:
        run = Run.open(path)
        _ = run.task.native  # excluded from the time of the drives
        end = time.process_time() + options.seconds
        found = closed_loop(run, lambda end=end: end - time.process_time())
        for share in found.shares:
            print(f"{run.task.compiled.name}: {share.guard} {share.satisfied} of {share.runs}", flush=True)
        best = found.recommended
        if best is None:
            print(f"{run.task.compiled.name}: nothing is recommended {found.why}".rstrip(), flush=True)
            continue
        satisfied, drives = fresh_drives(run, best.guard, options.drives)
        low, high = best.interval
        print(
            f"{run.task.compiled.name}: {best.guard} recommended, {best.share:.3f} "
            f"in [{low:.3f}, {high:.3f}]; fresh {satisfied} of {drives}, "
            f"difference {abs(satisfied / drives - best.share):.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
