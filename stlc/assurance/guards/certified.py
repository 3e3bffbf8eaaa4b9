"""`certified`: the full guard, whose plans must be safe for all errors within the bounds of the scenario."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.controller.guard.kind import GuardInputs, GuardKind
from stlc.controller.guard.kinds.full import GUARD as FULL

if TYPE_CHECKING:
    from stlc.controller.guard.search import GuardSearch


class CertifiedGuard(GuardKind):
    """Guard that follows a plan only if its tube is safe."""

    def search(self, given: GuardInputs) -> GuardSearch:
        """Build the search for plans whose tubes are safe; see `CertifiedSearch`."""
        from stlc.assurance.certified_search import CertifiedSearch

        return CertifiedSearch(given, self)


GUARD = CertifiedGuard(
    name="certified",
    title="certified guard",
    cost=3,
    help="also bounds errors",
    stages=FULL.stages,
    needs="a requirement tagged `@safety`, and a scenario whose errors have bounds",
)
