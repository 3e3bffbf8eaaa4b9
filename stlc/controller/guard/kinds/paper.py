"""`paper`: the backup policy of Meng and Fan (2023), which tries first actions before the policy."""

from stlc.controller.guard.kind import GuardKind

GUARD = GuardKind(
    name="paper",
    title="paper's guard",
    cost=1,
    flag="--backup",
    stages=("prefix_shooting", "longest_safe_prefix"),
    monitors=False,
    relaxes=False,
    timed=False,
    compared=True,
    exported=True,
)
