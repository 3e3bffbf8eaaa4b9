"""`stlc bench`: the paper's tables made again, one policy for a family, and how fast robustness is."""

from __future__ import annotations

import typer

from stlc.cli.bench.ablation import ablation
from stlc.cli.bench.disturbed import disturbed
from stlc.cli.bench.family import family
from stlc.cli.bench.latency import latency
from stlc.cli.bench.paper import paper
from stlc.cli.bench.polish import polish
from stlc.cli.bench.robustness import robustness
from stlc.cli.bench.step import step
from stlc.cli.bench.worlds import worlds
from stlc.cli.framework.options import describe

_KEPT = (
    "Results that are there are kept if specification, system and engine are still the same; "
    "a training that was cut short goes on where it stopped. Exit code 1 if a training broke off."
)


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    group = typer.Typer(
        name="bench",
        help=describe("Make the figures of the documentation again.", "stlc bench paper"),
        no_args_is_help=True,
        rich_markup_mode=None,
    )
    group.command(
        help=describe(
            "Train and judge the six benchmarks of the paper, and write the tables and curves.",
            "stlc bench paper",
            "stlc bench paper --only traffic,ship_safe --budget 60s --seeds 0 --jobs 2",
            note=_KEPT,
        )
    )(paper)
    group.command(
        help=describe(
            "Repeat the paper's tables for gamma, k, network size and number of samples on traffic.",
            "stlc bench ablation",
            "stlc bench ablation --only gamma,k --budget 60s --seeds 0",
            note=_KEPT,
        )
    )(ablation)
    _register_others(group)
    app.add_typer(group)


def _register_others(group: typer.Typer) -> None:
    group.command(
        help=describe(
            "Train one policy for all values of a parameter, and judge it inside and outside of its range.",
            "stlc bench family",
            "stlc bench family --only stop_time --budget 60s --seeds 0..2 --jobs 2",
            note=_KEPT + " So is a verdict at a value of the parameter.",
        )
    )(family)
    group.command(
        help=describe(
            "Deploy policies in worlds that are not as their model says, without a guard and with one.",
            "stlc bench disturbed",
            "stlc bench disturbed runs/traffic/latest --guards none,paper --seeds 0..2 --steps 60",
            note="Deployments that are there are kept if run, world and size are still the same.",
        )
    )(disturbed)
    group.command(
        help=describe(
            "Time the robustness of whole traces, forward and backward.",
            "stlc bench robustness",
            "stlc bench robustness --samples 1000 --traces 1000",
            note="On one thread. `passes` is the time as a multiple of one pass over a signal (clone, and "
            "its backward); `plain torch` is how many times longer plain torch takes.",
        )
    )(robustness)
    group.command(
        help=describe(
            "Time the parts of a training step, and rollouts with verdicts and gradients.",
            "stlc bench step",
            "stlc bench step --only traffic --page docs/benchmarks.md",
            note="Milliseconds of processor time on one thread; the search beside it runs on another core.",
        )
    )(step)
    group.command(
        help=describe(
            "Time decisions for one agent, without a guard and with each.",
            "stlc bench latency",
            "stlc bench latency runs/traffic/latest runs/ship_track/latest --page docs/benchmarks.md",
            note="Milliseconds on one thread, in states of deployments. The full guard has its usual limit "
            "of 100 ms a decision.",
        )
    )(latency)
    group.command(
        help=describe(
            "Count what mends the plans that the monitor rejects, and time it.",
            "stlc bench polish",
            "stlc bench polish runs/ship_track/latest --scenario shifted --page docs/benchmarks.md",
            note="Gradient steps, climbs, both, and the whole guard, on the same states of a deployment.",
        )
    )(polish)
    group.command(
        help=describe(
            "Deploy policies in their worlds, without a guard and with each, and write the table.",
            "stlc bench worlds",
            "stlc bench worlds runs/ship_track/latest --seeds 0..9 --guards none,full",
            note="What was driven with the same policy, system and setting is kept. A system's scenarios "
            "that have worlds of their own are driven, too.",
        )
    )(worlds)
