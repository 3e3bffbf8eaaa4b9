"""Options that several commands share, and parsers of option values."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.completion import requirement_names, run_names
from stlc.diagnostics import usage
from stlc.files import STDIN, real
from stlc.registry import PLANNERS

if TYPE_CHECKING:
    from stlc.controller.run.config import Clock
    from stlc.controller.search.planner_policy import PlannerChoice

MOST_SEED = 2**63 - 1
"""Greatest seed of torch's random numbers."""

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on the standard output.")]
SystemOption = Annotated[
    str | None,
    typer.Option(
        "--system",
        "-s",
        metavar="FILE",
        help="The system: as given, beside the spec, in systems/, in examples/, or installed.",
    ),
]
RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN",
        help="A run's folder, number, words, spec (its name or file), or latest.",
        autocompletion=run_names,
    ),
]
RequireOption = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="NAME",
        help="This requirement only; repeatable.",
        autocompletion=requirement_names,
    ),
]
SpecsArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="FILE…", help="Specifications, folders, or -; the current folder if none."),
]
SeedsOption = Annotated[str, typer.Option("--seeds", metavar="SEEDS", help="Such as 0..9 or 0,3.")]
FailUnderOption = Annotated[
    float | None,
    typer.Option(
        "--fail-under",
        metavar="SHARE",
        min=0,
        max=1,
        help="Exit with 1 if a smaller share satisfies everything, else with 0.",
    ),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="auto|local|HOST:PORT",
        help="Work on a Ray cluster, with as many processes as it has cores.",
    ),
]
TimeLimitOption = Annotated[
    str | None,
    typer.Option(
        metavar="TIME",
        help="Time limit of a guard's decision per agent, or `none`.",
        show_default="100ms, or none of the paper's guard",
    ),
]
MarginOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="M|NAME=M|auto",
        help="Safety margin that the guard requests; repeatable. `auto` calibrates it.",
    ),
]
DriveStepsOption = Annotated[
    int | None, typer.Option(min=1, help="Steps of each drive.", show_default="the system's")
]
RunsOption = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Folder of all runs.")]
PythonOption = Annotated[
    bool, typer.Option("--python", help="Run the Python that the run names: of a run that you trust.")
]
PicturesOption = Annotated[bool, typer.Option(help="Draw pictures and the report.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a constant of the spec or a key of the system."),
]
MethodOptionsOption = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="NAME=VALUE", help="An option of --method; repeatable."),
]
SeedOption = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Seed of everything random.")]
JobsOption = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Number of processes side by side.")]
AgentsOption = Annotated[
    int | None, typer.Option(min=1, help="Agents in each world.", show_default="the system's")
]
PlantOption = Annotated[
    Path | None,
    typer.Option("--plant", metavar="FILE", help="A black box instead of a system (docs/plants.md)."),
]


def planner_choice(name: str, pairs: Sequence[str] | None, budget: str) -> PlannerChoice:
    """Return the planner called `name` (`--method`), with the values of `--option` and `--budget`.

    `pairs` are the values `NAME=VALUE` of `--option`. Raises UsageError (U101).
    """
    from stlc.controller.search.planner_policy import PlannerChoice

    options = parse_pairs(pairs, "--option", "NAME=VALUE", "tries=500")
    return PlannerChoice(PLANNERS.chosen(name), options, parse_seconds(budget))


def require_no_jobs(cluster: str | None, jobs: int) -> None:
    """Raise UsageError (U101) if `--cluster` and `--jobs` are both given."""
    if cluster is not None and jobs != 1:
        raise usage("`--jobs` and `--cluster` contradict each other", "a cluster uses all of its cores")


def parse_overrides(pairs: Sequence[str] | None) -> dict[str, str]:
    """Parse pairs such as `T_red=3 s` into a mapping such as `{"T_red": "3 s"}`.

    Raises:
        UsageError: U101, see `parse_pairs`.
    """
    return parse_pairs(pairs, "--set", "NAME=VALUE", "T_red=3s")


def parse_pairs(pairs: Sequence[str] | None, option: str, form: str, example: str) -> dict[str, str]:
    """Parse the values `NAME=VALUE` of a repeated option into a mapping NAME -> VALUE.

    `option`, `form` and `example` are named in error messages.

    Raises:
        UsageError: U101, a value is not of the form `NAME=VALUE`, or a name is given twice.
    """
    values: dict[str, str] = {}
    for pair in pairs or ():
        name, sign, value = (part.strip() for part in pair.partition("="))
        if not (name and sign and value):
            raise usage(f"`{option} {pair}` is not of the form {form}", f"write it as {option} {example}")
        if name in values:
            raise usage(f"`{option} {name}=…` is given twice")
        values[name] = value
    return values


def require_separate(
    written: Iterable[tuple[str, Path | str | None]], read: Iterable[Path | str | None]
) -> None:
    """Check that no file that a command writes is one that it reads, or the file of another option.

    Args:
        written: options with the files that they name; None if an option is not given.
        read: files that the command reads.

    Raises:
        UsageError: U101, two of the files are one.
    """
    known = {_identity(path): "" for path in read}
    for option, path in written:
        file = _identity(path)
        if file is None:
            continue
        if file in known:
            what = f"also the file of `{known[file]}`" if known[file] else "a file that this command reads"
            raise usage(f"`{option} {path}` is {what}", "name another file")
        known[file] = option


def _identity(path: Path | str | None) -> object:
    """Key of a file, equal for all its paths; None for no file, such as a folder, a device or `-`."""
    if path is None or str(path) == STDIN:
        return None
    try:
        target = real(Path(path))
        found = target.stat()
    except FileNotFoundError:
        return target
    except (OSError, ValueError):  # no path: reading or writing it says why
        return None
    return (found.st_dev, found.st_ino) if stat.S_ISREG(found.st_mode) else None


# --------------------------------------------------------- durations, counts, seeds

MOST_SEEDS = 1000
_RANGE = re.compile(r"\s*(\d{1,18})\s*(?:\.\.\s*(\d{1,18})\s*)?")


def parse_seconds(text: str) -> float:
    """Parse a duration such as `60s`, `5min` or `1.5 h`; return it in seconds. A bare number is in seconds.

    Raises:
        UsageError: U101, the text is not a duration.
    """
    from stlc.units import parse_unit

    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyz ").strip()
    unit = text.strip()[len(number) :].strip() or "s"
    try:
        value = float(number) * float(parse_unit(unit).scale)
        if parse_unit(unit).dims != parse_unit("s").dims or not 0.0 < value < 1e9:
            raise ValueError
    except ValueError as error:
        raise usage(f"`{text}` is not a duration", "write it as 60s or 5min") from error
    return value


def parse_count(text: str, option: str) -> int:
    """Parse a whole number of at least 1, the value of `option`. Raises UsageError (U101)."""
    if re.fullmatch(r"\s*0*[1-9]\d{0,17}\s*", text, re.ASCII):
        return int(text)
    raise usage(f"`{option} {text}` is no number from 1 on", f"{option} 1200")


def parse_limit(text: str) -> float | None:
    """Parse a duration and return it in seconds; return None for `none`. Raises UsageError (U101)."""
    return None if text.strip() == "none" else parse_seconds(text)


def parse_clock(text: str) -> Clock:
    """Parse the clock of a budget. Raises UsageError (U101) for anything but `wall` and `processor`."""
    match text:
        case "wall" | "processor":
            return text
    raise usage(f"there is no clock `{text}`", "wall or processor")


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse a list of seeds such as `0..2`, `3` or `0..2,7`; return them in order, without duplicates.

    Raises:
        UsageError: U101, the text is not such a list.
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if high < low or high - low >= MOST_SEEDS:
            raise usage(f"`{text}` is not a list of seeds", "write it as --seeds 0..2 or 0,3,7")
        seeds.update(dict.fromkeys(range(low, high + 1)))
    return tuple(seeds)
