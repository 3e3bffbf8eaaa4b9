"""Execution of stlc as `python -m stlc`."""

import sys

from stlc import stopping


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C while modules are imported gives 130."""
    try:
        stopping.arm()
        from stlc.cli.framework.app import main as run

        return stopping.finish(run())
    except KeyboardInterrupt:
        return stopping.finish(130)


if __name__ == "__main__":
    sys.exit(main())
