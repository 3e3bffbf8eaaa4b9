"""Pictures of episodes: `render_mode="rgb_array"` of the environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.view.scene import DrawScene, SceneOptions, scene_animation

RenderMode: TypeAlias = Literal["rgb_array"]
Picture: TypeAlias = NDArray[np.uint8]

MODES = ["rgb_array"]
DPI = 100
"""Dots per inch; a picture is 7.6 inches wide, or less if it is tall."""


class Pictures:
    """Snapshots of an episode, and their pictures.

    Args:
        mode: `rgb_array`, or None if no pictures are wanted.
        draw: function that draws a frame of a scene on axes, such as the method `draw` of a world.
        dt: seconds between snapshots.

    Raises UsageError (U101) for another mode.
    """

    def __init__(self, mode: RenderMode | None, draw: DrawScene, dt: float) -> None:
        if mode not in (None, *MODES):
            raise usage(f"there is no render_mode `{mode}`", 'render_mode="rgb_array" gives pictures')
        self._mode, self._draw, self._dt = mode, draw, dt
        self._seen: list[Mapping[str, NDArray[Any]]] = []
        self._size: tuple[int, int] | None = None

    def add(self, snapshot: Mapping[str, NDArray[Any]], *, first: bool) -> None:
        """Add the snapshot of an instant, name -> array; the `first` one of an episode begins it anew."""
        if first:
            self._seen = []
        self._seen.append({name: np.array(values) for name, values in snapshot.items()})

    def shown(self) -> Picture:
        """Picture of the last instant, (height, width, 3); all pictures have the shape of the first one.

        Raises UsageError (U101) if no pictures are wanted, or no episode has begun.
        """
        if self._mode is None:
            raise usage(
                "this environment was made without render_mode", 'make it with render_mode="rgb_array"'
            )
        if not self._seen:
            raise usage("no episode has begun", "call `reset` first")
        scene = {name: np.stack([one[name] for one in self._seen]) for name in self._seen[0]}
        scene["decision"] = np.zeros((len(self._seen), 1), dtype=np.int64)
        animation = scene_animation(scene, SceneOptions(self._draw, self._dt))
        last = len(self._seen) - 1
        (image,) = animation.images(range(last, last + 1), DPI)
        self._size = self._size or image.size
        if image.size != self._size:
            image = image.resize(self._size)
        return np.asarray(image)


def snapshot(task: Task, states: Tensor) -> dict[str, NDArray[Any]]:
    """Arrays from which `ModelWorld.draw` draws agents with the states (agents, n) on the model."""
    names = task.plain.names
    return {"state": states[:, : len(names)].numpy(force=True), "names": np.array(names)}
