"""`full`: plan repair by gradient refinement, local search and random restarts, then the backup policy."""

from stlc.controller.guard.kind import GuardKind

GUARD = GuardKind(
    name="full",
    title="full guard",
    cost=2,
    help="also repairs plans",
    stages=(
        *("gradient_refine", "local_search", "restarts", "sampled_shooting"),
        *("prefix_shooting", "longest_safe_prefix"),
    ),
    compared=True,
)
