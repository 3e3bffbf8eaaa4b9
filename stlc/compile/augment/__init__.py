"""State augmentation: added states (timers, latches, statuses) that carry the past into a plan."""
