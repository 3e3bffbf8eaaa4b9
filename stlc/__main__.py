"""`python -m stlc` is `stlc`."""

import sys


def main() -> int:
    """Run the command line; Ctrl-C while it is being imported is an interruption like any other."""
    try:
        from stlc.cli.app import main as run

        return run()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
