"""States that a plan needs to know what was before it: timers, statuses, missions."""
