"""The proofs of the monitor at any size: random formulas on random traces against the definitions.

    python tools/proofs.py values --count 10000

Runs a test of `tests/proof/` on cases that nobody has seen (or from `--first` on) and prints, every
`--every` cases, how many there were, in how many blocks of them one disagreed, the greatest difference of two
finite values that should be equal, and the seconds of processor time. A mismatch is printed with its case and
seed. Exit code: 1 if there was one.
"""

import random
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import torch
import typer

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from proof import test_gradients, test_monitor, test_online
from proof.cases import Case

BLOCK = 100
"""Cases after the first mismatch of a block are not looked at."""


def _rtamt(numbers: range) -> None:
    from proof.test_rtamt import test_rtamt_says_the_same

    test_rtamt_says_the_same(numbers)


def _slopes(name: str) -> Callable[[range], None]:
    return lambda numbers: test_gradients.check_gradients(numbers, name)


PROOFS: dict[str, Callable[[range], None]] = {
    "values": test_monitor.test_every_value_is_the_definition,
    "other": test_monitor.test_the_other_evaluator_says_the_same,
    "truth": test_monitor.test_truth_is_boolean_and_agrees_with_the_sign,
    "clock": test_monitor.test_the_mission_clock,
    "windows": test_monitor.test_planning_windows,
    "online": test_online.test_samples_one_by_one,
    "promises": test_online.test_what_was_said_stays_true,
    "rtamt": _rtamt,
    **{f"gradients-{name}": _slopes(name) for name in ("exact", "smooth", "agm", "dgmsr")},
}


class Differences:
    """Notes how far values are apart that the proofs compare, while it is entered."""

    def __init__(self) -> None:
        self.worst = 0.0

    def __enter__(self) -> Self:
        same = self._same = Case.same

        def noted(case: Case, found: Any, wanted: Any, about: str) -> None:
            with np.errstate(invalid="ignore"):
                apart = np.abs(np.asarray(found, float) - np.asarray(wanted, float))
            self.worst = max(self.worst, float(np.max(apart, where=np.isfinite(apart), initial=0.0)))
            same(case, found, wanted, about)

        Case.same = noted  # type: ignore[method-assign]
        return self

    def __exit__(self, *_: object) -> None:
        Case.same = self._same  # type: ignore[method-assign]


def main(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(PROOFS)}.")],
    count: int = 10_000,
    first: int | None = None,
    every: int = 500,
) -> None:
    """Run one proof and print what came out."""
    if name not in PROOFS:
        raise typer.BadParameter(f"the proofs are {', '.join(PROOFS)}")
    torch.set_num_threads(1)
    begin = random.SystemRandom().randrange(1 << 40) if first is None else first
    began, bad = time.process_time(), 0
    print(f"{name}: cases from {begin} on")
    with Differences() as differences:
        for low in range(begin, begin + count, BLOCK):
            numbers = range(low, min(low + BLOCK, begin + count))
            try:
                PROOFS[name](numbers)
            except Exception as error:
                bad += 1
                print(f"MISMATCH among {numbers}: {type(error).__name__}: {error}")
            done, seconds = numbers.stop - begin, time.process_time() - began
            if done % every == 0 or done == count:
                told = f"{done:6} cases  {bad} blocks with a mismatch"
                print(f"{told}  greatest difference {differences.worst:.1e}  {seconds:.0f} s", flush=True)
    raise typer.Exit(code=1 if bad else 0)


if __name__ == "__main__":
    typer.run(main)
