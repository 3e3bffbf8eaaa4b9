"""`python -m stlc` is `stlc`."""

import sys

from stlc import stopping


def main() -> int:
    """Run the command line; Ctrl-C while it is being imported is an interruption like any other."""
    try:
        stopping.arm()
        from stlc.cli.framework.app import main as run

        return stopping.finish(run())
    except KeyboardInterrupt:
        return stopping.finish(130)


if __name__ == "__main__":
    sys.exit(main())
