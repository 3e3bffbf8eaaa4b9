"""`stlc simulate`: closed-loop runs of a trained policy in its world (simulated environment)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from stlc.activity import PULSE
from stlc.assurance.options import SimulateOptions
from stlc.cli.framework.options import FailUnderOption, JsonOption, RunArgument, require_separate
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.jsontext import plain

if TYPE_CHECKING:
    from collections.abc import Callable

    from stlc.assurance.plant_judge import PlantSimulation
    from stlc.assurance.simulated import Simulation
    from stlc.controller.problem.task import Task
    from stlc.controller.run.run import Run

OPTIONS = SimulateOptions()


@dataclass(frozen=True, slots=True)
class Screen:
    """Options on what the command shows.

    Attributes:
        live: Show margins and decisions during the simulation.
        robustness (FILE): Write robustness margins to FILE, a JSON object per agent and step; `-` prints
            them.
        windows: Also show results on plans and planning windows, such as plan accuracy.
        window: Show robots in PyBullet's window, too.
    """

    live: bool = False
    robustness: str | None = None
    windows: bool = False
    window: bool = False


SCREEN = Screen()


@command(
    "stlc simulate --backup",
    "stlc simulate latest --backup --seeds 0..19 --record trace.npz",
    "stlc simulate specs/ship_track.stl --backup --scenario all",
    "stlc simulate --backup --seeds 0 --live --robustness robustness.jsonl",
    "stlc simulate fall.stl --plant ball.yaml --seeds 0..19",
    drives=True,
)
def simulate(
    run: RunArgument = "latest",
    options: SimulateOptions = OPTIONS,
    screen: Screen = SCREEN,
    fail_under: FailUnderOption = None,
    json: JsonOption = False,
) -> Answer[Simulation | PlantSimulation]:
    """Deploy a trained policy in the world of its system.

    RUN is by default the newest run. With --method, a planner controls the system: without training, if RUN
    is a specification, else beside the policy of the run, in the same table. With --backup, the backup policy
    of Meng and Fan (2023) guards the policy. For comparison, the same seeds are simulated without it, too.
    Trace, scene and figures are written to the run's folder. A drive is the closed-loop run of one agent with
    one seed. Drives are judged by the specification that the system file names (key `judge` of its section
    `test`). Means over seeds have 95 % intervals (Student's t). Every system has the scenarios mismatch,
    disturb and noise. A number sets their strength in percent, as in mismatch-20. --scenario disturbed runs
    all of them. With --plant, RUN is a specification and FILE a plant file (docs/plants.md): a black box is
    simulated in processes of its own, at --from or at a random point for each seed, and each trace is judged.
    The command measures: its exit code is 0 whatever the drives satisfy, or with --fail-under 1 if fewer do;
    and 1 if a plant gives no trace. With --pictures an animation and the report are drawn, which
    can take longer than the simulation; `stlc report` draws the report later.
    """
    read = (run, options.plant, options.system)
    require_separate([("--record", options.record), ("--robustness", screen.robustness)], read)
    if options.plant is not None:
        from stlc.assurance.plant_runs import plant_simulation
        from stlc.cli.commands.simulate import plant

        seen = plant_simulation(run, options)
        return Answer(
            seen, lambda: plant.show(seen, run, options.overrides), plant.exit_code(seen, fail_under)
        )
    from stlc.assurance.simulated import simulation
    from stlc.cli.commands.certify.text import bounds_lines, require_claim
    from stlc.cli.commands.simulate import text
    from stlc.cli.commands.simulate.watch import Watching, require_writable
    from stlc.view.simulated import pictures

    printed = _printed(json=json, margins=screen.robustness)
    require_writable(screen.robustness)
    require_claim(options.certify, fail_under)
    check = _require_robots if screen.window else None
    opened, found = simulation(run, options, Watching(screen.live, screen.robustness, check).of)
    guard = options.guarded
    if not json:  # before the pictures, so that they do not affect the measurements
        record: Any = plain(found)
        for line in text.screen(record, windows=screen.windows):
            printed(line)
        for name, each in zip(("", *found.scenarios), found.under(guard), strict=True):
            if each.assurance is not None:
                for line in (f"\n  {name}" if name else "", *bounds_lines(each.assurance)):
                    printed(line)
    drawn = pictures(opened) if options.pictures else {}

    def show() -> None:
        # external functions are not stored in traces: judging needs the system file
        needed = f"{opened.dir.shown}/system.yaml" if opened.task.system.decl.functions else None
        for line in text.closing(found.trace, drawn, options.record, needed):
            printed(line)
        if screen.window:
            _show_robots(opened)

    code = int(fail_under is not None and found.satisfied(guard) < fail_under)
    if options.certify is not None:
        code = {"certified": 0, "refuted": 1}.get(found.answer(guard), 4)
    return Answer(replace(found, **drawn), show, code)


def _printed(*, json: bool, margins: str | None) -> Callable[[str], None]:
    """Function that prints text to the standard output, or to stderr if `--robustness -` occupies it.

    Raises UsageError (U101) if `--json` and `--robustness -` are combined.
    """
    from stlc.cli.commands.simulate.watch import STANDARD_OUTPUT

    if margins != STANDARD_OUTPUT:
        return emit
    if json:
        message = "`--json` and `--robustness -` both want the standard output"
        raise usage(message, "--robustness robustness.jsonl")
    return say


def _require_robots(task: Task) -> None:
    """Raise an error before the simulation if the world has no robots or no window can be opened.

    Raises:
        UsageError: U101, the run's world has no robots.
        MissingError: R301, PyBullet is not installed; R302, there is no display.
    """
    from stlc.controller.stage import Staged
    from stlc.controller.world import world_type
    from stlc.view.bullet import require_window

    if not isinstance(world_type(task.system.decl), Staged):
        message = f"`--window` shows robots, and `{task.system.decl.name}` has none"
        raise usage(message)
    require_window()


def _show_robots(run: Run) -> None:
    """Play the newest deployment in PyBullet's window."""
    from stlc.view import bullet
    from stlc.view.run_animation import recorded_scene

    seen = recorded_scene(run.dir)
    stage = None if seen is None else seen.stage
    if seen is not None and stage is not None:
        with PULSE.doing(""):
            bullet.show(stage, seen.scene, seen.dt)
