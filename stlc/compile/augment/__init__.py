"""State augmentation: timers, latches and statuses that carry the past into a plan."""
