"""`none`: plans are judged, and followed whatever their verdicts are."""

from stlc.controller.guard.kind import GuardKind

GUARD = GuardKind(
    name="none",
    title="no guard",
    cost=0,
    intervenes=False,
    monitors=False,
    compared=True,
    exported=True,
)
