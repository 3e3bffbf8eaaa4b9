"""Export of the monitor of a specification as C99, also valid C++17: a header, a source file, an example.

The code is that of `Monitor.online` (`stlc.compile.backends.c.streams`). It allocates nothing, has no global
variables, and needs libm alone.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, ClassVar, Literal

from stlc.compile.backends.c.streams import TABLES, Streams, runtime, streams_of
from stlc.compile.backends.numbers import Untranslatable
from stlc.diagnostics import usage
from stlc.escape import c_comment, c_string
from stlc.files import File, place
from stlc.monitor.online.kernel import streamed_rule
from stlc.monitor.online.online import How, Online
from stlc.monitor.prefix_bounds import FAR
from stlc.monitor.verdict import Monitor

_LIBM = "|".join(
    (
        *("sqrt", "sin", "cos", "tan", "asin", "acos", "atan2", "atan", "sinh", "cosh", "tanh", "exp"),
        *("log10", "log2", "log", "pow", "fabs", "floor", "ceil", "rint", "fmod", "hypot"),
    )
)
_ROW, _RULE, _HEAD = 24, 136, 128
"""Bytes of a gap, of the verdicts of a requirement and of the head of a state, at most."""


@dataclass(frozen=True, slots=True)
class ExportedMonitor:
    """Result of the export of a monitor.

    Attributes:
        spec: name of the specification.
        target: the form of the export.
        folder: folder of the written files.
        files: names of the files.
        bytes: size of the state, at most.
    """

    JSON: ClassVar = "spec target folder files bytes"

    spec: str
    target: str
    folder: Path
    files: tuple[str, ...]
    bytes: int

    def __repr__(self) -> str:
        return f"ExportedMonitor({self.spec} as {self.target}: {len(self.files)} files in {self.folder})"

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the export."""
        return (f"the state takes {self.bytes:,} bytes",)


def export_monitor(
    monitor: Monitor, folder: Path, *, at: int | Literal["all"] | None = None, single: bool = False
) -> ExportedMonitor:
    """Write the monitor of a specification as C.

    Args:
        monitor: the monitor.
        folder: destination; existing files of the same names are replaced.
        at: instants at which the requirements are evaluated, as of `stlc.monitor.online.How`.
        single: whether all numbers are `float`, for targets without doubles.

    Raises:
        UsageError: U101, a requirement has no transducers.
    """
    online = monitor.online(How(at=at))
    rules = [streamed_rule(each, online.signals) for each in online.asked]
    for asked, rule in zip(online.asked, rules, strict=True):
        if rule is None:
            why = "it has a `freeze`, or a window to an end inside of another"
            message = f"`{asked.rule.name}` has no form as C: {why}"
            raise usage(message, span=asked.rule.span)
    try:
        program = streams_of([rule for rule in rules if rule is not None], online.signals, cut=False)
    except Untranslatable as error:
        raise usage(f"this specification has no form as C: {error}") from error
    texts, size = _texts(online, program, single=single)
    for name, text in texts.items():
        File(place(folder, name)).write(text)
    return ExportedMonitor(monitor.spec.source.name, "c", folder, tuple(texts), size)


def _texts(online: Online, program: Streams, *, single: bool) -> tuple[dict[str, str], int]:
    """Names and texts of the files, and the size of the state in bytes."""
    name = re.sub(r"\W", "_", online.compiled.name, flags=re.ASCII).lower() or "stlc"
    name = f"{name}_monitor" if name[0].isalpha() else f"m{name}_monitor"
    sizes, real = program.sizes, 4 if single else 8
    size = _HEAD + 8 * sizes["times"] + _ROW * sizes["signals"] + _RULE * sizes["judged"]
    size += 2 * real * sizes["spans"] + real * sizes["signals"] * (sizes["rows"] + 1)
    size += 4 * sizes["ints"] + sizes["truths"] + 7
    starts = [
        f"  stlc_init(m, {i}, {each.begin}, {int(each.everywhere)}, 0, (real){each.tolerance!r});"
        for i, each in enumerate(online.asked)
    ]
    dt, (types, functions) = online.compiled.grid.dt, runtime()
    values = {
        "NAME": name,
        "UPPER": name.upper(),
        "SPEC": c_comment(online.compiled.name),
        "DT": "unknown" if dt is None else f"{float(dt)!r} s",
        "REAL": "float" if single else "double",
        "SIGNALS": len(online.signals),
        "REQUIREMENTS": len(online.asked),
        "WORDS": size // 8,
        "SIGNAL_NAMES": ", ".join(map(c_string, online.signals)) or '""',
        "REQUIREMENT_NAMES": ", ".join(c_string(each.rule.name) for each in online.asked),
        "ABOUT": "\n".join(_about(online)),
        "STARTS": "\n".join(starts),
        "TYPES": _single(types) if single else types,
        "TABLES": "\n".join(_table(kind, rows) for kind, rows in program.tables.items()),
        "PREDICATES": _single(program.predicates) if single else program.predicates,
        "FUNCTIONS": functions,
        "SIZES": ", ".join(map(str, sizes.values())),
    }
    folder = files("stlc.export") / "templates"
    texts = {}
    for file, template in (
        (f"{name}.h", "monitor.h"),
        (f"{name}.c", "monitor.c"),
        ("main.c", "monitor_main.c"),
    ):
        texts[file] = _Text((folder / f"{template}.txt").read_text(encoding="utf-8")).substitute(values)
    return texts, size


class _Text(Template):
    delimiter = "@"


def _about(online: Online) -> list[str]:
    """Lines of a comment about signals and requirements."""
    lines = ["   Signals, in the order of a sample:"]
    columns = {column.name: column for column in online.compiled.signature.columns}
    for i, name in enumerate(online.signals):
        column = columns[name]
        values = ", ".join(f"{value:g} {label}" for label, value in column.labels) or str(column.unit)
        lines.append(f"     {i}  {c_comment(name)}: {c_comment(values)}")
    lines.append("   Requirements:")
    for i, each in enumerate(online.asked):
        where = "at every sample" if each.everywhere else f"at sample {each.begin}"
        later = max(each.lag, each.span.future)
        known = "at the end" if later >= FAR else f"after {later} samples more"
        lines.append(f"     {i}  {c_comment(each.rule.name)}: {where}, known {known} at the latest")
    if assumed := ", ".join(c_comment(each.name) for each in online.compiled.assumptions):
        lines.append(f"   Not judged, as they are assumptions: {assumed}")
    return lines


def _table(name: str, rows: Sequence[Sequence[Any]]) -> str:
    kind = next(kind for kind, each in TABLES.items() if each == name)
    texts = [", ".join(map(str, row)) for row in rows or [(0,)]]
    braced = [text if kind == "int32_t" else f"{{{text}}}" for text in texts]
    return "\n".join([f"static const {kind} {name}_[] = {{", *(f"  {text}," for text in braced), "};"])


def _single(text: str) -> str:
    """C text with the functions and literals of `float`."""
    text = re.sub(rf"\b({_LIBM})\(", r"\1f(", text.replace("const double", "const float"))
    text = re.sub(r"(0x[0-9a-f.]+p[+-]?\d+)\)", lambda found: f"{_nearest(found[1])})", text)
    return re.sub(r"\b(\d+\.\d+)\b(?!f)", r"\1f", text)


def _nearest(number: str) -> str:
    """C text of the `float` that is nearest to a number, as compilers warn of numbers beyond its range."""
    value = ctypes.c_float(float.fromhex(number)).value
    return "INF" if math.isinf(value) else f"{value.hex()}f"
