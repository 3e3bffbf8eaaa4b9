"""Comparison of a training's closed-loop shares with 200 fresh drives under its recommended guard.

`python tools/fresh_drives.py RUN... --seconds 15` simulates each trained run for 15 s of processor time, as
`stlc train` does at its end, then over the first seeds of `stlc simulate`, and prints both shares.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from stlc.controller.evaluation.closed_loop import closed_loop, fresh_share
from stlc.controller.run.run import Run


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
        fresh = fresh_share(run, best.guard, options.drives)
        low, high = best.interval
        print(
            f"{run.task.compiled.name}: {best.guard} recommended, {best.share:.3f} "
            f"in [{low:.3f}, {high:.3f}]; fresh {fresh.satisfied} of {fresh.runs}, "
            f"difference {abs(fresh.share - best.share):.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
