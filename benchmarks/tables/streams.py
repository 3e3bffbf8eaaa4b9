"""Streams: time and memory of a sample, beside the online monitors of RTAMT, Reelay, SENTIL and mstlo.

Formulas are on a grid of one second. Times are processor times on one thread, minima over rounds in which the
monitors take turns; windows are full before the clock starts. Loops that push samples run in C (`map`).
"""

from __future__ import annotations

import csv
import ctypes
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Annotated, Any, TypeAlias

import numpy as np
import typer

from benchmarks.monitors import (
    ALWAYS,
    BLOCK,
    NESTED,
    PEERS,
    Data,
    Feed,
    always,
    at_first,
    by_rtamt_alone,
    drawn,
    endless,
    first_verdicts,
    installed,
    lookahead,
    monitor_of,
    online_of,
    ours,
    read_by,
    recorded,
    response,
)
from benchmarks.options import OnlyOption, Output, ResultsOption, chosen
from benchmarks.requirements import Formula, Joined, Over, written
from benchmarks.store import RESULTS, Key, ResultStore
from benchmarks.table import Columns, listed, provenance, publish, values
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.export.monitor import export_monitor
from stlc.monitor.online.online import Decision

SAMPLES, ROUNDS = 200_000, 5
COMPARED = 5_000
"""Samples of which all monitors' values are compared."""
_SPENT = 0.4
"""Processor time of one measurement of another monitor in seconds; a slow one gets fewer samples."""
_FULL = 10.0
"""Processor time in seconds that may be spent on filling its windows."""
_OUTPUT = Output()

# --------------------------------------------------------------------------- rows


@dataclass(frozen=True, slots=True)
class StreamRow:
    """One measured figure.

    Attributes:
        target: the target that it belongs to, a key of `TARGETS`.
        pushed: what is pushed, or given: row, dict, block, …
        formula: the formula, or several.
        samples: number of samples that were timed; those of a slow monitor are fewer.
        unit: unit of the figures.
        stlc: figure of stlc; None if it could not be measured here.
        others: figure of each other monitor by name; None where it cannot express the formula.
        note: what else was measured.
    """

    target: str
    pushed: str
    formula: str
    samples: int
    unit: str
    stlc: float | None
    others: Mapping[str, float | None] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True, slots=True)
class AgreementRow:
    """Comparison of values that mean the same thing.

    Attributes:
        formula: the formula.
        what: what is compared with stlc's.
        compared: number of values.
        equal: those that are equal bit for bit.
        note: how the others differ.
    """

    formula: str
    what: str
    compared: int
    equal: int
    note: str


@dataclass(frozen=True, slots=True)
class Target:
    """Target of the redesign of streams, and what it was before.

    Attributes:
        text: what is asked.
        limit: greatest figure that meets it, in the unit of its rows.
        before: figure before, as measured when the target was set.
    """

    text: str
    limit: float
    before: str = ""


TARGETS = {
    "row": Target("a verdict for every start, pushed row by row: at most 1 µs", 1.0, "82, 92 µs"),
    "hundred": Target("100 requirements: at most .3 µs each", 0.3, "360 to 420 µs each"),
    "dict": Target("pushed as a dict: at most 3 µs", 3.0, "86 to 93 µs"),
    "block": Target("in blocks: at most 50 ns a sample and operator", 50.0),
    "c": Target("exported C: at most 50 ns a sample and operator", 50.0, "only with a trained run"),
    "allocation": Target("exported C: 0 bytes allocated, size of the state in the header", 0.0),
    "offline": Target("one trace of 1,000 samples: at most 15 µs", 15.0, "118 µs"),
    "start": Target("a value at one start of 10^6 samples: at most 50 µs", 50.0, "1,300 µs"),
    "pipe": Target("`stlc check -`: at most twice `pandas.read_csv` over the same pipe", 2.0),
    "wide": Target("windows of 10^5 and 10^7 samples: the cost of 1,000 (at most 1.2 times)", 1.2),
    "late": Target("wide windows: no verdict late", 0.0, "by up to an eighth of the window"),
    "memory": Target("memory: at most 3 times that of wedges", 3.0),
    "growth": Target("memory: unchanged by a million samples (at most 100 kB)", 100.0),
    "lines": Target("at most half of the lines of `monitor/online`, new code counted", 0.5, "2,843 lines"),
}
"""Targets in their order; figures of `before` are those that were measured when they were set."""


@dataclass(frozen=True, slots=True)
class Reached:
    """A target beside its worst measured figure."""

    target: Target
    rows: tuple[StreamRow, ...]

    @property
    def measured(self) -> str:
        """Figures of its rows."""
        return ", ".join(_figure(row.stlc) for row in self.rows) + f" {self.rows[0].unit}"

    @property
    def verdict(self) -> str:
        """`met` if all of its figures are within the limit."""
        found = [row.stlc for row in self.rows if row.stlc is not None]
        if len(found) < len(self.rows):
            return "not measured here"
        return "met" if max(found) <= self.target.limit else "**missed**"


def _figure(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 or value == 0 else f"{value:.3g}"


def _of(name: str) -> Callable[[StreamRow], str]:
    (peer,) = (each for each in PEERS if each.name == name)

    def shown(row: StreamRow) -> str:
        if name not in row.others and row.target in _BESIDE and not peer.installed:
            return f"`pip install {peer.package}`"
        return _figure(row.others.get(name))

    return shown


_BESIDE = ("row", "hundred", "dict", "block", "wide", "growth", "offline", "start")
"""Targets in which other monitors stand beside stlc."""

REACHED: Columns[Reached] = {
    "target": "{target.text}",
    **{"before": "{target.before}", "measured": "{measured}", "": "{verdict}"},
}
COLUMNS: Columns[StreamRow] = {
    **{"pushed": "{pushed}", "formula": "{formula}", "samples": "{samples:,}", "unit": "{unit}"},
    "stlc": lambda row: _figure(row.stlc),
    **{peer.name: _of(peer.name) for peer in PEERS},
    "note": "{note}",
}
AGREEMENT: Columns[AgreementRow] = {
    **{"formula": "{formula}", "compared with stlc": "{what}"},
    **{"values": "{compared:,}", "equal": "{equal:,}", "others": "{note}"},
}


@dataclass(frozen=True, slots=True)
class Sizes:
    """Sizes of the measurements.

    Attributes:
        samples: samples of a stream that are timed; others follow from it.
        rounds: number of measurements of which the least counts.
    """

    samples: int = SAMPLES
    rounds: int = ROUNDS

    @property
    def many(self) -> int:
        """A million, unless `samples` are fewer than usual."""
        return 5 * self.samples


def timed(formulas: Sequence[Formula], pushed: str, sizes: Sizes, *, calm: bool = False) -> dict[str, float]:
    """Processor time per sample in microseconds, by monitor; those that cannot express it are left out."""
    data = read_by(drawn(min(sizes.samples, 100_000), calm=calm), formulas)
    full = max(map(lookahead, formulas)) + 100
    form = "block" if pushed == "block" else "row"
    makers: dict[str, Callable[[], Feed | None]] = {"stlc": partial(ours, formulas, data, pushed)}
    peers = [each for each in installed() if full <= each.longest]
    makers |= {each.name: partial(each.feed, formulas, data, form) for each in peers}
    counts = {name: _counts(name, maker(), form, full, sizes.samples) for name, maker in makers.items()}
    best: dict[str, float] = {}
    for _ in range(sizes.rounds):
        for name, (filled, number, samples) in counts.items():
            if samples and (feed := makers[name]()) is not None:
                feed.run(filled)
                best[name] = min(best.get(name, np.inf), 1e6 * feed.run(number) / samples)
    return best


def _counts(name: str, feed: Feed | None, form: str, full: int, samples: int) -> tuple[int, int, int]:
    """Pushes before the clock starts, pushes that are timed, and their samples."""
    if feed is None:
        return 0, 0, 0
    if form == "block":
        size = min(BLOCK, samples)
        blocks = samples // size
        return (-(-full // size), blocks, blocks * size) if name == "stlc" else (0, 1, min(samples, 100_000))
    if name == "stlc":
        return full, samples, samples
    once = feed.run(20) / 20
    number = int(min(max(_SPENT / once, 20), samples))
    if name == "RTAMT":  # its buffers are full from the start
        return 0, number, number
    return (full, number, number) if once * full < _FULL else (0, 0, 0)


# --------------------------------------------------------------------------- parts


Parts: TypeAlias = Iterator[StreamRow | AgreementRow]


def _row(
    target: str, formulas: Sequence[Formula], pushed: str, sizes: Sizes, per: float = 1.0, unit: str = ""
) -> StreamRow:
    found = timed(formulas, pushed, sizes)
    shown = written(formulas[0]) + (f", and {len(formulas) - 1} like it" if formulas[1:] else "")
    figures = {name: each / per for name, each in found.items()}
    mine = figures.pop("stlc")
    others = {each.name: figures.get(each.name) for each in installed()}
    return StreamRow(target, pushed, shown, sizes.samples, unit or "µs a sample", mine, others)


def rows(sizes: Sizes) -> Parts:
    """Samples one by one."""
    for formula in (NESTED, ALWAYS, response(), always(response())):
        yield _row("row" if formula in (NESTED, ALWAYS) else "", [formula], "row", sizes)
    for formula in (NESTED, ALWAYS):
        yield _row("dict", [formula], "dict", sizes)
    fewer = Sizes(max(sizes.samples // 20, 500), sizes.rounds)
    for formula in (NESTED, ALWAYS):
        yield _row("", [formula], "row, verdicts read", fewer)
    hundred = [response(i) for i in range(100)]
    for several in (hundred, [always(each) for each in hundred]):
        yield _row("hundred", several, "row", fewer, 100, "µs a sample and requirement")


def blocks(sizes: Sizes) -> Parts:
    """Samples in blocks."""
    for formula in (NESTED, ALWAYS, response(), always(response())):
        per = 1e-3 * operators(formula)
        yield _row("block", [formula], "block", sizes, per, "ns a sample and operator")


def operators(formula: Formula) -> int:
    """Number of temporal operators and connectives; comparisons are not counted."""
    match formula:
        case Joined(_, left, right):
            return 1 + operators(left) + operators(right)
        case Over(_, _, body):
            return 1 + operators(body)
    return 0


def wide(sizes: Sizes) -> Parts:
    """Wide windows, full of samples."""
    narrow = timed([ALWAYS], "row", sizes, calm=True)
    few = Sizes(sizes.samples, min(sizes.rounds, 2))
    for width in (sizes.samples // 2, 50 * sizes.samples):
        formula = Over("always", (0, width), ALWAYS.body)
        found = timed([formula], "row", few, calm=True)
        note = ", ".join(f"{name} {_figure(each)}" for name, each in found.items()) + " µs"
        figures = {name: each / narrow[name] for name, each in found.items()}
        mine, shown = figures.pop("stlc"), written(formula)
        yield StreamRow("wide", "row", shown, sizes.samples, "of the time with 1,000", mine, figures, note)
        yield late(width)


def late(width: int) -> StreamRow:
    """Starts of `always[0, width]` that are not decided by the first sample at which they can be."""
    formula = Over("always", (0, width), ALWAYS.body)
    samples, size = 22 * width // 10, max(width // 100, 1)
    x = np.full(samples, 6.0)
    bad = np.array([2 * width // 10, 2 * width // 10 + 7, 5 * width // 10, 17 * width // 10])
    x[bad] = 4.0
    start = np.arange(samples)
    after = np.append(bad, 2 * samples)[np.searchsorted(bad, start)]
    first = np.minimum(after, start + width)
    wanted = np.bincount(first[first < samples] // size, minlength=-(-samples // size))
    online = online_of([formula])
    found = [online.push_block(x[at : at + size, None])[0] for at in range(0, samples, size)]
    behind = int(np.abs(np.cumsum(found) - np.cumsum(wanted)).max())
    return StreamRow("late", "block", written(formula), samples, "starts decided late", behind)


def memory(sizes: Sizes) -> Parts:
    """Memory of a monitor, and its growth over a million samples, each in a process of its own."""
    for formula in (NESTED, ALWAYS, Over("always", (0, sizes.samples // 2), ALWAYS.body)):
        online, wedges = online_of([formula]), wedge_bytes(formula)
        assert online._kernel is not None
        state = online._kernel.state.nbytes
        shown = written(formula)
        note = f"{state:,} bytes, wedges {wedges:,}"
        yield StreamRow("memory", "", shown, 0, "of the wedges' bytes", state / wedges, note=note)
        names = ["stlc", *(each.name for each in installed())]
        grown = {name: _grown(name, formula, sizes.many) for name in names}
        few = [
            f"{name} after {samples:,} samples"
            for name, (_, samples) in grown.items()
            if samples < sizes.many
        ]
        others = {name: kilobytes for name, (kilobytes, _) in grown.items() if name != "stlc"}
        mine = grown["stlc"][0]
        yield StreamRow("growth", "row", shown, sizes.many, "kB of growth", mine, others, "; ".join(few))


def wedge_bytes(formula: Formula) -> int:
    """Bytes of wedges: a value and an index for each sample of each window."""
    match formula:
        case Over(_, (lo, hi), body):
            return 16 * round(hi - lo + 1) + wedge_bytes(body)
        case Joined(_, left, right):
            return wedge_bytes(left) + wedge_bytes(right)
    return 0


def _grown(name: str, formula: Formula, samples: int) -> tuple[float, int]:
    with get_context("fork").Pool(1) as pool:
        return pool.apply(_growth, (name, formula, samples))


def _growth(name: str, formula: Formula, samples: int) -> tuple[float, int]:
    """Growth of this process's peak memory in kB while a monitor takes samples, and their number."""
    data = read_by(drawn(100_000), [formula])
    maker = ours if name == "stlc" else next(each.feed for each in PEERS if each.name == name)
    feed = maker([formula], data, "row")
    assert feed is not None
    once = feed.run(20) / 20
    filled = 2 * lookahead(formula) + BLOCK
    if once * filled < _FULL:
        feed.run(filled)
    number = min(samples, int(_FULL / once))
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # the peak is what is used now
    before = _peak()
    feed.run(number)
    return _peak() - before, number


def _peak() -> float:
    (found,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="utf-8"))
    return float(found)


def exported(sizes: Sizes) -> Parts:
    """Exported C, compiled by `cc -O2`: `step_block`, which takes a sample after the other."""
    compiler = shutil.which("cc")
    for formula in (always(NESTED.body), always(response()), always(Joined("and", response(), ALWAYS))):
        shown, unit = written(formula), "ns a sample and operator"
        if compiler is None:
            yield StreamRow("c", "block, in C", shown, 0, unit, None, note="there is no compiler `cc`")
            continue
        with TemporaryDirectory() as name:
            yield from _exported(formula, Path(name), compiler, sizes)


def _exported(formula: Formula, folder: Path, compiler: str, sizes: Sizes) -> Parts:
    found = export_monitor(monitor_of([formula]), folder)
    (source,) = folder.glob("*_monitor.c")
    (words,) = re.findall(r"_BYTES \(8 \* (\d+)\)", source.with_suffix(".h").read_text())
    library = folder / "monitor.so"
    options = ["-O2", "-ffp-contract=off", "-std=c99", "-shared", "-fPIC", "-o", str(library)]
    subprocess.run([compiler, *options, str(source), "-lm"], check=True)
    loaded, prefix = ctypes.CDLL(str(library)), source.stem
    online = online_of([formula])
    data = drawn(sizes.samples)
    table = np.stack([data[each] for each in online.signals], axis=1)
    take, state = loaded[f"{prefix}_step_block"], (ctypes.c_int64 * int(words))()
    best = np.inf
    for _ in range(sizes.rounds):
        loaded[f"{prefix}_init"](state)
        begin = process_time()
        take(state, ctypes.c_void_p(table.ctypes.data), ctypes.c_int64(len(table)))
        best = min(best, process_time() - begin)
    loaded[f"{prefix}_finish"](state)
    summary = (ctypes.c_double * 16)()
    loaded[f"{prefix}_read"](state, 0, summary)
    online.push_block(table)
    tally = online.finish()["r0"]
    each, shown = 1e9 * best / len(table), written(formula)
    symbols = subprocess.run(["nm", "-uD", library], capture_output=True, text=True, check=True).stdout
    allocating = re.findall(r"\b(?:malloc|calloc|realloc|free|mmap|sbrk)\b", symbols)
    note = f"{each:.0f} ns a sample; {found.bytes:,} bytes of state; {len(allocating)} calls that allocate"
    per, unit = each / operators(formula), "ns a sample and operator"
    yield StreamRow("c", "block, in C", shown, len(table), unit, per, note=note)
    yield StreamRow("allocation", "", shown, 0, "calls that allocate", len(allocating))
    said = np.array(summary[5:7])
    yield _agreed(shown, "bounds of the exported C at the end", said, np.array([tally.low, tally.high]))


def offline(sizes: Sizes) -> Parts:
    """Recorded traces."""
    whole, size = drawn(sizes.many), min(1000, sizes.samples)
    long = {"x": whole["x"]}
    short = {"x": whole["x"][:size]}
    for formula in (NESTED, ALWAYS):
        monitor = monitor_of([formula])
        makers: dict[str, Callable[[], object]] = {"stlc": partial(monitor.robustness, short, end="truncate")}
        makers |= recorded(formula, short)
        yield _calls("offline", "trace", written(formula), size, makers, sizes)
    for formula in (NESTED, ALWAYS):
        monitor = monitor_of([formula])
        for at in (0, sizes.many // 2):
            makers = {"stlc": partial(monitor.robustness, long, at=at)}
            if at == 0:
                makers |= at_first(formula, long)
            yield _calls("start", f"trace, start {at:,}", written(formula), sizes.many, makers, sizes)


def _calls(
    target: str,
    pushed: str,
    shown: str,
    samples: int,
    makers: Mapping[str, Callable[[], object]],
    sizes: Sizes,
) -> StreamRow:
    best = dict.fromkeys(makers, np.inf)
    for _ in range(2 * sizes.rounds):
        for name, function in makers.items():
            number, begin = 0, process_time()
            while number < 3 or process_time() - begin < 0.02:
                function()
                number += 1
            best[name] = min(best[name], 1e6 * (process_time() - begin) / number)
    mine = best.pop("stlc")
    others = {each.name: best.get(each.name) for each in installed()}
    return StreamRow(target, pushed, shown, samples, "µs a call", mine, others)


PIPED = """\
signal x, y, z
require nested: always eventually[0 s, 1 s] x > {low}
require limit: always[0 s, 100 s] z < 9
require response: always (x > 7 -> eventually[0 s, .5 s] y > {low})
"""
PANDAS = f"""\
import sys, pandas
for chunk in pandas.read_csv(sys.stdin, chunksize={BLOCK}): pass
"""


MEASURED = """\
import resource, subprocess, sys
with subprocess.Popen(["cat", sys.argv[1]], stdout=subprocess.PIPE) as source:
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    code = subprocess.call(sys.argv[2:], stdin=source.stdout, **quiet)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(code, used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
"""Program that measures another one; it is small, as a child's peak memory includes that of its parent."""


def pipe(sizes: Sizes) -> Parts:
    """`stlc check -` and `pandas.read_csv` over the same pipe; they take turns."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        programs = {"pandas": [sys.executable, "-c", PANDAS]}
        for what, low in (("satisfied", -9), ("violated and explained", 5)):
            spec = folder / f"{what}.stl"
            spec.write_text(PIPED.format(low=low), encoding="utf-8")
            programs[what] = [sys.executable, "-m", "stlc", "check", str(spec), "-"]
        files = {"short": _log(folder / "short.csv", 10), "long": _log(folder / "long.csv", sizes.many)}
        each = [(program, file) for program in programs for file in files]
        runs = [{one: _piped(programs[one[0]], files[one[1]]) for one in each} for _ in range(sizes.rounds)]
        seconds = {one: min(run[one][0] for run in runs) for one in each}
        peak = {one: min(run[one][1] for run in runs) for one in each}
    theirs = seconds["pandas", "long"]
    for what in [*programs][1:]:
        mine, shown = seconds[what, "long"], f"3 requirements, {what}"
        net = (mine - seconds[what, "short"]) / (theirs - seconds["pandas", "short"])
        note = f"{mine:.2f} s, pandas {theirs:.2f} s; {net:.1f} of pandas without the time to start; "
        note += f"peak {peak[what, 'long']:,} kB, {peak[what, 'short']:,} kB after 10 lines"
        yield StreamRow("pipe", "lines", shown, sizes.many, "of pandas", mine / theirs, note=note)


def _log(path: Path, samples: int) -> Path:
    data = {"t": np.arange(samples) / 100, **drawn(samples), "z": drawn(samples, 1)["y"]}
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(data)
        writer.writerows(zip(*(each.round(3).tolist() for each in data.values()), strict=True))
    return path


def _piped(words: Sequence[str], file: Path) -> tuple[float, int]:
    """Processor time in seconds and peak memory in kB of a program that reads a file from a pipe."""
    run = subprocess.run([sys.executable, "-c", MEASURED, str(file), *words], capture_output=True, check=True)
    code, seconds, peak = run.stdout.split()
    if int(code) not in (0, 1, 4):
        raise RuntimeError(f"{words} ended with {code!r}")
    return float(seconds), int(peak)


def lines(_: Sizes) -> Parts:
    """Lines of the code of streams."""
    root = Path(__file__).parent.parent.parent / "stlc"
    online = [*(root / "monitor/online").glob("*.py")]
    core = [*(root / "compile/backends/c").glob("streams.*")]
    export = [root / "export/monitor.py", *(root / "export/templates").glob("monitor*")]
    own, new, more = (
        sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)
        for paths in (online, core, export)
    )
    note = f"{own:,} lines, {new:,} of the transducers; not counted: {more:,} of the export"
    yield StreamRow("lines", "", "", 0, "of the lines before", (own + new) / 2843, note=note)


# --------------------------------------------------------------------------- agreement


def agreement(sizes: Sizes) -> Parts:
    """Values of all monitors beside those of stlc."""
    samples, names = min(COMPARED, sizes.samples), {each.name for each in installed()}
    for formula in (NESTED, ALWAYS, response(), always(response())):
        data, shown = read_by(drawn(samples, 2), [formula]), written(formula)
        once, complete = endless(formula), samples - lookahead(formula)
        if once:
            wanted = _upper_bounds(formula, data)[-complete:]
        else:
            wanted = np.asarray(monitor_of([formula]).robustness(data, end="truncate"))[:complete]
            yield from _first_verdicts(formula, data, wanted)
        for peer in installed():
            if (feed := peer.feed([formula], data, "row")) is not None:
                what = f"{'upper bounds' if once else 'values'} of {peer.name}"
                yield _agreed(shown, what, feed.outputs(samples), wanted)
        if "RTAMT" in names and not once:
            own = by_rtamt_alone(formula, data)
            yield _agreed(shown, "values of RTAMT after its own `pastify`", own, wanted)


def _upper_bounds(formula: Formula, data: Data) -> Any:
    online = online_of([formula])
    found = []
    for row in np.stack([data[name] for name in online.signals], axis=1).tolist():
        online.push(row)
        found.append(online.bounds("r0", 0)[1])
    return np.array(found)


def _first_verdicts(formula: Formula, data: Data, wanted: Any) -> Parts:
    """Verdicts of the stream against the signs of the values, and those of mstlo against them."""
    online, shown = online_of([formula]), written(formula)
    mine: dict[int, Decision] = {}
    for row in np.stack([data[name] for name in online.signals], axis=1).tolist():
        online.push(row)
        mine |= {each.start: each for each in online.verdicts()}
    held = np.array([mine[start].status == "satisfied" for start in range(len(wanted))])
    yield _agreed(shown, "signs of recorded values, with its verdicts", wanted >= -1e-6, held)
    if "mstlo" in {each.name for each in installed()}:
        theirs = first_verdicts(formula, data)
        both = np.array([start for start in range(len(wanted)) if start in theirs and wanted[start] != 0.0])
        said = [theirs[start][1] for start in both]
        yield _agreed(shown, "early verdicts of mstlo, values of 0 left out", said, held[both])
        late = np.array([theirs[start][0] - mine[start].sample for start in both])
        note = f"{(late > 0).sum():,} later, {(late < 0).sum():,} earlier"
        same = int((late == 0).sum())
        yield AgreementRow(shown, "samples at which mstlo tells them", len(late), same, note)


def _agreed(shown: str, what: str, said: Any, wanted: Any) -> AgreementRow:
    """Comparison of values from the first start on; values beyond 1e300 are infinite."""
    count = min(len(said), len(wanted))
    a, b = (np.asarray(each[:count], float) for each in (said, wanted))
    a, b = (np.where(np.abs(each) > 1e300, np.copysign(np.inf, each), each) for each in (a, b))
    same, known = a == b, np.isfinite(a) & np.isfinite(b)
    note = "" if same.all() else f"others differ by up to {np.abs(a[known] - b[known]).max(initial=0.0):.3g}"
    return AgreementRow(shown, what, count, int(same.sum()), note)


# --------------------------------------------------------------------------- the command

PARTS: dict[str, Callable[[Sizes], Parts]] = {
    **{"rows": rows, "blocks": blocks, "exported": exported, "offline": offline, "pipe": pipe},
    **{"agreement": agreement, "lines": lines, "memory": memory, "wide": wide},
}


@command(
    "python -m benchmarks streams",
    "python -m benchmarks streams --only rows,blocks --page docs/streams.md",
)
def streams(
    only: OnlyOption = None,
    samples: Annotated[
        int, typer.Option("--samples", metavar="N", min=100, help="Samples of a stream; other sizes follow.")
    ] = SAMPLES,
    rounds: Annotated[
        int, typer.Option("--rounds", metavar="N", min=1, help="Measurements, of which the least counts.")
    ] = ROUNDS,
    out: ResultsOption = RESULTS,
    output: Output = _OUTPUT,
) -> None:
    """Time streams in Python, in pipes and in C, beside the online monitors of others.

    The last measurement of each part is kept.
    """
    store, sizes = ResultStore("streams", out), Sizes(samples, rounds)
    for name in chosen(only, [*PARTS], "part"):
        found = list(PARTS[name](sizes))
        for row in found:
            say(f"{name}: {row}")
        result = {
            "rows": [values(row) for row in found if isinstance(row, StreamRow)],
            "agreement": [values(row) for row in found if isinstance(row, AgreementRow)],
        }
        store.put(Key(name, {"samples": samples, "rounds": rounds}), result)
    kept = [each for name in PARTS if (each := store.all().get(name)) is not None]
    measured = [StreamRow(**row) for each in kept for row in each["rows"]]
    agreed = [AgreementRow(**row) for each in kept for row in each["agreement"]]
    figures, compared = listed("rows", measured, COLUMNS), listed("agreement", agreed, AGREEMENT)
    by_target = (
        (each, tuple(row for row in measured if row.target == name)) for name, each in TARGETS.items()
    )
    reached = listed("targets", [Reached(target, mine) for target, mine in by_target if mine], REACHED)

    def section() -> list[str]:
        return [
            *("## Targets", "", *reached.markdown(), "", "## Figures", "", *figures.markdown(), ""),
            *("## Agreement", "", *compared.markdown(), "", *provenance(kept, "parts")),
        ]

    publish("streams", output, section, {"rows": figures, "agreement": compared})
