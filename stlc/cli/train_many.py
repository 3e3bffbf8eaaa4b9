"""Training for several seeds: one run each, in a process of its own, and a table of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from stlc.cli.output import emit, emit_json, say, table

if TYPE_CHECKING:
    from stlc.controller.config import TrainConfig
    from stlc.controller.launch import Launch
    from stlc.controller.sweep import Errand, Returned

HEADER = ("seed", "accuracy", "95 % interval", "known feasible", "share", "worst requirement", "time", "run")
ENDED = 70
"""Exit code for a process that a signal ended."""


@dataclass(frozen=True, slots=True)
class Many:
    """Runs that differ in their seeds alone.

    Attributes:
        spec: the specification's file.
        system: as given, or None.
        config: what the runs have in common.
        launch: where, and under which name.
        seeds: one a run.
        jobs: processes at a time.
        log: of `--log`.
        pictures: whether reports are drawn.
    """

    spec: Path | None
    system: str | None
    config: TrainConfig
    launch: Launch
    seeds: Sequence[int]
    jobs: int
    log: str | None
    pictures: bool

    def errand(self, seed: int) -> Errand:
        """The command line of one run."""
        from stlc.controller.sweep import Errand

        config, launch = self.config, self.launch
        threads = config.threads or (1 if self.jobs > 1 else None)
        name = None if launch.name is None else f"{launch.name}-seed{seed}"
        options: Mapping[str, object] = {
            "--system": self.system,
            "--budget": None if config.budget is None else f"{config.budget!r}s",
            "--clock": config.clock,
            "--steps": config.steps,
            "--method": config.method,
            "--name": name,
            "--device": config.device,
            "--threads": threads,
            "--plans": config.plans,
            "--lr": config.lr,
            "--batch": config.batch,
            "--held-out": config.held_out,
            "--log": self.log,
            "--runs": launch.root,
        }
        given = [word for key, value in options.items() if value is not None for word in (key, str(value))]
        changed = [word for key, value in launch.overrides.items() for word in ("--set", f"{key}={value}")]
        drawn = () if self.pictures else ("--no-pictures",)
        return Errand(f"seed {seed}", (str(self.spec), "--seed", str(seed), *given, *changed, *drawn))


def train_many(many: Many, *, json: bool) -> NoReturn:
    """Train all, and print a table or the JSON document; raises `typer.Exit` with the exit code."""
    from stlc.controller.sweep import side_by_side

    errands = [many.errand(seed) for seed in many.seeds]
    seeds = dict(zip((errand.name for errand in errands), many.seeds, strict=True))
    found: dict[int, Returned] = {}
    try:
        for back in side_by_side(errands, jobs=many.jobs, begun=lambda errand: say(f"{errand.name} begins")):
            found[seeds[back.errand.name]] = back
            say(_line(back))
    except (KeyboardInterrupt, SystemExit):
        say(f"interrupted; runs that were going are saved: stlc runs list --runs {many.launch.root}")
        raise
    ordered = [found[seed] for seed in many.seeds]
    code = max((back.code if back.code >= 0 else ENDED) for back in ordered)
    if json:
        result = {"runs": [_entry(seed, found[seed]) for seed in many.seeds]}
        emit_json("train/1", ok=code == 0, exit_code=code, result=result)
    else:
        emit(
            table(
                [*(_cells(seed, found[seed]) for seed in many.seeds), *_mean(ordered)],
                header=HEADER,
                indent="",
            )
        )
    raise typer.Exit(code)


def _line(back: Returned) -> str:
    """What is said as a run ends."""
    accuracy = back.result.get("accuracy")
    if accuracy is None:
        return f"{back.errand.name} broke off with exit code {back.code}\n{back.said}".rstrip()
    return f"{back.errand.name} done: accuracy {accuracy:.4f}  {back.result['run']}"


def _cells(seed: int, back: Returned) -> tuple[str, ...]:
    result = back.result
    if result.get("accuracy") is None:
        return (str(seed), "", f"exit code {back.code}")
    low, high = result["interval"]
    shares = result["requirements"]
    worst = min(shares, key=shares.__getitem__)
    return (
        *(str(seed), f"{result['accuracy']:.4f}", f"[{low:.4f}, {high:.4f}]", f"{result['feasible']:.4f}"),
        *(_share(result), f"{worst} {shares[worst]:.4f}", f"{result['seconds']:.0f} s", result["run"]),
    )


def _share(result: Mapping[str, Any]) -> str:
    return f"{100 * result['accuracy'] / result['feasible']:.1f} %" if result["feasible"] else ""


def _mean(backs: Sequence[Returned]) -> list[tuple[str, ...]]:
    """The last line, where there are several runs that ended well."""
    results = [back.result for back in backs if back.result.get("accuracy") is not None]
    if len(results) < 2:
        return []
    accuracies = [float(result["accuracy"]) for result in results]
    spread = f"{min(accuracies):.4f} to {max(accuracies):.4f}"
    feasible = fmean(float(result["feasible"]) for result in results)
    mean = {"accuracy": fmean(accuracies), "feasible": feasible}
    return [("mean", f"{mean['accuracy']:.4f}", spread, f"{feasible:.4f}", _share(mean))]


def _entry(seed: int, back: Returned) -> dict[str, Any]:
    return {"seed": seed, "exit_code": back.code, **back.result}
