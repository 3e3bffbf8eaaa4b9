"""Rules for closed-loop runs, and verdicts of the rules on recorded runs.

The rules are a second specification, which a system file names by `test: {judge: …}`. The first specification
judges each plan over its horizon. In contrast, the rules judge a closed-loop run once, from its first to its
last sample. The rules may use past operators, and may refer to the world.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.compile.pipeline import compile_spec
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.causes import Cause, Lost, losses
from stlc.controller.evaluation.executed import MOST_TIMED
from stlc.controller.run.run import save_library
from stlc.diagnostics import Diagnostic, SystemFileError, UsageError
from stlc.files import File
from stlc.grammar.spec import Spec, file_of
from stlc.jsontext import Count
from stlc.monitor.explain.report import explain
from stlc.monitor.verdict import Monitor
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.deployment.simulator import DeploymentRecording
    from stlc.controller.evaluation.executed import Executed
    from stlc.controller.problem.task import Task
    from stlc.controller.run.run import Run
    from stlc.dynamics.declaration.decl import SystemDecl
    from stlc.dynamics.declaration.deployment import JudgeRef
    from stlc.monitor.judgement import Verdict

JUDGE = "judge"
_INDEX = f"{JUDGE}/{RunDir.INDEX}"


@dataclass(frozen=True, slots=True)
class Rules:
    """A specification for closed-loop runs.

    Attributes:
        spec: the parsed specification, with the texts of its imports.
        path: path of the file as the user gave it when the run was made.
        overrides: constants that the run or the deployment changes: name -> value as a text.
    """

    spec: Spec
    path: str
    overrides: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the specification; by default the name of its file."""
        return self.spec.name or Path(self.path).stem

    @property
    def docs(self) -> dict[str, str]:
        """Comments on the rules: name of a rule -> text of its `##` comment."""
        rules = self.spec.requirements.values()
        return {item.name: " ".join((item.doc or "").split()) for item in rules}

    @staticmethod
    def of(run: Run) -> Rules | None:
        """Rules for the closed-loop runs of a run; None if the specification of the plans judges them.

        Training copies the rules that the system file names into the run folder, and this copy is read. Rules
        that are named later, with `--set test.judge=…`, are read from their own file.

        Raises:
            RunError: R101, the index of the copies in the run folder is damaged.
            SystemFileError: S210, the file of rules does not exist.
            SpecError: the file is not a specification.
        """
        return Rules.stored(run.dir, run.task.system.decl)

    @staticmethod
    def stored(folder: RunDir, decl: SystemDecl) -> Rules | None:
        """Rules for the closed-loop runs of the run in a folder, whose system is `decl`; see `of`."""
        judge, overrides = decl.test.judge, decl.overrides
        if judge is None:
            return None
        index = folder.read_json(_INDEX, dict[str, CopiedRules]) if folder.has(_INDEX) else {}
        entry = index.get(judge.written)
        if entry is None:
            spec = read_rules(judge)
            return Rules(spec, str(judge.path), _own(spec, overrides))
        name = entry["file"]
        spec = Spec.parse(folder.source(f"{JUDGE}/{name}"))
        spec = replace(spec, library=folder.library(_library_of(name)))
        return Rules(spec, entry.get("path") or name, _own(spec, overrides))

    def verdict_on(self, task: Task, recording: DeploymentRecording) -> Verdict:
        """Verdict of the rules on every run from its first sample to its last.

        Raises:
            SpecError: the rules use names that the system does not have.
        """
        outside = bool(self.spec.functions)
        decl = task.system.decl
        monitor = Monitor(
            self.spec,
            dt=decl.dt,
            horizon=decl.dt * decl.horizon,
            system=decl.path if outside else None,
            overrides=self.overrides,
        )
        columns = np.moveaxis(recording.states, -1, 0)
        return monitor.check(dict(zip(task.system.names, columns, strict=True)))


@dataclass(frozen=True, slots=True)
class Broken:
    """Run that broke rules.

    Attributes:
        row: index of the run in the recording.
        rules: broken rule -> time of the violation, in seconds from the start; None if no single instant
            decides.
        lost: time since which no good plan was known, and the cause; see `Lost`, which defines good. None if
            all plans followed until the violation were good, or if the cause was not determined.
    """

    row: int
    rules: Mapping[str, float | None]
    lost: Lost | None = None

    @property
    def excused(self) -> bool:
        """True if no good plan (see `Lost`) was known at the start, or none after an exogenous event."""
        return self.lost is not None and self.lost.why in ("start", "told")


@dataclass(frozen=True, slots=True)
class RunVerdicts:
    """Verdicts on closed-loop runs; a run is one agent under one seed.

    Attributes:
        rules: rule -> status of each run, (rows,): `satisfied`, `violated` or `inconclusive`.
        broken: the runs that broke a rule, in the order of their rows.
        viable: mask, (rows,), of the runs that could have obeyed the rules, as far as is known. It is True
            for a run that obeyed them. It is False for a run that broke a rule if no good plan (see `Lost`)
            was known at the start, or none after an exogenous event. It is True for other runs that broke a
            rule, and for inconclusive runs from whose start a safe plan is known.
        safety: names of the rules tagged `@safety`.
    """

    rules: Mapping[str, NDArray[np.str_]]
    broken: tuple[Broken, ...]
    viable: NDArray[np.bool_]
    safety: tuple[str, ...] = ()

    @property
    def obeyed(self) -> NDArray[np.bool_]:
        """Mask of the runs that satisfy every rule, (rows,)."""
        return obeying(self.rules, len(self.viable))

    @property
    def safe(self) -> NDArray[np.bool_] | None:
        """Mask of the runs that satisfy the rules tagged `@safety`, (rows,); None if no rule has this tag."""
        kept = {name: self.rules[name] for name in self.safety}
        return obeying(kept, len(self.viable)) if kept else None


def obeying(rules: Mapping[str, NDArray[np.str_]], rows: int) -> NDArray[np.bool_]:
    """Mask of the runs that satisfy every rule, (rows,).

    `rules`: rule -> status of each run, (rows,). `rows`: number of runs.
    """
    satisfied = [statuses == "satisfied" for statuses in rules.values()]
    held: NDArray[np.bool_] = np.all([np.ones(rows, dtype=bool), *satisfied], axis=0)
    return held


# ------------------------------------------------------------------------ files of rules


@dataclass(frozen=True, slots=True)
class CopiedRules:
    """Copy of a file of rules in the folder of a run: its name, and the path of the file."""

    file: str
    path: str | None = None


def read_rules(judge: JudgeRef) -> Spec:
    """Read the rules (specification of closed-loop runs) that a system file names, with their imports.

    Raises:
        SystemFileError: S210, the file does not exist.
        SpecError: the file is not a valid specification.
    """
    try:
        spec = Spec.parse(File(judge.path).read(judge.span.source.root))
    except UsageError as error:
        first = error.diagnostics[0]
        advice = (*first.help, "`--set test.judge=null` does without")
        finding = Diagnostic("S210", first.message, judge.span, label="named here", help=advice)
        raise SystemFileError(finding) from None
    return replace(spec, library=spec.imported_texts())


def keep_rules(folder: RunDir, task: Task) -> None:
    """Compile the rules (specifications of closed-loop runs) of a system, and copy them to the run folder.

    Raises:
        SystemFileError: S210, a file of rules does not exist.
        SpecError: the rules are invalid, or use names that the system does not have.
    """
    system, found = task.plain, {}
    for judge in task.system.decl.judges:
        spec = read_rules(judge)
        changed = _own(spec, system.decl.overrides)
        compile_spec(
            spec, grid=system.decl.grid, interface=system.interface(), overrides=changed, purpose="check"
        )
        found[judge.written] = judge, spec
    index: dict[str, dict[str, str]] = {}
    for number, (written, (judge, spec)) in enumerate(found.items()):
        name = judge.path.name if number == 0 else f"{number}-{judge.path.name}"
        folder.write(f"{JUDGE}/{name}", spec.source.text)
        save_library(folder, spec.library or {}, _library_of(name))
        index[written] = {"file": name, "path": str(judge.path)}
    folder.write_json(_INDEX, index)


def _library_of(name: str) -> str:
    return f"{JUDGE}/lib/{file_of(name)}"


def _own(spec: Spec, overrides: Mapping[str, str]) -> dict[str, str]:
    """The entries of `overrides` whose names are constants of the specification `spec`."""
    own = spec.settable
    return {name: text for name, text in overrides.items() if name in own}


# ----------------------------------------------------------------------- verdicts


def judge_runs(
    rules: Rules, task: Task, recording: DeploymentRecording, viable: NDArray[np.bool_]
) -> RunVerdicts:
    """Judge every closed-loop run from its first sample to its last.

    Args:
        rules: specification for closed-loop runs.
        task: task that supplies state names, time step and external functions.
        recording: the recorded runs.
        viable: mask, (rows,), of the runs from whose first state a safe plan is known.

    Raises:
        SpecError: the rules use names that the system does not have.
    """
    runs = runs_by_rules(rules, task, recording)
    able, found = viable.copy(), losses(task, recording, runs.broken, runs.safety)
    broken = tuple(replace(each, lost=found.get(each.row)) for each in runs.broken)
    for each in broken:
        able[each.row] = not each.excused
    return replace(runs, broken=broken, viable=able | runs.obeyed)


def runs_by_rules(rules: Rules, task: Task, recording: DeploymentRecording) -> RunVerdicts:
    """Judge every closed-loop run as `judge_runs` does, but do not search for plans: all runs are viable."""
    verdict = rules.verdict_on(task, recording)
    found = {judgement.name: np.array(judgement.statuses) for judgement in verdict}
    safety = frozenset(rule.name for rule in verdict.subject.compiled.safety)
    kept = tuple(name for name in found if name in safety)
    broken, left = [], MOST_TIMED
    for row in range(verdict.traces):
        names = [name for name, statuses in found.items() if statuses[row] == "violated"]
        if not names:
            continue
        times: dict[str, float | None] = dict.fromkeys(names)
        if left > 0:
            run = verdict.within(np.arange(verdict.traces) == row)
            causes = {name: explain(run, name) for name in names}
            times |= {name: cause.shown_time for name, cause in causes.items() if cause is not None}
        broken.append(Broken(row, times))
        left -= len(names)
    return RunVerdicts(found, tuple(broken), np.ones(verdict.traces, dtype=bool), kept)


def judge_runs_by_plans(executed: Executed, dt: float) -> RunVerdicts:
    """Judge closed-loop runs by the specification of the plans, if there is no other specification for runs.

    A row is one run. A start is a sample of the run at which a requirement is evaluated. A run obeys a
    requirement if the requirement certainly holds at every start, of which there is one at least. The run
    breaks the requirement at the sample that decides that it fails at a start.

    Args:
        executed: verdicts on the runs by the specification of the plans.
        dt: time step in seconds.
    """
    viable, fails = executed.viable, executed.fails
    told = np.vectorize(TOLERANCE.status, otypes=["U12"])
    rules = {
        name: told(fails[name].any(0), held.all(0) & (len(held) > 0)) for name, held in executed.rules.items()
    }
    names = {row: [name for name in rules if rules[name][row] == "violated"] for row in range(len(viable))}
    broken = (
        Broken(
            row,
            {name: None if np.isnan(at := executed.decided[name][row]) else float(at) * dt for name in each},
            None if viable[row] else Lost("start", 0.0),
        )
        for row, each in names.items()
        if each
    )
    return RunVerdicts(rules, tuple(broken), viable | obeying(rules, len(viable)), executed.safety)


# ------------------------------------------------------------------------- JSON


@dataclass(frozen=True, slots=True)
class RuleCounts:
    """Numbers of runs that obey a rule, that break it, and without a verdict."""

    obeyed: Count
    broken: Count
    undecided: Count


@dataclass(frozen=True, slots=True)
class LossCause:
    """Time in seconds since which no good plan was known, and why; see `Lost`."""

    why: Cause
    time: float


@dataclass(frozen=True, slots=True)
class BrokenRun:
    """Run that broke rules: their times in seconds from the start (None if unknown), and the cause."""

    seed: int
    agent: Count
    lost: bool
    rules: Mapping[str, float | None]
    cause: LossCause | None


@dataclass(frozen=True, slots=True)
class JudgedRuns:
    """Verdicts on the closed-loop runs under one guard, as `simulate.json` holds them.

    Attributes:
        count: number of runs.
        obeyed: number of runs that satisfy every rule.
        safe: number of runs that satisfy every rule tagged `@safety`; None if no rule has this tag.
        undecided: number of inconclusive runs.
        lost: number of runs that could not obey the rules (see `RunVerdicts.viable`).
        told: number of the lost runs in which a good plan was known until an exogenous event. In the other
            lost runs, no good plan was known even at the start.
        rules: rule -> numbers of runs.
        broken: the runs that broke rules.
    """

    count: Count
    obeyed: Count
    safe: Count | None
    undecided: Count
    lost: Count
    told: Count
    rules: Mapping[str, RuleCounts]
    broken: Sequence[BrokenRun]

    @classmethod
    def of(cls, runs: RunVerdicts, seeds: Sequence[int], agents: int) -> JudgedRuns:
        """Count verdicts on runs of `agents` agents under each seed."""
        obeyed, rows = int(runs.obeyed.sum()), len(runs.viable)
        words = ("satisfied", "violated", "inconclusive")
        broken = []
        for each in runs.broken:
            lost, (seed, agent) = each.lost, divmod(each.row, agents)
            cause = None if lost is None else LossCause(lost.why, round(lost.time, 9))
            viable = bool(runs.viable[each.row])
            broken.append(BrokenRun(seeds[seed], agent, not viable, dict(each.rules), cause))
        return cls(
            *(rows, obeyed, None if runs.safe is None else int(runs.safe.sum())),
            undecided=rows - obeyed - len(runs.broken),
            lost=int((~runs.viable).sum()),
            told=sum(each.lost is not None and each.lost.why == "told" for each in runs.broken),
            rules={
                name: RuleCounts(*(int((statuses == word).sum()) for word in words))
                for name, statuses in runs.rules.items()
            },
            broken=broken,
        )
