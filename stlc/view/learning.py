"""Verdict on a training run: how many drives obey, why the others fail, and advice.

A drive is the closed-loop run of one agent from a start of the mission. The module makes numbers and
sentences only, no pictures. The terminal, the JSON output and the report all show this verdict.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np

from stlc.controller.guard.kind import named_guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.diagnostics import StlcError
from stlc.dynamics.load import load_system_decl
from stlc.escape import operand, shell
from stlc.registry import GUARDS
from stlc.rundir import RunDir
from stlc.signature import Signature
from stlc.view.held_out import HeldOut, load_held_out
from stlc.view.words import seconds as duration
from stlc.view.words import share

Level: TypeAlias = Literal[
    "infeasible", "no plan known", "not driven", "undertrained", "partly trained", "trained"
]

UNDERTRAINED, TRAINED = 0.5, 0.9
"""Shares of drives that obey: undertrained below the first, trained from the second."""
SOLVED = 0.95
"""Share of feasible starts that a policy solves which a learning curve is extrapolated to."""
LISTED = 3
"""Maximum number of violated requirements that are listed."""
MUCH_INFEASIBLE = 0.5
"""Share of starts without a known plan from which on infeasibility is reported first."""
LEAST_ROUNDS = 5
"""Minimum number of search rounds for an extrapolation of a learning curve."""
FLAT = 0.1
"""Growth of the log-odds per doubling of the steps below which a learning curve is flat."""
MOST_TIMES = 32.0
"""Largest factor by which the number of steps is extrapolated."""
ROUND_TIMES = (10.0, 20.0, 30.0, 60.0, 120.0, 180.0, 300.0, 600.0, 900.0, 1200.0, 1800.0, 3600.0)
"""Budgets to propose, in seconds; larger ones are multiples of an hour."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Extrapolation of a learning curve.

    Attributes:
        state: `short`: there were too few search rounds for an extrapolation; `flat`: twice as many steps
            would change little; `rising`: more steps would help.
        times: factor by which the number of steps must grow so that the policy solves the share `SOLVED` of
            the feasible starts. The factor assumes that the slope of the curve stays the same. Since curves
            flatten, the forecast is a range from this factor to its square. None if the factor exceeds
            `MOST_TIMES`, or if the curve is not rising.
    """

    state: Literal["short", "flat", "rising"]
    times: float | None = None


@dataclass(frozen=True, slots=True)
class Learning:
    """Verdict on a training run: how well the policy has learned, and what to do next.

    Attributes:
        level: `trained`, `partly trained` or `undertrained`, by the share of drives that obey; `not driven`
            if there were none; `no plan known` or `infeasible` without a satisfying plan from any start.
        share: share of the feasible starts that the policy solves. A start is feasible if a satisfying plan
            from it is known. None if no start is feasible.
        sentence: share of drives that obey, and share of starts with a satisfying plan, as a sentence.
        advice: sentences of advice.
        command: the command to run next.
        worst: the worst requirement and the region where it fails, as a sentence; "" if none fails.
    """

    JSON: ClassVar = "level sentence advice worst share_of_feasible=share next=command"

    level: Level
    share: float | None
    sentence: str
    advice: tuple[str, ...]
    command: str
    worst: str = ""


EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Commands:
    """Command lines for one run that a verdict may recommend.

    Attributes:
        train_on: resumes the training run. The option `--budget` is still missing; the caller appends it.
        simulate: simulates the policy under the recommended guard.
        report: writes the report.
        afresh: trains for the same specification and system; options may be appended.
        search: simulates a planner as controller of the same system; options may be appended.
    """

    train_on: str
    simulate: str
    report: str
    afresh: str = "stlc train SPEC"
    search: str = "stlc simulate SPEC --method search"

    @classmethod
    def of(
        cls,
        run: str,
        record: Mapping[str, Any] = EMPTY,
        *,
        newest: bool = False,
        start: str = "stlc",
    ) -> Commands:
        """Return the commands for the run named `run`.

        Args:
            run: name of the run.
            record: content of its `run.json`.
            newest: whether it is the newest run. The command `simulate` then omits its name.
            start: program that the training command begins with.
        """
        run = shell((operand(run),))
        option = named_guard(recommended(record)).option
        simulate = " ".join(filter(None, ("stlc simulate", "" if newest else run, option)))
        spec = shell((operand(str(record.get("spec_path") or "SPEC")),))
        system = shell(("--system", str(record["system_path"]))) if record.get("system_path") else ""
        given = " ".join(filter(None, (spec, system)))
        return cls(
            f"{start} train --resume {run}",
            simulate,
            f"stlc report {run}",
            f"{start} train {given}",
            f"stlc simulate {given} --method search",
        )


def recommended(record: Mapping[str, Any]) -> str:
    """Name of the guard that `run.json` recommends; of the paper's if there are no closed-loop results."""
    result = record.get("result")
    driven = result.get("closed_loop") if isinstance(result, Mapping) else None
    guard = driven.get("recommended") if isinstance(driven, Mapping) else None
    return str(guard) if guard in GUARDS else PAPER.name


def driven_lines(result: Mapping[str, Any]) -> list[str]:
    """Lines on the closed-loop results of a run: one line per guard, then the recommended guard.

    The best guard comes first. All lines count drives from the same initial states; guards are compared only
    then. The list is empty if `result` contains no closed-loop results. If no simulation was possible, the
    only line states the reason.
    """
    found = result.get("closed_loop")
    if not isinstance(found, Mapping):
        return []
    try:
        guards = [each for each in found.get("guards") or () if isinstance(each, Mapping)]
        if not guards:
            why = found.get("why") or "no drive ended within the time limit"
            return [f"not driven: {why}"]
        best = found.get("recommended")
        first = sorted(guards, key=lambda each: each.get("guard") != best)
        lines = [_driven_line(each) for each in first]
        left_out = [named_guard(name).noun for name in found.get("left_out") or ()]
        if left_out:
            lines.append(f"too few drives in the time to compare {' and '.join(left_out)}")
        if len({each["drives"] for each in guards}) > 1:
            return lines  # a record of an older version, which counted different starts
        acting = [each for each in first if named_guard(each["guard"]).intervenes]
        if len(acting) < len(guards):
            lines += map(_changed_line, acting)
        if best in GUARDS:
            guard = named_guard(best)
            command = f"stlc simulate {guard.option}".rstrip()
            better = max(each["share"] for each in guards) > first[0]["share"]
            why = ", the cheapest within 2 % of the best" if better else ""
            lines.append(f"recommended after these drives: {guard.noun} (`{command}`){why}")
        return lines
    except (KeyError, TypeError, ValueError):  # a damaged or foreign record
        return []


def _driven_line(each: Mapping[str, Any]) -> str:
    """Line on the closed-loop runs (drives) under one guard; `each` contains their results.

    Example: "0 of 20 drives obeyed without a guard: `set_down` (30 s); 95 % interval 0.0 to 16.1 %". A number
    of drives is given with a requirement that not all failed drives violate.
    """
    low, high = each["interval"]
    failed, violated = each["drives"] - each["satisfied"], each.get("broken") or ()
    names = []
    for found in violated[:LISTED]:
        time = "" if found["seconds"] is None else duration(found["seconds"])
        many = "" if found["drives"] == failed else f"{found['drives']:,} drives"
        told = ", ".join(filter(None, (many, time)))
        names.append(f"`{found['requirement']}`" + (f" ({told})" if told else ""))
    more = f" and {len(violated) - LISTED} more" if len(violated) > LISTED else ""
    listed = f": {', '.join(names)}{more}" if names else ""
    safe = "" if each.get("safe") is None else f", {share(each['safe'])} safe"
    count = f"{each['satisfied']:,} of {each['drives']:,} drives obeyed {named_guard(each['guard']).beside}"
    return f"{count}{listed}; 95 % interval {100 * low:.1f} to {share(high)}{safe}"


def _changed_line(each: Mapping[str, Any]) -> str:
    """Line on the verdicts that a guard changes: drives that are satisfied only with it, or only without."""
    changed, noun = each["gained"] + each["lost"], named_guard(each["guard"]).noun
    if not changed:
        return f"{noun} changes no verdict"
    return (
        f"{noun} changes the verdicts of {changed:,} of {each['drives']:,} drives: "
        f"{each['gained']:,} obey only with it, {each['lost']:,} only without"
    )


def learning_of_run(run: RunDir, commands: Commands) -> Learning | None:
    """The verdict on a training run; None if the run is not finished.

    Raises:
        RunError: R101, `run.json` is damaged.
    """
    try:
        signature = load_system_decl(run.source(RunDir.SYSTEM)).signature
    except StlcError:
        signature = None
    return learning_on_record(run.record(), run.rows(), commands, clause(load_held_out(run), signature))


def learning_on_record(
    record: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], commands: Commands, where: str
) -> Learning | None:
    """The verdict on a training run, from the contents of `run.json` and `train.jsonl`.

    None if the run is not finished. `where` is a clause on the region in which the worst requirement fails,
    or "".
    """
    result = record.get("result")
    if not isinstance(result, Mapping) or result.get("accuracy") is None or result.get("feasible") is None:
        return None
    return learning_of(result, rows, commands, where)


def clause(held: HeldOut | None, signature: Signature | None) -> str:
    """Clause on the region in which the worst requirement fails; "" if none fails."""
    if held is None or (weakness := held.weakness()) is None:
        return ""
    return weakness.text(held, signature)


def learning_of(
    result: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], commands: Commands, where: str = ""
) -> Learning:
    """The verdict on a finished training run.

    Args:
        result: the result in `run.json`: `accuracy`, `feasible`, `requirements`, `seconds`.
        rows: lines of `train.jsonl`.
        commands: commands that may be recommended.
        where: region where the worst requirement fails, as a clause ("fails in …"), or "".
    """
    accuracy, feasible = float(result["accuracy"]), float(result["feasible"])
    if feasible <= 0.0:
        return _without_plan(commands, proved=bool(result.get("proved")))
    part, drives = min(accuracy / feasible, 1.0), best_drives(result)
    searched, held_out = int(result.get("searched") or 0), int(result.get("held_out") or 0)
    sampled = 0 < searched < held_out
    estimate = f", by an estimate from {searched:,} of the {held_out:,} starts" if sampled else ""
    sentence = (
        f"the policy's plan satisfies the specification from {share(accuracy)} of the starts; a satisfying "
        f"plan is known for {share(feasible)}{estimate}"
    )
    worst, hard = _worst(result, where), _hard_starts(feasible, sampled=sampled)
    learnt = min(
        [accuracy, *[float(row["accuracy"]) for row in rows[-1:] if row.get("accuracy") is not None]]
    )
    longer = _longer(forecast(rows, learnt, feasible), float(result.get("seconds") or 0.0), commands)
    if drives is None:
        advice = (longer[0], *hard) if part < SOLVED else hard
        return Learning("not driven", part, sentence, advice, commands.simulate, worst)
    obeyed = float(drives["share"])
    level: Level = (
        "trained" if obeyed >= TRAINED else "partly trained" if obeyed >= UNDERTRAINED else "undertrained"
    )
    count = f"{drives['satisfied']:,} of {drives['drives']:,} drives obeyed"
    sentence = f"{count} {named_guard(drives['guard']).beside}; {sentence}"
    if level == "trained":
        return Learning(level, part, sentence, hard, commands.simulate, worst)
    told, command = _told(drives, result["closed_loop"], commands)
    if not command:
        told, command = f"{told}; {longer[0]}" if told else longer[0], longer[1] or commands.search
    planner = f"a planner as controller, which needs no training: `{commands.search}`"
    others = hard if commands.search in told else (*hard, planner)
    command = commands.simulate if level == "partly trained" else command
    return Learning(level, part, sentence, (told, *others), command, worst)


def _without_plan(commands: Commands, *, proved: bool) -> Learning:
    looser = "a looser specification, a longer horizon, or another initial set"
    if proved:
        sentence = "no plan satisfies the specification: bounds of what the controls can do prove it"
        advice = f"{looser}: more training cannot help"
        return Learning("infeasible", None, sentence, (advice,), commands.report)
    sentence = "neither the policy nor search found a satisfying plan for any start"
    longer = f"a longer search may find plans: `{commands.search}`"
    return Learning("no plan known", None, sentence, (longer, f"else {looser}"), commands.search)


def best_drives(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Results of the drives under the recommended guard, or the guard that does best; None without drives."""
    found = result.get("closed_loop")
    guards = found.get("guards") if isinstance(found, Mapping) else None
    if not isinstance(found, Mapping) or not guards:
        return None
    best: Mapping[str, Any] = max(
        guards, key=lambda each: (each["guard"] == found.get("recommended"), each["share"])
    )
    return best


def _told(drives: Mapping[str, Any], found: Mapping[str, Any], commands: Commands) -> tuple[str, str]:
    """Return the most frequent cause of failed drives with a remedy, and the command for it.

    The command is "" if longer training is the remedy. Both are "" if no cause was determined.

    Args:
        drives: results under one guard.
        found: results of all drives.
        commands: commands that may be recommended.
    """
    causes: Mapping[str, int] = drives.get("causes") or {}
    cause = max(causes, key=causes.__getitem__, default="")
    if cause not in _CAUSES:
        return "", ""
    said, remedy, command = _CAUSES[cause]
    if cause == "later" and (found.get("plan_seconds") or 0.0) >= (found.get("seconds") or 0.0):
        remedy, command = _ASK, "{search}"  # plans reach to the end already
    first = (drives.get("broken") or [{"requirement": "it"}])[0]
    due = f"is due at {duration(first['due'])}" if first.get("due") else "asks for more"
    facts = {"name": f"`{first['requirement']}`", "due": due, "whole": f"{found.get('seconds') or 0:g}s"}
    command = command.format(**asdict(commands), **facts)
    remedy = remedy.format(command=command, reach=duration(found.get("plan_seconds")), **facts)
    of = f"{causes[cause]:,} of {sum(causes.values()):,} failed drives that were examined"
    return f"in {of}, {said}{remedy}", command


_ASK = "; ask for less of {name}, allow more time or control, or search for longer: `{command}`"
_CAUSES: Mapping[str, tuple[str, str, str]] = {
    "start": ("no satisfying plan is known from the start", _ASK, "{search}"),
    "told": (
        "a satisfying plan was followed until the world did what no plan foresees",
        "; states after such events are trained on by `{command}`",
        "{afresh} --falsify",
    ),
    "later": (
        "a satisfying plan was followed until none was known, although nothing unforeseen happened",
        "; plans end after {reach}, {name} {due}: `{command}` plans to the end of the drive",
        "{search} --set time.horizon={whole}",
    ),
    "near": ("the best known plans miss by little", _ASK, "{search}"),
    "missed": ("a satisfying plan is known that the policy did not propose", "", ""),
    "rules": (
        "the plans satisfied their specification to the end, and the rules of the drives ask for more",
        "; the specification of the plans should ask for {name} too",
        "{report}",
    ),
}
"""Cause of a failed drive -> the same in words, remedy, and command, with the facts that fill them.

The causes are those of `stlc.controller.evaluation.causes.Cause`.
"""


def forecast(rows: Sequence[Mapping[str, Any]], accuracy: float, feasible: float) -> Curve:
    """Extrapolate the learning curve of plan accuracy beyond the end of a training run.

    The success rate p is the accuracy divided by `feasible`. A line is fitted to the log-odds of p, log(p /
    (1 - p)), over the logarithm of the step. The first quarter of the steps is left out. The line is then
    continued from the final accuracy. The forecast is rough, as the learning rate decays at the end of every
    training run.

    Args:
        rows: lines of `train.jsonl`.
        accuracy: final share of starts from which the policy's plan satisfies the specification.
        feasible: share of starts from which a satisfying plan is known, which the accuracy cannot exceed.
    """
    pairs = [
        (float(row["step"]), float(row["accuracy"]) / feasible)
        for row in rows
        if row.get("accuracy") is not None and row.get("step")
    ]
    late = [(math.log2(step), _log_odds(value)) for step, value in pairs if 4.0 * step >= pairs[-1][0]]
    if len(late) < LEAST_ROUNDS:
        return Curve("short")
    doublings, odds = np.array(late).T
    (growth, _), covariance = np.polyfit(doublings, odds, 1, cov=True)
    if growth - math.sqrt(covariance[0, 0]) < FLAT:
        return Curve("flat")
    times = 2.0 ** min((_log_odds(SOLVED) - _log_odds(accuracy / feasible)) / growth, 60.0)
    return Curve("rising", times if times <= MOST_TIMES else None)


def _log_odds(value: float) -> float:
    bounded = min(max(value, 0.001), 0.999)
    return math.log(bounded / (1.0 - bounded))


def _longer(curve: Curve, seconds: float, commands: Commands) -> tuple[str, str]:
    """Return advice on training for longer, and the command that does so.

    The command is "" if longer training would not help.
    """
    twice = f"{commands.train_on} --budget {budget_text(max(seconds, 10.0))}"
    match curve.state, curve.times:
        case "rising", float(times):
            late = min(times * times, MOST_TIMES)
            command = f"{commands.train_on} --budget {budget_text(max((late - 1.0) * seconds, 10.0))}"
            about = f"{duration(_rough(times * seconds))} to {duration(_rough(late * seconds))}"
            text = f"a longer budget: the curve is rising, and points to {share(SOLVED, 0)} of what is known"
            return f"{text} to be feasible after {about} in all (a rough figure): `{command}`", command
        case "rising", _:
            text = "a much longer budget: the curve is rising, but too slowly for a forecast of the time"
            return f"{text}: `{twice}`", twice
        case "flat", _:
            text = "a longer budget alone promises little, the curve is flat: let the policy see what decides"
            return f"{text} (`policy: {{observe: …}}`), or look at where it fails: `{commands.report}`", ""
    text = f"a longer budget: {LEAST_ROUNDS} search rounds are needed to say how long, and there were fewer"
    enough = f"{commands.train_on} --budget {budget_text(max(seconds, 60.0))}"
    return f"{text}: `{enough}`", enough


def _worst(result: Mapping[str, Any], where: str) -> str:
    shares: Mapping[str, float] = result.get("requirements") or {}
    if not shares or min(shares.values()) >= 1.0:
        return ""
    worst = min(shares, key=shares.__getitem__)
    there = f": it {where}" if where else ""
    return f"the worst requirement is {worst}, {share(shares[worst])} satisfied{there}"


def _hard_starts(feasible: float, *, sampled: bool) -> tuple[str, ...]:
    if feasible > MUCH_INFEASIBLE:
        return ()
    starts = f"{'about ' if sampled else ''}{share(1.0 - feasible)} of the starts"
    return (
        f"for {starts} search found no satisfying plan either; where there is none, only a narrower `init`, "
        "a longer `horizon` or later deadlines help",
    )


def _rough(seconds: float) -> float:
    """Round a duration to one significant digit, or to two digits if the first digit is 1."""
    digits = math.floor(math.log10(max(seconds, 1.0)))
    step = 10.0**digits if seconds >= 2.0 * 10.0**digits else 10.0 ** (digits - 1)
    return float(round(max(seconds, 1.0) / step)) * step


def budget_text(seconds: float) -> str:
    """Return a usual training budget for `seconds`, such as `60s`, `5min` or `2h`.

    It is the smallest of the usual budgets that is not clearly less than `seconds`.
    """
    fitting = [time for time in ROUND_TIMES if time >= 0.95 * seconds]
    time = fitting[0] if fitting else 3600.0 * math.ceil(0.95 * seconds / 3600.0)
    if time < 120.0:
        return f"{time:.0f}s"
    return f"{time / 60.0:.0f}min" if time < 3600.0 else f"{time / 3600.0:.0f}h"
