"""The pictures of the worlds in docs/img: a still of each, and traffic in motion.

    python tools/pictures.py --runs runs

deploys the newest run of every specification once (seed 0, with the paper's backup policy) and takes the
instant in which most agents were guarded.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from stlc.cli.app import main as stlc
from stlc.rundir import RunDir
from stlc.view.animate import film_of
from stlc.view.film import save_film, save_still

ROOT = Path(__file__).resolve().parent.parent
WORLDS = (
    ("traffic", None),
    ("reach_n_avoid", None),
    ("ship_safe", None),
    ("ship_track", None),
    ("ship_track", "shifted"),
    ("navigation", None),
    ("manipulation", None),
)
MOVING = "traffic"
MAX_BYTES = 700_000


def draw(spec: str, scenario: str | None, runs: Path, folder: Path) -> Iterator[Path]:
    """Deploy the newest run of `spec` and draw it; yields what was written."""
    run = RunDir.open(spec, runs)
    under = [] if scenario is None else ["--scenario", scenario]
    code = stlc(["simulate", str(run.path), "--backup", "--seeds", "1", "--no-pictures", *under])
    film = film_of(run, title=" · ".join(part for part in (spec, scenario) if part))
    if code or film is None:
        raise SystemExit(f"{run.shown} could not be deployed")
    name = "-".join(part for part in (spec, scenario) if part)
    yield save_still(film, folder / f"{name}.webp")
    if name == MOVING:
        path = folder / f"{name}.gif"
        save_film(film, path, max_bytes=MAX_BYTES)
        yield path


def main() -> int:
    """Draw them all, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--output", type=Path, default=ROOT / "docs/img")
    parser.add_argument("specs", nargs="*", help="specifications; by default all that have a world")
    given = parser.parse_args()
    for spec, scenario in WORLDS:
        if not given.specs or spec in given.specs:
            for path in draw(spec, scenario, given.runs, given.output):
                print(f"{path.stat().st_size / 1000:6.0f} kB  {path}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
