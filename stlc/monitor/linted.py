"""Lint of specification files, with the systems that they are for, and with a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

from stlc.diagnostics import Diagnostic, SpecError, SystemFileError, UsageError, usage
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.lint.lint import Selection, Surroundings
from stlc.lint.lint import fix as repair
from stlc.lint.lint import lint as lint_text
from stlc.source import Source


@dataclass(frozen=True, slots=True)
class Lint:
    """Findings in specification files, and the number of those that were repaired."""

    JSON: ClassVar = "files findings=count fixed"

    files: tuple[str, ...]
    findings: tuple[Diagnostic, ...]
    fixed: int = 0

    @property
    def count(self) -> int:
        """Number of findings."""
        return len(self.findings)

    @property
    def invalid(self) -> bool:
        """True if a finding is an error."""
        return any(finding.severity == "error" for finding in self.findings)

    @property
    def brief(self) -> str:
        """The numbers of findings and of files, such as `1 error, 2 warnings in 3 files`."""
        count = Counter(finding.severity for finding in self.findings)
        files = several(len(self.files), "file")
        kinds = [several(count[kind], kind) for kind in ("error", "warning", "fact") if count[kind]]
        return f"{', '.join(kinds)} in {files}" if kinds else f"{files}, nothing to say"

    def __repr__(self) -> str:
        return f"Lint({self.brief})"


def several(number: int, word: str) -> str:
    """Return a number with a noun in the singular or plural."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def lint(
    files: Path | str | Sequence[Path | str] = ".",
    *,
    fix: bool = False,
    select: Sequence[str] = (),
    ignore: Sequence[str] = (),
    system: str | None = None,
    trace: Path | str | None = None,
) -> Lint:
    """Look for errors and for unclear, unused or unusual parts in specifications.

    Args:
        files: specification files, or folders with them.
        fix: whether files are repaired in place, as far as what is required stays the same.
        select: codes of the warnings to look for, or their beginnings; `ALL` for every one.
        ignore: codes of warnings to leave out.
        system: the system that the specifications must fit; None: the one that each file names.
        trace: a recording, of which is told what it does not test.

    Raises:
        UsageError: U101, there is no such code; U102, a file is missing.
        SystemFileError: the file of `system` is invalid.
    """
    given = [files] if isinstance(files, str | Path) else files
    names = File.specs([str(name) for name in given])
    if fix and File.STDIN in names:
        raise usage("`--fix` needs files, not the standard input")
    selection, repairs, findings = Selection(tuple(select), tuple(ignore)), 0, list[Diagnostic]()
    for name in names:
        try:
            source = File(name if fix else File(name).spec()).read()
        except SpecError as error:
            findings += error.diagnostics
            continue
        within = None
        try:
            within = _surroundings(system, source)
        except (SystemFileError, UsageError) as error:
            if system is not None:
                raise
            findings += error.diagnostics
        look = partial(lint_text, within=within, selection=selection)
        if fix:
            repaired = repair(source, look)
            if repaired.count:
                File(source.name).write(repaired.source.text)
            repairs += repaired.count
            source, found = repaired.source, repaired.findings
        else:
            found = look(source)
        findings += found
        if trace is not None and not any(finding.severity == "error" for finding in found):
            from stlc.monitor.facts.findings import findings_on

            tested = findings_on(Spec.parse(source), Path(trace), system)
            findings += [each for each in tested if selection.wants(each.code)]
    return Lint(names, tuple(findings), repairs)


def _surroundings(system: str | None, source: Source) -> Surroundings | None:
    """Load the system `system`, or else the one that `source` names, to check the specification with it.

    Return None if there is none, or if the specification cannot be read.
    """
    if system is None:
        try:
            system = Spec.parse(source).system
        except SpecError:
            return None
    if system is None:
        return None
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Purpose
    from stlc.dynamics.load import load_system_decl

    decl = load_system_decl(File(system).system(source.name))
    purpose: Purpose = "check" if decl.judges_by(Path(source.name)) else "train"
    return Surroundings(decl.interface(), Grid(decl.dt, decl.horizon), purpose)
