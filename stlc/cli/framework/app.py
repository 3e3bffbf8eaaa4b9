"""The program `stlc`."""

from __future__ import annotations

from collections.abc import Sequence

from stlc.cli.framework.program import Program, describe
from stlc.registry import PackageRegistry

PROGRAM = Program(
    name="stlc",
    help=describe(
        "Train, check and guard controllers from Signal Temporal Logic requirements.",
        "stlc train specs/traffic.stl --system car.yaml --budget 60s",
        "stlc simulate --backup",
        "stlc check trace.npz",
    ),
    package="stlc.cli.commands",
    groups={
        "Requirements and traces": ("check", "explain", "plot", "lint", "fmt", "compile"),
        "Controllers": ("plan", "train", "simulate", "export"),
        "Assurance": ("falsify", "certify", "verify"),
        "Projects and runs": ("init", "system", "runs", "report"),
        "Tools": ("lsp", "schema", "doctor", "help"),
    },
    moved={
        "bench": "python -m benchmarks  in a clone of the repository makes the tables of the documentation",
        "parse": "stlc compile FILE --show ast",
        "new": "stlc init --spec NAME, or stlc init --system NAME",
    },
    elsewhere=PackageRegistry(
        "command", "", "", group="stlc.commands", accepts="stlc.cli.framework.program:is_command"
    ),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `stlc` with these arguments (default: those of the process) and return its exit code."""
    return PROGRAM.run(argv)
