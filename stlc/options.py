"""Options of operations, declared once: a function's arguments and a command's options come from them.

The options of an operation are the fields of a dataclass, each annotated with an `Option`. `Options.taking`
makes them the keyword arguments of the function, and `stlc.cli.framework.program` those of the command line.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Concatenate,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from stlc.diagnostics import usage

P = ParamSpec("P")
Subject = TypeVar("Subject")
Chosen = TypeVar("Chosen")
Result = TypeVar("Result")
Clock = Literal["wall", "processor"]
"""Clock of a budget: wall time, or processor time as on an idle machine."""


_ENTRY = re.compile(r"^ {4}(\w+)(?: \((.+)\))?: (.+(?:\n {8}.*)*)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Option:
    """An option on the command line; beside it, `Annotated` may hold a function that reads its text.

    Attributes:
        help: what it is for, and its default after `; by default`; else what the docstring says.
        metavar: placeholder of its value.
        flags: its names; by default that of the field.
        many: whether it may be repeated.
        least: least value of a number.
        most: greatest value of a number.
        names: what its values name, `run_names` or `requirement_names`, which shells complete.
    """

    help: str = ""
    metavar: str | None = None
    flags: tuple[str, ...] = ()
    many: bool = False
    least: float | None = None
    most: float | None = None
    names: str = ""

    @staticmethod
    def described(options: type) -> dict[str, tuple[str | None, str]]:
        """Placeholder and help of each option, from the attributes in the docstrings of a dataclass."""
        text = "\n".join(inspect.cleandoc(each.__doc__ or "") for each in options.__mro__)
        return {
            name: (metavar or None, " ".join(told.split())) for name, metavar, told in _ENTRY.findall(text)
        }

    @staticmethod
    def parts(hint: Any) -> tuple[Any, Option | None, Callable[[Any], Any] | None]:
        """Type of an option without its description, the description, the function that reads its text."""
        if get_origin(hint) in (Union, UnionType):
            found = [Option.parts(each) for each in get_args(hint)]
            options = [each for each in found if each[1] is not None]
            return (hint, None, None) if not options else (options[0][0] | None, *options[0][1:])
        held = get_args(hint) if get_origin(hint) is Annotated else ()
        if len(held) < 2 or not isinstance(held[1], Option):
            return hint, None, None
        return held[0], held[1], held[2] if len(held) > 2 else None

    @staticmethod
    def flags_of(name: str, option: Option | None) -> tuple[str, ...]:
        """Flags of an option: its own, or `--held-out` of the field `held_out`."""
        return (option and option.flags) or (f"--{name.rstrip('_').replace('_', '-')}",)


def parse_overrides(pairs: Sequence[str] | None) -> dict[str, str]:
    """Parse pairs such as `T_red=3 s` into a mapping such as `{"T_red": "3 s"}`.

    Raises:
        UsageError: U101, see `parse_pairs`.
    """
    return parse_pairs(pairs, "--set", "NAME=VALUE", "T_red=3s")


def parse_options(pairs: Sequence[str]) -> dict[str, str]:
    """Parse the options of a method or planner, such as `tries=500`. Raises UsageError (U101)."""
    return parse_pairs(pairs, "--option", "NAME=VALUE", "tries=500")


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


MOST_SEEDS = 1000
_RANGE = re.compile(r"\s*(\d{1,18})\s*(?:\.\.\s*(\d{1,18})\s*)?")


def parse_seconds(text: str) -> float:
    """Parse a duration such as `60s`, `5min` or `1.5 h`; return it in seconds. A bare number is in seconds.

    Raises:
        UsageError: U101, the text is not a duration.
    """
    from stlc.units import Unit

    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyz ").strip()
    unit = text.strip()[len(number) :].strip() or "s"
    try:
        value = float(number) * float(Unit.parse(unit).scale)
        if Unit.parse(unit).dims != Unit.parse("s").dims or not 0.0 < value < 1e9:
            raise ValueError
    except ValueError as error:
        raise usage(f"`{text}` is not a duration", "write it as 60s or 5min") from error
    return value


def parse_count(text: str, option: str) -> int:
    """Parse a whole number of at least 1, the value of `option`. Raises UsageError (U101)."""
    if re.fullmatch(r"\s*0*[1-9]\d{0,17}\s*", text, re.ASCII):
        return int(text)
    raise usage(f"`{option} {text}` is no number from 1 on", f"{option} 1200")


def parse_limit(text: str) -> float:
    """Parse a duration and return it in seconds, infinity for `none`. Raises UsageError (U101)."""
    return math.inf if text.strip() == "none" else parse_seconds(text)


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


class Options:
    """Base class of the options of an operation, and the types of options that several operations have."""

    __slots__ = ()
    MOST_SEED: ClassVar = 2**63 - 1
    """Greatest seed of torch's random numbers."""
    SET = Option("Change a constant of the spec or a key of the system.", "NAME=VALUE", ("--set",), many=True)
    REQUIRE = Option(
        "This requirement only; repeatable.", "NAME", ("--require",), many=True, names="requirement_names"
    )
    NONE: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """No overrides, or no options of a method."""

    System = Annotated[
        str | None,
        Option(
            "The system: as given, beside the spec, in systems/, in examples/, or installed.",
            "FILE",
            ("--system", "-s"),
        ),
    ]
    Overrides = Annotated[Mapping[str, str], SET, parse_overrides]
    OfMethod = Annotated[
        Mapping[str, str],
        Option("An option of --method; repeatable.", "NAME=VALUE", ("--option",), many=True),
        parse_options,
    ]
    Seconds = Annotated[float, Option(metavar="TIME"), parse_seconds]
    Seeds = Annotated[Sequence[int], Option(metavar="SEEDS"), parse_seeds]
    Clock = Annotated[Clock, Option(metavar="wall|processor", flags=("--budget-clock",)), parse_clock]
    Natural = Annotated[int, Option(metavar="N", least=0)]
    Positive = Annotated[int, Option(metavar="N", least=1)]
    Seed = Annotated[int, Option("Seed of everything random.", least=0, most=MOST_SEED)]
    Jobs = Annotated[int, Option("Number of processes side by side.", flags=("--jobs", "-j"), least=1)]
    Cluster = Annotated[
        str | None,
        Option("Work on a Ray cluster, with as many processes as it has cores.", "auto|local|HOST:PORT"),
    ]
    Runs = Annotated[Path, Option("Folder of all runs.", "DIR")]
    Python = Annotated[bool, Option("Run the Python that the run names: of a run that you trust.")]

    @staticmethod
    def taking(
        options: Callable[P, Chosen],
    ) -> Callable[[Callable[[Subject, Chosen], Result]], Callable[Concatenate[Subject, P], Result]]:
        """Return a decorator: a function of a subject and `options` takes their fields as keyword arguments.

        A path may be given as text.
        """

        def decorate(
            function: Callable[[Subject, Chosen], Result],
        ) -> Callable[Concatenate[Subject, P], Result]:
            own, hints = inspect.signature(function), get_type_hints(options)
            paths = {name for name, hint in hints.items() if Path in (hint, *get_args(hint))}

            @wraps(function)
            def called(subject: Subject, *given: P.args, **named: P.kwargs) -> Result:
                for name in paths & named.keys():
                    if isinstance(text := named[name], str):
                        named[name] = Path(text)
                return function(subject, options(*given, **named))

            first, *_ = own.parameters.values()
            taken = inspect.signature(options).parameters
            rest = (each.replace(annotation=hints[name]) for name, each in taken.items())
            called.__signature__ = own.replace(parameters=[first, *rest])  # type: ignore[attr-defined]
            return called  # type: ignore[return-value]

        return decorate

    @staticmethod
    def checked_share(option: str, share: float) -> float:
        """Return a share in (0, 1), the value of `option`; any other number raises UsageError (U101)."""
        if not 0.0 < share < 1.0:
            raise usage(f"`{option} {share:g}` is not between 0 and 1", f"{option} .99")
        return share

    @staticmethod
    def require_no_jobs(cluster: str | None, jobs: int) -> None:
        """Raise UsageError (U101) if `--cluster` and `--jobs` are both given."""
        if cluster is not None and jobs != 1:
            raise usage("`--jobs` and `--cluster` contradict each other", "a cluster uses all of its cores")

    def given(self) -> dict[str, Any]:
        """Keyword arguments that give these options."""
        return {name: getattr(self, name) for name in self.flags()}

    @classmethod
    def flags(cls) -> dict[str, str]:
        """Field of the dataclass -> its first flag."""
        hints = get_type_hints(cls, include_extras=True)
        return {
            each.name: Option.flags_of(each.name, Option.parts(hints[each.name])[1])[0]
            for each in fields(cls)  # type: ignore[arg-type]
        }

    def words(self) -> dict[str, tuple[str, ...]]:
        """First flag of each option that is given -> the texts of its occurrences, "" for a switch."""
        found = {}
        for name, flag in self.flags().items():
            value = getattr(self, name)
            if isinstance(value, Mapping):
                value = [f"{key}={text}" for key, text in value.items()]
            values = value if isinstance(value, list | tuple) else [value]
            if values and value is not None and value is not False:
                found[flag] = tuple("" if each is True else str(each) for each in values)
        return found

    @staticmethod
    def command_line(words: Mapping[str, Sequence[str]]) -> list[str]:
        """Words of a command line that gives options: flag -> the texts of its occurrences."""
        return [each for flag, texts in words.items() for text in texts for each in (flag, text) if each]
