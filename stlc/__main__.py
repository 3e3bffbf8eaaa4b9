"""Execution of stlc as `python -m stlc`."""

import gc
import sys

from stlc import stopping

GARBAGE = (10_000, 10, 50)
"""Thresholds of the garbage collection. With Python's own ones imports take 7 % longer."""


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C while modules are imported gives 130."""
    try:
        gc.set_threshold(*GARBAGE)
        stopping.arm()
        from stlc.cli.framework.app import main as run

        return stopping.finish(run())
    except KeyboardInterrupt:
        return stopping.finish(130)


if __name__ == "__main__":
    sys.exit(main())
