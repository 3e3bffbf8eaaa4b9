"""Kind of plant `sum`: its outputs are the sum of all inputs until now, times a gain."""

from dataclasses import dataclass

from stlc.dynamics.declaration.schema.record import key, number
from stlc.plants.kind import PlantKind


@dataclass(frozen=True, slots=True)
class SumKeys:
    """The keys of `sum` in a plant file."""

    gain: float = key(number(), "factor of the sum", 1.0)


class Sum:
    """The opened plant."""

    units = {}
    ended = False

    def __init__(self, layout):
        self._gain, self._count = layout.options["gain"], len(layout.outputs)

    def start(self, initial, param, inputs, seed):
        """Begin at the start value."""
        self._total = sum(initial)
        return [self._gain * self._total] * self._count

    def step(self, inputs):
        """Add the inputs."""
        self._total += sum(inputs)
        return [self._gain * self._total] * self._count


KIND = PlantKind(SumKeys, "gain", Sum)
