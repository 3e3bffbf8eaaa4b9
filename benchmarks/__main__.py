"""The program `python -m benchmarks`: each module in `benchmarks/tables/` is a command that makes a table."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from stlc import stopping
from stlc.cli.framework.program import Program, describe
from stlc.plugins import name_path

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
    groups={
        "Controllers": ("paper", "ablation", "family", "worlds", "disturbed", "latency", "repair", "step"),
        "Monitors": ("robustness", "streams", "gym"),
        "Tasks": ("tasks",),
        "Assurance": ("falsify", "searches", "certificates", "uncertain", "verify", "ainncs"),
    },
    drives=True,
)

RIVALS = {
    "stlc.methods": Path(__file__).parent / "methods",
    "stlc.planners": Path(__file__).parent / "methods/planners",
}
"""Folders of the methods and planners that only the tables need, by group of plugins."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, with the methods of the comparison, and return its exit code.

    `argv` are the arguments, by default those of the process.
    """
    for group, folder in RIVALS.items():
        name_path(group, folder)
    return PROGRAM.run(argv)


if __name__ == "__main__":
    stopping.arm()
    sys.exit(stopping.finish(main()))
