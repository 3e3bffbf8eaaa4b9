"""Exported monitors on a Cortex-M4: flash, RAM and instructions a sample, beside R2U2's monitor in C.

QEMU runs the board mps2-an386 and counts instructions (`benchmarks/cortex/board.c`), so that two runs agree.
The loop over samples and the start of the program are measured without a monitor, and subtracted. stlc is
exported with `--float`; R2U2 compares doubles, as its compiled specifications hold them.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal, NamedTuple

import numpy as np
import typer

from benchmarks.monitors import ALWAYS, NESTED, Data, lookahead, monitor_of, response
from benchmarks.options import Output
from benchmarks.requirements import Atom, Formula, Joined, Over, signals_of, written
from benchmarks.table import Columns, Table, measured_here, publish
from stlc.cli.framework.program import command
from stlc.diagnostics import MissingError, usage
from stlc.export.monitor import export_monitor

BOARD = Path(__file__).resolve().parents[1] / "cortex"
FORMULAS = (NESTED, ALWAYS, response())
ROWS, PASSES, FULL = 1000, 12, 2
"""Samples of a pass, passes, and those that fill the windows before instructions are counted."""

_GCC, _SIZE, _QEMU = "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"
_COMPILE = (
    *(_GCC, "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=gnu99", "-w"),
    *("-ffp-contract=off", "-ffunction-sections", "-fdata-sections", f"-I{BOARD}", f"-T{BOARD / 'board.ld'}"),
    *("-nostartfiles", "-Wl,--gc-sections", "--specs=nano.specs", "--specs=nosys.specs"),
)
_RUN = (
    *(_QEMU, "-machine", "mps2-an386", "-icount", "shift=0", "-nographic"),
    *("-semihosting-config", "enable=on,target=native", "-kernel"),
)
_CALIBRATION = 2_000_000
"""Instructions of the loop whose ticks the board prints first."""

_OUTPUT = Output()

Who = Literal["nothing", "stlc", "R2U2"]


class Measurement(NamedTuple):
    """Bytes of a program and its variables, instructions, and starts that are known and satisfied."""

    flash: int
    ram: int
    instructions: float
    known: int
    satisfied: int


@dataclass(frozen=True, slots=True)
class CortexRow:
    """A monitor on the board.

    Attributes:
        formula: the formula.
        monitor: stlc or R2U2.
        optimised: option of the compiler.
        flash: bytes of code and constants, with what it links of the C library.
        ram: bytes of variables.
        instructions: instructions a sample.
        known: number of starts whose verdict it knows at the end.
        equal: whether as many of them are satisfied as the evaluator of recordings says.
    """

    formula: str
    monitor: str
    optimised: str
    flash: int
    ram: int
    instructions: float
    known: int
    equal: bool


COLUMNS: Columns[CortexRow] = {
    **{"formula": "{formula}", "monitor": "{monitor}", "option": "`{optimised}`"},
    **{"flash, bytes": "{flash:,}", "RAM, bytes": "{ram:,}", "instructions a sample": "{instructions:,.0f}"},
    **{"verdicts": "{known:,}", "as recorded": lambda row: "equal" if row.equal else "**different**"},
}


def samples(signals: Sequence[str]) -> Data:
    """The samples of `board.c` by signal, (time,)."""
    seed, drawn = 1, []
    for _ in range(ROWS * len(signals)):
        seed = (seed * 1664525 + 1013904223) % (1 << 32)
        drawn.append(10 * (seed >> 22) / 1024)
    table = np.tile(np.array(drawn).reshape(ROWS, -1), (PASSES, 1))
    return {name: table[:, i] for i, name in enumerate(signals)}


def for_r2u2(formula: Formula) -> str:
    """Return a formula in the language of R2U2, on a grid of one second."""
    match formula:
        case Atom(signal, op, value):
            return f"({signal} {op} {value!r})"
        case Joined(op, left, right):
            sign = {"and": "&&", "or": "||", "->": "->"}[op]
            return f"({for_r2u2(left)} {sign} {for_r2u2(right)})"
        case Over("always" | "eventually" as op, (lo, hi), body):
            return f"({'G' if op == 'always' else 'F'}[{lo:.0f},{hi:.0f}] {for_r2u2(body)})"
    raise usage(f"R2U2 has no form of `{written(formula)}` here")


def measure(who: Who, formula: Formula, optimised: str, r2u2: Path | None) -> Measurement:
    """Build the program of a monitor, and run it on the board.

    Raises:
        UsageError: U101, R2U2's compiler refuses the formula, or a program does not run.
    """
    signals = sorted(signals_of(formula))
    defined = [f"-DSIGNALS={len(signals)}", f"-DPASSES={PASSES}", f"-DFULL={FULL}"]
    with TemporaryDirectory() as name:
        folder = Path(name)
        sources, program = [BOARD / "board.c", BOARD / f"with_{who.lower()}.c"], folder / "program.elf"
        if who == "stlc":
            export_monitor(monitor_of([formula]), folder, at="all", single=True)
            (header,) = folder.glob("*_monitor.h")
            sources.append(header.with_suffix(".c"))
            defined += [f"-DNAME={header.stem}", f'-DHEADER="{header.name}"', f"-I{folder}"]
        elif who == "R2U2":
            assert r2u2 is not None
            sources += _r2u2(formula, signals, folder, r2u2)
            defined += [f"-I{folder / 'src'}", '-DSPECIFICATION="../specification.inc"']
        _called([*_COMPILE, optimised, *defined, *map(str, sources), "-lm", "-o", str(program)])
        text, data, bss = map(int, _called([_SIZE, str(program)]).splitlines()[-1].split()[:3])
        calibrated, ticks, known, satisfied = map(int, _called([*_RUN, str(program)]).split())
    instructions = ticks * _CALIBRATION / calibrated / (ROWS * (PASSES - FULL))
    return Measurement(text + data, data + bss, instructions, known, satisfied)


def _r2u2(formula: Formula, signals: Sequence[str], folder: Path, clone: Path) -> list[Path]:
    """Compile a formula by R2U2; return the sources of its monitor, with the sizes that the formula needs."""
    source, map_, binary = (folder / f"formula.{end}" for end in ("c2po", "map", "bin"))
    declared = "".join(f"  {name}: float;\n" for name in signals)
    source.write_text(f"INPUT\n{declared}\nFTSPEC\n  r: {for_r2u2(formula)};\n", encoding="utf-8")
    map_.write_text("".join(f"{name}:{i}\n" for i, name in enumerate(signals)), encoding="utf-8")
    shutil.copytree(clone / "monitors" / "c" / "src", folder / "src")
    bounds = folder / "src" / "internals" / "bounds.h"
    options = ["--spec", str(source), "--map", str(map_), "-bz", "--no-aux", "-q", "-o", str(binary)]
    compiler = str(clone / "compiler" / "c2po.py")
    _called([sys.executable, compiler, *options, "--write-bounds", str(bounds)])
    (folder / "specification.inc").write_text(",".join(map(str, binary.read_bytes())), encoding="utf-8")
    return [path for path in (folder / "src").rglob("*.c") if "cli" not in path.parts]


def _called(words: Sequence[str]) -> str:
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        raise usage(f"`{words[0]}` ends with exit code {done.returncode}: {done.stderr.strip()[-300:]}")
    return done.stdout + (done.stderr if words[0] == _QEMU else "")  # semihosting writes there


def row_of(who: Who, formula: Formula, optimised: str, r2u2: Path | None) -> CortexRow:
    """Return the row of a monitor, without what the program takes that has none."""
    found, empty = (measure(each, formula, optimised, r2u2) for each in (who, "nothing"))
    data = samples(sorted(signals_of(formula)))
    complete = ROWS * PASSES - lookahead(formula)
    recorded = monitor_of([formula]).robustness(data, end="truncate")[: found.known]
    equal = found.known >= complete and int((recorded >= -1e-6).sum()) == found.satisfied
    return CortexRow(
        *(written(formula), who, optimised, found.flash - empty.flash, found.ram - empty.ram),
        *(found.instructions - empty.instructions, found.known, equal),
    )


@command("python -m benchmarks cortex", "python -m benchmarks cortex --r2u2 ../r2u2 --page docs/streams.md")
def cortex(
    r2u2: Annotated[
        Path | None, typer.Option("--r2u2", metavar="DIR", help="Clone of R2U2/r2u2, which is measured too.")
    ] = None,
    output: Output = _OUTPUT,
) -> None:
    """Measure exported monitors on a Cortex-M4, which QEMU runs."""
    for program in (_GCC, _SIZE, _QEMU):
        if shutil.which(program) is None:
            packages = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
            raise MissingError.of("R301", f"there is no `{program}`", help=(f"apt install {packages}",))
    who: tuple[Who, ...] = ("stlc",) if r2u2 is None else ("stlc", "R2U2")
    cells = [*product(FORMULAS, ("-O2", "-Os"), who)]
    table = Table(
        "cortex",
        cells,
        lambda cell: row_of(cell[2], cell[0], cell[1], r2u2),
        COLUMNS,
        "{formula} {monitor} {optimised}: {instructions:,.0f} instructions",
    )
    compiler = re.sub(r"\s*\(.*?\)", "", _called([_GCC, "--version"]).splitlines()[0])
    told = f"{compiler}; {_called([_QEMU, '--version']).splitlines()[0].split(' (')[0]}"
    publish("cortex", output, lambda: [*table.markdown(), "", f"{measured_here()}; {told}"], {"rows": table})
