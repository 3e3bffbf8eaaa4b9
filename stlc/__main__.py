"""Execution of stlc as `python -m stlc`."""

import gc
import os
import sys

from stlc import stopping

GARBAGE = (10_000, 10, 50)
"""Thresholds of the garbage collection. With Python's own ones imports take 7 % longer."""


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C while modules are imported gives 130."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller, as by some daemons
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115, PTH123
    try:
        gc.set_threshold(*GARBAGE)
        stopping.arm()
        from stlc.cli.framework.app import main as run

        return stopping.finish(run())
    except KeyboardInterrupt:
        return stopping.finish(130)


if __name__ == "__main__":
    sys.exit(main())
