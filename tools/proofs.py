"""Proofs of the compiler and the monitor at any size: random formulas and traces against the definitions.

    python tools/proofs.py --count 100000 --jobs 16 --seed 1 --log proofs.jsonl
    python tools/proofs.py values online --count 500

Runs the checks of `tests/proof/` and `tests/helpers/laws.py` on fresh random cases, or on those of `--seed`,
in blocks of 100, `--jobs` of them at the same time. With `--log` each finished block is a line of that file;
the same command resumes after the last one. A mismatch is printed with its case. A final table shows for each
proof the number of cases and mismatches, the greatest difference of two finite values that should be equal,
and processor time. Exit code: 1 after a mismatch.
"""

from __future__ import annotations

import json
import multiprocessing
import random
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import hypothesis
import numpy as np
import torch
import typer
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers import laws
from helpers.emitted import choosing, near_switches, slopes_agree
from helpers.formula_strategies import formulas, traces
from helpers.mission_strategies import bodies, missions, nested
from proof import blamed, monitored, slopes, streamed
from proof import missions as states
from proof.cases import Case

from stlc.native import compiler

BLOCK = 100
"""Number of cases in a block, after which a process reports its outcome."""

MOST = 10
"""Maximum number of mismatches per proof that are printed in full."""


@dataclass(frozen=True)
class Block:
    """Some cases of one proof: `count` from the number `first` on."""

    proof: str
    first: int
    count: int


@dataclass(frozen=True)
class Outcome:
    """Outcome of a block.

    Attributes:
        block: the cases.
        cases: number of judged ones; some drawn formulas are rejected.
        mismatches: descriptions with the case.
        worst: the greatest difference of two finite values that should be equal.
        seconds: of processor time.
    """

    block: Block
    cases: int
    mismatches: list[str] = field(default_factory=list)
    worst: float = 0.0
    seconds: float = 0.0


# ---------------------------------------------------------------------- the proofs

Check = Callable[[int], Any]
"""Check of the case with a number: raises on a mismatch; False if there was nothing to judge."""


def one_by_one(check: Check, block: Block) -> tuple[int, list[str]]:
    """Run cases seeded by their numbers; return their count and mismatches."""
    cases, mismatches = 0, []
    for number in range(block.first, block.first + block.count):
        try:
            cases += check(number) is not False
        except Exception as error:
            cases += 1
            mismatches.append(f"{block.proof} {number}: {type(error).__name__}: {error}")
    return cases, mismatches


def by_hypothesis(
    check: Callable[..., None], given: Mapping[str, Any], block: Block
) -> tuple[int, list[str]]:
    """Run cases drawn by hypothesis, seeded by the block's first number; a mismatch is shrunk."""
    cases = 0

    def judged(**values: Any) -> None:
        nonlocal cases
        check(**values)
        cases += 1

    run = hypothesis.seed(block.first)(
        hypothesis.settings(
            max_examples=block.count,
            deadline=None,
            database=None,
            phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
            suppress_health_check=list(hypothesis.HealthCheck),
            print_blob=False,
        )(hypothesis.given(**given)(judged))
    )
    try:
        run()
    except Exception as error:
        notes = "\n".join(getattr(error, "__notes__", ()))
        return block.count, [f"{block.proof} {block.first}: {type(error).__name__}: {error}\n{notes}"]
    return min(cases, block.count), []


def drawn_choices(block: Block) -> tuple[int, list[str]]:
    """Compare conditional expressions in C and torch, at and near switches; none without a compiler."""
    if compiler() is None:
        return 0, []
    nums = choosing(block.count, block.first)
    points = near_switches(np.random.default_rng(block.first), 60)
    mismatches = []
    try:
        slopes_agree(nums, points)
    except Exception as error:
        mismatches.append(f"{block.proof} {block.first}: {type(error).__name__}: {error}")
    return len(nums), mismatches


def _law(data: st.DataObject, env: dict[str, Any], flip: bool, name: str) -> None:
    laws.check_law(laws.LAWS[name], data.draw, env, flip=flip)


def _moved(data: st.DataObject, env: dict[str, Any]) -> None:
    laws.check_moved(data.draw, env)
    laws.check_clock(data.draw, env)


def _rtamt(number: int) -> None:
    from proof.test_rtamt import test_rtamt_says_the_same

    test_rtamt_says_the_same(range(number, number + 1))


_SHORT = traces(high=9, batch=1)
_SEEDS = st.integers(0, 2**32 - 1)
_LAW = {
    "data": st.data(),
    "env": _SHORT,
    "flip": st.booleans(),
    "name": st.sampled_from(sorted(laws.LAWS)),
}
_WHOLE = {"formula": formulas() | formulas(held=()), "env": _SHORT}

PROOFS: dict[str, Callable[[Block], tuple[int, list[str]]]] = {
    "values": partial(one_by_one, monitored.check_values),
    "other": partial(one_by_one, monitored.check_other),
    "truth": partial(one_by_one, monitored.check_truth),
    "clock": partial(one_by_one, monitored.check_clock),
    "windows": partial(one_by_one, monitored.check_windows),
    "online": partial(one_by_one, streamed.check_online),
    "promises": partial(one_by_one, streamed.check_promise),
    "causes": partial(one_by_one, blamed.check_cause),
    "causes-streamed": partial(one_by_one, blamed.check_told_by_stream),
    "missions": partial(by_hypothesis, states.check_mission, {"formula": missions, "seed": _SEEDS}),
    "past": partial(by_hypothesis, states.check_past, {"formula": bodies, "seed": _SEEDS}),
    "nested": partial(by_hypothesis, states.check_nested, {"formula": nested, "seed": _SEEDS}),
    "past-margins": partial(by_hypothesis, states.check_margins, {"formula": bodies, "seed": _SEEDS}),
    "recorded": partial(by_hypothesis, states.check_recorded, {"formula": missions, "seed": _SEEDS}),
    "laws": partial(by_hypothesis, _law, _LAW),
    "moved": partial(by_hypothesis, _moved, {"data": st.data(), "env": _SHORT}),
    "compiled": partial(by_hypothesis, laws.check_compiled, _WHOLE),
    **{
        f"gradients-{name}": partial(one_by_one, partial(slopes.check_gradient, name=name))
        for name in ("exact", "smooth", "agm", "dgmsr")
    },
    "gradients-choices": drawn_choices,
    "rtamt": partial(one_by_one, _rtamt),
}
EXTRA = frozenset({"rtamt"})
"""Proofs that run only if named, as they need another package."""


def run(block: Block) -> Outcome:
    """Judge the cases of a block."""
    began, apart = time.process_time(), 0.0
    same = Case.same

    def noted(case: Case, found: Any, wanted: Any, about: str) -> None:
        nonlocal apart
        with np.errstate(invalid="ignore"):
            gaps = np.abs(np.asarray(found, float) - np.asarray(wanted, float))
        apart = max(apart, float(np.max(gaps, where=np.isfinite(gaps), initial=0.0)))
        same(case, found, wanted, about)

    Case.same = noted  # type: ignore[method-assign]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hypothesis.errors.HypothesisWarning)
            cases, mismatches = PROOFS[block.proof](block)
    finally:
        Case.same = same  # type: ignore[method-assign]
    return Outcome(block, cases, mismatches, apart, time.process_time() - began)


# ------------------------------------------------------------------------ the run


def blocks_of(names: list[str], count: int, seed: int) -> list[Block]:
    """All blocks, alternating between proofs, so that mismatches show early."""
    firsts = range(seed, seed + count, BLOCK)
    return [Block(name, first, min(BLOCK, seed + count - first)) for first in firsts for name in names]


def finished(log: Path | None) -> list[Outcome]:
    """The finished blocks of a log; an incomplete last line is ignored."""
    found = []
    for line in log.read_text(encoding="utf-8").splitlines() if log is not None and log.exists() else ():
        try:
            entry = json.loads(line)
            found.append(Outcome(**{**entry, "block": Block(**entry["block"])}))
        except (ValueError, TypeError, KeyError):
            continue
    return found


def outcomes(blocks: list[Block], jobs: int) -> Iterator[Outcome]:
    """The outcome of each block, in the order of completion."""
    torch.set_num_threads(1)
    if jobs == 1:
        yield from map(run, blocks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, torch.set_num_threads, (1,)) as pool:
        yield from pool.imap_unordered(run, blocks)


class Tally:
    """Counts of every proof, and mismatches."""

    def __init__(self, names: list[str], every: int) -> None:
        self.totals = {name: Outcome(Block(name, 0, 0), 0) for name in names}
        self._every, self._told = every, 0

    def add(self, new: Outcome) -> None:
        """Add a block; print mismatches, and intermediate counts."""
        name = new.block.proof
        old = self.totals[name]
        for text in new.mismatches[: max(MOST - len(old.mismatches), 0)]:
            print(f"MISMATCH {text}", flush=True)
        self.totals[name] = Outcome(
            old.block,
            old.cases + new.cases,
            old.mismatches + new.mismatches,
            max(old.worst, new.worst),
            old.seconds + new.seconds,
        )
        done = sum(total.cases for total in self.totals.values())
        if done // self._every > self._told:
            self._told = done // self._every
            print(f"{done:9,} cases  {self.wrong} mismatches", flush=True)

    @property
    def wrong(self) -> int:
        """Mismatches so far."""
        return sum(len(total.mismatches) for total in self.totals.values())

    def table(self) -> None:
        """Print a line per proof, and the total."""
        print(f"{'proof':18}{'cases':>10}{'mismatches':>12}{'difference':>12}{'seconds':>9}")
        for name, total in self.totals.items():
            wrong = len(total.mismatches)
            print(f"{name:18}{total.cases:10,}{wrong:12}{total.worst:12.1e}{total.seconds:9.0f}")
        cases = sum(total.cases for total in self.totals.values())
        seconds = sum(total.seconds for total in self.totals.values())
        print(f"{'all':18}{cases:10,}{self.wrong:12}{'':12}{seconds:9.0f}", flush=True)


def main(
    names: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(PROOFS)}; all but rtamt.")] = None,
    count: Annotated[int, typer.Option(min=1, help="Cases of each proof.")] = 10_000,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Number of the first case; drawn if not given.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    log: Annotated[Path | None, typer.Option(help="File of finished blocks, to go on from.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Cases between two lines of counts.")] = 5_000,
) -> None:
    """Run proofs and print the outcomes."""
    chosen = list(names) if names else [name for name in PROOFS if name not in EXTRA]
    if unknown := set(chosen) - PROOFS.keys():
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: the proofs are {', '.join(PROOFS)}")
    before = [outcome for outcome in finished(log) if outcome.block.proof in chosen]
    if seed is None:
        starts = [outcome.block.first for outcome in before]
        seed = min(starts) if starts else random.SystemRandom().randrange(1 << 40)
    print(f"{', '.join(chosen)}: {count:,} cases each from {seed} on", flush=True)
    wanted = blocks_of(chosen, count, seed)
    known = {outcome.block: outcome for outcome in before}
    tally = Tally(chosen, every)
    for block in wanted:
        if block in known:
            tally.add(known[block])
    for outcome in outcomes([block for block in wanted if block not in known], jobs):
        if log is not None:
            with log.open("a", encoding="utf-8") as file:
                file.write("\n" + json.dumps(asdict(outcome)) + "\n")
        tally.add(outcome)
    tally.table()
    raise typer.Exit(code=1 if tally.wrong else 0)


if __name__ == "__main__":
    typer.run(main)
