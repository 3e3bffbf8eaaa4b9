"""Text output of `stlc simulate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from stlc.controller.guard.kind import named_guard
from stlc.escape import operand, shell, visible
from stlc.view.words import cause_words, listing, satisfied_sentence, seconds, viable_sentence

Record: TypeAlias = "Mapping[str, Any]"

MOST_LISTED = 12
MOST_BROKEN = 6
"""Maximum number of listed drives that violate requirements."""
ERRORS = {
    "actuator_gain": "wrong: gains of actuators",
    "parameters": "wrong: numbers of the dynamics",
    "actuator_noise": "noise: what actuators give",
    "sensor_noise": "noise: what agents see",
}
"""Model errors of a scenario, in words."""


def screen(document: Record, *, windows: bool = False) -> Iterator[str]:
    """Lines of text that show the results of a simulation, whose record is `document`.

    These are results on drives (closed-loop runs). Results on plans and planning windows, such as the share
    of satisfying plans, are shown if `windows` is True.
    """
    from stlc.cli.framework.output import table

    guards = document["guards"]
    seeds, agents, steps = len(document["seeds"]), document["agents"], document["steps"]
    size = f"{seeds} seed{'s' * (seeds > 1)} x {agents} agents x {steps} steps"
    world = document["world"] or f"{document['system']} and its events"
    scenario = [f"scenario {document['scenario']}"] if document["scenario"] else []
    yield visible(" · ".join((document["spec"], f"run {document['run']}", f"world {world}", *scenario, size)))
    known = {"savable": "a safe plan", "feasible": "a plan that satisfies everything"}.get(document["starts"])
    if known:
        yield f"  starts from which {known} is known; {document['redrawn']:,} others were drawn again"
    yield from _wrong(document.get("errors", {}))
    if document.get("margin"):
        margins = ", ".join(f"{name} {margin:.3g}" for name, margin in document["margin"].items())
        yield f"  robustness margins of the guard: {margins}"
    yield ""
    yield from _drives(document)
    planners = document.get("planners", {})
    header = ("", *(named_guard(name).title for name in guards), *(f"planner {name}" for name in planners))
    columns = {**guards, **planners}
    shares = _shares(columns, safe=bool(document.get("safety", True))) if windows else ()
    yield table([*_counts(columns), *_progress(columns), *_times(columns), *shares], header=header)
    for name, guard in guards.items():
        if named_guard(name).intervenes:
            yield f"  guard acted in {_acted(guard['decisions'])}"
    name, last = list(guards.items())[-1]
    yield from _broken(name, last["drives"], judged="" if document["judge"] else "judged from ")
    if windows and document.get("safety", True):
        yield f"  {_unsafe(last['unsafe'], seeds * agents)}"
    foreseen = last["metrics"].get("foreseen") if windows else None
    if foreseen and (mean := foreseen["mean"]) > 0:
        beyond = "; the others contain exogenous events" if mean < 1 else ""
        part = f"the {_part(mean)} of starts from which the world did as the model says"
        yield f"  model-consistent: {part}{beyond}"
    if document.get("scenarios"):
        yield from compared(document, windows=windows)


def _drives(document: Record) -> Iterator[str]:
    """Lines with the verdict on the drives (closed-loop runs), and with the number of drives that are lost.

    A drive is lost if no satisfying plan was known at its start, or after an exogenous event.
    """
    yield f"  {satisfied_sentence(document)}"
    lost = viable_sentence(document)
    if lost:
        yield f"  {lost}"
    judge = document["judge"]
    if judge is None:
        yield f"  judged as plans are; {document['system']} has no rules for drives (test: judge)"
    else:
        yield f"  judged by {judge['path']}"


def _counts(guards: Mapping[str, Record]) -> Iterator[tuple[str, ...]]:
    """Table rows with one cell per guard, such as `37 of 40`: the drives that satisfy each requirement.

    Two more rows count the drives that satisfy all requirements, and all that are tagged `@safety`.
    """
    each = [guard["drives"] for guard in guards.values()]
    for name in each[-1]["rules"]:
        yield (name, *(f"{drives['rules'][name]['obeyed']} of {drives['count']}" for drives in each))
    for label, key in (("satisfied", "obeyed"), ("safe", "safe")):
        if all(drives[key] is not None for drives in each):
            yield (label, *(f"{drives[key]} of {drives['count']}" for drives in each))


def _broken(guard: str, drives: Record, judged: str) -> Iterator[str]:
    """Lines on the drives under a guard that violate a requirement.

    An example is `violated with the full guard: seed 3, agent 7: full_stop (4.3 s)`. A drive is the
    closed-loop run of one agent with one seed. Only the first few drives are listed. Viable drives, for which
    a satisfying plan was known, come first. `judged` stands before times.
    """
    violated = f"  violated {named_guard(guard).beside}"
    for each in sorted(drives["broken"], key=lambda each: each["lost"])[:MOST_BROKEN]:
        rules = ", ".join(
            name if time is None else f"{name} ({judged}{time:.3g} s)" for name, time in each["rules"].items()
        )
        cause = cause_words(each)
        yield f"{violated}: seed {each['seed']}, agent {each['agent']}: {rules}{cause and f'; {cause}'}"
    more = len(drives["broken"]) - MOST_BROKEN
    if more > 0:
        yield f"{violated}: {more} more, see eval/simulate.json"


def _wrong(errors: Mapping[str, Any]) -> Iterator[str]:
    """Lines on the model errors that the scenario introduces, one line per kind of error."""
    for name, what in ERRORS.items():
        if name in errors:
            numbers = listing(errors.get("numbers", ())) if name == "parameters" else ""
            if name != "parameters" or numbers:
                yield f"  {what} by {100 * errors[name]:.3g} %{numbers and f': {numbers}'}"
    if errors.get("exact"):
        yield f"  exact, as conditions or limits read them: {listing(errors['exact'])}"


def compared(document: Record, *, windows: bool = False) -> Iterator[str]:
    """Lines of a table that compares all scenarios, one row per scenario.

    Each row has a cell per guard: the number of drives (closed-loop runs) that satisfy every requirement. If
    `windows` is True, each guard has a second cell: the share of plans that satisfy the specification.
    """
    from stlc.cli.framework.output import table

    guards = list(document["guards"])
    labels = ["satisfied", *(["plan accuracy"] if windows else [])]
    header = ("scenario", *(f"{named_guard(name).title}: {label}" for name in guards for label in labels))
    rows = []
    for name, each in {"none": document, **document["scenarios"]}.items():
        cells: list[str] = []
        for guard in guards:
            found = each["guards"].get(guard)
            if found is None:
                cells += [""] * len(labels)
                continue
            cells.append(f"{found['drives']['obeyed']} of {found['drives']['count']}")
            cells += [_number(found["metrics"]["plan_accuracy"], "", 3)] if windows else []
        rows.append((name, *cells))
    yield ""
    yield table(rows, header=header)


def closing(trace: str, drawn: Mapping[str, str], record: Path | None, system: str | None) -> Iterator[str]:
    """Lines with the paths of the results; the last line is the command to run next.

    Args:
        trace: path of the recorded trace.
        drawn: kind of picture -> path.
        record: file of `--record`, if given.
        system: system file that the next command names; None if it is not needed.
    """
    from stlc.files import File

    yield ""
    yield f"  trace      {visible(trace)}"
    for what, path in drawn.items():
        yield f"  {what:<10} {visible(path)}"
    if not drawn:
        yield f"  pictures   {shell(('stlc', 'report', operand(str(Path(trace).parent))))}"
    found = (
        File("trace.npz").trace()
        if Path("trace.npz").exists() or Path("runs/latest/trace.npz").exists()
        else None
    )
    short = found is not None and found.resolve() == Path(trace).resolve()
    judged = operand(str(record or ("trace.npz" if short else trace)))
    needed = () if system is None else ("--system", system)
    yield f"  next       {shell(('stlc', 'check', judged, *needed))}"


def _shares(guards: Record, *, safe: bool) -> Iterator[tuple[str, ...]]:
    """Table rows with shares, such as the share of satisfying plans; one column per guard.

    If `safe` is True, rows on the requirements tagged `@safety` are included.
    """
    from stlc.controller.evaluation.metrics import METRICS

    for metric in METRICS.values():
        found = [guard["metrics"].get(metric.key) for guard in guards.values()]
        if any(found) and (safe or not metric.safety):
            yield (metric.label, *("" if each is None else _number(each, "", 3) for each in found))


def _progress(guards: Record) -> Iterator[tuple[str, ...]]:
    """Table rows with the metrics of the simulated system, such as a mean speed; one column per guard."""
    from stlc.controller.evaluation.metrics import is_progress

    first = next(iter(guards.values()))
    for name in filter(is_progress, first["metrics"]):
        unit = first["units"].get(name, "")
        yield (
            name.replace("_", " "),
            *(_number(guard["metrics"][name], unit, 2) for guard in guards.values()),
        )


def _times(guards: Record) -> Iterator[tuple[str, ...]]:
    """Table rows with the times of decisions, and of the searches of a planner, which have a budget."""
    for label, name in (("decision, median", "median"), ("decision, 99 %", "p99")):
        yield (label, *(seconds(guard["latency"][name]) for guard in guards.values()))
    uses = [guard.get("search") for guard in guards.values()]
    rows: dict[str, Callable[[Record], str]] = {
        "search, budget": lambda use: seconds(use["budget"]),
        "search, median": lambda use: seconds(use["median"]),
        "search, 99 %": lambda use: seconds(use["p99"]),
        "unused, median": lambda use: _part(max(0.0, 1.0 - use["median"] / use["budget"])),
        "ended early": lambda use: _part(use["early"]),
    }
    for label, text in rows.items() if any(uses) else ():
        yield (label, *("" if use is None else text(use) for use in uses))


def _number(metric: Record, unit: str, digits: int) -> str:
    """Text of a mean and of the half-width of its 95 % interval: `0.957 ± 0.012`, `4.10 ± 0.20 m/s`.

    Without an interval only the mean is shown. `digits` is the number of decimals.
    """
    mean, high = metric["mean"], metric["high"]
    text = f"{mean:.{digits}f}" if high is None else f"{mean:.{digits}f} ± {high - mean:.{digits}f}"
    return f"{text} {unit}".rstrip()


def _unsafe(unsafe: Sequence[Record], agents: int) -> str:
    """Text on the agents whose closed-loop runs violated a requirement tagged `@safety`.

    An example is `not driven safely: 9 of 60 agents, of which 1 is viable (seed 2: 7)`. The viable agent is
    agent 7 of seed 2. An agent is viable if a plan that satisfies the safety requirements is known from its
    start.
    """
    if not unsafe:
        return f"all {agents} agents were driven safely"
    lost = [each for each in unsafe if each["savable"]]
    ending = (
        f"{len(lost)} {'is' if len(lost) == 1 else 'are'} viable ({_listed(lost)})"
        if lost
        else "none is viable"
    )
    return f"not driven safely: {len(unsafe)} of {agents} agents, of which {ending}"


def _listed(agents: Sequence[Record]) -> str:
    """Text that lists the first few agents by seed.

    Example: `seed 2: 7, 11; seed 5: 0` for the agents 7 and 11 of seed 2 and the agent 0 of seed 5.
    """
    shown = agents[:MOST_LISTED]
    seeds = dict.fromkeys(each["seed"] for each in shown)
    parts = (
        f"seed {seed}: " + ", ".join(str(each["agent"]) for each in shown if each["seed"] == seed)
        for seed in seeds
    )
    return "; ".join(parts) + ("; …" if len(agents) > MOST_LISTED else "")


def _acted(decisions: Mapping[str, float]) -> str:
    """Text on how often the guard intervened, and by which means.

    An example is `3.1 % of decisions (T0=1 71 %, T0=2 22 %, longest safe prefix 7 %)`. T0=2 means that a
    search chose the first 2 steps of the plan, and the policy chose the rest. "Longest safe prefix" means
    that no satisfying plan was found. The plan that stays safe for longest was then followed.
    """
    total = 1.0 - decisions["policy"]
    if total <= 0.0:
        return "0 % of decisions"
    kinds = {name.removeprefix("backup "): share for name, share in decisions.items() if "T0=" in name}
    kinds |= {"polished": decisions["polished"], "longest safe prefix": decisions["safest"]}
    parts = ", ".join(f"{name} {_part(share / total)}" for name, share in kinds.items() if share)
    return f"{100 * total:.1f} % of decisions ({parts})"


def _part(share: float) -> str:
    """Text of a share in percent; `0 %` is shown only for exactly 0, and `100 %` only for exactly 1."""
    return "< 1 %" if share < 0.005 else "> 99 %" if 0.995 <= share < 1.0 else f"{100 * share:.0f} %"
