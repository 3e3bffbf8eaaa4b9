"""`braking`: full braking, before the shortest prefix."""

from stlc.controller.guard.kind import GuardKind

GUARD = GuardKind(
    name="braking",
    title="braking guard",
    cost=1.5,
    help="brakes first",
    stages=("full_braking", "prefix_shooting"),
    timed=False,
)
