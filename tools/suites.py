"""Test suites of other online monitors: their formulas, traces and expected results, by streams of stlc.

`python tools/suites.py --r2u2 FOLDER --rtamt FOLDER` reads clones of R2U2/r2u2 and nickovic/rtamt; nothing of
them is run. Of R2U2 these are all suites of `test/suites` whose signals are truth values; every verdict that
it gives is compared. Of RTAMT it is `tests/python/api/test_stl_discrete_time_online_specification.py`, read
as syntax: every robustness that a test expects is compared. What the languages mean differently is written
out: the left side of `until` in R2U2 is asked from the begin of the window on, and in both it is not asked at
the instant of the right side; in RTAMT `iff` is `-|a - b|`. Tests of exceptions, and of what has no form in
stlc, count as not translated.
"""

from __future__ import annotations

import argparse
import ast
import csv
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import stlc
from stlc.diagnostics import StlcError
from stlc.monitor.online.online import Decision, How

TOKENS = re.compile(r"\s*(<->|->|&&|\|\||[!()\[\],]|\w+)")
BINARY = (("<->",), ("->",), ("||",), ("&&",), ("U", "S"))
"""Binary operators of C2PO, loosest first."""
OPERATORS = (
    *("and", "or", "not", "next", "s_next", "once", "historically", "always", "eventually", "since"),
    "until",
)
MEANINGS = {
    r"(\w+) (?:==|iff) (\w+)": r"-abs(\1 - \2) >= 0",
    r"(\w+) (?:!==|xor) (\w+)": r"abs(\1 - \2) >= 0",
    r"prev\((\w+)\)": r"historically[1 s, 1 s] \1 >= 0",
    r"s_prev\((\w+)\)": r"once[1 s, 1 s] \1 >= 0",
    r"rise\((\w+)\)": r"\1 >= 0 and historically[1 s, 1 s] \1 <= 0",
    r"fall\((\w+)\)": r"\1 <= 0 and historically[1 s, 1 s] \1 >= 0",
}
"""Formulas of RTAMT that mean something else in stlc, in its words."""
LONGEST = 5
"""Samples of the traces of RTAMT's tests, at most."""
WORDS = {"G": "always", "F": "eventually", "H": "historically", "O": "once", "&&": "and", "||": "or"}


class UntranslatedError(ValueError):
    """A formula that is not translated."""


@dataclass(slots=True)
class Counts:
    """Expected results by what came of them."""

    tests: int = 0
    untranslated: int = 0
    equal: int = 0
    different: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        others = ", ".join(f"{count} of `{what}`" for what, count in self.different.most_common())
        compared = self.equal + self.different.total()
        tests = f"{self.tests} tests, {self.untranslated} not translated"
        told = f"{tests}; {self.equal:,} of {compared:,} results equal"
        return told + (f"; different: {others}" if others else "")


# -------------------------------------------------------------------------- R2U2


class Reader:
    """Formulas of C2PO over truth values, as text of stlc; a step is a second."""

    def __init__(self, text: str) -> None:
        self.tokens = TOKENS.findall(text)
        if "".join(self.tokens) != re.sub(r"\s", "", text):
            raise UntranslatedError(text)

    def formula(self, rank: int = 0) -> str:
        """Read a formula whose operators bind at least as tightly as those of `BINARY[rank]`."""
        if rank == len(BINARY):
            return self._unary()
        left = self.formula(rank + 1)
        while self.tokens and self.tokens[0] in BINARY[rank]:
            op = self.tokens.pop(0)
            window = self._window() if op in "US" else (0, 0)
            right = self.formula(rank + 1)
            left = met(left, right, window, op) if op in "US" else f"({left} {WORDS.get(op, op)} {right})"
        return left

    def _unary(self) -> str:
        if not self.tokens:
            raise UntranslatedError("the formula ends early")
        token: str = self.tokens.pop(0)
        match token:
            case "!":
                return f"(not {self._unary()})"
            case "(":
                inner = self.formula()
                self._take(")")
                return inner
            case "G" | "F" | "H" | "O" as op:
                return over(WORDS[op], self._window(), self._unary())
            case name if re.fullmatch(r"[a-z]\w*", name):
                return name
            case other:
                raise UntranslatedError(other)

    def _window(self) -> tuple[int, int]:
        self._take("[")
        first = int(self.tokens.pop(0))
        if self.tokens[0] == "]":
            lo, hi = 0, first
        else:
            self._take(",")
            lo, hi = first, int(self.tokens.pop(0))
        self._take("]")
        return lo, hi

    def _take(self, token: str) -> None:
        if not self.tokens or self.tokens.pop(0) != token:
            raise UntranslatedError(f"`{token}` is missing")


def over(op: str, window: tuple[int, int], body: str) -> str:
    """Temporal operator with a window in steps."""
    return f"({op}[{window[0]} s, {window[1]} s] {body})"


def met(left: str, right: str, window: tuple[int, int], op: str, *, begin: int | None = None) -> str:
    """`until` or `since` that asks the left side from `begin` (of the window) on, before the right one."""
    lo, hi = window
    there, between = ("eventually", "always") if op == "U" else ("once", "historically")
    first = lo if begin is None else begin
    cases = []
    for k in range(lo, hi + 1):
        held = [over(between, (first, k - 1), left)] if k > first else []
        cases.append("(" + " and ".join([over(there, (k, k), right), *held]) + ")")
    return "(" + " or ".join(cases) + ")"


def r2u2(folder: Path) -> Counts:
    """Compare the verdicts of all suites."""
    counts, seen = Counts(), set()
    for suite in sorted((folder / "test/suites").glob("*.json")):
        for test in json.loads(suite.read_text()).get("tests", ()):
            key = tuple(test[part] for part in ("mltl", "trace", "oracle"))
            if key in seen:
                continue
            seen.add(key)
            counts.tests += 1
            specification, trace, oracle = (
                folder / "test" / part / test[name]
                for part, name in (("c2po", "mltl"), ("trace", "trace"), ("oracle", "oracle"))
            )
            try:
                names, formulas = c2po(specification.read_text())
                samples = samples_of(trace, names)
                said, length = verdicts(names, formulas, samples), len(samples)
            except ValueError:
                counts.untranslated += 1
                continue
            for number, start, wanted in told(oracle.read_text()):
                if start >= length:  # of the past alone, and known before the sample comes
                    continue
                if said[number].get(start) == wanted:
                    counts.equal += 1
                else:
                    counts.different[formulas[number]] += 1
    return counts


def c2po(text: str) -> tuple[list[str], list[str]]:
    """Signals of a specification, all of them truth values, and its formulas in stlc."""
    text = re.sub(r"--.*", "", text)
    found = re.fullmatch(
        r"\s*INPUT\s+([\w,\s]+):\s*bool\s*;\s*(?:FTSPEC|PTSPEC)\s+(.*?);?\s*", text, re.DOTALL
    )
    if found is None:
        raise UntranslatedError("other sections")
    formulas = []
    for part in found[2].split(";"):
        reader = Reader(re.sub(r"^\s*\w+\s*:", "", part))
        formulas.append(reader.formula())
        if reader.tokens:
            raise UntranslatedError(part)
    return [name.strip() for name in found[1].split(",")], formulas


def samples_of(path: Path, names: Sequence[str]) -> list[dict[str, float]]:
    """Samples of a trace; its header may be a comment."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = csv.reader(line for line in lines if not line.startswith("#"))
    head = lines[0].lstrip("# ").split(",") if lines[0].startswith("#") else list(names)
    found = [dict(zip(map(str.strip, head), map(float, row), strict=True)) for row in rows]
    if not set(names) <= found[0].keys():
        raise UntranslatedError("the trace lacks a signal")
    return [{name: row[name] for name in names} for row in found]


def told(text: str) -> Iterator[tuple[int, int, bool]]:
    """Verdicts of an oracle: number of the formula, start, verdict; a line has the starts since the last."""
    after: Counter[int] = Counter()
    for number, last, word in re.findall(r"^(\d+):(\d+),([TF])$", text, re.MULTILINE):
        for start in range(after[int(number)], int(last) + 1):
            yield int(number), start, word == "T"
        after[int(number)] = int(last) + 1


def verdicts(
    names: Sequence[str], formulas: Sequence[str], samples: Sequence[Mapping[str, float]]
) -> list[dict[int, bool]]:
    """Verdicts of a stream by start, of each formula."""
    lines = [f"signal {name} : bool" for name in names]
    lines += [f"require r{i}: {formula}" for i, formula in enumerate(formulas)]
    online = stlc.Monitor("\n".join(lines), dt=1.0).online(How(at="all"))
    found: list[dict[int, bool]] = [{} for _ in formulas]
    for sample in samples:
        if online.push(sample):
            for each in online.verdicts():
                found[int(each.requirement[1:])][each.start] = each.status == "satisfied"
    return found


# -------------------------------------------------------------------------- RTAMT


def rtamt(folder: Path) -> Counts:
    """Compare the robustness values that the tests of the online monitor expect."""
    path = folder / "tests/python/api/test_stl_discrete_time_online_specification.py"
    (suite,) = (each for each in ast.parse(path.read_text()).body if isinstance(each, ast.ClassDef))
    methods = [each for each in suite.body if isinstance(each, ast.FunctionDef)]
    (start,) = (each for each in methods if each.name == "__init__")
    numbers = {
        each.targets[0].attr: ast.literal_eval(each.value)
        for each in start.body
        if isinstance(each, ast.Assign) and isinstance(each.targets[0], ast.Attribute)
    }
    counts = Counts()
    for method in methods:
        if not method.name.startswith("test"):
            continue
        counts.tests += 1
        try:
            _compare(method, numbers, counts)
        except (UntranslatedError, StlcError, LookupError, ValueError):
            counts.untranslated += 1
    return counts


def _compare(method: ast.FunctionDef, numbers: Mapping[str, float], counts: Counts) -> None:
    text, samples, expected = "", [], []
    for node in ast.walk(method):
        match node:
            case ast.Assign([ast.Attribute(attr="spec")], ast.Constant(str(written))):
                text = written.partition("=")[2].strip()
            case ast.Call(ast.Attribute(attr="update"), [ast.Constant(int(time)), ast.List(pairs)]):
                samples.append((time, {_pair(each)[0]: numbers[_pair(each)[1]] for each in pairs}))
            case ast.Call(ast.Attribute(attr="assertEqual"), [ast.Name(name), told, *_]):
                expected.append((int(name.removeprefix("out")) - 1, _number(told)))
    if not expected or not samples or not samples[0][1]:
        raise UntranslatedError(method.name)  # an error is expected, or a constant without signals
    rows = [row for _, row in sorted(samples, key=lambda each: each[0])]
    formula, ahead = translated(text)
    names = sorted(rows[0])
    monitor = stlc.Monitor(f"signal {', '.join(names)}\nrequire r: {formula}", dt=1.0)
    online = monitor.online(How(at="all"))
    said: dict[int, tuple[Decision, float, float]] = {}
    for row in rows:
        if online.push(row):
            said |= {each.start: (each, *online.bounds("r", each.start)) for each in online.verdicts()}
    values = monitor.robustness({name: [float(row[name]) for row in rows] for name in names}, end="truncate")
    for update, wanted in expected:
        if (at := update - ahead) < 0:
            continue  # before the first value is known
        value, (decision, low, high) = float(values[at]), said[at]
        agrees = low <= value <= high and (decision.status == "satisfied") == (value >= -1e-6)
        if agrees and (value == wanted or abs(value - wanted) < 1e-12):
            counts.equal += 1
        else:
            counts.different[f"{text}: {value:g}, there {wanted:g}"] += 1


def _pair(node: ast.expr) -> tuple[str, str]:
    match node:
        case ast.Tuple([ast.Constant(str(name)), ast.Attribute(attr=attr)]):
            return name, attr
    raise UntranslatedError(ast.dump(node))


def _number(node: ast.expr) -> float:
    text = ast.unparse(node)
    return {"float('inf')": inf, "-float('inf')": -inf}.get(text) or float(ast.literal_eval(node))


def translated(text: str) -> tuple[str, int]:
    """Formula of RTAMT in stlc, and the delay of its values in samples; a signal is its own robustness."""
    for pattern, meaning in MEANINGS.items():
        if found := re.fullmatch(pattern, text):
            return found.expand(meaning), 0
    if not re.search(rf"\b({'|'.join(OPERATORS)})\b|->|[<>]=?", text):
        return f"{text} >= 0", 0
    if re.fullmatch(r"\w+ [<>]=? \w+", text):
        return text, 0
    text = re.sub(r"\b(req|gnt)\b", r"(\1 >= 0)", text.replace("s_next", "next"))
    text = text.replace(" since (", f" since[0,{LONGEST}] (")
    if found := re.fullmatch(r"(\(.*?\)) (until|since)\[(\d+),(\d+)\] (\(.*\))", text):
        left, op, lo, hi, right = found.groups()
        window = int(lo), int(hi)
        return met(left, right, window, op[0].upper(), begin=0), window[1] * (op == "until")
    ahead = re.match(r"(?:always|eventually)\[\d+,(\d+)\]", text)
    late = int(ahead[1]) if ahead else int(text.startswith("next"))
    return re.sub(r"\[(\d+),(\d+)\]", r"[\1 s, \2 s]", text), late


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what came of each suite."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--r2u2", type=Path, help="clone of R2U2/r2u2")
    parser.add_argument("--rtamt", type=Path, help="clone of nickovic/rtamt")
    given: Any = parser.parse_args(arguments)
    for name, suite in (("r2u2", r2u2), ("rtamt", rtamt)):
        if (folder := getattr(given, name)) is not None:
            sys.stdout.write(f"{name}: {suite(folder)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
