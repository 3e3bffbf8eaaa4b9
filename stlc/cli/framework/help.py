"""Help texts: options and commands in groups."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from typer.core import TyperCommand, TyperGroup

OPTIONS: dict[str, str] = {
    "Input": "spec system plant from starts states set require scenario controller period resume replay "
    "verify again python example trace select ignore to",
    "Recording": "map resample between max-gap dt clock fps group columns chunk",
    "Method": "method option target tube seed seeds random lr batch plans held-out falsify agents steps "
    "boxes continuous stdio quick",
    "Guard": "backup guard time-limit margin known-feasible",
    "Budget": "budget budget-clock evaluations simulations drives jobs cluster device threads stream",
    "Verdict": "at end semantics tolerance uncertain strict fail-under certify share confidence width shift",
    "Output": "out record name json junit table robustness pictures window live windows log format "
    "precision float show places guarantee check diff fix watch sort force runs",
}
"""Title of a group of options -> names of its options; an option of no group stands under "Options"."""

MOVED_OPTIONS = {
    "--output": "--out",
    "--time": "--budget",
    "--max-drives": "--drives",
    "--ceiling": "--known-feasible",
    "--clock": "--budget-clock",
}
"""Former name of an option -> its name."""

_TITLES = {f"--{name}": title for title, names in OPTIONS.items() for name in names.split()}
_TITLES |= {"train --steps": "Budget"}
_TITLES |= {"init --spec": "Output", "init --system": "Output"}


class CommandHelp(TyperCommand):
    """Command whose help shows its options in the groups of `OPTIONS`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for the arguments, and one for each group of options."""
        rows: dict[str, list[tuple[str, str]]] = {
            "Arguments": [],
            **{title: [] for title in OPTIONS},
            "Options": [],
        }
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                about = re.sub(r"(?<=\[default: )\((.*)\)", r"\1", record[1])  # as that of a number
                rows[title_of(param, str(self.name))].append((record[0], about))
        _write_sections(formatter, rows)


class ProgramHelp(TyperGroup):
    """Group of commands whose help shows the commands in groups.

    Attributes:
        titles: title of a group -> names of its commands; other commands stand under "Commands".
    """

    titles: Mapping[str, Iterable[str]] = {}

    def format_commands(self, _ctx: Any, formatter: Any) -> None:
        """Write a section for each group of commands, with the first sentence of each."""
        left = dict(self.commands)
        grouped = {
            title: {name: left.pop(name) for name in names if name in left}
            for title, names in self.titles.items()
        }
        width = formatter.width - 6 - max(map(len, self.commands))
        _write_sections(
            formatter,
            {
                title: [(name, entry.get_short_help_str(width)) for name, entry in entries.items()]
                for title, entries in (grouped | {"Commands": left}).items()
            },
        )


def title_of(param: Any, command: str) -> str:
    """Return the title of the section of a parameter in the help of `command`."""
    if param.param_type_name == "argument":
        return "Arguments"
    keys = (*(f"{command} {word}" for word in param.opts), *param.opts)
    return next((_TITLES[key] for key in keys if key in _TITLES), "Options")


def _write_sections(formatter: Any, rows: Mapping[str, list[tuple[str, str]]]) -> None:
    widest = max((len(first) for section in rows.values() for first, _ in section), default=0)
    for title, section in rows.items():
        if section:
            with formatter.section(title):
                formatter.write_dl([(f"{first:{min(widest, 30)}}", about) for first, about in section])
