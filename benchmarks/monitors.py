"""Online monitors of stlc, RTAMT, Reelay, SENTIL and mstlo: the same formula and samples for each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, count, cycle, islice, repeat
from time import process_time
from typing import Any, TypeAlias

import numpy as np

from benchmarks.answers import import_rtamt
from benchmarks.requirements import (
    Atom,
    Flag,
    Floats,
    Formula,
    Joined,
    Over,
    Until,
    for_rtamt,
    signals_of,
    written,
)
from stlc.monitor.online.online import How, Online
from stlc.monitor.verdict import Monitor

Data: TypeAlias = Mapping[str, Floats]
"""Signal -> samples, (time,)."""
_WORDS = {"always": "G", "eventually": "F"}
BLOCK = 10_000
"""Samples of a block."""


@dataclass(frozen=True, slots=True)
class Feed:
    """A new monitor, and what it is pushed: samples one by one without an end, or one block.

    Attributes:
        push: function that takes a sample, or a block.
        arguments: for each parameter of `push`, its arguments.
        values: results of `push` -> robustness of the starts from 0 on, as far as they are known; for a
            formula that is evaluated once, its upper bound after each sample.
    """

    push: Callable[..., Any]
    arguments: Sequence[Iterator[Any]]
    values: Callable[[list[Any]], Floats] = np.array

    def run(self, count: int) -> float:
        """Push the next samples, or blocks; return the processor time in seconds."""
        todo = map(self.push, *(islice(each, count) for each in self.arguments))
        start = process_time()
        deque(todo, maxlen=0)
        return process_time() - start

    def outputs(self, count: int) -> Floats:
        """Push the next samples, or blocks, and return what the monitor says (`values`)."""
        return self.values(list(map(self.push, *(islice(each, count) for each in self.arguments))))


@dataclass(frozen=True, slots=True)
class Peer:
    """Monitor of another project.

    Attributes:
        name: its name.
        package: its package on PyPI.
        module: the module of the package.
        feed: (formulas, data, "row" or "block") -> feed; None if it has no such form.
        longest: longest window in samples that it is given.
    """

    name: str
    package: str
    module: str
    feed: Callable[[Sequence[Formula], Data, str], Feed | None]
    longest: int = 1 << 62

    @property
    def installed(self) -> bool:
        """True if the package is installed."""
        return find_spec(self.module) is not None


# ---------------------------------------------------------------------- formulas

NESTED = Over("always", (0, 100), Over("eventually", (0, 10), Atom("x", ">", 5.0, "5")))
ALWAYS = Over("always", (0, 1000), Atom("x", ">", 5.0, "5"))


def response(i: int = 40) -> Formula:
    """Bounded response, the `i`-th of a hundred: each has its own threshold and window."""
    high = round(6.6 + 0.01 * i, 2)
    reaction = Over("eventually", (0, 10 + i), Atom("y", ">", 2.0, "2"))
    return Joined("->", Atom("x", ">", high, f"{high:g}"), reaction)


def always(formula: Formula) -> Formula:
    """Formula at all samples of the stream, evaluated once."""
    return Over("always", None, formula)


def lookahead(formula: Formula) -> int:
    """Number of samples after a start that its value needs; windows without an end count as 0."""
    match formula:
        case Atom() | Flag():
            return 0
        case Joined(_, left, right) | Until(left, right):
            return max(lookahead(left), lookahead(right))
        case Over(op, window, body):
            ahead = round(window[1]) if window is not None and op in _WORDS else 0
            return ahead + lookahead(body)


def endless(formula: Formula) -> bool:
    """True if a formula is evaluated once, over the whole stream."""
    return isinstance(formula, Over) and formula.window is None


def delayed(formula: Formula, delay: int) -> Formula:
    """Formula of the past whose value at a sample is that of `formula` `delay` samples earlier.

    `delay` is at least the lookahead of the formula. `always` without an interval becomes `historically`.
    """
    match formula:
        case Atom():
            return formula if delay == 0 else Over("once", (delay, delay), formula)
        case Joined(op, left, right):
            return Joined(op, delayed(left, delay), delayed(right, delay))
        case Over("always" | "eventually" as op, window, body):
            inner = lookahead(body)
            part = delayed(body, inner)
            ago = None if window is None else (delay - window[1] - inner, delay - window[0] - inner)
            return Over("historically", ago, part) if op == "always" else Over("once", ago, part)
    raise TypeError(formula)


def of_past(formula: Formula) -> Formula:
    """Formula of the past with the values of a formula of the future, as late as they are known."""
    return delayed(formula, lookahead(formula))


def for_sentil(formula: Formula) -> str:
    """Formula in the language of SENTIL, which is that of RTAMT with other brackets."""
    return for_rtamt(formula).replace(":", ",")


def for_reelay(formula: Formula) -> str:
    """Formula of the past in the language of Reelay."""
    match formula:
        case Atom(signal, op, value):
            return f"{{{signal} {op} {value:.9f}}}"
        case Joined(op, left, right):
            return f"({for_reelay(left)} {op} {for_reelay(right)})"
        case Over("historically" | "once" as op, window, body):
            shown = "" if window is None else f"[{window[0]:.0f}:{window[1]:.0f}]"
            return f"({op}{shown} {for_reelay(body)})"
    raise TypeError(formula)


def for_mstlo(formula: Formula) -> str:
    """Formula of the future in the language of mstlo."""
    match formula:
        case Atom(signal, op, value):
            return f"({signal} {op} {value:.9f})"
        case Joined(op, left, right):
            return f"({for_mstlo(left)} {op} {for_mstlo(right)})"
        case Over(op, (lo, hi), body) if op in _WORDS:
            return f"{_WORDS[op]}[{lo:.0f}, {hi:.0f}]({for_mstlo(body)})"
    raise TypeError(formula)


# ---------------------------------------------------------------------- stlc


def drawn(samples: int, seed: int = 0, *, calm: bool = False) -> Data:
    """Draw two signals; if `calm`, `x` stays above 5."""
    rng, turn = np.random.default_rng(seed), 2.0 * np.sin(np.arange(samples) / 400)
    noise = rng.normal(0.0, 1.0, (2, samples)).round(3)
    return {"x": 5.001 + np.abs(turn + noise[0]) if calm else (5.0 + turn + noise[0]).round(3), "y": noise[1]}


def read_by(data: Data, formulas: Sequence[Formula]) -> Data:
    """Signals of `data` that the formulas read."""
    names = frozenset[str]().union(*map(signals_of, formulas))
    return {name: data[name] for name in sorted(names)}


def monitor_of(formulas: Sequence[Formula]) -> Monitor:
    """Monitor of stlc, a requirement for each formula."""
    names = sorted(frozenset[str]().union(*map(signals_of, formulas)))
    lines = [f"signal {', '.join(names)}", *(f"require r{i}: {written(f)}" for i, f in enumerate(formulas))]
    return Monitor("\n".join(lines), dt=1.0)


def online_of(formulas: Sequence[Formula]) -> Online:
    """Online monitor of stlc, for every start unless the formulas are evaluated once."""
    return monitor_of(formulas).online(How(at=None if endless(formulas[0]) else "all"))


def ours(formulas: Sequence[Formula], data: Data, pushed: str) -> Feed:
    """Feed of stlc; `pushed` is row, dict, block, or "row, verdicts" if each verdict is read as a record."""
    online = online_of(formulas)
    rows = np.stack([data[name] for name in online.signals], axis=1)
    if pushed == "dict":
        return Feed(online.push, (cycle(dicts(data)),))
    if pushed == "block":
        return Feed(online.push_block, (cycle(np.split(rows, range(BLOCK, len(rows), BLOCK))),))
    read = lambda row: online.push(row) and online.verdicts()  # noqa: E731
    return Feed(online.push if pushed == "row" else read, (cycle(rows.tolist()),))


# ---------------------------------------------------------------------- others


def _rtamt(formulas: Sequence[Formula], data: Data, pushed: str) -> Feed | None:
    if pushed == "block":
        return None
    updates = [_rtamt_online(of_past(formula)).update for formula in formulas]
    samples = [[*each.items()] for each in dicts(data)]
    push = updates[0] if len(updates) == 1 else lambda t, row: [update(t, row) for update in updates]
    return Feed(push, (count(), cycle(samples)), _from(formulas[0], float))


def _rtamt_online(formula: Formula) -> Any:
    spec = _rtamt_spec(import_rtamt().StlDiscreteTimeOnlineSpecification(), formula)
    spec.pastify()
    return spec


def _rtamt_spec(spec: Any, formula: Formula) -> Any:
    for name in signals_of(formula):
        spec.declare_var(name, "float")
    spec.spec = for_rtamt(formula)
    spec.set_sampling_period(1, "s", 0.1)
    spec.parse()
    return spec


def by_rtamt_alone(formula: Formula, data: Data) -> Floats:
    """Values of RTAMT if its own `pastify` derives the formula of the past."""
    spec = _rtamt_online(formula)
    samples = enumerate([*each.items()] for each in dicts(data))
    return _from(formula, float)([spec.update(time, sample) for time, sample in samples])


def _reelay(formulas: Sequence[Formula], data: Data, pushed: str) -> Feed | None:
    if pushed == "block":
        return None
    make = import_module("reelay").discrete_timed_monitor
    updates = [
        make(pattern=for_reelay(of_past(formula)), semantics="robustness", condense=False).update
        for formula in formulas
    ]
    push = updates[0] if len(updates) == 1 else lambda row: [update(row) for update in updates]
    return Feed(push, (cycle(dicts(data)),), _from(formulas[0], lambda found: found["value"]))


def _sentil(formulas: Sequence[Formula], data: Data, pushed: str) -> Feed | None:
    sentil, (formula, *others) = import_module("sentil"), formulas
    times = count(0.0, 1.0)
    if others:
        several = sentil.MultiMonitor()
        for i, each in enumerate(formulas):
            several.add(str(i), for_sentil(each))
        return Feed(several.update, (times, cycle(dicts(data))))
    monitor = sentil.OnlineMonitor(for_sentil(formula))
    said = _from(formula, lambda found: found.upper if endless(formula) else found.value)
    if pushed == "block":
        trace = sentil.Trace(list(islice(times, _length(data))), dict(data))
        return Feed(monitor.run, (iter([trace]),), lambda found: said(found[0]))
    return Feed(monitor.update, (times, cycle(dicts(data))), said)


def _mstlo(
    formulas: Sequence[Formula], data: Data, pushed: str, says: str = "DelayedQuantitative"
) -> Feed | None:
    if any(map(endless, formulas)) or (pushed == "block" and len(formulas) > 1):
        return None  # it has no windows without an end
    mstlo, names, times = import_module("mstlo_python"), sorted(data), count(0.0, 1.0)
    monitors = [mstlo.Monitor(mstlo.parse_formula(for_mstlo(each)), semantics=says) for each in formulas]
    if pushed == "block":
        clock = list(islice(times, _length(data)))
        block = {name: list(zip(data[name].tolist(), clock, strict=True)) for name in names}
        return Feed(monitors[0].update_batch, (iter([block]),), _of_mstlo)
    columns = [data[name].tolist() for name in names]
    if len(monitors) == len(names) == 1:
        return Feed(monitors[0].update, (repeat(names[0]), cycle(columns[0]), times), _of_mstlo)
    updates = [(each.update, name) for each in monitors for name in names]

    def push(sample: Mapping[str, float], time: float) -> Any:
        return [update(name, sample[name], time) for update, name in updates]

    return Feed(push, (cycle(dicts(data)), times), lambda found: _of_mstlo([*chain(*found)]))


def _of_mstlo(found: list[Any]) -> Floats:
    return np.array([value for output in found for _, value in output.verdicts()])


def _from(formula: Formula, value: Callable[[Any], float]) -> Callable[[list[Any]], Floats]:
    """Function that returns the values from the first one on that is complete."""
    return lambda found: np.array([value(each) for each in found[lookahead(formula) :]])


def _length(data: Data) -> int:
    return len(next(iter(data.values())))


def dicts(data: Data) -> list[dict[str, float]]:
    """Samples, each as a number by signal."""
    names = sorted(data)
    rows = zip(*(data[name].tolist() for name in names), strict=True)
    return [dict(zip(names, row, strict=True)) for row in rows]


def first_verdicts(formula: Formula, data: Data) -> dict[int, tuple[int, bool]]:
    """Start -> sample at which mstlo first knows its verdict, and the verdict (`EagerQualitative`)."""
    feed = _mstlo([formula], data, "row", "EagerQualitative")
    assert feed is not None
    found: dict[int, tuple[int, bool]] = {}
    for sample, outputs in enumerate(islice(map(feed.push, *feed.arguments), _length(data))):
        for output in outputs if isinstance(outputs, list) else [outputs]:
            found |= {round(start): (sample, holds) for start, holds in output.verdicts()}
    return found


PEERS = (
    Peer("RTAMT", "rtamt", "rtamt", _rtamt, 1_000_000),
    Peer("Reelay", "reelay", "reelay", _reelay),
    Peer("SENTIL", "sentil", "sentil", _sentil),
    Peer("mstlo", "mstlo-python", "mstlo_python", _mstlo),
)
"""All give delayed values. RTAMT and Reelay take formulas of the past, SENTIL and mstlo of the future."""


def installed() -> list[Peer]:
    """Monitors whose packages are installed."""
    return [each for each in PEERS if each.installed]


def recorded(formula: Formula, data: Data) -> dict[str, Callable[[], object]]:
    """Robustness of a recorded trace at every sample, by the monitors that have it."""
    names = {each.name for each in installed()}
    found: dict[str, Callable[[], object]] = {}
    times = np.arange(float(_length(data)))
    if "SENTIL" in names:
        sentil = import_module("sentil")
        parsed = sentil.Formula.parse(for_sentil(formula))
        found["SENTIL"] = lambda: parsed.robustness_signal(sentil.Trace(times, dict(data)))
    if "RTAMT" in names:
        spec = _rtamt_spec(import_rtamt().StlDiscreteTimeOfflineSpecification(), formula)
        lists = {"time": times.tolist()} | {name: x.tolist() for name, x in data.items()}
        found["RTAMT"] = lambda: spec.evaluate({name: [*each] for name, each in lists.items()})
    return found


def at_first(formula: Formula, data: Data) -> dict[str, Callable[[], object]]:
    """Robustness of a recorded trace at its first sample, by SENTIL; the trace has been made."""
    if "SENTIL" not in {each.name for each in installed()}:
        return {}
    sentil = import_module("sentil")
    trace = sentil.Trace(np.arange(float(_length(data))), dict(data))
    return {"SENTIL": partial(sentil.Formula.parse(for_sentil(formula)).robustness, trace)}
