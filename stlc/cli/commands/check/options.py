"""Options on traces that `stlc check`, `explain` and `plot` share, each declared here alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, get_type_hints

import typer

from stlc.compile.semantics.tolerance import TOLERANCE, End
from stlc.diagnostics import usage
from stlc.escape import operand
from stlc.monitor.check import Question, seconds_of
from stlc.options import Options, parse_overrides, parse_pairs
from stlc.registry import SEMANTICS

if TYPE_CHECKING:
    from stlc.monitor.uncertain import Uncertainty
    from stlc.trace.clocks import ClockSetting
    from stlc.trace.resample import Between


@dataclass(frozen=True, slots=True)
class Traces(Options):
    """Command-line options that say how traces are read and judged.

    Attributes:
        spec (FILE): The specification, instead of the trace's own.
        map_ (SIGNAL=NAME): A signal's name in the trace; t is the clock.
        resample (TIME): Judge on a grid of this step; every recorded sample counts.
        between (SIGNAL=HOW): Values between samples: hold, hold:0.5s (older is unknown), linear or angle.
        max_gap (TIME): In longer gaps signals are unknown; by default three steps with --resample, else
            no gap.
        dt (TIME): Time between samples that have no clock, as 10ms.
        clock (NAME[:UNIT]): The clock and its unit: timestamp:us, header.stamp, frame:frames.
        fps (N): Frames per second, for a clock that counts frames.
        group (NAME): Column that tells objects apart, a trace each; none: one trace.
        columns (NAMES): Names of the columns of a table without a header.
    """

    spec: Path | None = None
    system: Options.System = None
    set_: Annotated[list[str] | None, Options.SET] = None
    require: Annotated[list[str] | None, Options.REQUIRE] = None
    map_: list[str] | None = None
    resample: str | None = None
    between: list[str] | None = None
    max_gap: str | None = None
    dt: str | None = None
    clock: str | None = None
    fps: float | None = None
    group: str | None = None
    columns: str | None = None
    runs: Options.Runs = Path("runs")

    def words(self) -> dict[str, tuple[str, ...]]:
        """The options as they were given: flag -> the texts of all occurrences, "" for a switch."""
        return {flag: texts for flag, texts in Options.words(self).items() if flag != "--runs"}

    @property
    def replay(self) -> tuple[str, ...]:
        """Words of a command line that reads the same trace, to explain one of its violations."""
        given = self.words()
        words = [operand(spec) for spec in given.get("--spec", ())]
        words += Options.command_line({flag: given.get(flag, ()) for flag in _REPLAYED})
        return (*words, *(("--group", "none") if self.group == "none" else ()))

    @classmethod
    def from_words(cls, words: Mapping[str, Sequence[str]]) -> Self:
        """Return the options that `words` gave. Raises ValueError for an option that there is not."""
        declared = {flag: name for name, flag in cls.flags().items()}
        hints, given = get_type_hints(cls), dict[str, Any]()
        for name, values in words.items():
            kind = str(hints.get(declared.get(name, "")))
            if name not in declared or not values or not all(isinstance(value, str) for value in values):
                raise ValueError(f"`{name}` is no option of check with its values")
            one = True if "bool" in kind else float(values[0]) if "float" in kind else values[0]
            given[declared[name]] = (
                list(values) if "list" in kind else Path(values[0]) if "Path" in kind else one
            )
        return cls(**given)

    def question(self, **more: Any) -> Question:
        """Return the options as a `Question`; `more` sets further fields, such as `at`.

        Raises:
            UsageError: U101, the value of an option is malformed.
        """
        asked: dict[str, Any] = {
            "spec": self.spec,
            "system": self.system,
            "names": parse_pairs(self.map_, "--map", "SIGNAL=NAME", "v_lead=vlead"),
            "require": tuple(self.require or ()),
            "resample": time_step("--resample", self.resample),
            "overrides": parse_overrides(self.set_),
            "dt": time_step("--dt", self.dt),
            "between": betweens(parse_pairs(self.between, "--between", "SIGNAL=HOW", "v_lead=hold")),
            "clock": clock_setting(self.clock, self.fps),
            "group": self.group or "",
            "columns": tuple(name.strip() for name in (self.columns or "").split(",") if name.strip()),
            "max_gap": time_step("--max-gap", self.max_gap),
        }
        return Question(**{**asked, **more})


_REPLAYED = (
    *("--system", "--map", "--set", "--resample", "--dt", "--max-gap", "--between", "--clock", "--fps"),
    *("--columns", "--uncertain"),
)


TRACES = Traces()


@dataclass(frozen=True, slots=True)
class Judging(Traces):
    """Options of `stlc check` on reading and judging, with which its result can be made again.

    Attributes:
        uncertain (SIGNAL=ERROR): Greatest error of each sample, as x=0.1m or v=2%.
        at (0|all|K|TIME): Judge at this sample or time, or at all starts.
        end: If the trace is too short: bounds, an error, or cut windows.
        tolerance: A robustness of at least minus this is satisfied; 0: `>` is not `>=`.
        strict: Times at which signals were not seen are unknown; 4 if a requirement was not fully judged.
    """

    uncertain: list[str] | None = None
    at: str | None = None
    end: End = "open"
    tolerance: float = TOLERANCE
    semantics: Annotated[
        str,
        typer.Option(
            metavar="NAME", help=f"Reported robustness: {', '.join(SEMANTICS.names)}. Verdicts are exact."
        ),
    ] = "exact"
    strict: bool = False

    def question(self, **more: Any) -> Question:
        """Return the options as a `Question`. Raises UsageError (U101) if one is malformed."""
        if not 0 <= self.tolerance < math.inf:
            raise usage(f"`--tolerance {self.tolerance}` is not a number from 0 on")
        errors = uncertainties(parse_pairs(self.uncertain, "--uncertain", "SIGNAL=ERROR", "x=0.1m"))
        given = {name: getattr(self, name) for name in ("at", "end", "tolerance", "semantics", "strict")}
        return Traces.question(self, **{**given, "uncertain": errors, **more})


JUDGING = Judging()


def uncertainties(pairs: Mapping[str, str]) -> dict[str, Uncertainty]:
    """Parse the values of `--uncertain`: signal -> text such as `0.1m` or `2%`.

    Raises:
        UsageError: U101, a text is not an amount, or its unit is unknown.
    """
    from stlc.monitor.uncertain import Uncertainty

    found = {}
    for name, text in pairs.items():
        try:
            found[name] = Uncertainty.parse(text)
        except ValueError as error:
            raise usage(f"`--uncertain {name}={text}`: {error}", "write --uncertain x=0.1m") from None
    return found


def betweens(pairs: Mapping[str, str]) -> dict[str, Between]:
    """Parse the values of `--between`: signal -> text such as `hold`, `hold:0.5s`, `linear` or `angle`.

    Raises:
        UsageError: U101, a text is none of these.
    """
    if not pairs:
        return {}
    from stlc.trace.resample import Between

    found = {}
    for name, text in pairs.items():
        how, colon, age = (part.strip() for part in text.partition(":"))
        if how not in ("hold", "linear", "angle") or (colon and how != "hold"):
            help_ = "write hold, hold:0.5s, linear or angle"
            raise usage(f"`--between {name}={text}` is no way to continue a signal", help_)
        found[name] = Between(how, time_step("--between", age) if colon else None)  # type: ignore[arg-type]
    return found


def clock_setting(text: str | None, fps: float | None) -> ClockSetting | None:
    """Parse the values of `--clock` and `--fps`; None if neither is given.

    Raises:
        UsageError: U101, a value is malformed.
    """
    if text is None and fps is None:
        return None
    from stlc.trace.clocks import ClockSetting

    if fps is not None and not 0.0 < fps < math.inf:
        raise usage(f"`--fps {fps}` is not a number above 0")
    step = None if fps is None else 1.0 / fps
    if text is None:
        return ClockSetting(step=step)
    try:
        return ClockSetting.parse(text.strip(), step)
    except ValueError as error:
        raise usage(f"`--clock {text}`: {error}", "write --clock NAME  or  --clock NAME:us") from None


def time_step(option: str, text: str | None) -> float | None:
    """Parse the value of `option` as a time step and return it in seconds; None is returned unchanged.

    Raises:
        UsageError: U101, the text is not a time with a unit, or the time is not positive.
    """
    if text is None:
        return None
    seconds = seconds_of(option, text, "a time with its unit: 0.1s, 20ms")
    if not 0 < seconds < float("inf"):
        raise usage(f"`{option} {text}` is not a time above 0")
    return seconds
