"""Errors and warnings (diagnostics) as data: codes, labels, help.

They are printed by `stlc.cli.framework.render`.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

from stlc.similar import did_you_mean
from stlc.source import Label, Range, Span

Severity = Literal["error", "warning", "fact"]
"""An error; a warning, which most likely is a mistake; a fact, which stands beside a result."""


@dataclass(frozen=True, slots=True)
class Edit:
    """A location, and the text that replaces that there."""

    JSON: ClassVar = "file=span.source.name range=span.range replacement"

    span: Span
    replacement: str


@dataclass(frozen=True, slots=True)
class Fix:
    """Repair of a finding: edits, as (source location, replacement) pairs, and their effect in words.

    If not `same`, the repair changes what is required: it is offered, and never applied by itself.
    """

    JSON: ClassVar = "text edits=replacements"

    edits: tuple[tuple[Span, str], ...]
    text: str = ""
    same: bool = True

    @property
    def replacements(self) -> tuple[Edit, ...]:
        """The edits."""
        return tuple(Edit(*each) for each in self.edits)


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """An error or a warning about an input or about the machine.

    Attributes:
        code: an entry of `CODES`; codes that start with W are warnings or facts.
        message: one terse headline, in the user's terms.
        span: location in the source; None for a finding that concerns no text.
        label: text shown beside the underlined location.
        labels: secondary locations, each with a text.
        help: advice, a line per entry.
        note: reasons, a line per entry.
        fix: edits that repair the finding.
    """

    JSON: ClassVar = "code severity message file range label labels help note fix"

    code: str
    message: str
    span: Span | None = None
    label: str = ""
    labels: tuple[Label, ...] = ()
    help: tuple[str, ...] = ()
    note: tuple[str, ...] = ()
    fix: Fix | None = None

    @property
    def severity(self) -> Severity:
        """Severity by the first letter of the code; warnings in `FACTS` are facts."""
        if not self.code.startswith("W"):
            return "error"
        return "fact" if self.code in FACTS else "warning"

    @property
    def file(self) -> str | None:
        """Name of the source; None for a finding that concerns no text."""
        return None if self.span is None else self.span.source.name

    @property
    def range(self) -> Range | None:
        """Lines and columns of the location, from 1."""
        return None if self.span is None else self.span.range

    def near(self, name: str, candidates: Iterable[str], *otherwise: str, listed: str = "") -> Diagnostic:
        """A copy whose advice begins with the candidate that is most similar to a misspelt name.

        If none is similar, it begins with the texts `otherwise`. `listed` follows in the same line.
        """
        found = did_you_mean(name, candidates, *otherwise)
        first = ("  ".join((*found, listed)),) if listed else found
        return replace(self, help=(*first, *self.help))

    def with_note(self, text: str) -> Diagnostic:
        """A copy with one more note."""
        return replace(self, note=(*self.note, text))


class Findings(list[Diagnostic]):
    """A list of findings without duplicates, with constant-time membership tests."""

    def __init__(self, items: Iterable[Diagnostic] = ()) -> None:
        super().__init__(items)
        self._known: set[tuple[str, Span | None, str]] = set()
        self._indexed = 0

    def tell(self, finding: Diagnostic) -> None:
        """Append a finding, unless the list has one with the same code, location and message."""
        for known in self[self._indexed :]:
            self._known.add((known.code, known.span, known.message))
        key = (finding.code, finding.span, finding.message)
        if key not in self._known:
            self._known.add(key)
            self.append(finding)
        self._indexed = len(self)


def tell(sink: list[Diagnostic], finding: Diagnostic) -> None:
    """Append a finding to the list `sink`.

    The finding is dropped if the list has one with the same code, location and message.
    """
    if isinstance(sink, Findings):
        sink.tell(finding)
        return
    key = (finding.code, finding.span, finding.message)
    if all((known.code, known.span, known.message) != key for known in sink):
        sink.append(finding)


class StlcError(Exception):
    """Base class of the errors that a user can correct.

    `diagnostics` are the findings to show. `exit_code` is the exit code of a command that fails with the
    error. As text, the error says what helps with the names of Python's arguments.
    """

    exit_code = 3

    def __init__(self, *diagnostics: Diagnostic) -> None:
        super().__init__(*diagnostics)
        self.diagnostics = diagnostics

    @classmethod
    def of(
        cls,
        code: str,
        message: str,
        span: Span | None = None,
        label: str = "",
        labels: tuple[Label, ...] = (),
        help: tuple[str, ...] = (),
        note: tuple[str, ...] = (),
    ) -> Self:
        """Return the error with one finding, whose parts are those of `Diagnostic`."""
        return cls(Diagnostic(code, message, span, label, labels, help, note))

    def near(self, name: str, candidates: Iterable[str], *otherwise: str, listed: str = "") -> Self:
        """The error with the advice of `Diagnostic.near` in its first finding."""
        first, *rest = self.diagnostics
        return type(self)(first.near(name, candidates, *otherwise, listed=listed), *rest)

    def __str__(self) -> str:
        return "\n".join(
            line
            for found in self.diagnostics
            for line in (f"{found.code}: {found.message}", *(f"  help: {_in_python(e)}" for e in found.help))
        )


def _in_python(advice: str) -> str:
    """Advice with arguments for options: `max_gap=3` for `--max-gap 3s`, `names={"t": "x"}` for `--map`."""
    advice = re.sub(r"--map (\w+)=(\w+)", r'names={"\1": "\2"}', advice)
    time = r"--([a-z]+(?:-[a-z]+)*) ([0-9.e+-]+)s(?!\w)"
    return re.sub(time, lambda found: f"{found[1].replace('-', '_')}={found[2]}", advice)


class SpecError(StlcError):
    """Error: a specification is invalid."""


class SystemFileError(StlcError):
    """Error: a system file is invalid."""


class TraceError(StlcError):
    """Error: a trace cannot be read, or does not fit its specification."""


class RunError(StlcError):
    """Error: a run folder or checkpoint is damaged, or cannot be used for what was requested."""


class PluginError(StlcError):
    """Error: a plugin of an installed package, or of a file that the user named, cannot be loaded."""


class UsageError(StlcError):
    """Error: the command line is wrong, or a file named in it does not exist."""

    exit_code = 2


def usage(
    message: str, *advice: str, code: str = "U101", span: Span | None = None, note: tuple[str, ...] = ()
) -> UsageError:
    """Return an error of what the user asks for, with a message and advice; the caller raises it.

    Its code is U101, a wrong command line or argument, unless `code` says otherwise.
    """
    return UsageError.of(code, message, span, help=advice, note=note)


class MissingError(StlcError):
    """Error: a package, a compiler, memory or room on the disk is missing on this machine."""

    exit_code = 5


class Notice(UserWarning):
    """A warning about the machine that does not affect results; the command line shows it once."""

    def __init__(self, finding: Diagnostic) -> None:
        super().__init__(": ".join((finding.code, "; ".join((finding.message, *finding.help)))))
        self.finding = finding


def os_reason(error: OSError) -> str:
    """Reason of an operating-system error in lower case, such as `permission denied`."""
    return (error.strerror or type(error).__name__).lower()


def notice(finding: Diagnostic) -> None:
    """Issue a Python warning (`Notice`) about the machine, such as a missing compiler."""
    warnings.warn(Notice(finding), stacklevel=3)


CODES: dict[str, str] = {
    # reading
    "E001": "a character that is not of the language",
    "E002": "`|` used as absolute-value bars",
    "E003": "not a specification: a mesh, a binary file, or not UTF-8",
    "E004": "a file that is missing or cannot be read",
    "E005": "nested too deeply, or too large",
    # syntax
    "E010": "something is missing or unexpected",
    "E011": "a bracket that is never closed",
    "E012": "a chain of `until`s without parentheses",
    "E013": "`=` where `==` is meant",
    "E014": "a vector directly after a temporal operator",
    "E015": "a feature of the language that this version does not compile yet",
    "E016": "a number over a window that has no equivalent formula",
    # names
    "E101": "an unknown name",
    "E102": "a name defined twice",
    "E103": "a signal that the system does not have",
    "E104": "a constant that differs between specification and system",
    "E105": "a definition that refers to itself, or wrong arguments",
    "W105": "a name that is declared and never used",
    "W106": "a word or sign of another tool, where the language has its own",
    "W107": "a temperature in coulombs",
    "W108": "a state without a unit, whose flow has one",
    "E106": "an import that cannot be read, or that leads back to itself",
    "E107": "a function from outside that nobody provides",
    # types and units
    "E201": "a number where a formula is needed",
    "E202": "a formula where a number is needed",
    "E203": "units that do not agree",
    "E204": "`==` between real numbers",
    "E205": "an operation that its operands do not have",
    # time
    "E301": "an interval that ends before it starts",
    "W301": "a formula that other tools read differently without parentheses",
    "W302": "an implication beside `and` or `or` without parentheses",
    "E302": "a future operator with a negative bound",
    "E303": "an interval bound that is not a constant",
    "W304": "an interval bound that is not a whole number of steps",
    "W311": "a requirement that is judged at the first sample only",
    "W312": "a formula that every value satisfies",
    "W313": "a comparison that a declared range decides",
    "W314": "a bare number beside a unit for which another is common",
    "W315": "a requirement in a comment",
    "W316": "a requirement that is due later than plans reach",
    "W319": "a comment for stlc that it does not understand",
    "E305": "an interval without a sample",
    "W305": "a recording that was read in part",
    "E306": "more signal is needed than there is",
    "E307": "an absolute interval under another temporal operator",
    "E309": "a past operator that asks for too much memory",
    "E310": "an absolute operator over more of the future than states can hold",
    "E311": "`T`, `dt` or a number of steps without a system that says what they are",
    "E312": "an absolute goal without a deadline, in a specification to train on",
    "E313": "a requirement that a stream cannot judge at a bounded cost",
    "W101": "a bare number as an interval bound",
    # numbers
    "E401": "division or modulo by zero",
    "W402": "a divisor whose range contains 0",
    "W403": "a modulo in a predicate to be trained",
    # tags and meaning
    "E501": "an unknown or misplaced tag",
    "W502": "a safety requirement that cannot constrain a prefix",
    "W503": "a requirement that is satisfied vacuously",
    "W504": "a specification that requires nothing",
    "W505": "a conjunction that nothing satisfies",
    # traces
    "E601": "a trace that lacks a signal",
    "E602": "a trace whose time is not uniform",
    "E603": "a trace file that cannot be read, or is not safe to read",
    "E604": "a trace whose times are not finite",
    "E605": "a trace whose arrays do not fit together",
    "E606": "a trace with two clocks that disagree",
    "E607": "a clock whose numbers are hardly seconds",
    # system files
    "S100": "not a YAML document",
    "S101": "an unknown key",
    "S102": "a key that is given twice, or a missing key",
    "S103": "a value of the wrong kind",
    "S201": "an expression that is not of the expression language",
    "S202": "a name that is not a state",
    "S203": "a formula or a number in the wrong place",
    "S204": "a control without a range, or bounds in the wrong order",
    "S205": "a feedback that cannot be computed",
    "S206": "a world or plugin that cannot be loaded",
    "S207": "a world that fails while it runs",
    "S208": "a function from outside that cannot be loaded, or that fails",
    "S209": "a file that a system file extends, and that cannot be read",
    "S210": "a specification of closed-loop runs that cannot be read",
    "S211": "a world that cannot draw the start of one agent again",
    "S212": "an uncertain number in a place to which no error can be carried",
    "S213": "an uncertain constant that changes nothing",
    "S301": "initial states that are (nearly) all rejected",
    "S302": "dynamics that give NaN or infinity",
    "S303": "initial states in a file that cannot be used",
    "S304": "a mirror that is not a symmetry",
    "S401": "a plant that cannot be opened, or that lacks what its file names",
    "W601": "an acceptance rate of initial states below 1 %",
    "W602": "plans of a plant that is unstable",
    "W604": "an unbounded mission that is simulated for longer than it was validated",
    # runs
    "R101": "no run, or a run folder that is damaged",
    "R102": "a checkpoint of another specification or system",
    "R103": "a run that is already finished",
    "R104": "options that cannot change on resume",
    "R105": "an exported controller that does not do what its run does",
    "R106": "an exported controller whose files are missing, damaged or mixed",
    "R107": "a state that an exported controller cannot decide in",
    "R108": "a file that is no certificate, or a damaged one",
    "R109": "a run that another process is training",
    "R110": "a link, a pipe, a device or a too large file in the folder of a run",
    "R111": "Python that a run names, and that the command does not run",
    "R201": "no room on the disk, or a file that cannot be written",
    "R202": "not enough memory",
    "R301": "a package that is not installed",
    "R302": "a device that is not there",
    "R401": "training diverged",
    "R402": "a policy whose plan is not a number",
    "R403": "a process of a training that is gone",
    "R404": "requirements that no plan was found for",
    "R405": "starts from none of which a plan is known",
    "R406": "work that was lost with the process or machine that did it",
    "W603": "a control without effect",
    "W701": "a cache folder, or a file in it, that others could have changed",
    "W702": "a C compiler that fails or hangs",
    "W711": "a requirement that could read a part of the recording only",
    "W712": "an obligation that the recording never triggered",
    "W713": "an `eventually` that is true at once, everywhere",
    "W714": "a comparison far from all recorded values",
    "W715": "a signal that is constant, or stuck for a while",
    "W716": "a value far off all others",
    "W717": "a column that seems to tell objects apart",
    "W718": "a recording of a few samples",
    "W719": "a signal that is known in a part of the recording only",
    "W720": "a column of the signal's own name that `--map` hides",
    "W721": "a column whose name says another unit than its signal has",
    "W722": "a signal in radians with values as in degrees",
    "W723": "a requirement that is satisfied on the boundary",
    "U101": "a command line that cannot be understood",
    "U102": "a file that does not exist",
    # the tool itself
    "B001": "a bug in stlc",
}

FACTS = frozenset({*(f"W{number}" for number in range(711, 720)), "W722", "W723"})
"""Codes of facts about a result (`stlc.monitor.facts`), which are no warnings."""
