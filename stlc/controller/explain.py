"""Explanations: of codes, topics and specifications in words, of violations, and of a backup policy."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from stlc.diagnostics import CODES, usage
from stlc.files import File
from stlc.grammar.manual import CodeList, Page, SpecInWords
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from stlc.controller.guard.coverage import Guarantee
    from stlc.controller.run.run import Run
    from stlc.monitor.explain.tree import Explanation
    from stlc.monitor.judgement import Verdict

_CODE = re.compile(r"[A-Za-z]\d{3}")
_TOPICS = ("precedence",)
Explained: TypeAlias = "CodeList | Page | SpecInWords | Explanation | Guarantee"


def explain(
    what: str | Path | Spec | Verdict | Run | None = None,
    *,
    require: tuple[str, ...] = (),
    guarantee: bool = False,
    runs: Path = RunDir.RUNS,
    **options: Any,
) -> Explained:
    """Explain a code, a specification, the violations of a recording, or the backup policy of a run.

    Args:
        what: a code such as `E203`, or `precedence`; a specification or its file; a verdict, a trace file, or
            a run with a trace. None: all codes.
        require: names of the requirements to explain; all if empty.
        guarantee: whether `what` is a run, of whose backup policy lower bounds on the probability are given
            that it finds a plan that satisfies the specification (Theorem 1 of Meng and Fan 2023, and exact).
        runs: folder of all runs.
        options: fields of `stlc.monitor.check.Question`, such as `at` and `spec`, with which a trace is
            judged.

    Raises:
        UsageError: U101, there is no such code; U102, there is no such file.
        StlcError: a file is invalid.
    """
    if guarantee:
        from stlc.controller.guard.coverage import guarantee as bounds
        from stlc.controller.run.run import Run

        run: Any = what or "latest"
        folder = Run.folder(run, runs)
        return bounds(folder.name, Run.task_in(folder, options.get("overrides")))
    if what is None:
        return CodeList(dict(CODES))
    if isinstance(what, Spec):
        return SpecInWords.of(what, what.source.name, require)
    if not isinstance(what, str | Path):
        from stlc.monitor.explain.tree import explanation
        from stlc.monitor.judgement import Verdict

        if isinstance(what, Verdict):
            return explanation(what)
        what = what.dir.path
    name = str(what)
    if _CODE.fullmatch(name) or name in _TOPICS:
        page = Page.read(name if name in _TOPICS else name.upper())
        if page is None:
            missing = usage(f"there is no code `{name.upper()}`")
            raise missing.near(name.upper(), CODES, "stlc explain  lists the codes")
        return page
    if name == File.STDIN or File(name).is_spec:
        return SpecInWords.of(Spec.load(name), name, require)
    from stlc.monitor.check import Question, judge
    from stlc.monitor.explain.tree import explanation

    path = File(name if File(name).is_pattern else str(RunDir.recorded_trace(name, runs))).seen(runs)
    verdicts = judge(path, Question(require=require, **options))
    return explanation(next((each for each in verdicts if each.causes), verdicts[0]))  # the first violation
