"""TensorBoard log of a training run (extra `log`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from stlc.escape import markdown
from stlc.extras import needed
from stlc.files import place

FOLDER = "tensorboard"
_PLAIN = ("accuracy", "feasible", "loss", "lr", "s_per_step")


class Writer(Protocol):
    """The methods of TensorBoard's `SummaryWriter` that are used here."""

    def add_scalar(self, tag: str, value: float, step: int, /) -> None:
        """Log a number."""

    def add_text(self, tag: str, text: str, step: int, /) -> None:
        """Log a text."""

    def close(self) -> None:
        """Write pending events and close."""


Opener: TypeAlias = "Callable[[Path], TensorBoardLogger]"
"""Constructor of a log from a run folder."""


class TensorBoardLogger:
    """TensorBoard logger of one run."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer

    def started(self, chosen: Mapping[str, Any]) -> None:
        """Log the resolved options."""
        lines = "\n".join(f"| {markdown(key)} | {markdown(str(value))} |" for key, value in chosen.items())
        self._writer.add_text("engine", f"| | |\n|---|---|\n{lines}", 0)

    def row(self, row: Mapping[str, Any]) -> None:
        """Log the numbers of a row of `train.jsonl`; those of the requirements form a group."""
        step = int(row["step"])
        for key in _PLAIN:
            if row.get(key) is not None:
                self._writer.add_scalar(key, float(row[key]), step)
        for name, share in (row.get("requirements") or {}).items():
            self._writer.add_scalar(f"requirements/{tag(name)}", float(share), step)
        if row.get("failing"):
            self._writer.add_scalar("repaired", row["repaired"] / row["failing"], step)

    def close(self) -> None:
        """Write pending events and close."""
        self._writer.close()


def find_writer() -> Opener:
    """Return a function that opens the log in a run's folder, by tensorboardX or else by torch.

    Raises:
        MissingError: R301, neither is installed.
    """
    torch_has_it = find_spec("tensorboard") and not find_spec("tensorboardX")
    module = "torch.utils.tensorboard" if torch_has_it else "tensorboardX"
    writer = needed(module, "`--log tensorboard` needs").SummaryWriter
    return lambda run: TensorBoardLogger(writer(str(place(run, f"{FOLDER}/events").parent)))


def tag(name: str) -> str:
    """Return a name as one part of a TensorBoard tag, without the `/` that separates groups.

    Different names have different results.
    """
    return re.sub(r"[^\w.-]|_(?=x[0-9a-f]+_)", lambda match: f"_x{ord(match[0]):x}_", name)
