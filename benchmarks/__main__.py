"""The program `python -m benchmarks`: each module in `benchmarks/tables/` is a command that makes a table."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from stlc import stopping
from stlc.cli.framework.program import Program, describe

PROGRAM = Program(
    name="python -m benchmarks",
    help=describe(
        "Measure the tables of the documentation again, and write them into its pages.",
        "python -m benchmarks paper --only traffic --budget 60s --seeds 0",
        "python -m benchmarks robustness",
        note="Results are kept in benchmarks/results/ under what they depend on: specification, system, "
        "method and its version, version of the guard, seeds. What is there is not measured again.",
    ),
    package="benchmarks.tables",
    order=(
        *("paper", "ablation", "family", "worlds", "disturbed", "latency", "repair", "step", "robustness"),
        *("gym", "falsify", "certificates", "uncertain", "verify", "ainncs"),
    ),
    drives=True,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code.

    `argv` are the arguments, by default those of the process.
    """
    return PROGRAM.run(argv)


if __name__ == "__main__":
    stopping.arm()
    sys.exit(stopping.finish(main()))
